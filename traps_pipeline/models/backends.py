"""The one place where a registry entry becomes a backend; a new backend is one more branch here."""

from __future__ import annotations

from traps_pipeline.errors import TrapsError
from traps_pipeline.models.registry import Entry
from traps_pipeline.models.request import Backend


def make_backend(entry: Entry) -> Backend:
    """The entry's backend. Imports are lazy: a study without paid models never loads a provider's library.

    Raises TrapsError when its key is not set, or its weights are not here.
    """
    match entry.backend:
        case "reference":
            from traps_pipeline.models.reference import ReferenceBackend

            return ReferenceBackend()
        case "observer":
            from traps_pipeline.models.observer import ObserverBackend

            return ObserverBackend()
        case "rule":
            from traps_pipeline.models.shortcut_rules import RuleBackend

            return RuleBackend()
        case "api":
            from traps_pipeline.models.api import ApiBackend

            return ApiBackend(entry)
        case "local":
            from traps_pipeline.models.local.backend import LocalBackend

            return LocalBackend(entry)
    raise TrapsError(f"{entry.id}: unknown backend {entry.backend!r}; known: reference, observer, rule, api, local")
