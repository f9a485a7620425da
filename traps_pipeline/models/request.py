"""Define the two values that every backend handles: `Request -> Outcome`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from traps_pipeline.base.digests import digest
from traps_pipeline.base.redaction import redact

if TYPE_CHECKING:
    from traps_pipeline.storage.media import Media

OutcomeKind = Literal["answer", "truncated", "unfinished", "empty", "refused", "error", "malformed"]
WITH_TEXT: tuple[OutcomeKind, ...] = ("answer", "truncated")  # docs/models.md, "Request -> Outcome"
JUDGED_OUTCOMES: tuple[str, ...] = ("answer",)  # outcomes of `models.reading.interpret` that judges see
UNFINISHED = "unfinished"  # unknown finish reason: no answer, whatever its text says
RATE_LIMITED = "rate_limited"  # the kind of a 429
UNREACHABLE = "unreachable"  # the kind of a call that was never sent: no byte of it reached a server
MALFORMED = "malformed"  # the kind of a malformed answer
_VERBATIM = 600  # texts up to this length are stored verbatim in the key's components, for `traps why`


@dataclass(frozen=True)
class Request:
    """A complete call: all that decides the answer, and nothing else.

    participant: model or judge. endpoint: kind of backend. params: exactly what is sent. about: the item, model,
    regime, run (and task) of the call: repeated questions are calls of their own. secret: facts only for a reference
    model (side, ground truth) or a rule (the commonest answer). media is the clip, media_digest its identity in the
    key.
    """

    participant: str
    endpoint: str
    params: Mapping[str, Any]
    system: str
    user: str
    about: Mapping[str, str | int]
    media: Path | None = None
    sent: Media | None = None
    media_digest: str = ""
    secret: Mapping[str, Any] = field(default_factory=dict)

    @property
    def components(self) -> dict[str, Any]:
        """The parts of the ledger key: no code version, concurrency, time-out or API key."""
        parts: dict[str, Any] = {
            "participant": self.participant,
            "endpoint": self.endpoint,
            "params": dict(self.params),
            "system": digest(self.system)[:16],
            "user": self.user if len(self.user) <= _VERBATIM else digest(self.user),
            "media": self.media_digest,
            "about": dict(self.about),
        }
        return parts | ({"secret": dict(self.secret)} if self.secret else {})

    @cached_property
    def key(self) -> str:
        """The ledger key: a digest of all that the answer depends on."""
        return digest(self.components)


@dataclass(frozen=True)
class Outcome:
    """The result of a request; a failure is a kind, so no error text reaches a judge.

    finish_reason: as the provider sent it. client: library and version that built and sent the call. raw: the beginning
    of a malformed answer, for people. cost_usd: None if it is unknown. first_token: see `first_token.stored`.
    """

    kind: OutcomeKind
    text: str | None = None
    reasoning: str | None = None
    finish_reason: str | None = None
    error: str | None = None
    served_model: str | None = None
    client: str | None = None
    prompt_tokens: int | None = None
    completion_tokens: int | None = None
    reasoning_tokens: int | None = None
    cost_usd: float | None = None
    raw: str | None = None
    first_token: str | None = None

    def __post_init__(self) -> None:
        """Redact keys in the provider's texts, which may echo the request's headers."""
        for name in ("text", "reasoning", "finish_reason", "error", "served_model", "raw", "first_token"):
            value = getattr(self, name)
            if value:
                object.__setattr__(self, name, redact(value))


class TransientError(Exception):
    """Raised for a failure worth a retry: time-out, 408, 409, 429, 5xx, or a broken answer.

    billed: whether the provider may charge for it; cost_usd: the stated charge, if any, else the worst case counts;
    raw: see `Outcome`; why: what went wrong, or why a call was not sent, for people.
    """

    def __init__(
        self,
        kind: str,
        retry_after_s: float | None = None,
        *,
        billed: bool = True,
        cost_usd: float | None = None,
        raw: str | None = None,
        why: str = "",
    ) -> None:
        super().__init__(kind)
        self.kind, self.retry_after_s, self.billed, self.raw, self.why = kind, retry_after_s, billed, raw, why
        self.cost_usd = cost_usd

    @property
    def outcome(self) -> Outcome:
        """The outcome to record if there is no retry left."""
        return Outcome("malformed" if self.kind == MALFORMED else "error", error=self.kind, raw=self.raw)


class Backend(Protocol):
    """A backend, which answers requests of one participant."""

    async def ask(self, request: Request) -> Outcome:
        """Make one attempt. Raises TransientError to retry; other failures are Outcomes."""
        ...
