"""Pack and unpack zip archives: equal content gives equal bytes, and any damage is one error."""

import io
import struct
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from lzma import LZMAError

# What zipfile and its decompressors raise on altered bytes. RuntimeError covers encryption and NotImplementedError
# (another method or version); a bzip2 stream raises an OSError without a number.
_DAMAGE = (
    *(zipfile.BadZipFile, zlib.error, LZMAError, struct.error, EOFError, OverflowError, MemoryError),
    *(ValueError, LookupError, RuntimeError, OSError),
)
_DATE = (1980, 1, 1, 0, 0, 0)  # date of every member


class BadArchive(ValueError):
    """An archive that is damaged, or is none."""


@contextmanager
def reading_archive() -> Iterator[None]:
    """Raise BadArchive for whatever damaged bytes raise in the block; an OSError of the file passes."""
    try:
        yield
    except _DAMAGE as error:
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise BadArchive(str(error) or type(error).__name__) from error


def zip_bytes(members: Mapping[str, bytes], *, level: int = 0) -> bytes:
    """Return a zip of the members in their order, deflated at a level, or stored (0)."""
    stream = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if level else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in members.items():
            entry = zipfile.ZipInfo(name, _DATE)
            entry.create_system, entry.external_attr = 3, 0o644 << 16
            archive.writestr(entry, content, method, level or None)
    return stream.getvalue()


def unzip_bytes(data: bytes) -> dict[str, bytes]:
    """Return the members in their order, each checked by its CRC. Raises BadArchive."""
    with reading_archive(), zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {entry.filename: archive.read(entry) for entry in archive.infolist()}
