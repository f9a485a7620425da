"""The one place where a registry entry becomes a backend; a new backend is one more branch here."""

from __future__ import annotations

from traps_pipeline.models.request import Backend


def make_backend(kind: str) -> Backend:
    """A backend of that kind. Imports are lazy: a study without paid models never loads a provider's library."""
    match kind:
        case "reference":
            from traps_pipeline.models.reference import ReferenceBackend

            return ReferenceBackend()
        case "observer":
            from traps_pipeline.models.observer import ObserverBackend

            return ObserverBackend()
    raise ValueError(f"unknown backend {kind!r}; known: reference, observer")
