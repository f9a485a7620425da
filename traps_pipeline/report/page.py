"""Render the report page (docs/report.md): findings, leaderboard, results, gaps."""

import hashlib
from base64 import b64encode
from collections.abc import Mapping, Sequence

import pandas as pd

from traps_pipeline.report.cards import Card, LinkOf, tables_html
from traps_pipeline.report.leaderboard_page import leaderboards, legend, provenance
from traps_pipeline.report.study_findings import StudyFinding
from traps_pipeline.report.writing import TEMPLATES, environment

FIRST_CARD = "figure-pecs_landscape"  # beside the leaderboard


def report_html(
    board: pd.DataFrame,
    figures: Sequence[Card] = (),
    pictures: Sequence[Card] = (),
    tables: Sequence[Card] = (),
    *,
    findings: Sequence[StudyFinding] = (),
    address: LinkOf | None = None,
    explorer: str = "",
    two_way: pd.DataFrame | None = None,
    notes: Sequence[str] = (),
    terms: Mapping[str, str] | None = None,
) -> str:
    """Render the report as one page that opens from disk and makes no network request.

    Cards with results are shown, tables in a collapsed appendix; for the others the reasons are listed. With `address`
    every number links to the items behind it. notes: those below the leaderboard; terms: words of the legend.
    """
    boards = leaderboards(board, two_way, notes)
    ranked_tables = [table for table in boards if table.title == boards[0].title]  # one per panel
    other_cards = [
        Card(table.name, f"Leaderboard, {table.title.lower()}", environment().get_template("tables.html.j2").render(
            own=tables_html([table], table.title, address), absent=[], published={}))
        for table in boards if table not in ranked_tables
    ]  # fmt: skip
    run = [[card for card in cards if card.html] for cards in (figures, pictures, [*other_cards, *tables])]
    names_by_reason: dict[str, list[str]] = {}
    for card in (card for card in (*figures, *pictures, *tables) if not card.html):
        names_by_reason.setdefault(card.why, []).append(card.title)
    script = (TEMPLATES / "report.js").read_text(encoding="utf-8")
    return (
        environment()
        .get_template("report.html.j2")
        .render(
            title="TRAPSBench report",
            provenance=provenance(board),
            explorer=explorer,
            findings=findings,
            boards=[
                {**table, "title": ranked_table.title}
                for ranked_table in ranked_tables
                for table in tables_html([ranked_table], "", address)
            ],
            first=[card for card in run[0] if card.name == FIRST_CARD],
            figures=[card for card in run[0] if card.name != FIRST_CARD],
            pictures=run[1],
            appendix=run[2],
            absent={reason: list(dict.fromkeys(titles)) for reason, titles in names_by_reason.items()},
            shown={"leaderboard", *(card.name for cards in run for card in cards)},
            legend={**legend(board, two_way), **(terms or {})},
            script=script,
            script_digest=b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii"),
        )
    )
