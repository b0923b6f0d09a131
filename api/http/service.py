"""What the routes share, and how they wait for work."""

from __future__ import annotations

import asyncio
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request
from starlette.concurrency import run_in_threadpool

from api.http.encoded_tiles import EncodedTiles
from api.http.served_levels import ServedLevel, ServedLevels
from api.settings import Settings
from api.workers.pool import Pool

T = TypeVar("T")


@dataclass(frozen=True)
class Service:
    """Settings, levels and render processes of an application."""

    settings: Settings
    levels: ServedLevels
    pool: Pool
    tiles: EncodedTiles

    async def level(self, name: str) -> ServedLevel:
        """A level as it is now. Raises ``NotServedError``, ``LevelError`` or ``SourceError``."""
        return await run_in_threadpool(self.levels.get, name)


class ClientGoneError(Exception):
    """The client has closed the connection: nobody reads the answer."""


def service_of(request: Request) -> Service:
    """The dependency."""
    return request.app.state.service


TheService = Annotated[Service, Depends(service_of)]


async def cancel_on_disconnect(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """The result of work, which is cancelled when the client goes away. Raises ``ClientGoneError``."""
    task = asyncio.ensure_future(work)
    gone = asyncio.ensure_future(_gone(request))
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientGoneError
        return task.result()
    finally:
        task.cancel()
        gone.cancel()


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
