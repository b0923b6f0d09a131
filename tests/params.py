"""Parameters of tests: a few run by default, all of them in the long profile."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def mark_long_except(values: Iterable[Any], *default_values: Any) -> list[Any]:
    """Return values as parameters. All but the default values are marked ``long``. Fail if a default value is not in ``values``."""
    values = list(values)
    assert all(value in values for value in default_values), default_values
    return [
        value
        if value in default_values
        else pytest.param(*(value if isinstance(value, tuple) else (value,)), marks=pytest.mark.long)
        for value in values
    ]
