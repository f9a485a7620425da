"""Declare the report group: report page and explorer in the folder `reports`."""

from functools import partial

from traps_pipeline.pipeline.graph import Parent
from traps_pipeline.pipeline.pieces import Piece, make_pieces
from traps_pipeline.pipeline.previews import Markdown
from traps_pipeline.pipeline.stage import code_of, dep, is_declared, source, stage
from traps_pipeline.pipeline.stages import judging_stages, people_stages, scoring_stages
from traps_pipeline.report.catalogue import FIGURE_REPORTS, TABLE_REPORTS
from traps_pipeline.scoring.published import published_digest
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.workspace import Workspace

GROUP = "report"
# Declared before this group, which reads their tables, as the package's file does for the mechanism's.
GROUPS_READ = (judging_stages, people_stages, scoring_stages)
NAMES = 12  # names of pieces listed in an event
SCORES = ("leaderboard", "two_way", "human_row", "panel_errors")  # on the page and in the explorer
ANSWERS = ("items", "videos", "responses", "votes", "verdicts")
_REPORTED = [name for report in (*TABLE_REPORTS, *FIGURE_REPORTS) for name in report.reads]
_stage = partial(stage, group=GROUP, kinds=["html"])


@source(group=GROUP, kinds=["csv"])
def published(workspace: Workspace, _: None) -> str:
    """Return the version of the paper's tables as printed (assets/published)."""
    return published_digest()


def _parents(*names: str) -> list[Parent]:
    return [dep(name, need="none") for name in dict.fromkeys(names) if is_declared(name)]


@_stage("report_page", parents=_parents(*ANSWERS, *SCORES, *_REPORTED, "published"))
def report_page(workspace: Workspace, _: None) -> StageOutput:
    """Return findings, leaderboard, figures and tables beside the paper's on one page.

    It opens from disk, and every number links into the explorer. A table or figure is rebuilt only when a table that it
    reads changes.
    """
    from traps_pipeline.report.cards import Card, Sources
    from traps_pipeline.report.printed_board import BOARD_FILE, board_bytes, board_tables
    from traps_pipeline.report.publish import MARKDOWN, report_files, report_parts

    sources = Sources(workspace)
    parts = report_parts(sources)
    pieces = [
        Piece(
            f"{p.chapter}/{p.name}",
            lambda p=p: p.make().data,
            (*p.reads, "published", *(("human_row",) if sources.study.certified else ())),
            p.inputs,
        )
        for p in parts
    ]
    contents, rebuilt_names = make_pieces(workspace, "report_page", code_of(GROUP), pieces)
    files = report_files(sources.study, [(name.partition("/")[0], Card.read(data)) for name, data in contents.items()])
    shown = {
        "made again": f"{len(rebuilt_names)} of {len(pieces)}: {', '.join(rebuilt_names[:NAMES]) or 'none'}",
        "leaderboard": Markdown(files[MARKDOWN].decode()),
    }
    return StageOutput(files | {BOARD_FILE: board_bytes(board_tables(workspace))}, shown=shown)


@_stage("site", parents=_parents(*ANSWERS, "scene_specs", *SCORES, "contrasts", "regime_tests"))
def site(workspace: Workspace, _: None) -> StageOutput:
    """Return the explorer: all answers with votes and clips, opened from disk."""
    from traps_pipeline.report.explorer.site import site_files

    files = site_files(workspace)
    data = workspace.store.below(workspace.reports / "data", "*.js")
    workspace.store.remove({*data} - {workspace.reports / name for name in files})
    return StageOutput(files)
