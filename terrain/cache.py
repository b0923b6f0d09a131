"""What is kept: every cache there is has a name, a bound in bytes, and a time that its values last; one call empties them.

Values lie under the objects that they were made from. What compares by identity (a scene, its ground, a buffer, an array) is held
weakly: nothing is kept alive by a cache, and a value goes when something that it was made from does. All else (numbers, names,
frozen values) is compared.
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

Lasts = Literal["light", "scene", "process"]
"""How long values last: until the light moves (or anything else does that they show); as long as the scene that they were made
for; or as long as the process, for they belong to no scene.
"""

KIB, MIB = 2**10, 2**20

_lock = RLock()  # one for all: letting go of a value of one cache may empty another
_caches: weakref.WeakSet[Any] = weakref.WeakSet()


class IdentityKey(weakref.ref[Any]):
    """A weak reference that equals those to the same living object: a key for what has no equality of that kind."""

    __slots__ = ("number",)
    number: int

    def __new__(cls, of: object, gone: Callable[[Any], None] | None = None) -> IdentityKey:
        self = super().__new__(cls, of, gone)
        self.number = id(of)
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, IdentityKey) and self() is not None and self() is other()

    def __hash__(self) -> int:
        return self.number


def _by_identity(part: object) -> bool:
    """Whether a part of a key goes by identity: it is an array, or of a class without an equality of its own."""
    kind = type(part)
    return kind is np.ndarray or (kind.__hash__ is object.__hash__ and kind.__weakrefoffset__ > 0 and kind is not _Function)


_Function = type(lambda: None)


def _key_of(parts: Iterable[object], gone: Callable[[Any], None] | None = None) -> tuple[Hashable, ...]:
    """The key under which a value lies that was made from some parts; ``gone`` is called when one that goes by identity does."""
    return tuple(IdentityKey(part, gone) if _by_identity(part) else part for part in parts)


class Missing:
    """What ``Cache.get`` answers where there is nothing; a value may be ``None``."""


MISSING = Missing()


class Cache(Generic[V]):
    """The values used last, of at most ``limit_bytes`` together. To be used from any thread.

    ``size_of`` gives a value's bytes: one larger than the limit is handed through, not kept. ``release`` is called with a value
    that is let go, and never with the newest one to make room for it: whoever put it there uses it. ``most`` bounds their number.
    """

    def __init__(
        self,
        name: str,
        lifetime: Lasts,
        limit_bytes: int,
        size_of: Callable[[V], int] | None = None,
        release: Callable[[V], None] | None = None,
        most: int | None = None,
    ) -> None:
        self.name, self.lifetime, self.limit_bytes, self.most = name, lifetime, limit_bytes, most
        self.nbytes = 0
        self._size_of = size_of or bytes_of
        self._release = release
        self._values: OrderedDict[tuple[Hashable, ...], tuple[V, int]] = OrderedDict()
        register_cache(self)

    def __len__(self) -> int:
        return len(self._values)

    @property
    def values(self) -> list[V]:
        """All values, the one used last at the end."""
        with _lock:
            return [value for value, _ in self._values.values()]

    def get(self, *parts: object) -> V | Missing:
        """The value under a key of some parts, or ``MISSING``."""
        key = _key_of(parts)
        with _lock:
            found = self._values.get(key)
            if found is None:
                return MISSING
            self._values.move_to_end(key)
            return found[0]

    def put(self, *parts: object, value: V) -> None:
        """Keep a value under a key, and let go of the oldest ones until the bounds hold."""
        size = self._size_of(value)
        key = self._key(parts)
        with _lock:
            self._drop(key)
            if size > self.limit_bytes and self._release is None:
                return
            self._values[key] = value, size
            self.nbytes += size
            while self.nbytes > self.limit_bytes and len(self._values) > 1:
                self._drop(next(iter(self._values)))
            if self.most is not None:
                self.trim(self.most)

    def trim(self, most: int) -> None:
        """Let go of all but the ``most`` values used last."""
        with _lock:
            while len(self._values) > most:
                self._drop(next(iter(self._values)))

    def drop(self, *parts: object) -> None:
        """Forget the value under a key."""
        with _lock:
            self._drop(_key_of(parts))

    def clear(self) -> None:
        """Forget all."""
        with _lock:
            while self._values:
                self._drop(next(iter(self._values)))

    def clear_of(self, owner: object) -> None:
        """Forget what was made from an object, or from one that has it as its ``elevation``: a scene's ground is its own."""
        with _lock:
            for key in list(self._values):
                made_from = [part() for part in key if isinstance(part, IdentityKey)]
                if any(each is owner or getattr(each, "elevation", None) is owner for each in made_from):
                    self._drop(key)

    def _key(self, parts: Iterable[object]) -> tuple[Hashable, ...]:
        """A key whose value goes as soon as one of its parts does."""
        held: list[tuple[Hashable, ...]] = []
        cache_ref = weakref.ref(self)

        def gone(_: object) -> None:
            cache = cache_ref()
            if cache is not None and held and not sys.is_finalizing():
                with _lock:
                    cache._drop(held[0])

        key = _key_of(parts, gone)
        held.append(key)
        return key

    def _drop(self, key: tuple[Hashable, ...]) -> None:
        found = self._values.pop(key, None)
        if found is not None:
            value, size = found
            self.nbytes -= size
            if self._release is not None:
                self._release(value)


