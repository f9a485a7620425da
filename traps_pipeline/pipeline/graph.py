"""Build the dependency graph: upstream partitions, all keys, the order of stages.

`stage` and `source` (`pipeline.stage`) are the only declarations. Nothing here imports Dagster: `traps status`, `why`
and `plan` read only this graph and the tables' footers, and `pipeline.assets` builds Dagster's assets from it.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any, Literal

from traps_pipeline.base.errors import TrapsError
from traps_pipeline.base.progress import Tally
from traps_pipeline.base.suggestions import did_you_mean
from traps_pipeline.pipeline.partitioning import EVERY, SAME, KeyMapping, Partitioning
from traps_pipeline.pipeline.wanted import StudyPartitions
from traps_pipeline.storage.parquet import StageOutput
from traps_pipeline.storage.tables import Table
from traps_pipeline.storage.workspace import Workspace

Node = tuple[str, str | None]  # stage or source, and its partition key
UpstreamPolicy = Literal["every", "some", "none"]
Cost = Literal["", "money", "machine"]
# Each job and the groups of assets that it materializes. Every group occurs once, in order of execution.
JOB_GROUPS: Mapping[str, tuple[str, ...]] = {
    "benchmark": ("benchmark", "arms"),
    "evaluation": ("evaluation",),
    "scoring": ("scoring", "judging", "people"),
    "mechanism": ("mechanism",),
    "report": ("report",),
}
GROUPS = tuple(group for groups in JOB_GROUPS.values() for group in groups)


@dataclass(frozen=True)
class Check:
    """A check of each partition; `blocks`: a failure blocks what is below. wrong: returns the failure, or empty."""

    name: str
    doc: str
    wrong: Callable[[Workspace, str | None, StageOutput], Any]
    blocks: bool = True


@dataclass(frozen=True)
class Parent:
    """An upstream asset of a stage, and how its partitions are chosen and needed.

    mapping: selects its partitions (default: the same key if both are partitioned alike, else all). need: how many of
    the partitions that the study wants must exist.
    """

    name: str
    mapping: KeyMapping | None = None
    need: UpstreamPolicy = "every"


@dataclass(frozen=True)
class Source:
    """A file or setting that people edit; `version` returns a key's data version."""

    name: str
    version: Callable[[Workspace, Any], str]
    group: str
    doc: str
    kinds: Sequence[str]
    scheme: Partitioning | None = None


@dataclass(frozen=True)
class RunResources:
    """The resources that a cluster reserves for a run of a stage.

    memory_gb: 0 if it does not matter. each_gb: for a stage that uses all cores it is given (`traps run --cpus`), extra
    memory per core; 0: it uses one core. A stage whose cost is `machine` also takes a GPU, as `traps run --gpus` says.
    """

    memory_gb: float = 0.0
    each_gb: float = 0.0


@dataclass(frozen=True)
class ConcurrentBuild:
    """The functions by which several runs build one partition: its files together, then one run builds it.

    The other runs adopt the finished partition. files: makes the files that no other run is making, optionally waits
    until none is missing, and returns the work done here and whether all exist. seconds: estimates one core's time for
    the missing files, as far as that is known before anything upstream exists.
    """

    files: Callable[[Workspace, Any, bool], tuple[Tally, bool]] = lambda _, __, ___: (Tally(), True)
    seconds: Callable[[Workspace, Any], float] = lambda workspace, key: 0.0


@dataclass(frozen=True)
class Stage:
    """The declaration of an asset to build: a table, or files (table: None).

    make: returns the StageOutput of a key; if `side_by_side`, takes several keys and yields each with its own, or with
    the TrapsError that says why it has none. code: the code version; raise it when the formula changes, so that
    existing partitions become stale. cost: the main resource it uses besides time. wants: whether a study wants a key
    at all. lost: returns the missing files that a partition names. takes: the resources of a run on a host. shared: how
    several runs build a partition together, if they may.
    """

    name: str
    table: Table | None
    make: Callable[[Workspace, Any], Any]
    group: str
    parents: Mapping[str, Parent]
    doc: str
    scheme: Partitioning | None
    checks: Sequence[Check]
    kinds: Sequence[str]
    code: str
    cost: Cost
    wants: Callable[[StudyPartitions, Any], bool]
    lost: Callable[[Workspace, Any], list[str]]
    takes: RunResources = RunResources()
    shared: ConcurrentBuild | None = None
    side_by_side: bool = False

    def columns(self, key: str | None) -> Mapping[str, Any]:
        """Return the values of the table's partition columns, by name, for a key."""
        return {} if self.scheme is None or key is None else self.scheme.columns(key)

    def wanted(self, partitions: StudyPartitions) -> list[str | None]:
        """Return the partition keys that a study wants, in key order."""
        keys: Sequence[str | None] = [None] if self.scheme is None else self.scheme.wanted(partitions)
        return [key for key in keys if self.wants(partitions, key)]


DECLARED: dict[str, Stage | Source] = {}  # by name; filled as stages are imported


