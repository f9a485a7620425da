"""Register models and accounts (`assets/models.yaml`); judges have the same form."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, ValidationInfo, field_validator, model_validator

from traps_pipeline.base.digests import digest
from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.keys import check_parameters
from traps_pipeline.base.names import Name
from traps_pipeline.base.paths import ASSETS
from traps_pipeline.base.plugins import Group, name_with_package, require_known
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.base.yamlfile import faults_of, parse_yaml_model, read_yaml
from traps_pipeline.models.reading.thinking import Marks, marks_of
from traps_pipeline.models.registry import user_registry
from traps_pipeline.models.registry.accounts import Account, Groups, Limits, Prices
from traps_pipeline.models.registry.local_settings import DEVICE, LocalParams, MechanismSpec, NetworkSize
from traps_pipeline.models.registry.owned_parameters import check_owned_parameters
from traps_pipeline.models.registry.schemas import answer_object
from traps_pipeline.protocol.cells import Evaluation
from traps_pipeline.protocol.regimes import fields_of
from traps_pipeline.storage.media import MediaSpec, profile_digest

MODELS_VARIABLE = "TRAPS_MODELS"  # environment variable: the path of another registry
MODELS_FILE = Path(os.environ.get(MODELS_VARIABLE) or ASSETS / "models.yaml").absolute()
# The protocol's parameters (docs/spec.md 3.1): parameter to its providers' names and its value. An entry that
# sends something else, or nothing, says why under `waivers`.
Protocol = Mapping[str, tuple[tuple[str, ...], Any]]
PROTOCOL_PARAMS: Protocol = {
    "temperature": (("temperature",), 0.8),
    "top_p": (("top_p",), 0.95),
    "max_tokens": (("max_tokens", "max_completion_tokens"), 8000),
}
JUDGE_PROTOCOL: Protocol = {
    "temperature": (("temperature",), 0.8),
    "max_tokens": (("max_tokens", "max_completion_tokens"), 512),
}
# The protocol's settings besides parameters. identifier: the provider's name of the model.
OTHER_WAIVERS = ("media", "reasoning", "json_schema", "identifier", "retries")
NETWORK = "api"  # the backend for network models
LOCAL = "local"  # the backend for checkpoints on this machine
LOCAL_TIMEOUT_S = 24 * 3600.0
BACKENDS = ("reference", "observer", "rule", NETWORK, LOCAL)  # of models; installed packages add others


class Entry(BaseModel):
    """An entry of a registry: a model or a judge.

    params is exactly what is sent, and part of the ledger key. waivers: protocol parameter to the reason why it differs
    from the protocol.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)
    plugins: ClassVar[Group] = "models"  # the group in which packages add backends to these
    own_backends: ClassVar[tuple[str, ...]] = ()  # any, where there are none
    id: Name = Field(description="its name in every table")
    backend: str
    params: dict[str, Any] = Field(default_factory=dict, description="what is sent, and part of the ledger key")
    limits: Limits = Field(default=Limits(), description="of its calls")
    account: str | None = Field(default=None, description="one of `accounts`; of backend api")
    provider_id: str | None = Field(default=None, description="litellm's name: route/model, e.g. gemini/gemini-2.5-pro")
    thinking: Marks | None = Field(
        default=None, description="what opens and what closes the thinking in its visible text, which is split off"
    )
    waivers: dict[str, str] = Field(default={}, description="why a parameter departs from the protocol")
    prices: Prices | None = Field(default=None, description="None: unknown, and a study must allow that")
    expected_completion_tokens: int = Field(default=500, ge=0, description="estimate for `traps plan`")
    expected_latency_s: float | None = Field(
        default=None, gt=0, description="of a call, for `traps plan`; by default 4 s, and 60 tokens/s"
    )

    @field_validator("backend")
    @classmethod
    def _backend_is_known(cls, value: str) -> str:
        return require_known(value, cls.plugins, cls.own_backends) if cls.own_backends else value

    @field_validator("thinking", mode="before")
    @classmethod
    def _marks(cls, value: Any) -> Any:
        return marks_of(value) if isinstance(value, str | list) else value

    @model_validator(mode="after")
    def _network_entry_is_whole(self, info: ValidationInfo) -> Entry:
        if self.backend != NETWORK:
            unused_fields = [name for name in ("account", "provider_id", "prices") if getattr(self, name) is not None]
            if unused_fields:
                raise ValueError(f"{', '.join(unused_fields)}: only backend {NETWORK} has it")
            return self
        accounts: Mapping[str, Account] = (info.context or {}).get("accounts", {})
        if self.account not in accounts:
            known_accounts = f"known accounts: {', '.join(accounts) or 'none'}"
            known_accounts += f"; add one under `accounts:` of {MODELS_FILE.name} or of the experiment"
            raise ValueError(f"account is {self.account!r}; {known_accounts}")
        if self.provider_id is None or "/" not in self.provider_id:
            raise ValueError(f"provider_id is {self.provider_id!r}; it is route/model, e.g. openai/gpt-5")
        check_parameters(self.params)
        check_owned_parameters(self.params)
        self._check_waivers(self.protocol())
        if self.prices and (self.prices.input or self.prices.output) and not self.max_tokens:
            raise ValueError("params.max_tokens is not sent: without it no budget can bound what a call costs")
        return self

    @property
    def endpoint(self) -> str:
        """The endpoint in the ledger key: litellm's name, or the kind of backend with the package that adds it."""
        return self.provider_id or name_with_package(self.plugins, self.backend)

    @property
    def max_tokens(self) -> int:
        """Maximum completion tokens; 0 if the entry sends no limit."""
        return int(self.params.get("max_tokens") or self.params.get("max_completion_tokens") or 0)

    def protocol(self) -> Protocol:
        """Return the parameters that the protocol fixes for such a participant, with names and values."""
        return PROTOCOL_PARAMS

    def _check_waivers(self, protocol: Protocol) -> None:
        for parameter, (names, value) in protocol.items():
            values = [self.params[name] for name in names if name in self.params]
            if values == [value]:
                if parameter in self.waivers:
                    raise ValueError(f"waivers.{parameter}: is sent as the protocol has it; remove the waiver")
            elif len(values) > 1:
                raise ValueError(f"params: {' and '.join(names)} are two names of one parameter: send one of them")
            elif parameter not in self.waivers:
                problem = f"is {values[0]!r}" if values else "is not sent"
                raise ValueError(
                    f"params.{parameter} {problem}, the protocol has {value!r}: send that, or say why under waivers"
                )
        known_parameters = (*protocol, *OTHER_WAIVERS)
        for parameter in self.waivers.keys() - set(known_parameters):
            raise ValueError(f"waivers.{parameter}: nothing that the protocol sets ({', '.join(known_parameters)})")


