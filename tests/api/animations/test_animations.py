"""Animations as jobs: their states and bounds, and that nothing is left of those that end otherwise than well."""

from __future__ import annotations

import asyncio
import errno
import gc
import os
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from skugga.api.animations.animation import Animation
from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import FRAME_TRIES, frame_renderer
from skugga.api.animations.film_order import FilmOrder
from skugga.api.errors import NotServedError, RetryLaterError, StorageError, WorkerStartError, outcome_of
from skugga.api.settings import Settings
from skugga.api.workers.jobs import FilmPicture, FrameJob, LevelKey, PlanHandover
from skugga.selector.film_request import FilmSpan
from skugga.terrain.errors import BusyError, InputError, RenderError
from tests.api.workers.test_pool import SOON_S, until

FRAMES = 4


def order(number: int = 0, frames: int = FRAMES) -> FilmOrder:
    level = LevelKey(path=Path("level.yaml"), version="1")
    return FilmOrder(level=level, level_name="level", span=FilmSpan(frames, 60.0 + number))


def ask(animations: Animations, asked: FilmOrder) -> Animation:
    return animations.ask(asked, frame_s=2.0)


class Studio:
    """Draws frames that are their numbers, each when it is let go, and writes them as text."""

    def __init__(self) -> None:
        self.go, self.drawing, self.closed = asyncio.Semaphore(0), 0, 0
        self.fails_at: dict[int, Exception] = {}
        self.encoder_fails: Exception | None = None
        self.encoding = threading.Event()
        self.folders: list[Path] = []

    async def draw(self, order: FilmOrder) -> AsyncGenerator[np.ndarray, None]:
        try:
            for number in range(order.span.frames):
                self.drawing += 1
                try:
                    await self.go.acquire()
                finally:
                    self.drawing -= 1
                if number in self.fails_at:
                    raise self.fails_at[number]
                yield np.full((2, 3, 3), number, np.uint8)
        finally:
            self.closed += 1

    def encode(self, path: Path, frames: Iterable[np.ndarray], order: FilmOrder) -> None:
        self.folders.append(path.parent)
        with path.open("w") as file:
            for frame in frames:
                self.encoding.set()
                file.write(f"{frame[0, 0, 0]},")
                if self.encoder_fails is not None:
                    raise self.encoder_fails

    def release(self, frames: int) -> None:
        for _ in range(frames):
            self.go.release()


Scenario = Callable[[Animations, Studio], Awaitable[None]]


def with_animations(scenario: Scenario, **settings) -> None:
    """Run a scenario, and make sure that nothing of it is left."""
    gc.collect()  # files that earlier tests left to the garbage collector
    before = set(os.listdir("/proc/self/fd")), threading.active_count()

    async def run() -> None:
        studio = Studio()
        animations = Animations(Settings(**settings), studio.draw, studio.encode)
        try:
            await asyncio.wait_for(scenario(animations, studio), SOON_S)
        finally:
            await asyncio.wait_for(animations.close(), SOON_S)
        assert studio.drawing == 0
        assert not any(folder.exists() for folder in studio.folders)

    asyncio.run(run())
    assert (set(os.listdir("/proc/self/fd")), threading.active_count()) == before


def film_of(animation: Animation) -> bytes:
    assert animation.film is not None
    reading = animation.film.reading(0, animation.film.nbytes)
    content = b"".join(iter(reading.chunk, b""))
    reading.close()
    return content


def test_an_animation_goes_from_accepted_to_successful_and_its_film_is_whole():
    async def scenario(animations: Animations, studio: Studio) -> None:
        animation = ask(animations, order())
        assert (animation.status, animation.frames_done, animation.film) == ("accepted", 0, None)
        studio.release(2)
        await until(lambda: animation.frames_done == 2)
        assert (animation.status, animation.film) == ("running", None)
        studio.release(FRAMES - 2)
        await until(lambda: animation.ended)
        assert (animation.status, animation.frames_done) == ("successful", FRAMES)
        assert film_of(animation) == b"0,1,2,3,"
        assert animation.film_bytes == animations.cached_bytes == 8
        assert animation.created <= animation.started <= animation.finished  # type: ignore[operator]
        assert studio.closed == 1

    with_animations(scenario)


