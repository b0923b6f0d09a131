"""Fixture that reads the measured table of the selection benchmark once."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.selection.table import read_table


@pytest.fixture(scope="session")
def stored_table() -> tuple[list[dict[str, Any]], Any]:
    """Return the views of the table in the repository, and the device that they were measured on."""
    return read_table()
