"""Create the backend of a registry entry, in this one place."""

from __future__ import annotations

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.extras import require
from traps_pipeline.models.registry.entries import LOCAL, NETWORK, Entry, ModelEntry
from traps_pipeline.models.request import Backend


def require_libraries(entry: Entry) -> None:
    """Raise TrapsError, with the command, unless an entry's libraries are installed."""
    if entry.backend == NETWORK:
        require("api")
    if entry.backend == LOCAL:
        require("local")
        if isinstance(entry, ModelEntry) and entry.local_params().quantisation == "nf4":
            require("nf4")


def make_backend(entry: Entry) -> Backend:
    """Return the entry's backend, and import its library only now.

    Raises TrapsError if its library is not installed, its key is not set, or its weights are missing.
    """
    require_libraries(entry)
    match entry.backend:
        case "reference":
            from traps_pipeline.models.baselines.reference import ReferenceBackend

            return ReferenceBackend()
        case "observer":
            from traps_pipeline.models.baselines.observer import ObserverBackend

            return ObserverBackend()
        case "rule":
            from traps_pipeline.models.baselines.shortcut_rules import RuleBackend

            return RuleBackend()
        case "api":
            from traps_pipeline.models.wire.api import ApiBackend

            return ApiBackend(entry)
        case "local":
            from traps_pipeline.models.local.backend import LocalBackend

            return LocalBackend(entry)
    raise TrapsError(f"{entry.id}: unknown backend {entry.backend!r}; known: reference, observer, rule, api, local")
