"""What the selection's benchmark measured is read once."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.selection.table import read_table


@pytest.fixture(scope="session")
def kept() -> tuple[list[dict[str, Any]], Any]:
    """The views of the table that is kept in the repository, and the device that they were measured on."""
    return read_table()
