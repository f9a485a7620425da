"""Write and verify the SHA-256 of a folder's files, as `sha256sum --check` does."""

import re
from pathlib import Path

from traps_pipeline.base.digests import file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text

CHECKSUMS = "SHA256SUMS"
SIGNATURE = "signature.sig.json"
_OUTSIDE = (CHECKSUMS, SIGNATURE)  # the checksum file itself, and the signature over it
_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")


def released_files(folder: Path) -> list[str]:
    """Return the files of a folder that have a checksum, by relative path, sorted."""
    paths = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file() or path.is_symlink()]
    names = [path.as_posix() for path in paths if not any(part.startswith(".") for part in path.parts)]
    return sorted(name for name in names if name not in _OUTSIDE)


def write_checksums(folder: Path, canary: str) -> int:
    """Write a folder's checksums below a canary comment; return the number of files."""
    names = released_files(folder)
    lines = [f"{file_digest(folder / name)}  {name}\n" for name in names]
    write_text(folder / CHECKSUMS, f"# {canary}\n{''.join(lines)}")
    return len(names)


def read_checksums(folder: Path) -> dict[str, str]:
    """Return checksums by path. Raises TrapsError naming an invalid line."""
    path = folder / CHECKSUMS
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise TrapsError(
            f"{path}: cannot be read ({error}); give the folder that `traps publish release` wrote"
        ) from error
    checksums: dict[str, str] = {}
    for number, line in enumerate(lines, start=1):
        if line.startswith("#"):
            continue
        match = _LINE.fullmatch(line)
        if match is None or match[2] in checksums or match[2].startswith("/") or ".." in Path(match[2]).parts:
            raise TrapsError(f"{path}:{number}: is no checksum of a file of the folder; get the folder again")
        checksums[match[2]] = match[1]
    return checksums


def altered_files(folder: Path) -> list[str]:
    """Compare a folder with its checksums, one sentence a file. Raises TrapsError."""
    expected, existing = read_checksums(folder), {*released_files(folder)}
    problems = []
    for name in sorted({*expected, *existing}):
        if name not in existing:
            problems.append(f"{name}: is missing")
        elif name not in expected:
            problems.append(f"{name}: has no checksum, so it was added")
        elif (folder / name).is_symlink():
            problems.append(f"{name}: is a link, not a file")
        elif file_digest(folder / name) != expected[name]:
            same_files = [known_name for known_name, sha256 in expected.items() if sha256 == file_digest(folder / name)]
            problems.append(f"{name}: is {f'in truth {same_files[0]}' if same_files else 'altered'}")
    return problems
