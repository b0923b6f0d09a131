"""Parameters of which a few are enough in seconds, and all of them in minutes."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def quick(values: Iterable[Any], *chosen: Any) -> list[Any]:
    """The values as parameters: the chosen ones as they are, all others marked ``long``. A chosen one that is none is an error."""
    values = list(values)
    assert all(one in values for one in chosen), chosen
    return [
        value if value in chosen else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.long)
        for value in values
    ]
