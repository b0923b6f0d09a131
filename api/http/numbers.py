"""Numbers in addresses and queries: digits as everybody writes them, so that a number has one address."""

from __future__ import annotations

import re
from typing import Annotated, Any

from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

NOT_FINITE = "nan", "inf", "infinity"

_WHOLE = re.compile("-?[0-9]{1,20}")


def _whole(value: Any) -> Any:
    if isinstance(value, str) and not _WHOLE.fullmatch(value):
        raise PydanticCustomError("int_parsing", "Input should be a valid integer, unable to parse string as an integer")
    return value


def _decimal(value: Any) -> Any:
    if isinstance(value, str) and ("_" in value or not value.isascii()):
        raise PydanticCustomError("float_parsing", "Input should be a valid number, unable to parse string as a number")
    if isinstance(value, str) and value.strip().lstrip("+-").lower() in NOT_FINITE:  # bounds would be told first
        raise PydanticCustomError("finite_number", "Input should be a finite number")
    return value


def _whole_or_word(value: Any) -> Any:
    return int(value) if isinstance(value, str) and _WHOLE.fullmatch(value) else value


WHOLE_OR_WORD = BeforeValidator(_whole_or_word)
"""Of parameters whose values are listed, numbers among them."""

PLAIN_WHOLE, PLAIN_DECIMAL = BeforeValidator(_whole), BeforeValidator(_decimal)
"""Of parameters in ``Annotated``: what Python takes for a number besides (``1_2``, ``12.0`` as a whole number, digits of other
scripts) is refused."""

WholeNumber = Annotated[int, PLAIN_WHOLE]
"""A whole number of an address."""
