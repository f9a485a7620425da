"""The printed leaderboard and the report page show the table's content, escaped, and the same on every build."""

from __future__ import annotations

import base64
import hashlib
import io
import re
import warnings
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from tests.build.boards import PECS_OF, board_of, board_row, leaderboard_section, tables
from traps_pipeline.models.registry.judges import BY_RULES
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.regimes import PAPER_REGIMES
from traps_pipeline.report.cards import EXPLORER, Card, data_address, explorer_address
from traps_pipeline.report.contact_sheet import PAGE, pairs_figure, six_pairs, telling_times, whole_pairs
from traps_pipeline.report.figures.landscape import landscape_figure
from traps_pipeline.report.leaderboard_page import BOUNDS, leaderboard_markdown, leaderboard_text, leaderboards
from traps_pipeline.report.page import report_html
from traps_pipeline.report.worked_example import Example, chosen_example, example_figure, reading
from traps_pipeline.report.writing import NotRun, figure_bytes, fraction, percent, table_latex
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.video.encode import encode

BOARDS = ("overall", *DATASETS)
HOSTILE = "<script>alert(1)</script>|[x](http://evil.example)\x1b[2J"
REFERENCES = {  # Acc, FalseAbs, AbsRec
    "oracle": (1, 0, 1),
    "always-abstain": (0, 1, 1),
    "never-abstain": (0.4, 0, 0),
    "random-50": (0.5, 0.5, 0.5),
    "perfect-answerer": (1, 0, 0),
    "inverse-oracle": (0, 1, 0),
    "confidence-noise": (0.7, 0.3, 0.3),
    "prior": (0.41, 0, 0),
}


@pytest.fixture(scope="module")
def board():
    """The reference strategies and a model of hostile name, under all regimes on all datasets and overall."""
    models = {**REFERENCES, HOSTILE: (0.6, 0.1, 0.5)}
    return board_of(
        *(
            board_row(m, r, d, shares)
            for m, shares in models.items()
            for r in PAPER_REGIMES
            for d in (*DATASETS, "overall")
        )
    )


def points(board):
    """What the landscape shows of a board."""
    return board[board["dataset"] == "overall"]


def entry(board, model):
    """What every medium shows of a model, by heading."""
    text, markdown, page = tables(board)
    assert text == markdown == page
    return next(row for row in text if row["Model"] == model)


def test_text_lists_models_by_overall_pecs_with_their_interval(board):
    shown = board[board["model"] != HOSTILE]
    shown = pd.concat([shown, board_of(board_row("mid", pecs_ci_low=0.2, pecs_ci_high=0.3))])
    lines = leaderboard_text(shown).splitlines()
    assert lines[0].startswith("Overall. ")
    assert {"three", "1", "v1", "e1"} <= {*re.findall(r"\w+", lines[0])}  # panel, its version, the benchmark's, epoch
    text = tables(shown)[0]
    # Reference rows are no models: they come last, however high their score, below a heading.
    assert [row["Model"] for row in text[:5]] == ["mid", "Reference rows"] + ["oracle"] * 3
    assert (text[2]["PECS"], text[2]["95 % CI"], text[2]["Acc %"]) == ("1.000", "[1.000, 1.000]", "100.0")
    assert {*filter(None, text[1].values())} == {"Reference rows"}
    # Acc 0.5, J 0.6 - 0.1 = 0.5, PECS 0.25; no dataset of its own is on the board.
    assert text[0].items() >= {
        "PECS": "0.250", "95 % CI": "[0.200, 0.300]", "Acc %": "50.0", "AbsRec %": "60.0", "FalseAbs %": "10.0",
        "J": "0.500", **dict.fromkeys(PECS_OF.values(), "–"), "n": "1404", "Missing": "0",
    }.items()  # fmt: skip
    assert len({len(x) for x in lines[2:-2] if x != "Reference rows"}) == 1
    assert lines[-1].startswith("– ")


def test_ties_keep_the_regimes_order(board):
    assert list(leaderboards(board)[0].rows["regime"][:3]) == list(PAPER_REGIMES)


def cells_with_gaps(model="gaps"):
    """A model that lost 60 items of `chaotic`, so that this and overall are incomplete; occlusion lacks a majority."""
    lost = {"n_missing": 60, "n_refused": 41, "n_empty": 7, "n_errors": 12, "answered": 0.98, "incomplete": True}
    return [
        board_row(model, **{**lost, "n_missing": 61, "pecs_low": 0.2, "pecs_high": 0.31, "answered": 0.995}),
        board_row(model, dataset="occlusion", n_missing=1, pecs_low=0.249, pecs_high=0.251),
        board_row(model, dataset="occlusion_ill_posed"),
        board_row(model, dataset="chaotic", **lost, pecs_low=0.15, pecs_high=0.35),
        board_row(model, dataset="chaotic_ill_posed"),
    ]


