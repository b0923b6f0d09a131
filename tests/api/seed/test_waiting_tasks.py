"""Order and assignment of waiting tasks to lanes."""

from __future__ import annotations

import pytest

from skugga.api.seed.running import MAX_STRETCH, WaitingTasks


def handed_out(waiting: WaitingTasks, lanes: int) -> list[list[int]]:
    """Return the tasks of each lane when lanes take turns."""
    out: list[list[int]] = [[] for _ in range(lanes)]
    while waiting:
        lane = sum(map(len, out)) % lanes
        out[lane].append(waiting.take(lane))
    return out


@pytest.mark.parametrize("lanes", [1, 2, 7, 400])
@pytest.mark.parametrize("count", [1, 10, 1000])
def test_every_task_is_handed_out_once(lanes: int, count: int):
    assert sorted(sum(handed_out(WaitingTasks(range(count)), lanes), [])) == list(range(count))


def test_one_lane_gets_all_tasks_in_order():
    assert handed_out(WaitingTasks(range(1000)), 1) == [list(range(1000))]


def test_lanes_get_neighbouring_tasks():
    drawn = handed_out(WaitingTasks(range(10_000)), 4)
    for lane in drawn:
        beside = sum(b == a + 1 for a, b in zip(lane, lane[1:], strict=False))
        assert beside > (1.0 - 1.5 / MAX_STRETCH) * len(lane)


def test_tasks_start_about_in_their_order():
    lanes = handed_out(WaitingTasks(range(1000)), 4)
    turns = {task: turn for lane in lanes for turn, task in enumerate(lane)}
    assert all(abs(4 * turn - task) <= 4 * 4 * MAX_STRETCH for task, turn in turns.items())


def test_a_slow_lane_keeps_only_its_one_task():
    waiting = WaitingTasks(range(100))
    waiting.take(1)
    others = [waiting.take(0) for _ in range(99)]
    assert len(set(others)) == 99 and not waiting
    with pytest.raises(IndexError):
        waiting.take(0)


def test_returned_tasks_come_last():
    waiting = WaitingTasks([1, 2, 3])
    waiting.put_back(waiting.take(0))
    assert [waiting.take(0) for _ in range(len(waiting))] == [2, 3, 1]
