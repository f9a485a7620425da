"""Write the folder of `traps publish release`, byte-identical for the same study."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import replace_folder, write_bytes, write_text
from traps_pipeline.base.paths import ASSETS, OWN_SPECS, ROOT, SCENE_SPECS
from traps_pipeline.benchmark.held_out import (
    begin_publication,
    drawn_items,
    held_out_key,
    mark_held_out,
    opaque_name,
    require_secret_seed,
)
from traps_pipeline.release import content as rows_of
from traps_pipeline.release.card import card, dictionary
from traps_pipeline.release.checksums import CHECKSUMS, read_checksums, released_files, write_checksums
from traps_pipeline.release.content import CLIPS, Content
from traps_pipeline.release.croissant import croissant
from traps_pipeline.release.held_out_clips import date_equally, write_held_out_clips
from traps_pipeline.release.released_rows import (
    CERTIFICATES,
    HELD_OUT,
    HELD_OUT_ITEMS,
    OPEN,
    PAIRS,
    PROMPTS,
    RELEASED_ITEMS,
    SCENARIOS,
    SPLITS,
    TWO_EVENTS_SCENARIOS,
)
from traps_pipeline.storage.tables import Table

FORMAT = 1  # version of the released folder's format
MANIFEST, COMMITMENT, CROISSANT = "release.json", "commitment.json", "croissant.json"
CARD, DICTIONARY, CITATION = "README.md", "DICTIONARY.md", "CITATION.cff"
LICENCE, PROMPTS_LICENCE = "LICENSE-DATA", "LICENSE-PROMPTS"
RECORDED_LICENCE = (
    "Clips and words of each pair: as its importer states in the columns source, licence of metadata.jsonl."
)
# The hub's loader finds clips only below their table's folder: pairs name them from the top, items from clips/.
PLACES: Mapping[str, str] = {table.name: f"{table.name}.jsonl" for table in OPEN} | {
    PAIRS.name: "metadata.jsonl",
    RELEASED_ITEMS.name: f"{CLIPS}/metadata.jsonl",
}


@dataclass(frozen=True)
class Options:
    """Options of `traps publish release`: what a release holds.

    arms: published beside the pairs. held_out: the file of the key that gives items opaque names, beside which their
    answers are written; None to publish the answers. date: date of publication, YYYY-MM-DD. commitment: a file of
    `traps benchmark commit`.
    """

    arms: Sequence[str] = ()
    anonymous: bool = False
    held_out: Path | None = None
    date: str | None = None
    commitment: Path | None = None


@dataclass(frozen=True)
class ReleaseSummary:
    """A written folder's counts of files, clips and rows, and the held-out answers."""

    files: int
    clips: int
    rows: Mapping[str, int]
    answers: Path | None = None


@dataclass
class _Folder:
    """The folder in progress, and the texts that must not appear in it."""

    root: Path
    hide: Callable[[str], str]
    rows: dict[str, int] = field(default_factory=dict)

    def text(self, name: str, text: str) -> None:
        write_text(self.root / name, self.hide(text))

    def write_table(self, table: Table[Any], rows: Sequence[Any]) -> None:
        lines = [json.dumps({n: getattr(row, n) for n in table.names}, ensure_ascii=False) + "\n" for row in rows]
        self.text(PLACES[table.name], "".join(lines))
        self.rows[table.name] = len(rows)


def write_release(content: Content, target: Path, options: Options) -> ReleaseSummary:
    """Write the folder; it may replace only a former release. Raises TrapsError."""
    # Before a former release is removed.
    if options.held_out is not None and options.held_out.resolve().is_relative_to(target.resolve()):
        raise TrapsError(f"{options.held_out}: lies in the folder that is published; keep the key elsewhere")
    _require_own(target)
    if options.held_out is None:
        begin_publication(content.study, "an open release")
    with replace_folder(target) as part:
        folder = _Folder(part, anonymize if options.anonymous else str)
        answers = _open_release(folder, content) if options.held_out is None else None
        if options.held_out is not None:
            answers = _held_out_release(folder, content, options.held_out)
        folder.write_table(PROMPTS, rows_of.prompt_rows(content.release.canary))
        _pages(folder, content, options)
        files = write_checksums(part, content.release.canary) + 1
        if options.held_out is not None:
            date_equally(part)
    return ReleaseSummary(files, len([*target.glob(f"{CLIPS}/*/*.mp4")]), folder.rows, answers)


def _require_own(target: Path) -> None:
    """Raise TrapsError unless a folder is missing, empty, or a former release that may be replaced."""
    if not (target / CHECKSUMS).is_file():
        if target.exists() and any(target.iterdir()):
            raise TrapsError(f"{target}: holds other files than a release; give an empty or a new folder")
        return
    foreign_files = sorted({*released_files(target)} - {*read_checksums(target)})
    if foreign_files:
        raise TrapsError(f"{target / foreign_files[0]}: is no file of the release there; move it away")


