"""`assets/models.yaml`: every model that can be evaluated. Adding one is one entry, no code."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from traps_pipeline.errors import TrapsError
from traps_pipeline.partitions import Evaluation, check_slug, evaluations
from traps_pipeline.paths import ASSETS
from traps_pipeline.yamlfile import parse_yaml_model, read_yaml

MODELS_FILE = ASSETS / "models.yaml"


class Limits(BaseModel):
    """How a participant is asked; none of it is in the ledger key."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    concurrency: int = Field(default=24, ge=1)
    retries: int = Field(default=5, ge=0)
    backoff_s: float = Field(default=1.0, gt=0, description="first wait; doubles with each retry, full jitter")


class Groups(BaseModel):
    """Groups of the paper that tables select by."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    family: str
    access: str
    input: str
    group: str


class ModelEntry(BaseModel):
    """One model configuration."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    id: str
    backend: Literal["reference", "observer"]
    params: dict[str, Any] = Field(default_factory=dict, description="exactly what is sent; part of the ledger key")
    runs: int = Field(default=3, ge=1, le=9)
    limits: Limits = Limits()
    groups: Groups

    @field_validator("id")
    @classmethod
    def _slug(cls, value: str) -> str:
        return check_slug(value)

    @model_validator(mode="after")
    def _known_strategy(self) -> ModelEntry:
        from traps_pipeline.models.reference import STRATEGIES

        if self.backend == "reference" and self.params.get("strategy") not in STRATEGIES:
            known = ", ".join(STRATEGIES)
            raise ValueError(f"params.strategy is {self.params.get('strategy')!r}; known strategies: {known}")
        return self


@cache
def load_models(path: Path = MODELS_FILE) -> dict[str, ModelEntry]:
    """Entries by id, in file order. Raises TrapsError naming entry and field."""
    data = read_yaml(path)
    entries = data.get("models") if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise TrapsError(f"{path}: must hold a list `models:`")
    models: dict[str, ModelEntry] = {}
    for number, raw in enumerate(entries, start=1):
        name = raw.get("id", "?") if isinstance(raw, dict) else "?"
        entry = parse_yaml_model(ModelEntry, raw, path, f"model {number} ({name})")
        if entry.id in models:
            raise TrapsError(f"{path}: model {number}: id {entry.id!r} occurs twice")
        models[entry.id] = entry
    return models


def get_model(model_id: str) -> ModelEntry:
    """The entry of that id. Raises TrapsError with the known ids."""
    models = load_models()
    if model_id not in models:
        raise TrapsError(f"unknown model {model_id!r}; {MODELS_FILE} has {', '.join(models)}")
    return models[model_id]


@cache
def all_evaluations() -> tuple[Evaluation, ...]:
    """The second partition dimension: every model, regime and run of the registry."""
    return tuple(evaluations((entry.id, entry.runs) for entry in load_models().values()))
