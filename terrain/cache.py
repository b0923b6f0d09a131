"""A least-recently-used cache bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

V = TypeVar("V")


class ByteCache(Generic[V]):
    """Keeps the values used last, at most ``limit_bytes`` of them. Not thread-safe.

    ``size_of`` gives a value's bytes. A value larger than the limit is handed through, not kept.
    """

    def __init__(self, limit_bytes: int, size_of: Callable[[V], int]) -> None:
        self.limit_bytes = limit_bytes
        self.bytes = 0
        self._size_of = size_of
        self._values: OrderedDict[Hashable, V] = OrderedDict()

    def __len__(self) -> int:
        return len(self._values)

    def get(self, key: Hashable) -> V | None:
        """The value of a key, or ``None``."""
        if key not in self._values:
            return None
        self._values.move_to_end(key)
        return self._values[key]

    def put(self, key: Hashable, value: V) -> None:
        """Keep a value and let go of the oldest ones until the limit holds."""
        self.drop(key)
        size = self._size_of(value)
        if size > self.limit_bytes:
            return
        self._values[key] = value
        self.bytes += size
        while self.bytes > self.limit_bytes:
            _, old = self._values.popitem(last=False)
            self.bytes -= self._size_of(old)

    def drop(self, key: Hashable) -> None:
        """Forget a key."""
        old = self._values.pop(key, None)
        if old is not None:
            self.bytes -= self._size_of(old)
