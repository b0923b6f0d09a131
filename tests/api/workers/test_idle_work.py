"""The basis of plans changes while a pool runs. Idle work changes it for one level."""

import asyncio
import functools
import os
from pathlib import Path

import pytest

from skugga.api.workers import idle_work
from skugga.api.workers.idle_work import IdleJob
from skugga.api.workers.jobs import BlockTiles, LevelKey
from skugga.api.workers.plan_basis import PlanBasis
from skugga.api.workers.pool import Pool
from tests.api.workers import fake_workers
from tests.api.workers.fake_calibrations import profile
from tests.api.workers.test_pool import LEVEL, Gate, block, until, with_pool

OTHER = LevelKey(path=Path("other.yaml"), version="other")


class PlanGate(Gate):
    """Gate in front of processes that plan."""

    def __init__(self) -> None:
        super().__init__()
        self.target = functools.partial(fake_workers.planning, **self.target.keywords)


def test_plan_versions_depend_on_profile_and_probes():
    device = profile()
    basis = PlanBasis(device)
    assert PlanBasis().version_of(LEVEL) == ""
    assert basis.version_of(LEVEL) == basis.version_of(None) != PlanBasis(profile(took_s=2.0)).version_of(LEVEL)
    probed = basis.with_probed({LEVEL.version: "coarse pixels"})
    assert probed.version_of(OTHER) == basis.version_of(OTHER) == probed.version_of(None)
    versions = {
        each.version_of(LEVEL)
        for each in (basis, probed, basis.with_probed({LEVEL.version: "fine"}), PlanBasis(probed=probed.probed))
    }
    assert len(versions) == 4
    both = probed.with_probed({OTHER.version: "fine"})
    assert both.version_of(LEVEL) == probed.version_of(LEVEL) and both.version_of(OTHER) != basis.version_of(OTHER)
    newer = LevelKey(path=LEVEL.path, version="newer")
    assert both.version_of(newer) == basis.version_of(newer), "what was probed for another version does not hold"


def drawn(answer: object) -> str:
    assert isinstance(answer, BlockTiles)
    assert set(answer.tiles.values()) == {answer.plan_version.encode()}
    return answer.plan_version


def test_all_processes_adopt_a_new_basis():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        await until(lambda: len(pool.pids) == 3)
        for first, basis in enumerate([None, PlanBasis(profile()), PlanBasis(profile(took_s=2.0))]):
            pool.basis = basis or pool.basis
            # one job at a time for each process
            light = [asyncio.create_task(pool.run(block(10 * first + each))) for each in range(3)]
            await asyncio.gather(*(gate.begun() for _ in range(2)))
            gate.open(3)
            await gate.begun()
            assert {drawn(await one) for one in light} == {pool.plan_version(LEVEL)}

    with_pool(scenario, gate.target, workers=3)


def test_requests_after_a_change_use_the_new_basis():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        before = asyncio.create_task(pool.run(block(1)))
        await gate.begun()
        pool.basis = PlanBasis(profile())
        after = asyncio.create_task(pool.run(block(1)))
        await asyncio.sleep(0)
        gate.open()
        assert drawn(await before) == ""  # drawn by the basis at its start
        assert pool.finished(block(1)) is None
        await gate.begun()
        gate.open()
        assert drawn(await after) == pool.plan_version(LEVEL) != ""
        kept = pool.finished(block(1))
        assert kept is not None and drawn(kept) == pool.plan_version(LEVEL)

    with_pool(scenario, gate.target)


def test_queued_jobs_use_the_new_basis():
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        running, waiting = (asyncio.create_task(pool.run(block(x))) for x in (1, 2))
        await gate.begun()
        pool.basis = PlanBasis(profile())
        gate.open(2)
        assert (drawn(await running), drawn(await waiting)) == ("", pool.plan_version(LEVEL))

    with_pool(scenario, gate.target)


def test_a_process_started_later_uses_the_new_basis():
    async def scenario(pool: Pool) -> None:
        await pool.settled()
        pool.basis = PlanBasis(profile())
        for x in range(4):
            assert drawn(await pool.run(block(x))) == pool.plan_version(LEVEL)
        assert pool.counters.started > 2

    with_pool(scenario, fake_workers.planning, recycle_blocks=1)


def test_idle_work_changes_the_plans_of_one_level(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(idle_work, "QUIET_S", 0.05)
    failures: list[str] = []

    async def scenario(pool: Pool) -> None:
        async def note(found: int) -> None:
            assert pool.basis is not None
            pool.basis = pool.basis.with_probed({LEVEL.version: str(found)})

        assert drawn(await pool.run(block(1))) == ""
        pool.idle.add(IdleJob(os.getenv, (), note, failures.append))  # fails: it needs an argument
        pool.idle.add(IdleJob(abs, (-3,), note, failures.append, lambda: False))
        pool.idle.add(IdleJob(abs, (-5,), note, failures.append))
        await until(lambda: pool.plan_version(LEVEL) != "")
        assert pool.basis is not None and pool.basis.probed == {LEVEL.version: "5"}
        assert pool.plan_version(OTHER) == ""
        assert drawn(await pool.run(block(1))) == pool.plan_version(LEVEL)
        assert drawn(await pool.run(block(1).model_copy(update={"level": OTHER}))) == ""
        assert len(failures) == 1 and failures[0].startswith("TypeError: getenv() missing")

    with_pool(scenario, fake_workers.planning)


def test_idle_work_waits_until_nothing_is_drawn(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(idle_work, "QUIET_S", 0.05)
    monkeypatch.setattr(idle_work, "QUIET_CHECK_S", 0.01)
    gate = PlanGate()

    async def scenario(pool: Pool) -> None:
        done = asyncio.Event()

        async def note(found: int) -> None:
            done.set()

        running = asyncio.create_task(pool.run(block(1)))
        await gate.begun()
        pool.idle.add(IdleJob(abs, (-5,), note, pytest.fail))
        await asyncio.sleep(0.3)
        assert pool.idle.pid is None and not done.is_set()
        gate.open()
        await running
        await done.wait()

    with_pool(scenario, gate.target)
