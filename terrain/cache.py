"""Caches with a name, a limit in bytes and a lifetime. One call empties them all.

A cache key consists of the objects that a value was computed from:

- Objects that compare by identity (a scene, its elevation, a buffer, an array) are referenced weakly. A cache keeps none of them
  alive. An entry is evicted when one of these objects is collected.
- All other parts (numbers, names, frozen values) are compared by equality.
"""

from __future__ import annotations

import sys
import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from functools import update_wrapper
from threading import RLock
from typing import Any, Generic, Literal, ParamSpec, TypeVar

import numpy as np

P = ParamSpec("P")
V = TypeVar("V")

CacheLifetime = Literal["light", "scene", "process"]
"""How long the entries of a cache stay valid.

- ``light``: until the sun or a lamp moves, or until another input that changes from frame to frame does.
- ``scene``: as long as the scene that the value was computed for.
- ``process``: until the process ends, since the value belongs to no scene.
"""

KIB, MIB = 2**10, 2**20

_lock = RLock()  # shared by all caches: evicting an entry of one may empty another
_caches: weakref.WeakSet[Any] = weakref.WeakSet()


class IdentityKey(weakref.ref[Any]):
    """A weak reference that is hashed and compared by the identity of its object. It serves as a cache key."""

    __slots__ = ("object_id",)
    object_id: int

    def __new__(cls, referent: object, on_collected: Callable[[Any], None] | None = None) -> IdentityKey:
        """Return the key of an object. ``on_collected`` is called with the key when the object is garbage-collected."""
        self = super().__new__(cls, referent, on_collected)
        self.object_id = id(referent)
        return self

    def __eq__(self, other: object) -> bool:
        """Return whether both keys refer to the same object, which is still alive."""
        return isinstance(other, IdentityKey) and self() is not None and self() is other()

    def __hash__(self) -> int:
        """Return the identity of the object, also after it was garbage-collected."""
        return self.object_id


def _is_compared_by_identity(part: object) -> bool:
    """Return whether a part of a key is compared by identity: an array, or an instance of a class without ``__eq__`` of its own."""
    kind = type(part)
    return kind is np.ndarray or (kind.__hash__ is object.__hash__ and kind.__weakrefoffset__ > 0 and kind is not _FunctionType)


_FunctionType = type(lambda: None)


def _key_of(key_parts: Iterable[object], on_collected: Callable[[Any], None] | None = None) -> tuple[Hashable, ...]:
    """Return the cache key of some parts.

    ``on_collected`` is called when a part that is compared by identity is garbage-collected.
    """
    return tuple(IdentityKey(part, on_collected) if _is_compared_by_identity(part) else part for part in key_parts)


class Missing:
    """The type of ``MISSING``, which ``Cache.get`` returns where the cache holds no entry. ``None`` is a valid value."""


MISSING = Missing()


class Cache(Generic[V]):
    """A least-recently-used cache with a limit in bytes. Thread-safe.

    Parameters
    ----------
    name
        The cache's name.
    lifetime
        How long its entries stay valid.
    limit_bytes
        Upper bound of the size of all values together. A single larger value is stored only if the cache has a ``release``.
    size_of
        Function that returns the size of a value in bytes. Default: ``estimated_bytes``.
    release
        Function that is called with each evicted value. The newest value is never evicted to make room, because its caller uses it.
    max_entries
        Upper bound of the number of entries.
    """

    def __init__(
        self,
        name: str,
        lifetime: CacheLifetime,
        limit_bytes: int,
        size_of: Callable[[V], int] | None = None,
        release: Callable[[V], None] | None = None,
        max_entries: int | None = None,
    ) -> None:
        self.name, self.lifetime, self.limit_bytes, self.max_entries = name, lifetime, limit_bytes, max_entries
        self.nbytes = 0
        self._size_of = size_of or estimated_bytes
        self._release = release
        self._values: OrderedDict[tuple[Hashable, ...], tuple[V, int]] = OrderedDict()
        register_cache(self)

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self._values)

    @property
    def values(self) -> list[V]:
        """All values, least recently used first."""
        with _lock:
            return [value for value, _ in self._values.values()]

    def get(self, *key_parts: object) -> V | Missing:
        """Return the value of a key, or ``MISSING``. ``key_parts`` are the objects that make up the key."""
        key = _key_of(key_parts)
        with _lock:
            entry = self._values.get(key)
            if entry is None:
                return MISSING
            self._values.move_to_end(key)
            return entry[0]

    def get_several(self, first_parts: tuple[object, ...], last_parts: Iterable[tuple[Hashable, ...]]) -> list[V | Missing]:
        """Return what ``get`` returns for several keys that begin with the same parts.

        Their ``last_parts`` are compared by equality. A loop of ``get`` takes several times as long.
        """
        first = _key_of(first_parts)
        found: list[V | Missing] = []
        with _lock:
            for last in last_parts:
                key = (*first, *last)
                entry = self._values.get(key)
                if entry is None:
                    found.append(MISSING)
                else:
                    self._values.move_to_end(key)
                    found.append(entry[0])
        return found

    def put(self, *key_parts: object, value: V) -> None:
        """Store a value under a key. Evict the least recently used entries until the limits hold."""
        size = self._size_of(value)
        key = self._key(key_parts)
        with _lock:
            self._drop(key)
            if size > self.limit_bytes and self._release is None:
                return
            self._values[key] = value, size
            self.nbytes += size
            while self.nbytes > self.limit_bytes and len(self._values) > 1:
                self._drop(next(iter(self._values)))
            if self.max_entries is not None:
                self.trim(self.max_entries)

    def trim(self, max_entries: int) -> None:
        """Evict all entries except the ``max_entries`` that were used last."""
        with _lock:
            while len(self._values) > max_entries:
                self._drop(next(iter(self._values)))

    def drop(self, *key_parts: object) -> None:
        """Evict the entry of a key."""
        with _lock:
            self._drop(_key_of(key_parts))

    def clear(self) -> None:
        """Evict all entries."""
        with _lock:
            while self._values:
                self._drop(next(iter(self._values)))

    def evict_computed_from(self, elevation: object) -> None:
        """Evict the entries whose key contains ``elevation`` or an object with that elevation."""
        with _lock:
            for key in list(self._values):
                sources = [part() for part in key if isinstance(part, IdentityKey)]
                if any(source is elevation or getattr(source, "elevation", None) is elevation for source in sources):
                    self._drop(key)

    def _key(self, key_parts: Iterable[object]) -> tuple[Hashable, ...]:
        """Return the cache key of some parts.

        Its entry is evicted when a part that is compared by identity is garbage-collected.
        """
        key_holder: list[tuple[Hashable, ...]] = []
        cache_ref = weakref.ref(self)

        def on_collected(_: object) -> None:
            cache = cache_ref()
            if cache is not None and key_holder and not sys.is_finalizing():
                with _lock:
                    cache._drop(key_holder[0])

        key = _key_of(key_parts, on_collected)
        key_holder.append(key)
        return key

    def _drop(self, key: tuple[Hashable, ...]) -> None:
        """Evict the entry of a key, if there is one, and release its value."""
        entry = self._values.pop(key, None)
        if entry is not None:
            value, size = entry
            self.nbytes -= size
            if self._release is not None:
                self._release(value)


