"""The list of compiled loops that each product needs, with the types that they are called with.

``signatures.json`` is recorded by ``scripts/record_signatures.py``. It says what may be compiled before it is called. A loop or
a type that it lacks is compiled when it is called, so a list that is behind costs time and nothing else.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba.core.types

types: Any = numba.core.types  # its stubs lack most of what is used here

PATH = Path(__file__).with_name("signatures.json")

Encoded = str | list[Any]


@dataclass(frozen=True)
class Signature:
    """A loop with the types of its arguments.

    Attributes
    ----------
    loop : str
        Module and name, as ``skugga.terrain.ground.surface:height_at``.
    args : str
        Types of the arguments, encoded as JSON.
    products : tuple of str
        Products that need it.
    """

    loop: str
    args: str
    products: tuple[str, ...]

    def dispatcher(self) -> Any:
        """Return the loop. Raises ``ImportError`` or ``AttributeError`` where it is no longer there."""
        module, _, name = self.loop.partition(":")
        return getattr(importlib.import_module(module), name)

    def argument_types(self) -> tuple[Any, ...]:
        """Return the types. Raises ``ImportError`` or ``AttributeError`` where a named tuple is no longer there."""
        return tuple(map(decode_type, json.loads(self.args)))


def recorded_signatures(products: Iterable[str] | None = None) -> list[Signature]:
    """Return the recorded signatures that some products need; all of them by default."""
    if not PATH.is_file():
        return []
    rows = json.loads(PATH.read_text(encoding="utf-8"))
    found = [Signature(row["loop"], json.dumps(row["args"]), tuple(row["products"])) for row in rows]
    wanted = None if products is None else set(products)
    return [each for each in found if wanted is None or wanted & set(each.products)]


def encode_type(numba_type: Any) -> Encoded:
    """Encode a type as JSON. Raises ``ValueError`` for a kind of type that loops are not called with."""
    match numba_type:
        case types.Array():
            flags = (["readonly"] if not numba_type.mutable else []) + (["unaligned"] if not numba_type.aligned else [])
            return ["array", encode_type(numba_type.dtype), numba_type.ndim, numba_type.layout, *flags]
        case types.BaseNamedTuple():
            cls = numba_type.instance_class
            return ["namedtuple", f"{cls.__module__}:{cls.__qualname__}", *map(encode_type, numba_type.types)]
        case types.BaseTuple():
            return ["tuple", *map(encode_type, numba_type.types)]
        case types.Omitted() if isinstance(numba_type.value, bool | int | float | None):
            return ["omitted", numba_type.value]
        case types.Optional():
            return ["optional", encode_type(numba_type.type)]
        case types.IntegerLiteral() | types.BooleanLiteral():
            return ["literal", numba_type.literal_value]
        case types.Number() | types.Boolean() | types.NoneType():
            return str(numba_type.name)
    raise ValueError(f"a loop is called with the type {numba_type}, which cannot be recorded")


def decode_type(encoded: Encoded) -> Any:
    """Return the type that was encoded."""
    if isinstance(encoded, str):
        return types.boolean if encoded == "bool" else getattr(types, encoded)
    kind, *parts = encoded
    match kind:
        case "array":
            dtype, ndim, layout, *flags = parts
            return types.Array(decode_type(dtype), ndim, layout, "readonly" in flags, aligned="unaligned" not in flags)
        case "namedtuple":
            module, _, name = parts[0].partition(":")
            return types.BaseTuple.from_types(tuple(map(decode_type, parts[1:])), getattr(importlib.import_module(module), name))
        case "tuple":
            return types.BaseTuple.from_types(tuple(map(decode_type, parts)))
        case "omitted":
            return types.Omitted(parts[0])
        case "optional":
            return types.Optional(decode_type(parts[0]))
        case "literal":
            return types.literal(parts[0])
    raise ValueError(f"unknown kind of type: {kind}")
