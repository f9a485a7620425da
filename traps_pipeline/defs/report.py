"""The report group: a figure, a contact sheet of pairs, the leaderboard page; and whether they are current."""

import base64
import hashlib
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items, scene_specs, videos
from traps_pipeline.defs.common import OWNERS, Events
from traps_pipeline.defs.scoring import leaderboard
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import Lineage, write_report_state
from traps_pipeline.progress import Tally
from traps_pipeline.scenes.encode import DamagedClip
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, LEADERBOARD, SCENE_SPECS, VIDEOS

GROUP = "report"
Files = dict[str, bytes]


def _report(
    name: str, doc: str, deps: Sequence[dg.AssetsDefinition], make: Callable[[Workspace], Files]
) -> dg.AssetsDefinition:
    """An unpartitioned asset that writes files for people into the workspace's `reports` folder."""

    @dg.asset(
        name=name,
        description=doc,
        deps=deps,
        group_name=GROUP,
        kinds={"html" if name in ("gallery", "leaderboard_page") else "png"},
        owners=OWNERS,
        output_required=False,
    )
    def report(context: dg.AssetExecutionContext) -> Events:
        workspace = Workspace.open()
        provenance = common.provenance(context, workspace)
        inputs = Lineage(workspace).inputs(name, None)
        files = make(workspace)
        for file, content in files.items():
            _write(workspace.reports / file, content)
        version = hashlib.sha256(b"".join(files.values())).hexdigest()[:16]
        write_report_state(workspace, name, version, inputs)
        progress.current().partition(name, "", Tally())
        shown = [file for file in files if "/" not in file]  # posters are parts of a page
        metadata = {file: dg.MetadataValue.path(str(workspace.reports / file)) for file in shown}
        pictures = {f"preview of {f}": _preview(content) for f, content in files.items() if f.endswith(".png")}
        yield common.materialized(context, None, version, provenance, **metadata, **pictures)

    return report


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    part.write_bytes(content)
    part.replace(path)


def _preview(png: bytes) -> dg.MarkdownMetadataValue:
    return dg.MetadataValue.md(f"![preview](data:image/png;base64,{base64.b64encode(png).decode()})")


def _landscape(workspace: Workspace) -> Files:
    from traps_pipeline.report.figures import figure_bytes, landscape_figure

    figure = landscape_figure(workspace.tables.read(LEADERBOARD, {}))
    return {f"pecs_landscape.{kind}": figure_bytes(figure, kind) for kind in ("png", "svg")}


def _sheet(workspace: Workspace) -> Files:
    from traps_pipeline.report.contact_sheet import contact_sheet, six_pairs

    rows = workspace.tables.read_all(ITEMS)
    if rows.empty:
        raise TrapsError("contact_sheet: no items yet; materialize items first")
    return {
        "contact_sheet.png": contact_sheet(rows, workspace.root),
        "six_pairs.png": contact_sheet(six_pairs(rows), workspace.root),
    }


def _gallery(workspace: Workspace) -> Files:
    from traps_pipeline.benchmark.records import load_release
    from traps_pipeline.report.gallery import gallery_files

    specs, clips = workspace.tables.read_all(SCENE_SPECS), workspace.tables.read_all(VIDEOS)
    if clips.empty:
        raise TrapsError("gallery: no clips yet; materialize videos first")
    release = load_release()
    return gallery_files(specs, clips, workspace.root, f"{release.name} {release.version}: all pairs")


def _shortcuts(workspace: Workspace) -> Files:
    from traps_pipeline.benchmark.shortcuts import shortcuts
    from traps_pipeline.report.figures import figure_bytes, shortcut_figure

    rows = workspace.tables.read_all(ITEMS)
    if rows.empty:
        raise TrapsError("shortcuts: no items yet; materialize items first")
    try:
        table = shortcuts(rows, workspace.tables.read_all(VIDEOS), workspace.root)
    except DamagedClip as error:
        raise TrapsError(str(error)) from error
    figure = shortcut_figure(table)
    pictures = {f"shortcuts.{kind}": figure_bytes(figure, kind) for kind in ("png", "svg")}
    return pictures | {"shortcuts.csv": table.to_csv(index=False, float_format="%.4f").encode()}


def _page(workspace: Workspace) -> Files:
    from traps_pipeline.report.page import leaderboard_html, leaderboard_markdown

    board = workspace.tables.read(LEADERBOARD, {})
    pictures = {
        "Accuracy against discrimination": (workspace.reports / "pecs_landscape.png").read_bytes(),
        "Control told from void by one cue alone (0.5 is chance)": (workspace.reports / "shortcuts.png").read_bytes(),
        "Pairs: control above, void below": (workspace.reports / "contact_sheet.png").read_bytes(),
    }
    return {
        "leaderboard.html": leaderboard_html(board, pictures).encode(),
        "leaderboard.md": leaderboard_markdown(board).encode(),
    }


pecs_landscape = _report(
    "pecs_landscape", "Acc against J with iso-PECS contours, one marker a model and regime.", [leaderboard], _landscape
)
contact_sheet = _report(
    "contact_sheet",
    "Control and void frames of one pair of each sub-scenario, with question and ground truth.",
    [items],
    _sheet,
)
gallery = _report(
    "gallery",
    "Control, void and twin of every scenario on a page that opens from disk, with words and certificates.",
    [scene_specs, videos],
    _gallery,
)
shortcuts = _report(
    "shortcuts",
    "How well control and void can be told apart by the question's words, the clip's length, its first frame or its "
    "file size alone: a figure and a table.",
    [items, videos],
    _shortcuts,
)
leaderboard_page = _report(
    "leaderboard_page",
    "The leaderboard as a page that opens from disk (HTML) and as Markdown.",
    [leaderboard, pecs_landscape, contact_sheet, shortcuts],
    _page,
)


def _inputs_current(asset: dg.AssetsDefinition) -> dg.AssetChecksDefinition:
    name = asset.key.to_user_string()

    @dg.asset_check(
        asset=asset,
        name="inputs_current",
        description="Made from what is there now; Dagster itself never calls an unpartitioned asset stale.",
    )
    def current() -> dg.AssetCheckResult:
        status = Lineage(Workspace.open()).status(name, None)
        return dg.AssetCheckResult(
            passed=status.kind == "fresh", metadata={"status": status.kind, "changed": list(status.reasons)}
        )

    return current


inputs_current = [
    _inputs_current(asset)
    for asset in (leaderboard, pecs_landscape, contact_sheet, gallery, shortcuts, leaderboard_page)
]
