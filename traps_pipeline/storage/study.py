"""Define `study.yaml`: benchmark, experiments, budget and mechanistic analyses."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from traps_pipeline.base.names import Name, check_name
from traps_pipeline.protocol.datasets import is_ill_posed
from traps_pipeline.protocol.regimes import PROBE_PROMPT, VQA_PROMPTS
from traps_pipeline.storage.media import MediaSpec

FORMAT = 1  # version of a workspace's format
Regime = Annotated[str, Field(pattern=f"^({'|'.join(VQA_PROMPTS)})$")]


class Settings(BaseModel):
    """Base of settings that people write: it refuses unknown fields, and lists that name something twice."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*")
    @classmethod
    def _require_unique(cls, value: Any) -> Any:
        members = [*map(repr, value)] if isinstance(value, list | tuple) else []
        if twice := sorted({member for member in members if members.count(member) > 1}):
            raise ValueError(f"{', '.join(twice[:5])} is named twice; leave one out")
        return value


# --- what is asked inside local models --------------------------------------------------------------------------------


class Layers(Settings):
    """A model's layers as in hidden_states: 0 = embeddings, l = output of block l."""

    steering: int = Field(ge=1, description="block whose output is steered")
    centroid: int = Field(ge=0, description="of the nearest centroid")
    sweep: tuple[Annotated[int, Field(ge=1)], ...] = Field(default=(), description="further layers for the sweep")
    media: MediaSpec | None = Field(
        default=None, description="how clips are shown where the model is looked into; null: as where it answers"
    )


class ProbeSettings(Settings):
    """How probes are fitted and resampled (docs/spec.md 7)."""

    folds: int = Field(default=5, ge=2, description="scenarios of a fold are held out together")
    shuffles: int = Field(default=20, ge=20, description="with fewer the mean says little")
    resamples: int = Field(default=1000, ge=100, description="of intervals")
    prompts: tuple[Regime, ...] = Field(
        default=(PROBE_PROMPT,), description="VQA prompts; others than standard are for what a prompt changes alone"
    )


class NullSettings(Settings):
    """The number of null directions of each kind against which an effect is ranked.

    They are steered at every alpha and the largest gap on the datasets that they come from.
    """

    kinds: tuple[Literal["isotropic", "covariance", "shuffled"], ...] = Field(
        default=("covariance",), description="how null directions are drawn"
    )
    draws: int = Field(default=20, ge=1, description="19 are the fewest with which p can reach .05")


class SteeringSettings(Settings):
    """The settings of steering (docs/spec.md 8.2)."""

    alphas: tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...] = Field(
        default=(2, 5, 10), min_length=1, description="doses in units of the unit direction"
    )
    pairs: int = Field(
        default=50, ge=1, description="pairs a cell; none is steered along a direction that comes from its scenario"
    )
    well_posed_pairs: int = Field(default=100, ge=2, description="pairs that a well-posed direction comes from")
    ill_posed_pairs: int = Field(default=50, ge=2, description="pairs that an ill-posed direction comes from")
    direction_regimes: tuple[Regime, ...] = Field(
        default=(PROBE_PROMPT,), min_length=1, description="prompts of the states that directions come from"
    )
    inference_regimes: tuple[Regime, ...] = Field(
        default=("guided",), min_length=1, description="prompts of the steered answers"
    )
    gaps: tuple[Annotated[float, Field(gt=0, allow_inf_nan=False)], ...] = Field(
        default=(0.5, 1, 2, 4), description="further doses, in units of the distance between the sides' means there"
    )
    cap: float = Field(
        default=2.0, gt=0, description="longest dose in gaps, in mean lengths of control states; no longer one is given"
    )
    signs: tuple[Literal["plus", "minus"], ...] = Field(
        default=("plus", "minus"), description="policies beside the paper's, which knows each item's side"
    )
    nulls: NullSettings | None = Field(default=NullSettings(), description="null: no null directions")
    max_new_tokens: int = Field(default=512, ge=1, description="of a steered answer")

    def direction_pairs(self, dataset: str) -> int:
        """Return the maximum number of pairs behind a dataset's directions."""
        return self.ill_posed_pairs if is_ill_posed(dataset) else self.well_posed_pairs

    @field_validator("alphas", "gaps")
    @classmethod
    def _check_ascending(cls, values: tuple[float, ...]) -> tuple[float, ...]:
        if list(values) != sorted(set(values)):
            raise ValueError(f"{values} must ascend; alpha 0, the unsteered model, is always there")
        return values


class GateSettings(Settings):
    """The settings of probe-gated abstention (docs/mechanism.md)."""

    false_abs: float = Field(default=0.05, gt=0, lt=1, description="of source controls, that conformal gates promise")


class PatchingSettings(Settings):
    """The settings of activation patching between controls and voids."""

    pairs: int = Field(default=50, ge=1, description="pairs of each well-posed dataset, the first of a seeded order")
    sites: tuple[Literal["residual", "attention", "mlp"], ...] = Field(
        default=("residual", "attention", "mlp"), min_length=1, description="what is patched in a block"
    )
    exact: int = Field(
        default=24, ge=1, description="cells of each direction that are patched: those with the largest estimates"
    )
    stride: int = Field(default=4, ge=1, description="these lie at every so many layers, and at the last one")
    prompt: Regime = Field(
        default=PROBE_PROMPT, description="VQA prompt of the passes; one under which the output tells the sides"
    )


