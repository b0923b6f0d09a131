"""Animations as jobs: their states, their limits, and the cleanup after every kind of end."""

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
from skugga.api.animations.animation_spec import AnimationSpec
from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import MAX_FRAME_ATTEMPTS, frame_renderer
from skugga.api.errors import NotServedError, RetryLaterError, StorageError, WorkerStartError, error_report_of
from skugga.api.settings import Settings
from skugga.api.workers.jobs import FilmPicture, FilmPlanState, FrameJob, LevelKey
from skugga.selector.film_request import FilmSpan
from skugga.terrain.errors import BusyError, InputError, RenderError
from tests.api.workers.test_pool import TIMEOUT_S, wait_until

FRAME_COUNT = 4
"""Frames of a film by default."""


def animation_spec(number: int = 0, frames: int = FRAME_COUNT) -> AnimationSpec:
    """Return the order of a film. Specs with different numbers are different films."""
    level = LevelKey(path=Path("level.yaml"), version="1")
    return AnimationSpec(level=level, level_name="level", span=FilmSpan(frames, 60.0 + number))


def request_animation(animations: Animations, order: AnimationSpec) -> Animation:
    """Request a film whose frames are expected to take 2 s each."""
    return animations.request(order, expected_frame_s=2.0)


class FakeBackend:
    """Draw frames filled with their number, one per permit, and encode them as text."""

    def __init__(self) -> None:
        self.frame_permits, self.drawing, self.closed = asyncio.Semaphore(0), 0, 0
        self.frame_errors: dict[int, Exception] = {}
        self.encoder_error: Exception | None = None
        self.encoding = threading.Event()
        self.folders: list[Path] = []

    async def draw(self, spec: AnimationSpec) -> AsyncGenerator[np.ndarray, None]:
        try:
            for number in range(spec.span.frames):
                self.drawing += 1
                try:
                    await self.frame_permits.acquire()
                finally:
                    self.drawing -= 1
                if number in self.frame_errors:
                    raise self.frame_errors[number]
                yield np.full((2, 3, 3), number, np.uint8)
        finally:
            self.closed += 1

    def encode(self, path: Path, frames: Iterable[np.ndarray], spec: AnimationSpec) -> None:
        """Write the first value of each frame to a text file. Raise ``encoder_error`` after the first frame if it is set."""
        self.folders.append(path.parent)
        with path.open("w") as file:
            for frame in frames:
                self.encoding.set()
                file.write(f"{frame[0, 0, 0]},")
                if self.encoder_error is not None:
                    raise self.encoder_error

    def release(self, frames: int) -> None:
        """Allow a number of further frames to be drawn."""
        for _ in range(frames):
            self.frame_permits.release()


Scenario = Callable[[Animations, FakeBackend], Awaitable[None]]


def run_with_animations(scenario: Scenario, **settings) -> None:
    """Run a scenario, and check that it leaves no task, file or thread."""
    gc.collect()  # files that earlier tests left to the garbage collector
    before = set(os.listdir("/proc/self/fd")), threading.active_count()

    async def run() -> None:
        backend = FakeBackend()
        animations = Animations(Settings(**settings), backend.draw, backend.encode)
        try:
            await asyncio.wait_for(scenario(animations, backend), TIMEOUT_S)
        finally:
            await asyncio.wait_for(animations.close(), TIMEOUT_S)
        assert backend.drawing == 0
        assert not any(folder.exists() for folder in backend.folders)

    asyncio.run(run())
    assert (set(os.listdir("/proc/self/fd")), threading.active_count()) == before


def film_content(animation: Animation) -> bytes:
    """Return the bytes of an animation's finished film."""
    assert animation.film is not None
    reader = animation.film.open_reader(0, animation.film.nbytes)
    content = b"".join(iter(reader.read_chunk, b""))
    reader.close()
    return content


def test_animation_goes_from_accepted_to_successful():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animation = request_animation(animations, animation_spec())
        assert (animation.status, animation.frames_done, animation.film) == ("accepted", 0, None)
        backend.release(2)
        await wait_until(lambda: animation.frames_done == 2)
        assert (animation.status, animation.film) == ("running", None)
        backend.release(FRAME_COUNT - 2)
        await wait_until(lambda: animation.has_ended)
        assert (animation.status, animation.frames_done) == ("successful", FRAME_COUNT)
        assert film_content(animation) == b"0,1,2,3,"
        assert animation.film_bytes == animations.cached_bytes == len(b"0,1,2,3,")
        assert animation.created <= animation.started <= animation.finished  # type: ignore[operator]
        assert backend.closed == 1

    run_with_animations(scenario)


