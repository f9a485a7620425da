"""Read measured answer probabilities of graded cuts (docs/arms.md, "Graded cuts")."""

import json

from traps_pipeline.protocol.datasets import GRADED
from traps_pipeline.storage.benchmark_tables import ARMS
from traps_pipeline.storage.workspace import Workspace


def posteriors(workspace: Workspace) -> dict[str, dict[str, float]]:
    """Return the probabilities of possible answers to graded cuts, by scenario."""
    rows = workspace.tables.read_all(ARMS, ["scenario_id", "arm", "refused", "evidence"])
    rows = rows.loc[rows["arm"].eq(GRADED) & rows["refused"].isna()]
    return {
        scenario: json.loads(evidence)["posterior"]
        for scenario, evidence in zip(rows["scenario_id"], rows["evidence"], strict=True)
    }
