"""Recorded pairs from a folder of videos to a release: asked, labelled by people, corrected, never simulated."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.build.recorded import balls
from tests.conftest import ROOT

pytestmark = pytest.mark.slow
PEOPLE = ("jd", "ab", "cy")
EXPERIMENT = """
name: balls
benchmark: balls
models: [oracle, always-abstain]
datasets: [occlusion, occlusion_ill_posed, chaotic, chaotic_ill_posed, two_events]
regimes: [standard]
panel: rules
"""
# In a process of its own: which benchmark is read is fixed when the package is loaded.
LABEL = """
import sys
from pathlib import Path
from traps_pipeline.people.label_units import sample
from traps_pipeline.servers.labelstore import LabelStore
from traps_pipeline.storage.benchmark_tables import ITEMS
from traps_pipeline.storage.workspace import Workspace
workspace = Workspace.open(Path(sys.argv[1]))
truth = workspace.tables.read_all(ITEMS).set_index("item_id")["ground_truth"]
store = LabelStore(workspace.labels)
units = sample(workspace, "answerability")
for who in sys.argv[2:]:
    for row in units.to_dict("records"):
        store.show(who, "answerability", row["unit"], row["scenario_id"])
        answer = truth[row["item_id"]] if row["side"] == "control" else None
        store.record(who, "answerability", row["unit"], {"answer": answer})
print(units.groupby(["dataset", "side"]).size().loc[["occlusion", "chaotic"]].tolist())
"""
NOTE = """
import sys
from pathlib import Path
from traps_pipeline.people.recorded_certificates import certification_note
from traps_pipeline.storage.workspace import Workspace
print(certification_note(Workspace.open(Path(sys.argv[1])).tables))
"""
FIGURES = """
import json
import sys
from pathlib import Path
from matplotlib.text import Text
from traps_pipeline.report.cards import Sources
from traps_pipeline.report.catalogue import FIGURE_REPORTS
from traps_pipeline.report.writing import NotRun
from traps_pipeline.storage.workspace import Workspace
study, said = Sources(Workspace.open(Path(sys.argv[1]))).study, []
for report in FIGURE_REPORTS:
    try:
        figure = report.figure(study)
    except NotRun:
        continue
    said.append(any("not certified" in text.get_text() for text in figure.findobj(Text)))
print(json.dumps(said))
"""


class Folder:
    """A folder with an imported benchmark and a study on it."""

    def __init__(self, root: Path) -> None:
        self.root, self.study = root, root / "study"
        self.benchmark, self.experiment = root / "balls", root / "experiment.yaml"
        self.experiment.write_text(EXPERIMENT, encoding="utf-8")

    def python(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"TRAPS_SCENE_SPECS": str(self.benchmark), "PYTHONPATH": str(ROOT)}
        command = [sys.executable, *map(str, arguments)]
        return subprocess.run(
            command, capture_output=True, text=True, env=environment, cwd=self.root, timeout=540, check=False
        )

    def traps(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        return self.python("-m", "traps_pipeline.cli", *arguments)

    def run(self, until: str) -> str:
        """Run the experiment; return what was printed."""
        done = self.traps("run", self.experiment, "--workspace", self.study, "--until", until)
        assert done.returncode == 0, done.stderr
        return done.stdout + done.stderr

    def note(self) -> str:
        return self.python("-W", "ignore", "-c", NOTE, self.study).stdout

    def figures(self) -> set[bool]:
        """Return whether the figures say that pairs are not certified."""
        printed = self.python("-W", "ignore", "-c", FIGURES, self.study)
        said = json.loads(printed.stdout)
        assert len(said) >= 2, printed.stderr
        return {*said}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Folder:
    root = tmp_path_factory.mktemp("recorded")
    made = Folder(root)
    done = made.traps("benchmark", "import", balls(root / "videos", 6, events=1), "--out", made.benchmark)
    assert done.returncode == 0, done.stderr
    return made


def test_recorded_pairs_are_asked_certified_corrected_and_released(folder: Folder) -> None:
    assert "64 answers asked" in folder.run("two_way")  # 2 models, 6 scenarios of 4 items, and one of 8
    folder.run("leaderboard")
    assert "not certified: 0 of 7" in folder.note()
    assert folder.figures() == {True}
    sampled = folder.python("-W", "ignore", "-c", LABEL, folder.study, *PEOPLE)
    assert sampled.stdout.strip() == "[3, 3, 3, 3]", sampled.stderr  # every clip, on both sides
    assert "0 answers asked" in folder.run("human_row")
    assert "all 7 certified" in folder.note()
    assert folder.figures() == {False}

    decision = {"scenario_id": "balls-0002", "action": "correct", "question": "Where does it go, left or right?"}
    corrections = folder.benchmark / "corrections"
    corrections.mkdir()
    line = decision | {"who": "jd", "when": "2026-11-28", "why": "plainer"}
    (corrections / "review.jsonl").write_text(json.dumps(line) + "\n", encoding="utf-8")
    assert "6 answers asked" in folder.run("human_row")  # of 2 models: all but the ill-posed void
    assert "not certified: 6 of 7" in folder.note()

    released = folder.root / "released"
    done = folder.traps("publish", "release", released, "--workspace", folder.study)
    assert done.returncode == 0, done.stderr
    assert folder.traps("publish", "verify", released).returncode == 0
    pairs = [json.loads(line) for line in (released / "metadata.jsonl").read_text().splitlines()]
    assert {(row["licence"], row["source"]) for row in pairs} == {("CC0-1.0", "filmed in a test")}
    assert len(pairs) == 12
    certificates = [json.loads(line) for line in (released / "certificates.jsonl").read_text().splitlines()]
    assert [row["scenario_id"] for row in certificates if not row["holds"]] == ["balls-0002"]


@pytest.mark.parametrize(
    "arguments",
    [
        ("benchmark", "certify"),
        ("benchmark", "commit", "balls", "--out", "a.json", "--reveal", "b.json"),
        ("run", "observer.yaml", "--workspace", "other"),
        ("run", "arms.yaml", "--workspace", "other"),
    ],
)
def test_what_needs_physics_says_once_that_it_is_not_for_recorded_pairs(
    folder: Folder, arguments: tuple[str, ...]
) -> None:
    (folder.root / "observer.yaml").write_text(EXPERIMENT.replace("oracle", "observer"), encoding="utf-8")
    (folder.root / "arms.yaml").write_text(EXPERIMENT.replace("two_events", "twin_control"), encoding="utf-8")
    done = folder.traps(*arguments)
    assert done.returncode == 1
    assert (done.stdout + done.stderr).count("not for recorded pairs") == 1


def test_a_parameter_of_a_recorded_pair_cannot_be_corrected(folder: Folder) -> None:
    path = folder.benchmark / "corrections" / "a.jsonl"
    path.parent.mkdir(exist_ok=True)
    line = {"scenario_id": "balls-0001", "action": "correct", "params": {"size": [9, 9]}}
    path.write_text(json.dumps(line | {"who": "jd", "when": "2026-11-28", "why": "no"}) + "\n", encoding="utf-8")
    done = folder.traps("status", "--workspace", folder.study)
    path.unlink()
    assert done.returncode == 1
    assert "recorded pairs have no parameters" in done.stderr


def test_a_submission_on_recorded_pairs_holds(folder: Folder) -> None:
    folder.run("leaderboard")
    packed = folder.root / "mine.zip"
    done = folder.traps("publish", "submit", packed, "--name", "lab", "--workspace", folder.study)
    assert done.returncode == 0, done.stderr
    assert folder.traps("publish", "verify", packed).returncode == 0
