"""Numba's cache of one compiled loop, on the store: entries are named by the digest of all that their machine code depends on."""

from __future__ import annotations

import logging
import pickle
import re
import sys
import threading
from collections.abc import Callable, Hashable
from contextlib import suppress
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config, sigutils
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.types import Type

from skugga.terrain.compiling.digest import UnknownValueError, describe_function, describe_types, digest
from skugga.terrain.compiling.hooks import report_missing_loop
from skugga.terrain.compiling.store import LoopStore, default_store

ENTRY_FORMAT = 1
"""Version of what an entry holds."""

OPTIONS = (
    "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "DISABLE_INTEL_SVML", "ENABLE_AVX", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS",
    "LOOP_VECTORIZE", "OPT", "SLP_VECTORIZE",
)  # fmt: skip
"""Settings of numba that change machine code."""

NAME_LENGTH = 40
"""Characters of a loop's own name in the name of its entry, for people who look at the folder."""

Loop = Any
"""A dispatcher of numba, whose stubs lack most of what is used here; so do those of its compile results."""

log = logging.getLogger("skugga")

_rebuild: Callable[..., Any] = CompileResult._rebuild
_dumps: Callable[[Any], bytes] = dumps
_normalized: Callable[[Any], tuple[tuple[Type, ...], Any]] = sigutils.normalize_signature

_store: list[LoopStore] = []
_mixed: set[Loop] = set()

recorders: list[Callable[[Loop, tuple[Type, ...]], None]] = []
"""Functions that are called with each loop that was compiled in this process, and the types of its arguments."""

_lock = threading.RLock()


def loop_store() -> LoopStore:
    """Return the store of this process."""
    if not _store:
        _store.append(default_store())
    return _store[0]


class LoopCache(_Cache):
    """The cache of a dispatcher.

    The digest of a loop is computed when the loop is first compiled or read, and stays. A loop that would have another digest later
    (a test replaced a global, say) is compiled without the store from then on, and so are the loops that call it: the machine code
    of this process may then mix values of two times.

    Parameters
    ----------
    dispatcher
        The loop.
    is_stored
        Whether its machine code is stored. That of an internal loop is part of its callers'; its digest is part of theirs.
    """

    def __init__(self, dispatcher: Loop, is_stored: bool = True) -> None:
        self._dispatcher = dispatcher
        self._enabled = is_stored
        self._digest: str | None = None

    @property
    def cache_path(self) -> str:
        """The folder of the store."""
        return str(loop_store().folder)

    def enable(self) -> None:
        """Use the store."""
        self._enabled = True

    def disable(self) -> None:
        """Compile without the store."""
        self._enabled = False

    def flush(self) -> None:
        """Do nothing: entries are named by content, and none can be stale."""

    def digest(self) -> str:
        """Return the digest of the loop and of all loops that it calls.

        Raises
        ------
        UnknownValueError
            Where the loop, or one that it calls, reads a value that has no digest, or where its values have changed.
        """
        with _lock:
            return _digest_of(self._dispatcher, ())

    def entry_name(self, args: tuple[Type, ...], target: Hashable) -> str | None:
        """Return the name of the entry of a signature; ``None`` where the loop cannot be stored."""
        try:
            own = self.digest()
        except UnknownValueError as error:
            log.debug("%s is not stored: it reads %s", self._dispatcher, error)
            return None
        readable = re.sub(r"\W", "", self._dispatcher.py_func.__name__)[:NAME_LENGTH]
        return f"{readable}-{digest((_engine(target), own, describe_types(args)))[:40]}"

    def load_overload(self, sig: Any, target_context: Any) -> Any | None:
        """Return the stored machine code of a signature; ``None`` where there is none."""
        args = _normalized(sig)[0]
        if not self._enabled:
            with suppress(UnknownValueError):
                self.digest()  # what it is compiled with: callers that are compiled later hold the same
            return None
        found = self._read(args, target_context)
        if found is None and report_missing_loop():  # what was called may have compiled it in another process
            found = self._read(args, target_context)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the machine code of a signature."""
        if not self._enabled:
            return
        args = _normalized(sig)[0]
        for record in recorders:
            record(self._dispatcher, args)
        if data.library.has_dynamic_globals or data.lifted:
            return
        name = self.entry_name(args, data.codegen.magic_tuple())
        if name is not None:
            library, description, environment, *rest = data._reduce()
            rest[3] = ""  # annotated source, which nothing here shows
            loop_store().write(name, _dumps((library, description, environment, *rest)))

    def _read(self, args: tuple[Type, ...], target_context: Any) -> Any | None:
        name = self.entry_name(args, target_context.codegen().magic_tuple())
        content = None if name is None else loop_store().read(name)
        if content is None:
            return None
        # Numba refreshes the whole context here, which takes half a second and serves compiling alone.
        rtsys.initialize(target_context)
        try:
            return _rebuild(target_context, *pickle.loads(content))
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError, TypeError) as error:
            log.warning("%s: entry %s cannot be used, and is compiled again: %s", loop_store().folder, name, error)
            return None


def _digest_of(dispatcher: Loop, callers: tuple[Loop, ...]) -> str:
    """Return the digest of a loop that ``callers`` call, one another; a loop that calls itself is named there by its place."""
    if dispatcher in callers:
        return f"caller {callers[::-1].index(dispatcher)}"
    cache = dispatcher._cache
    known = cache._digest if isinstance(cache, LoopCache) else None
    if known is not None and callers and not _mixed:
        return known
    function = dispatcher.py_func
    options = tuple(sorted((name, repr(value)) for name, value in dispatcher.targetoptions.items()))
    now = digest((options, describe_function(function, lambda callee: _digest_of(callee, (*callers, dispatcher)))))
    if isinstance(cache, LoopCache):
        if known not in (None, now):
            _mixed.add(dispatcher)
        if dispatcher in _mixed:
            raise UnknownValueError(f"values that have changed since {dispatcher} was compiled")
        cache._digest = now
    return now


def _engine(target: Hashable) -> Hashable:
    """What the machine code of every loop depends on: versions, the processor, settings."""
    return (
        ENTRY_FORMAT, sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, np.__version__.split(".")[:2], target,
        tuple((name, repr(getattr(config, name, None))) for name in OPTIONS),
    )  # fmt: skip