class ModelEntry(Entry):
    """One model of the registry, with the settings that decide its answers."""

    own_backends: ClassVar[tuple[str, ...]] = BACKENDS
    backend: str = Field(
        description="what answers: reference, observer, rule, api (a server), local (a checkpoint), or a package's name"
    )
    media: MediaSpec | None = Field(default=None, description="how it is shown a clip")
    runs: int = Field(default=3, ge=1, le=9, description="most repetitions that an experiment may ask for")
    json_schema: bool = Field(default=True, description="structured output in the JSON regime; of backend api")
    tokens_per_frame: int = Field(default=300, ge=0, description="estimate for `traps plan`, upper bound for a budget")
    groups: Groups = Field(
        default=Groups(family="own", access="own", input="own", group="own"), description="by which tables select"
    )
    device: str | None = Field(
        default=None, pattern=DEVICE, description="of backend local: cpu, cuda, cuda:1, mps, or auto: all GPUs"
    )
    mechanism: MechanismSpec | None = Field(default=None, description="of backend local: how it is looked into")
    size: NetworkSize | None = Field(default=None, description="of backend local: for the hours of `traps plan`")

    @model_validator(mode="before")
    @classmethod
    def _local_models_take_their_time(cls, data: Any) -> Any:
        """Give local requests more time, since each waits for the batch before its own."""
        if isinstance(data, dict) and data.get("backend") == LOCAL and isinstance(data.get("limits", {}), dict):
            return data | {"limits": {"timeout_s": LOCAL_TIMEOUT_S} | data.get("limits", {})}
        return data

    @model_validator(mode="after")
    def _backend_has_what_it_needs(self) -> ModelEntry:
        from traps_pipeline.models.baselines.reference import STRATEGIES
        from traps_pipeline.models.baselines.shortcut_rules import RULES

        if self.backend == "reference" and self.params.get("strategy") not in STRATEGIES:
            known_strategies = ", ".join(STRATEGIES)
            raise ValueError(
                f"params.strategy is {self.params.get('strategy')!r}; known strategies: {known_strategies}"
            )
        if self.backend == "rule" and self.params.get("rule") not in RULES:
            raise ValueError(f"params.rule is {self.params.get('rule')!r}; known rules: {', '.join(RULES)}")
        if self.backend in BACKENDS and (self.backend in (NETWORK, LOCAL)) != (self.media is not None):
            raise ValueError(f"media: backend {self.backend} {'needs it' if self.media is None else 'has none'}")
        if self.media is not None:
            self._check_media(self.media)
        self._check_local()
        if self.backend == NETWORK and self.json_schema == ("json_schema" in self.waivers):
            raise ValueError(
                "json_schema: the JSON regime asks for structured output; where it is off, a waiver says why"
            )
        return self

    def _check_local(self) -> None:
        if self.backend == LOCAL:
            if self.device is None:
                raise ValueError(
                    "device: backend local needs it (cpu, cuda, cuda:1, mps or auto); it is not chosen for you"
                )
            try:
                self.local_params()
            except ValidationError as error:
                raise ValueError(f"params: {faults_of(error)}") from error
        elif (self.device, self.mechanism, self.size) != (None, None, None):
            raise ValueError("device, mechanism, size: only backend local has them")

    def local_params(self) -> LocalParams:
        """Return the validated `params` of backend local, or raise ValidationError."""
        return LocalParams.model_validate(self.params)

    @property
    def has_random_weights(self) -> bool:
        """Whether states of the network with random weights are controls of its claims."""
        return self.mechanism is None or self.mechanism.random_weights

    def inside_params(self) -> LocalParams:
        """Return the parameters for mechanistic analyses: `params` with their overrides."""
        params = self.local_params()
        return self.mechanism.inside(params) if self.mechanism else params

    def _check_media(self, media: MediaSpec) -> None:
        if self.backend in BACKENDS and (media.profile == "frames") != (self.backend == LOCAL):
            raise ValueError("media.profile: frames goes to local models, video or images over the network")
        if self.backend == NETWORK and (media.fps, media.most) != (5, 25) and "media" not in self.waivers:
            raise ValueError("media: the protocol has fps 5, most 25: send that, or say why under waivers")


