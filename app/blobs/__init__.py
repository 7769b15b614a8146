"""The blob store: immutable bytes under the SHA-256 of their content."""

from pathlib import Path
from urllib.parse import unquote, urlsplit

from app.blobs.folder import FolderBlobStore
from app.blobs.s3 import S3BlobStore
from app.blobs.store import BlobStore, StoredBlob
from app.errors import InvalidInput

__all__ = ["BlobStore", "FolderBlobStore", "S3BlobStore", "StoredBlob", "open_blob_store"]


def open_blob_store(url: str, *, make: bool = True) -> BlobStore:
    """The store at a `file://` or `s3://` address; a folder is made if there is none, unless `make` is false.

    Raises InvalidInput for addresses that are not offered.
    """
    parts = urlsplit(url)
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return FolderBlobStore(Path(unquote(parts.path)), make=make)
    if parts.scheme == "s3":
        return S3BlobStore(url)
    raise InvalidInput(
        f"blob address {url!r} cannot be read: use file:///FOLDER with an absolute path, or s3://BUCKET/PREFIX"
    )
