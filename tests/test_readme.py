"""Every command of the README is run, and what it says about models, families and corrections works as it stands."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from tests.conftest import EXPERIMENT, ROOT, Checkout, Finished
from tests.providers.server import Provider

pytestmark = pytest.mark.slow
README = (ROOT / "README.md").read_text()
# The command of `make ui` is started by tests/integration/test_ui.py.
ELSEWHERE = ("make ui",)


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


def in_this_study(study: Checkout, command: str) -> str:
    """The command with the study's folders in place of the README's."""
    # Into the checkout, which is on the path of its commands, and not into the environment of all tests.
    options = f"--no-deps --no-build-isolation --no-index --target {study.root}"
    command = re.sub("^pip install", f"{sys.executable} -m pip install {options}", command)
    command = command.replace("mine.yaml", str(study.workspace.parent / "mine.yaml")).replace(
        ".workspaces/mine", str(study.workspace.parent / "mine")
    )
    # The real Makefile of the real checkout, on this study, but no set-up: in a checkout whose environment is another's
    # (a link) it would install this one there.
    return f"{command} -C {ROOT} -o .venv/.core DEMO={study.workspace}" if command.startswith("make") else command


def run(study: Checkout, command: str) -> Finished:
    """A line of a shell. One that is no more than a command of ours and its arguments needs no shell of its own."""
    name, _, arguments = command.partition(" ")
    if name in ("traps", "dagster") and not re.search(r"[$`<>&;*?~#]| \| ", arguments):
        return {"traps": study.traps, "dagster": study.dagster}[name](*shlex.split(arguments))
    return study.run("bash", "-c", re.sub(r"\btraps ", f"{sys.executable} -m traps_pipeline.cli ", command, count=1))


# Left to the campaign: these draw, certify, render or train, or repeat what another test of `make test` holds.
DEAR = re.compile(r"make |pip |traps (benchmark|run|publish harness|models check --live)|TRAPS_SCENE_SPECS|export ")


@pytest.mark.promise
def test_the_commands_of_the_readme_that_render_nothing_run_on_the_golden_study(study: Checkout) -> None:
    (experiment,) = blocks("yaml")
    (study.workspace.parent / "mine.yaml").write_text(experiment)
    commands = [line for line in "".join(blocks("sh")).splitlines() if not DEAR.match(line)]
    assert len(commands) == 15
    for command in commands:
        ours = re.sub(r"\b(status|plan) demo$", rf"\1 {EXPERIMENT}", command)
        finished = run(study, in_this_study(study, ours))
        assert finished.code == 0, (command, finished.out[-2000:], finished.err[-2000:])


def test_every_command_of_the_readme_runs(demo_study: Checkout, provider: Provider) -> None:
    study = demo_study
    shutil.copytree(ROOT / "docs", study.root / "docs")
    (experiment,) = blocks("yaml")
    # The panel of the paper needs keys; here three judges of one's own sit at the provider, too.
    judges = "".join(f'  - {{id: judge-{k}, base_url: "{provider.url}/v1"}}\n' for k in "abc")
    here = f"judges:\n{judges}panels: {{here: [judge-a, judge-b, judge-c]}}\npanel: here"
    mine = experiment.replace("http://127.0.0.1:8000", provider.url).replace("panel: paper", here)
    (study.workspace.parent / "mine.yaml").write_text(mine)
    (correction,) = blocks("json")
    # The demo's clips serve here too: a clip's name is its content.
    shutil.copytree(study.workspace / "clips", study.workspace.parent / "mine" / "clips")
    ran = 0
    for command in "".join(blocks("sh")).splitlines():
        if command.startswith("export") or command in ELSEWHERE:
            continue
        if command == "traps status demo" and ran > 6:  # the second time, after the correction
            folder = study.root / "scene_specs" / "corrections"
            folder.mkdir(exist_ok=True)
            (folder / "review.jsonl").write_text(correction)
        finished = run(study, in_this_study(study, command))
        assert finished.code == 0, (command, finished.out[-2000:], finished.err[-2000:])
        ran += 1
        if command.startswith("traps run demo"):
            assert finished.counts() == {"answers": 27, "votes": 81, "frames": 0}  # one item, 9 models x 3 regimes
        if command.startswith("traps run mine.yaml"):
            # 4 scenarios x 2 datasets x 2 sides x 2 regimes; three votes on a control's two tasks and a void's one
            assert finished.counts() | {"frames": 0} == {"answers": 32, "votes": 32 // 2 * 9, "frames": 0}
    assert ran == len("".join(blocks("sh")).splitlines()) - 1 - len(ELSEWHERE)
    drawn = study.root / ".workspaces" / "trial" / "released" / "plank_post.jsonl"
    assert len(drawn.read_text().splitlines()) == 1


@pytest.mark.parametrize("size", ["lite", "full"])
def test_what_an_evaluation_costs_in_the_readme_is_what_the_plan_says(size: str, tmp_path: Path) -> None:
    (row,) = re.findall(rf"^\| {size} \| (.*) \|$", README, re.MULTILINE)
    scenarios, answers, votes, dollars, batched, width = row.split(" | ")
    mine = blocks("yaml")[0].partition("scenarios:")[0] + (f"scenarios: {size}\n" if size == "lite" else "")
    (tmp_path / "mine.yaml").write_text(mine)
    plan = (
        Checkout(ROOT, tmp_path / "none").traps("plan", tmp_path / "mine.yaml", "--workspace", tmp_path / "mine").ok()
    )
    assert re.search(rf"^my-model +{answers} +0 +{answers} +{votes} ", plan.out, re.MULTILINE)
    lite, full = re.findall(r"([\d.]+)\smillion", README)
    assert re.search(rf"^my-model +{answers} +{lite if size == 'lite' else full}, ", plan.out, re.MULTILINE)
    expected, low, high = re.findall(r"[0-9.]+", dollars)
    assert re.search(rf"^all +[0-9,]+ +{low} +{expected} +{high} ", plan.out, re.MULTILINE)
    assert re.search(rf"traps study export-requests --batch\b.* {batched}$", plan.out, re.MULTILINE)
    assert {f"{int(scenarios) * 2:,}", *re.findall(r"[\d.]+", width)} <= {*re.findall(r"\d[\d,.]*\b", plan.out)}


def test_the_sample_of_the_leaderboard_in_the_readme_is_what_the_demo_prints(demo_output: str) -> None:
    shown = blocks("text")[0]  # the second one lists the rooms
    printed = demo_output.splitlines()
    for line in shown.splitlines():
        if re.match(r"(oracle|always-abstain|never-abstain|perfect-answerer) ", line):
            assert any(row.startswith(line) for row in printed), line


def test_nothing_that_ships_names_a_folder_of_the_machine_it_was_made_on() -> None:
    listed = [
        path for folder in ("traps_pipeline", "docs", "assets", "scene_specs") for path in (ROOT / folder).rglob("*")
    ]
    texts = [path for path in listed if path.suffix in (".py", ".md", ".yaml", ".jsonl", ".txt", ".j2")]
    assert texts
    for path in texts:
        assert str(ROOT) not in path.read_text(), path
