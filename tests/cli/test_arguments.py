"""Numbers on the command line are what they look like, and bad ones end with a sentence."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from traps_pipeline.cli import build_parser, main

SAMPLE = ["benchmark", "sample", "--seed", "1", "--out", "x"]


@pytest.mark.parametrize(
    "arguments",
    [
        *([*SAMPLE, "--scale", said] for said in ("nan", "inf", "-1", "0", "1e3", "1_0", "\u0661", "9" * 400)),
        *([*SAMPLE, "--count", said] for said in ("-1", "1.0", "1_0", "9" * 30, "\u0661")),
        *(["ui", "--port", said] for said in ("0", "65536", "3000.0", "-1", " 80")),
        ["benchmark", "sample", "--out", "x", "--seed", "-1"],
        ["benchmark", "certify", "--workers", "0"],
    ],
)
def test_a_number_that_is_none_is_bad_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        build_parser().parse_args(arguments)
    assert ended.value.code == 2
    assert f"argument {arguments[-2]}: " in capsys.readouterr().err


def test_no_pairs_are_a_sample_only_beside_two_events(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*SAMPLE, "--count", "0", "--out", str(tmp_path / "sampled")]) == 1
    assert "--count: 0 pairs" in capsys.readouterr().err and not (tmp_path / "sampled").exists()


@pytest.mark.parametrize("said", ["nan", "inf", "-1", "1e3", "1_000", "", "yes", "gpt-5=nan", "=", "\u0661"])
def test_a_budget_that_is_no_number_is_named(said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "demo", "--workspace", str(tmp_path / "w"), f"--budget-usd={said}"]) == 1
    assert f"--budget-usd {said}: " in capsys.readouterr().err


def test_a_stage_that_is_none_is_refused_and_leaves_no_workspace(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "demo", "--workspace", str(tmp_path / "w"), "--until", "vidos"]) == 1
    assert "--until vidos: " in capsys.readouterr().err and not (tmp_path / "w").exists()


def test_an_empty_variable_names_no_folder_of_the_history(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DAGSTER_HOME", "")
    monkeypatch.delenv("TRAPS_WORKSPACE", raising=False)
    assert main(["init", "demo", "--workspace", str(tmp_path / "w")]) == 0
    assert str(tmp_path / "w" / "dagster") in capsys.readouterr().out
    monkeypatch.undo()


@pytest.mark.slow
def test_words_of_any_kind_in_the_place_of_an_experiment_end_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = random.Random(1)
    monkeypatch.chdir(tmp_path)
    for _ in range(200):
        word = "".join(draw.choice("ab/.%\n\x1b\u202e\ud800~-_\u0000 é") for _ in range(draw.choice((1, 5, 300, 5000))))
        word = word.replace("\x00", "").lstrip("-") or "a"
        assert main(["plan", word, "--workspace", str(tmp_path / "w")]) == 1
        told = capsys.readouterr().err
        assert told.startswith("traps: ") and "\x1b" not in told and "\u202e" not in told
        assert len(told) < 1200
