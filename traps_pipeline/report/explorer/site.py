"""Write the explorer: a folder to browse answers, from disk or any web host.

`index.html` has one classic script; all data are script files, which a page opened from disk may load where it may not
fetch; clips have relative paths. The content policy forbids any request outside the folder. Numbers come from the
study's tables; the page counts decisions and computes no metric.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
from base64 import b64encode
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.files import write_bytes
from traps_pipeline.benchmark.held_out import begin_publication
from traps_pipeline.benchmark.records import load_release
from traps_pipeline.models.request import JUDGED_OUTCOMES
from traps_pipeline.people.human_score_rows import HUMAN_ROW, PANEL_ERRORS
from traps_pipeline.people.recorded_certificates import certification_note, recorded_verdicts
from traps_pipeline.protocol.datasets import DATASETS, TWO_EVENTS, UNPAIRED, sides_of
from traps_pipeline.protocol.metric_words import METRIC_WORDS
from traps_pipeline.protocol.regimes import REGIMES
from traps_pipeline.protocol.two_events import CLIPS as LANE_CLIPS
from traps_pipeline.protocol.two_events import LANES, lane_items
from traps_pipeline.report.explorer.answer_shards import StudyAnswers, study_answers
from traps_pipeline.report.explorer.scenario_words import certificate_phrases, closes_frame, intervention
from traps_pipeline.report.leaderboard_page import OPTIONAL, TWO_WAY_COLUMNS, legend, provenance, shortfall
from traps_pipeline.report.published_results import PublishedResults
from traps_pipeline.report.tables.human_tables import people_notes
from traps_pipeline.report.tables.table_columns import entries
from traps_pipeline.report.tables.two_way_table import two_way_table
from traps_pipeline.report.terms import ARM_TITLES, MARKS, TITLE_OF
from traps_pipeline.report.writing import environment
from traps_pipeline.scoring.analyses import REASONING_PAIRS, SHARES
from traps_pipeline.scoring.score_rows import CONTRASTS, LEADERBOARD, REGIME_TESTS, TWO_WAY
from traps_pipeline.storage.benchmark_tables import ARMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.tables import records
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

WEB = Path(__file__).parent / "web"
INDEX, REPORT, SCRIPT, MANIFEST = "index.html", "report.html", "explorer.js", "site.json"
DATA, CLIPS = "data", "clips"
LIBRARY = WEB / "vendor" / "parquet.js"
_SOURCES = (
    *("dom.js", "keys.js", "search.js", "download.js", "numbers.js", "store.js", "outcomes.js", "parts.js"),
    *(
        "leaderboard.js",
        "landscape.js",
        "model.js",
        "matrix.js",
        "answers.js",
        "player.js",
        "pair.js",
        "lanes.js",
        "compare.js",
    ),
    *("cases.js", "scenes.js", "main.js"),
)
_ITEM_COLUMNS = (
    *("dataset", "scenario_id", "pair_id", "side", "category", "family", "sub_scenario", "question", "ground_truth"),
    *("control_answer", "answer_type", "clip"),
)
_PAGE_BYTES = 1 << 24  # one page per column of a shard, so that repeated values are stored once


@dataclass
class SiteSummary:
    """A summary of a site: files and bytes by kind, and missing clips."""

    answers: int = 0
    votes: int = 0
    files: int = 0
    bytes: int = 0
    clips: int = 0
    clip_bytes: int = 0
    lacking: list[str] = field(default_factory=list)


def site_files(workspace: Workspace) -> dict[str, bytes]:
    """Return the explorer's files by path, for a folder beside the study's clips. Raises TrapsError without items."""
    answers, scenarios = study_answers(workspace), _scenarios(workspace)
    return _files(workspace, answers, scenarios, {*_clip_names(answers.items, scenarios)}, "../", report=True)


def write_site(workspace: Workspace, folder: Path, *, clips: bool = True) -> SiteSummary:
    """Write a study's explorer and report to a self-contained folder.

    Files of an earlier site in the folder are replaced, or removed if they are no longer needed; `index.html` is
    written last. clips: include clips, as hard links if the file system allows it, else as copies. Raises TrapsError if
    the folder holds something else, or the study has no items.
    """
    begin_publication(workspace.root, "the explorer")
    previous_files = _former_files(folder)
    answers, scenarios = study_answers(workspace), _scenarios(workspace)
    names = _clip_names(answers.items, scenarios) if clips else []
    existing = {name for name in names if workspace.resolve(name).is_file()}
    summary = SiteSummary(len(answers.decisions), len(answers.votes), lacking=sorted(set(names) - existing))
    page = workspace.reports / REPORT
    report = {REPORT: workspace.store.here(page).read_bytes()} if workspace.store.has(page) else {}
    files = report | _files(workspace, answers, scenarios, existing, "", report=bool(report))
    for name in sorted(existing):
        summary.clip_bytes += _put_clip(workspace.resolve(name), folder / name)
        summary.clips += 1
    manifest = json.dumps(sorted([*files, *existing]), indent=0).encode()
    write_bytes(folder / MANIFEST, json.dumps(sorted({*files, *existing, *previous_files}), indent=0).encode())
    for name, content in files.items():  # the index comes last
        write_bytes(folder / name, content)
        summary.files, summary.bytes = summary.files + 1, summary.bytes + len(content)
    for name in sorted(previous_files - {*files, *existing}):
        (folder / name).unlink(missing_ok=True)
    write_bytes(folder / MANIFEST, manifest)
    return summary


def _files(
    workspace: Workspace, answers: StudyAnswers, scenarios: list[dict[str, Any]], clips: set[str], clips_at: str, *,
    report: bool,
) -> dict[str, bytes]:  # fmt: skip
    """Return the files by path, the index last; clips are those below clips_at."""
    contents = _contents(workspace, answers, scenarios, clips)
    stamp = _digest(contents)
    files = {f"{DATA}/{name}.js": data_script(name, stamp, content) for name, content in contents.items()}
    return {**files, SCRIPT: script().encode(), INDEX: index_page(workspace, stamp, clips_at, report=report).encode()}


def _former_files(folder: Path) -> set[str]:
    """Return an earlier site's files. Raises TrapsError if the folder is no site."""
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return set()
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise TrapsError(
            f"{folder}: holds something that is no site; name a folder that is empty, or does not exist yet"
        ) from None
    return {name for name in manifest if isinstance(name, str) and _is_inside(name)}


