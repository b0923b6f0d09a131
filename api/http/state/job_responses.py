"""Run a job in a render process and build the response: entity tag, status 304, cache rules and timings."""

from __future__ import annotations

from collections.abc import Callable

from fastapi import Request, Response

from skugga.api.http.request_times import freshness_s, time_headers
from skugga.api.http.responses import cache_headers, entity_tag, has_current_copy, render_headers
from skugga.api.http.state.service import Service
from skugga.api.workers.jobs import MapJob, PointJob, PointResult, Snapshot, SnapshotJob


async def job_response(
    request: Request,
    service: Service,
    job: MapJob | SnapshotJob | PointJob,
    level: str,
    response_kind: str,
    media_type: str,
    max_age_s: int,
    write_body: Callable[[bytes], bytes] = lambda body: body,
) -> Response:
    """Run a job of a level and return its response, or 304 if the client's copy is current.

    Parameters
    ----------
    request, service
        The request and the service.
    job
        The job, of the level that is named ``level``.
    level
        The level's name in addresses.
    response_kind
        The kind of answer, such as ``map``. It is part of the entity tag.
    media_type
        Media type of the body.
    max_age_s
        Maximum freshness lifetime of the answer in seconds.
    write_body
        Function that converts the job's bytes to the response body.

    Raises
    ------
    SkuggaError
        The job fails or is rejected by admission control.
    """
    parts = job.level.version, level, response_kind, job.model_dump(exclude={"level"}, exclude_none=True), media_type
    is_picture = not isinstance(job, PointJob)
    render_versions = (service.pool.renderer, service.pool.plan_version(job.level)) if is_picture else ()
    seconds = service.max_age_s(request, max_age_s) if is_picture else freshness_s(request, max_age_s)
    sun_time_headers = time_headers(request) if isinstance(job, PointJob) or job.request.product_record.when == "sun" else {}
    headers = cache_headers(entity_tag(*render_versions, *parts), seconds) | sun_time_headers
    if has_current_copy(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    is_cached = service.pool.cached_picture(job) is not None
    result = await service.run_job(request, job)
    if isinstance(result, Snapshot):
        headers = cache_headers(entity_tag(result.renderer, result.plan_version, *parts), seconds) | sun_time_headers
        headers |= render_headers(result, response_kind, is_cached, result.encode_ms)
    else:
        assert isinstance(result, PointResult)
    return Response(write_body(result.body), headers=headers, media_type=media_type)
