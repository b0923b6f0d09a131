"""Row ranges and tasks on several cores."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain import compiled as compiled_module
from skugga.terrain.compiled import map_on_cores, run_in_chunks


@pytest.mark.parametrize("cores", [1, 2, 5])
@pytest.mark.parametrize("rows", [0, 1, 3, 7, 64, 1001])
def test_chunks_contain_each_row_once(monkeypatch, cores, rows):
    monkeypatch.setattr(compiled_module, "CORES", cores)
    visit_counts = np.zeros(rows, np.int64)

    def count_visits(first: int, last: int, increment: int) -> None:
        visit_counts[first:last] += increment

    run_in_chunks(rows, count_visits, 3)
    assert (visit_counts == 3).all()


def test_error_of_a_chunk_is_raised(monkeypatch):
    monkeypatch.setattr(compiled_module, "CORES", 2)

    def fail(first: int, last: int) -> None:
        raise ValueError(f"row {first}")

    with pytest.raises(ValueError, match="row 0"):
        run_in_chunks(100, fail)


@pytest.mark.parametrize("cores", [1, 2, 5])
def test_map_on_cores_returns_all_results_in_order(cores):
    assert map_on_cores(lambda part: part * part, range(7), cores) == [0, 1, 4, 9, 16, 25, 36]
    assert map_on_cores(lambda part: part, [], cores) == []


@pytest.mark.parametrize("cores", [1, 3])
def test_tasks_on_cores_may_run_chunks(monkeypatch, cores):
    monkeypatch.setattr(compiled_module, "CORES", 2)
    visit_counts = np.zeros((6, 40), np.int64)

    def share_out(part: int) -> None:
        def count_visits(first: int, last: int) -> None:
            visit_counts[part, first:last] += 1

        run_in_chunks(40, count_visits)

    map_on_cores(share_out, range(6), cores)
    assert (visit_counts == 1).all()


def test_error_of_a_task_is_raised():
    with pytest.raises(ZeroDivisionError):
        map_on_cores(lambda part: 1 // part, [1, 0], 2)
