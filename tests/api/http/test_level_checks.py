"""A level whose files cannot be checked in time delays no other level. Its last version is served."""

import asyncio
import errno
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from skugga.api.http.ogc import routes_wms
from skugga.api.http.server.app import create_app
from skugga.api.http.state import level_checks
from skugga.api.http.state.level_checks import FileCheck
from skugga.api.settings import Settings
from skugga.terrain.errors import LevelError
from tests.api.conftest import CORNER, ZOOM, running, write_level
from tests.api.workers import fake_workers


class GatedCheck:
    """Check of a level's files that blocks until ``may_finish`` is set."""

    def __init__(self, outcome: object = "new") -> None:
        self.outcome, self.started_count, self.may_finish = outcome, 0, threading.Event()

    def __call__(self) -> object:
        self.started_count += 1
        assert self.may_finish.wait(30.0)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def check(gated_check: GatedCheck, ttl_s: float = 0.0, max_wait_s: float = 0.2) -> FileCheck:
    """Return a check of a level's files by ``gated_check``, whose results are valid for ``ttl_s`` seconds.

    A caller waits for a check at most ``max_wait_s`` seconds.
    """
    return FileCheck("level", "old", gated_check, ttl_s, max_wait_s)


def test_hanging_check_returns_the_old_level():
    async def scenario() -> None:
        gated_check = GatedCheck()
        level = check(gated_check)
        assert await asyncio.gather(*(level.current() for _ in range(50))) == ["old"] * 50
        assert gated_check.started_count == 1, "all requests wait for one check"
        assert level.fresh_value() == "old"
        assert await asyncio.wait_for(level.current(), 0.1) == "old", "later requests do not wait for the hanging check"
        gated_check.may_finish.set()
        while await level.current() == "old":
            await asyncio.sleep(0.01)

    asyncio.run(scenario())


def test_check_in_time_is_awaited():
    async def scenario() -> None:
        gated_check = GatedCheck()
        gated_check.may_finish.set()
        level = check(gated_check, ttl_s=60.0, max_wait_s=30.0)
        assert level.fresh_value() is None
        assert await level.current() == level.fresh_value() == "new"
        await level.current()
        assert gated_check.started_count == 1, "the first result is still fresh"
        level.expire()
        await level.current()
        assert gated_check.started_count == 2

    asyncio.run(scenario())


def test_check_error_is_raised_until_a_check_succeeds():
    async def scenario() -> None:
        gated_check = GatedCheck(LevelError("level.yaml", "x", "y"))
        gated_check.may_finish.set()
        level = check(gated_check, max_wait_s=30.0)
        for _ in range(2):
            with pytest.raises(LevelError):
                await level.current()
        assert level.fresh_value() is None
        gated_check.outcome = "mended"
        assert await level.current() == "mended"

    asyncio.run(scenario())


def test_hanging_checks_are_bounded(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(level_checks, "CHECK_ABANDON_DELAY_S", 0.0)

    async def scenario() -> None:
        gated_check = GatedCheck()
        level = check(gated_check, max_wait_s=0.01)
        for _ in range(20):
            assert await level.current() == "old"
        assert gated_check.started_count == level_checks.MAX_ABANDONED_CHECKS + 1, (
            "each abandoned check holds a thread, so their number is bounded"
        )
        gated_check.may_finish.set()

    asyncio.run(scenario())


@contextmanager
def no_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let every start of a thread fail, as at a machine's limit of processes."""

    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", start)
        yield


def test_failed_thread_start_costs_no_later_check(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    """Each failed start once used up one of the few allowed checks for ever."""
    monkeypatch.setattr(level_checks, "CHECK_ABANDON_DELAY_S", 0.0)

    async def scenario() -> None:
        gated_check = GatedCheck()
        gated_check.may_finish.set()
        level = check(gated_check, max_wait_s=30.0)
        for _ in range(2 * level_checks.MAX_ABANDONED_CHECKS):
            with no_threads(monkeypatch):
                assert await asyncio.wait_for(level.current(), 1.0) == "old"
        assert await level.current() == "new"

    asyncio.run(scenario())
    assert caplog.text.count("its files cannot be checked") == 1, "the warning is logged once"


def test_check_out_of_file_descriptors_keeps_old_level():
    async def scenario() -> None:
        gated_check = GatedCheck(OSError(errno.EMFILE, "Too many open files"))
        gated_check.may_finish.set()
        level = check(gated_check, max_wait_s=30.0)
        assert await level.current() == "old"
        gated_check.outcome = "new"
        assert await level.current() == "new"

    asyncio.run(scenario())


def test_request_without_a_thread_is_503_with_retry_after(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """The level is served as last known; a request that needs a thread can be repeated later."""
    path = write_level(tmp_path, "hills")
    with running(create_app(Settings(workers=1, level_check_s=0), [path], fake_workers.scripted)) as client:
        client.get(tile("hills"))
        before = client.get("/levels/hills").json()
        level = json.loads(path.read_text())
        path.write_text(json.dumps({**level, "title": "Other hills"}), encoding="utf-8")
        with no_threads(monkeypatch):
            assert client.get("/levels/hills").json() == before
            monkeypatch.setattr(routes_wms, "run_in_threadpool", _without_a_thread)
            response = client.get("/wms?REQUEST=GetCapabilities")
        assert (response.status_code, response.headers["Retry-After"], response.headers["Content-Type"]) == (
            503,
            "5",
            "application/problem+json",
        )
        assert client.get("/levels/hills").json()["title"] == "Other hills"


async def _without_a_thread(function: object, *args: object) -> None:
    """Fail like a thread pool that cannot start a thread."""
    raise RuntimeError("can't start new thread")


def tile(level: str) -> str:
    """Return the URL path of the tile at ``CORNER``."""
    return f"/levels/{level}/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_raster_replaced_by_a_pipe_blocks_no_other_level(tmp_path: Path):
    """Opening a named pipe blocks until another process writes into it."""
    good_level, slow_level = write_level(tmp_path, "good"), write_level(tmp_path, "slow")
    settings = Settings(workers=1, level_check_s=0, level_timeout_s=2.0)
    with running(create_app(settings, [good_level, slow_level], fake_workers.scripted)) as client:
        while not client.service.pool.is_ready:
            client.get("/readyz")
        assert client.get(tile("slow")).status_code == client.get(tile("good")).status_code == 200
        raster = slow_level.with_suffix(".tif")
        raster.rename(raster.with_suffix(".old"))
        os.mkfifo(raster)
        for _ in range(3):
            response = client.get(tile("slow"), timeout=10)
            assert response.status_code == 500 and response.json()["code"] == "source"
            assert client.get(tile("good"), timeout=10).status_code == 200
            assert client.get("/healthz", timeout=10).status_code == 200
        assert "good" in {level["name"] for level in client.get("/levels", timeout=10).json()}
        raster.unlink()
        raster.with_suffix(".old").rename(raster)
        assert client.get(tile("slow"), timeout=10).status_code == 200


def test_level_that_parses_slowly_is_served_as_before(tmp_path: Path):
    path = write_level(tmp_path, "hills")
    settings = Settings(workers=1, level_check_s=0, level_timeout_s=0.2)
    with running(create_app(settings, [path], fake_workers.scripted)) as client:
        assert client.get(tile("hills")).status_code == 200
        level = json.loads(path.read_text())
        level["meshes"] = [{"generate": "tetrahedra"}] * 20_000
        path.write_text(json.dumps(level), encoding="utf-8")
        assert client.get(tile("hills"), timeout=20).status_code == 200
        assert client.get("/healthz", timeout=20).status_code == 200