@pytest.mark.slow
def test_text_markdown_and_html_show_the_same_counts_and_bounds_and_mark_an_incomplete_cell_at_every_pecs_and_n():
    board = board_of(*cells_with_gaps(), *(board_row("whole", dataset=d, shares=(1, 0, 1)) for d in BOARDS))
    assert entry(board, "whole").items() >= {
        "PECS": "1.000", "PECS chaotic": "1.000", "n": "1404", "Missing": "0", "Refused": "0", "Empty": "0",
    }.items()  # fmt: skip
    assert entry(board, "gaps").items() >= {
        "PECS occlusion": "0.250", "PECS chaotic": "0.250 ‡", "PECS chaotic ill-posed": "0.250", "n": "1404 ‡",
        "Missing": "61 †", "Refused": "41", "Empty": "7", BOUNDS: "[0.200, 0.310]",
    }.items()  # fmt: skip
    marked = {heading for heading, cell in entry(board, "gaps").items() if "‡" in cell}
    assert marked == {"PECS", "PECS chaotic", "n"}
    for said in (leaderboard_text(board), leaderboard_markdown(board), report_html(board)):
        assert "99 %" in said
    own = {d: report_html(board).split(f'id="leaderboard_{d}"')[1].split("</details>")[0] for d in DATASETS}
    assert own["chaotic"].count("‡") == 3  # PECS and n of the dataset's own table, and what it means
    assert "‡" not in own["occlusion"] and "[0.249, 0.251]" in own["occlusion"]


@pytest.mark.parametrize(("overruled", "shown"), [(None, None), (0, None), (10, "10"), (11, "11 ¶")])
def test_votes_that_code_decides_unlike_their_judges_are_counted_and_marked_above_1_percent_of_the_controls(
    overruled, shown
):
    nobody = board_row("rules", n_overruled=None)
    for rows in tables(
        board_of(board_row("m", n_pairs=500, n_runs=2, n_overruled=overruled), nobody)
    ):  # 1,000 controls
        by_model = {row["Model"]: row.get("Overruled") for row in rows}
        assert by_model == {"m": shown, "rules": None if shown is None else "–"}


def test_a_board_of_which_a_fifth_is_missing_says_first_why_and_what_to_change():
    counts = {"n_missing": 26, "n_truncated": 11, "n_empty": 10, "n_unread": 5}
    lacking = {"n_runs": 1, "n_pairs": 16} | counts
    rows = [board_row("fine", dataset="occlusion"), board_row("m", dataset="occlusion", **lacking)]
    board = board_of(*rows, board_row("m", **lacking))
    first = leaderboard_text(board).splitlines()[0]
    assert first.startswith("m: 11 of 32 answers were cut off, 10 empty, 5 unread: raise its limit of tokens")
    assert leaderboard_markdown(board).startswith(first)
    a_fifth = board_row("m", dataset="occlusion", n_runs=1, n_pairs=15, n_missing=6, n_errors=6)
    assert leaderboard_text(board_of(a_fifth)).startswith("Occlusion. ")
    more = board_of(a_fifth | {"n_missing": 9, "n_errors": 1})
    assert leaderboard_text(more).startswith("m: 8 of 30 answers were undecided by the panel, 1 not given")
    held_out = board_of(a_fifth | {"n_items": 15, "n_missing": 4, "n_errors": 4})  # one item of each pair
    assert leaderboard_text(held_out).startswith("m: 4 of 15 answers were not given")


def test_marks_and_columns_are_away_where_nothing_calls_for_them():
    for board in (board_of(board_row("m")), board_of(board_row("m", n_errors=1, n_missing=0))):
        for shown in (leaderboard_text(board), leaderboard_markdown(board), report_html(board)):
            assert not re.search("‡|99 %|refused|Refused|empty|Empty|worst|incomplete:", shown)
    undecided = board_of(board_row("m", n_missing=1))
    for shown in (leaderboard_text(undecided), leaderboard_markdown(undecided), report_html(undecided)):
        assert "[0.250, 0.250]" in shown.replace("\\", "")
        assert not re.search("‡|refused|Refused|Empty", shown)


