"""Every command that a page, an error or a help text names exists, with the options that it is given there; and a test
runs it, or docs/ci.md says what it needs that tests do not have."""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

import traps_pipeline.definitions  # noqa: F401 - declares the graph
from tests.conftest import ROOT
from tools.docs_hooks import NOTEBOOK, notebook_page
from traps_pipeline.cli import GROUPS, build_parser
from traps_pipeline.cli.command import SHORT_NAMES
from traps_pipeline.definitions import defs
from traps_pipeline.pipeline.graph import the_graph

README = ROOT / "README.md"
PAGES = [README, *(ROOT / name for name in ("CONTRIBUTING.md", "SECURITY.md")), *sorted((ROOT / "docs").glob("*.md"))]
PAGES += sorted((ROOT / "assets").rglob("README.md"))
BLOCK = re.compile(r"^```(?:sh|bash|text|)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINE = re.compile(r"(?:[A-Z_]+=\S+ )*(?:[\w/]+/)?(traps|make|dagster|inspect|python3?|pip|uv|apt-get) ")
SPAN = re.compile(r"`((?:traps|make) [^`|]+)`")
NOT_RUN = (ROOT / "docs" / "ci.md").read_text().partition("## Commands that no test runs")[2].partition("\n## ")[0]
MAKEFILE = {
    target
    for name in ("Makefile", "maintainers.mk")
    for target in re.findall(r"^([a-z-]+):", (ROOT / name).read_text(), re.MULTILINE)
}
TESTS = {path.relative_to(ROOT / "tests").as_posix(): path.read_text() for path in (ROOT / "tests").rglob("*.py")}
# A test runs these by other words: the file, and the words.
RUN_AS = {
    "traps people review": ("integration/test_review.py", 'listening(study, "review"'),
    "traps study import-votes": ("integration/test_batches.py", 'f"import-{what}"'),
    "inspect eval": ("release/test_pocket_harness.py", '"-m", "inspect_ai", "eval"'),
    "make docs": ("test_docs_site.py", '"make", "-C", checkout'),
    "make release": ("test_habits.py", '"release", "VERSION=9.0.0"'),
    "make release-check": ("test_habits.py", '"release-check"'),
    "make sbom": ("base/test_extras.py", '"tools/sbom.py"'),
    "make ui": ("integration/test_ui.py", '"ui",'),
    "make wheel": ("test_wheel.py", '"hatchling", "build"'),
    **{
        f"tools.pocket {name}": ("pocket/test_pocket.py", f'main(["{name}"')
        for name in ("render", "train", "evaluate", "card")
    },
}
# `.ci/run` is `make test`, which sets up in a fresh environment and runs what `make check` runs.
ELSEWHERE = ("make test", "make ui")  # lines of the README that tests/test_readme.py does not run
IN_CI = ("venv", "make check", "make setup", "make test", "make help")


def in_blocks(text: str) -> Iterator[list[str]]:
    """The words of each line of the fenced blocks of a page that calls a program."""
    for block in BLOCK.findall(text):
        for line in block.replace("\\\n", " ").splitlines():
            if called := LINE.match(line):
                yield [called[1], *shlex.split(line[called.end() :], comments=True)]


def in_spans(text: str) -> Iterator[list[str]]:
    """The words of each command that stands in a sentence; what it needs may be left out there."""
    for span in SPAN.findall(text):
        yield shlex.split(re.sub(r"[\[\]<>]|\.\.\.", "", span))


def name(words: list[str]) -> str:
    """What is run, without what it is run on: `traps study import-answers`, `make demo`."""
    if words[0].startswith("python"):
        words = words[words.index("-m") + 1 :]
    if words[0] == "traps" and words[2:] and words[2] in SHORT_NAMES:
        words = [words[0], *words[2:]]
    deep = 3 if words[0] == "dagster" or words[1] in GROUPS else 1 if words[0] in ("lmms_eval", "venv") else 2
    return " ".join(words[:deep])


COMMANDS = [(page, words, True) for page in PAGES for words in in_blocks(page.read_text())]
COMMANDS += [(page, words, False) for page in PAGES for words in in_spans(page.read_text())]
COMMANDS += [(NOTEBOOK, words, True) for words in in_blocks(notebook_page())]
COMMANDS += [(NOTEBOOK, words, False) for words in in_spans(notebook_page())]
# What the package's errors and help tell to type; a value that is only known then stands in braces.
TOLD = [re.sub(r"\{[^{}]*\}", "X", path.read_text()) for path in (ROOT / "traps_pipeline").rglob("*.py")]
COMMANDS += [(ROOT / "traps_pipeline", words, False) for text in TOLD for words in in_spans(text)]
OF_TRAPS = {(shlex.join(words), whole) for _, words, whole in COMMANDS if words[0] == "traps"}


def test_the_pages_have_commands_of_many_programs() -> None:
    assert len(OF_TRAPS) > 80 and {words[0] for _, words, _ in COMMANDS} > {"traps", "make", "dagster", "inspect"}


def test_every_command_in_a_block_is_parsed_as_it_stands() -> None:
    for command in sorted(command for command, whole in OF_TRAPS if whole):
        build_parser().parse_args(["1" if word == "SEED" else word for word in shlex.split(command)[1:]])


def test_every_command_in_a_sentence_has_the_options_that_it_is_said_to_have(
    capsys: pytest.CaptureFixture[str],
) -> None:
    for command in sorted(command for command, whole in OF_TRAPS if not whole):
        words = shlex.split(command)[1:]
        with pytest.raises(SystemExit) as ended:  # an unknown command ends with 2
            build_parser().parse_args([*itertools.takewhile(lambda word: word[0] != "-", words), "--help"])
        assert ended.value.code == 0, command
        options = {*re.findall(r"--[\w-]+", capsys.readouterr().out)}
        assert {word for word in words if word.startswith("--")} <= options, command


def test_every_target_of_make_exists() -> None:
    wanted = {words[1] for _, words, _ in COMMANDS if words[0] == "make" and "=" not in words[1]}
    assert len(wanted) > 10 and wanted <= MAKEFILE


def test_stages_partitions_and_jobs_that_dagster_is_asked_for_exist() -> None:
    graph, jobs, seen = the_graph(), {job.name for job in defs.jobs or ()}, 0
    for words in (words for _, words, _ in COMMANDS if words[0] == "dagster"):
        given = dict(itertools.pairwise(words))
        asked = {*given.get("--partition-range", given.get("--partition", "")).split("...")} - {""}
        for stage in given.get("--select", "").split(",") if "--select" in given else ():
            keys = graph.keys(stage)
            assert asked <= {*keys} if asked else keys == [None], (words, stage)
            seen += 1
        assert given.get("-j", "everything") in jobs
    assert seen >= 8


def is_run(page: Path, words: list[str], whole: bool) -> bool:
    """Whether a test runs a command: the README's blocks are run as they stand, others by their name."""
    called = name(words)
    if called in IN_CI or (page == README and whole and shlex.join(words) not in ELSEWHERE):
        return True
    if called in RUN_AS:
        file, by = RUN_AS[called]
        return by in TESTS[file]
    parts = called.split()[words[0] in ("traps", "dagster") :]
    sought = re.compile(r",\s*".join(f'"{part}"' for part in parts))
    return any(sought.search(text) for text in TESTS.values())


def test_every_command_is_run_by_a_test_or_said_to_be_run_by_none() -> None:
    runs = {name(words) for page, words, whole in COMMANDS if is_run(page, words, whole)}
    rest = {name(words) for _, words, _ in COMMANDS} - runs
    told = {*re.findall(r"`([^`]+)`", "".join(re.findall(r"^\|([^|]+)\|", NOT_RUN, re.MULTILINE)))}
    assert rest == told
