"""Fix the time of point queries that mean today, and run point jobs in a render process."""

from __future__ import annotations

from fastapi import Request

from skugga.api.http.request_times import current_quarter_hour
from skugga.api.http.responses import REQUESTED_SUN_MAX_AGE_S
from skugga.api.http.state.service import Service
from skugga.api.point.values import PointQuery
from skugga.api.workers.jobs import PointJob, PointResult, PointsJob
from skugga.terrain.level.parts import SunSpec


def resolve_current_time(point: PointQuery, sun: SunSpec | None) -> tuple[PointQuery, int]:
    """Return a query that does not depend on the clock, and the seconds for which its answer stays fresh.

    A query without a date and without a sun is about today. Its field ``now`` becomes the begin of the current quarter of an hour,
    and its answer stays fresh until the next quarter.
    """
    if sun is not None or point.date is not None:
        return point, REQUESTED_SUN_MAX_AGE_S
    begin, left_s = current_quarter_hour()
    return point.model_copy(update={"now": begin}), left_s


async def run_point_job(request: Request, service: Service, job: PointJob | PointsJob) -> bytes:
    """Run a point job and return its body. Raises ``SkuggaError``."""
    answer = await service.run_job(request, job)
    assert isinstance(answer, PointResult)
    return answer.body
