"""A study in an object store: hosts with scratch folders of their own make it together, and it is the study that one
machine makes in a folder."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from bench.equality import main as compare
from tests.conftest import ROOT, SMALL, Checkout, Finished
from tests.objectstore import S3
from tests.postgres import Postgres
from traps_cluster.bucket import object_name
from traps_cluster.objects import ObjectStore
from traps_pipeline.storage.workspace import DATABASE, Workspace

pytestmark = pytest.mark.slow
EXPERIMENT = SMALL.with_name("one_regime.yaml")
MODELS = ("confidence-noise", "oracle", "prior", "random-50")
ANSWERS = len(MODELS) * 2 * 2 * 12  # datasets of a taxonomy, sides, scenarios
ADDRESS = "s3://lab/one-regime"


@dataclass(frozen=True)
class Host:
    """A host of the study, with a scratch folder of its own."""

    scratch: Path

    def traps(self, *arguments: str | Path) -> Finished:
        own = {"TRAPS_WORKSPACE": ADDRESS, "TRAPS_SCRATCH": str(self.scratch), "PYTHONPATH": str(ROOT)}
        environment = {name: value for name, value in os.environ.items() if name != "DAGSTER_HOME"} | own
        command = [sys.executable, "-m", "traps_pipeline.cli", *map(str, arguments)]
        finished = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
        return Finished(finished.returncode, finished.stdout, finished.stderr)

    @property
    def root(self) -> Path:
        """Its folder for this study."""
        (folder,) = self.scratch.iterdir()
        return folder

    def files(self) -> list[Path]:
        """What it has of tables, clips and media."""
        return [path for kind in ("tables", "clips", "media") for path in (self.root / kind).rglob("*.*")]


@pytest.fixture
def hosts(s3: S3, postgres: Postgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Host]:
    monkeypatch.setenv(DATABASE, postgres.address())
    return [Host(tmp_path / name) for name in ("one", "two", "three")]


def opened(host: Host, monkeypatch: pytest.MonkeyPatch) -> tuple[Workspace, ObjectStore]:
    monkeypatch.setenv("TRAPS_SCRATCH", str(host.scratch))
    workspace = Workspace.open(ADDRESS)
    assert isinstance(workspace.store, ObjectStore)
    return workspace, workspace.store


def test_hosts_make_one_study_together_and_it_is_that_of_a_single_machine(
    hosts: list[Host], one_regime: Checkout, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two, three = hosts
    made = one.traps("init", EXPERIMENT)
    assert made.code == 0 and ADDRESS in made.out, made.out + made.err
    shutil.copytree(one_regime.workspace / "clips", one.root / "clips", dirs_exist_ok=True)  # not rendered again
    first = one.traps("run", EXPERIMENT, "--until", "items")
    assert (first.code, first.counts()["frames"]) == (0, 0), first.out + first.err

    rest = two.traps("run", EXPERIMENT, "--until", "leaderboard").ok()
    assert rest.counts() == {"answers": ANSWERS, "votes": rest.counts()["votes"], "frames": 0}
    stages = {row["stage"]: row["fresh"] for row in json.loads(three.traps("status", "--json").out)["stages"]}
    assert stages["leaderboard"] == 1

    workspace, store = opened(two, monkeypatch)
    store.bring(store.below(workspace.tables.root))
    assert compare(one_regime.workspace, workspace.root) == 0

    clips = [path for path in store.below(workspace.root / "clips") if "plinko-0001" in path.parent.name]
    assert len(clips) == 6  # control, void and twin, each with its note
    before = store.digests(clips)
    store.bucket.delete([object_name(bytes.fromhex(digest)) for digest in before.values()])
    again = three.traps("run", EXPERIMENT, "--until", "leaderboard").ok()
    assert again.counts()["frames"] > 0 and again.counts()["answers"] == 0
    _, store = opened(three, monkeypatch)
    again_there = store.digests(three.root / path.relative_to(workspace.root) for path in before)
    assert [*again_there.values()] == [*before.values()]
    nothing = one.traps("run", EXPERIMENT, "--until", "leaderboard")
    assert (nothing.code, nothing.counts()) == (0, {"answers": 0, "votes": 0, "frames": 0}), nothing.err
    ledger = workspace.answers
    assert ledger.evaluations() == [f"{m}__standard__run1" for m in MODELS]
    strays = [path for host in hosts for path in host.files() if not path.resolve().is_relative_to(host.scratch)]
    assert strays == []


def test_errors_name_the_host_the_study_and_the_remedy(
    hosts: list[Host], postgres: Postgres, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = hosts[0]
    monkeypatch.setenv(DATABASE, postgres.address(password="wrong"))
    refused = one.traps("init", EXPERIMENT)
    assert refused.code == 1 and "password authentication failed" in refused.err and DATABASE in refused.err
    monkeypatch.delenv(DATABASE)
    refused = one.traps("init", EXPERIMENT)
    assert refused.code == 1 and f"{DATABASE}=postgresql://" in refused.err
    monkeypatch.setenv(DATABASE, postgres.address())
    refused = one.traps("init", EXPERIMENT, "--workspace", "s3://no-such-bucket/study")
    assert refused.code == 1 and "s3://no-such-bucket/study" in refused.err and "AWS_ACCESS_KEY_ID" in refused.err
    one.traps("init", EXPERIMENT, "--workspace", "s3://lab/refusals").ok()
    for command in (("study", "move", "--store", "s3://lab/other"), ("people", "annotate", "--who", "jd")):
        refused = one.traps(*command, "--workspace", "s3://lab/refusals")
        assert refused.code == 1 and "s3://lab/refusals: " in refused.err, refused.err
    refused = one.traps("status", "--workspace", "ftp://lab/study")
    assert refused.code == 1 and "ftp://lab/study" in refused.err and "s3://BUCKET/STUDY" in refused.err