def _is_inside(name: str) -> bool:
    """Return whether a relative path stays in its folder."""
    parts = Path(name).parts
    return bool(parts) and not Path(name).is_absolute() and ".." not in parts


def _put_clip(source: Path, target: Path) -> int:
    """Link or copy a clip unless it exists (names identify content); return its bytes."""
    size = source.stat().st_size
    if not (target.is_file() and target.stat().st_size == size):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        try:
            os.link(source, target)
        except OSError:  # another file system, or one without links
            shutil.copyfile(source, target)
    return size


# --- data -------------------------------------------------------------------------------------------------------------


def _contents(
    workspace: Workspace, answers: StudyAnswers, scenarios: list[dict[str, Any]], clips: set[str]
) -> dict[str, dict[str, Any]]:
    """Return every data file by name: JSON values, or Parquet by its table's name."""
    import pyarrow as pa

    contents: dict[str, dict[str, Any]] = {}
    shards = []
    for number, shard in enumerate(answers.shards()):
        name = f"answers-{number:04d}"
        contents[name] = {"texts": parquet_text(shard.texts), "votes": parquet_text(shard.votes)}
        shards.append([name, shard.first, len(shard.texts)])
    items = answers.items.loc[:, [*_ITEM_COLUMNS]].copy()
    items["clip"] = [clip if clip in clips else None for clip in items["clip"]]
    contents["items"] = {"items": parquet_text(pa.Table.from_pandas(items, preserve_index=False))}
    contents["decisions"] = {"decisions": parquet_text(answers.decisions)}
    rows = [{**row, "twin_clip": row["twin_clip"] if row["twin_clip"] in clips else None} for row in scenarios]
    contents["scenarios"] = {"scenarios": [*rows, *_lanes(workspace, clips)]}
    for table in (CONTRASTS, REGIME_TESTS):
        contents[table.name] = {table.name: parquet_text(workspace.tables.read_arrow(table))}
    return {"study": _study(workspace, answers, shards, bool(clips)), **contents}


