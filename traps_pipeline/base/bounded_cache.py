"""Cache values in memory up to a number of bytes; the least recently used one goes first."""

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar

Key = TypeVar("Key")
Value = TypeVar("Value")


class BoundedCache(Generic[Key, Value]):
    """A thread-safe cache of at most `most_bytes`, or of one value that is larger."""

    def __init__(self, most_bytes: int, size_of: Callable[[Value], int]) -> None:
        self.most_bytes, self._size_of = most_bytes, size_of
        self._held_bytes, self._lock = 0, Lock()
        self._kept: OrderedDict[Key, Value] = OrderedDict()

    def __len__(self) -> int:
        return len(self._kept)

    def get(self, key: Key, make: Callable[[], Value]) -> Value:
        """Return the cached value, or a new one; two threads may make the same one."""
        with self._lock:
            if key in self._kept:
                self._kept.move_to_end(key)
                return self._kept[key]
        value = make()
        with self._lock:
            if key not in self._kept:
                self._kept[key] = value
                self._held_bytes += self._size_of(value)
            while self._held_bytes > self.most_bytes and len(self._kept) > 1:
                self._held_bytes -= self._size_of(self._kept.popitem(last=False)[1])
        return value