class MechanismSettings(Settings):
    """The section `mechanism:` of experiments and `study.yaml`: models and layers."""

    models: dict[str, Layers] = Field(min_length=1, description="local models, with the layers to look at")
    prompts: tuple[Regime, ...] = Field(default=VQA_PROMPTS, min_length=1, description="VQA prompts extracted")
    probes: ProbeSettings = Field(default=ProbeSettings(), description="how probes are fitted")
    gate: GateSettings = Field(default=GateSettings(), description="abstention by a probe")
    patching: PatchingSettings | None = Field(default=None, description="null: nothing is patched")
    sentences: tuple[str, ...] = Field(
        default=(
            "I don't know: this cannot be determined from the video.",
            "I cannot tell from the video.",
            "It is not possible to determine this from the video.",
        ),
        description="abstentions whose log-probability is read behind every item, a pass each; []: none",
    )
    system: Literal["vqa", "benchmark"] = Field(
        default="vqa", description="system prompts of extraction: the short VQA ones, or the benchmark's own"
    )
    pooling: Literal["last", "answer", "mean", "visual", "changed", "unchanged", "stamps", "question"] = Field(
        default="last", description="of tokens; the paper does not say which"
    )
    steering: SteeringSettings | None = Field(default=SteeringSettings(), description="null: nothing is steered")
    seed: int = Field(default=20260101, description="of draws, folds and samples")

    @model_validator(mode="after")
    def _prompts_are_extracted(self) -> MechanismSettings:
        missing = set(self.steering.direction_regimes if self.steering else ()) - set(self.prompts)
        if missing:
            raise ValueError(f"steering.direction_regimes: {sorted(missing)} are not among the prompts {self.prompts}")
        missing_prompts = {*self.probes.prompts} - {*self.prompts, PROBE_PROMPT}
        if missing_prompts:
            raise ValueError(f"probes.prompts: {sorted(missing_prompts)} are not among the prompts {self.prompts}")
        return self

    @field_validator("models")
    @classmethod
    def _slugs(cls, values: dict[str, Any]) -> dict[str, Any]:
        return {check_name(name): layers for name, layers in values.items()}


# --- the study --------------------------------------------------------------------------------------------------------


class Asked(Settings):
    """One experiment's scenarios, and whether they get mechanistic analyses."""

    datasets: tuple[str, ...]
    models: tuple[str, ...]
    regimes: tuple[str, ...]
    runs: tuple[int, ...]
    mechanism: bool = False


class Study(Settings):
    """`study.yaml`: benchmark and subset, panel, budget and experiments.

    benchmark, scenarios and per_family are fixed when the workspace is created; panel, epoch and budget may be edited.
    No command and no button asks a model that `experiments` does not name.
    """

    format: int = Field(default=FORMAT, description="version of the workspace's format")
    name: str = Field(
        default="",
        pattern=r"^([a-z0-9-]+)?$",
        max_length=120,
        description="tells studies apart that share one Dagster history",
    )
    benchmark: str = Field(default="released", description="released, or the name of a private one")
    scenarios: list[str] | None = Field(default=None, min_length=1, description="named scenarios; all if absent")
    per_family: int | None = Field(default=None, ge=1, description="the first n scenarios of each family")
    panel: str = Field(default="", description="who judges; nothing is judged until one is named")
    judged_by_rules: bool = Field(default=False, description="rules may judge models, not reference strategies alone")
    epoch: str = Field(
        default="1",
        pattern=r"^[A-Za-z0-9_-]+([._-][A-Za-z0-9_-]+)*$",
        max_length=40,
        description="name of the campaign, kept beside every answer",
    )
    budget_usd: float = Field(default=0.0, ge=0.0, description="for all calls over the network, ever")
    model_budgets_usd: dict[str, Annotated[float, Field(ge=0.0)]] = Field(
        default={}, description="by model or judge, besides"
    )
    account_budgets: dict[str, str] = Field(
        default={}, description="by account, the folder of a budget that several studies share (docs/models.md)"
    )
    database: str | None = Field(
        default=None,
        pattern=r"^[A-Z][A-Z0-9_]*$",
        description="variable that holds the address of the PostgreSQL database with the ledger (docs/cluster.md)",
    )
    allow_unknown_prices: bool = Field(default=False, description="ask models without a price: no budget bounds them")
    mechanism: MechanismSettings | None = Field(default=None, description="what is asked inside local models")
    experiments: dict[Name, Asked] = Field(
        default={}, description="by name; written by `traps init` and `traps run`, remove one to ask no more for it"
    )

    @property
    def is_subset(self) -> bool:
        """Whether the study leaves out scenarios of its benchmark."""
        return self.scenarios is not None or self.per_family is not None

    @model_validator(mode="after")
    def _check_subset(self) -> Study:
        if self.scenarios is not None and self.per_family is not None:
            raise ValueError("give scenarios or per_family, not both")
        return self