_Entry = TypeVar("_Entry", bound=Entry)


@user_registry.clear_on_new_entries
@cache
def _parse(path: Path) -> Any:
    """Return a registry's YAML, from which models and accounts are read in turn."""
    return read_yaml(path)


def read_entries(path: Path, key: str, kind: type[_Entry]) -> dict[str, _Entry]:
    """Return a file's entries by id, in order. Raises TrapsError naming entry, field."""
    data = _parse(path)
    entries = data.get(key) if isinstance(data, dict) else None
    if not isinstance(entries, list):
        raise TrapsError(f"{path}: must hold a list `{key}:`")
    context = {"accounts": load_accounts()}
    entries_by_id: dict[str, _Entry] = {}
    for number, raw in enumerate(entries, start=1):
        _add(entries_by_id, kind, raw, path, f"{key.rstrip('s')} {number}", context)
    return entries_by_id


def _add(
    entries: dict[str, _Entry], kind: type[_Entry], raw: Any, path: Path, what: str, context: Mapping[str, Any]
) -> None:
    name = raw.get("id", "?") if isinstance(raw, dict) else "?"
    short_fields = [field for field in user_registry.SHORT_FIELDS if isinstance(raw, dict) and field in raw]
    if short_fields:  # `user_registry` completes an experiment's short entries before they come here
        raise TrapsError(
            f"{path}: {what} ({name}): {', '.join(short_fields)}: an entry with an address of its own stands in an "
            "experiment's file (docs/models.md); one of the registry has backend, account and provider_id"
        )
    also = user_registry.SHORT_FIELDS if path != MODELS_FILE else ()
    entry = parse_yaml_model(kind, raw, path, f"{what} ({name})", context, entry=str(name), also=also)
    if entry.id in entries:
        raise TrapsError(f"{path}: {what}: id {entry.id!r} occurs twice, here or in {MODELS_FILE.parent}")
    entries[entry.id] = entry


