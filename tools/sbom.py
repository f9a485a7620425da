"""Writes what the lock installs as a CycloneDX 1.6 bill of materials: `make sbom`. Offline; the same bytes each time.

    python tools/sbom.py dist/sbom.json

Packages, versions, files and hashes come from `pylock.toml`; licences from the metadata of packages that are installed
here in the locked version.
"""

from __future__ import annotations

import json
import sys
import tomllib
from importlib.metadata import PackageMetadata, PackageNotFoundError, metadata, version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def licences(found: PackageMetadata) -> list[dict[str, Any]]:
    """Return what a package says of its licence: an SPDX expression, else its classifiers' names, else nothing."""
    if "License-Expression" in found:
        return [{"expression": found["License-Expression"]}]
    named = [line.split(" :: ")[-1] for line in found.get_all("Classifier", []) if line.startswith("License :: ")]
    return [{"license": {"name": name}} for name in sorted(set(named))]


def component(package: dict[str, Any]) -> dict[str, Any]:
    """Return one package of the lock."""
    name, version = package["name"], package["version"]
    files = [*package.get("wheels", ()), *filter(None, [package.get("sdist")])]
    distributions = [
        {
            "type": "distribution",
            "url": Path(file["path"]).name,
            "hashes": [{"alg": "SHA-256", "content": file["hashes"]["sha256"]}],
        }
        for file in files
    ]
    purl = f"pkg:pypi/{name}@{version}"
    entry = {"type": "library", "bom-ref": purl, "name": name, "version": version, "purl": purl}
    try:
        distribution = metadata(name)
    except PackageNotFoundError:
        distribution = None
    if distribution is not None and distribution["Version"] == version and (licence := licences(distribution)):
        entry["licenses"] = licence
    return entry | {"externalReferences": sorted(distributions, key=lambda one: one["url"])}


def bill(pylock: str, project: dict[str, Any]) -> dict[str, Any]:
    """Return the whole bill of the text of a `pylock.toml`, without a time and a serial number: it is named by its
    content."""
    packages = sorted(tomllib.loads(pylock)["packages"], key=lambda one: (one["name"], one["version"]))
    purl = f"pkg:pypi/{project['name']}@{project['version']}"
    ours = {"type": "application", "bom-ref": purl, "name": project["name"], "version": project["version"]}
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": {"component": ours | {"licenses": [{"expression": project["license"]}]}},
        "components": [component(package) for package in packages],
    }


def main() -> None:
    """Write the bill to the file that the first argument names."""
    (out,) = map(Path, sys.argv[1:])
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    project["version"] = version(project["name"])  # of the tag that was installed
    document = bill((ROOT / "pylock.toml").read_text(encoding="utf-8"), project)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"{out}: {len(document['components'])} packages")


if __name__ == "__main__":
    main()