@dataclass(frozen=True, eq=False)
class Graph:
    """All declared stages and sources, their partition keys, and each partition's upstream partitions."""

    declared: Mapping[str, Stage | Source] = field(default_factory=lambda: DECLARED)

    @cached_property
    def parents_of(self) -> Mapping[str, Mapping[str, Parent]]:
        """The upstream assets of each stage, by name; empty for a source."""
        return {
            name: declaration.parents if isinstance(declaration, Stage) else {}
            for name, declaration in self.declared.items()
        }

    def __getitem__(self, name: str) -> Stage:
        declaration = self.declared.get(name)
        if not isinstance(declaration, Stage):
            stage_names = [stage.name for stage in self.stages]
            raise TrapsError(
                f"no stage {name!r}{did_you_mean(name, stage_names) or '; choose from ' + ', '.join(stage_names)}"
            )
        return declaration

    def source(self, name: str) -> Source | None:
        """Return the source of that name; None for a stage."""
        declaration = self.declared[name]
        return declaration if isinstance(declaration, Source) else None

    @cached_property
    def sources(self) -> list[str]:
        """The names of all sources: files that people edit and stages read."""
        return [name for name, declaration in self.declared.items() if isinstance(declaration, Source)]

    def blocks(self, names: Collection[str] | None = None) -> list[list[Stage]]:
        """Return stages (default: all) in order, in blocks that one run can materialize.

        The stages of a block share a scheme, and no stage of another scheme lies between them. Ready stages follow the
        order of `GROUPS`.
        """
        remaining = {
            name: declaration
            for name, declaration in self.declared.items()
            if isinstance(declaration, Stage) and (names is None or name in names)
        }
        upstream = {name: {p for p in self.parents_of[name] if p in remaining} for name in remaining}
        result: list[list[Stage]] = []
        while remaining:
            ready_stages = [name for name in remaining if not upstream[name] & remaining.keys()]
            if not ready_stages:
                raise TrapsError(f"the graph has a circle among {', '.join(remaining)}")
            first = min(ready_stages, key=lambda name: GROUPS.index(remaining[name].group))
            scheme, block = remaining[first].scheme, list[Stage]()
            while ready_stages:
                block += [remaining.pop(name) for name in ready_stages if remaining[name].scheme is scheme]
                ready_stages = [
                    n for n in remaining if remaining[n].scheme is scheme and not upstream[n] & remaining.keys()
                ]
            result.append(block)
        return result

    @cached_property
    def stages(self) -> list[Stage]:
        """All stages, in topological order."""
        return [stage for block in self.blocks() for stage in block]

    def above(self, names: Iterable[str]) -> set[str]:
        """Return the names of these stages, and of all stages upstream of them."""
        return {name for name in _reached(names, self.parents_of.__getitem__) if isinstance(self.declared[name], Stage)}

    def below(self, name: str) -> set[str]:
        """Return the names of the stages directly downstream of a stage."""
        return {child for child, parents in self.parents_of.items() if name in parents}

    def all_below(self, name: str) -> set[str]:
        """Return the names of a stage and of all stages downstream of it."""
        return _reached([name], self.below)

    @cache  # noqa: B019 - a graph lives as long as its process
    def keys(self, name: str) -> list[str | None]:
        """Return all partition keys of a stage or source, in order."""
        scheme = self.declared[name].scheme
        return [None] if scheme is None else [*scheme.keys]

    @cache  # noqa: B019 - a graph lives as long as its process
    def parents(self, name: str, key: str | None) -> Mapping[str, Sequence[str | None]]:
        """Return every partition upstream of one, existing or not, by stage or source."""
        scheme = self.declared[name].scheme
        if key is not None and (scheme is None or key not in scheme.known):
            return {}  # a key of an experiment that was removed from the study
        return {
            parent.name: [None] if (parent_scheme := self.declared[parent.name].scheme) is None
            else self.mapping(name, parent.name).above(key, scheme, parent_scheme)
            for parent in self.parents_of[name].values()
        }  # fmt: skip

    def mapping(self, name: str, parent: str) -> KeyMapping:
        """Return the mapping by which a stage's partition selects partitions of a partitioned parent."""
        scheme, stated_mapping = self.declared[name].scheme, self.parents_of[name][parent].mapping
        return stated_mapping or (SAME if scheme is self.declared[parent].scheme else EVERY)


def _reached(names: Iterable[str], neighbours: Callable[[str], Iterable[str]]) -> set[str]:
    reached, remaining = set[str](), [*names]
    while remaining:
        if (name := remaining.pop()) not in reached:
            reached.add(name)
            remaining += neighbours(name)
    return reached


def name_of(node: Node) -> str:
    """Return a partition's name as footers store it: `stage` or `stage/key`."""
    return node[0] if node[1] is None else f"{node[0]}/{node[1]}"


@cache
def the_graph() -> Graph:
    """Return the graph. Raises RuntimeError unless `pipeline.stages` is imported."""
    if not DECLARED:
        raise RuntimeError("no stage is declared yet: import traps_pipeline.pipeline.stages first")
    return Graph()
