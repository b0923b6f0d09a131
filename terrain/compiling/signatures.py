"""Recorded signatures: the compiled loops that each product needs, with their argument types.

``scripts/record_signatures.py`` records ``signatures.json``. The file lists the loops that can be compiled ahead of time. A loop or
signature that it lacks is compiled on its first call, so an outdated list costs only time.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba.core.types

types: Any = numba.core.types  # its stubs lack most names used here

SIGNATURES_FILE = Path(__file__).with_name("signatures.json")

Encoded = str | list[Any]


@dataclass(frozen=True)
class Signature:
    """A loop with the types of its arguments.

    Attributes
    ----------
    loop : str
        Module and name, for example ``skugga.terrain.ground.surface:height_at``.
    args : str
        Types of the arguments, encoded as JSON.
    products : tuple of str
        Products that need the loop.
    """

    loop: str
    args: str
    products: tuple[str, ...]

    def dispatcher(self) -> Any:
        """Return the loop. Raises ``ImportError`` or ``AttributeError`` if it no longer exists."""
        module, _, name = self.loop.partition(":")
        return getattr(importlib.import_module(module), name)

    def argument_types(self) -> tuple[Any, ...]:
        """Return the argument types. Raises ``ImportError`` or ``AttributeError`` if a named tuple no longer exists."""
        return tuple(map(decode_type, json.loads(self.args)))


def recorded_signatures(products: Iterable[str] | None = None) -> list[Signature]:
    """Return the recorded signatures that some products need, by default all recorded signatures."""
    if not SIGNATURES_FILE.is_file():
        return []
    rows = json.loads(SIGNATURES_FILE.read_text(encoding="utf-8"))
    signatures = [Signature(row["loop"], json.dumps(row["args"]), tuple(row["products"])) for row in rows]
    product_set = None if products is None else set(products)
    return [signature for signature in signatures if product_set is None or product_set & set(signature.products)]


def encode_type(numba_type: Any) -> Encoded:
    """Encode a numba type as JSON. Raises ``ValueError`` for an unsupported type."""
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
    raise ValueError(f"argument type: {numba_type} cannot be encoded")


def decode_type(encoded: Encoded) -> Any:
    """Return the numba type that ``encode_type`` encoded. Raises ``ValueError`` for an unknown kind."""
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
    raise ValueError(f"argument type: unknown kind {kind!r}")
