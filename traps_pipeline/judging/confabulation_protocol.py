"""Read the confabulation protocol (`assets/confabulation.yaml`): samples, judges.

Nothing here asks a judge: `traps status` reads the protocol's digest, and the study's partitions follow its models.
"""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.yamlfile import name_file_in_errors, parse_yaml_model, read_yaml
from traps_pipeline.models.registry.entries import NETWORK, get_model
from traps_pipeline.models.registry.judges import JudgeEntry, load_judges
from traps_pipeline.models.registry.prompts import load_prompt
from traps_pipeline.models.registry.schemas import structured_output
from traps_pipeline.protocol.cells import Cell, Evaluation
from traps_pipeline.protocol.datasets import DATASETS
from traps_pipeline.protocol.ratings import AXES
from traps_pipeline.protocol.regimes import REGIMES

PROTOCOL_FILE = ASSETS / "confabulation.yaml"
TASK = "confabulation"
# The parts of a failure's id, which people's labels refer to: another answer is another failure. They are in the
# protocol's digest, so that the table is rebuilt when the parts change.
SAMPLED = ("cell", "item", "answer", "trace that the judge sees")
SCHEMA = structured_output(TASK, **{axis: {"type": "boolean"} for axis in AXES}, rationale={"type": "string"})
TRACE_AND_OUTPUT, OUTPUT = "trace_and_output", "output"
Evidence = Literal["trace_and_output", "output"]
VOID_KINDS: Mapping[str, str] = {
    "occluder": "an opaque wall hides the place where the outcome could be seen",
    "truncation": "the clip ends before the outcome is decided",
    "question": "the clip shows the whole event, but the question asks for what the clip cannot show, or takes for "
    "granted something that is not in it",
}


class Validation(BaseModel):
    """The selection of labelled failures that two people label too."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1)
    models: list[str] = Field(min_length=1)


class Protocol(BaseModel):
    """The contents of `assets/confabulation.yaml`: how failures are sampled, and each panel's judge."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    n: int = Field(ge=1, description="failures per model; all if there are fewer")
    seed: int
    regime: str = Field(pattern=f"^({'|'.join(REGIMES)})$")
    run: int = Field(ge=1)
    judges: dict[str, str] = Field(description="judge by panel; for a panel that is not here nothing is labelled")
    models: dict[str, Evidence] = Field(min_length=1)
    validation: Validation

    def cells(self, model: str) -> list[Cell]:
        """Return the cells (dataset, and model under a regime in a run) whose failures are sampled."""
        return [Cell(dataset, Evaluation(model, self.regime, self.run)) for dataset in DATASETS]

    def judge(self, panel: str) -> JudgeEntry | None:
        """Return the entry of the judge that labels for this panel; None if the panel has none."""
        name = self.judges.get(panel)
        return load_judges()[name] if name is not None else None


@cache
def load_protocol(path: Path = PROTOCOL_FILE) -> Protocol:
    """Return the protocol. Raises TrapsError naming file and field, model or judge."""
    protocol = parse_yaml_model(Protocol, read_yaml(path), path)
    with name_file_in_errors(path):
        runs = {model: get_model(model).runs for model in protocol.models}
    for model, n_runs in runs.items():
        if protocol.run > n_runs:
            raise TrapsError(f"{path}: run is {protocol.run}, but {model} has only {n_runs} runs")
    unknown_models = [model for model in protocol.validation.models if model not in protocol.models]
    if unknown_models:
        raise TrapsError(f"{path}: validation.models: {', '.join(unknown_models)} must be among `models`")
    for panel, name in protocol.judges.items():
        judge = load_judges().get(name)
        if judge is None or judge.backend != NETWORK:
            judge_names = ", ".join(entry.id for entry in load_judges().values() if entry.backend == NETWORK)
            raise TrapsError(f"{path}: judges.{panel} is {name!r}; it must be a judge over the network: {judge_names}")
    return protocol


def protocol_digest(panel: str) -> str:
    """Return the digest of all that decides a panel's labels except the answers."""
    protocol = load_protocol()
    judge = protocol.judge(panel)
    call = (
        [judge.id, judge.provider_id, judge.params, SCHEMA, load_prompt(f"judge_{TASK}"), VOID_KINDS] if judge else None
    )
    call = [*call, *judge.thinking] if call and judge and judge.thinking else call
    return digest([protocol.model_dump(exclude={"judges"}), call, SAMPLED])[:16]
