"""Every command of the README is run, and what it says about models, families and corrections works as it stands."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

import pandas
import pytest

from tests.conftest import EXPERIMENT, ROOT, Checkout, Finished
from tests.providers.server import Provider

pytestmark = pytest.mark.slow
README = (ROOT / "README.md").read_text()
# The command of `make ui` is started by tests/integration/test_ui.py; a clone would be of another host's repository.
ELSEWHERE = ("make ui", "git clone")


def blocks(language: str, page: str = README) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)


def judged_by_models(panel: str, scenarios: str) -> str:
    """The experiment of the README's first result, with the lines about rules replaced as the README says."""
    (first,) = blocks("yaml")
    said = [line for line in re.findall(r"`([a-z]+: [^`]+)`", README) if line.partition(":")[0] in PANEL_KEYS]
    assert len(said) == 5, said
    panels = {"paper": said[:1], "one": said[1:3]}
    return "\n".join([*first.splitlines()[:-4], *panels[panel], said[3], *([said[4]] if scenarios == "lite" else [])])


PANEL_KEYS = ("panel", "panels", "regimes", "scenarios")


def in_this_study(study: Checkout, command: str) -> str:
    """The command with the study's folders in place of the README's."""
    # Into the checkout, which is on the path of its commands, and not into the environment of all tests.
    options = f"--no-deps --no-build-isolation --no-index --target {study.root}"
    command = re.sub("^pip install", f"{sys.executable} -m pip install {options}", command)
    folder = study.workspace.parent
    command = re.sub(r"\.workspaces/(mine|judged)\b", rf"{folder}/\1", command).replace(
        "mine.yaml", f"{folder}/mine.yaml"
    )
    # The real Makefile of the real checkout, on this study, but no set-up: in a checkout whose environment is another's
    # (a link) it would install this one there.
    ready = f"-C {ROOT} -o .venv/.core -o .venv/.without-torch DEMO={study.workspace}"
    return f"{command} {ready}" if command.startswith("make") else command


def run(study: Checkout, command: str) -> Finished:
    """A line of a shell. One that is no more than a command of ours and its arguments needs no shell of its own."""
    name, _, arguments = command.partition(" ")
    if name in ("traps", "dagster") and not re.search(r"[$`<>&;*?~#]| \| ", arguments):
        return {"traps": study.traps, "dagster": study.dagster}[name](*shlex.split(arguments))
    return study.run("bash", "-c", re.sub(r"\btraps ", f"{sys.executable} -m traps_pipeline.cli ", command, count=1))


# Left to the campaign: these draw, certify, render or train, or repeat what another test of `make test` holds.
DEAR = re.compile(
    r"git |make |pip |traps (benchmark|run|publish harness|models check --live)|TRAPS_SCENE_SPECS|export "
)


@pytest.mark.promise
def test_the_commands_of_the_readme_that_render_nothing_run_on_the_golden_study(study: Checkout) -> None:
    (experiment,) = blocks("yaml")
    (study.workspace.parent / "mine.yaml").write_text(experiment)
    commands = [line for line in "".join(blocks("sh")).splitlines() if not DEAR.match(line)]
    assert len(commands) == 9
    for command in commands:
        ours = re.sub(r"\b(status|plan) demo$", rf"\1 {EXPERIMENT}", command)
        finished = run(study, in_this_study(study, ours))
        assert finished.code == 0, (command, finished.out[-2000:], finished.err[-2000:])


