"""Reach an object store (S3, Google, Azure) by obstore; its errors are sentences."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.keys import optional_key

# Environment variables that obstore reads, by kind of store.
KEYS = {
    "s3": "AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_REGION, and AWS_ENDPOINT for a server of your own",
    "gs": "GOOGLE_APPLICATION_CREDENTIALS, the path of a file with a service account's key",
    "az": "AZURE_STORAGE_ACCOUNT_NAME and AZURE_STORAGE_ACCOUNT_KEY; the bucket is a container of that account",
}
_SECRETS = {
    "s3": ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"),
    "az": ("AZURE_STORAGE_ACCOUNT_KEY",),
}
_NO_BUCKET = ("NoSuchBucket", "ContainerNotFound")  # the services' terms; Azure's is the latter


def object_name(digest: bytes) -> str:
    """Return a content's name, by its SHA-256, in the store and in scratch folders."""
    return f"{digest.hex()[:2]}/{digest.hex()}"


class Bucket:
    """A place in an object store, such as s3://bucket/study (TRAPS_WORKSPACE)."""

    def __init__(self, address: str) -> None:
        require_extra("cluster", "obstore")
        from obstore.store import from_url

        self.address, self._kind = address, address.partition(":")[0]
        for variable in _SECRETS.get(self._kind, ()):
            optional_key(variable)  # obstore reads it again
        with self._used():
            self._store = from_url(address, retry_config={"max_retries": 5})

    @contextmanager
    def _used(self) -> Iterator[None]:
        """Translate errors within the block to FileNotFoundError or TrapsError."""
        from obstore.exceptions import BaseError

        try:
            yield
        except (BaseError, FileNotFoundError, ValueError, TypeError) as error:
            if isinstance(error, FileNotFoundError) and not any(code in str(error) for code in _NO_BUCKET):
                raise
            reason = " ".join(str(error).split())[:300]
            raise TrapsError(
                f"{self.address}: cannot be used from the host {socket.gethostname()} ({reason}). See that the bucket "
                f"exists, that its keys and its address are in the environment ({KEYS[self._kind]}), and that this "
                "machine's clock is right; then run the same command again: what is finished is kept"
            ) from None

    def get(self, name: str) -> bytes | None:
        """Return an object's content; None if it is missing. Raises TrapsError."""
        with suppress(FileNotFoundError), self._used():
            return bytes(self._store.get(name).bytes())
        return None

    def size(self, name: str) -> int | None:
        """Return an object's size in bytes; None if it is missing. Raises TrapsError."""
        with suppress(FileNotFoundError), self._used():
            return int(self._store.head(name)["size"])
        return None

    def put(self, name: str, content: bytes) -> None:
        """Write an object. Raises TrapsError."""
        with self._used():
            self._store.put(name, content)

    def delete(self, names: Sequence[str]) -> None:
        """Remove objects. Raises TrapsError."""
        with suppress(FileNotFoundError), self._used():
            self._store.delete(names)

    def names(self, below: str = "") -> Iterator[tuple[str, int, datetime]]:
        """Yield objects' name, size (bytes) and time, below a name. Raises TrapsError."""
        with self._used():
            for page in self._store.list(below or None):
                yield from ((entry["path"], entry["size"], entry["last_modified"]) for entry in page)