def _study(workspace: Workspace, answers: StudyAnswers, shards: list[Any], has_clips: bool) -> dict[str, Any]:
    """Return the data that every page of the explorer needs, and the leaderboard."""
    from traps_pipeline.models.registry.entries import load_models

    board, two_way = workspace.tables.read_all(LEADERBOARD), workspace.tables.read_all(TWO_WAY)
    printed = two_way_table(two_way)
    human_row = workspace.tables.read_all(HUMAN_ROW)
    release, registry = load_release(), load_models()
    published = entries(PublishedResults())
    printed_by_paper = [name for name in METRIC_WORDS if name in SHARES]
    evaluations = [[e.model, e.regime, e.run] for e in answers.evaluations]
    models = sorted({*(e.model for e in answers.evaluations), *board["model"], *published["model"]})
    unknown = "not in the registry"
    datasets = [name for name in (*DATASETS, *UNPAIRED) if name in set(answers.items["dataset"])]
    return {
        "name": workspace.study.name,
        "benchmark": f"{release.name} {release.version}",
        "provenance": provenance(board) if len(board) else "",
        "has_clips": has_clips,
        "datasets": [{"id": d, "title": {**TITLE_OF, **ARM_TITLES}[d], "sides": [*sides_of(d)]} for d in datasets],
        "titles": TITLE_OF,
        "regimes": [name for name in REGIMES if name in {e.regime for e in answers.evaluations}],
        "models": [{"id": m, "group": registry[m].groups.group if m in registry else unknown} for m in models],
        "evaluations": evaluations,
        "outcomes": [*answers.outcomes],
        "judged": [*JUDGED_OUTCOMES],
        "epochs": [*answers.epochs],
        "shards": shards,
        "n_votes": len(answers.votes),
        "metrics": [
            {"field": m.name, "title": m.heading, "unit": m.unit, "in_paper": m.name in printed_by_paper}
            for m in METRIC_WORDS.values()
        ],
        "two_way_metrics": [{"field": c.field, "title": c.heading, "unit": c.unit} for c in TWO_WAY_COLUMNS],
        "counts": [
            {"field": column.field, "title": column.heading, "unit": column.unit}
            for column, field in OPTIONAL.items()
            if column.unit != "range" and any(value > 0 for value in board[field].astype(float))
        ],
        "shortfall": shortfall(board) if len(board) else "",
        "leaderboard": records(board),
        "two_way": records(printed.rows),
        "two_way_table": [{"field": c.field, "title": c.heading, "unit": c.unit} for c in printed.columns],
        "two_way_notes": [*printed.notes],
        "people": records(human_row),
        "said": people_notes(human_row, workspace.tables.read_all(PANEL_ERRORS), certification_note(workspace.tables)),
        "published": records(published.loc[:, ["model", "regime", "dataset", "epoch", *printed_by_paper]]),
        "legend": legend(board, two_way) if len(board) else {},
        "marks": MARKS,
        "reasoning_pairs": [*map(list, REASONING_PAIRS)],
    }


def _scenarios(workspace: Workspace) -> list[dict[str, Any]]:
    """Return the data about scenarios on the pages of pairs, by scenario."""
    specs, videos = workspace.tables.read_all(SCENE_SPECS), workspace.tables.read_all(VIDEOS)
    clips = {(row["scenario_id"], row["side"]): row for row in records(videos)}
    rows, people = [], recorded_verdicts(workspace.tables)
    for spec in sorted(specs.to_dict("records"), key=lambda row: row["scenario_id"]):
        twin, evidence = json.loads(spec["twin"]), json.loads(spec["evidence"])
        control_clip, twin_clip = (clips.get((spec["scenario_id"], side)) for side in ("control", "twin"))
        rows.append(
            {
                "scenario_id": spec["scenario_id"],
                "intervention": intervention(spec),
                "labels": [*spec["labels"]],
                "certificate": [words for _, words in certificate_phrases(evidence)]
                + ([people[spec["scenario_id"]] or "certified by people"] if spec["scenario_id"] in people else []),
                "by_people": spec["scenario_id"] in people,
                "twin_answer": None if evidence.get("twin_px") else twin["ground_truth"] or None,
                "twin_clip": twin_clip["path"] if twin_clip and not evidence.get("twin_px") else None,
                "fps": control_clip["fps"] if control_clip else None,
                "shown_at": _seconds(closes_frame(spec), control_clip),
            }
        )
    return rows