def test_every_command_of_the_readme_runs(demo_study: Checkout, provider: Provider) -> None:
    study = demo_study
    shutil.copytree(ROOT / "docs", study.root / "docs")
    (first,) = blocks("yaml")
    mine = study.workspace.parent / "mine.yaml"
    mine.write_text(first.replace("http://127.0.0.1:8000", provider.url))
    # The judge of the README needs a key; here one of one's own sits at the provider, too.
    eight = first.splitlines()[-1]
    judged = judged_by_models("one", "full").replace("http://127.0.0.1:8000", provider.url)
    judged = re.sub(r"\bjudge-[\w.-]+", "judge-a", judged) + f"\n{eight}\n"
    judged += f'judges: [{{id: judge-a, base_url: "{provider.url}/v1"}}]\n'
    (correction,) = blocks("json", (ROOT / "docs" / "benchmark.md").read_text())
    # The demo's clips serve here too: a clip's name is its content.
    for name in ("mine", "judged"):
        shutil.copytree(study.workspace / "clips", study.workspace.parent / name / "clips")
    ran = 0
    for command in "".join(blocks("sh")).splitlines():
        if command.startswith(("export", *ELSEWHERE)):
            continue
        if command.startswith("traps plan mine.yaml"):
            mine.write_text(judged)
        if command == "traps run demo":
            folder = study.root / "scene_specs" / "corrections"
            folder.mkdir(exist_ok=True)
            (folder / "review.jsonl").write_text(correction)
        finished = run(study, in_this_study(study, command))
        assert finished.code == 0, (command, finished.out[-2000:], finished.err[-2000:])
        ran += 1
        if command == "traps run demo":
            assert finished.counts() == {"answers": 27, "votes": 81, "frames": 0}  # one item, 9 models x 3 regimes
        if command.startswith("traps run mine.yaml"):
            # 8 scenarios x 2 datasets x 2 sides, under one regime and three rules first, then under two regimes and one
            # judge; a judge votes on a control's two tasks and a void's one
            answers, votes = (64, 64 // 2 * 3) if "budget" in command else (32, 32 // 2 * 9)
            assert finished.counts() | {"frames": 0} == {"answers": answers, "votes": votes, "frames": 0}
            assert len(finished.out.splitlines()) < 40 and re.search("^my-model ", finished.out, re.MULTILINE)
    assert ran == len("".join(blocks("sh")).splitlines()) - 2 - len(ELSEWHERE)
    drawn = study.root / ".workspaces" / "trial" / "released" / "plank_post.jsonl"
    assert len(drawn.read_text().splitlines()) == 1


def planned(mine: str, folder: Path) -> str:
    """What `traps plan` prints of this experiment."""
    (folder / "mine.yaml").write_text(mine)
    return Checkout(ROOT, folder / "none").traps("plan", folder / "mine.yaml", "--workspace", folder / "mine").ok().out


@pytest.mark.parametrize("panel", ["paper", "one"])
@pytest.mark.parametrize("size", ["lite", "full"])
def test_what_an_evaluation_costs_in_the_readme_is_what_the_plan_says(size: str, panel: str, tmp_path: Path) -> None:
    (row,) = re.findall(rf"^\| {size} \| (.*) \|$", README, re.MULTILINE)
    answers, *by_panel, width = row.split(" | ")
    votes, expected, low, high, batched = re.findall(r"[0-9.,]*[0-9]", by_panel[panel == "one"])
    plan = planned(judged_by_models(panel, size), tmp_path)
    assert re.search(rf"^my-model +{answers} +0 +{answers} +{votes} ", plan, re.MULTILINE)
    lite, full = re.findall(r"([\d.]+)\smillion", README)
    assert re.search(rf"^my-model +{answers} +{lite if size == 'lite' else full}, ", plan, re.MULTILINE)
    assert re.search(rf"^all +[0-9,]+ +{low} +{expected} +{high} ", plan, re.MULTILINE)
    assert re.search(rf"traps study export-requests --batch\b.* {batched}$", plan, re.MULTILINE)
    assert {*re.findall(r"[\d.]+", width)} <= {*re.findall(r"\d[\d,.]*\b", plan)}


def test_a_first_look_has_the_calls_and_the_interval_that_the_readme_says(tmp_path: Path) -> None:
    (first,) = blocks("yaml")
    plan = planned(first, tmp_path)
    asked, pairs, width = re.findall(r"model (\d+) questions|Of (\d+) pairs|PECS is about ([\d.]+) wide", README)
    assert re.search(rf"^my-model +{asked[0]} ", plan, re.MULTILINE)
    assert re.search(rf"with {pairs[1]} pairs:.* about {width[2]} wide", plan)


def test_one_judge_differs_from_the_panel_as_often_as_the_readme_says() -> None:
    # Of three yes-or-no votes that are not unanimous, one differs from the majority: a third of them for each judge.
    table = pandas.read_csv(ROOT / "assets" / "published" / "judge_agreement.csv")
    differing = (100 - table["unanimous_pct"]) / 3
    said = re.search(r"from\sthe\smajority\son\s([\d.]+)\sto\s([\d.]+)\s%", README)
    assert said and said.groups() == (f"{differing.min():.1f}", f"{differing.max():.1f}")


def test_the_sample_of_the_leaderboard_in_the_readme_is_what_the_demo_prints(demo_output: str) -> None:
    (shown,) = blocks("text")
    printed = demo_output.splitlines()
    for line in shown.splitlines():
        if re.match(r"(Reference rows$|oracle |always-abstain |never-abstain |perfect-answerer )", line):
            assert any(row.startswith(line) for row in printed), line


def test_nothing_that_ships_names_a_folder_of_the_machine_it_was_made_on() -> None:
    listed = [
        path for folder in ("traps_pipeline", "docs", "assets", "scene_specs") for path in (ROOT / folder).rglob("*")
    ]
    texts = [path for path in listed if path.suffix in (".py", ".md", ".yaml", ".jsonl", ".txt", ".j2")]
    assert texts
    for path in texts:
        assert str(ROOT) not in path.read_text(), path
