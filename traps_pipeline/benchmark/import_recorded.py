"""Make a benchmark of recorded pairs: a folder of videos in, records and clips out (docs/recorded.md).

Each pair is made once: its record and its clips stay in the benchmark's folder under a digest of the line, the videos
and the code, so that a killed import goes on, and a second one makes what changed.
"""

import json
import shutil
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark import footage, recorded_clips
from traps_pipeline.benchmark.composition import name_benchmark
from traps_pipeline.benchmark.footage import FPS, UnusableFootage
from traps_pipeline.benchmark.recorded_clips import RecordedClips, clip_path, is_whole, make_clips, video_path
from traps_pipeline.benchmark.recorded_pairs import RecordedPair, read_pairs
from traps_pipeline.benchmark.records import NOT_MIXED
from traps_pipeline.protocol.datasets import RECORDED, RECORDED_CATEGORIES
from traps_pipeline.scenes.worlds.clip_notes import save_clip
from traps_pipeline.scenes.worlds.lane_records import RecordedEvents
from traps_pipeline.scenes.worlds.spec import SceneSpec, Twin

RecordedSpec = SceneSpec | RecordedEvents
FOLDERS: Mapping[type[RecordedSpec], str] = {SceneSpec: "released", RecordedEvents: "two_events/released"}
RECORDS = f"{RECORDED}.jsonl"
STATE = ".import"


def import_recorded(
    source: Path, out: Path, name: str, *, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> tuple[list[RecordedSpec], list[str]]:
    """Write the benchmark of a folder's pairs; return its records, and problems in words. Raises TrapsError."""
    if any(path.name != RECORDS for path in (out / "released").glob("*.jsonl")):
        raise TrapsError(f"{out / 'released'}: {NOT_MIXED}")
    pairs, problems = read_pairs(source)
    records, make = dict[str, RecordedSpec](), partial(_import_pair, source, out)
    for number, (pair, (record, notes)) in enumerate(run_in_order(make, pairs, workers, at_once=True), start=1):
        if record is None:
            problems += [f"{pair.id}: {note}" for note in notes]
        else:
            records[pair.id] = record
        report(f"{number} of {len(pairs)}: {': '.join((pair.id, *notes))}")
    if not any(isinstance(record, SceneSpec) for record in records.values()):
        raise TrapsError(
            f"{source}: no pair could be imported ({'; '.join(problems[:3])}); correct it and import again"
        )
    for kind, folder in FOLDERS.items():
        members = {id_: record for id_, record in records.items() if isinstance(record, kind)}
        lines = (json.dumps(record.model_dump(mode="json"), ensure_ascii=False) + "\n" for record in members.values())
        write_text(out / folder / RECORDS, "".join(lines))
        for clips in (out / folder / "clips").glob("*"):
            if clips.name not in members:
                shutil.rmtree(clips)
    name_benchmark(out, name)
    return [*records.values()], problems


@cache
def _code() -> str:
    """Return a digest of the code that makes clips."""
    return digest([*map(file_digest, map(Path, (__file__, str(footage.__file__), str(recorded_clips.__file__))))])


def _import_pair(source: Path, out: Path, pair: RecordedPair) -> tuple[RecordedSpec | None, list[str]]:
    """Make a pair's clips and record, unless they are made; return the record or None, and remarks in words."""
    state, kind = out / STATE / f"{pair.id}.json", RecordedEvents if pair.two_events else SceneSpec
    released = out / FOLDERS[kind]
    try:
        videos = [video_path(source, name) for name in (pair.control, pair.void, pair.twin) if name is not None]
        key = digest([pair.model_dump(mode="json"), [*map(file_digest, videos)], _code()])
        with suppress(OSError, ValueError, KeyError, TypeError):  # not made yet, or a damaged file
            made = json.loads(state.read_text(encoding="utf-8"))
            clips = {clip_path(released, pair.id, side): sha256 for side, sha256 in made["clips"].items()}
            if made["key"] == key and all(is_whole(clip, sha256) for clip, sha256 in clips.items()):
                return kind.model_validate(made["record"]), [*map(str, made["notes"])]
        clips = make_clips(pair, source)
    except UnusableFootage as error:
        return None, [str(error)]
    except OSError as error:
        return None, [f"{error.filename}: cannot be read ({error.strerror}); correct its rights"]
    digests = dict[str, str]()
    for side, frames in clips.clips.items():
        path = clip_path(released, pair.id, side)
        save_clip(path, frames, FPS)
        digests[side] = file_digest(path)
    record = (_events if pair.two_events else _pair)(pair, clips, digests)
    fields = {"record": record.model_dump(mode="json"), "clips": digests, "notes": clips.notes}
    write_text(state, json.dumps({"key": key, **fields}))
    return record, clips.notes


def _words(pair: RecordedPair, clips: RecordedClips) -> dict[str, Any]:
    """Return the fields that records of pairs and of two events share."""
    kinds: dict[tuple[str, ...], str] = {("left", "right"): "direction", ("no", "yes"): "binary"}
    is_number = all(map(str.isdigit, pair.choices))
    return {
        "scenario_id": pair.id,
        "category": RECORDED_CATEGORIES[pair.cut_s is not None],
        "family": RECORDED,
        "seed": 0,
        "physics": {"duration_s": len(next(iter(clips.clips.values()))) / FPS, "fps": FPS},
        "camera": {},
        "question": pair.question,
        "labels": pair.choices,
        "aliases": pair.aliases,
        "answer_type": "numeric" if is_number else kinds.get((*sorted(pair.choices),), "colour"),
        "evidence": clips.evidence,
    }


def _pair(pair: RecordedPair, clips: RecordedClips, digests: dict[str, str]) -> SceneSpec:
    is_cut = pair.cut_s is not None
    height, width, _ = clips.clips["control"][0].shape
    return SceneSpec(
        **_words(pair, clips),
        taxonomy="chaotic" if is_cut else "occlusion",
        sub_scenario=f"{pair.category}, cut" if is_cut else pair.category,  # each has one way of voids
        params={"size": [width, height], "clips": digests},
        void_kind="truncation" if is_cut else "occluder",
        void=clips.void,
        ground_truth=pair.answer[0],
        ill_posed_question=pair.ill_posed_question or "",
        answerable_question=None,
        trajectory_sha256=digests["control"],
        twin=Twin(params=None, ground_truth=pair.twin_answer or "", trajectory_sha256=digests.get("twin", "")),
    )


def _events(pair: RecordedPair, clips: RecordedClips, digests: dict[str, str]) -> RecordedEvents:
    lanes = [
        {"name": name, "ground_truth": answer, **{field: values[k] for field, values in clips.void.items()}}
        for k, (name, answer) in enumerate(zip(pair.two_events, pair.answer, strict=True))
    ]
    sha256 = digest([*digests.values()])
    return RecordedEvents.model_validate(
        {**_words(pair, clips), "kind": pair.category, "clips": digests, "lanes": lanes, "trajectory_sha256": sha256}
    )
