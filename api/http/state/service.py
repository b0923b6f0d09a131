"""What the routes share, and how they wait for work."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request

from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import frame_job
from skugga.api.animations.film_order import FilmOrder
from skugga.api.errors import NotServedError
from skugga.api.http.answers import FACTS_S, ExpectedTime
from skugga.api.http.moments import fresh_for
from skugga.api.http.state.encoded_tiles import EncodedTiles
from skugga.api.http.state.metrics import ServiceMetrics
from skugga.api.http.state.new_suns import NewSuns, network_of
from skugga.api.http.state.served_archives import ServedArchives
from skugga.api.http.state.served_levels import ServedLevel, ServedLevels
from skugga.api.settings import Settings
from skugga.api.workers.jobs import DescribedPlanJob, FilmChecked, Job, Result
from skugga.api.workers.pool import Pool
from skugga.terrain.errors import LevelError, SkuggaError, SourceError

T = TypeVar("T")

log = logging.getLogger("skugga")


@dataclass(frozen=True)
class Service:
    """Settings, levels, archives, render processes and animations of an application."""

    settings: Settings
    levels: ServedLevels
    archives: ServedArchives
    pool: Pool
    tiles: EncodedTiles
    new_suns: NewSuns
    animations: Animations
    metrics: ServiceMetrics

    async def close(self) -> None:
        """End all that is being drawn, and what draws it."""
        await self.animations.close()
        await self.pool.close()

    @property
    def draws(self) -> bool:
        """Whether there are render processes: archives alone need none."""
        return bool(self.levels.names()) or self.settings.levels is not None

    def fresh_s(self, request: Request, otherwise_s: int) -> int:
        """How many seconds a picture is fresh: a minute while the device is to be calibrated or levels are to be probed, so that
        clients do not join pictures of other plans with it for long.
        """
        soon_others = self.pool.calibrating.expected or self.pool.probing.waiting
        return fresh_for(request, min(otherwise_s, FACTS_S) if soon_others else otherwise_s)

    def frame_s(self, order: FilmOrder, checked: FilmChecked) -> float:
        """How many seconds each frame of a film is expected to take."""
        return self.pool.expected_s(frame_job(order, 0)) if checked.frame_ms is None else checked.frame_ms / 1000.0

    async def level(self, name: str) -> ServedLevel:
        """A level as it is now. Raises ``NotServedError``, ``LevelError`` or ``SourceError``."""
        return await self.levels.current(name)

    async def all_levels(self) -> list[ServedLevel]:
        """All levels as they are now; one that was broken since is left out."""
        names = self.levels.names()
        found = await asyncio.gather(*(self.levels.current(name) for name in names), return_exceptions=True)
        for name, level in zip(names, found, strict=True):
            if isinstance(level, BaseException) and not isinstance(level, SkuggaError):
                raise level
            if isinstance(level, SkuggaError):
                log.error("level %s: %s", name, level)
        return [level for level in found if isinstance(level, ServedLevel)]

    async def done(self, request: Request, job: Job) -> Result:
        """A job's answer, for as long as the client waits for it.

        Raises ``TooManySunsError`` for a client that asks for too many suns, ``ClientGoneError``, ``NotServedError`` for a level
        that is served no more and whose files are gone, or where nothing is drawn, and what ``Pool.run`` raises.
        """
        if not self.draws:
            raise NotServedError("level", "This service has archives alone, and draws nothing.")
        client = network_of(request.client.host if request.client else "")
        if self.pool.finished(job) is None:
            if job.request.sun is not None:
                level = None if isinstance(job, DescribedPlanJob) else job.level
                self.new_suns.take(client, (level, job.request.sun))
            request.state.expected_time = ExpectedTime(self.pool.expected_wait_s(job, client), self.pool.expected_s(job))
        try:
            return await cancel_on_disconnect(request, self.pool.run(job, client))
        except (LevelError, SourceError):
            if isinstance(job, DescribedPlanJob) or self.levels.serves(job.level.path):
                raise
            raise NotServedError("level", "This level is not served any more.") from None


class ClientGoneError(Exception):
    """The client has closed the connection: nobody reads the answer."""


def service_of(request: Request) -> Service:
    """The service of a request's application."""
    return request.app.state.service


async def the_service(request: Request) -> Service:
    """The dependency. A plain function would be called in a thread, of which there may be none left."""
    return service_of(request)


TheService = Annotated[Service, Depends(the_service)]


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
