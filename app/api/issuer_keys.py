"""The public keys of an OpenID Connect issuer, by its discovery document; asked for seldom, kept while it is away."""

import logging
from threading import Event, Lock
from time import monotonic
from typing import Any

import httpx
from joserfc.errors import JoseError
from joserfc.jwk import ECKey, JWKRegistry, OKPKey, RSAKey

from app.errors import Unavailable

__all__ = ["IssuerKeys", "PublicKey"]

_log = logging.getLogger(__name__)
PublicKey = RSAKey | ECKey | OKPKey

FRESH_S = 600.0
"""Keys older than this are asked for again: one that the issuer took back is good for so long."""
ASK_EVERY_S = 10.0
"""At least this long between two fetches, however many tokens name keys nobody knows."""
TIMEOUT_S = 5.0
MOST_BYTES = 256 * 1024
MOST_KEYS = 100
LEAST_RSA_BITS = 2048


class IssuerKeys:
    """Finds keys by their id. Safe to use from several threads: one fetches, and but for the first time no other waits
    for it."""

    def __init__(self, issuer: str) -> None:
        self._issuer = issuer
        self._keys: dict[str, PublicKey] = {}
        self._fetched_at: float | None = None
        self._asked_at: float | None = None
        self._failed = False
        self._asking, self._first = Lock(), Event()

    def find(self, kid: str) -> PublicKey | None:
        """The key of this id; the issuer is asked for one that is not known, unless it was asked a moment ago.

        Raises Unavailable when it is not known and the issuer did not answer.
        """
        key = self._keys.get(kid)
        if key is not None or (self._wait_s() > 0.0 and not self._failed):
            return key
        if not self._ask():
            raise Unavailable(
                "the issuer of this token cannot be asked for its keys now",
                retry_after_s=max(self._wait_s(), 1.0),
            )
        return self._keys.get(kid)

    def refresh(self) -> None:
        """Ask again if the keys are old. Called now and then, so that no request has to wait for it."""
        if self._fetched_at is None or monotonic() - self._fetched_at >= FRESH_S:
            self._ask()

    def _wait_s(self) -> float:
        """Until the issuer may be asked again."""
        return 0.0 if self._asked_at is None else self._asked_at + ASK_EVERY_S - monotonic()

    def _ask(self) -> bool:
        """Fetch the keys, unless it is too early or another thread is about it; whether they were fetched."""
        if not self._asking.acquire(blocking=False):
            return not self._first.is_set() and self._first.wait(TIMEOUT_S) and not self._failed
        try:
            if self._wait_s() > 0.0:
                return not self._failed
            self._asked_at, self._failed = monotonic(), True
            self._keys = _fetch(self._issuer)
            self._fetched_at, self._failed = monotonic(), False
        except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
            _log.warning("the keys of %s could not be fetched; those known stay: %s", self._issuer, error)
        finally:
            self._asking.release()
            self._first.set()
        return not self._failed


def _fetch(issuer: str) -> dict[str, PublicKey]:
    """Raises HTTPError, InvalidURL, ValueError."""
    with httpx.Client(timeout=TIMEOUT_S, follow_redirects=False) as http:
        found = _read(http, issuer.rstrip("/") + "/.well-known/openid-configuration")
        if found.get("issuer") != issuer:
            raise ValueError(f"its discovery document is of {found.get('issuer')!r}: set ISODYN_OIDC_ISSUER to that")
        address = found.get("jwks_uri")
        if not isinstance(address, str) or (issuer.startswith("https:") and not address.startswith("https:")):
            raise ValueError(f"its jwks_uri {address!r} cannot be trusted")
        told = _read(http, address).get("keys")
    if not isinstance(told, list):
        raise ValueError("its key set has no list of keys")
    usable = (_usable(each) for each in told[:MOST_KEYS])
    return {key.kid: key for key in usable if key is not None and key.kid is not None}


def _read(http: httpx.Client, address: str) -> dict[str, Any]:
    with http.stream("GET", address, headers={"Accept": "application/json"}) as answer:
        answer.raise_for_status()
        data = b""
        for part in answer.iter_bytes():
            data += part
            if len(data) > MOST_BYTES:
                raise ValueError(f"{address} holds more than {MOST_BYTES} bytes")
    read = httpx.Response(200, content=data).json()
    if not isinstance(read, dict):
        raise ValueError(f"{address} is no JSON object")
    return read


def _usable(told: Any) -> PublicKey | None:
    """A key to verify signatures with; None for one for something else, of another kind, or too weak."""
    if not isinstance(told, dict) or told.get("use", "sig") != "sig" or not isinstance(told.get("kid"), str):
        return None
    if told.get("kty") not in ("RSA", "EC", "OKP"):
        return None  # a shared secret above all
    if told["kty"] == "RSA" and 6 * len(str(told.get("n"))) < LEAST_RSA_BITS:
        return None
    try:
        key = JWKRegistry.import_key(told)
    except (JoseError, ValueError, TypeError, KeyError):
        return None
    return key if isinstance(key, RSAKey | ECKey | OKPKey) else None