def test_one_frame_at_most_is_drawn_ahead():
    async def scenario(animations: Animations, studio: Studio) -> None:
        held = threading.Event()
        real = studio.encode

        def slow(path: Path, frames: Iterable[np.ndarray], order: FilmOrder) -> None:
            real(path, (frame for frame in frames if held.wait()), order)

        animations._encode = slow
        animation = ask(animations, order(frames=10))
        studio.release(10)
        await until(lambda: animation.frames_done == 2)
        for _ in range(20):
            await asyncio.sleep(0)
        assert animation.frames_done == 2, "the one that is encoded, and the next"
        held.set()
        await until(lambda: animation.status == "successful")

    with_animations(scenario)


def test_the_same_order_is_the_same_animation_while_it_is_drawn_and_kept():
    async def scenario(animations: Animations, studio: Studio) -> None:
        first = ask(animations, order())
        assert ask(animations, order()) is first and ask(animations, order(1)) is not first
        studio.release(FRAMES)
        await until(lambda: first.ended)
        assert ask(animations, order()) is first
        animations.dismiss(first, "enough")
        assert ask(animations, order()) is not first

    with_animations(scenario)


def test_they_are_drawn_in_the_order_in_which_they_came():
    async def scenario(animations: Animations, studio: Studio) -> None:
        first, second, third = (ask(animations, order(number)) for number in range(3))
        for done in range(1, 3 * FRAMES + 1):
            studio.release(1)
            await until(lambda done=done: sum(each.frames_done for each in (first, second, third)) == done)
            if done == FRAMES - 1:
                assert [each.status for each in (first, second, third)] == ["running", "accepted", "accepted"]
            if done > FRAMES:
                assert first.frames_done == FRAMES
        await until(lambda: third.ended)

    with_animations(scenario)


def test_seconds_left_count_those_before():
    async def scenario(animations: Animations, studio: Studio) -> None:
        first, second = ask(animations, order(0)), ask(animations, order(1, frames=2))
        assert animations.seconds_left(first) == 8.0
        assert animations.seconds_left(second) == 12.0
        studio.release(FRAMES)
        await until(lambda: first.ended)
        assert animations.seconds_left(first) == 0.0

    with_animations(scenario)


def test_more_than_may_wait_are_refused_and_told_when_to_come_back():
    async def scenario(animations: Animations, studio: Studio) -> None:
        first, second = ask(animations, order(0)), ask(animations, order(1))
        with pytest.raises(RetryLaterError) as refused:
            ask(animations, order(2))
        assert refused.value.retry_after_s == 8, "as long as the first one takes"
        assert ask(animations, order(1)) is second, "what is there already takes no place"
        animations.dismiss(first, "enough")
        assert ask(animations, order(2)).status == "accepted"

    with_animations(scenario, animations_waiting=1)


def test_a_dismissed_animation_stops_and_gives_its_place_away():
    async def scenario(animations: Animations, studio: Studio) -> None:
        first, second = ask(animations, order(0)), ask(animations, order(1))
        studio.release(1)
        await until(lambda: first.frames_done == 1 and studio.drawing == 1)
        animations.dismiss(first, "enough")
        assert (first.status, first.message) == ("dismissed", "enough")
        await until(lambda: second.status == "running")
        studio.release(FRAMES)
        await until(lambda: second.ended)
        assert film_of(second) == b"0,1,2,3,"
        assert first.frames_done == 1
        assert animations.get(first.id).status == "dismissed", "its state is still told"
        animations.dismiss(first, "again")
        assert first.message == "enough"
        assert animations.ended == {"successful": 1, "failed": 0, "dismissed": 1}

    with_animations(scenario)


