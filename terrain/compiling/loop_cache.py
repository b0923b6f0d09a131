"""Numba cache of one compiled loop, backed by the store. The cache key is a digest of all inputs of the machine code."""

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
from skugga.terrain.compiling.hooks import compile_needed_products
from skugga.terrain.compiling.store import LoopStore, default_store

ENTRY_FORMAT_VERSION = 1
"""Version of the format of cache entries."""

NUMBA_OPTIONS = (
    "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "DISABLE_INTEL_SVML", "ENABLE_AVX", "LLVM_REFPRUNE_PASS", "LLVM_REFPRUNE_FLAGS",
    "LOOP_VECTORIZE", "OPT", "SLP_VECTORIZE",
)  # fmt: skip
"""Numba settings that affect the machine code."""

MAX_LOOP_NAME_CHARS = 40
"""Number of characters of the loop's name in the name of its entry. The name helps people who inspect the folder."""

Loop = Any
"""A numba dispatcher. Numba's stubs lack most attributes of dispatchers and of compile results."""

log = logging.getLogger("skugga")

_rebuild: Callable[..., Any] = CompileResult._rebuild
_dumps: Callable[[Any], bytes] = dumps
_normalize_signature: Callable[[Any], tuple[tuple[Type, ...], Any]] = sigutils.normalize_signature

_store: list[LoopStore] = []
_inconsistent_loops: set[Loop] = set()

compile_recorders: list[Callable[[Loop, tuple[Type, ...]], None]] = []
"""Callbacks for each loop that this process compiles: called with the loop and the types of its arguments."""

_lock = threading.RLock()


def loop_store() -> LoopStore:
    """Return the store of compiled loops that this process uses. The first call creates it."""
    if not _store:
        _store.append(default_store())
    return _store[0]


class LoopCache(_Cache):
    """Disk cache of one compiled loop (a numba dispatcher), with an entry for each signature.

    The digest of a loop is computed when the loop is first compiled or read, and does not change after that. Suppose that a later
    computation gives another digest, for example because a test replaced a global. From then on the loop and its callers are
    compiled without the store, since the machine code of this process may mix old and new values.

    Parameters
    ----------
    dispatcher
        The loop.
    is_stored
        Whether its machine code is stored. An internal loop is not stored: its code and its digest are part of its callers'.
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
        """Read and write this loop's machine code in the store from now on."""
        self._enabled = True

    def disable(self) -> None:
        """Neither read nor write this loop's machine code in the store from now on."""
        self._enabled = False

    def flush(self) -> None:
        """Do nothing: the cache key covers the content, so no entry can be stale."""

    def digest(self) -> str:
        """Return the digest of the loop and of all loops that it calls.

        Raises
        ------
        UnknownValueError
            If the loop or one of its callees reads a value that has no digest, or a value that has changed.
        """
        with _lock:
            return _digest_of(self._dispatcher, ())

    def entry_name(self, args: tuple[Type, ...], target: Hashable) -> str | None:
        """Return the name of the cache entry of a signature, or ``None`` if the loop cannot be stored."""
        try:
            loop_digest = self.digest()
        except UnknownValueError as error:
            log.debug("%s: cannot be stored: it reads %s", self._dispatcher, error)
            return None
        readable = re.sub(r"\W", "", self._dispatcher.py_func.__name__)[:MAX_LOOP_NAME_CHARS]
        return f"{readable}-{digest((_codegen_inputs(target), loop_digest, describe_types(args)))[:40]}"

    def load_overload(self, sig: Any, target_context: Any) -> Any | None:
        """Return the stored machine code of a signature as numba's compile result, or ``None`` on a cache miss."""
        args = _normalize_signature(sig)[0]
        if not self._enabled:
            with suppress(UnknownValueError):
                self.digest()  # fix the digest now: callers that are compiled later include the same values
            return None
        overload = self._read(args, target_context)
        if overload is None and compile_needed_products():  # the hook may have compiled it in another process
            overload = self._read(args, target_context)
        return overload

    def save_overload(self, sig: Any, data: Any) -> None:
        """Write the machine code ``data`` (numba's compile result) of a signature to the store."""
        if not self._enabled:
            return
        args = _normalize_signature(sig)[0]
        for record in compile_recorders:
            record(self._dispatcher, args)
        if data.library.has_dynamic_globals or data.lifted:
            return
        name = self.entry_name(args, data.codegen.magic_tuple())
        if name is not None:
            library, description, environment, *rest = data._reduce()
            rest[3] = ""  # annotated source, unused
            loop_store().write(name, _dumps((library, description, environment, *rest)))

    def _read(self, args: tuple[Type, ...], target_context: Any) -> Any | None:
        """Return the stored machine code for some argument types as numba's compile result; ``None`` if it cannot be loaded.

        ``target_context`` is numba's context of the processor.
        """
        name = self.entry_name(args, target_context.codegen().magic_tuple())
        content = None if name is None else loop_store().read(name)
        if content is None:
            return None
        # Numba would refresh the whole context here. That takes half a second and only compiling needs it.
        rtsys.initialize(target_context)
        try:
            return _rebuild(target_context, *pickle.loads(content))
        except (AttributeError, ImportError, EOFError, pickle.UnpicklingError, TypeError) as error:
            log.warning("%s: entry %s cannot be loaded (%s). Its loop is compiled again.", loop_store().folder, name, error)
            return None


def _digest_of(dispatcher: Loop, callers: tuple[Loop, ...]) -> str:
    """Return the digest of a loop that is reached through a chain of ``callers``.

    A recursive call is described by its position in the chain.
    """
    if dispatcher in callers:
        return f"caller {callers[::-1].index(dispatcher)}"
    cache = dispatcher._cache
    cached_digest = cache._digest if isinstance(cache, LoopCache) else None
    if cached_digest is not None and callers and not _inconsistent_loops:
        return cached_digest
    function = dispatcher.py_func
    options = tuple(sorted((name, repr(value)) for name, value in dispatcher.targetoptions.items()))
    current_digest = digest((options, describe_function(function, lambda callee: _digest_of(callee, (*callers, dispatcher)))))
    if isinstance(cache, LoopCache):
        if cached_digest not in (None, current_digest):
            _inconsistent_loops.add(dispatcher)
        if dispatcher in _inconsistent_loops:
            raise UnknownValueError(f"values that have changed since {dispatcher} was compiled")
        cache._digest = current_digest
    return current_digest


def _codegen_inputs(target: Hashable) -> Hashable:
    """Return the inputs that the machine code of every loop depends on: versions, the processor, settings."""
    return (
        ENTRY_FORMAT_VERSION, sys.implementation.cache_tag, numba.__version__, llvmlite.__version__, np.__version__.split(".")[:2],
        target,
        tuple((name, repr(getattr(config, name, None))) for name in NUMBA_OPTIONS),
    )  # fmt: skip
