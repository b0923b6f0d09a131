"""Validate numbers in paths and queries. Only plain decimal digits are accepted, to give each number one address."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

NOT_FINITE = "nan", "inf", "infinity"

_INTEGER = re.compile("-?[0-9]{1,20}")
_DECIMAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,4})?")


def _check_integer(value: Any) -> Any:
    if isinstance(value, str) and not _INTEGER.fullmatch(value):
        raise PydanticCustomError("int_parsing", "Input should be a whole number")
    return value


def _check_decimal(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value.strip().lstrip("+-").lower() in NOT_FINITE:  # before pydantic reports bounds
        raise PydanticCustomError("finite_number", "Input should be a finite number")
    if not _DECIMAL.fullmatch(value.strip()):
        raise PydanticCustomError("float_parsing", "Input should be a number")
    return value


def _parse_integer_or_word(value: Any) -> Any:
    return int(value) if isinstance(value, str) and _INTEGER.fullmatch(value) else value


def parse_decimal(text: str) -> float | None:
    """Return the finite number in a text, spelt as in queries; ``None`` if the text is anything else."""
    number = float(text) if _DECIMAL.fullmatch(text.strip()) else math.inf
    return number if math.isfinite(number) else None


INTEGER_OR_WORD = BeforeValidator(_parse_integer_or_word)
"""Validator of parameters with a list of allowed values, some of them integers."""

PLAIN_INTEGER, PLAIN_DECIMAL = BeforeValidator(_check_integer), BeforeValidator(_check_decimal)
"""Validators of integers and decimals for ``Annotated``.

They reject other spellings that Python accepts: ``1_2``, ``12.0`` as an integer, digits of other scripts."""

WholeNumber = Annotated[int, PLAIN_INTEGER]
"""An integer in a path."""
