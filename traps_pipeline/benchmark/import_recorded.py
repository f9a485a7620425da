"""Make a benchmark of recorded pairs: a folder of videos in, records and clips out (docs/recorded.md).

Each pair is made once: its record and its clips stay in the benchmark's folder under a digest of the line, the videos
and the code, so that a killed import goes on, and a second one makes what changed.
"""

import json
import shutil
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache, partial
from pathlib import Path

from traps_pipeline.base.digests import digest, file_digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_text
from traps_pipeline.base.workers import run_in_order
from traps_pipeline.benchmark import footage, recorded_clips
from traps_pipeline.benchmark.composition import name_benchmark
from traps_pipeline.benchmark.footage import FPS, UnusableFootage
from traps_pipeline.benchmark.recorded_clips import RecordedClips, clip_path, clip_problems, make_clips, video_path
from traps_pipeline.benchmark.recorded_pairs import RecordedPair, read_pairs
from traps_pipeline.benchmark.records import NOT_MIXED
from traps_pipeline.protocol.datasets import RECORDED, RECORDED_CATEGORIES
from traps_pipeline.scenes.worlds.clip_notes import save_clip
from traps_pipeline.scenes.worlds.spec import SceneSpec, Twin

NO_TWIN = Twin(params=None, ground_truth="", trajectory_sha256="")
RECORDS = f"{RECORDED}.jsonl"
STATE = ".import"


def import_recorded(
    source: Path, out: Path, name: str, *, workers: int | None = None, report: Callable[[str], None] = lambda _: None
) -> tuple[list[SceneSpec], list[str]]:
    """Write the benchmark of a folder's pairs; return its records, and problems in words. Raises TrapsError."""
    released = out / "released"
    if any(path.name != RECORDS for path in released.glob("*.jsonl")):
        raise TrapsError(f"{released}: {NOT_MIXED}")
    pairs, problems = read_pairs(source)
    records, make = dict[str, SceneSpec](), partial(_import_pair, source, out)
    for number, (pair, (record, notes)) in enumerate(run_in_order(make, pairs, workers, at_once=True), start=1):
        if record is None:
            problems += [f"{pair.id}: {note}" for note in notes]
        else:
            records[pair.id] = record
        report(f"{number} of {len(pairs)}: {': '.join((pair.id, *notes))}")
    if not records:
        raise TrapsError(
            f"{source}: no pair could be imported ({'; '.join(problems[:3])}); correct it and import again"
        )
    lines = (json.dumps(record.model_dump(mode="json"), ensure_ascii=False) + "\n" for record in records.values())
    write_text(released / RECORDS, "".join(lines))
    for folder in (released / "clips").iterdir():
        if folder.name not in records:
            shutil.rmtree(folder)
    name_benchmark(out, name)
    return [*records.values()], problems


@cache
def _code() -> str:
    """Return a digest of the code that makes clips."""
    return digest([*map(file_digest, map(Path, (__file__, str(footage.__file__), str(recorded_clips.__file__))))])


def _import_pair(source: Path, out: Path, pair: RecordedPair) -> tuple[SceneSpec | None, list[str]]:
    """Make a pair's clips and record, unless they are made; return the record or None, and remarks in words."""
    state = out / STATE / f"{pair.id}.json"
    try:
        videos = [video_path(source, name) for name in (pair.control, pair.void, pair.twin) if name is not None]
        key = digest([pair.model_dump(mode="json"), [*map(file_digest, videos)], _code()])
        with suppress(OSError, ValueError, KeyError, TypeError):  # not made yet, or a damaged file
            made = json.loads(state.read_text(encoding="utf-8"))
            record = SceneSpec.model_validate(made["record"])
            if made["key"] == key and not clip_problems(record, out / "released"):
                return record, [*map(str, made["notes"])]
        clips = make_clips(pair, source)
    except UnusableFootage as error:
        return None, [str(error)]
    except OSError as error:
        return None, [f"{error.filename}: cannot be read ({error.strerror}); correct its rights"]
    record = _record(pair, clips, out / "released")
    write_text(state, json.dumps({"key": key, "record": record.model_dump(mode="json"), "notes": clips.notes}))
    return record, clips.notes


def _answer_type(choices: Sequence[str]) -> str:
    """Return the answer type of a question by its choices."""
    kinds: dict[tuple[str, ...], str] = {("left", "right"): "direction", ("no", "yes"): "binary"}
    return "numeric" if all(map(str.isdigit, choices)) else kinds.get((*sorted(choices),), "colour")


def _record(pair: RecordedPair, clips: RecordedClips, released: Path) -> SceneSpec:
    digests = dict[str, str]()
    for side, frames in clips.clips.items():
        path = clip_path(released, pair.id, side)
        save_clip(path, frames, FPS)
        digests[side] = file_digest(path)
    is_cut, control = pair.cut_s is not None, clips.clips["control"]
    twin = NO_TWIN
    if pair.twin_answer is not None:
        twin = Twin(params=None, ground_truth=pair.twin_answer, trajectory_sha256=digests["twin"])
    height, width, _ = control[0].shape
    return SceneSpec(
        scenario_id=pair.id,
        taxonomy="chaotic" if is_cut else "occlusion",
        category=RECORDED_CATEGORIES[is_cut],
        sub_scenario=f"{pair.category}, cut" if is_cut else pair.category,  # each has one way of voids
        family=RECORDED,
        seed=0,
        params={"size": [width, height], "clips": digests},
        physics={"duration_s": len(control) / FPS, "fps": FPS},
        camera={},
        void_kind="truncation" if is_cut else "occluder",
        void=clips.void,
        question=pair.question,
        labels=pair.choices,
        aliases=pair.aliases,
        answer_type=_answer_type(pair.choices),
        ground_truth=pair.answer,
        ill_posed_question=pair.ill_posed_question,
        answerable_question=None,
        trajectory_sha256=digests["control"],
        twin=twin,
        evidence=clips.evidence,
    )
