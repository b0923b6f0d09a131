"""Serve the sun at points: reports, horizon files and charts of one point (GET), and reports of many points (POST)."""

from __future__ import annotations

import json
from datetime import date, datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Body, Depends, Path, Query, Request, Response
from fastapi.responses import JSONResponse
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

from skugga.api.http.numbers import PLAIN_DECIMAL, PLAIN_INTEGER
from skugga.api.http.openapi_parts import WORK_ERROR_STATUSES, LevelPath, file_docs, problem_docs
from skugga.api.http.parameters import TimeQuery, allow_only_parameters
from skugga.api.http.points.point_queries import resolve_current_time, run_point_job
from skugga.api.http.request_times import PLAIN_DATE, PLAIN_TIME, request_sun
from skugga.api.http.state.job_responses import job_response
from skugga.api.http.state.service import Service, ServiceDep
from skugga.api.point.horizon_formats import HORIZON_FORMATS
from skugga.api.point.values import MAX_POINTS, PointQuery, PointReport, ReportedMoment, TrackPoint
from skugga.api.request import PictureRequest
from skugga.api.workers.jobs import PointJob, PointProduct, PointsJob
from skugga.shadows.point.terms import MAX_EYE_HEIGHT_M
from skugga.terrain.errors import InputError
from skugga.terrain.geo.sun_path import as_utc, check_times
from skugga.terrain.level.parts import SunSpec

router = APIRouter(tags=["points"], responses=problem_docs(*WORK_ERROR_STATUSES))

POINTS_PER_JOB = 200
"""Maximum number of points in one job. A request with more points becomes several jobs.

Jobs of other requests can run between these jobs."""

SKY_MEDIA_TYPES = {"svg": "image/svg+xml", "png": "image/png", "json": "application/json"}

POINT_PARAMETERS = ("lon", "lat", "time", "date", "height", "clock", "year")

OptionalDate = Annotated[date | None, PLAIN_DATE]
LonQuery = Annotated[
    float,
    PLAIN_DECIMAL,
    Query(ge=-1e9, le=1e9, allow_inf_nan=False, description="Degrees; in a flat world metres east.", examples=[8.43]),
]
LatQuery = Annotated[
    float,
    PLAIN_DECIMAL,
    Query(ge=-1e9, le=1e9, allow_inf_nan=False, description="Degrees; in a flat world metres north.", examples=[47.5]),
]
DateQuery = Annotated[
    date | None,
    PLAIN_DATE,
    Query(description="The day, as 2024-10-21; default: that of the time, else today.", examples=["2024-10-21"]),
]
HeightQuery = Annotated[
    float,
    PLAIN_DECIMAL,
    Query(ge=0.0, le=MAX_EYE_HEIGHT_M, allow_inf_nan=False, description="Metres above the ground.", examples=[1.7]),
]
ClockQuery = Annotated[
    str | None,
    Query(
        max_length=60,
        description="solar, utc, +02:00 or Europe/Oslo; default: the offset of the time, else solar.",
        examples=["Europe/Oslo"],
    ),
]
YearQuery = Annotated[
    int | None,
    PLAIN_INTEGER,
    Query(ge=1800, le=2200, description="With the hours of sun of each day of this year.", examples=[2024]),
]


class PointOfMany(BaseModel):
    """A point: longitude and latitude in degrees, height in metres above the ground, and optionally a time of its own."""

    model_config = ConfigDict(extra="forbid")

    lon: float = Field(ge=-1e9, le=1e9, allow_inf_nan=False, strict=True)
    lat: float = Field(ge=-1e9, le=1e9, allow_inf_nan=False, strict=True)
    height: float = Field(default=0.0, ge=0.0, le=MAX_EYE_HEIGHT_M, allow_inf_nan=False, strict=True)
    time: Annotated[AwareDatetime | None, PLAIN_TIME] = None


class PointsQuery(BaseModel):
    """Many points, with the time and the date of those points that have no time."""

    model_config = ConfigDict(extra="forbid")

    points: list[PointOfMany] = Field(min_length=1, max_length=MAX_POINTS)
    time: Annotated[AwareDatetime | None, PLAIN_TIME] = None
    date: OptionalDate = None
    clock: str | None = Field(default=None, max_length=60)


POINTS_EXAMPLE: dict[str, Any] = {"points": [{"lon": 8.43, "lat": 47.5}], "date": "2024-03-21"}


class ReportedPoint(BaseModel):
    """The report of one of many points. ``remark`` is the reason for null values."""

    lon: float
    lat: float
    height_m: float
    time: datetime | None
    elevation_m: float | None
    now: ReportedMoment | None
    direct_h: float | None
    remark: str | None


class PointsReport(BaseModel):
    """The reports of the points, in the order of the request."""

    points: list[ReportedPoint]


async def point_query(
    lon: LonQuery,
    lat: LatQuery,
    date: DateQuery = None,
    height: HeightQuery = 0.0,
    clock: ClockQuery = None,
    year: YearQuery = None,
) -> PointQuery:
    """Return the point that the query parameters define (a FastAPI dependency)."""
    return PointQuery(lon=lon, lat=lat, height=height, date=date, clock=clock, year=year)


PointDep = Annotated[PointQuery, Depends(point_query)]