def test_a_dismissed_film_is_gone_but_for_those_who_read_it():
    async def scenario(animations: Animations, studio: Studio) -> None:
        animation = ask(animations, order())
        studio.release(FRAMES)
        await until(lambda: animation.ended)
        assert animation.film is not None
        film = animation.film
        reading = film.reading(2, 6)
        animations.dismiss(animation, "enough")
        assert (animation.film, animations.cached_bytes) == (None, 0)
        assert reading.chunk() + reading.chunk() == b"1,2,"
        assert film.closed and not film.gone
        for _ in range(2):
            reading.close()
        assert film.gone and reading.chunk() == b""
        assert animations.ended["successful"] == 1 and animations.ended["dismissed"] == 0, "it had ended before"

    with_animations(scenario)


def test_what_nobody_asks_about_is_given_up():
    async def scenario(animations: Animations, studio: Studio) -> None:
        animation = ask(animations, order())
        await until(lambda: animation.ended)
        assert animation.status == "dismissed"
        assert animation.message is not None and "SKUGGA_ANIMATION_ABANDONED_S" in animation.message
        await until(lambda: studio.drawing == 0)

    with_animations(scenario, animation_abandoned_s=0.05)


def test_what_is_asked_about_goes_on():
    """Each question puts off the end: it is the timer of the last one that counts."""

    async def scenario(animations: Animations, studio: Studio) -> None:
        animation = ask(animations, order())
        for question in (lambda: animations.get(animation.id), lambda: ask(animations, order())):
            before = animation.ending
            assert question() is animation
            assert before is not None and before.cancelled() and animation.ending is not before
        studio.release(FRAMES)
        await until(lambda: animation.ended)
        assert animation.status == "successful"

    with_animations(scenario)


def test_films_go_after_an_age():
    async def scenario(animations: Animations, studio: Studio) -> None:
        animation = ask(animations, order())
        studio.release(FRAMES)
        await until(lambda: animation.ended)
        await until(lambda: not animations.counts["successful"])
        with pytest.raises(NotServedError):
            animations.get(animation.id)
        assert ask(animations, order()) is not animation

    with_animations(scenario, animation_age_s=0.05)


def test_a_film_that_is_larger_than_all_may_be_is_none():
    async def scenario(animations: Animations, studio: Studio) -> None:
        real = studio.encode

        def huge(path: Path, frames: Iterable[np.ndarray], order: FilmOrder) -> None:
            real(path, frames, order)
            os.truncate(path, 2**20 + 1)

        animations._encode = huge
        animation = ask(animations, order())
        studio.release(FRAMES)
        await until(lambda: animation.ended)
        assert animation.status == "failed"
        assert "1048577 bytes" in str(animation.error) and "SKUGGA_ANIMATION_BYTES" in str(animation.error)

    with_animations(scenario, animation_bytes=2**20)


def test_the_oldest_films_go_where_there_are_too_many():
    async def scenario(animations: Animations, studio: Studio) -> None:
        made, films = [], []
        for number in range(3):
            made.append(ask(animations, order(number)))
            studio.release(FRAMES)
            await until(lambda: made[-1].ended)
            films.append(made[-1].film)
        assert [film.gone for film in films] == [True, False, False]
        with pytest.raises(NotServedError):
            animations.get(made[0].id)
        assert animations.get(made[1].id) is made[1]

    with_animations(scenario, animations_kept=2)


def test_the_oldest_films_go_where_they_are_too_large():
    async def scenario(animations: Animations, studio: Studio) -> None:
        real = studio.encode

        def large(path: Path, frames: Iterable[np.ndarray], order: FilmOrder) -> None:
            real(path, frames, order)
            os.truncate(path, 600_000)

        animations._encode = large
        films = []
        for number in range(2):
            last = ask(animations, order(number))
            studio.release(FRAMES)
            await until(lambda last=last: last.ended)
            films.append(last.film)
        assert [film.gone for film in films] == [True, False]
        assert animations.cached_bytes == 600_000

    with_animations(scenario, animation_bytes=2**20)


