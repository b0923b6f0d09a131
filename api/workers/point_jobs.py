"""Reports about points, computed in a render process because it has their levels open."""

from __future__ import annotations

import json
from typing import Any

from skugga.api.point.horizon_formats import directions_for, horizon_file
from skugga.api.point.polar_picture import sky_picture
from skugga.api.point.report import point_surroundings, report_or_null, requested_clock, requested_day
from skugga.api.point.sky_figures import sky_figures
from skugga.api.point.track import sun_at_points
from skugga.api.workers.jobs import PointAnswer, PointJob, PointsJob
from skugga.shadows.point.horizon import horizon_profile
from skugga.terrain.scene import Scene


def point_answer(job: PointJob, scene: Scene) -> PointAnswer:
    """Return a point's report (nulls where the level has no data), horizon file, sky chart or figures. Raises ``InputError``."""
    if job.product == "report":
        return PointAnswer(report_or_null(scene, job.query).model_dump_json().encode())
    surroundings = point_surroundings(scene, job.query)
    if job.product == "horizon":
        return PointAnswer(
            horizon_file(job.format, horizon_profile(surroundings, directions_for(job.format)), surroundings.place).encode()
        )
    day = requested_day(scene, job.query, surroundings.place.lon_deg)
    clock = requested_clock(scene, job.query, surroundings.place.lon_deg, day)
    if job.format == "json":
        return PointAnswer(sky_figures(surroundings, horizon_profile(surroundings), day, clock).model_dump_json().encode())
    format: Any = job.format
    title = scene.loaded.level.title or scene.loaded.name
    return PointAnswer(sky_picture(surroundings, horizon_profile(surroundings), day, clock, format, title))


def points_answer(job: PointsJob, scene: Scene) -> PointAnswer:
    """Return elevation, sun and hours of the day at many points as JSON."""
    rows = sun_at_points(scene, list(job.points), job.query)
    return PointAnswer(json.dumps([row.as_json(point) for point, row in zip(job.points, rows, strict=True)]).encode())
