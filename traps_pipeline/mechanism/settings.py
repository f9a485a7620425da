"""What an experiment asks of the mechanistic stages; it becomes part of the study, which every run reads."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from traps_pipeline.partitions import VQA_PROMPTS, check_slug

Kind = Literal["void", "random", "shuffled"]
Regime = Literal["standard", "guided"]


class Layers(BaseModel):
    """Layers of one model, counted as in hidden_states: 0 = embeddings, l = output of the l-th block."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    steering: int = Field(ge=1, description="block whose output is steered")
    centroid: int = Field(ge=0, description="of the nearest centroid")
    sweep: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(), description="further layers for the sweep")


class ProbeSettings(BaseModel):
    """How probes are fitted and resampled (docs/spec.md 7)."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    solver: Literal["exact", "sklearn"] = "exact"
    folds: int = Field(default=5, ge=2)
    shuffles: int = Field(default=20, ge=20, description="with fewer the mean says little")
    resamples: int = Field(default=1000, ge=100)


class SteeringSettings(BaseModel):
    """What is steered (docs/spec.md 8.2)."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    alphas: tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...] = Field(default=(2, 5, 10), min_length=1)
    pairs: int = Field(default=50, ge=1, description="pairs a cell, the same scenarios for every cell of a taxonomy")
    well_posed_pairs: int = Field(default=100, ge=2, description="pairs that a well-posed direction comes from")
    ill_posed_pairs: int = Field(default=50, ge=2, description="pairs that an ill-posed direction comes from")
    direction_regimes: tuple[Regime, ...] = Field(default=VQA_PROMPTS, min_length=1)
    inference_regimes: tuple[Regime, ...] = Field(default=VQA_PROMPTS, min_length=1)
    controls: tuple[Literal["random", "shuffled"], ...] = ("random", "shuffled")
    max_new_tokens: int = Field(default=512, ge=1)

    @field_validator("alphas")
    @classmethod
    def _ascending(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if list(values) != sorted(set(values)):
            raise ValueError(f"{values} must ascend; alpha 0, the unsteered model, is always there")
        return values


class MechanismSettings(BaseModel):
    """`mechanism:` of an experiment and of `study.yaml`. models: the local models, and their layers."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    models: dict[str, Layers] = Field(min_length=1)
    prompts: tuple[Regime, ...] = Field(default=VQA_PROMPTS, min_length=1, description="VQA prompts extracted")
    probes: ProbeSettings = ProbeSettings()
    pooling: Literal["last", "mean"] = Field(default="last", description="of tokens; the paper does not say which")
    steering: SteeringSettings | None = SteeringSettings()
    seed: int = 20260101

    @model_validator(mode="after")
    def _directions_are_extracted(self) -> MechanismSettings:
        missing = set(self.steering.direction_regimes if self.steering else ()) - set(self.prompts)
        if missing:
            raise ValueError(f"steering.direction_regimes: {sorted(missing)} are not among the prompts {self.prompts}")
        return self

    @field_validator("models")
    @classmethod
    def _slugs(cls, values: dict[str, Any]) -> dict[str, Any]:
        return {check_slug(name): layers for name, layers in values.items()}
