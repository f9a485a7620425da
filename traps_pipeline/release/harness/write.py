"""Write the folder with which inspect_ai and lmms-eval evaluate on a release."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import yaml

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes, write_text
from traps_pipeline.base.yamlfile import read_lines
from traps_pipeline.models.registry.entries import PROTOCOL_PARAMS
from traps_pipeline.models.registry.judges import RULES_PANEL, panel_id
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.protocol.regimes import BY_NAME
from traps_pipeline.release.checksums import altered_files
from traps_pipeline.release.content import CLIPS, SYSTEM
from traps_pipeline.release.folder import MANIFEST
from traps_pipeline.release.harness.harness_items import ABOUT, ITEMS, MEDIA
from traps_pipeline.release.harness.scoring import TWO_WAY_METRICS
from traps_pipeline.storage.media import MediaSpec, MediaStore, payload

PACKAGE, LMMS = "traps_harness", "lmms"
_CODE = Path(__file__).parents[2]
# Modules that are copied under their own names. They import each other and the standard library.
_COPIED = (
    *("base/digests.py", "base/redaction.py", "protocol/regimes.py", "protocol/datasets.py", "protocol/two_events.py"),
    *("models/request.py", "models/reading/endings.py", "models/reading/thinking.py", "models/reading/interpret.py"),
    *("models/reading/judged_answers.py", "judging/rules.py", "release/harness/scoring.py"),
    *("release/harness/harness_items.py", "release/harness/inspect_task.py"),
)
_IMPORT = re.compile(r"(?m)^( *)from traps_pipeline\.([\w.]+) import ")
_ITEM_FIELDS = ("item_id", "dataset", "side", "question", "labels", "aliases", "answer_type", "ground_truth", "canary")
MEDIA_SETTINGS: Mapping[Literal["images", "video"], MediaSpec] = {
    "images": MediaSpec(profile="images", fps=5, most=25),
    "video": MediaSpec(profile="video", fps=5, most=25),
}


def media_settings(media: Literal["images", "video"], uniform: int | None = None) -> MediaSpec:
    """Return media settings of the protocol, or of even frames. Raises TrapsError."""
    if uniform is None:
        return MEDIA_SETTINGS[media]
    if media == "video":
        raise TrapsError("--uniform: goes with --media images; a video plays the protocol's 5 frames a second")
    return MediaSpec(profile="images", uniform=uniform)


def write_harness(release: Path, target: Path, media: MediaSpec = MEDIA_SETTINGS["images"]) -> int:
    """Write the harness of a release's pairs and two events to an empty folder; return item count.

    media: of `media_settings`: the JPEGs or the mp4 that the pipeline sends, byte for byte. Raises TrapsError for an
    altered release or one without answers, and for a folder that holds other files.
    """
    if target.exists() and any(target.iterdir()):
        raise TrapsError(
            f"{target}: holds other files, or what a stopped harness left; give an empty or a new folder, or delete it"
        )
    problems = altered_files(release)
    if problems:
        raise TrapsError(f"{release}: is not what was released: {problems[0]}")
    manifest = json.loads((release / MANIFEST).read_text(encoding="utf-8"))
    if manifest["held_out"]:
        raise TrapsError(f"{release}: is a held-out set, whose answers only its owner can score")
    package = target / PACKAGE
    items = _items(release, package, media)
    prompts = [json.loads(line) for _, line in read_lines(release / "prompts.jsonl")]
    description = {
        **{name: manifest[name] for name in ("name", "version", "canary", "versions")},
        "panel": panel_id(RULES_PANEL),
        "media": media.model_dump(mode="json", exclude_none=True),
        "prompts": {row["name"]: row["text"] for row in prompts if row["role"] == SYSTEM and _is_of_text(row["name"])},
        "parameters": {name: value for name, (_, value) in PROTOCOL_PARAMS.items()},
        "items": digest(sorted(items)),
    }
    write_text(package / ABOUT, json.dumps(description, indent=1, ensure_ascii=False) + "\n")
    for source in _COPIED:
        write_text(package / Path(source).name, rewritten_source((_CODE / source).read_text(encoding="utf-8")))
    write_text(package / "__init__.py", f'"""The items, panel and metric of {manifest["name"]}."""\n')
    write_text(target / "traps_task.py", _TASK)
    write_text(target / "pyproject.toml", _PYPROJECT.format(version=manifest["version"].partition("+")[0]))
    _lmms(target, description)
    return len(items)


def rewritten_source(source: str) -> str:
    """Return a module's source with imports rewritten for the harness."""
    return _IMPORT.sub(lambda m: f"{m[1]}from {PACKAGE}.{m[2].rpartition('.')[2]} import ", source)