@router.get(
    "/levels/{level}/point",
    summary="The sun at a point",
    response_model=PointReport,
    responses=file_docs("The report.", ["application/json"]),
    dependencies=[Depends(allow_only_parameters(*POINT_PARAMETERS))],
)
async def sun_of_point(request: Request, service: ServiceDep, level: LevelPath, point: PointDep, time: TimeQuery = None) -> Any:
    """Report the sun at a point.

    The report has the elevation, whether the point is lit at the time, the occluder if it is not, and the sun of the day. With a
    `year` it has the hours of sun of each day of that year.
    """
    return await _run_point_query(request, service, level, point, time, "report", "json", "application/json")


@router.get(
    "/levels/{level}/point/horizon.{suffix}",
    summary="The horizon of a point, as a file",
    response_class=Response,
    responses=file_docs("The file.", dict.fromkeys(horizon_format.media_type for horizon_format in HORIZON_FORMATS.values())),
    dependencies=[Depends(allow_only_parameters(*POINT_PARAMETERS, "format"))],
)
async def horizon_of_point(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    suffix: Annotated[Literal["csv", "json", "txt", "hor"], Path(description="Of the file.", examples=["csv"])],
    point: PointDep,
    time: TimeQuery = None,
    format: Annotated[
        str | None,
        Query(
            description="; ".join(
                f"`{horizon_format.name}` (.{horizon_format.suffix}): {horizon_format.description}"
                for horizon_format in HORIZON_FORMATS.values()
            ),
            examples=["pvlib"],
        ),
    ] = None,
) -> Response:
    """Return the horizon angles of a point in all directions, from ground, buildings and trees.

    `format` is a format of solar tools. The default is the first format of the suffix.
    """
    formats_of_suffix = [horizon_format for horizon_format in HORIZON_FORMATS.values() if horizon_format.suffix == suffix]
    chosen_format = next((horizon_format for horizon_format in formats_of_suffix if format in (None, horizon_format.name)), None)
    if chosen_format is None:
        names = ", ".join(horizon_format.name for horizon_format in formats_of_suffix)
        raise InputError("format", format, f"{names} for .{suffix} files")
    return await _run_point_query(request, service, level, point, time, "horizon", chosen_format.name, chosen_format.media_type)


@router.get(
    "/levels/{level}/point/sun.{format}",
    summary="The sky over a point",
    response_class=Response,
    responses=file_docs("The chart.", SKY_MEDIA_TYPES.values()),
    dependencies=[Depends(allow_only_parameters(*POINT_PARAMETERS))],
)
async def sky_of_point(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    format: Annotated[Literal["svg", "png", "json"], Path(description="Of the picture; `json`: its figures.", examples=["svg"])],
    point: PointDep,
    time: TimeQuery = None,
) -> Response:
    """Draw a chart of the sky: the horizon, and the sun paths of the day, the solstices and the equinox, marked with hours.

    JSON has the figures of the chart. `horizon` has the horizon angles of ground, buildings and leaves in degrees towards each
    `azimuth`. `path` has the sun of the day every five minutes: `azimuth`, `altitude`, and whether it shines on the point.
    """
    return await _run_point_query(request, service, level, point, time, "sky", format, SKY_MEDIA_TYPES[format])


@router.post(
    "/levels/{level}/point",
    summary="The sun at many points",
    response_model=PointsReport,
    responses=problem_docs(413),
    dependencies=[Depends(allow_only_parameters())],
)
async def sun_of_points(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    points_query: Annotated[PointsQuery, Body(description=f"Up to {MAX_POINTS} points.", examples=[POINTS_EXAMPLE])],
) -> Any:
    """Report the sun at each of many points.

    Each report has the elevation, whether the point is lit, the occluder if it is not, and the hours of direct sun of the day.
    Values of points outside the data are null, and `remark` says why.
    """
    served_level = await service.level(level)
    points = tuple(TrackPoint(point.lon, point.lat, point.height, point.time) for point in points_query.points)
    query = PointQuery(lon=0.0, lat=0.0, date=points_query.date, clock=points_query.clock)
    picture = _picture_request(points_query.time)
    reports: list[Any] = []
    for first in range(0, len(points), POINTS_PER_JOB):
        job = PointsJob(level=served_level.key, points=points[first : first + POINTS_PER_JOB], query=query, request=picture)
        reports += json.loads(await run_point_job(request, service, job))
    return JSONResponse({"points": reports}, headers={"Cache-Control": "no-store"})


async def _run_point_query(
    request: Request,
    service: Service,
    level: str,
    point: PointQuery,
    time: str | None,
    product: PointProduct,
    format: str,
    media_type: str,
) -> Response:
    """Answer a query about one point: fix its time, run its job in a render process, and return the response.

    ``level`` is the level's name. ``time`` is the query's text. ``format`` is the file format of ``product``, and
    ``media_type`` that of the response. Raises ``SkuggaError``.
    """
    served_level = await service.level(level)
    sun = request_sun(request, time, None, None, service.settings.time_grain_s)
    point, max_age_s = resolve_current_time(point, sun)
    job = PointJob(level=served_level.key, query=point, product=product, format=format, request=PictureRequest(sun=sun))
    return await job_response(request, service, job, level, "point", media_type, max_age_s)


def _picture_request(time: datetime | None) -> PictureRequest:
    """Return the request for a picture under the sun of a time; ``None``: the level's own sun. Raises ``InputError``."""
    if time is not None:
        check_times(as_utc([time]))
    return PictureRequest(sun=None if time is None else SunSpec(time=time))
