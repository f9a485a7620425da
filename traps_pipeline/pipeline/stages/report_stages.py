"""The report group: contact sheet, gallery, the catalogue's tables and figures, the report page."""

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.sheets import csv_bytes
from traps_pipeline.pipeline.graph import Stage
from traps_pipeline.pipeline.pieces import Files, Piece, make_pieces
from traps_pipeline.pipeline.previews import Markdown
from traps_pipeline.pipeline.stage import code_of, is_declared, of, source, stage
from traps_pipeline.pipeline.stages import (
    inside_stages,
    judging_stages,
    mechanism_stages,
    people_stages,
    scoring_stages,
)
from traps_pipeline.pipeline.stages.pictures_shown import thumbnail
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.report.catalogue import FIGURES, TABLES, Report, workspace_files
from traps_pipeline.report.result_frames import Results
from traps_pipeline.scoring.published import published_digest
from traps_pipeline.storage.benchmark_tables import ARMS, ITEMS, SCENE_SPECS, VIDEOS
from traps_pipeline.storage.parquet import Made
from traps_pipeline.storage.workspace import Workspace

if TYPE_CHECKING:
    import pandas as pd

GROUP = "report"
SHOWN = 12  # names of pieces in an event
# Declared before this group, which reads their tables.
READ = (judging_stages, people_stages, mechanism_stages, inside_stages, scoring_stages)
published = source(
    "published",
    lambda workspace, key: published_digest(),
    group=GROUP,
    doc="assets/published: the paper's tables as printed.",
    kinds=["csv"],
)


def _report(
    name: str,
    make: Callable[[Workspace], Files],
    doc: str,
    *,
    deps: Sequence[str],
    kinds: Sequence[str] = ("png",),
) -> Stage:
    """An asset that writes files for people into the workspace's `reports` folder, from those tables that exist."""

    def made(workspace: Workspace, _: None) -> Made:
        files = make(workspace)
        return Made(files, shown=_previews(files, [*files]))

    return _stage(name, made, doc, deps, kinds)


def _in_pieces(
    name: str,
    pieces: Callable[[Workspace], Sequence[Piece]],
    doc: str,
    *,
    deps: Sequence[str],
    kinds: Sequence[str] = ("png",),
    previewed: Sequence[str] = (),
) -> Stage:
    """An asset of many files, each made again only when what it is made from changed."""

    def made(workspace: Workspace, _: None) -> Made:
        files, remade = make_pieces(workspace, name, code_of(GROUP), pieces(workspace))
        shown = {"made again": f"{len(remade)} of {len(files)}: {', '.join(remade[:SHOWN]) or 'none'}"}
        return Made(files, shown=shown | _previews(files, [file for file in previewed if file in files]))

    return _stage(name, made, doc, deps, kinds)


def _stage(
    name: str, made: Callable[[Workspace, Any], Made], doc: str, deps: Sequence[str], kinds: Sequence[str]
) -> Stage:
    parents = [of(dep, need="none") for dep in deps if is_declared(dep)]
    made.__doc__ = doc
    return stage(name, made, group=GROUP, parents=parents, kinds=kinds)


def _previews(files: Mapping[str, bytes], names: Sequence[str]) -> dict[str, Any]:
    """Previews for Dagster of some files: small pictures, and tables as Markdown."""
    pictures = {f"preview of {f}": thumbnail(files[f]) for f in names if f.endswith(".png")}
    texts = {f"preview of {f}": Markdown(files[f].decode()) for f in names if f.endswith(".md")}
    return pictures | texts


def _looked_at(rows: "pd.DataFrame") -> str:
    """Rows as JSON, without the benchmark's version, which a correction changes in rows that it does not touch."""
    return str(rows.drop(columns=["benchmark_version"]).to_json(orient="records"))