def _open_release(folder: _Folder, content: Content) -> None:
    folder.write_table(PAIRS, rows_of.pair_rows(content))
    folder.write_table(RELEASED_ITEMS, rows_of.item_rows(content))
    folder.write_table(SCENARIOS, rows_of.scenario_rows(content))
    if content.two_events:
        folder.write_table(TWO_EVENTS_SCENARIOS, rows_of.two_events_rows(content))
    folder.write_table(CERTIFICATES, rows_of.certificate_rows(content))
    folder.write_table(SPLITS, rows_of.split_rows(content))
    for name, source in sorted(content.clips.items()):
        write_bytes(folder.root / name, source.read_bytes())


def _held_out_release(folder: _Folder, content: Content, key_file: Path) -> Path:
    """Write one item of each scenario with a clip of its own, and the answers beside the key."""
    if SCENE_SPECS != OWN_SPECS:
        require_secret_seed(SCENE_SPECS)
    key = held_out_key(key_file, make=True)
    items = drawn_items(content.items, key)
    mark_held_out(content.study, items)
    digests = write_held_out_clips(items, content.clips, key, folder.root / CLIPS / "items")
    folder.write_table(HELD_OUT_ITEMS, rows_of.held_out_rows(items, digests, key, content.release.canary))
    names = sorted((opaque_name(key, row["item_id"]), row["item_id"]) for row in items)
    answers = key_file.with_name(f"{key_file.name}.items.jsonl")
    lines = "".join(json.dumps({"item": n, "item_id": id_}) + "\n" for n, id_ in names)
    if answers.exists() and answers.read_text(encoding="utf-8") != lines:
        raise TrapsError(f"{answers}: maps the items of another release; give each release a key of its own")
    write_text(answers, lines, private=True)
    return answers


def _pages(folder: _Folder, content: Content, options: Options) -> None:
    """Write everything but tables and clips."""
    canary = content.release.canary
    tables = [table for table in (OPEN if options.held_out is None else HELD_OUT) if table.name in folder.rows]
    licence = (ROOT / LICENCE).read_text(encoding="utf-8")
    prompts = (ASSETS / "prompts" / "README.md").read_text(encoding="utf-8")
    licence = RECORDED_LICENCE if content.people else licence.rstrip()
    folder.text(LICENCE, f"{licence}\n\n{canary}\n")
    folder.text(PROMPTS_LICENCE, f"{prompts.rstrip()}\n\n{canary}\n")
    citation = yaml.safe_dump(ANONYMOUS_CITATION) if options.anonymous else (ROOT / CITATION).read_text("utf-8")
    folder.text(CITATION, f"# {canary}\n{citation}")
    if options.commitment is not None:
        folder.text(COMMITMENT, options.commitment.read_text(encoding="utf-8"))
    manifest = {
        "format": FORMAT,
        **content.release.model_dump(),
        "versions": content.versions,
        **({"recorded": True} if content.people else {}),
        "held_out": options.held_out is not None,
        "anonymous": options.anonymous,
        "date": options.date,
        "arms": sorted(options.arms),
        "rows": dict(folder.rows),
        "prompts": {row.name: row.version for row in rows_of.prompt_rows(canary) if row.role == rows_of.SYSTEM},
    }
    folder.text(MANIFEST, json.dumps(manifest, indent=1, ensure_ascii=False) + "\n")
    folder.text(DICTIONARY, dictionary(tables, PLACES, canary))
    folder.text(CARD, card(manifest, tables, PLACES))
    folder.text(CROISSANT, croissant(folder.root, manifest, tables, PLACES))


# --- double-blind review ----------------------------------------------------------------------------------------------

ANONYMOUS_CITATION = {
    "cff-version": "1.2.0",
    "message": "Authors are withheld for double-blind review.",
    "title": "A dataset under double-blind review",
    "type": "dataset",
    "authors": [{"name": "Anonymous authors"}],
}


def identity_texts() -> dict[str, str]:
    """Return texts that identify the authors, with replacements for blind review."""
    data = yaml.safe_load((ROOT / CITATION).read_text(encoding="utf-8"))
    paper = data["preferred-citation"]
    names = [f"{author['given-names']} {author['family-names']}" for author in paper["authors"]]
    words = {paper["url"]: "(address withheld)", paper["title"]: "(title withheld)", data["title"]: "(title withheld)"}
    words |= {paper["collection-title"]: "(venue withheld)", paper["conference"]["name"]: "(venue withheld)"}
    return words | {", ".join(names): "Anonymous authors"} | dict.fromkeys(names, "Anonymous authors")


def anonymize(text: str) -> str:
    """Return a text without the authors' identity, even across line breaks."""
    for words, replacement in identity_texts().items():
        text = re.sub(r"\s+".join(map(re.escape, words.split())), replacement, text)
    return text
