"""Define a local model's settings in the registry, without heavy imports."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Dtype = Literal["float32", "bfloat16", "float16"]
Quantisation = Literal["none", "nf4"]
SPREAD = "auto"  # device: spread over all GPUs of the process, or on the CPU without any
DEVICE = r"^(cpu|mps|auto|cuda(:\d+)?)$"


class LocalParams(BaseModel):
    """The `params` of an entry with backend local.

    Everything here decides an answer and is in the ledger key.

    checkpoint: hub id, or a folder (absolute, or relative to the checkout). revision: the hub's commit. template:
    variables of the chat template. video: options of the checkpoint's video processor. nf4_skip: modules left
    unquantised; by default the library chooses.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    checkpoint: str = Field(min_length=1)
    revision: str | None = None
    dtype: Dtype
    quantisation: Quantisation
    nf4_skip: tuple[str, ...] = ()
    attn_implementation: Literal["eager", "sdpa", "flash_attention_2"] = "sdpa"
    do_sample: bool
    temperature: float | None = Field(default=None, gt=0)
    top_p: float | None = Field(default=None, gt=0, le=1)
    max_new_tokens: int = Field(ge=1)
    template: dict[str, Any] = {}
    video: dict[str, Any] = {}

    @model_validator(mode="after")
    def _sampling_is_whole(self) -> LocalParams:
        sampling_names = [name for name in ("temperature", "top_p") if getattr(self, name) is not None]
        if self.do_sample and len(sampling_names) != 2:
            raise ValueError("do_sample: true needs temperature and top_p (1.0 for all tokens)")
        if not self.do_sample and sampling_names:
            raise ValueError(f"do_sample: false is greedy, and {sampling_names[0]} has no effect; leave it out")
        if self.nf4_skip and self.quantisation != "nf4":
            raise ValueError("nf4_skip goes with quantisation: nf4")
        return self


class NetworkSize(BaseModel):
    """A network's billions of parameters, and its language model's layers and width."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    parameters_b: float = Field(gt=0)
    layers: int = Field(ge=1)
    width: int = Field(ge=1)


class MechanismSpec(BaseModel):
    """Overrides of a local model's settings for mechanistic analyses (docs/spec.md 7.1); None: as in `params`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    quantisation: Quantisation | None = None
    nf4_skip: tuple[str, ...] = ()
    random_weights: bool = Field(
        default=True, description="also read the network with random weights, twice; false: claims lack it"
    )

    @model_validator(mode="after")
    def _skips_are_of_nf4(self) -> MechanismSpec:
        if self.nf4_skip and self.quantisation != "nf4":
            raise ValueError("nf4_skip goes with quantisation: nf4 in the same section")
        return self

    def inside(self, params: LocalParams) -> LocalParams:
        """Return the model's parameters with the overrides."""
        if self.quantisation in (None, params.quantisation) and not self.nf4_skip:
            return params
        return params.model_copy(update={"quantisation": self.quantisation, "nf4_skip": self.nf4_skip})
