"""Loops that only other compiled loops call: they are compiled as a part of their callers, and nothing else is made of them.

Numba optimises each loop by itself, makes machine code of it and wraps that for Python and for C, and then does it all again for
each loop that calls it. An internal loop is optimised as a part of its callers alone.
"""

from __future__ import annotations

from typing import Any, NoReturn

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


def hide_from_python(loop: Any) -> None:
    """Let calls of a loop from Python raise ``TypeError``: it has no entry for them, and one would crash."""
    loop._insert = _keep_from_python
    loop._compile_for_args = _refuse


def _keep_from_python(*signature: object, **options: object) -> None:
    """Stand for what would put a compiled loop where a call of Python finds it."""


def _refuse(*args: object, **keywords: object) -> NoReturn:
    """Stand for what a call of Python does that finds no compiled loop."""
    raise TypeError("an internal loop can be called by compiled loops alone")


class _NoEnvironment:
    """Takes the environment of a loop, which only its wrapper for Python would read."""

    def set_env(self, name: str, environment: object) -> None:
        """Drop it."""


class _LinkedLibrary(JITCodeLibrary):
    """Code that is linked into other libraries, which optimise it and make machine code of it."""

    @property
    def codegen(self) -> Any:
        return _NoEnvironment()

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _optimize_final_module(self) -> None:
        """Leave that to the libraries that this one is linked into."""

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True


class InternalCompiler(Compiler):
    """Numba's compiler, writing to a ``_LinkedLibrary``."""

    def define_pipelines(self) -> Any:
        name = self.state.func_id.func_qualname
        self.state.library = _LinkedLibrary(self.state.targetctx.codegen(), name)  # type: ignore[no-untyped-call]
        return super().define_pipelines()  # type: ignore[no-untyped-call]