def test_at_most_one_frame_is_drawn_ahead():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        release_event = threading.Event()
        original_encode = backend.encode

        def encode_on_release(path: Path, frames: Iterable[np.ndarray], spec: AnimationSpec) -> None:
            original_encode(path, (frame for frame in frames if release_event.wait()), spec)

        animations._encode_film = encode_on_release
        animation = request_animation(animations, animation_spec(frames=10))
        backend.release(10)
        await wait_until(lambda: animation.frames_done == 2)
        for _ in range(20):
            await asyncio.sleep(0)
        assert animation.frames_done == 2, "one frame is being encoded, and one is drawn ahead"
        release_event.set()
        await wait_until(lambda: animation.status == "successful")

    run_with_animations(scenario)


def test_equal_requests_share_an_animation_while_it_exists():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first = request_animation(animations, animation_spec())
        assert (
            request_animation(animations, animation_spec()) is first
            and request_animation(animations, animation_spec(1)) is not first
        )
        backend.release(FRAME_COUNT)
        await wait_until(lambda: first.has_ended)
        assert request_animation(animations, animation_spec()) is first
        animations.dismiss(first, "enough")
        assert request_animation(animations, animation_spec()) is not first

    run_with_animations(scenario)


def test_animations_are_drawn_in_order_of_arrival():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first, second, third = (request_animation(animations, animation_spec(number)) for number in range(3))
        for done in range(1, 3 * FRAME_COUNT + 1):
            backend.release(1)
            await wait_until(lambda done=done: sum(animation.frames_done for animation in (first, second, third)) == done)
            if done == FRAME_COUNT - 1:
                assert [animation.status for animation in (first, second, third)] == ["running", "accepted", "accepted"]
            if done > FRAME_COUNT:
                assert first.frames_done == FRAME_COUNT
        await wait_until(lambda: third.has_ended)

    run_with_animations(scenario)


def test_seconds_left_include_earlier_animations():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first, second = request_animation(animations, animation_spec(0)), request_animation(animations, animation_spec(1, frames=2))
        # A frame takes 2 s. The first animation has 4 frames, and the second has 2 and waits for the first.
        assert animations.seconds_left(first) == 8.0
        assert animations.seconds_left(second) == 12.0
        backend.release(FRAME_COUNT)
        await wait_until(lambda: first.has_ended)
        assert animations.seconds_left(first) == 0.0

    run_with_animations(scenario)


def test_full_queue_rejects_animations_with_retry_after():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first, second = request_animation(animations, animation_spec(0)), request_animation(animations, animation_spec(1))
        with pytest.raises(RetryLaterError) as error_info:
            request_animation(animations, animation_spec(2))
        assert error_info.value.retry_after_s == 8, "the first animation takes 8 s: 4 frames of 2 s"
        assert request_animation(animations, animation_spec(1)) is second, "a request for a waiting animation takes no slot"
        animations.dismiss(first, "enough")
        assert request_animation(animations, animation_spec(2)).status == "accepted"

    run_with_animations(scenario, animations_waiting=1)


def test_dismissed_animation_stops_and_frees_its_slot():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first, second = request_animation(animations, animation_spec(0)), request_animation(animations, animation_spec(1))
        backend.release(1)
        await wait_until(lambda: first.frames_done == 1 and backend.drawing == 1)
        animations.dismiss(first, "enough")
        assert (first.status, first.message) == ("dismissed", "enough")
        await wait_until(lambda: second.status == "running")
        backend.release(FRAME_COUNT)
        await wait_until(lambda: second.has_ended)
        assert film_content(second) == b"0,1,2,3,"
        assert first.frames_done == 1
        assert animations.get(first.id).status == "dismissed", "clients can still read the state"
        animations.dismiss(first, "again")
        assert first.message == "enough"
        assert animations.ended_counts == {"successful": 1, "failed": 0, "dismissed": 1}

    run_with_animations(scenario)


