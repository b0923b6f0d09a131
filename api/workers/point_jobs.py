"""Compute sun reports, horizon files and sky charts of points. Render processes do this, because they have levels open."""

from __future__ import annotations

import json
from typing import Any

from skugga.api.point.horizon_formats import azimuths_of_format, horizon_file
from skugga.api.point.polar_picture import sky_picture
from skugga.api.point.report import point_surroundings, report_with_remark, requested_clock, requested_day
from skugga.api.point.sky_figures import sky_figures
from skugga.api.point.track import sun_at_points
from skugga.api.workers.jobs import PointJob, PointResult, PointsJob
from skugga.shadows.point.horizon import horizon_profile
from skugga.terrain.scene import Scene


def point_result(job: PointJob, scene: Scene) -> PointResult:
    """Return the report, the horizon file or the sky chart of a point, as the job's ``product`` and ``format`` say.

    A report has nulls for a point without data. Raises ``InputError``.
    """
    if job.product == "report":
        return PointResult(report_with_remark(scene, job.query).model_dump_json().encode())
    surroundings = point_surroundings(scene, job.query)
    if job.product == "horizon":
        return PointResult(
            horizon_file(job.format, horizon_profile(surroundings, azimuths_of_format(job.format)), surroundings.place).encode()
        )
    day = requested_day(scene, job.query, surroundings.place.lon_deg)
    clock = requested_clock(scene, job.query, surroundings.place.lon_deg, day)
    if job.format == "json":
        return PointResult(sky_figures(surroundings, horizon_profile(surroundings), day, clock).model_dump_json().encode())
    format: Any = job.format
    title = scene.loaded.level.title or scene.loaded.name
    return PointResult(sky_picture(surroundings, horizon_profile(surroundings), day, clock, format, title))


def points_result(job: PointsJob, scene: Scene) -> PointResult:
    """Return a JSON list with a report for each point: elevation, the sun at its time, and hours of direct sun of the day."""
    rows = sun_at_points(scene, list(job.points), job.query)
    return PointResult(json.dumps([row.as_json(point) for point, row in zip(job.points, rows, strict=True)]).encode())
