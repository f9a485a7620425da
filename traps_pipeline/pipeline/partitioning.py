"""Ways of partitioning, and which partitions of a parent one is made from, without Dagster.

Dagster's import alone takes longer than `traps status`; `pipeline.translation` puts these words into Dagster's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Protocol

from traps_pipeline.pipeline.wanted import StudyPartitions

SEPARATOR = "|"  # between the two dimensions of a key, as Dagster writes it


@dataclass(frozen=True, eq=False)
class Partitioning:
    """One way of partitioning.

    dimensions: the keys of each dimension by its name, one or two, in the order of their names. columns: the values of
    a table's partition columns for a key; wanted: a study's keys.
    """

    dimensions: Mapping[str, Sequence[str]]
    columns: Callable[[str], Mapping[str, Any]]
    wanted: Callable[[StudyPartitions], Sequence[str]]

    @cached_property
    def keys(self) -> Sequence[str]:
        """Every key, in order."""
        return [*map(SEPARATOR.join, product(*self.dimensions.values()))]

    @cached_property
    def known(self) -> frozenset[str]:
        """Every key, to look one up."""
        return frozenset(self.keys)

    @cached_property
    def key_of(self) -> Mapping[tuple[str, ...], str]:
        """Every key by the values of its columns, as the path of a file has them."""
        return {tuple(map(str, self.columns(key).values())): key for key in self.keys}

    def between(self, first: str, last: str) -> Sequence[str]:
        """Return the keys of a range as Dagster has them: of two dimensions, the rectangle between its corners."""
        spans = []
        for keys, start, end in zip(
            self.dimensions.values(), first.split(SEPARATOR), last.split(SEPARATOR), strict=True
        ):
            spans.append(keys[keys.index(start) : keys.index(end) + 1])
        return [*map(SEPARATOR.join, product(*spans))]


class KeyMapping(Protocol):
    """Says which partitions of a parent one is made from."""

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """Return the parent's keys for a key of the stage below (None where that has no partitions)."""
        ...


@dataclass(frozen=True)
class Every:
    """Every partition of the parent."""

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """See `KeyMapping`."""
        return above.keys


@dataclass(frozen=True)
class Same:
    """The partition of the same key."""

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """See `KeyMapping`."""
        return [key] if key in above.known and key is not None else []


EVERY, SAME = Every(), Same()


@dataclass(frozen=True)
class ByDimension:
    """The partitions that agree in a dimension; one side has that dimension alone, the other has another besides."""

    name: str

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """See `KeyMapping`."""
        assert key is not None and below is not None, "both sides have partitions"
        if len(above.dimensions) == 1:
            return [key.split(SEPARATOR)[[*below.dimensions].index(self.name)]]
        keys = [[key] if name == self.name else every for name, every in above.dimensions.items()]
        return [*map(SEPARATOR.join, product(*keys))]


@dataclass(frozen=True, eq=False)
class Pairs:
    """Partitions that are stated one by one. below: what is made from each partition of the parent."""

    below: Mapping[str, Sequence[str]]

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """See `KeyMapping`."""
        return [parent for parent, keys in self.below.items() if key in keys]


@dataclass(frozen=True)
class These:
    """The same partitions of the parent for every key."""

    keys: Sequence[str]

    def above(self, key: str | None, below: Partitioning | None, above: Partitioning) -> Sequence[str]:
        """See `KeyMapping`."""
        return self.keys