def _sheets(workspace: Workspace) -> list[Piece]:
    import pandas as pd

    from traps_pipeline.report.arms_sheet import arms_sheets
    from traps_pipeline.report.contact_sheet import PAGE, chosen_pairs, contact_sheet, pairs_figure, six_pairs
    from traps_pipeline.report.writing import figure_bytes

    rows = workspace.tables.read_all(ITEMS, dataset=DATASETS)
    if rows.empty:
        raise TrapsError("contact_sheet: no items yet; materialize items first")
    arms = workspace.tables.read_all(ARMS)
    root = workspace.bring([*rows["clip"], *arms["clip"].dropna()])
    first, six = pd.concat(chosen_pairs(rows, 1)).reset_index(), six_pairs(rows)
    visual = _looked_at(rows.loc[rows["dataset"].isin(["occlusion", "chaotic"])]) if len(arms) else ""
    return [
        Piece("first pairs", lambda: {"contact_sheet.png": contact_sheet(rows, root)}, inputs=_looked_at(first)),
        Piece(
            "six pairs",
            lambda: {"six_pairs.png": figure_bytes(pairs_figure(six, root, None, 3, PAGE))},
            inputs=_looked_at(six),
        ),
        Piece("arms", lambda: arms_sheets(rows, arms, root), inputs=[visual, _looked_at(arms)]),
    ]


def _gallery(workspace: Workspace) -> list[Piece]:
    from traps_pipeline.benchmark.records import load_release
    from traps_pipeline.report.gallery import Poster, gallery

    specs, clips = workspace.tables.read_all(SCENE_SPECS), workspace.tables.read_all(VIDEOS)
    if clips.empty:
        raise TrapsError("gallery: no clips yet; materialize videos first")
    release, root = load_release(), workspace.bring(clips["path"])
    page, posters = gallery(specs, clips, f"{release.name} {release.version}: all pairs")

    def picture(poster: Poster) -> Piece:
        return Piece(poster.name, lambda: {poster.name: poster.jpeg(root)}, inputs=[poster.clip, poster.before])

    return [Piece("page", lambda: {"gallery.html": page}, inputs=page.decode()), *map(picture, posters)]


def _shortcuts(workspace: Workspace) -> Files:
    from traps_pipeline.benchmark.shortcuts import shortcuts
    from traps_pipeline.report.figures.shortcut_figure import shortcut_figure
    from traps_pipeline.report.writing import figure_bytes
    from traps_pipeline.video.encode import DamagedClip

    rows = workspace.tables.read_all(ITEMS, dataset=DATASETS)
    if rows.empty:
        raise TrapsError("shortcuts: no items yet; materialize items first")
    try:
        table = shortcuts(rows, workspace.tables.read_all(VIDEOS), workspace.bring(rows["clip"]))
    except DamagedClip as error:
        raise TrapsError(str(error)) from error
    figure = shortcut_figure(table)
    pictures = {f"shortcuts.{kind}": figure_bytes(figure, kind) for kind in ("png", "svg")}
    return pictures | {"shortcuts.csv": csv_bytes(table, "%.4f")}


def _page(workspace: Workspace) -> Files:
    from traps_pipeline.report.cell_pages import FOLDER, write_item_pages
    from traps_pipeline.report.publish import report_files, study_pictures

    folder = workspace.reports / FOLDER
    held = workspace.store.below(folder)
    workspace.bring_folder(folder)
    cells = write_item_pages(workspace, folder, clips="../..")
    made = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    workspace.store.keep(made)
    workspace.store.remove({*held} - {*made})
    study, paper = (_results(workspace, of_paper=of_paper) for of_paper in (False, True))
    return report_files(study, paper, cells, study_pictures(workspace))


contact_sheet = _in_pieces(
    "contact_sheet",
    _sheets,
    "Control and void frames of one pair of each sub-scenario, with question and ground truth; where arms were filmed, "
    "one scenario of each taxonomy with all its arms.",
    deps=["items", "arms"],
    previewed=["contact_sheet.png", "six_pairs.png"],
)
gallery = _in_pieces(
    "gallery",
    _gallery,
    "Control, void and twin of every scenario on a page that opens from disk, with words and certificates.",
    deps=["scene_specs", "videos"],
    kinds=["html"],
)
shortcuts = _report(
    "shortcuts",
    _shortcuts,
    "How well one cue alone (the question's words, the clip's length, its first frame or its file size) separates "
    "control from void: a figure and a table.",
    deps=["items", "videos"],
)


