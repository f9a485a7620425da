"""Rows of a leaderboard, and how it is printed in each medium."""

from __future__ import annotations

import re
from html.parser import HTMLParser

import numpy as np
import pandas as pd

from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.metric_words import COUNT_WORDS, METRIC_WORDS
from traps_pipeline.report.leaderboard_page import leaderboard_markdown, leaderboard_text
from traps_pipeline.report.page import report_html
from traps_pipeline.report.terms import TITLE_OF
from traps_pipeline.scoring.score_rows import LEADERBOARD

NO_BREAK = "\u2011"  # a hyphen at which no line ends


def board_row(model, regime="standard", dataset="overall", shares=(0.5, 0.1, 0.6), **other):
    """One LEADERBOARD row with these Acc, FalseAbs and AbsRec."""
    acc, false_abs, abs_rec = map(np.array, shares)
    figures = {name: float(metric.formula(acc, false_abs, abs_rec)) for name, metric in METRIC_WORDS.items()}
    row = {
        **{"model": model, "regime": regime, "dataset": dataset, "n_runs": 3, "n_pairs": 1404, "n_missing": 0},
        **figures,
        "n_items": 2 * other.get("n_pairs", 1404),
        **{f"{name}_std": 0.01 for name in figures},
        # Counts of decisions are null, as of every panel that is not asked.
        **{name: None if count.is_of_decisions else 0 for name, count in COUNT_WORDS.items()},
        **{"answered": 1.0, "incomplete": False, "broken": 0.0, "is_broken": False, "panel": "three@1"},
        **{f"{name}_ci_{end}": value for name, value in figures.items() for end in ("low", "high")},
        **{"rank": 1, "rank_low": 1, "rank_high": 2, "naive": float(acc * abs_rec)},
        **dict.fromkeys(("pecs_low", "pecs_high", "pecs_by_family"), figures["pecs"]),
        **{"epoch": "e1", "benchmark_version": "v1"},
    }
    return {**row, **other}


def board_of(*rows):
    return pd.DataFrame(list(rows))[LEADERBOARD.names]


def leaderboard_section(page):
    """The part of a report page with its first leaderboard."""
    return page.partition('id="leaderboard"')[2].partition("</section>")[0]


class Rows(HTMLParser):
    """The cells' texts of every table row of a page."""

    def __init__(self, page):
        super().__init__()
        self.rows, self.inside = [], False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")
            self.inside = True

    def handle_endtag(self, tag):
        self.inside = self.inside and tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.rows[-1][-1] += data


def tables(board):
    """Header and rows of the ranked table in a terminal, in Markdown and in HTML, each row by heading, without the
    columns that HTML alone has or names otherwise."""
    text = [re.split(r"\s{2,}", line.strip()) for line in leaderboard_text(board).split("\n\n")[1].splitlines()]
    lines = [line for line in leaderboard_markdown(board).splitlines() if line.startswith("|")]
    markdown = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in [lines[0], *lines[2:]]]
    html = [[" ".join(cell.split()) for cell in row] for row in Rows(report_html(board)).rows[: len(text)]]
    return [by_heading(rows) for rows in (text, markdown, html)]


PECS_OF = {name: f"PECS {name.replace('_ill_posed', ' ill-posed')}" for name in DATASETS}  # headings in a terminal


def by_heading(rows):
    """Rows as mappings, without deviations, bars and escapes."""
    names = {f"PECS {TITLE_OF[name].replace('-', NO_BREAK)}": PECS_OF[name] for name in DATASETS}
    headings = [names.get(heading, heading).replace("\\", "") for heading in rows[0]]
    found = []
    for row in rows[1:]:
        cells = [re.sub(r" ± [\d.]+", "", cell.replace("\\", "")) for cell in row]
        cells = dict(zip(headings, cells, strict=False))  # a terminal's line ends before what is empty at its end
        found.append({name: cell for name, cell in cells.items() if name not in ("", "Runs") and cell})
    return found