def _lanes(workspace: Workspace, clips: set[str]) -> list[dict[str, Any]]:
    """Return the data about scenarios of two events: clips, when boards stand, and items in the order of a page."""
    rows = {(row["scenario_id"], row["item"]): row for row in records(workspace.tables.read_all(ARMS))}
    scenarios, people = [], recorded_verdicts(workspace.tables)
    for scenario in sorted({id_ for (id_, _), row in rows.items() if row["arm"] == TWO_EVENTS}):
        row_of = {item: rows[scenario, item.name] for item in lane_items(scenario)}
        path_of = {item.clip: row["clip"] if row["clip"] in clips else None for item, row in row_of.items()}
        evidence = {item.lane: json.loads(row["evidence"]) for item, row in row_of.items()}
        n_frames, fps = int(next(iter(row_of.values()))["n_frames"]), evidence[LANES[0]]["fps"]
        standing = [sum(a <= k < b for lane in LANES for a, b in evidence[lane]["stands"]) for k in range(n_frames)]
        of_items = [{name: getattr(i, name) for name in ("pair_id", "side", "lane", "clip")} for i in row_of]
        scenarios.append(
            {
                **{"scenario_id": scenario, "family": scenario.rpartition("-")[0], "fps": fps, "n_frames": n_frames},
                "shown_at": max(k for k in range(n_frames) if standing[k] == min(standing)) / fps,
                "lanes": [
                    {"name": n, "stands": evidence[n]["stands"], "hides": evidence[n].get("hides")} for n in LANES
                ],
                "clips": [{"name": n, "hidden": [*hidden], "path": path_of[n]} for n, hidden in LANE_CLIPS.items()],
                "items": of_items,
                "certificate": people.get(scenario),
            }
        )
    return scenarios


BOARD_COMES_S = 0.6  # maximum time for which an occluder is visible on its way


def _seconds(closes: int | None, clip: Mapping[str, Any] | None) -> float | None:
    """Return the last moment (s) before a control's closing occluder, None without."""
    return None if closes is None or clip is None else (closes - 0.5) / clip["fps"] - BOARD_COMES_S


def _clip_names(items: pd.DataFrame, scenarios: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the clips that pages show, without names that lead out of the folder."""
    clip_names = {*items["clip"], *(row["twin_clip"] for row in scenarios)}
    return sorted(name for name in clip_names if name and Path(name).parts[0] == CLIPS and _is_inside(name))


def _digest(contents: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the version of a site: a digest of all its data and its script."""
    digest = hashlib.sha256(script().encode())
    for name, content in contents.items():
        for key, value in content.items():
            text = value if isinstance(value, str) else json.dumps(value, sort_keys=True)
            digest.update(f"\0{name}\0{key}\0{text}".encode())
    return digest.hexdigest()[:16]


# --- page -------------------------------------------------------------------------------------------------------------


@cache
def script() -> str:
    """Return the text of the explorer's script, libraries included. Raises TrapsError if a library was changed."""
    library = LIBRARY.read_bytes()
    expected_sha256 = LIBRARY.with_name("parquet.js.sha256").read_text(encoding="ascii").split()[0]
    if hashlib.sha256(library).hexdigest() != expected_sha256:
        raise TrapsError(f"{LIBRARY}: is not what was checked in; restore it from git, or run `make explorer-vendor`")
    sources = "\n".join((WEB / name).read_text(encoding="utf-8") for name in _SOURCES)
    return f'{library.decode("utf-8")}\n(() => {{\n"use strict";\n{sources}\n}})();\n'


def index_page(workspace: Workspace, stamp: str, clips_at: str = "", *, report: bool = False) -> str:
    """Return the explorer's HTML page, which may load only scripts and clips of its own folder."""
    style = (WEB / "style.css").read_text(encoding="utf-8")
    digest = b64encode(hashlib.sha256(style.encode()).digest()).decode("ascii")
    return environment(WEB).get_template("index.html.j2").render(
        title=f"{load_release().name}: {workspace.study.name}", version=stamp, style=style, style_digest=digest,
        script=SCRIPT, data=DATA, clips_at=clips_at, report=REPORT if report else "",
    )  # fmt: skip


def parquet_text(table: pa.Table) -> str:
    """Return a table as a Parquet file (zstd) in base64."""
    stream = io.BytesIO()
    pq.write_table(
        table.replace_schema_metadata(None), stream, compression="zstd", compression_level=9,
        data_page_size=_PAGE_BYTES, dictionary_pagesize_limit=_PAGE_BYTES, row_group_size=max(len(table), 1),
        write_statistics=False, store_schema=False,
    )  # fmt: skip
    return b64encode(stream.getvalue()).decode("ascii")


def data_script(name: str, version: str, content: Mapping[str, Any]) -> bytes:
    """Return a data file's JavaScript, which passes its content to the page's function `TRAPS_DATA`.

    version: version of the whole site, so that a page never mixes files of two. content: JSON values; Parquet is
    `parquet_text`.
    """
    # "<" cannot close a script element, should a host inline the file; JSON knows the escape.
    body = json.dumps(content, ensure_ascii=True, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    return f"TRAPS_DATA({json.dumps(name)},{json.dumps(version)},{body});\n".encode()
