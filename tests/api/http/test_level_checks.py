"""One level that cannot be read in time keeps nobody waiting for another one, nor for what is kept of itself."""

import asyncio
import json
import os
import threading
from pathlib import Path

import pytest

from api.http import level_checks
from api.http.app import create_app
from api.http.level_checks import LevelCheck
from api.settings import Settings
from terrain.errors import LevelError
from tests.api.conftest import CORNER, ZOOM, running, write_level
from tests.api.workers import fake_workers


class Looks:
    """A look that tests let through, or not."""

    def __init__(self, outcome: object = "new") -> None:
        self.outcome, self.begun, self.go = outcome, 0, threading.Event()

    def __call__(self) -> object:
        self.begun += 1
        assert self.go.wait(30.0)
        if isinstance(self.outcome, Exception):
            raise self.outcome
        return self.outcome


def check(looks: Looks, fresh_s: float = 0.0, wait_s: float = 0.2) -> LevelCheck:
    return LevelCheck("level", "old", looks, fresh_s, wait_s)


def test_a_look_that_hangs_is_not_waited_for_and_comes_later():
    async def scenario() -> None:
        looks = Looks()
        level = check(looks)
        assert await asyncio.gather(*(level.current() for _ in range(50))) == ["old"] * 50
        assert looks.begun == 1, "all wait for one look"
        assert level.known() == "old"
        assert await asyncio.wait_for(level.current(), 0.1) == "old", "nobody waits any more"
        looks.go.set()
        while await level.current() == "old":
            await asyncio.sleep(0.01)

    asyncio.run(scenario())


def test_a_look_that_comes_in_time_is_waited_for():
    async def scenario() -> None:
        looks = Looks()
        looks.go.set()
        level = check(looks, fresh_s=60.0, wait_s=30.0)
        assert level.known() is None
        assert await level.current() == level.known() == "new"
        await level.current()
        assert looks.begun == 1, "it is fresh"
        level.expire()
        await level.current()
        assert looks.begun == 2

    asyncio.run(scenario())


def test_what_a_look_raises_is_raised_until_a_look_does_not():
    async def scenario() -> None:
        looks = Looks(LevelError("level.yaml", "x", "y"))
        looks.go.set()
        level = check(looks, wait_s=30.0)
        for _ in range(2):
            with pytest.raises(LevelError):
                await level.current()
        assert level.known() is None
        looks.outcome = "mended"
        assert await level.current() == "mended"

    asyncio.run(scenario())


def test_a_look_that_never_comes_back_is_left_to_itself(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(level_checks, "LOOK_AGAIN_S", 0.0)

    async def scenario() -> None:
        looks = Looks()
        level = check(looks, wait_s=0.01)
        for _ in range(20):
            assert await level.current() == "old"
        assert looks.begun == level_checks.MOST_LOST + 1, "a thread each: not without end"
        looks.go.set()

    asyncio.run(scenario())


def tile(level: str) -> str:
    return f"/levels/{level}/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_raster_that_becomes_a_pipe_is_told_of_and_stops_no_other_level(tmp_path: Path):
    """Who opens a named pipe waits until somebody writes into it."""
    good, slow = write_level(tmp_path, "good"), write_level(tmp_path, "slow")
    settings = Settings(workers=1, level_check_s=0, level_timeout_s=2.0)
    with running(create_app(settings, [good, slow], fake_workers.obedient)) as client:
        while not client.service.pool.ready:
            client.get("/readyz")
        assert client.get(tile("slow")).status_code == client.get(tile("good")).status_code == 200
        raster = slow.with_suffix(".tif")
        raster.rename(raster.with_suffix(".old"))
        os.mkfifo(raster)
        for _ in range(3):
            told = client.get(tile("slow"), timeout=10)
            assert told.status_code == 500 and told.json()["code"] == "source"
            assert client.get(tile("good"), timeout=10).status_code == 200
            assert client.get("/healthz", timeout=10).status_code == 200
        assert "good" in {level["name"] for level in client.get("/levels", timeout=10).json()}
        raster.unlink()
        raster.with_suffix(".old").rename(raster)
        assert client.get(tile("slow"), timeout=10).status_code == 200


def test_a_level_that_takes_long_to_parse_is_served_as_it_was(tmp_path: Path):
    path = write_level(tmp_path, "hills")
    settings = Settings(workers=1, level_check_s=0, level_timeout_s=0.2)
    with running(create_app(settings, [path], fake_workers.obedient)) as client:
        assert client.get(tile("hills")).status_code == 200
        level = json.loads(path.read_text())
        level["meshes"] = [{"generate": "tetrahedra"}] * 20_000
        path.write_text(json.dumps(level), encoding="utf-8")
        assert client.get(tile("hills"), timeout=20).status_code == 200
        assert client.get("/healthz", timeout=20).status_code == 200
