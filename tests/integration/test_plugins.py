"""Packages that add a scene family, a model and a judge are installed, used, recorded, and named where they fail."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from tests.build.packages import install, write_package
from tests.conftest import ROOT, Checkout

pytestmark = pytest.mark.slow

PARROT = """
from traps_pipeline.models.request import Outcome


class Parrot:
    async def ask(self, request):
        assert not request.secret
        return Outcome("answer", text=f"I saw {request.sent.path.suffix if request.sent else 'nothing'}: yes")


class Nodding:
    async def ask(self, request):
        abstained = '{"abstained": false, "confidence": "high", "reasoning": "-"}'
        correct = '{"correct": true, "extracted_value": "yes", "reasoning": "-"}'
        return Outcome("answer", text=abstained if request.about["task"] == "abstention" else correct)


def parrot(entry):
    return Parrot()


def nodding(entry):
    return Nodding()


def broken(entry):
    raise OSError("no such bird")


class Odd:
    def __init__(self, answer):
        self.answer = answer

    async def ask(self, request):
        return self.answer()


def mute(entry):
    return Odd(lambda: None)


def failing(entry):
    return Odd(lambda: entry.wings)


def negative(entry):
    return Odd(lambda: Outcome("answer", text="yes", cost_usd=-1000.0))
"""
EXPERIMENT = """
name: birds
models:
  - {id: polly, backend: parrot, runs: 1, media: {profile: images, fps: 5, most: 4}}
judges:
  - {id: nodder, backend: nodding}
panels: {rules-nod: [nodder]}
panel: rules-nod
judged_by_rules: true
regimes: [standard]
scenarios: [domino_chain-0001]
"""


@pytest.fixture
def packaged(tmp_path: Path) -> Checkout:
    """A checkout on whose path packages can be installed."""
    root = tmp_path / "checkout"
    root.mkdir()
    for name in ("traps_pipeline", "assets", "scene_specs", "pyproject.toml", "docs"):
        (root / name).symlink_to(ROOT / name)
    return Checkout(root, tmp_path / "own")


def test_a_family_from_a_package_is_drawn_and_its_record_names_the_package(packaged: Checkout, tmp_path: Path) -> None:
    install(ROOT / "docs" / "plank_post", packaged.root)
    assert "plank_post (plank-post 1.0)" in packaged.traps("doctor").out
    trial = tmp_path / "trial"
    command = ("benchmark", "sample", "--families", "plank_post", "--count", "1", "--seed", "1")
    packaged.traps(*command, "--out", trial).ok()
    (record,) = map(json.loads, (trial / "released" / "plank_post.jsonl").read_text().splitlines())
    assert record["evidence"]["package"] == "plank-post 1.0"
    for path in [*packaged.root.glob("plank_post*")]:
        path.rename(tmp_path / path.name)
    missing = packaged.traps("benchmark", "certify", "--families", "plank_post", "--specs", trial)
    assert missing.code != 0 and "plank_post" in missing.err and "Traceback" not in missing.err


def test_a_model_and_a_judge_from_a_package_are_asked_and_their_rows_name_its_version(
    packaged: Checkout, tmp_path: Path
) -> None:
    points = {"models": 'parrot = "birds:parrot"', "judges": 'nodding = "birds:nodding"'}
    install(write_package(tmp_path / "birds", "birds", PARROT, **points), packaged.root)
    (tmp_path / "birds.yaml").write_text(EXPERIMENT)
    first = packaged.score(tmp_path / "birds.yaml").ok()
    assert first.counts()["answers"] == 4  # a control and a void of two datasets
    responses = pd.read_parquet(packaged.workspace / "tables" / "responses")
    assert responses["text"].str.fullmatch(r"I saw \.\w+: yes").all()
    for kind, endpoint in (("answers", "parrot (birds 1.2)"), ("votes", "nodding (birds 1.2)")):
        assert {row["components"]["endpoint"] for row in packaged.ledger_rows(kind)} == {endpoint}
    assert packaged.score(tmp_path / "birds.yaml").ok().counts()["answers"] == 0


@pytest.mark.parametrize(
    ("point", "named"),
    [
        ('parrot = "birds:gone"', "gone"),
        ('parrot = "nowhere:parrot"', "nowhere"),
        ('parrot = "birds:broken"', "no such bird"),
        ('parrot = "birds:Parrot.ask"', "birds 1.2"),
        ('parrot = "birds:mute"', "None"),
        ('parrot = "birds:failing"', "wings"),
        ('parrot = "birds:negative"', "cost_usd"),
        ('parrot = "birds:parrot"\nreference = "birds:parrot"', "reference"),
    ],
)
def test_a_package_whose_backend_fails_is_named_with_the_way_out(
    packaged: Checkout, tmp_path: Path, point: str, named: str
) -> None:
    install(write_package(tmp_path / "birds", "birds", PARROT, models=point), packaged.root)
    (tmp_path / "birds.yaml").write_text(EXPERIMENT.replace("nodding", "rule"))
    refused = packaged.score(tmp_path / "birds.yaml")
    assert refused.code != 0 and "Traceback" not in refused.err
    assert "birds 1.2" in refused.err and named in refused.err and "pip uninstall birds" in refused.err


def test_a_backend_that_no_package_adds_is_told_with_the_nearest_name(packaged: Checkout, tmp_path: Path) -> None:
    (tmp_path / "birds.yaml").write_text(EXPERIMENT.replace("parrot", "refrence").replace("nodding", "rule"))
    refused = packaged.score(tmp_path / "birds.yaml")
    assert refused.code != 0 and "did you mean reference" in refused.err and "Traceback" not in refused.err


def test_two_packages_of_one_family_are_told_apart(packaged: Checkout, tmp_path: Path) -> None:
    for name in ("one", "two"):
        install(write_package(tmp_path / name, name, "FAMILY = None\n", families=f'swing = "{name}"'), packaged.root)
    refused = packaged.traps(
        "benchmark", "sample", "--families", "swing", "--count", "1", "--seed", "1", "--out", tmp_path
    )
    assert refused.code != 0 and "one 1.2" in refused.err and "two 1.2" in refused.err
