"""Queue the animations of a service: draw them in order, bound their number, bytes and age, and dismiss abandoned ones."""

from __future__ import annotations

import asyncio
import logging
import secrets
import tempfile
from collections.abc import AsyncGenerator, Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from skugga.api.animations.animation import STATUSES, Animation, AnimationStatus
from skugga.api.animations.animation_spec import AnimationSpec
from skugga.api.animations.film_file import FilmFile
from skugga.api.animations.thread_frame_iterator import ThreadFrameIterator
from skugga.api.errors import NotServedError, RetryLaterError, StorageError
from skugga.api.resource_exhaustion import exhausted_error, run_in_pool
from skugga.api.settings import Settings
from skugga.api.workers.admission import retry_after_s
from skugga.terrain.cache import Cache, Missing
from skugga.terrain.errors import BusyError, InputError, RenderError, SkuggaError

ANIMATION_ID_BYTES = 16
"""Bytes of an animation's random id. 2**128 values cannot be guessed."""

ANIMATION_OVERHEAD_BYTES = 4096
"""Estimated bytes of an animation without its film."""

DrawFrames = Callable[[AnimationSpec], AsyncGenerator[np.ndarray, None]]
"""Type of a function that draws the frames of a film, uint8 (rows, cols, 3), in the event loop."""

EncodeFilm = Callable[[Path, Iterable[np.ndarray], AnimationSpec], None]
"""Type of a function that writes frames into a file, in a thread. Raises ``OSError``."""

log = logging.getLogger("skugga")


