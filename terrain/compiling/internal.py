"""Internal loops: compiled functions that only other compiled loops call. They are compiled as part of their callers only.

Numba optimises each loop separately, generates its machine code and wraps that for Python and C. It then repeats all this for each
loop that calls it. An internal loop is optimised as part of its callers only, which saves the first pass.
"""

from __future__ import annotations

from typing import Any, NoReturn

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


def forbid_python_calls(loop: Any) -> None:
    """Make calls of a loop from Python raise ``TypeError``. The loop has no entry point for Python, so a call would crash."""
    loop._insert = _skip_registration
    loop._compile_for_args = _raise_for_python_call


def _skip_registration(*signature: object, **options: object) -> None:
    """Replace the method that registers a compiled signature for calls from Python. Do nothing."""


def _raise_for_python_call(*args: object, **keywords: object) -> NoReturn:
    """Replace the method that handles a call from Python without a compiled signature. Raise ``TypeError``."""
    raise TypeError("an internal loop can be called by compiled loops only")


class _NoEnvironment:
    """Code generator that discards the environment of a loop, which only the wrapper for Python reads."""

    def set_env(self, name: str, environment: object) -> None:
        """Discard the environment."""


class _LinkedLibrary(JITCodeLibrary):
    """Code that is linked into other libraries. These optimise it and generate its machine code."""

    @property
    def codegen(self) -> Any:
        """Return a code generator that discards the loop's environment."""
        return _NoEnvironment()

    def get_pointer_to_function(self, name: str) -> int:
        """Return 0, since the library has no machine code of its own."""
        return 0

    def _optimize_final_module(self) -> None:
        """Do nothing: the libraries that this one is linked into optimise it."""

    def _finalize_final_module(self) -> None:
        """Mark the library as final without generating machine code."""
        self._finalize_dynamic_globals()  # type: ignore[no-untyped-call]
        self._finalized = True


class InternalCompiler(Compiler):
    """Numba's compiler with a ``_LinkedLibrary`` as its output."""

    def define_pipelines(self) -> Any:
        """Return numba's pipelines, after the compiler's library is replaced by a ``_LinkedLibrary``."""
        name = self.state.func_id.func_qualname
        self.state.library = _LinkedLibrary(self.state.targetctx.codegen(), name)  # type: ignore[no-untyped-call]
        return super().define_pipelines()  # type: ignore[no-untyped-call]
