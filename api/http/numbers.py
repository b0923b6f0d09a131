"""Validate numbers in paths and queries. Only plain decimal digits are accepted.

With other spellings of a number, the same picture would have several URLs, which caches store separately.
"""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

NON_FINITE_WORDS = "nan", "inf", "infinity"

_INTEGER = re.compile("-?[0-9]{1,20}")
_DECIMAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,4})?")


def _check_integer(value: Any) -> Any:
    """Return a value unchanged. Raises a pydantic error for a text that is not spelled in plain digits with an optional minus."""
    if isinstance(value, str) and not _INTEGER.fullmatch(value):
        raise PydanticCustomError("int_parsing", "Input should be a whole number")
    return value


def _check_decimal(value: Any) -> Any:
    """Return a value unchanged. Raises a pydantic error for a text that is not a finite number in decimal digits."""
    if not isinstance(value, str):
        return value
    if value.strip().lstrip("+-").lower() in NON_FINITE_WORDS:  # before pydantic reports bounds
        raise PydanticCustomError("finite_number", "Input should be a finite number")
    if not _DECIMAL.fullmatch(value.strip()):
        raise PydanticCustomError("float_parsing", "Input should be a number")
    return value


def _parse_integer_or_word(value: Any) -> Any:
    """Return a text of digits as an integer, and any other value unchanged."""
    return int(value) if isinstance(value, str) and _INTEGER.fullmatch(value) else value


def parse_decimal(text: str) -> float | None:
    """Return the finite decimal number that a text spells; ``None`` for any other text."""
    number = float(text) if _DECIMAL.fullmatch(text.strip()) else math.inf
    return number if math.isfinite(number) else None


INTEGER_OR_WORD = BeforeValidator(_parse_integer_or_word)
"""Pydantic validator that converts a text of digits to an integer, and leaves words unchanged.

It is for parameters whose allowed values are words and integers."""

PLAIN_INTEGER, PLAIN_DECIMAL = BeforeValidator(_check_integer), BeforeValidator(_check_decimal)
"""Pydantic validators of integers and decimals, for ``Annotated``.

They reject other spellings that Python or pydantic accept: ``1_2``, ``12.0`` as an integer, and digits of other scripts."""

WholeNumber = Annotated[int, PLAIN_INTEGER]
"""Type of an integer in a path."""
