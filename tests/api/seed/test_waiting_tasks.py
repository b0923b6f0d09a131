"""Order and assignment of waiting tasks to lanes."""

from __future__ import annotations

import pytest

from skugga.api.seed.running import MAX_BATCH_TASKS, WaitingTasks


def hand_out_tasks(waiting: WaitingTasks, lanes: int) -> list[list[int]]:
    """Return the tasks of each lane when lanes take turns."""
    out: list[list[int]] = [[] for _ in range(lanes)]
    while waiting:
        lane = sum(map(len, out)) % lanes
        out[lane].append(waiting.take(lane))
    return out


@pytest.mark.parametrize("lanes", [1, 2, 7, 400])
@pytest.mark.parametrize("count", [1, 10, 1000])
def test_every_task_is_handed_out_once(lanes: int, count: int):
    assert sorted(sum(hand_out_tasks(WaitingTasks(range(count)), lanes), [])) == list(range(count))


def test_one_lane_gets_all_tasks_in_order():
    assert hand_out_tasks(WaitingTasks(range(1000)), 1) == [list(range(1000))]


def test_lanes_get_neighbouring_tasks():
    task_lanes = hand_out_tasks(WaitingTasks(range(10_000)), 4)
    for lane in task_lanes:
        adjacent_count = sum(b == a + 1 for a, b in zip(lane, lane[1:], strict=False))
        assert adjacent_count > (1.0 - 1.5 / MAX_BATCH_TASKS) * len(lane)


def test_tasks_start_about_in_their_order():
    lanes = hand_out_tasks(WaitingTasks(range(1000)), 4)
    position_by_task = {task: position for lane in lanes for position, task in enumerate(lane)}
    assert all(abs(4 * position - task) <= 4 * 4 * MAX_BATCH_TASKS for task, position in position_by_task.items())


def test_a_slow_lane_keeps_only_its_one_task():
    waiting = WaitingTasks(range(100))
    waiting.take(1)
    tasks = [waiting.take(0) for _ in range(99)]
    assert len(set(tasks)) == 99 and not waiting
    with pytest.raises(IndexError):
        waiting.take(0)


def test_returned_tasks_come_last():
    waiting = WaitingTasks([1, 2, 3])
    waiting.requeue(waiting.take(0))
    assert [waiting.take(0) for _ in range(len(waiting))] == [2, 3, 1]
