"""Decide what is stale: compare partitions' recorded inputs with the current ones.

The tables' footers (`storage.parquet.State`) hold the versions of the inputs (docs/design/staleness.md).
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Generic, Literal, TypeVar

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.wording import count_noun
from traps_pipeline.pipeline.graph import Stage, name_of, the_graph
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.storage.parquet import State
from traps_pipeline.storage.workspace import Workspace

DAMAGED = "damaged"  # the version of damaged data
Value = TypeVar("Value")


def failed_calls(count: int) -> str:
    """Return in words how many calls of a partition failed, with the remedy."""
    return (
        f"{count_noun(count, 'call')} failed; a new run of this partition asks {'it' if count == 1 else 'them'} again"
    )


OTHER_COLUMNS = "made by a version with other columns"


@dataclass(frozen=True)
class Status:
    """The status of a partition, its changed inputs, and its number of failed calls."""

    kind: Literal["fresh", "stale", "missing"]
    outdated: tuple[str, ...] = ()
    failed: int = 0

    @property
    def reasons(self) -> tuple[str, ...]:
        """Sentences on why the partition is stale."""
        return (*self.outdated, failed_calls(self.failed)) if self.failed else self.outdated


class _Once(Generic[Value]):
    """A function of a partition that is evaluated once, until its stage is renewed."""

    def __init__(self, find: Callable[[str, str | None], Value]) -> None:
        self._find, self._found = find, defaultdict[str, dict[str | None, Value]](dict)

    def __call__(self, name: str, key: str | None = None) -> Value:
        of_stage = self._found[name]
        if key not in of_stage:
            of_stage[key] = self._find(name, key)
        return of_stage[key]

    def renew(self, names: Iterable[str]) -> None:
        for name in names:
            self._found.pop(name, None)


class Lineage:
    """The versions and statuses of a workspace's partitions, each looked up once."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace, self.graph, self._thorough = workspace, the_graph(), False
        workspace.store.look()
        self.version, self.state, self.damage = _Once(self._version), _Once(self._state), _Once(self._damage)
        self.status, self._there = _Once(self._status), _Once(lambda name, _: self._keys_there(name))
        self._failed_checks = _Once(lambda name, _: workspace.failed_checks(name))
        self.partitions = StudyPartitions(workspace)
        self._wanted = cache(lambda name: {*self.graph[name].wanted(self.partitions)})

    def renew(self, stage: str) -> None:
        """Look up anew a stage that has been built since, and all stages downstream of it."""
        self._forget(self.graph.all_below(stage))

    def read_in_full(self) -> None:
        """Look everything up anew, and from now on compare every table with its checksum."""
        if not self._thorough:
            self._thorough = True
            self._forget(self.graph.declared)

    def _forget(self, names: Iterable[str]) -> None:
        for known in (self.version, self.state, self.damage, self.status, self._there, self._failed_checks):
            known.renew(names)

    def inputs(self, stage: str, key: str | None) -> dict[str, str]:
        """Return the versions of all existing inputs of a partition, by name."""
        nodes = [
            (parent, k)
            for parent, keys in self.graph.parents(stage, key).items()
            for k in keys
            if (parent_keys := self._there(parent)) is None or k in parent_keys
        ]
        versions = {name_of(node): self.version(*node) for node in nodes}
        return {name: version for name, version in versions.items() if version is not None}

    def _status(self, name: str, key: str | None) -> Status:
        """Return whether a partition exists, is intact, and matches inputs and code."""
        stage = self.graph[name]
        if damage := self.damage(name, key):
            return Status("stale", (damage,))
        state = self.state(name, key)
        if state is None:
            table, tables = stage.table, self._workspace.tables
            is_there = table is not None and self._workspace.store.has(tables.path(table, stage.columns(key)))
            return Status("missing", (OTHER_COLUMNS,) if is_there else ())
        reasons = [*_differences(state.inputs, self.inputs(name, key)), *stage.lost(self._workspace, key)]
        if state.code != stage.code:
            reasons.append(f"its code has version {stage.code} now, it was made by version {state.code}")
        return Status("stale", tuple(reasons), state.failed) if reasons or state.failed else Status("fresh")

    def made_at(self, name: str, key: str | None) -> int:
        """Return the time (ns since 1970) at which a partition was written; 0 if it does not exist."""
        stage = self.graph[name]
        path = _report_state(self._workspace, stage)
        if stage.table is not None:
            path = self._workspace.tables.path(stage.table, stage.columns(key))
        return self._workspace.store.changed_ns(path)

    def blocked(self, name: str, key: str | None, *, current: bool) -> str:
        """Return in words why a partition cannot be built, or empty; current: need fresh parents."""
        stage = self.graph[name]
        for parent, keys in self.graph.parents(name, key).items():
            if self.graph.source(parent) is not None:
                continue
            wanted_keys = [k for k in keys if k in self._wanted(parent)]
            reason_by_key = {k: reason for k in wanted_keys if (reason := self._unusable(parent, k, current))}
            need = stage.parents[parent].need
            if need == "none" or (need == "some" and len(reason_by_key) < len(wanted_keys)):
                reason_by_key = {
                    k: reason for k, reason in reason_by_key.items() if self.damage(parent, k)
                }  # it would be read with the rest
            if reason_by_key:
                first, reason = next(iter(reason_by_key.items()))
                suffix = f" (and {len(reason_by_key) - 1} more)" if len(reason_by_key) > 1 else ""
                return f"{name_of((parent, first))} {reason}{suffix}"
            if need == "some" and not wanted_keys:
                return f"the study wants no {parent}"
        return ""

    def waits(self, name: str, key: str | None) -> bool:
        """Return whether a partition must wait for an upstream one.

        That is so if an upstream partition is outdated, has been lost since this one was made, or is missing; paid
        parents that are not required do not count.
        """
        stage_parents = self.graph[name].parents
        parents = {
            parent: keys
            for parent, keys in self.graph.parents(name, key).items()
            if not self.graph.source(parent)
            and not (stage_parents[parent].need == "none" and self.graph[parent].cost == "money")
        }
        upstream = [(parent, k) for parent, keys in parents.items() for k in keys if k in self._wanted(parent)]
        state = self.state(name, key)
        lost_parents = (
            node
            for node in upstream
            if state and name_of(node) in state.inputs and self.status(*node).kind == "missing"
        )
        return (
            any(self.status(*node).outdated for node in upstream)
            or any(lost_parents)  # otherwise tables would be rebuilt from fewer inputs than before
            or bool(self.blocked(name, key, current=True))
        )

    def _unusable(self, name: str, key: str | None, current: bool) -> str:
        if damage := self.damage(name, key):
            return f"is damaged: {damage.partition('; ')[0]}; materialize {name} for this partition again"
        status = self.status(name, key)
        if status.kind == "missing":
            return f"is not made; materialize {name} for this partition first"
        if current and status.outdated:
            return f"is not current: {status.outdated[0]}"
        blocking = {check.name for check in self.graph[name].checks if check.blocks}
        failed = [check for check in self._failed_checks(name).get(key, []) if check in blocking]
        return f"does not pass its check {failed[0]}" if failed else ""

    def _keys_there(self, name: str) -> Set[str] | None:
        """Return the keys with a file, None for an asset without partitions in a table."""
        if self.graph.source(name) is not None or (stage := self.graph[name]).table is None or stage.scheme is None:
            return None
        files = (tuple(partition.values()) for partition in self._workspace.tables.partitions(stage.table))
        return {key for values in files if (key := stage.scheme.key_of.get(values)) is not None}

    def _state(self, name: str, key: str | None) -> State | None:
        stage = self.graph[name]
        if self.damage(name, key):
            return None  # what a damaged file says of itself is not believed
        if stage.table is not None:
            return self._workspace.tables.state(stage.table, stage.columns(key))
        return read_report_state(self._workspace, stage)

    def _damage(self, name: str, key: str | None) -> str:
        stage = self.graph[name]
        if stage.table is None:
            return ""
        return self._workspace.tables.damage(stage.table, stage.columns(key), thorough=self._thorough)

    def _version(self, name: str, key: str | None) -> str | None:
        source = self.graph.source(name)
        if source is not None:
            return source.version(self._workspace, key)
        if self.damage(name, key):
            return DAMAGED
        state = self.state(name, key)
        return state.version if state else None


def _differences(then: Mapping[str, str], now: Mapping[str, str]) -> Iterator[str]:
    for name in sorted(then.keys() | now.keys()):
        if name not in now:
            yield f"{name} is gone"
        elif name not in then:
            yield f"{name} is new"
        elif then[name] != now[name]:
            yield f"{name} changed"


def write_report_state(workspace: Workspace, stage: Stage, state: State) -> None:
    """Record which inputs a stage's report files were made from, in a folder beside them."""
    workspace.store.write({_report_state(workspace, stage): json.dumps(asdict(state)).encode()})


def read_report_state(workspace: Workspace, stage: Stage) -> State | None:
    """Return the state that `write_report_state` wrote, None if the files are gone."""
    path = _report_state(workspace, stage)
    if not workspace.store.has(path):
        return None
    try:
        return State(**json.loads(workspace.store.here(path).read_text(encoding="utf-8")))
    except (ValueError, TypeError) as error:
        raise TrapsError(f"{path}: is not what was written ({error}); delete it and run again") from error


def _report_state(workspace: Workspace, stage: Stage) -> Path:
    return workspace.reports / ".state" / f"{stage.name}.json"
