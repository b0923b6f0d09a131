"""Parameters of which a few run by default, and all in the long profile."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def quick(values: Iterable[Any], *chosen: Any) -> list[Any]:
    """Return values as parameters, all but the chosen ones marked ``long``. Fail if a chosen value is missing."""
    values = list(values)
    assert all(choice in values for choice in chosen), chosen
    return [
        value if value in chosen else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.long)
        for value in values
    ]