def test_dismissed_film_stays_readable_by_open_readers():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animation = request_animation(animations, animation_spec())
        backend.release(FRAME_COUNT)
        await wait_until(lambda: animation.has_ended)
        assert animation.film is not None
        film = animation.film
        reader = film.open_reader(2, 6)
        animations.dismiss(animation, "enough")
        assert (animation.film, animations.cached_bytes) == (None, 0)
        assert reader.read_chunk() + reader.read_chunk() == b"1,2,"
        assert film.is_closed and not film.is_file_closed
        for _ in range(2):
            reader.close()
        assert film.is_file_closed and reader.read_chunk() == b""
        assert animations.ended_counts["successful"] == 1 and animations.ended_counts["dismissed"] == 0, (
            "an animation that had ended stays counted as successful"
        )

    run_with_animations(scenario)


def test_unpolled_animation_is_abandoned():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animation = request_animation(animations, animation_spec())
        await wait_until(lambda: animation.has_ended)
        assert animation.status == "dismissed"
        assert animation.message is not None and "SKUGGA_ANIMATION_ABANDONED_S" in animation.message
        await wait_until(lambda: backend.drawing == 0)

    run_with_animations(scenario, animation_abandoned_s=0.05)


def test_polled_animation_is_kept():
    """Each poll restarts the timer that abandons the animation."""

    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animation = request_animation(animations, animation_spec())
        for poll in (lambda: animations.get(animation.id), lambda: request_animation(animations, animation_spec())):
            timer_before = animation.expiry_timer
            assert poll() is animation
            assert timer_before is not None and timer_before.cancelled() and animation.expiry_timer is not timer_before
        backend.release(FRAME_COUNT)
        await wait_until(lambda: animation.has_ended)
        assert animation.status == "successful"

    run_with_animations(scenario)


def test_films_expire():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animation = request_animation(animations, animation_spec())
        backend.release(FRAME_COUNT)
        await wait_until(lambda: animation.has_ended)
        await wait_until(lambda: not animations.counts["successful"])
        with pytest.raises(NotServedError):
            animations.get(animation.id)
        assert request_animation(animations, animation_spec()) is not animation

    run_with_animations(scenario, animation_age_s=0.05)


def test_film_over_the_byte_limit_is_not_kept():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        original_encode = backend.encode

        def encode_over_limit(path: Path, frames: Iterable[np.ndarray], spec: AnimationSpec) -> None:
            original_encode(path, frames, spec)
            os.truncate(path, 2**20 + 1)

        animations._encode_film = encode_over_limit
        animation = request_animation(animations, animation_spec())
        backend.release(FRAME_COUNT)
        await wait_until(lambda: animation.has_ended)
        assert animation.status == "failed"
        assert "1048577 bytes" in str(animation.error) and "SKUGGA_ANIMATION_BYTES" in str(animation.error)

    run_with_animations(scenario, animation_bytes=2**20)


def test_oldest_films_are_evicted_above_the_count_limit():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        film_jobs, films = [], []
        for number in range(3):
            film_jobs.append(request_animation(animations, animation_spec(number)))
            backend.release(FRAME_COUNT)
            await wait_until(lambda: film_jobs[-1].has_ended)
            films.append(film_jobs[-1].film)
        assert [film.is_file_closed for film in films] == [True, False, False]
        with pytest.raises(NotServedError):
            animations.get(film_jobs[0].id)
        assert animations.get(film_jobs[1].id) is film_jobs[1]

    run_with_animations(scenario, animations_kept=2)


def test_oldest_films_are_evicted_above_the_byte_limit():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        original_encode = backend.encode

        def encode_large_film(path: Path, frames: Iterable[np.ndarray], spec: AnimationSpec) -> None:
            original_encode(path, frames, spec)
            os.truncate(path, 600_000)

        animations._encode_film = encode_large_film
        films = []
        for number in range(2):
            last = request_animation(animations, animation_spec(number))
            backend.release(FRAME_COUNT)
            await wait_until(lambda last=last: last.has_ended)
            films.append(last.film)
        assert [film.is_file_closed for film in films] == [True, False]
        assert animations.cached_bytes == 600_000

    run_with_animations(scenario, animation_bytes=2**20)


