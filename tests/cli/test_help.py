"""Commands in groups: help with examples, suggestions for misspelt words, completion in a shell."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tools.commands_page import PAGE, page
from traps_pipeline.cli import GROUPS, START, build_parser, main
from traps_pipeline.cli.command import SHORT_NAMES


def test_the_examples_of_help_texts_can_be_given_as_they_stand() -> None:
    for path, command in build_parser().commands.items():
        text = command.format_help()
        (example,) = (line for line in text.splitlines() if line.startswith("example: traps "))
        parsed = build_parser().parse_args(shlex.split(example.removeprefix("example: traps ")))
        assert parsed.parser.prog == f"traps {path}"
        codes = re.findall(r"\b\d+\b", text.partition(example)[2])
        assert codes == ["0", "1", "2", *["4"] * (path == "study run"), "130"]


def test_no_line_of_a_help_text_is_wider_than_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    parser = build_parser()
    texts = [each.format_help() for each in (parser, *parser.commands.values())] + [START]
    assert not [line for text in texts for line in text.splitlines() if len(line) > 80]


def test_every_command_but_completion_stands_in_a_group_and_daily_ones_need_none() -> None:
    assert {path.split()[0] for path in build_parser().commands} == {*GROUPS, "completion"}
    for name, group in SHORT_NAMES.items():
        words = ["demo"] if name in ("plan", "run") else ["a:b:c"] if name == "why" else []
        assert build_parser().parse_args([name, *words]).parser.prog == f"traps {group} {name}"


def test_no_command_shows_where_to_start_and_a_group_its_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "traps run demo" in capsys.readouterr().out
    assert main(["people"]) == 0
    told = capsys.readouterr().out
    assert not [path for path in build_parser().commands if path.startswith("people ") and path.split()[1] not in told]
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("traps 0.")


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["sttaus"], "`traps status`"),
        (["certify"], "`traps benchmark certify`"),
        (["reslts"], "`traps results`"),
        (["study", "expot-votes"], "`traps study export-votes`"),
        (["zzz"], "`traps --help`"),
        (["run", "demo", "--budgt-usd", "3"], "--budget-usd?"),
        (["run", "demo", "--progress", "jsn"], "json?"),
    ],
)
def test_a_misspelt_word_is_bad_usage_with_the_nearest_one(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert hint in capsys.readouterr().err.splitlines()[-1]


def test_a_shell_completes_commands_options_and_experiments() -> None:
    command = [sys.executable, "-m", "traps_pipeline.cli", "completion", "bash"]
    script = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for words, expected in {
        "traps stu": "study",
        "traps study pl": "plan",
        "traps run hyp": "hypotheses hypotheses-pocket",
        "traps study run demo --unt": "--until",
        "traps publish ver": "verify",
    }.items():
        asked = f"COMP_WORDS=({words}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _traps; echo ${{COMPREPLY[@]}}"
        done = subprocess.run(["bash", "-c", f"{script}\n{asked}"], capture_output=True, text=True)
        assert (done.stdout.strip(), done.stderr) == (expected, "")


def test_the_page_of_commands_is_what_the_parser_says_and_every_argument_has_a_meaning() -> None:
    text = page()
    assert PAGE.read_text(encoding="utf-8") == text  # `python -m tools.commands_page` writes it
    arguments = [line for line in text.partition("## Common")[2].splitlines() if line.startswith("- `")]
    assert len(arguments) > 100 and not [line for line in arguments if not re.search(r"`(?: \(required\))?: \w", line)]


def test_help_loads_neither_dagster_nor_pandas() -> None:
    code = (
        "import sys; from traps_pipeline.cli import build_parser; build_parser().format_help();"
        "print(sorted({'dagster', 'pandas', 'pydantic', 'numpy'} & set(sys.modules)))"
    )
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (ran.stdout, ran.stderr) == ("[]\n", "")
