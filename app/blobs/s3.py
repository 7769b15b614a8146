"""Blobs in a bucket of S3, or of another server of its API, by obstore.

Under the prefix a blob has the name it has in a folder, `ab/cd/abcd...`, so that either can be copied to the other. A
blob is one PUT: there whole or not at all, and on the server's disks once it is answered. Its bytes are signed with
their hash, so that a server that checks signatures refuses what was damaged on the way.

How long a call may take: CONNECT_S to connect, REQUEST_S for one request with its bytes, RETRIES more tries (of what
is answered 5xx, lost or late) of which none begins later than RETRY_WITHIN_S: 75 s at worst, half a second or two where
nothing listens.
"""

import hashlib
import os
import re
from collections.abc import Iterator
from configparser import ConfigParser
from configparser import Error as ConfigParserError
from contextlib import contextmanager
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError
from obstore.store import S3Store

from app.blobs.observed import observed
from app.blobs.store import StoredBlob, check_name
from app.errors import CorruptArtefact, InvalidInput, NotFound, Unavailable

if TYPE_CHECKING:
    from obstore.store import S3Config

__all__ = ["S3BlobStore"]

CONNECT_S = 3
REQUEST_S = 60
RETRIES = 3
RETRY_WITHIN_S = 15
PAGE = 1000  # what S3 lists at most in one answer
A_SECOND = timedelta(seconds=1)  # which times of objects are whole numbers of

_ADDRESS = re.compile(r"s3://([a-z0-9][a-z0-9.-]{1,61}[a-z0-9])((?:/[A-Za-z0-9!_*'()=-][A-Za-z0-9!_.*'()=-]*)*)/?")
_KEY = re.compile(r"([0-9a-f]{2})/([0-9a-f]{2})/(\1\2[0-9a-f]{60})")

_used_in: int | None = None  # the process in which obstore's threads run; a fork of it has none


