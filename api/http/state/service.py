"""The service object that all routes share. It runs jobs and cancels them when their clients disconnect."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Request

from skugga.api.animations.animation_spec import AnimationSpec
from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import frame_job
from skugga.api.errors import NotServedError
from skugga.api.http.request_times import freshness_s
from skugga.api.http.responses import METADATA_MAX_AGE_S, ExpectedTime
from skugga.api.http.state.encoded_tiles import EncodedTiles
from skugga.api.http.state.metrics import ServiceMetrics
from skugga.api.http.state.rate_limiter import RateLimiter, client_key
from skugga.api.http.state.served_archives import ServedArchives
from skugga.api.http.state.served_levels import ServedLevel, ServedLevels
from skugga.api.settings import Settings
from skugga.api.workers.jobs import DescriptorPlanJob, FilmCheckResult, Job, Result
from skugga.api.workers.pool import Pool
from skugga.terrain.errors import LevelError, SkuggaError, SourceError

T = TypeVar("T")

log = logging.getLogger("skugga")


@dataclass(frozen=True)
class Service:
    """The settings, levels, archives, render processes, caches and animations of an application."""

    settings: Settings
    levels: ServedLevels
    archives: ServedArchives
    pool: Pool
    tiles: EncodedTiles
    rate_limiter: RateLimiter
    animations: Animations
    metrics: ServiceMetrics

    async def close(self) -> None:
        """Stop animations and render processes."""
        await self.animations.close()
        await self.pool.close()

    @property
    def can_render(self) -> bool:
        """Whether the service has render processes. A service of archives alone has none."""
        return bool(self.levels.names()) or self.settings.levels is not None

    def max_age_s(self, request: Request, default_age_s: int) -> int:
        """Return the freshness lifetime of a picture in seconds.

        It is ``default_age_s``, or a minute at most while a calibration of the device or a probe of a level is pending. These
        measurements may change plans (choices of algorithms), and clients must not combine pictures of different plans for long.
        """
        is_plan_pending = self.pool.idle_calibration.is_expected or self.pool.idle_probes.requested_count
        return freshness_s(request, min(default_age_s, METADATA_MAX_AGE_S) if is_plan_pending else default_age_s)

    def expected_frame_s(self, spec: AnimationSpec, check_result: FilmCheckResult) -> float:
        """Return the expected seconds of one frame of a film: the prediction of its plan, else that of ``ExpectedTimes``."""
        return self.pool.expected_s(frame_job(spec, 0)) if check_result.frame_ms is None else check_result.frame_ms / 1000.0

    async def level(self, name: str) -> ServedLevel:
        """Return the present version of a level. Raises ``NotServedError``, ``LevelError`` or ``SourceError``."""
        return await self.levels.current(name)

    async def all_levels(self) -> list[ServedLevel]:
        """Return the present version of all levels. Levels that can no longer be read are logged and left out."""
        names = self.levels.names()
        results = await asyncio.gather(*(self.levels.current(name) for name in names), return_exceptions=True)
        for name, level in zip(names, results, strict=True):
            if isinstance(level, BaseException) and not isinstance(level, SkuggaError):
                raise level
            if isinstance(level, SkuggaError):
                log.error("level %s: %s", name, level)
        return [level for level in results if isinstance(level, ServedLevel)]

    async def run_job(self, request: Request, job: Job) -> Result:
        """Run a job in a render process and return its result. The wait ends if the client disconnects.

        Raises
        ------
        RateLimitError
            The client has requested too many new sun positions.
        ClientDisconnectedError
            The client has disconnected.
        NotServedError
            The level is no longer served, or the service has archives only and renders nothing.
        SkuggaError
            The errors of ``Pool.run``.
        """
        if not self.can_render:
            raise NotServedError("level", "level: this service has archives only and renders nothing.")
        client = client_key(request.client.host if request.client else "")
        if self.pool.cached_picture(job) is None:
            if job.request.sun is not None:
                level = None if isinstance(job, DescriptorPlanJob) else job.level
                self.rate_limiter.acquire(client, (level, job.request.sun))
            request.state.expected_time = ExpectedTime(self.pool.expected_wait_s(job, client), self.pool.expected_s(job))
        try:
            return await cancel_on_disconnect(request, self.pool.run(job, client))
        except (LevelError, SourceError):
            if isinstance(job, DescriptorPlanJob) or self.levels.is_served(job.level.path):
                raise
            raise NotServedError("level", "level: this level is no longer served.") from None


class ClientDisconnectedError(Exception):
    """The client has closed the connection."""


def service_of(request: Request) -> Service:
    """Return the service of a request's application."""
    return request.app.state.service


async def service_dependency(request: Request) -> Service:
    """Return the service (a FastAPI dependency).

    It is asynchronous because FastAPI calls other functions in a thread, and a machine under load may have no thread left.
    """
    return service_of(request)


ServiceDep = Annotated[Service, Depends(service_dependency)]


async def cancel_on_disconnect(request: Request, coroutine: Coroutine[Any, Any, T]) -> T:
    """Await a coroutine and return its result. If the client disconnects, cancel it and raise ``ClientDisconnectedError``."""
    task = asyncio.ensure_future(coroutine)
    disconnect = asyncio.ensure_future(_wait_for_disconnect(request))
    try:
        await asyncio.wait({task, disconnect}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnectedError
        return task.result()
    finally:
        task.cancel()
        disconnect.cancel()


async def _wait_for_disconnect(request: Request) -> None:
    """Return when the client of a request disconnects."""
    while (await request.receive())["type"] != "http.disconnect":
        pass
