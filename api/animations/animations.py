"""The animations of a service: one after the other drawn, bounded in number, bytes and age, and given up where nobody asks for
them any more."""

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
from skugga.api.animations.film_file import FilmFile
from skugga.api.animations.film_order import FilmOrder
from skugga.api.animations.frame_handover import FrameHandover
from skugga.api.errors import LaterError, NotServedError, StorageError
from skugga.api.exhaustion import exhausted_error, in_thread
from skugga.api.settings import Settings
from skugga.api.workers.admission import retry_after_s
from skugga.terrain.cache import Cache, Missing
from skugga.terrain.errors import BusyError, InputError, Problem, RenderError, SkuggaError

ID_BYTES = 16
"""Of the random number that is an animation's name: nobody guesses one of 2**128."""

STATE_BYTES = 4096
"""About what is kept of an animation without its film."""

Draw = Callable[[FilmOrder], AsyncGenerator[np.ndarray, None]]
"""Draws the frames of a film, uint8 (rows, cols, 3), in the event loop."""

Encode = Callable[[Path, Iterable[np.ndarray], FilmOrder], None]
"""Writes frames into a file, in a thread. Raises ``OSError``."""

log = logging.getLogger("skugga")


class Animations:
    """Films that were asked for: drawn by ``draw``, written by ``encode``. To be used from one event loop.

    ``animations_at_a_time`` are drawn, in the order in which they came; others wait. One that nobody asks about for
    ``animation_abandoned_s`` is dismissed. What has ended is kept for ``animation_age_s``, within ``animations_kept`` and
    ``animation_bytes``; the one asked about last longest.
    """

    def __init__(self, settings: Settings, draw: Draw, encode: Encode) -> None:
        self._settings = settings
        self._draw, self._encode = draw, encode
        self._going: dict[str, Animation] = {}
        self._kept: Cache[Animation] = Cache(
            "skugga.api.animations.kept", "process", settings.animation_bytes, lambda each: each.film_bytes + STATE_BYTES,
            self._let_go, settings.animations_kept,
        )  # fmt: skip
        self._by_order: dict[FilmOrder, Animation] = {}
        self._turns = asyncio.Semaphore(settings.animations_at_a_time)
        self._threads = ThreadPoolExecutor(settings.animations_at_a_time, "skugga-film")
        self._works: set[asyncio.Task[None]] = set()
        self._closed = False
        self.ended: dict[AnimationStatus, int] = dict.fromkeys(STATUSES[2:], 0)

    @property
    def counts(self) -> dict[AnimationStatus, int]:
        """How many there are, by their status."""
        found = [each.status for each in (*self._going.values(), *self._kept.values)]
        return {status: found.count(status) for status in STATUSES}

    @property
    def going(self) -> int:
        """How many are drawn, or wait for that."""
        return len(self._going)

    @property
    def kept_bytes(self) -> int:
        """Bytes of the films that are kept."""
        return sum(each.film_bytes for each in self._kept.values)

    def known(self, order: FilmOrder) -> Animation | None:
        """The animation that there is of an order, while it is drawn or kept: it is asked about by that."""
        animation = self._by_order.get(order)
        return None if animation is None else self.get(animation.id)

    def check_room(self) -> None:
        """Raise ``LaterError`` where as many animations wait as may."""
        if self._closed:
            raise BusyError("The service is shutting down.")
        waiting = len(self._going) - self._settings.animations_at_a_time
        if waiting >= self._settings.animations_waiting:
            left_s = min(map(self._own_seconds_left, self._going.values()))
            message = f"The service is busy: {len(self._going)} animations are being drawn or waiting."
            raise LaterError(message, retry_after_s(left_s))

    def ask(self, order: FilmOrder, frame_s: float) -> Animation:
        """The animation of an order: the one that is known, or a new one, whose frames may take ``frame_s`` seconds each. Raises as
        ``check_room`` does.
        """
        if (animation := self.known(order)) is not None:
            return animation
        self.check_room()
        animation = Animation(secrets.token_hex(ID_BYTES), order, frame_s)
        self._going[animation.id] = self._by_order[order] = animation
        self._await_questions(animation)
        animation.work = asyncio.create_task(self._make(animation))
        self._works.add(animation.work)
        animation.work.add_done_callback(self._works.discard)
        return animation

    def get(self, name: str) -> Animation:
        """The animation of a name, which is asked about by that. Raises ``NotServedError``."""
        animation = self._going.get(name)
        if animation is not None:
            self._await_questions(animation)
            return animation
        kept = self._kept.get(name)
        if isinstance(kept, Missing):
            raise NotServedError("animation", "There is no such animation: its address is another one, or it is not kept any more.")
        return kept

    def dismiss(self, animation: Animation, message: str) -> None:
        """Stop drawing an animation, or forget its film. What has come to nothing before stays as it was."""
        if animation.status in ("failed", "dismissed"):
            return
        if animation.work is not None:
            animation.work.cancel()
        self._kept.drop(animation.id)
        animation.let_go()
        self._end(animation, "dismissed", message)

    def seconds_left(self, animation: Animation) -> float:
        """How long it is expected to take until an animation is there, those before it included."""
        if animation.ended:
            return 0.0
        before = []
        for each in self._going.values():
            if each is animation:
                break
            before.append(self._own_seconds_left(each))
        waited_for = sum(before) / self._settings.animations_at_a_time if animation.status == "accepted" else 0.0
        return waited_for + self._own_seconds_left(animation)

    async def close(self) -> None:
        """Dismiss all that is drawn, forget all films, and wait until the threads are done with theirs."""
        self._closed = True
        for animation in list(self._going.values()):
            self.dismiss(animation, "The service was stopped.")
        if self._works:
            await asyncio.wait(self._works)
        self._kept.clear()
        self._threads.shutdown(wait=True)

    def _own_seconds_left(self, animation: Animation) -> float:
        done, order, each_s = animation.frames_done, animation.order, animation.frame_s
        if done and animation.running_since_s is not None:
            each_s = (asyncio.get_running_loop().time() - animation.running_since_s) / done
        return (order.span.frames - done) * each_s

    def _await_questions(self, animation: Animation) -> None:
        """Give an animation up unless it is asked about soon."""
        if animation.ending is not None:
            animation.ending.cancel()
        silence_s = self._settings.animation_abandoned_s
        message = f"Nobody asked about it for {silence_s:g} s (SKUGGA_ANIMATION_ABANDONED_S)."
        animation.ending = asyncio.get_running_loop().call_later(silence_s, self.dismiss, animation, message)

    async def _make(self, animation: Animation) -> None:
        """Draw an animation when it is its turn. It ends well, or its error says how; a dismissed one is cancelled."""
        loop = asyncio.get_running_loop()
        try:
            async with self._turns:
                animation.begin(loop.time())
                film = await self._film(animation)
        except SkuggaError as error:
            self._fail(animation, error)
        except Exception as error:  # others go on
            self._fail(animation, _known_error(animation, error))
        else:
            animation.film = film
            self._end(animation, "successful")

    async def _film(self, animation: Animation) -> FilmFile:
        """The film, whole. However this ends, no more frames are drawn, and the thread is done with the file."""
        loop, order = asyncio.get_running_loop(), animation.order
        frames = FrameHandover(self._draw(order), loop, animation.advance)
        try:
            writing = in_thread(self._threads, self._written, frames, order)
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

    def _written(self, frames: Iterable[np.ndarray], order: FilmOrder) -> FilmFile:
        """The film in a file that has no name any more, so that it is gone however this process ends."""
        with tempfile.TemporaryDirectory(prefix="skugga-", ignore_cleanup_errors=True) as folder:
            path = Path(folder) / f"film.{order.format}"
            self._encode(path, frames, order)
            film = FilmFile(path)
        if film.nbytes <= self._settings.animation_bytes:
            return film
        film.close()
        allowed = f"films of at most {self._settings.animation_bytes} bytes (the service's SKUGGA_ANIMATION_BYTES)"
        raise InputError("size", Problem(f"a film of {film.nbytes} bytes"), f"{allowed}: of fewer or smaller frames, or in mp4")

    def _fail(self, animation: Animation, error: SkuggaError) -> None:
        log.warning("animation %s of level %s failed: %s", animation.id, animation.order.level.path.stem, error)
        self._end(animation, "failed", error=error)

    def _end(
        self, animation: Animation, status: AnimationStatus, message: str | None = None, error: SkuggaError | None = None
    ) -> None:
        """Keep an animation that has ended, for its age; only a film that is there stands for its order."""
        if not animation.ended:
            self.ended[status] += 1
        animation.end(status, self._settings.animation_age_s, message, error)
        self._going.pop(animation.id, None)
        if animation.film is None:
            self._forget_order(animation)
        if animation.ending is not None:
            animation.ending.cancel()
        self._kept.put(animation.id, value=animation)
        later = asyncio.get_running_loop().call_later
        animation.ending = later(self._settings.animation_age_s, self._kept.drop, animation.id)

    def _let_go(self, animation: Animation) -> None:
        animation.let_go()
        self._forget_order(animation)

    def _forget_order(self, animation: Animation) -> None:
        if self._by_order.get(animation.order) is animation:
            del self._by_order[animation.order]


def _known_error(animation: Animation, error: Exception) -> SkuggaError:
    """What an error of writing a film means: no thread or memory, no room on the disk, or a bug or an encoder's own exception."""
    if (exhausted := exhausted_error(error)) is not None:
        return exhausted
    if isinstance(error, OSError):
        log.error("animation %s: %s", animation.id, error)
        return StorageError(f"a film cannot be written: {error.strerror or error}")
    log.exception("animation %s failed unexpectedly", animation.id)
    return RenderError(f"{type(error).__name__}: {error}")