class S3BlobStore:
    """Blobs in a bucket. Threads may share one; credentials, region and endpoint are those of the environment.

    Nothing is asked of the server before the first blob. Every method raises Unavailable where the server does not
    answer, refuses the key, or has no such bucket; then nothing is acknowledged.
    """

    def __init__(self, address: str) -> None:
        """The store at `s3://BUCKET` or `s3://BUCKET/PREFIX`. Raises InvalidInput for what is no such address."""
        parts = _ADDRESS.fullmatch(address)
        if parts is None:
            told = "" if "@" in address else f" {address!r}"  # a secret is not repeated
            raise InvalidInput(
                f"blob address{told} cannot be read: use s3://BUCKET or s3://BUCKET/PREFIX; keys, region and endpoint "
                "belong into AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION and AWS_ENDPOINT_URL"
            )
        self._address = address.rstrip("/")
        self._bucket, self._prefix = parts[1], parts[2].lstrip("/")
        self._endpoint = _endpoint()
        self._opened: S3Store | None = None

    @observed
    def put(self, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        # Also where it is already: that costs no more than to read it, repairs damage, and makes it young again.
        with self._reached():
            self._client().put(_key(sha256), data, use_multipart=False)
        return sha256

    @observed
    def get(self, sha256: str) -> bytes:
        check_name(sha256)
        try:
            with self._reached():
                data = self._client().get(_key(sha256)).bytes().to_bytes()
        except FileNotFoundError:
            raise NotFound(
                f"no blob {sha256} in {self._address}: was the bucket cleaned, or does it expire what it holds?"
            ) from None
        if hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptArtefact(
                f"blob {sha256}: its {len(data)} bytes do not match their hash; restore it from a backup or an earlier "
                "version of the object, or upload or build it again"
            )
        return data

    @observed
    def exists(self, sha256: str) -> bool:
        check_name(sha256)
        client = self._client()
        try:
            with self._reached(told_why=False):
                client.head(_key(sha256))
        except FileNotFoundError:
            pass
        else:
            return True
        try:
            with self._reached():  # the answer to a GET, unlike that to a HEAD, says what is missing: blob or bucket
                client.get(_key(sha256))
        except FileNotFoundError:
            return False
        return True

    @observed
    def discard(self, sha256: str) -> None:
        check_name(sha256)
        try:
            with self._reached():
                self._client().delete(_key(sha256))
        except FileNotFoundError:  # some servers mind, S3 does not
            return

    @observed
    def discard_older(self, sha256: str, before: datetime) -> bool:
        """As the contract has it, but for a put between looking and deleting, some milliseconds: S3 deletes without
        conditions (docs/storage.md)."""
        check_name(sha256)
        try:
            with self._reached(told_why=False):
                told = self._client().head(_key(sha256))
            if told["last_modified"] + A_SECOND >= before:
                return False
            with self._reached():
                self._client().delete(_key(sha256))
        except FileNotFoundError:
            return False
        return True

    def stored(self) -> Iterator[StoredBlob]:
        found = []
        with self._reached():
            for page in self._client().list(chunk_size=PAGE):
                for each in page:
                    if name := _KEY.fullmatch(each["path"]):
                        found.append(StoredBlob(name[3], each["size"], each["last_modified"]))
        yield from sorted(found)  # as S3 lists them, but not every server of its API

    def _client(self) -> S3Store:
        global _used_in
        if _used_in is None:
            _used_in = os.getpid()
        if _used_in != os.getpid():
            raise RuntimeError(
                "blobs in S3 cannot be reached from a fork of a process that has reached them: its threads are not in "
                "the fork, and it would wait for ever; start a new process instead (subprocess, or multiprocessing's "
                "method spawn)"
            )
        if self._opened is None:  # two threads may make one each: the later is kept, the other works as well
            self._opened = self._open()
        return self._opened

    def _open(self) -> S3Store:
        config: S3Config = {"disable_bulk_delete": True, **_credentials()}  # which not every server of the API has
        if self._endpoint is not None:
            config["endpoint"] = self._endpoint
        return S3Store(
            self._bucket,
            prefix=self._prefix or None,
            config=config,
            client_options={
                "allow_http": self._endpoint is not None and self._endpoint.startswith("http://"),
                "connect_timeout": f"{CONNECT_S}s",
                "timeout": f"{REQUEST_S}s",
            },
            retry_config={
                "max_retries": RETRIES,
                "retry_timeout": timedelta(seconds=RETRY_WITHIN_S),
                "backoff": {
                    "init_backoff": timedelta(seconds=0.1),
                    "max_backoff": timedelta(seconds=2),
                    "base": 2,
                },
            },
        )

    @contextmanager
    def _reached(self, told_why: bool = True) -> Iterator[None]:
        """Raises Unavailable for whatever goes wrong but that a blob is not there, which stays FileNotFoundError.

        `told_why`: the answer has a body, which must say so itself; 404 alone may come from anywhere.
        """
        try:
            yield
        except (BaseError, OSError) as error:
            said = str(error)
            if isinstance(error, FileNotFoundError) and (not told_why or "<Code>NoSuchKey</Code>" in said):
                raise
            # A refused listing has no error of its own.
            refused = isinstance(error, (PermissionDeniedError, UnauthenticatedError))
            if refused or "status code: 403" in said or "status code: 401" in said:
                raise Unavailable(
                    f"the blob store {self._address} refuses its key: it needs s3:GetObject, s3:PutObject, "
                    "s3:DeleteObject and s3:ListBucket there (AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, "
                    "AWS_SESSION_TOKEN)"
                ) from error
            if "<Code>NoSuchBucket</Code>" in said:
                raise Unavailable(
                    f"the blob store {self._address} is not there: make the bucket {self._bucket}, or correct "
                    "ISODYN_BLOB_URL, AWS_REGION or AWS_ENDPOINT_URL"
                ) from error
            raise Unavailable(
                f"the blob store {self._address} cannot be reached now; nothing was acknowledged, try again "
                "(`isodyn doctor` says why)"
            ) from error


def _key(sha256: str) -> str:
    return f"{sha256[:2]}/{sha256[2:4]}/{sha256}"


def _credentials() -> "S3Config":
    """The key in the file of AWS_SHARED_CREDENTIALS_FILE, where there is one: secrets come as files to containers.

    Its section `default`, as other tools write it. Raises InvalidInput for what has no key.
    """
    file = os.environ.get("AWS_SHARED_CREDENTIALS_FILE")
    if not file:
        return {}
    parser = ConfigParser(interpolation=None)
    try:
        parser.read_string(Path(file).read_text())
        section = parser["default"]
        found: S3Config = {
            "access_key_id": section["aws_access_key_id"],
            "secret_access_key": section["aws_secret_access_key"],
        }
    except (OSError, KeyError, ConfigParserError) as error:
        raise InvalidInput(
            f"AWS_SHARED_CREDENTIALS_FILE: {file} has no key of the section [default] "
            f"(aws_access_key_id, aws_secret_access_key): {type(error).__name__}"
        ) from error
    if "aws_session_token" in section:
        found["session_token"] = section["aws_session_token"]
    return found


def _endpoint() -> str | None:
    """The server, where it is not Amazon's. Raises InvalidInput for what is no address of one."""
    for name in ("AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"):
        if endpoint := os.environ.get(name):
            parts = urlsplit(endpoint)
            if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or parts.password:
                raise InvalidInput(f"{name} cannot be read: use https://HOST, or http://HOST:PORT in a trusted network")
            return endpoint.rstrip("/")
    return None
