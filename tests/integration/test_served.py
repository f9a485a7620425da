"""A row of a model behind a server that nobody here wrote: an address in the experiment, and no code."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.conftest import ROOT, SMALL, Checkout
from tests.providers.server import Provider
from tests.serving import transformers_serve
from traps_pipeline.scoring.score_rows import LEADERBOARD
from traps_pipeline.storage.workspace import Workspace

pytestmark = pytest.mark.slow
WEIGHTS = ROOT / "assets" / "pocket" / "weights"


def test_the_pocket_model_behind_transformers_serve_gets_a_row(
    unasked: Checkout, provider: Provider, tmp_path: Path
) -> None:
    judges = "".join(f'  - {{id: judge-{k}, base_url: "{provider.url}/v1"}}\n' for k in "abc")
    path = tmp_path / "served.yaml"
    with transformers_serve(WEIGHTS, tmp_path) as url:
        path.write_text(
            f"name: served\nmodels:\n  - id: served\n    base_url: {url}\n    served_name: {WEIGHTS}\n"
            "    media: {profile: images, uniform: 8}\n    waivers: {media: it was trained with eight frames}\n"
            f"judges:\n{judges}panels: {{three: [judge-a, judge-b, judge-c]}}\n"
            f"regimes: [standard]\ndatasets: [occlusion]\n{SMALL.read_text()[SMALL.read_text().index('scenarios:') :]}"
        )
        # Without a preflight: this model knows the words of its own scenes alone, and not the preflight's.
        finished = unasked.traps("run", path, "--panel", "three", "--no-preflight", "--until", "leaderboard")
    assert finished.code == 0, finished.err
    answers = unasked.ledger_rows("answers")
    assert len(answers) == 12 and {row["served_model"] for row in answers} == {f"{WEIGHTS}@main"}
    assert any(row["outcome"] == "answer" for row in answers)
    tables = Workspace.open(unasked.workspace).tables
    (row,) = tables.read(LEADERBOARD, {}).query("model == 'served' and dataset == 'occlusion'").to_dict("records")
    assert str(row["panel"]).startswith("three@") and row["n_missing"] < len(answers)
