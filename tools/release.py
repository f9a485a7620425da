"""Cuts a version: `make release VERSION=0.4.0`, or checks one that is tagged: `make release-check TAG=v0.4.0`.

Cutting checks everything at once, dates the changelog, commits, tags, and builds wheel and bill of materials into
`dist/`. It pushes nothing. Where something fails, neither commit nor tag is left.
"""

from __future__ import annotations

import argparse
import datetime
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from packaging.version import InvalidVersion, Version

ROOT = Path(__file__).resolve().parents[1]
PLACEHOLDERS = re.compile(r"OWNER|host\.invalid|SECURITY-ADDRESS")
TO_FILL = ("README.md", "pyproject.toml", "SECURITY.md", ".github/CODEOWNERS")


def run(*command: str) -> str:
    """Return what a command prints; its errors go to the terminal."""
    return subprocess.run(command, cwd=ROOT, check=True, text=True, stdout=subprocess.PIPE).stdout.strip()


def build_version() -> str:
    """Return the version that a build of this checkout would have."""
    return run(sys.executable, "-m", "hatchling", "version")


def unfit(version: str, heading: str) -> Iterator[str]:
    """Yield a sentence for each reason why this checkout can be no such version, whose changelog has this heading."""
    from tools.lock import outdated

    if not re.search(rf"^## {heading}$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE):
        yield f"CHANGELOG.md: has no section of {version}: write one under `## Unreleased`"
    benchmark = re.findall(r"^version: (.+)$", (ROOT / "scene_specs/benchmark.yaml").read_text(), re.MULTILINE)[0]
    if f"\n## {benchmark}\n" not in (ROOT / "docs/benchmark.md").read_text(encoding="utf-8"):
        yield f"docs/benchmark.md: has no section `## {benchmark}`: say what may be compared with the version before"
    yield from outdated()
    for name in TO_FILL:
        if found := sorted({*PLACEHOLDERS.findall((ROOT / name).read_text(encoding="utf-8"))}):
            yield f"{name}: put your own in the place of {', '.join(found)}"


def unfit_to_cut(version: str) -> Iterator[str]:
    """Yield a sentence for each reason why this version cannot be cut here and now."""
    if changes := run("git", "status", "--porcelain"):
        yield f"git: commit these first, or take them away: {changes}"
    tags = run("git", "tag", "--list", "v*").split()
    try:
        if not (newest := Version(version)).release == tuple(map(int, version.split("."))):
            raise ValueError
        if older := [tag for tag in tags if Version(tag) >= newest]:
            yield f"VERSION={version}: is not after {', '.join(older)}"
    except (InvalidVersion, ValueError):
        yield f"VERSION={version}: is no version such as 0.4.0"
    yield from unfit(version, "Unreleased")


def unfit_as_tagged(tag: str) -> Iterator[str]:
    """Yield a sentence for each reason why this checkout is not the version that it is tagged as."""
    if (built := f"v{build_version()}") != tag:
        yield f"this checkout is {built} and not {tag}: check the tag out, with no changed file"
    version = tag.removeprefix("v")
    yield from unfit(version, rf"{re.escape(version)} - \d{{4}}-\d\d-\d\d")


def cut(version: str) -> None:
    """Date the changelog, commit, tag, and build; take commit and tag back where that fails."""
    log, before = ROOT / "CHANGELOG.md", run("git", "rev-parse", "HEAD")
    dated = f"## {version} - {datetime.datetime.now(datetime.UTC):%Y-%m-%d}"
    log.write_text(log.read_text(encoding="utf-8").replace("## Unreleased", dated, 1), encoding="utf-8")
    try:
        run("git", "commit", "--quiet", "--message", f"Release {version}", "CHANGELOG.md")
        run("git", "tag", "--annotate", f"v{version}", "--message", f"Version {version}")
        stop_at([*unfit_as_tagged(f"v{version}")])
        run(sys.executable, "-m", "hatchling", "build", "-t", "wheel")
        run(sys.executable, "tools/sbom.py", "dist/sbom.json")
    except BaseException:
        subprocess.run(["git", "tag", "--delete", f"v{version}"], cwd=ROOT, check=False, capture_output=True)
        run("git", "reset", "--quiet", "--hard", before)
        raise
    print(
        f"v{version} is tagged, and dist/ has its wheel and sbom.json; publish it with: git push origin HEAD v{version}"
    )


def stop_at(problems: list[str]) -> None:
    """End the program where there are problems, and print all of them."""
    if problems:
        sys.exit("\n".join(problems))


def main() -> None:
    """Cut a version, or check a tagged one."""
    parser = argparse.ArgumentParser(description=__doc__)
    task = parser.add_mutually_exclusive_group(required=True)
    task.add_argument("--cut", metavar="VERSION")
    task.add_argument("--check", metavar="TAG")
    arguments = parser.parse_args()
    if arguments.check is not None:
        stop_at([*unfit_as_tagged(arguments.check)])
    else:
        stop_at([*unfit_to_cut(arguments.cut)])
        cut(arguments.cut)


if __name__ == "__main__":
    main()
