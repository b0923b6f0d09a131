"""Run a job and build its response: entity tag, 304, cache rules and timings."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import Request, Response

from skugga.api.http.answers import cache_headers, entity_tag, is_fresh, render_headers
from skugga.api.http.request_times import fresh_for, time_headers
from skugga.api.http.state.service import Service
from skugga.api.workers.jobs import MapJob, PointAnswer, PointJob, Snapshot, SnapshotJob


async def job_answer(
    request: Request,
    service: Service,
    job: MapJob | SnapshotJob | PointJob,
    level: str,
    subject: str,
    media_type: str,
    fresh_s: int,
    written: Callable[[bytes], bytes] = lambda body: body,
) -> Response:
    """Run a job of a level and return its response, or 304 if the client's copy is current.

    Parameters
    ----------
    subject
        The kind of answer, as ``map``. It is part of the entity tag.
    fresh_s
        Maximum freshness lifetime of the answer in seconds.
    written
        Function that converts the job's file to the response body.

    Raises
    ------
    SkuggaError
        The job fails or is rejected by admission control.
    """
    parts = job.level.version, level, subject, job.model_dump(exclude={"level"}, exclude_none=True), media_type
    is_picture = not isinstance(job, PointJob)
    by = (service.pool.renderer, service.pool.plan_version(job.level)) if is_picture else ()
    seconds = service.fresh_s(request, fresh_s) if is_picture else fresh_for(request, fresh_s)
    of_time = time_headers(request) if isinstance(job, PointJob) or job.request.record.when == "sun" else {}
    headers = cache_headers(entity_tag(*by, *parts), seconds) | of_time
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    kept = service.pool.finished(job) is not None
    done = await service.done(request, job)
    if isinstance(done, Snapshot):
        headers = cache_headers(entity_tag(done.renderer, done.plan_version, *parts), seconds) | of_time
        headers |= render_headers(done, subject, kept, done.encode_ms)
    else:
        assert isinstance(done, PointAnswer)
    return Response(written(done.body), headers=headers, media_type=media_type)
