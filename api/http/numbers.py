"""Numbers in addresses and queries: digits as everybody writes them, so that a number has one address."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

NOT_FINITE = "nan", "inf", "infinity"

_WHOLE = re.compile("-?[0-9]{1,20}")
_DECIMAL = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]{1,4})?")


def _whole(value: Any) -> Any:
    if isinstance(value, str) and not _WHOLE.fullmatch(value):
        raise PydanticCustomError("int_parsing", "Input should be a whole number")
    return value


def _decimal(value: Any) -> Any:
    if not isinstance(value, str):
        return value
    if value.strip().lstrip("+-").lower() in NOT_FINITE:  # bounds would be told first
        raise PydanticCustomError("finite_number", "Input should be a finite number")
    if not _DECIMAL.fullmatch(value.strip()):
        raise PydanticCustomError("float_parsing", "Input should be a number")
    return value


def _whole_or_word(value: Any) -> Any:
    return int(value) if isinstance(value, str) and _WHOLE.fullmatch(value) else value


def decimal_in(text: str) -> float | None:
    """The finite number that a text is, spelt as in queries; ``None`` for any other."""
    number = float(text) if _DECIMAL.fullmatch(text.strip()) else math.inf
    return number if math.isfinite(number) else None


WHOLE_OR_WORD = BeforeValidator(_whole_or_word)
"""Of parameters whose values are listed, numbers among them."""

PLAIN_WHOLE, PLAIN_DECIMAL = BeforeValidator(_whole), BeforeValidator(_decimal)
"""Of parameters in ``Annotated``: what Python takes for a number besides (``1_2``, ``12.0`` as a whole number, digits of other
scripts) is refused."""

WholeNumber = Annotated[int, PLAIN_WHOLE]
"""A whole number of an address."""
