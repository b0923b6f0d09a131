"""The measurements that plans use change while a pool runs. Idle work changes them for one level."""

import asyncio
import functools
import os
from pathlib import Path

import pytest

from skugga.api.workers import idle_work
from skugga.api.workers.idle_work import IdleJob
from skugga.api.workers.jobs import BlockTiles, LevelKey
from skugga.api.workers.plan_measurements import PlanMeasurements
from skugga.api.workers.pool import Pool
from tests.api.workers import fake_workers
from tests.api.workers.fake_calibrations import profile
from tests.api.workers.test_pool import LEVEL, Gate, block, run_with_pool, wait_until

OTHER_LEVEL = LevelKey(path=Path("other.yaml"), version="other")


class PlanGate(Gate):
    """Gate in front of processes that plan."""

    def __init__(self) -> None:
        super().__init__()
        self.target = functools.partial(fake_workers.planning, **self.target.keywords)


def test_plan_versions_depend_on_profile_and_probes():
    device = profile()
    measurements = PlanMeasurements(device)
    assert PlanMeasurements().version_of(LEVEL) == ""
    assert (
        measurements.version_of(LEVEL) == measurements.version_of(None) != PlanMeasurements(profile(took_s=2.0)).version_of(LEVEL)
    )
    probed = measurements.with_probes({LEVEL.version: "coarse pixels"})
    assert probed.version_of(OTHER_LEVEL) == measurements.version_of(OTHER_LEVEL) == probed.version_of(None)
    versions = {
        measurements.version_of(LEVEL)
        for measurements in (
            measurements,
            probed,
            measurements.with_probes({LEVEL.version: "fine"}),
            PlanMeasurements(probes_json_by_version=probed.probes_json_by_version),
        )
    }
    assert len(versions) == 4
    both_probed = probed.with_probes({OTHER_LEVEL.version: "fine"})
    assert both_probed.version_of(LEVEL) == probed.version_of(LEVEL) and both_probed.version_of(
        OTHER_LEVEL
    ) != measurements.version_of(OTHER_LEVEL)
    newer_level = LevelKey(path=LEVEL.path, version="newer")
    assert both_probed.version_of(newer_level) == measurements.version_of(newer_level), (
        "probes of another version of the level are not used"
    )


def plan_version_of(answer: object) -> str:
    """Return the plan version of a block's tiles. Fake tiles contain it."""
    assert isinstance(answer, BlockTiles)
    assert set(answer.tiles.values()) == {answer.plan_version.encode()}
    return answer.plan_version


def test_all_processes_adopt_new_measurements():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: len(pool.ready_pids) == 3)
        for round_number, measurements in enumerate([None, PlanMeasurements(profile()), PlanMeasurements(profile(took_s=2.0))]):
            pool.measurements = measurements or pool.measurements
            # one job at a time for each process
            tasks = [asyncio.create_task(pool.run(block(10 * round_number + offset))) for offset in range(3)]
            await asyncio.gather(*(gate.job_started() for _ in range(2)))
            gate.open(3)
            await gate.job_started()
            assert {plan_version_of(await task) for task in tasks} == {pool.plan_version(LEVEL)}

    run_with_pool(scenario, gate.target, workers=3)


def test_requests_after_a_change_use_new_measurements():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        before = asyncio.create_task(pool.run(block(1)))
        await gate.job_started()
        pool.measurements = PlanMeasurements(profile())
        after = asyncio.create_task(pool.run(block(1)))
        await asyncio.sleep(0)
        gate.open()
        assert plan_version_of(await before) == ""  # drawn with the measurements at its start
        assert pool.cached_picture(block(1)) is None
        await gate.job_started()
        gate.open()
        assert plan_version_of(await after) == pool.plan_version(LEVEL) != ""
        cached_block = pool.cached_picture(block(1))
        assert cached_block is not None and plan_version_of(cached_block) == pool.plan_version(LEVEL)

    run_with_pool(scenario, gate.target)


def test_queued_jobs_use_new_measurements():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        running, waiting = (asyncio.create_task(pool.run(block(x))) for x in (1, 2))
        await gate.job_started()
        pool.measurements = PlanMeasurements(profile())
        gate.open(2)
        assert (plan_version_of(await running), plan_version_of(await waiting)) == ("", pool.plan_version(LEVEL))

    run_with_pool(scenario, gate.target)


def test_a_process_started_later_uses_new_measurements():
    async def scenario(pool: Pool) -> None:
        await pool.wait_for_first_process()
        pool.measurements = PlanMeasurements(profile())
        for x in range(4):
            assert plan_version_of(await pool.run(block(x))) == pool.plan_version(LEVEL)
        assert pool.counters.processes_started > 2

    run_with_pool(scenario, fake_workers.planning, recycle_blocks=1)


def test_idle_work_changes_the_plans_of_one_level(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 0.05)
    failures: list[str] = []

    async def scenario(pool: Pool) -> None:
        async def adopt_probes(version: int) -> None:
            assert pool.measurements is not None
            pool.measurements = pool.measurements.with_probes({LEVEL.version: str(version)})

        assert plan_version_of(await pool.run(block(1))) == ""
        pool.idle_work.add(IdleJob(os.getenv, (), adopt_probes, failures.append))  # fails: it needs an argument
        pool.idle_work.add(IdleJob(abs, (-3,), adopt_probes, failures.append, lambda: False))
        pool.idle_work.add(IdleJob(abs, (-5,), adopt_probes, failures.append))
        await wait_until(lambda: pool.plan_version(LEVEL) != "")
        assert pool.measurements is not None and pool.measurements.probes_json_by_version == {LEVEL.version: "5"}
        assert pool.plan_version(OTHER_LEVEL) == ""
        assert plan_version_of(await pool.run(block(1))) == pool.plan_version(LEVEL)
        assert plan_version_of(await pool.run(block(1).model_copy(update={"level": OTHER_LEVEL}))) == ""
        assert len(failures) == 1 and failures[0].startswith("TypeError: getenv() missing")

    run_with_pool(scenario, fake_workers.planning)


def test_idle_work_waits_until_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(idle_work, "IDLE_DELAY_S", 0.05)
    monkeypatch.setattr(idle_work, "IDLE_CHECK_INTERVAL_S", 0.01)
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        finished = asyncio.Event()

        async def set_finished(version: int) -> None:
            finished.set()

        running = asyncio.create_task(pool.run(block(1)))
        await gate.job_started()
        pool.idle_work.add(IdleJob(abs, (-5,), set_finished, pytest.fail))
        await asyncio.sleep(0.3)
        assert pool.idle_work.pid is None and not finished.is_set()
        gate.open()
        await running
        await finished.wait()

    run_with_pool(scenario, gate.target)
