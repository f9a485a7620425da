"""What an entry of the registry says about a local model; nothing heavy is imported here."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

Dtype = Literal["float32", "bfloat16", "float16"]
Quantisation = Literal["none", "nf4"]
SPREAD = "auto"  # device of a model that is spread over all GPUs of the process, or lies on the CPU without any
DEVICE = r"^(cpu|mps|auto|cuda(:\d+)?)$"


class LocalParams(BaseModel):
    """`params` of an entry with backend local: all of it decides an answer, so all of it is in the ledger key.

    checkpoint: hub id, or a folder (absolute, or relative to the checkout). revision: the hub's commit. template:
    variables of the chat template. video: options of the checkpoint's video processor. nf4_skip: modules left as they
    are; by default the library chooses.
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
        declared = [name for name in ("temperature", "top_p") if getattr(self, name) is not None]
        if self.do_sample and len(declared) != 2:
            raise ValueError("do_sample: true needs temperature and top_p (1.0 for all tokens)")
        if not self.do_sample and declared:
            raise ValueError(f"do_sample: false is greedy, and {declared[0]} has no effect; leave it out")
        if self.nf4_skip and self.quantisation != "nf4":
            raise ValueError("nf4_skip goes with quantisation: nf4")
        return self


class NetworkSize(BaseModel):
    """The size of a network, for `traps plan`. parameters_b: in billions. layers, width: of the language model."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    parameters_b: float = Field(gt=0)
    layers: int = Field(ge=1)
    width: int = Field(ge=1)


class MechanismSpec(BaseModel):
    """How a model is loaded to look inside (docs/spec.md 7.1), where that differs from how it answers.

    quantisation, with its nf4_skip: None is that of `params`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    quantisation: Quantisation | None = None
    nf4_skip: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _skips_are_of_nf4(self) -> MechanismSpec:
        if self.nf4_skip and self.quantisation != "nf4":
            raise ValueError("nf4_skip goes with quantisation: nf4 in the same section")
        return self

    def inside(self, params: LocalParams) -> LocalParams:
        """Return the parameters that the model is looked into with."""
        if self.quantisation in (None, params.quantisation) and not self.nf4_skip:
            return params
        return params.model_copy(update={"quantisation": self.quantisation, "nf4_skip": self.nf4_skip})