def with_user_entries(entries: dict[str, _Entry], key: user_registry.Kind, kind: type[_Entry]) -> dict[str, _Entry]:
    """Return a registry's entries, then those of the experiment and the workspace."""
    context = {"accounts": load_accounts()}
    for path, raw in user_registry.entries(key):
        _add(entries, kind, raw, path, f"own {key.rstrip('s')}", context)
    return entries


@user_registry.clear_on_new_entries
@cache
def load_models(path: Path = MODELS_FILE) -> dict[str, ModelEntry]:
    """Return models by id, in file order. Raises TrapsError naming entry and field."""
    models = read_entries(path, "models", ModelEntry)
    return with_user_entries(models, "models", ModelEntry) if path == MODELS_FILE else models


@user_registry.clear_on_new_entries
@cache
def load_accounts(path: Path = MODELS_FILE) -> dict[str, Account]:
    """Return accounts by name. Raises TrapsError naming account and field."""
    data = _parse(path)
    accounts = data.get("accounts", {}) if isinstance(data, dict) else None
    if not isinstance(accounts, dict):
        raise TrapsError(f"{path}: `accounts:` must be a mapping of names")
    if path == MODELS_FILE:
        accounts = {**accounts, **user_registry.accounts()}
    return {
        name: parse_yaml_model(Account, raw or {}, path, f"account {name}", entry=name)
        for name, raw in accounts.items()
    }


def account_of(entry: Entry) -> Account:
    """Return the account of a network entry."""
    return load_accounts()[str(entry.account)]


def effective_params(entry: ModelEntry, regime: str, dataset: str = "") -> dict[str, Any]:
    """Return the parameters sent under a regime, in a dataset that may vary it.

    They are the entry's parameters, the schema of the requested object if the entry uses schemas, and for a checkpoint
    the digest of its weights (`declared_digest`).
    """
    if entry.backend == LOCAL:
        from traps_pipeline.models.registry.checkpoint import declared_digest

        content = declared_digest(entry.local_params())
        return entry.params | ({"checkpoint_digest": content} if content else {})
    fields = fields_of(regime, dataset)
    structured_output = {"response_format": answer_object(fields)} if fields else {}
    return entry.params | (structured_output if entry.backend == NETWORK and entry.json_schema else {})


def answering_version(evaluation: Evaluation) -> str:
    """Return the digest of a model's settings that decide its answers, prompt aside."""
    entry = get_model(evaluation.model)
    parts: list[Any] = [effective_params(entry, evaluation.regime)]
    parts += [profile_digest(entry.media)] if entry.media else []
    parts += [["thinking", *entry.thinking]] if entry.thinking else []  # decides how an answer is read
    return digest([entry.id, entry.endpoint, *parts])[:16]


def missing_keys(entries: Iterable[Entry]) -> dict[str, list[str]]:
    """Return the key variables that are not set, each with the ids of entries that need it."""
    accounts = load_accounts()
    missing: dict[str, list[str]] = {}
    for entry in entries:
        key = accounts[entry.account].key if entry.account is not None else None
        if key and not os.environ.get(key):
            missing.setdefault(key, []).append(entry.id)
    return missing


def get_model(model_id: str) -> ModelEntry:
    """Return the entry of a model id, or raise TrapsError with similar ids."""
    models = load_models()
    if model_id not in models:
        suggestion = did_you_mean(model_id, models) or f"; {MODELS_FILE} has {len(models)}"
        raise TrapsError(f"unknown model {model_id!r:.60}{suggestion}")
    return models[model_id]


def is_reference(model_id: str) -> bool:
    """Return whether a model, or model@submission, is one that rules can judge."""
    models, name = load_models(), model_id.partition("@")[0]
    return name in models and models[name].backend in ("reference", "observer", "rule")


def reference_rows() -> list[str]:
    """Return the ids of the registry's strategies and rules: rows to compare with, which no text calls models."""
    return [*filter(is_reference, load_models())]


@user_registry.clear_on_new_entries
@cache
def local_models() -> tuple[str, ...]:
    """Return the ids of the models whose hidden states can be read, in file order."""
    return tuple(entry.id for entry in load_models().values() if entry.backend == LOCAL)
