"""Memory of temporary arrays is used again as soon as nobody refers to it, and never before."""

import numpy as np
import pytest

from skugga.terrain import scratch
from skugga.terrain.cache import MIB
from skugga.terrain.scratch import scratch_array


@pytest.fixture(autouse=True)
def _no_buffers(monkeypatch):
    monkeypatch.setattr(scratch, "_buffers", [])


def address(array):
    return array.__array_interface__["data"][0]


def test_memory_is_reused_once_no_array_refers_to_it():
    first = scratch_array((40, 50), np.float32)
    start = address(first)
    del first
    assert address(scratch_array((10, 100), np.float32)) == start


@pytest.mark.parametrize("view_of", [lambda array: array[2:, 3], lambda array: array[::-1].T, lambda array: array.reshape(-1)])
def test_memory_is_not_reused_while_a_view_refers_to_it(view_of):
    first = scratch_array((40, 50), np.float32)
    first[:] = 7.0
    view = view_of(first)
    del first
    scratch_array((40, 50), np.float32)[:] = 0.0
    assert (view == 7.0).all()


def test_the_base_of_an_array_has_its_type_and_size():
    array = scratch_array((4, 5), np.float32)
    assert array.base.dtype == np.float32 and array.base.shape == (20,)
    assert scratch_array((0, 0), np.bool_).shape == (0, 0)


def test_idle_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(scratch, "MAX_IDLE_BYTES", 2 * MIB)
    arrays = [scratch_array((1024, 1024), np.bool_) for _ in range(4)]
    del arrays
    scratch_array((1024, 1024), np.bool_)
    assert sum(len(buffer) for buffer, _ in scratch._buffers) <= 2 * MIB
    scratch_array((4096, 1024), np.bool_)
    assert sum(len(buffer) for buffer, _ in scratch._buffers) <= 2 * MIB