def _cases(workspace: Workspace) -> Files:
    from traps_pipeline.report.cases import cases_files

    return cases_files(workspace, clips="..")


def _worked_example(workspace: Workspace) -> Files:
    from traps_pipeline.report.worked_example import worked_example
    from traps_pipeline.report.writing import figure_bytes

    return {"worked_example.png": figure_bytes(worked_example(workspace))}


worked_example = _report(
    "worked_example",
    _worked_example,
    "One pair with a model's answer to each side, how the panel read it, and the verdict.",
    deps=["items", "responses", "votes", "verdicts"],
)
cases = _report(
    "cases",
    _cases,
    "What the paper describes in words, in this study's own answers side by side: inverted calibration, voids that "
    "guided prompting flips, visual against textual voids, thinking against not thinking.",
    deps=["items", "responses", "verdicts"],
    kinds=["html", "csv"],
)


# --- tables and figures of the catalogue ------------------------------------------------------------------------------


def _results(workspace: Workspace, *, of_paper: bool) -> Results:
    """The results of the study or of the paper, kept in memory while their tables are unchanged, since a run makes
    dozens of tables and figures from them."""
    from traps_pipeline.report.published_results import PublishedResults
    from traps_pipeline.report.study_results import StudyResults

    if of_paper:
        return _kept(("paper", published_digest()), PublishedResults)
    reads = {"items", *(name for report in (*TABLES, *FIGURES) for name in report.reads)}
    files = [f for name in sorted(reads) for f in workspace.store.below(workspace.tables.root / name)]
    slot = (workspace.root, *((file, workspace.store.changed_ns(file)) for file in files))
    return _kept(("study", slot), lambda: StudyResults(workspace))


def _kept(slot: tuple[str, Any], make: Callable[[], Results]) -> Results:
    if _KEPT.get(slot[0], (None,))[0] != slot[1]:
        _KEPT[slot[0]] = slot[1], make()
    return _KEPT[slot[0]][1]


_KEPT: dict[str, tuple[Any, Results]] = {}


def _printed(name: str, reports: Sequence[Report], doc: str, previewed: Sequence[str]) -> Stage:
    """An asset of many tables or figures of the study, each made again only when a table that it reads changed."""

    def pieces(workspace: Workspace) -> list[Piece]:
        def piece(report: Report) -> Piece:
            make = lambda: workspace_files(report, _results(workspace, of_paper=False))  # noqa: E731 - of this report
            return Piece(report.name, make, report.reads)

        return [piece(report) for report in reports]

    reads = dict.fromkeys(dep for report in reports for dep in report.reads)
    kinds = ["csv" if name == "report_tables" else "png"]
    return _in_pieces(name, pieces, doc, deps=[*reads], kinds=kinds, previewed=previewed)


def _printed_of_paper(name: str, reports: Sequence[Report], doc: str) -> Stage:
    def files(workspace: Workspace) -> Files:
        results = _results(workspace, of_paper=True)
        return {path: data for report in reports for path, data in workspace_files(report, results).items()}

    return _report(name, files, doc, deps=["published"])


report_tables = _printed(
    "report_tables",
    TABLES,
    "Every table of the study, as CSV, LaTeX, Markdown and Parquet.",
    ["tables/overall.md"],
)
report_figures = _printed(
    "report_figures",
    FIGURES,
    "Every figure of the study.",
    ["figures/pecs_landscape.png", "figures/abs_rec.png"],
)
published_report = _printed_of_paper(
    "published_report",
    [report for report in (*TABLES, *FIGURES) if report.published],
    "Tables and figures of the paper's published numbers.",
)
report_page = _report(
    "report_page",
    _page,
    "The report: leaderboard, figures and tables beside the paper's, every number linked to its items (HTML that opens "
    "from disk); the leaderboard as Markdown.",
    deps=[
        "items",
        "responses",
        "votes",
        "verdicts",
        "leaderboard",
        "robust",
        "human_row",
        "panel_errors",
        "contact_sheet",
        "shortcuts",
        "worked_example",
        "cases",
        "report_tables",
        "report_figures",
        "published_report",
    ],
    kinds=["html"],
)
