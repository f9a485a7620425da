"""Declare settings that entries share or repeat: limits of calls, an account, prices, groups."""

from __future__ import annotations

import datetime

from pydantic import BaseModel, ConfigDict, Field, model_validator

from traps_pipeline.base.keys import Address, Variable, read_key
from traps_pipeline.base.redaction import redact_environment_variable


class Limits(BaseModel):
    """The limits of calls to a participant; none of them is in the ledger key."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    concurrency: int = Field(default=24, ge=1, description="calls at once")
    retries: int = Field(default=5, ge=0, description="of a call that failed and may succeed later")
    backoff_s: float = Field(default=1.0, gt=0, description="first wait; doubles with each retry, full jitter")
    timeout_s: float = Field(default=600.0, gt=0, description="of one attempt; backend local has a day by default")


class Account(BaseModel):
    """The settings that calls share: key variable, address, calls and tokens a minute."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    key: Variable | None = Field(default=None, description="environment variable of the key")
    base_url: Address | None = Field(default=None, description="of an OpenAI-compatible endpoint")
    batch_price: float = Field(
        default=1.0, gt=0, le=1, description="price of a call in a batch, relative to a live one"
    )
    requests_per_minute: int | None = Field(default=None, ge=1, description="null: no limit here")
    tokens_per_minute: int | None = Field(default=None, ge=1, description="null: no limit here")

    @model_validator(mode="after")
    def _is_redacted(self) -> Account:
        if self.key is not None:
            redact_environment_variable(self.key)
        return self

    def secret(self) -> str | None:
        """Return the key from the environment, None if unneeded. Raises TrapsError."""
        return read_key(self.key) if self.key is not None else None


class Prices(BaseModel):
    """Dollars per million tokens on a date; completion tokens include reasoning."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    input: float = Field(ge=0, description="of the prompt")
    output: float = Field(ge=0, description="of the answer, with its reasoning")
    as_of: datetime.date = Field(description="day on which the provider asked them")

    def cost(self, prompt_tokens: float, completion_tokens: float) -> float:
        """Return the cost of a call in dollars."""
        return (prompt_tokens * self.input + completion_tokens * self.output) / 1e6


class Groups(BaseModel):
    """The groups of a model in the paper, by which tables select rows."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    family: str
    access: str
    input: str
    group: str