class CachedFunction(Generic[P, V]):
    """A function that stores its latest results in ``cache``."""

    def __init__(self, function: Callable[P, V], cache: Cache[V], key: Callable[P, tuple[object, ...]] | None) -> None:
        self.cache = cache
        self._function, self._key = function, key
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> V:
        """Return the cached result for some arguments, or compute and store it."""
        parts = self._key(*args, **kwargs) if self._key is not None else (*args, *sorted(kwargs.items()))
        result = self.cache.get(*parts)
        if isinstance(result, Missing):
            result = self._function(*args, **kwargs)
            self.cache.put(*parts, value=result)
        return result


def cached(
    lifetime: CacheLifetime,
    limit_bytes: int,
    key: Callable[..., tuple[object, ...]] | None = None,
    size_of: Callable[[Any], int] | None = None,
    max_entries: int | None = None,
) -> Callable[[Callable[P, V]], CachedFunction[P, V]]:
    """Return a decorator that caches a function's results.

    Parameters
    ----------
    lifetime, limit_bytes, size_of, max_entries
        As in ``Cache``. The cache is named after the function.
    key
        Returns the cache key for the function's arguments. Default: all arguments.
    """

    def decorate(function: Callable[P, V]) -> CachedFunction[P, V]:
        cache: Cache[V] = Cache(
            f"{function.__module__}.{function.__qualname__}", lifetime, limit_bytes, size_of, max_entries=max_entries
        )
        return CachedFunction(function, cache, key)

    return decorate


def register_cache(cache: Any) -> None:
    """Register a cache of another class, so that ``caches`` and ``clear_caches`` include it.

    It needs ``name``, ``lifetime``, ``limit_bytes``, ``nbytes``, ``__len__``, ``clear`` and ``evict_computed_from``, as ``Cache``
    has them.
    """
    with _lock:
        _caches.add(cache)


def caches(*lifetimes: CacheLifetime) -> list[Cache[Any]]:
    """Return the caches of this process with one of some lifetimes (default: all of them), sorted by name."""
    with _lock:
        return sorted((cache for cache in _caches if not lifetimes or cache.lifetime in lifetimes), key=lambda cache: cache.name)


def clear_caches(*lifetimes: CacheLifetime) -> None:
    """Empty the caches with one of some lifetimes (default: all caches).

    After ``clear_caches("light")`` the next frame recomputes all that a moving sun changes. ``clear_caches("light", "scene")``
    discards everything that was computed from a level's files.
    """
    for cache in caches(*lifetimes):
        cache.clear()


def clear_scene_caches(elevation: object) -> None:
    """Evict the entries computed from an ``Elevation``, or from an object that holds it, such as a scene.

    Entries of other scenes stay.
    """
    for cache in caches("light", "scene"):
        cache.evict_computed_from(elevation)


def estimated_bytes(value: object) -> int:
    """Estimate the bytes of a value and of all objects that it references."""
    visited_ids: set[int] = set()
    pending, total = [value], 0
    while pending:
        item = pending.pop()
        if item is None or id(item) in visited_ids:
            continue
        visited_ids.add(id(item))
        nbytes = getattr(item, "nbytes", None)
        if isinstance(nbytes, int):
            total += nbytes
            continue
        total += sys.getsizeof(item)
        if isinstance(item, dict):
            pending += [*item.keys(), *item.values()]
        elif isinstance(item, list | tuple | set | frozenset):
            pending += item
        elif hasattr(item, "__dict__") and not isinstance(item, type | _FunctionType):
            pending += vars(item).values()
    return total