@pytest.mark.parametrize(
    ("raised", "told"),
    [
        (InputError("path, frame 2", "x", "a camera above the ground"), InputError),
        (RenderError("it went wrong"), RenderError),
        (OSError(errno.ENOSPC, "No space left on device"), StorageError),
        (ZeroDivisionError("a bug"), RenderError),
    ],
)
@pytest.mark.parametrize("where", ["drawing", "encoding"])
def test_one_that_fails_says_why_and_the_next_one_is_drawn(raised: Exception, told: type, where: str):
    async def scenario(animations: Animations, studio: Studio) -> None:
        if where == "drawing":
            studio.fails_at[1] = raised
        else:
            studio.encoder_fails = raised
        first, second = ask(animations, order(0)), ask(animations, order(1))
        studio.release(2)
        await until(lambda: first.ended)
        assert (first.status, type(first.error), first.film) == ("failed", told, None)
        studio.fails_at, studio.encoder_fails = {}, None
        studio.release(FRAMES)
        await until(lambda: second.ended)
        assert second.status == "successful"
        assert ask(animations, order(0)) is not first, "it is tried again"

    with_animations(scenario)


def test_an_encoder_that_stops_early_leaves_nothing_running():
    async def scenario(animations: Animations, studio: Studio) -> None:
        animations._encode = lambda path, frames, order: path.touch()
        animation = ask(animations, order())
        await until(lambda: animation.ended)
        assert studio.drawing == 0

    with_animations(scenario)


def test_a_service_that_stops_ends_all_of_them():
    """Also one whose encoder is just at work, and one that waits."""

    async def scenario(animations: Animations, studio: Studio) -> None:
        first, second = ask(animations, order(0)), ask(animations, order(1))
        studio.release(1)
        await asyncio.to_thread(studio.encoding.wait, SOON_S)
        await animations.close()
        assert (first.status, second.status) == ("dismissed", "dismissed")
        with pytest.raises(BusyError):
            ask(animations, order(2))

    with_animations(scenario)


def test_names_are_long_and_never_the_same():
    async def scenario(animations: Animations, studio: Studio) -> None:
        names = {ask(animations, order(number)).id for number in range(4)}
        assert len(names) == 4 and all(len(name) == 32 for name in names)
        with pytest.raises(NotServedError):
            animations.get("0" * 32)

    with_animations(scenario)


class StartingPool:
    """A pool no process of which starts for the first few jobs."""

    def __init__(self, failures: int) -> None:
        self.failures, self.jobs = failures, []

    async def run(self, job: FrameJob) -> FilmPicture:
        self.jobs.append(job.number)
        if len(self.jobs) <= self.failures:
            raise WorkerStartError("a render process ended while it warmed up")
        return FilmPicture(np.full((2, 3, 3), job.number, np.uint8), PlanHandover(None))


@pytest.mark.parametrize(("failures", "drawn"), [(0, FRAMES), (FRAME_TRIES - 1, FRAMES), (FRAME_TRIES, 0)])
def test_a_frame_waits_for_a_process_that_starts(monkeypatch, failures, drawn):
    """It is tried a few times, with pauses; an animation fails where that does not help."""
    pauses = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)

    async def level_now(name: str) -> LevelKey:
        return order().level

    async def frames_of(pool: StartingPool) -> list[int]:
        return [int(frame[0, 0, 0]) async for frame in frame_renderer(pool, level_now)(order())]  # type: ignore[arg-type]

    monkeypatch.setattr("skugga.api.animations.drawing.asyncio.sleep", pause)
    pool = StartingPool(failures)
    if drawn:
        assert asyncio.run(frames_of(pool)) == list(range(FRAMES))
        assert pool.jobs == [0] * failures + list(range(FRAMES))
    else:
        with pytest.raises(WorkerStartError):
            asyncio.run(frames_of(pool))
    assert pauses == [outcome_of(WorkerStartError("")).retry_after_s] * min(failures, FRAME_TRIES - 1)