class CachedFunction(Generic[P, V]):
    """A function whose last values are kept in ``cache``."""

    def __init__(self, function: Callable[P, V], cache: Cache[V], key: Callable[P, tuple[object, ...]] | None) -> None:
        self.cache = cache
        self._function, self._key = function, key
        update_wrapper(self, function)

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> V:
        parts = self._key(*args, **kwargs) if self._key is not None else (*args, *sorted(kwargs.items()))
        found = self.cache.get(*parts)
        if isinstance(found, Missing):
            found = self._function(*args, **kwargs)
            self.cache.put(*parts, value=found)
        return found


def cached(
    lifetime: Lasts,
    limit_bytes: int,
    key: Callable[..., tuple[object, ...]] | None = None,
    size_of: Callable[[Any], int] | None = None,
    most: int | None = None,
) -> Callable[[Callable[P, V]], CachedFunction[P, V]]:
    """Keep a function's last values, ``most`` of them, in a cache of the function's name; ``key`` gives what of its arguments they
    go by.
    """

    def decorate(function: Callable[P, V]) -> CachedFunction[P, V]:
        cache: Cache[V] = Cache(f"{function.__module__}.{function.__qualname__}", lifetime, limit_bytes, size_of, most=most)
        return CachedFunction(function, cache, key)

    return decorate


def register_cache(cache: Any) -> None:
    """List what keeps values in a way of its own: it has ``name``, ``lifetime``, ``limit_bytes``, ``nbytes``, a length, ``clear``
    and ``clear_of`` as a ``Cache`` has.
    """
    with _lock:
        _caches.add(cache)


def caches(*lifetime: Lasts) -> list[Cache[Any]]:
    """All caches of this process whose values last so long (no word: any time), by name."""
    with _lock:
        return sorted((cache for cache in _caches if not lifetime or cache.lifetime in lifetime), key=lambda cache: cache.name)


def clear_caches(*lifetime: Lasts) -> None:
    """Empty the caches whose values last so long: ``clear_caches("light")`` makes the next frame pay all that a moving sun costs,
    ``clear_caches("light", "scene")`` all that follows from a level's files.
    """
    for cache in caches(*lifetime):
        cache.clear()


def clear_scene_caches(elevation: object) -> None:
    """Forget what was made from a scene's ground, or from anything that stands on it; other scenes' values stay."""
    for cache in caches("light", "scene"):
        cache.clear_of(elevation)


def bytes_of(value: object) -> int:
    """About how many bytes a value takes, with all that it holds."""
    seen: set[int] = set()
    todo, total = [value], 0
    while todo:
        each = todo.pop()
        if each is None or id(each) in seen:
            continue
        seen.add(id(each))
        nbytes = getattr(each, "nbytes", None)
        if isinstance(nbytes, int):
            total += nbytes
            continue
        total += sys.getsizeof(each)
        if isinstance(each, dict):
            todo += [*each.keys(), *each.values()]
        elif isinstance(each, list | tuple | set | frozenset):
            todo += each
        elif hasattr(each, "__dict__") and not isinstance(each, type | _Function):
            todo += vars(each).values()
    return total
