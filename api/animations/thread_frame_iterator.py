"""Hand frames from the event loop to the thread that encodes them. One frame is drawn while the one before it is encoded."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterator
from concurrent.futures import Future
from typing import Generic, TypeVar

T = TypeVar("T")


class DrawingStoppedError(Exception):
    """The iterator was stopped. The error ends the thread's work and reaches no client."""


class _EndOfFrames:
    """Type of the value that marks the end of the frames, because ``StopAsyncIteration`` cannot be the result of a task."""

    pass


_END_OF_FRAMES = _EndOfFrames()


class ThreadFrameIterator(Generic[T]):
    """Iterator for a thread over the items of an async generator, which runs in an event loop.

    It holds at most two items: the current one and the next one. The event loop calls ``on_frame`` with the number of items so far.
    """

    def __init__(self, frames: AsyncGenerator[T, None], loop: asyncio.AbstractEventLoop, on_frame: Callable[[int], None]) -> None:
        self._frames, self._loop, self._on_frame = frames, loop, on_frame
        self._frame_count = 0
        self._stopped = False
        self._pending_frame: asyncio.Task[T | _EndOfFrames] | None = None

    def __iter__(self) -> Iterator[T]:
        """Yield the frames. Raises ``DrawingStoppedError`` after ``stop``, and the errors of the generator."""
        next_frame = self._request_next()
        while True:
            frame = next_frame.result()
            if isinstance(frame, _EndOfFrames):
                return
            next_frame = self._request_next()
            yield frame

    async def stop(self) -> None:
        """Stop the generator. The thread's next item raises ``DrawingStoppedError``. Call it in the event loop."""
        self._stopped = True
        if self._pending_frame is not None:
            self._pending_frame.cancel()
            await asyncio.wait({self._pending_frame})
        await self._frames.aclose()

    def _request_next(self) -> Future[T | _EndOfFrames]:
        """Start to draw the next frame in the event loop, from any thread, and return its future."""
        return asyncio.run_coroutine_threadsafe(self._next_frame(), self._loop)

    async def _next_frame(self) -> T | _EndOfFrames:
        """Return the next frame, or the mark of the end.

        Raises ``DrawingStoppedError`` if ``stop`` was called, or cancels the drawing.
        """
        if self._stopped:
            raise DrawingStoppedError
        self._pending_frame = asyncio.ensure_future(self._draw_next_frame())
        try:
            return await self._pending_frame
        except asyncio.CancelledError:
            raise DrawingStoppedError from None

    async def _draw_next_frame(self) -> T | _EndOfFrames:
        """Return the next item of the generator, or the mark of the end, and report the number of items so far."""
        frame = await anext(self._frames, _END_OF_FRAMES)
        if not isinstance(frame, _EndOfFrames):
            self._frame_count += 1
            self._on_frame(self._frame_count)
        return frame