@pytest.mark.parametrize(
    ("error", "expected_error"),
    [
        (InputError("path, frame 2", "x", "a camera above the ground"), InputError),
        (RenderError("it went wrong"), RenderError),
        (OSError(errno.ENOSPC, "No space left on device"), StorageError),
        (ZeroDivisionError("a bug"), RenderError),
    ],
)
@pytest.mark.parametrize("failing_stage", ["drawing", "encoding"])
def test_failed_animation_has_a_reason_and_the_next_is_drawn(error: Exception, expected_error: type, failing_stage: str):
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        if failing_stage == "drawing":
            backend.frame_errors[1] = error
        else:
            backend.encoder_error = error
        first, second = request_animation(animations, animation_spec(0)), request_animation(animations, animation_spec(1))
        backend.release(2)
        await wait_until(lambda: first.has_ended)
        assert (first.status, type(first.error), first.film) == ("failed", expected_error, None)
        backend.frame_errors, backend.encoder_error = {}, None
        backend.release(FRAME_COUNT)
        await wait_until(lambda: second.has_ended)
        assert second.status == "successful"
        assert request_animation(animations, animation_spec(0)) is not first, "a new request draws a failed film again"

    run_with_animations(scenario)


def test_failed_encoder_leaves_no_task_running():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        animations._encode_film = lambda path, frames, order: path.touch()
        animation = request_animation(animations, animation_spec())
        await wait_until(lambda: animation.has_ended)
        assert backend.drawing == 0

    run_with_animations(scenario)


def test_shutdown_ends_all_animations():
    """One animation is being encoded, and one waits in the queue."""

    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        first, second = request_animation(animations, animation_spec(0)), request_animation(animations, animation_spec(1))
        backend.release(1)
        await asyncio.to_thread(backend.encoding.wait, TIMEOUT_S)
        await animations.close()
        assert (first.status, second.status) == ("dismissed", "dismissed")
        with pytest.raises(BusyError):
            request_animation(animations, animation_spec(2))

    run_with_animations(scenario)


def test_animation_ids_are_long_and_unique():
    async def scenario(animations: Animations, backend: FakeBackend) -> None:
        names = {request_animation(animations, animation_spec(number)).id for number in range(4)}
        assert len(names) == 4 and all(len(name) == 32 for name in names)
        with pytest.raises(NotServedError):
            animations.get("0" * 32)

    run_with_animations(scenario)


class FlakyPool:
    """Pool whose process fails to start for the first jobs."""

    def __init__(self, failures: int) -> None:
        self.failures, self.jobs = failures, []

    async def run(self, job: FrameJob) -> FilmPicture:
        self.jobs.append(job.frame_number)
        if len(self.jobs) <= self.failures:
            raise WorkerStartError("a render process ended while it warmed up")
        return FilmPicture(np.full((2, 3, 3), job.frame_number, np.uint8), FilmPlanState(None))


@pytest.mark.parametrize(
    ("failed_starts", "drawn_frames"), [(0, FRAME_COUNT), (MAX_FRAME_ATTEMPTS - 1, FRAME_COUNT), (MAX_FRAME_ATTEMPTS, 0)]
)
def test_frame_is_retried_until_a_process_starts(monkeypatch, failed_starts, drawn_frames):
    """The frame is retried a few times, with pauses. Then the animation fails."""
    pauses = []

    async def pause(seconds: float) -> None:
        pauses.append(seconds)

    async def level_now(name: str) -> LevelKey:
        return animation_spec().level

    async def frame_numbers(pool: FlakyPool) -> list[int]:
        return [int(frame[0, 0, 0]) async for frame in frame_renderer(pool, level_now)(animation_spec())]  # type: ignore[arg-type]

    monkeypatch.setattr("skugga.api.animations.drawing.asyncio.sleep", pause)
    pool = FlakyPool(failed_starts)
    if drawn_frames:
        assert asyncio.run(frame_numbers(pool)) == list(range(FRAME_COUNT))
        assert pool.jobs == [0] * failed_starts + list(range(FRAME_COUNT))
    else:
        with pytest.raises(WorkerStartError):
            asyncio.run(frame_numbers(pool))
    assert pauses == [error_report_of(WorkerStartError("")).retry_after_s] * min(failed_starts, MAX_FRAME_ATTEMPTS - 1)
