"""Compiled loops: numba with its cache where one can be written, else without."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` with numba: no fast-math (results must not depend on the machine), GIL released.

    What belongs together it takes as a ``NamedTuple`` of its module, or of one that changes seldom: numba's cache notices a change
    of the function's own file alone, and goes by the order of the fields. What may be ``None`` is a parameter of its own, so that
    each variant is compiled without the code of the others.
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": False}
    try:
        loop = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # numba finds no writable place for its cache, as in a read-only installation
        return numba.njit(cache=False, **options)(function)
    _survive_renames(loop)
    return loop


def _survive_renames(loop: Any) -> None:
    """Let a cache of an older version count as empty. Numba reads its index before it compares versions, and cannot if the index
    names a tuple or a module that is no longer there.
    """
    cache = getattr(loop, "_cache", None)
    if cache is None:  # a plain function, where numba is told not to compile
        return
    index = cache._cache_file
    load = index._load_index

    def load_or_begin_anew() -> dict[Any, Any]:
        try:
            return load()
        except (AttributeError, ImportError):
            return {}

    index._load_index = load_or_begin_anew
