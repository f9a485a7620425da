"""Create the backend of a registry entry, in this one place."""

import inspect
from dataclasses import dataclass, replace
from typing import get_args

from traps_pipeline.base.extras import require_extra
from traps_pipeline.base.plugins import Plugin, plugins
from traps_pipeline.ledger.rows import replace_impossible
from traps_pipeline.models.registry.entries import LOCAL, NETWORK, Entry, ModelEntry
from traps_pipeline.models.request import Backend, Outcome, OutcomeKind, Request, TransientError


def require_libraries(entry: Entry) -> None:
    """Raise TrapsError, naming the command that installs them, if an entry's libraries are missing."""
    if entry.backend == NETWORK:
        require_extra("api")
    if entry.backend == LOCAL:
        require_extra("local")
        if isinstance(entry, ModelEntry) and entry.local_params().quantisation == "nf4":
            require_extra("nf4")


def make_backend(entry: Entry) -> Backend:
    """Return the entry's backend. Raises TrapsError if its library, its key or its weights are missing."""
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
    return make_plugin_backend(entry)


def make_plugin_backend(entry: Entry) -> Backend:
    """Return the backend of an installed package. Raises TrapsError naming the package."""
    plugin = plugins(entry.plugins)[entry.backend]
    make = plugin.load()
    try:
        backend: Backend = make(entry)
    except Exception as error:  # whatever foreign code raises
        raise plugin.error(f"makes no backend for {entry.id} ({type(error).__name__}: {error})") from error
    if not inspect.iscoroutinefunction(getattr(backend, "ask", None)):
        raise plugin.error("makes no backend: its `ask` must be `async def ask(self, request) -> Outcome`")
    return _PluginBackend(plugin, backend)


@dataclass(frozen=True)
class _PluginBackend:
    """A package's backend, whose errors and impossible answers name the package."""

    plugin: Plugin
    backend: Backend

    async def ask(self, request: Request) -> Outcome:
        try:
            outcome = await self.backend.ask(request)
        except (TransientError, TimeoutError):
            raise
        except Exception as error:  # whatever foreign code raises
            raise self.plugin.error(f"failed ({type(error).__name__}: {error})") from error
        if not isinstance(outcome, Outcome) or outcome.kind not in get_args(OutcomeKind):
            raise self.plugin.error(f"answered with {str(outcome)[:80]!r} in place of an Outcome")
        row = {"outcome": outcome.kind, **vars(outcome)}
        if fields := [name for name in replace_impossible(row) if row[name] is None]:
            raise self.plugin.error(f"answered with an impossible {fields[0]}")
        return replace(outcome, text=row["text"])  # without half characters
