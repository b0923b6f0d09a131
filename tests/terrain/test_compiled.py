"""Rows of a picture that cores share."""

from __future__ import annotations

import numpy as np
import pytest

from terrain import compiled as compiled_module
from terrain.compiled import in_shares


@pytest.mark.parametrize("cores", [1, 2, 5])
@pytest.mark.parametrize("rows", [0, 1, 3, 7, 64, 1001])
def test_each_row_is_in_one_share(monkeypatch, cores, rows):
    monkeypatch.setattr(compiled_module, "CORES", cores)
    met = np.zeros(rows, np.int64)

    def meet(first: int, last: int, by: int) -> None:
        met[first:last] += by

    in_shares(rows, meet, 3)
    assert (met == 3).all()


def test_what_a_share_raises_is_raised(monkeypatch):
    monkeypatch.setattr(compiled_module, "CORES", 2)

    def fail(first: int, last: int) -> None:
        raise ValueError(f"row {first}")

    with pytest.raises(ValueError, match="row 0"):
        in_shares(100, fail)
