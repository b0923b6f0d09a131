"""Loops that only other compiled loops call: they are compiled into their callers, and nothing else is made of them."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import numba
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler
from numba.core.dispatcher import Dispatcher

from terrain.compiling.loop_cache import LoopCache

P = ParamSpec("P")
R = TypeVar("R")


def internal(function: Callable[P, R]) -> Callable[P, R]:
    """Compile ``function`` for compiled loops alone, by the rules of ``terrain.compiled.compiled``.

    Numba optimises each loop by itself, makes machine code of it and wraps that for Python and for C, and then does it all again
    for each loop that calls it. An internal loop is optimised as a part of its callers alone. No cache holds it, for they hold
    theirs. Python cannot call it.

    Parameters
    ----------
    function : callable
        A loop in the subset of Python that numba compiles.

    Returns
    -------
    callable
        What compiled loops call.
    """
    loop: Callable[P, R] = numba.njit(
        pipeline_class=_InternalCompiler, no_cpython_wrapper=True, no_cfunc_wrapper=True, nogil=True, error_model="numpy",
        fastmath=False,
    )(function)  # fmt: skip
    if isinstance(loop, Dispatcher):  # else a plain function, where numba is told not to compile
        vars(loop)["_cache"] = LoopCache(loop, is_stored=False)
    return loop


@ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.py_object, ctypes.py_object, ctypes.py_object)
def _refuse(environment: object, args: object, keywords: object) -> object:
    """Stand where Python would call an internal loop."""
    raise TypeError("an internal loop can be called by compiled loops alone")


class _NoEnvironment:
    """Takes the environment of a loop, which only its wrapper for Python would read."""

    def set_env(self, name: str, environment: object) -> None:
        """Drop it."""


class _LinkedLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Code that is linked into other libraries, which optimise it and make machine code of it."""

    @property
    def codegen(self) -> Any:
        return _NoEnvironment()

    def get_pointer_to_function(self, name: str) -> int | None:
        return ctypes.cast(_refuse, ctypes.c_void_p).value

    def _optimize_final_module(self) -> None:
        """Leave that to the libraries that this one is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _InternalCompiler(Compiler):  # type: ignore[misc]
    """Numba's compiler, writing to a ``_LinkedLibrary``."""

    def define_pipelines(self) -> Any:
        self.state.library = _LinkedLibrary(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return super().define_pipelines()