def test_a_cell_of_errors_alone_is_marked_at_its_dash():
    null = dict.fromkeys(("acc", "abs_rec", "false_abs", "j", "pecs", "pecs_ci_low", "pecs_ci_high"), np.nan)
    lost = {"n_missing": 8424, "n_errors": 8424, "answered": 0.0, "incomplete": True, "pecs_low": 0.0, "pecs_high": 1.0}
    row = entry(board_of(*(board_row("m", dataset=d, **null, **lost) for d in BOARDS)), "m")
    assert [row[heading] for heading in ("PECS", *PECS_OF.values())] == ["– ‡"] * 5
    assert [row[name] for name in ("95 % CI", "Acc %", "AbsRec %", "FalseAbs %", "J")] == ["–"] * 5
    assert (row["n"], row["Missing"], row[BOUNDS]) == ("1404 ‡", "8424 †", "[0.000, 1.000]")


def test_a_model_without_an_overall_row_is_listed_last_with_what_it_has():
    part = board_row("part", dataset="chaotic", shares=(1, 0, 1), n_pairs=500, n_missing=50, incomplete=True)
    board = board_of(part, board_row("weak"))
    assert tables(board)[0][-1]["Model"] == "part"
    assert entry(board, "part").items() >= {
        "PECS": "–", "Acc %": "–", "PECS chaotic": "1.000 ‡", "n": "500 ‡", "Missing": "50 †",
    }.items()  # fmt: skip
    assert '<p class="source">– ' in leaderboard_section(report_html(board))


def test_a_board_of_one_dataset_is_ranked_by_that_dataset():
    board = board_of(board_row("a", dataset="chaotic"), board_row("b", dataset="chaotic", shares=(1, 0, 1)))
    lines = leaderboard_text(board).splitlines()
    assert lines[0].startswith("Chaotic.")
    assert [x.split()[0] for x in lines[3:5]] == ["b", "a"]


def test_null_figures_are_dashes_and_negative_ones_have_a_true_minus():
    assert (fraction(None), fraction(float("nan")), fraction(-0.5), fraction(-0.0001)) == ("–", "–", "−0.500", "0.000")
    assert (percent(0.1234), percent(np.nan)) == ("12.3", "–")
    null = dict.fromkeys(("acc", "j", "pecs", "pecs_std", "pecs_ci_low", "pecs_ci_high"), np.nan)
    board = board_of(board_row("m", **null))
    assert "nan" not in leaderboard_text(board) + leaderboard_markdown(board) + report_html(board)


@pytest.mark.slow
@pytest.mark.promise
def test_a_hostile_model_id_is_text_in_every_medium(board):
    for shown in (board, board_of(*cells_with_gaps(HOSTILE))):
        markdown, page = leaderboard_markdown(shown), report_html(shown)
        rows = [line for line in markdown.splitlines() if line.startswith("|")]
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in rows}) == 1  # no cell more than the heading has
        assert "<script" not in markdown and r"\|\[x\]\(http://evil.example\)?\[2J" in markdown
        assert page.count("<script") == 1 and "&lt;script&gt;alert(1)&lt;/script&gt;" in page  # the page's own
        assert "\x1b" not in leaderboard_text(shown)


@pytest.mark.slow
def test_html_asks_the_network_for_nothing(board):
    svg = figure_bytes(landscape_figure(points(board), "Overall"), "svg")
    card = Card("figure-x", "A figure", f'<img src="{data_address("svg", svg)}">')
    page = report_html(board, [card], address=explorer_address, explorer=EXPLORER)
    script = page.partition("<script>")[2].partition("</script>")[0]
    targets = {
        *re.findall(r"""\s(?:src|href|action|data|poster|srcset)\s*=\s*["']([^"']*)""", page.replace(script, ""))
    }
    kinds = {target.partition(",")[0].partition("?")[0] for target in targets if not target.startswith("#")}
    assert kinds == {
        "index.html", "index.html#/answers",
        *(f"data:{kind};base64" for kind in ("image/svg+xml", "text/csv", "application/x-tex")),
    }  # fmt: skip
    assert not re.search(r"url\(|@import|<link|<iframe", page) and page.count("<script") == 1
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{digest}'" in page


def test_every_number_of_the_leaderboard_is_a_link_to_its_items():
    rows = [*cells_with_gaps(), board_row("part", dataset="chaotic", n_pairs=77, n_missing=5)]
    page = report_html(board_of(*rows), address=lambda behind: f"to-{behind.dataset}-{behind.model}-{behind.side}")
    bare = re.sub(r"<a href=[^>]*>[^<]*</a>|<style>.*?</style>", "", page, flags=re.DOTALL)
    cells = re.findall(r"<td[^>]*>(.*?)</td>", bare, flags=re.DOTALL)
    assert cells
    shown = [re.sub(r"<span class=\"(sd|bar)\".*?</span>", "", cell) for cell in cells]
    assert not [cell for cell in shown if re.search(r"\d", re.sub(r"<[^>]*>", "", cell))]
    for text, to in (("[0.250, 0.250]", "to--gaps-"), ("1404", "to--gaps-"), ("61", "to--gaps-"), ("77", "to--part-")):
        assert f'<a href="{to}">{text}</a>' in page


