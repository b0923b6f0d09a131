"""Hand frames from the event loop to the thread that encodes them. One frame is drawn while the one before it is encoded."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Iterator
from concurrent.futures import Future
from typing import Generic, TypeVar

T = TypeVar("T")


class StoppedError(Exception):
    """The handover was stopped. The error ends the thread's work and reaches no client."""


class _End:
    pass


_END = _End()


class FrameHandover(Generic[T]):
    """Iterator for a thread over the items of an async generator, which runs in an event loop.

    It holds at most two items: the current one and the next one. The event loop calls ``on_frame`` with the number of items so far.
    """

    def __init__(self, frames: AsyncGenerator[T, None], loop: asyncio.AbstractEventLoop, on_frame: Callable[[int], None]) -> None:
        self._frames, self._loop, self._on_frame = frames, loop, on_frame
        self._count = 0
        self._stopped = False
        self._pending: asyncio.Task[T | _End] | None = None

    def __iter__(self) -> Iterator[T]:
        """Yield the frames. Raises ``StoppedError`` after ``stop``, and the errors of the generator."""
        next_frame = self._request_next()
        while True:
            frame = next_frame.result()
            if isinstance(frame, _End):
                return
            next_frame = self._request_next()
            yield frame

    async def stop(self) -> None:
        """Stop the generator. The thread's next item raises ``StoppedError``. Call it in the event loop."""
        self._stopped = True
        if self._pending is not None:
            self._pending.cancel()
            await asyncio.wait({self._pending})
        await self._frames.aclose()

    def _request_next(self) -> Future[T | _End]:
        return asyncio.run_coroutine_threadsafe(self._next(), self._loop)

    async def _next(self) -> T | _End:
        if self._stopped:
            raise StoppedError
        self._pending = asyncio.ensure_future(self._frame())
        try:
            return await self._pending
        except asyncio.CancelledError:
            raise StoppedError from None

    async def _frame(self) -> T | _End:
        frame = await anext(self._frames, _END)
        if not isinstance(frame, _End):
            self._count += 1
            self._on_frame(self._count)
        return frame
