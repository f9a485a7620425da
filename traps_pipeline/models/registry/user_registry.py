"""Add users' models, judges and panels without changing a tracked file.

They are defined in an experiment's YAML, and copied to `own.yaml` of the workspace in which it runs. An entry has the
registry's fields and may be short: an address, and the form of clips that the server takes. The protocol supplies the
rest.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import Name
from traps_pipeline.base.network import is_loopback
from traps_pipeline.base.yamlfile import faults_of, read_yaml
from traps_pipeline.storage.workspace import VARIABLE, Workspace

FILE = "own.yaml"
HOW_MEDIA = (
    "media: say what your server takes of a clip: `images` (25 JPEG frames as image_url; most servers take them) "
    "or `video` (the clip as one mp4 in video_url; vLLM with a video model)"
)
SHORT_FIELDS = ("base_url", "served_name", "key")  # fields of a short entry, which complete entries have elsewhere
Kind = Literal["models", "judges"]
Cached = TypeVar("Cached")


class UserRegistry(BaseModel):
    """The additions of an experiment or a workspace to the registries, which may be short."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    accounts: dict[Name, dict[str, Any]] = {}
    models: list[dict[str, Any]] = []
    judges: list[dict[str, Any]] = []
    panels: dict[Name, list[str]] = {}

    @field_validator("models", "judges")
    @classmethod
    def _have_ids(cls, values: list[dict[str, Any]]) -> list[dict[str, Any]]:
        if not all(isinstance(value.get("id"), str) for value in values):
            raise ValueError("each entry has an `id`, a word in lower case with hyphens")
        names = [value["id"] for value in values]
        if twice := [name for name in names if names.count(name) > 1]:
            raise ValueError(f"{twice[0]!r} is named twice; leave one out")
        for value in values:
            for name in SHORT_FIELDS[:2]:
                if name in value and not (isinstance(value[name], str) and value[name].strip()):
                    raise ValueError(
                        f"{value['id']}: {name} is no text in YAML but {value[name]!r}: write the name in quotes"
                    )
        return values

    def __or__(self, newer: UserRegistry) -> UserRegistry:
        """Return the union, in which newer entries replace those of the same name."""

        def entries(kind: Kind) -> list[dict[str, Any]]:
            return [*{entry["id"]: entry for registry in (self, newer) for entry in getattr(registry, kind)}.values()]

        return UserRegistry(
            accounts=self.accounts | newer.accounts,
            models=entries("models"),
            judges=entries("judges"),
            panels=self.panels | newer.panels,
        )

    @property
    def all_accounts(self) -> dict[str, dict[str, Any]]:
        """The accounts by name, with one for each entry that has its own address."""
        addressed_entries = [entry for entry in (*self.models, *self.judges) if "base_url" in entry]
        accounts = {
            _account(entry): {k: entry[k] for k in ("base_url", "key") if k in entry} for entry in addressed_entries
        }
        return self.accounts | accounts


_overlay: list[tuple[Path, UserRegistry]] = []  # additions of the command's experiment
_clearers: list[Callable[[], None]] = []  # clear the caches of the registries


def clear_on_new_entries(cached: Cached) -> Cached:
    """Return a cached registry reader unchanged, and clear its cache when entries are added."""
    _clearers.append(cached.cache_clear)  # pyright: ignore[reportAttributeAccessIssue] - of functools.cache
    return cached


def clear_caches() -> None:
    """Clear the caches of the registries, so that they are read again."""
    for clear_cache in _clearers:
        clear_cache()


def add_entries(own: UserRegistry, path: Path) -> None:
    """Add an experiment's entries for this process; `path` serves errors."""
    _overlay[:] = [(path, own)]
    clear_caches()


def save_entries(workspace: Workspace) -> None:
    """Write the experiment's entries into the workspace, where every run reads them."""
    additions = [registry for _, registry in _overlay if registry != UserRegistry()]
    if additions:
        path = Workspace.file_of(workspace.place, FILE)
        registries = (_read(path) if path else UserRegistry()) | additions[-1]
        workspace.store.write({workspace.root / FILE: _yaml(registries).encode()})
        clear_caches()


def registries() -> list[tuple[Path, UserRegistry]]:
    """Return all additions, each with the path of its file: the workspace's, the experiment's."""
    path = Workspace.file_of(Workspace.default_place(), FILE) if os.environ.get(VARIABLE) else None
    return [*([(path, _read(path))] if path else []), *_overlay]


def all_additions() -> UserRegistry:
    """Return the models, judges and panels that experiments and packages add, together."""
    registry_union = UserRegistry()
    for _, registry in registries():
        registry_union |= registry
    return registry_union


def accounts() -> Mapping[str, dict[str, Any]]:
    """Return by name the accounts of models that users described."""
    return all_additions().all_accounts


def entries(kind: Kind) -> Iterable[tuple[Path, dict[str, Any]]]:
    """Return the added models or judges, completed, each with the path of its file."""
    newest_of = {raw["id"]: (path, raw) for path, registry in registries() for raw in getattr(registry, kind)}
    return ((path, _entry_fields(raw, kind)) for path, raw in newest_of.values())


def _read(path: Path) -> UserRegistry:
    try:
        return UserRegistry.model_validate(read_yaml(path) or {})
    except ValidationError as error:
        raise TrapsError(f"{path}: {faults_of(error, UserRegistry)}") from error


def _yaml(registry: UserRegistry) -> str:
    import yaml

    head = "# Models, judges and panels of this study, from its experiments' files (docs/models.md).\n"
    return head + yaml.safe_dump(registry.model_dump(mode="json", exclude_defaults=True), sort_keys=False)


def _account(entry: Mapping[str, Any]) -> str:
    return f"own-{entry['id']}"


def _entry_fields(raw: Mapping[str, Any], kind: Kind) -> dict[str, Any]:
    """Return a possibly short entry with all fields of a registry's entry."""
    entry = {name: value for name, value in raw.items() if name not in SHORT_FIELDS}
    if "base_url" not in raw:
        return entry
    sampling = {"temperature": 0.8, "max_tokens": 512} if kind == "judges" else None
    sampling = sampling or {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    entry_fields: dict[str, Any] = {
        "backend": "api",
        "account": _account(raw),
        "provider_id": f"openai/{raw.get('served_name', raw['id'])}",
        **entry,
        "params": _params(sampling, entry.get("params") or {}),
    }
    if kind == "models":
        entry_fields |= {"media": _media(entry.get("media"))}
    if "prices" not in entry_fields and is_loopback(urlsplit(str(raw["base_url"])).hostname or ""):
        entry_fields["prices"] = {"input": 0, "output": 0, "as_of": datetime.date.today().isoformat()}
    return entry_fields


def _params(protocol: Mapping[str, Any], entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters to send: the protocol's and the entry's, without nulls."""
    replaced_names = {"max_tokens"} if "max_completion_tokens" in entry else set[str]()  # the same limit
    params = {name: value for name, value in protocol.items() if name not in replaced_names}
    return {name: value for name, value in (params | {**entry}).items() if value is not None}


def _media(media: Any) -> Any:
    if media is None:
        raise TrapsError(HOW_MEDIA)
    return {"profile": media, "fps": 5, "most": 25} if isinstance(media, str) else media
