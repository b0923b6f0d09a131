"""Serve the irradiation at points by month: as JSON, as a table, and as a chart."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Depends, Path, Query, Request, Response

from skugga.api.http.numbers import PLAIN_DECIMAL, PLAIN_INTEGER
from skugga.api.http.openapi_parts import WORK_ERROR_STATUSES, LevelPath, file_docs, problem_docs
from skugga.api.http.parameters import allow_only_parameters
from skugga.api.http.points.routes_point import HeightQuery, LatQuery, LonQuery
from skugga.api.http.request_times import PLAIN_DATE, current_quarter_hour
from skugga.api.http.responses import REQUESTED_SUN_MAX_AGE_S
from skugga.api.http.state.job_responses import job_response
from skugga.api.http.state.service import Service, ServiceDep
from skugga.api.point.irradiation_values import PointIrradiationOptions, PointIrradiationReport, check_plane, requested_dates
from skugga.api.point.values import PointQuery
from skugga.api.workers.jobs import PointJob
from skugga.terrain.errors import InputError

router = APIRouter(tags=["points"], responses=problem_docs(*WORK_ERROR_STATUSES))

MAX_SERVED_DATES = 366
"""Limit of dates in a request."""

MEDIA_TYPES = {"csv": "text/csv", "svg": "image/svg+xml", "png": "image/png"}

IRRADIATION_PARAMETERS = ("lon", "lat", "year", "date", "to", "plane", "tilt", "azimuth", "albedo", "linke", "clock", "height")


@dataclass(frozen=True)
class IrradiationQuery:
    """The query parameters of irradiation at a point.

    Attributes
    ----------
    point : PointQuery
        The point, its height, the year or the first date, and their clock.
    options : PointIrradiationOptions
        The last date, the plane, the air and the ground around.
    max_age_s : int
        Freshness lifetime of the answer in seconds.
    """

    point: PointQuery
    options: PointIrradiationOptions
    max_age_s: int


async def irradiation_query(
    lon: LonQuery,
    lat: LatQuery,
    year: Annotated[
        int | None,
        PLAIN_INTEGER,
        Query(ge=1800, le=2200, description="A whole year; default: this year (UTC).", examples=[2023]),
    ] = None,
    date: Annotated[
        date | None, PLAIN_DATE, Query(description="One date, or the first of several, instead of a year.", examples=["2024-03-21"])
    ] = None,
    to: Annotated[
        date | None, PLAIN_DATE, Query(description="The last of several dates.", examples=["2024-06-21"])
    ] = None,
    plane: Annotated[
        Literal["level", "ground"] | None,
        Query(description="The plane that receives light: `level` (the default), or `ground`, its own slope.", examples=["ground"]),
    ] = None,
    tilt: Annotated[
        float | None,
        PLAIN_DECIMAL,
        Query(
            ge=0.0, le=180.0, allow_inf_nan=False,
            description="Tilt of the plane, degrees: 90 is a wall, more faces downwards.", examples=[35],
        ),
    ] = None,
    azimuth: Annotated[
        float | None,
        PLAIN_DECIMAL,
        Query(
            ge=0.0, le=360.0, allow_inf_nan=False,
            description="Azimuth that a tilted plane faces, degrees clockwise from north; default: 180, south.", examples=[180],
        ),
    ] = None,
    albedo: Annotated[
        float, PLAIN_DECIMAL, Query(ge=0.0, le=1.0, allow_inf_nan=False, description="Albedo of the ground around.", examples=[0.2])
    ] = 0.2,
    linke: Annotated[
        float | None,
        PLAIN_DECIMAL,
        Query(
            ge=1.0, le=20.0, allow_inf_nan=False,
            description="Linke's turbidity of the air; default: the place's monthly climate.", examples=[3],
        ),
    ] = None,
    clock: Annotated[
        str | None,
        Query(
            max_length=60, description="Clock of the dates: solar (the default), utc, +02:00 or Europe/Oslo.",
            examples=["Europe/Oslo"],
        ),
    ] = None,
    height: HeightQuery = 0.0,
) -> IrradiationQuery:  # fmt: skip
    """Return the request that the query parameters define (a FastAPI dependency). Raises ``InputError``."""
    options = PointIrradiationOptions(to=to, plane=plane, tilt=tilt, azimuth=azimuth, albedo=albedo, linke=linke)
    check_plane(options)
    max_age_s = REQUESTED_SUN_MAX_AGE_S
    if year is None and date is None and to is None:
        begin, max_age_s = current_quarter_hour()
        year = begin.year
    point = PointQuery(lon=lon, lat=lat, height=height, date=date, clock=clock, year=year)
    first, last = requested_dates(point, options)
    if (count := (last - first).days + 1) > MAX_SERVED_DATES:
        raise InputError.over_limit("to", f"{count} dates", str(MAX_SERVED_DATES), "Use several requests")
    return IrradiationQuery(point, options, max_age_s)


IrradiationDep = Annotated[IrradiationQuery, Depends(irradiation_query)]


@router.get(
    "/levels/{level}/point/irradiation",
    summary="The irradiation at a point",
    response_model=PointIrradiationReport,
    responses=file_docs("The irradiation.", ["application/json"]),
    dependencies=[Depends(allow_only_parameters(*IRRADIATION_PARAMETERS))],
)
async def irradiation_of_point(request: Request, service: ServiceDep, level: LevelPath, query: IrradiationDep) -> Any:
    """Report the energy of sunlight and skylight on a plane at a point, by month, kWh/m2, under a clear sky.

    Terrain, buildings and trees hide the sun and the sky. The report has each part of the light, what the plane would receive under
    an open sky, and the light that is lost to terrain, buildings and trees.
    """
    return await _irradiation_response(request, service, level, query, "json", "application/json")


@router.get(
    "/levels/{level}/point/irradiation.{format}",
    summary="The irradiation at a point, as a file",
    response_class=Response,
    responses=file_docs("The table or the chart.", MEDIA_TYPES.values()),
    dependencies=[Depends(allow_only_parameters(*IRRADIATION_PARAMETERS))],
)
async def irradiation_file_of_point(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    format: Annotated[Literal["csv", "svg", "png"], Path(description="`csv`: a table; else a chart.", examples=["svg"])],
    query: IrradiationDep,
) -> Response:
    """Return the irradiation at a point by month as a table, or as a bar chart: received light, and losses by their causes."""
    return await _irradiation_response(request, service, level, query, format, MEDIA_TYPES[format])


async def _irradiation_response(
    request: Request, service: Service, level: str, query: IrradiationQuery, format: str, media_type: str
) -> Response:
    """Return the irradiation at a point of the level with a name, in a format. Raises ``SkuggaError``."""
    served_level = await service.level(level)
    job = PointJob(level=served_level.key, query=query.point, product="irradiation", format=format, irradiation=query.options)
    return await job_response(request, service, job, level, "point", media_type, query.max_age_s)
