"""What the mechanistic stages find in a pocket model, by training seed: the table that ships beside its weights."""

from __future__ import annotations

import json

from tools.pocket.claims import claimed
from tools.pocket.recipe import SHIPPED
from tools.pocket.seeds import Figure
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.mechanism.mechanism_rows import HIDDEN_STATES
from traps_pipeline.models.registry.checkpoint import as_folder, folder_digest
from traps_pipeline.protocol.regimes import VQA_PROMPTS
from traps_pipeline.storage.workspace import Workspace

FACTS = "training.json"  # beside the folder of the weights


def figures_of(workspace: Workspace) -> list[Figure]:
    """Return the figures of a finished workspace. Raises TrapsError if the seed of its weights is not known."""
    seed, weights = _seed_of(workspace, looked_into(workspace))
    return [Figure(seed, weights, *key, round(value, 6)) for key, value in claimed(workspace).items()]


def looked_into(workspace: Workspace) -> str:
    """Return which of the two models a workspace has states of. Raises TrapsError for none or both."""
    models = sorted({*workspace.tables.read_all(HIDDEN_STATES, ["model"])["model"]} & {*SHIPPED})
    if len(models) != 1:
        raise TrapsError(
            f"{workspace.root}: has hidden states of {' and '.join(models) or 'no pocket model'}; run an experiment "
            f"that looks into one of {', '.join(SHIPPED)} in a workspace of its own"
        )
    return models[0]


def _seed_of(workspace: Workspace, model: str) -> tuple[int, str]:
    """Return training seed and digest of the weights whose states a workspace has."""
    columns = ["checkpoint", "checkpoint_digest"]
    states = workspace.tables.read_all(HIDDEN_STATES, columns, model=model, prompt=VQA_PROMPTS)
    checkpoints = sorted(set(zip(states["checkpoint"], states["checkpoint_digest"], strict=True)))
    if len(checkpoints) != 1:
        raise TrapsError(
            f"{workspace.root}: has hidden states of {len(checkpoints)} checkpoints of {model}, but should have one; "
            "run `traps run mechanism` in a workspace of its own for each seed"
        )
    ((name, known),) = checkpoints
    folder = as_folder(name)
    if folder is None or not folder.is_dir() or folder_digest(folder) != known:
        raise TrapsError(
            f"{workspace.root}: was made with a checkpoint {name} ({known[:12]}), but that folder now has other "
            "weights or none; run `traps run mechanism` again with the weights of the seed"
        )
    facts = folder.parent / FACTS
    try:
        origin = json.loads(facts.read_text(encoding="utf-8"))
        return int(origin["seed"]), str(origin["weights"])[:12]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise TrapsError(
            f"{facts}: does not name the seed of these weights ({error}); `python -m tools.pocket train` writes it"
        ) from error
