"""Define partitioning schemes, and mappings between partitions, without Dagster.

Importing Dagster takes longer than `traps status`; `pipeline.translation` translates these classes into Dagster's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Protocol

from typing_extensions import override

from traps_pipeline.pipeline.wanted import StudyPartitions

SEPARATOR = "|"  # between the two dimensions of a key, as Dagster writes it


@dataclass(frozen=True, eq=False)
class Partitioning:
    """A scheme that divides an asset into partitions: the names of its dimensions and their keys.

    dimensions: the keys of each dimension by its name, one or two, sorted by name. columns: returns the values of a
    table's partition columns for a key; wanted: returns a study's keys.
    """

    dimensions: Mapping[str, Sequence[str]]
    columns: Callable[[str], Mapping[str, Any]]
    wanted: Callable[[StudyPartitions], Sequence[str]]

    @cached_property
    def keys(self) -> Sequence[str]:
        """The partition keys of all dimensions, in Dagster's order."""
        return [*map(SEPARATOR.join, product(*self.dimensions.values()))]

    @cached_property
    def known(self) -> frozenset[str]:
        """The set of all keys, for look-ups."""
        return frozenset(self.keys)

    @cached_property
    def key_of(self) -> Mapping[tuple[str, ...], str]:
        """Each key by the values of its columns, as in a file's path."""
        return {tuple(map(str, self.columns(key).values())): key for key in self.keys}

    def between(self, first: str, last: str) -> Sequence[str]:
        """Return the keys of a range, in two dimensions a rectangle, as Dagster does."""
        spans = []
        for keys, start, end in zip(
            self.dimensions.values(), first.split(SEPARATOR), last.split(SEPARATOR), strict=True
        ):
            spans.append(keys[keys.index(start) : keys.index(end) + 1])
        return [*map(SEPARATOR.join, product(*spans))]


class KeyMapping(Protocol):
    """Selects the upstream partitions of a partition."""

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """Return the parent's keys for a downstream key (None: no partitions)."""
        ...


@dataclass(frozen=True)
class Every(KeyMapping):
    """A mapping to all partitions of the upstream asset."""

    @override
    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        return above.keys


@dataclass(frozen=True)
class SameKeys(KeyMapping):
    """A mapping to the upstream partition of the same key."""

    @override
    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        return [key] if key in above.known and key is not None else []


EVERY, SAME = Every(), SameKeys()


@dataclass(frozen=True)
class ByDimension(KeyMapping):
    """A mapping to partitions that agree in one dimension; one side has only that, the other two."""

    name: str

    @override
    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        assert key is not None and below is not None, "both sides have partitions"
        if len(above.dimensions) == 1:
            return [key.split(SEPARATOR)[[*below.dimensions].index(self.name)]]
        keys = [[key] if name == self.name else dimension_keys for name, dimension_keys in above.dimensions.items()]
        return [*map(SEPARATOR.join, product(*keys))]


@dataclass(frozen=True, eq=False)
class Pairs(KeyMapping):
    """A mapping listed key by key: the downstream keys of each upstream partition."""

    below: Mapping[str, Sequence[str]]

    @override
    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        return [parent for parent, keys in self.below.items() if key in keys]


@dataclass(frozen=True)
class FixedKeys(KeyMapping):
    """A mapping of every key to the same upstream partitions."""

    keys: Sequence[str]

    @override
    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        return self.keys
