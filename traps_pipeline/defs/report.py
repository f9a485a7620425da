"""What people read: contact sheet, gallery, the catalogue's tables and figures, the report page; are they current."""

import base64
import hashlib
from collections.abc import Callable, Iterator, Sequence

import dagster as dg

from traps_pipeline import progress
from traps_pipeline.defs import common
from traps_pipeline.defs.benchmark import items, scene_specs, videos
from traps_pipeline.defs.common import OWNERS, Events
from traps_pipeline.defs.evaluation import responses, verdicts, votes
from traps_pipeline.defs.scoring import leaderboard
from traps_pipeline.errors import TrapsError
from traps_pipeline.lineage import JUDGED, REPORTS, Lineage, write_report_state
from traps_pipeline.progress import Tally
from traps_pipeline.report.catalogue import OF_PAPER, OF_STUDY, PRINTED, Report, TableReport, workspace_files
from traps_pipeline.report.writing import write_bytes
from traps_pipeline.scenes.encode import DamagedClip
from traps_pipeline.storage.workspace import Workspace
from traps_pipeline.tables import ITEMS, SCENE_SPECS, VIDEOS

GROUP = "report"
Files = dict[str, bytes]
published = common.source_asset(
    "published", "published", "assets/published: the paper's tables as it prints them.", ["csv"]
)


def _report(
    name: str, doc: str, deps: Sequence[dg.AssetsDefinition | dg.AssetKey], make: Callable[[Workspace], Files]
) -> dg.AssetsDefinition:
    """An unpartitioned asset that writes files for people into the workspace's `reports` folder."""

    @dg.asset(
        name=name,
        description=doc,
        deps=deps,
        group_name=GROUP,
        kinds={"html" if name in ("gallery", "report_page") else "png"},
        owners=OWNERS,
        output_required=False,
    )
    def report(context: dg.AssetExecutionContext) -> Events:
        workspace = Workspace.open()
        provenance = common.provenance(context, workspace)
        inputs = Lineage(workspace).inputs(name, None)
        files = make(workspace)
        for file, content in files.items():
            write_bytes(workspace.reports / file, content)
        version = hashlib.sha256(b"".join(files.values())).hexdigest()[:16]
        write_report_state(workspace, name, version, inputs)
        progress.current().partition(name, "", Tally())
        shown = [file for file in files if "/" not in file]  # posters are parts of a page
        metadata = {file: dg.MetadataValue.path(str(workspace.reports / file)) for file in shown}
        pictures = {f"preview of {f}": _preview(content) for f, content in files.items() if f.endswith(".png")}
        yield common.materialized(context, None, version, provenance, **metadata, **pictures)

    return report


def _preview(png: bytes) -> dg.MarkdownMetadataValue:
    return dg.MetadataValue.md(f"![preview](data:image/png;base64,{base64.b64encode(png).decode()})")


def _sheet(workspace: Workspace) -> Files:
    from traps_pipeline.report.contact_sheet import PAGE, contact_sheet, pairs_figure, six_pairs
    from traps_pipeline.report.writing import figure_bytes

    rows = workspace.tables.read_all(ITEMS)
    if rows.empty:
        raise TrapsError("contact_sheet: no items yet; materialize items first")
    six = pairs_figure(six_pairs(rows), workspace.root, None, layout=PAGE)
    return {"contact_sheet.png": contact_sheet(rows, workspace.root), "six_pairs.png": figure_bytes(six)}


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
    from traps_pipeline.report.figures.shortcuts import shortcut_figure
    from traps_pipeline.report.writing import figure_bytes

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
    from traps_pipeline.report.items import FOLDER, write_item_pages
    from traps_pipeline.report.publish import report_files, study_pictures
    from traps_pipeline.report.study_results import StudyResults

    cells = write_item_pages(workspace, workspace.reports / FOLDER, clips="../..")
    return report_files(StudyResults(workspace), cells, study_pictures(workspace))


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