class Animations:
    """Queue of a service's animations, which ``draw_frames`` draws and ``encode_film`` writes to files.

    Use it from one event loop. The settings bound it:

    * ``animations_at_a_time`` animations are drawn at once, in the order of their requests.
    * An animation that no client asks about for ``animation_abandoned_s`` seconds is dismissed.
    * Ended animations are cached for ``animation_age_s`` seconds.
    * The cache has up to ``animations_kept`` entries and ``animation_bytes`` bytes. It evicts the least recently used entry.
    """

    def __init__(self, settings: Settings, draw_frames: DrawFrames, encode_film: EncodeFilm) -> None:
        self._settings = settings
        self._draw_frames, self._encode_film = draw_frames, encode_film
        self._active: dict[str, Animation] = {}
        self._ended_cache: Cache[Animation] = Cache(
            "skugga.api.animations.kept", "process", settings.animation_bytes,
            lambda animation: animation.film_bytes + ANIMATION_OVERHEAD_BYTES, self._release, settings.animations_kept,
        )  # fmt: skip
        self._by_spec: dict[AnimationSpec, Animation] = {}
        self._slots = asyncio.Semaphore(settings.animations_at_a_time)
        self._threads = ThreadPoolExecutor(settings.animations_at_a_time, "skugga-film")
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        self.ended_counts: dict[AnimationStatus, int] = dict.fromkeys(STATUSES[2:], 0)

    @property
    def counts(self) -> dict[AnimationStatus, int]:
        """The number of animations by status."""
        statuses = [animation.status for animation in (*self._active.values(), *self._ended_cache.values)]
        return {status: statuses.count(status) for status in STATUSES}

    @property
    def active_count(self) -> int:
        """The number of animations that are drawn or in the queue."""
        return len(self._active)

    @property
    def cached_bytes(self) -> int:
        """Bytes of the cached films."""
        return sum(animation.film_bytes for animation in self._ended_cache.values)

    def find(self, spec: AnimationSpec) -> Animation | None:
        """Return the animation of a specification if it is queued, drawn or cached, and renew its timer as ``get`` does."""
        animation = self._by_spec.get(spec)
        return None if animation is None else self.get(animation.id)

    def check_queue(self) -> None:
        """Raise ``RetryLaterError`` if the queue is full, and ``BusyError`` after ``close``."""
        if self._closed:
            raise BusyError("The service is shutting down.")
        waiting = len(self._active) - self._settings.animations_at_a_time
        if waiting >= self._settings.animations_waiting:
            left_s = min(map(self._drawing_seconds_left, self._active.values()))
            message = f"The service is busy: {len(self._active)} animations are being drawn or waiting."
            raise RetryLaterError(message, retry_after_s(left_s))

    def request(self, spec: AnimationSpec, expected_frame_s: float) -> Animation:
        """Return the animation of a specification: the existing one, or a new one in the queue.

        ``expected_frame_s`` is the expected time of each frame in seconds. Raises the errors of ``check_queue``.
        """
        if (animation := self.find(spec)) is not None:
            return animation
        self.check_queue()
        animation = Animation(secrets.token_hex(ANIMATION_ID_BYTES), spec, expected_frame_s)
        self._active[animation.id] = self._by_spec[spec] = animation
        self._restart_abandon_timer(animation)
        animation.drawing_task = asyncio.create_task(self._run(animation))
        self._tasks.add(animation.drawing_task)
        animation.drawing_task.add_done_callback(self._tasks.discard)
        return animation

    def get(self, animation_id: str) -> Animation:
        """Return the animation with an id, and renew the timer that would dismiss it. Raises ``NotServedError``."""
        animation = self._active.get(animation_id)
        if animation is not None:
            self._restart_abandon_timer(animation)
            return animation
        ended_animation = self._ended_cache.get(animation_id)
        if isinstance(ended_animation, Missing):
            message = "animation: this animation does not exist, or has expired. Request it again."
            raise NotServedError("animation", message)
        return ended_animation

    def dismiss(self, animation: Animation, message: str) -> None:
        """End an animation at the request of a client, because no client asks about it, or when the service stops.

        A queued or running animation is no longer drawn, and its status becomes ``dismissed``. A successful animation loses its
        film, and its status becomes ``dismissed``, too. A failed or already dismissed animation does not change. Clients read
        ``message``, the reason, in the animation's status document.
        """
        if animation.status in ("failed", "dismissed"):
            return
        if animation.drawing_task is not None:
            animation.drawing_task.cancel()
        self._ended_cache.drop(animation.id)
        animation.release()
        self._end(animation, "dismissed", message)

    def seconds_left(self, animation: Animation) -> float:
        """Return the expected seconds until a queued or running animation is finished, with those that precede it in the queue."""
        if animation.has_ended:
            return 0.0
        queued_s = []
        for queued in self._active.values():
            if queued is animation:
                break
            queued_s.append(self._drawing_seconds_left(queued))
        queue_s = sum(queued_s) / self._settings.animations_at_a_time if animation.status == "accepted" else 0.0
        return queue_s + self._drawing_seconds_left(animation)

    async def close(self) -> None:
        """Dismiss all animations, delete all films, and wait until the threads that encode films have ended."""
        self._closed = True
        for animation in list(self._active.values()):
            self.dismiss(animation, "The service was stopped.")
        if self._tasks:
            await asyncio.wait(self._tasks)
        self._ended_cache.clear()
        self._threads.shutdown(wait=True)

    def _drawing_seconds_left(self, animation: Animation) -> float:
        """Return the expected seconds for the frames of an animation that are not drawn yet, without waiting in the queue.

        The time of a frame is the mean of the drawn frames; before the first one it is ``expected_frame_s``.
        """
        frames_done, spec, expected_frame_s = animation.frames_done, animation.spec, animation.expected_frame_s
        if frames_done and animation.running_since_s is not None:
            expected_frame_s = (asyncio.get_running_loop().time() - animation.running_since_s) / frames_done
        return (spec.span.frames - frames_done) * expected_frame_s

    def _restart_abandon_timer(self, animation: Animation) -> None:
        """Start the timer that dismisses an animation unless a client asks about it."""
        if animation.expiry_timer is not None:
            animation.expiry_timer.cancel()
        silence_s = self._settings.animation_abandoned_s
        message = f"No client requested its state for {silence_s:g} s (SKUGGA_ANIMATION_ABANDONED_S)."
        animation.expiry_timer = asyncio.get_running_loop().call_later(silence_s, self.dismiss, animation, message)

    async def _run(self, animation: Animation) -> None:
        """Draw an animation when a slot is free, and record its film or its error. Dismissal cancels this task."""
        loop = asyncio.get_running_loop()
        try:
            async with self._slots:
                animation.begin(loop.time())
                film = await self._draw_film(animation)
        except SkuggaError as error:
            self._fail(animation, error)
        except Exception as error:  # other animations go on
            self._fail(animation, _film_error(animation, error))
        else:
            animation.film = film
            self._end(animation, "successful")

    async def _draw_film(self, animation: Animation) -> FilmFile:
        """Draw and encode an animation, and return its film.

        When this returns or raises, drawing has stopped and the encoding thread has released the file.
        """
        loop, spec = asyncio.get_running_loop(), animation.spec
        frames = ThreadFrameIterator(self._draw_frames(spec), loop, animation.advance)
        try:
            writing = run_in_pool(self._threads, self._write_film, frames, spec)
            try:
                return await asyncio.shield(writing)
            except BaseException:
                await frames.stop()
                await asyncio.wait({writing})
                if writing.exception() is None:
                    writing.result().close()
                raise
        finally:
            await frames.stop()

    def _write_film(self, frames: Iterable[np.ndarray], spec: AnimationSpec) -> FilmFile:
        """Write the frames to an unlinked file, and return the film. The system deletes the file even if this process crashes.

        The file is unlinked when it is complete. So the folder remains only if the process is killed while it writes the film.
        """
        with tempfile.TemporaryDirectory(prefix="skugga-", ignore_cleanup_errors=True) as folder:
            path = Path(folder) / f"film.{spec.format}"
            self._encode_film(path, frames, spec)
            film = FilmFile(path)
        if film.nbytes <= self._settings.animation_bytes:
            return film
        film.close()
        limit = f"{self._settings.animation_bytes} bytes (the service's SKUGGA_ANIMATION_BYTES)"
        remedy = "Use fewer or smaller frames, or the format mp4"
        raise InputError.over_limit("size", f"the film has {film.nbytes} bytes", limit, remedy)

    def _fail(self, animation: Animation, error: SkuggaError) -> None:
        """Log the error of an animation, and end it with the status ``failed``."""
        log.warning("animation %s of level %s failed: %s", animation.id, animation.spec.level.path.stem, error)
        self._end(animation, "failed", error=error)

    def _end(
        self, animation: Animation, status: AnimationStatus, message: str | None = None, error: SkuggaError | None = None
    ) -> None:
        """Record the end of an animation and cache it. If it has no film, the next request for it draws it anew.

        ``message`` is the reason of a dismissal, and ``error`` that of a failure.
        """
        if not animation.has_ended:
            self.ended_counts[status] += 1
        animation.end(status, self._settings.animation_age_s, message, error)
        self._active.pop(animation.id, None)
        if animation.film is None:
            self._drop_spec(animation)
        if animation.expiry_timer is not None:
            animation.expiry_timer.cancel()
        self._ended_cache.put(animation.id, value=animation)
        later = asyncio.get_running_loop().call_later
        animation.expiry_timer = later(self._settings.animation_age_s, self._ended_cache.drop, animation.id)

    def _release(self, animation: Animation) -> None:
        """Release an animation that the cache evicts: delete its film. The next request for its specification draws it anew."""
        animation.release()
        self._drop_spec(animation)

    def _drop_spec(self, animation: Animation) -> None:
        """Forget that an animation answers requests for its specification, unless a newer animation answers them."""
        if self._by_spec.get(animation.spec) is animation:
            del self._by_spec[animation.spec]


def _film_error(animation: Animation, error: Exception) -> SkuggaError:
    """Return the ``SkuggaError`` that reports an exception raised while a film is written, and log the exception.

    Possible causes are exhausted threads or memory, a full disk, and a bug or an exception of the encoder.
    """
    if (exhausted := exhausted_error(error)) is not None:
        return exhausted
    if isinstance(error, OSError):
        log.error("animation %s: %s", animation.id, error)
        return StorageError(f"the film cannot be written: {error.strerror or error}")
    log.exception("animation %s failed unexpectedly", animation.id)
    return RenderError(f"{type(error).__name__}: {error}")
