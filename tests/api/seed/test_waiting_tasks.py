"""Order and assignment of waiting tasks to worker queues."""

from __future__ import annotations

import pytest

from skugga.api.seed.running import MAX_BATCH_TASKS, WaitingTasks


def hand_out_tasks(waiting: WaitingTasks, queue_count: int) -> list[list[int]]:
    """Return the tasks of each worker queue when the queues take turns."""
    out: list[list[int]] = [[] for _ in range(queue_count)]
    while waiting:
        worker_queue = sum(map(len, out)) % queue_count
        out[worker_queue].append(waiting.take(worker_queue))
    return out


@pytest.mark.parametrize("queue_count", [1, 2, 7, 400])
@pytest.mark.parametrize("count", [1, 10, 1000])
def test_every_task_is_handed_out_once(queue_count: int, count: int):
    assert sorted(sum(hand_out_tasks(WaitingTasks(range(count)), queue_count), [])) == list(range(count))


def test_one_worker_queue_gets_all_tasks_in_order():
    assert hand_out_tasks(WaitingTasks(range(1000)), 1) == [list(range(1000))]


def test_worker_queues_get_neighbouring_tasks():
    tasks_by_queue = hand_out_tasks(WaitingTasks(range(10_000)), 4)
    for worker_queue in tasks_by_queue:
        adjacent_count = sum(b == a + 1 for a, b in zip(worker_queue, worker_queue[1:], strict=False))
        assert adjacent_count > (1.0 - 1.5 / MAX_BATCH_TASKS) * len(worker_queue)


def test_tasks_start_about_in_their_order():
    tasks_by_queue = hand_out_tasks(WaitingTasks(range(1000)), 4)
    position_by_task = {task: position for worker_queue in tasks_by_queue for position, task in enumerate(worker_queue)}
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
