"""Scripts of `benchmarks/` import each other by plain names; what they measured is read once."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

# Behind everything else, so that no script's name hides a package.
sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))


@pytest.fixture(scope="session")
def kept() -> tuple[list[dict[str, Any]], Any]:
    """The views of the table that is kept in the repository, and the device that they were measured on."""
    from selection_table import read_table

    return read_table()