# --- tables and figures of the catalogue ------------------------------------------------------------------------------


def _spec(name: str, report: Report) -> dg.AssetSpec:
    of_paper = name in OF_PAPER
    return dg.AssetSpec(
        name,
        description=f"{report.doc} From the paper's published numbers." if of_paper else report.doc,
        deps=[published] if of_paper else [dg.AssetKey(name) for name in report.reads],
        group_name="published" if of_paper else "tables" if isinstance(report, TableReport) else "figures",
        kinds={"csv" if isinstance(report, TableReport) else "png"},
        owners=OWNERS,
        skippable=True,
    )


@dg.multi_asset(
    specs=[_spec(name, report) for name, report in {**OF_STUDY, **OF_PAPER}.items()],
    can_subset=True,
    description="Tables and figures; any of them in one run, since each takes less than a run's overhead.",
)
def printed(context: dg.AssetExecutionContext) -> Events:
    """Every selected table and figure, from what is there; what was not run says so."""
    from traps_pipeline.report.published_results import PublishedResults
    from traps_pipeline.report.study_results import StudyResults

    workspace = Workspace.open()
    selected = [name for name in PRINTED if dg.AssetKey(name) in context.selected_asset_keys]
    provenance = common.provenance_of_each(context, workspace)
    lineage, study, paper = Lineage(workspace), StudyResults(workspace), PublishedResults()
    for name in selected:
        inputs = lineage.inputs(name, None)
        report = OF_STUDY[name] if name in OF_STUDY else OF_PAPER[name]
        files = workspace_files(report, study if name in OF_STUDY else paper)
        for file, content in files.items():
            write_bytes(workspace.reports / file, content)
        version = hashlib.sha256(b"".join(files.values())).hexdigest()[:16]
        write_report_state(workspace, name, version, inputs)
        progress.current().partition("printed", name, Tally())
        yield common.event_of(dg.AssetKey(name), None, version, provenance[name], _shown(workspace, files))


def _shown(workspace: Workspace, files: Files) -> dict[str, dg.MetadataValue]:
    """Paths, with the picture or the table itself."""
    shown: dict[str, dg.MetadataValue] = {}
    for file, content in files.items():
        shown[file] = dg.MetadataValue.path(str(workspace.reports / file))
        if file.endswith(".png"):
            shown[f"preview of {file}"] = _preview(content)
        elif file.endswith(".md"):
            shown[f"preview of {file}"] = dg.MetadataValue.md(content.decode())
    return shown


report_page = _report(
    "report_page",
    "The report: leaderboard, figures and tables beside the paper's, every number linked to its items (HTML that opens "
    "from disk); the leaderboard as Markdown.",
    [
        items,
        responses,
        votes,
        verdicts,
        leaderboard,
        contact_sheet,
        shortcuts,
        *(dg.AssetKey(name) for name in PRINTED),
    ],
    _page,
)
ASSETS = [contact_sheet, gallery, shortcuts, printed, report_page]

_CHECKED = ("leaderboard", *JUDGED, "cosines", "steering_effects", "steering_shares", *REPORTS)


@dg.multi_asset_check(
    name="inputs_current",
    specs=[
        dg.AssetCheckSpec(
            "inputs_current",
            asset=name,
            description="Made from what is there now; Dagster itself never calls an unpartitioned asset stale.",
        )
        for name in _CHECKED
    ],
    can_subset=True,
)
def inputs_current(context: dg.AssetCheckExecutionContext) -> Iterator[dg.AssetCheckResult]:
    """Whether reports are made from what is there now."""
    lineage = Lineage(Workspace.open())
    for key in sorted(context.selected_asset_check_keys, key=lambda key: key.asset_key):
        status = lineage.status(key.asset_key.to_user_string(), None)
        yield dg.AssetCheckResult(
            check_name=key.name,
            asset_key=key.asset_key,
            passed=status.kind == "fresh",
            metadata={"status": status.kind, "changed": list(status.reasons)},
        )