def _items(release: Path, package: Path, media: MediaSpec) -> list[str]:
    """Write items and their media; return the digests of the items."""
    store, media_paths, lines, hashes = (
        MediaStore(package / ".prepared"),
        dict[str, list[str]](),
        list[str](),
        list[str](),
    )
    for _, line in read_lines(release / CLIPS / "metadata.jsonl"):
        row: dict[str, Any] = json.loads(line)
        if row["dataset"] not in (*DATASETS, TWO_EVENTS):
            continue
        clip = row["media_digest"]
        if clip not in media_paths:
            media_sent = store.prepare(release / CLIPS / row["file_name"], clip, media)
            media_paths[clip] = []
            for number, part in enumerate(payload(media_sent)):
                name = f"{MEDIA}/{clip[:32]}" + (f"/{number:02d}.jpg" if media.profile == "images" else ".mp4")
                write_bytes(package / name, part)
                media_paths[clip].append(name)
        item = {name: row[name] for name in _ITEM_FIELDS} | {"media": media_paths[clip]}
        lines.append(json.dumps(item, ensure_ascii=False) + "\n")
        hashes.append(row["item_hash"])
    write_text(package / ITEMS, "".join(lines))
    import shutil

    shutil.rmtree(store.folder)
    return hashes


# --- files of the harnesses -------------------------------------------------------------------------------------------

_TASK = '''"""`inspect eval traps_task.py -T regime=standard --model ...`: inspect_ai wants a task in this very file."""

import sys
from pathlib import Path

from inspect_ai import Task, task

sys.path.insert(0, str(Path(__file__).resolve().parent))

from traps_harness.inspect_task import evaluation  # noqa: E402


@task
def traps(regime: str = "standard") -> Task:
    """All items under one regime, once."""
    return evaluation(regime)
'''
_PYPROJECT = """[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "traps-harness"
version = "{version}"
requires-python = ">=3.11"

[project.entry-points.inspect_ai]
traps_harness = "traps_harness.inspect_task"

[tool.setuptools]
packages = ["traps_harness"]

[tool.setuptools.package-data]
traps_harness = ["*.json", "*.jsonl", "media/**"]
"""


def _is_of_text(regime: str) -> bool:
    """Return whether a regime is scored by the text of its answers alone."""
    return regime not in BY_NAME or not BY_NAME[regime].first_token


def _lmms(target: Path, about: Mapping[str, Any]) -> None:
    """Write a task for each regime. lmms-eval uses its path as written, so the folder must not be moved."""
    write_text(
        target / LMMS / "utils.py", rewritten_source((_CODE / "release/harness/lmms_utils.py").read_text("utf-8"))
    )
    parameters = {"max_new_tokens": about["parameters"]["max_tokens"], "do_sample": True}
    parameters |= {name: about["parameters"][name] for name in ("temperature", "top_p")}
    less_is_better = ["other_effect", *(name for name, metric in METRIC_WORDS.items() if metric.less_is_better)]
    for regime in about["prompts"]:
        task = {
            "task": f"traps_{regime}",
            "dataset_path": "json",
            "dataset_kwargs": {"data_files": {"test": str((target / PACKAGE / ITEMS).absolute())}},
            "test_split": "test",
            "output_type": "generate_until",
            "doc_to_visual": _Function("utils.doc_to_visual"),
            "doc_to_text": _Function(f"utils.{regime}_text"),
            "doc_to_messages": _Function(f"utils.{regime}_messages"),
            "doc_to_target": _Function("utils.doc_to_target"),
            "process_results": _Function(f"utils.{regime}_results"),
            "generation_kwargs": parameters,
            "metric_list": [
                {
                    "metric": f"traps_{name}",
                    "aggregation": _Function(f"utils.{name}"),
                    "higher_is_better": name in (*METRIC_WORDS, *TWO_WAY_METRICS) and name not in less_is_better,
                }
                for name in (*METRIC_WORDS, *TWO_WAY_METRICS, "missing", "unread")
            ],
            "metadata": [{"version": about["version"], "canary": about["canary"]}],
        }
        text = yaml.dump(task, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
        write_text(target / LMMS / f"traps_{regime}.yaml", f"# {about['canary']}\n{text}")


class _Function(str):
    """A function of `utils.py`, as lmms-eval's YAML names it."""


class _Dumper(yaml.SafeDumper):
    """Writes `!function utils.name`, and no anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(_Function, lambda dumper, value: dumper.represent_scalar("!function", str(value)))