def test_html_names_the_epoch_in_each_row_where_rows_differ():
    page = report_html(board_of(board_row("a"), board_row("b", epoch="e2")))
    assert '<th class="word">Epoch</th>' in page
    assert '<td class="word">e2</td>' in page


def test_an_empty_board_still_gives_a_page_and_a_table_and_no_empty_figure():
    board = pd.DataFrame(columns=pd.Index(LEADERBOARD.names))
    (table,) = leaderboards(board)
    assert table.absence and table.absence in report_html(board) and table.absence in leaderboard_text(board)
    with pytest.raises(NotRun):
        landscape_figure(points(board), "Overall")


def test_no_two_labels_of_the_landscape_overlap(board):
    figure = landscape_figure(points(board), "Overall")
    axes = figure.axes[0]
    figure.canvas.draw()
    boxes = [t.get_window_extent() for t in axes.texts if t.get_text()]
    assert not [(a, b) for k, a in enumerate(boxes) for b in boxes[:k] if a.overlaps(b)]
    edge = figure.bbox
    assert all(b.x0 >= 0 and b.y0 >= 0 and b.x1 <= edge.x1 and b.y1 <= edge.y1 for b in boxes)


def test_the_landscape_of_few_pairs_holds_its_wide_intervals():
    ends = {"acc_ci_low": 0.01, "acc_ci_high": 0.8, "j_ci_low": -0.6, "j_ci_high": 0.6}
    row = {"model": "mine", "regime": "guided", "acc": 0.25, "j": 0.0, "pecs": 0.0, "incomplete": False, **ends}
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # a layout that has no place for its axes
        axes = landscape_figure(pd.DataFrame([row]), "Overall").axes[0]
    assert axes.get_xlim()[0] <= -0.6 and axes.get_xlim()[1] >= 0.6
    assert axes.get_ylim()[0] >= -0.05 and axes.get_ylim()[1] >= 0.8


def test_the_landscape_reaches_left_to_the_inverse_oracle(board):
    assert landscape_figure(points(board), "Overall").axes[0].get_xlim()[0] < -1
    only_good = board[board["j"] >= 0]
    assert landscape_figure(points(only_good), "Overall").axes[0].get_xlim()[0] == pytest.approx(-0.08)


def pair_rows(scenario, root, frames=12, kept=12, dataset="chaotic", size=(48, 64)):
    """ITEMS columns of one pair whose void keeps the control's first frames, with its clips written under root."""
    clip = [np.full((*size, 3), 15 * k, np.uint8) for k in range(frames)]
    for side, count in (("control", frames), ("void", kept)):
        encode(clip[:count], root / f"{scenario}-{side}.mp4", 10)
    return [
        {
            **{"pair_id": f"{dataset}:{scenario}", "dataset": dataset, "scenario_id": scenario, "side": side},
            **{"sub_scenario": scenario.split("-")[0], "question": "Where?"},
            "ground_truth": "left" if side == "control" else None,
            "clip": f"{scenario}-{side}.mp4",
        }
        for side in ("control", "void")
    ]


def test_a_contact_sheet_is_a_png_and_hatches_what_the_void_does_not_show(tmp_path):
    import matplotlib.image

    sheets = []
    for kept in (12, 5):
        items = pd.DataFrame(pair_rows("plinko-0", tmp_path, kept=kept))
        sheets.append(
            matplotlib.image.imread(io.BytesIO(figure_bytes(pairs_figure(items, tmp_path, replace(PAGE, moments=4)))))
        )
    full, hatched = sheets
    differs = np.abs(full - hatched).sum(axis=2) > 0.05
    down, right = np.nonzero(differs)
    # Frames 0, 4, 7, 11 are shown: the void of 5 frames has the first two, so only the lower right quarter changes.
    assert full.shape == hatched.shape
    assert down.min() > 0.5 * full.shape[0]
    assert right.min() > 0.5 * full.shape[1]


def test_a_contact_sheet_shows_the_outcome_of_a_control_before_a_panel_closes_it():
    frames, at = np.full((50, 360, 480, 3), 180, np.uint8), np.arange(50) / 10
    assert telling_times(frames, at, 4).tolist() == [0.0, 1.6, 3.3, 4.9]
    frames[40:, 100:300, 150:350] = (16, 24, 64)
    assert telling_times(frames, at, 4).tolist() == [0.0, 2.0, 3.9, 4.9]
    assert telling_times(frames, at, 3).tolist() == [0.0, 2.0, 3.9]


