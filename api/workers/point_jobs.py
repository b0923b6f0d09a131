"""Compute sun reports, horizon files, sky charts and irradiation of points, in render processes, which have levels open."""

from __future__ import annotations

import json
from typing import Any

from skugga.api.point.horizon_formats import azimuths_of_format, horizon_file
from skugga.api.point.irradiation import csv_text, irradiation_with_remark, point_irradiation
from skugga.api.point.irradiation_chart import irradiation_chart
from skugga.api.point.polar_picture import sky_picture
from skugga.api.point.report import point_surroundings, report_with_remark, requested_clock, requested_day
from skugga.api.point.sky_figures import sky_figures
from skugga.api.point.track import sun_at_points
from skugga.api.workers.jobs import PointJob, PointResult, PointsJob
from skugga.shadows.point.horizon import horizon_profile
from skugga.terrain.scene import Scene


def point_result(job: PointJob, scene: Scene) -> PointResult:
    """Return what a job asks of a point, as its ``product`` and ``format`` say.

    A report, also of irradiation, has nulls for a point without data. Raises ``InputError``.
    """
    if job.product == "report":
        return PointResult(report_with_remark(scene, job.query).model_dump_json().encode())
    if job.product == "irradiation":
        return PointResult(_irradiation_file(job, scene))
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


def _irradiation_file(job: PointJob, scene: Scene) -> bytes:
    """Return the irradiation at a point in the job's format. Raises ``InputError``."""
    if job.format == "json":
        return irradiation_with_remark(scene, job.query, job.irradiation).model_dump_json().encode()
    report = point_irradiation(scene, job.query, job.irradiation)
    if job.format == "csv":
        return csv_text(report).encode()
    format: Any = job.format
    return irradiation_chart(report, format, scene.loaded.level.title or scene.loaded.name)


def points_result(job: PointsJob, scene: Scene) -> PointResult:
    """Return a JSON list with a report for each point: elevation, the sun at its time, and hours of direct sun of the day."""
    rows = sun_at_points(scene, list(job.points), job.query)
    return PointResult(json.dumps([row.as_json(point) for point, row in zip(job.points, rows, strict=True)]).encode())
