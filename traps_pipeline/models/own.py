"""Models, judges and panels of one's own, which need no change of a tracked file.

They stand in an experiment's YAML, and in `own.yaml` of the workspace that it was run in. An entry there has the fields
of the registry's and may be short: an address, and what the server takes of a clip. The protocol fills in the rest.
"""

from __future__ import annotations

import datetime
import os
from collections.abc import Callable, Iterable, Mapping
from ipaddress import ip_address
from pathlib import Path
from typing import Any, Literal, TypeVar
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.names import Name
from traps_pipeline.base.yamlfile import explain, read_yaml
from traps_pipeline.storage.workspace import VARIABLE, Workspace

FILE = "own.yaml"
HOW_MEDIA = (
    "media: say what your server takes of a clip: `images` (25 JPEG frames as image_url; most servers take them) "
    "or `video` (the clip as one mp4 in video_url; vLLM with a video model)"
)
SHORT = ("base_url", "served_name", "key")  # fields of a short entry, which the registry's entries have elsewhere
Kind = Literal["models", "judges"]
Cached = TypeVar("Cached")


class Own(BaseModel):
    """What an experiment or a workspace adds to the registries, in the form of `assets/models.yaml` and
    `assets/judges.yaml`, or short."""

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
        return values

    def __or__(self, newer: Own) -> Own:
        """Return these, with the newer entries in the place of those of the same name."""

        def entries(kind: Kind) -> list[dict[str, Any]]:
            return [*{entry["id"]: entry for own in (self, newer) for entry in getattr(own, kind)}.values()]

        return Own(
            accounts=self.accounts | newer.accounts,
            models=entries("models"),
            judges=entries("judges"),
            panels=self.panels | newer.panels,
        )

    @property
    def all_accounts(self) -> dict[str, dict[str, Any]]:
        """The accounts, with one for each entry that has an address of its own."""
        short = [entry for entry in (*self.models, *self.judges) if "base_url" in entry]
        accounts = {_account(entry): {k: entry[k] for k in ("base_url", "key") if k in entry} for entry in short}
        return self.accounts | accounts


_overlay: list[tuple[Path, Own]] = []  # of the experiment that a command names
_forget: list[Callable[[], None]] = []  # what is kept of the registries, and how to forget it


def keeps(cached: Cached) -> Cached:
    """Mark a cached reader of a registry: it reads again when other entries are added. For use as a decorator."""
    _forget.append(cached.cache_clear)  # pyright: ignore[reportAttributeAccessIssue] - of functools.cache
    return cached


def forget() -> None:
    """Read the registries again when they are next asked for."""
    for clear in _forget:
        clear()


def use(own: Own, path: Path) -> None:
    """Add what an experiment's file brings, for this process. path: the file, for errors."""
    _overlay[:] = [(path, own)]
    forget()


def keep(workspace: Workspace) -> None:
    """Write what the experiment brought into the workspace, where every run reads it, whoever starts it."""
    additions = [own for _, own in _overlay if own != Own()]
    if additions:
        path = Workspace.file_of(workspace.place, FILE)
        together = (_read(path) if path else Own()) | additions[-1]
        workspace.store.write({workspace.root / FILE: _yaml(together).encode()})
        forget()


def sources() -> list[tuple[Path, Own]]:
    """Return what is added to the registries, each with the file that brings it: the workspace's, then the
    experiment's."""
    path = Workspace.file_of(Workspace.default_place(), FILE) if os.environ.get(VARIABLE) else None
    return [*([(path, _read(path))] if path else []), *_overlay]


def together() -> Own:
    """Return all of `sources` in one."""
    combined = Own()
    for _, own in sources():
        combined |= own
    return combined


def accounts() -> Mapping[str, dict[str, Any]]:
    """Return all accounts that are added."""
    return together().all_accounts


def entries(kind: Kind) -> Iterable[tuple[Path, dict[str, Any]]]:
    """Return models or judges that are added, written out in full, each with its file."""
    newest = {raw["id"]: (path, raw) for path, own in sources() for raw in getattr(own, kind)}
    return ((path, _whole(raw, kind)) for path, raw in newest.values())


def _read(path: Path) -> Own:
    try:
        return Own.model_validate(read_yaml(path) or {})
    except ValidationError as error:
        raise TrapsError(f"{path}: {explain(error, Own)}") from error


def _yaml(own: Own) -> str:
    import yaml

    head = "# Models, judges and panels of this study, from its experiments' files (docs/models.md).\n"
    return head + yaml.safe_dump(own.model_dump(mode="json", exclude_defaults=True), sort_keys=False)


def _account(entry: Mapping[str, Any]) -> str:
    return f"own-{entry['id']}"


def _whole(raw: Mapping[str, Any], kind: Kind) -> dict[str, Any]:
    """Return an entry with all fields that a registry's has, from one that may be short."""
    entry = {name: value for name, value in raw.items() if name not in SHORT}
    if "base_url" not in raw:
        return entry
    sampling = {"temperature": 0.8, "max_tokens": 512} if kind == "judges" else None
    sampling = sampling or {"temperature": 0.8, "top_p": 0.95, "max_tokens": 8000}
    filled: dict[str, Any] = {
        "backend": "api",
        "account": _account(raw),
        "provider_id": f"openai/{raw.get('served_name', raw['id'])}",
        **entry,
        "params": _params(sampling, entry.get("params") or {}),
    }
    if kind == "models":
        filled |= {"media": _media(entry.get("media"))}
    if "prices" not in filled and _is_here(str(raw["base_url"])):
        filled["prices"] = {"input": 0, "output": 0, "as_of": datetime.date.today().isoformat()}
    return filled


def _params(protocol: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return what is sent: the protocol's parameters and the entry's own; one that is null is left out."""
    replaced = {"max_tokens"} if "max_completion_tokens" in own else set[str]()  # another name of the same limit
    params = {name: value for name, value in protocol.items() if name not in replaced}
    return {name: value for name, value in (params | {**own}).items() if value is not None}


def _media(media: Any) -> Any:
    if media is None:
        raise TrapsError(HOW_MEDIA)
    return {"profile": media, "fps": 5, "most": 25} if isinstance(media, str) else media


def _is_here(address: str) -> bool:
    """Return whether an address is this machine's, where nobody sends a bill."""
    host = urlsplit(address).hostname or ""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