def test_a_contact_sheet_takes_whole_pairs_alone(tmp_path):
    rows = [r for s in ("plinko-1", "plinko-0") for r in pair_rows(s, tmp_path, frames=2, kept=2)]
    rows += pair_rows("dice-1", tmp_path, frames=2, kept=2)[:1]  # no void: not a pair
    assert [pair.at["void", "scenario_id"] for pair in whole_pairs(pd.DataFrame(rows))] == ["plinko-0", "plinko-1"]


def test_six_pairs_are_of_six_sub_scenarios_occlusion_first(tmp_path):
    scenes = {"chaotic": ("plinko-0", "plinko-1", "dice-0", "seesaw-0"), "occlusion": ("race-0", "chain-0", "chain-1")}
    items = pd.concat(
        pd.DataFrame(pair_rows(scene, tmp_path, frames=2, kept=2, dataset=name)).assign(
            taxonomy=name, category=scene[:4]
        )
        for name, of in scenes.items()
        for scene in of
    )
    chosen = whole_pairs(six_pairs(items))
    # Three of the chaotic ones; the second chain is no further family, so occlusion has two.
    expected = ["chain-0", "race-0", "dice-0", "plinko-0", "seesaw-0"]
    assert [pair.at["void", "scenario_id"] for pair in chosen] == expected


def test_the_worked_example_is_a_pair_with_both_answers_and_their_verdicts(tmp_path):
    def verdict(pair, sub_scenario, side, abstained, correct, model="gemini-2.5-pro"):
        ids = {"pair_id": pair, "model": model, "run": 1, "dataset": "chaotic", "side": side}
        return {**ids, "sub_scenario": sub_scenario, "abstained": abstained, "correct": correct}

    rows = [
        *(verdict("a", "plinko", side, side == "void", side == "control") for side in ("control", "void")),
        *(verdict("b", "seesaw_sorter", side, False, side == "control") for side in ("control", "void")),
        verdict("c", "seesaw_sorter", "control", False, True),  # its void has no verdict
        *(verdict("d", "seesaw_sorter", side, False, False) for side in ("control", "void")),  # a wrong control
    ]
    chosen = chosen_example(pd.DataFrame(rows))
    assert (chosen["pair_id"], chosen["side"]) == ("b", "control")
    assert chosen_example(pd.DataFrame(rows[4:5])) is None
    votes = [{"valid": True, "task": "abstention", "abstained": k == 0, "extracted_value": None} for k in range(3)]
    votes += [{"valid": k > 0, "task": "correctness", "abstained": None, "extracted_value": "left"} for k in range(3)]
    words = reading("It goes left.", votes, rows[2])
    assert re.findall(r"\d|left", words[1]) == ["1", "3", "left"] and "correct" in words[2]
    assert len({reading("Left.", votes, rows[k])[2] for k in (1, 2, 3, 5)}) == 4  # voids and controls, right and wrong
    pair = pd.DataFrame(pair_rows("plinko-0", tmp_path, kept=5)).set_index("side")
    figure = example_figure(Example(pair, "a model", {"control": words, "void": words}), tmp_path)
    assert figure_bytes(figure).startswith(b"\x89PNG")


def test_panels_have_tables_of_their_own_and_a_model_judged_by_rules_is_said_not_to_be_comparable():
    both = board_of(
        board_row("gpt-5-high", panel="paper@2"),
        *(board_row(model, panel="rules@1") for model in ("oracle", "pocket")),
    )
    by_paper, by_rules = leaderboards(both)
    assert [list(table.rows["model"]) for table in (by_paper, by_rules)] == [["gpt-5-high"], ["oracle", "pocket"]]
    assert {"paper", "2"} <= {*re.findall(r"\w+", by_paper.lead)}
    for said in (table_latex(by_rules), leaderboard_text(both), leaderboard_markdown(both), report_html(both)):
        assert f"{BY_RULES[1:]}: pocket." in said
    for said in (table_latex(by_paper), leaderboard_text(both.loc[both["model"] == "oracle"])):
        assert BY_RULES[1:] not in said


def test_a_panel_of_one_judge_is_marked():
    one, several = (leaderboard_text(board_of(board_row("m", panel=f"mine@ab12{judges}"))) for judges in (".1", ""))
    assert "mine" in one and "ab12" in one and "ab12.1" not in one and one != several
