"""Name benchmark versions by content digests: equal content has equal versions.

A part (a category's specs or clips, a dataset's items) has the release's version while it equals the release, and
`release+digest` once a correction has changed it. Other parts keep their version. So a rebuilt study and one corrected
in place agree.
"""

import json
from collections.abc import Iterable, Mapping
from typing import Any

from traps_pipeline.base.digests import digest
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.protocol.datasets import is_ill_posed
from traps_pipeline.scenes.worlds.spec import SceneSpec


def version_of(released: Iterable[Any], current: Iterable[Any]) -> str:
    """Return the release's version; with a digest (0.3.0+3f2a9c01) if content differs."""
    release = load_release().version
    digests = sorted(digest(part) for part in current)
    return release if digests == sorted(digest(part) for part in released) else f"{release}+{digest(digests)[:8]}"


def item_content(dataset: str, record: Mapping[str, Any]) -> list[Any]:
    """Return the fields of a record (or its row) that a dataset's version hashes, in order."""
    aliases = record["aliases"] if isinstance(record["aliases"], dict) else json.loads(record["aliases"])
    content = [record["scenario_id"], record["scene_hash"], record["question"], list(record["labels"]), aliases]
    content.append(record["ground_truth"])
    return [*content, record["ill_posed_question"]] if is_ill_posed(dataset) else content


def spec_record(spec: SceneSpec) -> dict[str, Any]:
    """Return a scenario's record as a mapping with its scene hash, as `item_content` reads it."""
    return spec.model_dump(mode="json") | {"scene_hash": spec.scene_hash}
