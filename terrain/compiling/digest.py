"""Digest of a compiled loop: a content hash of everything that its machine code depends on.

Numba's own cache key covers the source file of the loop only. A loop also depends on the loops that it calls and on the values of
the globals that it reads. Compilation freezes both into the machine code. The digest covers them recursively. It leaves out
everything that does not change the machine code: line numbers, comments, docstrings, the path and the time of the file.
"""

from __future__ import annotations

import enum
import hashlib
from collections.abc import Callable, Hashable, Iterator
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType
from typing import Any

import numpy as np
from numba.core import types
from numba.core.dispatcher import Dispatcher

PACKAGES_IDENTIFIED_BY_NAME = frozenset({"_heapq", "builtins", "cmath", "heapq", "math", "numba", "numpy", "operator"})
"""Packages whose functions are identified by name. Their versions are part of the cache key of every loop."""

DigestFunction = Callable[[Dispatcher], str]


class UnknownValueError(TypeError):
    """A loop reads a value that has no digest."""


def digest(description: Hashable) -> str:
    """Return the SHA-256 digest of a nested tuple of numbers and strings."""
    return hashlib.sha256(repr(description).encode()).hexdigest()


def describe_function(function: FunctionType, digest_of_callee: DigestFunction) -> Hashable:
    """Describe a function by its bytecode, its constants, and the values of the globals and free variables that it reads.

    Parameters
    ----------
    function
        The uncompiled Python function.
    digest_of_callee
        Returns the digest of a compiled loop that the function calls.

    Returns
    -------
    Hashable
        A nested tuple of numbers and strings, equal for functions that compile to the same machine code.

    Raises
    ------
    UnknownValueError
        If the function reads a value of a type that this module cannot describe.
    """
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return (
        function.__module__,
        function.__qualname__,
        _describe_code(function.__code__, function.__doc__),
        tuple((name, _describe(cell.cell_contents, (), digest_of_callee)) for name, cell in cells),
        _describe(function.__defaults__, (), digest_of_callee),
        _describe(function.__kwdefaults__, (), digest_of_callee),
        tuple(_describe_globals(function, digest_of_callee)),
    )


def describe_types(args: tuple[types.Type, ...]) -> Hashable:
    """Describe the argument types of a signature. Named tuples include the order of their fields, which numba's names lack."""
    return tuple(_describe_type(numba_type) for numba_type in args)


def _describe_type(numba_type: types.Type) -> Hashable:
    """Describe a numba type as a nested tuple of texts. Named tuples and tuples include the types of their elements."""
    tuple_type: Any = numba_type  # numba's stubs lack its attributes
    if isinstance(numba_type, types.BaseNamedTuple):
        return "named tuple", _describe_class(tuple_type.instance_class), describe_types(tuple(tuple_type.types))
    if isinstance(numba_type, types.BaseTuple):
        return "tuple", describe_types(tuple(tuple_type.types))
    if isinstance(numba_type, types.Optional):
        return "optional", _describe_type(numba_type.type)
    return str(numba_type)


def _describe_code(code: CodeType, doc: str | None) -> Hashable:
    """Describe bytecode. ``doc`` is the docstring, which is left out: no instruction loads this constant."""
    constants = [
        _describe_code(constant, None) if isinstance(constant, CodeType) else (type(constant).__name__, repr(constant))
        for constant in code.co_consts
        if doc is None or constant is not doc
    ]
    return (
        code.co_code.hex(), code.co_exceptiontable.hex(), code.co_flags, code.co_argcount, code.co_posonlyargcount,
        code.co_kwonlyargcount, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, tuple(constants),
    )  # fmt: skip


def _describe_globals(function: FunctionType, digest_of_callee: DigestFunction) -> Iterator[Hashable]:
    """Describe the globals that a function may read.

    ``co_names`` also holds attribute names. A global that has the name of an attribute is therefore included.
    """
    names = tuple(dict.fromkeys(_code_names(function.__code__)))
    for name in names:
        if name in function.__globals__:
            yield name, _describe(function.__globals__[name], names, digest_of_callee)


def _code_names(code: CodeType) -> Iterator[str]:
    """Yield the names of the globals and attributes that bytecode and the functions nested in it use."""
    yield from code.co_names
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _code_names(constant)


def _describe(value: Any, attributes: tuple[str, ...], digest_of_callee: DigestFunction) -> Hashable:
    """Describe a value as a nested tuple of numbers and strings.

    A module is described by the values of those of its attributes whose names are in ``attributes``.
    """

    def described(part: Any) -> Hashable:
        return _describe(part, (), digest_of_callee)

    match value:
        case enum.Enum():
            return "enum", _describe_class(type(value)), value.name, described(value.value)
        case None | bool() | int() | float() | complex() | str() | bytes() if type(value).__module__ == "builtins":
            return type(value).__name__, repr(value)
        case np.ndarray() if not value.dtype.hasobject:
            layout = value.flags.c_contiguous, value.flags.f_contiguous, value.flags.writeable
            return "array", str(value.dtype.descr), value.shape, layout, hashlib.sha256(value.tobytes()).hexdigest()
        case np.generic():
            return "scalar", str(value.dtype.descr), value.tobytes().hex()
        case np.dtype():
            return "dtype", str(value.descr)
        case tuple():
            return "tuple", _describe_class(type(value)), tuple(map(described, value))
        case list():
            return "list", tuple(map(described, value))
        case dict():
            return "dict", tuple((described(key), described(part)) for key, part in value.items())
        case Dispatcher():
            return "loop", digest_of_callee(value)
        case types.Type():
            return "type", _describe_type(value)
        case type():
            return "class", _describe_class(value)
        case ModuleType():
            if _is_library(value.__name__):
                return "library", value.__name__
            attribute_names = [name for name in attributes if name in vars(value)]
            parts = ((name, _describe(vars(value)[name], attributes, digest_of_callee)) for name in attribute_names)
            return "module", value.__name__, tuple(parts)
    owner = getattr(value, "__module__", None) or type(value).__module__
    if _is_library(owner) or isinstance(value, BuiltinFunctionType | np.ufunc):
        return "library", owner, getattr(value, "__qualname__", None) or getattr(value, "__name__", None) or repr(value)
    if isinstance(value, FunctionType):  # registered with numba, which compiles it into its callers
        return "function", describe_function(value, digest_of_callee)
    raise UnknownValueError(f"a value of the type {type(value).__name__} in {owner}")


def _is_library(module: str) -> bool:
    """Return whether a module belongs to ``PACKAGES_IDENTIFIED_BY_NAME``."""
    return module.partition(".")[0] in PACKAGES_IDENTIFIED_BY_NAME


def _describe_class(cls: type) -> Hashable:
    """Describe a class by its module and name, and a named tuple also by its fields."""
    return cls.__module__, cls.__qualname__, getattr(cls, "_fields", ())
