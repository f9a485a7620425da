"""Writes the locks from `pyproject.toml`: `make lock`. Needs uv on the PATH, and a package index.

With `--check` it writes nothing and needs neither: it fails where a lock does not hold what `pyproject.toml` asks.

requirements.lock: everything that `make test` wants, but torch, which comes in builds for CPUs and each kind of GPU.
requirements-core.lock: what `make demo` wants, a part of it. pylock.toml: the former as PEP 751 has it.

Locks hold names, versions and hashes, and no addresses: pip checks the hashes, whatever index it is told to use. PEP
751 demands an address or a path for each file, so `pylock.toml` names files below `wheels/`, a folder that

    python -m pip download --no-deps --require-hashes -r requirements.lock -d wheels

fills, for machines without a network.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LOCK, CORE, PYLOCK = (ROOT / name for name in ("requirements.lock", "requirements-core.lock", "pylock.toml"))
WHEELS = "wheels"
BUILD = "hatchling\nhatch-vcs\n"  # installs the checkout itself
TORCH_NEEDS = "filelock\nfsspec\nnetworkx\nsetuptools>=77\nsympy\n"
UNLOCKED = ("sign", "cluster")  # the latter has a lock of its own
WITHOUT_TORCH = 'torch; sys_platform == "never"\n'


def compile_lock(out: Path, needs: str, *options: str | Path) -> None:
    """Let uv resolve the project and the lines in `needs` for all platforms; versions that `out` holds are kept."""
    with tempfile.TemporaryDirectory() as folder:
        also, override = Path(folder) / "also.in", Path(folder) / "override.txt"
        also.write_text(needs, encoding="utf-8")
        override.write_text(WITHOUT_TORCH, encoding="utf-8")
        command = ["uv", "pip", "compile", ROOT / "pyproject.toml", also, "--override", override, *options]
        command += ["--universal", "--python-version", "3.11", "--no-emit-package", "torch", "--no-header", "--quiet"]
        command += ["--no-annotate", "--no-emit-index-url", "--no-strip-extras", "--output-file", out]
        subprocess.run(list(map(str, command)), check=True, stdout=subprocess.DEVNULL)


def without_addresses(pylock: str) -> str:
    """Return a `pylock.toml` whose files lie in the folder `wheels`. Raises ValueError where an address is left."""
    pylock = re.sub(r'\burl = "[^"]*/([^"/]+)"', rf'path = "{WHEELS}/\1"', pylock)
    pylock = re.sub(r"upload-time = [^,]+, ", "", pylock)  # of the index, not of the file
    pylock = re.sub(r'^index = ".*"\n', "", pylock, flags=re.MULTILINE)
    if "://" in pylock:
        raise ValueError("pylock.toml: an address is left in a form that this script does not know; see what uv wrote")
    return pylock


def outdated(project: Path = ROOT / "pyproject.toml", lock: Path = LOCK) -> Iterator[str]:
    """Yield a sentence for each requirement that the lock's version of it does not meet, or that the lock lacks.

    What is in no lock is not looked at: torch, and the extras `sign` and `cluster`.
    """
    from packaging.requirements import Requirement

    table = tomllib.loads(project.read_text(encoding="utf-8"))["project"]
    extras = table["optional-dependencies"]
    pins = dict(re.findall(r"^([\w.-]+)(?:\[.*?\])?==([^ ;]+)", lock.read_text(encoding="utf-8"), re.MULTILINE))
    requirements = [*table["dependencies"], *(line for name in extras if name not in UNLOCKED for line in extras[name])]
    for requirement in map(Requirement, requirements):
        name = re.sub(r"[-_.]+", "-", requirement.name).lower()
        if name in (table["name"], "torch"):
            continue
        if name not in pins:
            yield f"{lock.name}: lacks {requirement}, which {project.name} asks; run `make lock`"
        elif not requirement.specifier.contains(pins[name], prereleases=True):
            yield f"{lock.name}: has {name} {pins[name]}, but {project.name} asks {requirement}; run `make lock`"


def main() -> None:
    """Write all three. Versions that are locked stay, unless `--upgrade` is among the arguments."""
    more = sys.argv[1:]
    if more == ["--check"]:
        sys.exit("\n".join(outdated()) or None)
    everything = ("--extra", "all", "--extra", "dev", "--extra", "docs")
    compile_lock(LOCK, BUILD + TORCH_NEEDS, *everything, "--generate-hashes", *more)
    compile_lock(CORE, BUILD, "--constraints", LOCK, "--generate-hashes", *more)
    with tempfile.TemporaryDirectory() as folder:
        written = Path(folder) / PYLOCK.name
        compile_lock(written, BUILD + TORCH_NEEDS, *everything, "--constraints", LOCK, "--format", "pylock.toml")
        PYLOCK.write_text(without_addresses(written.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
