"""The route that finds a place by coordinates of a CRS."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response
from pydantic import BaseModel
from pyproj import CRS
from pyproj.exceptions import ProjError
from starlette.concurrency import run_in_threadpool

from skugga.api.http.numbers import PLAIN_DECIMAL
from skugga.api.http.openapi_parts import LEVEL_ERROR_STATUSES, LevelPath, file_docs, problem_docs
from skugga.api.http.parameters import allow_only_parameters
from skugga.api.http.responses import JSON_MEDIA_TYPE, json_response
from skugga.api.http.state.service import ServiceDep
from skugga.terrain.errors import InputError, Problem, UnsupportedError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer

router = APIRouter(tags=["levels"], responses=problem_docs(*LEVEL_ERROR_STATUSES))

ROUND_TRIP_TOLERANCE = 1e-3
"""Tolerance of coordinates after a round trip, in units of the CRS or as a share of them: far less than a turn round the earth."""

XQuery = Annotated[
    float,
    PLAIN_DECIMAL,
    Query(ge=-1e9, le=1e9, allow_inf_nan=False, description="Coordinate to the east, in units of the CRS.", examples=[457000]),
]
YQuery = Annotated[
    float,
    PLAIN_DECIMAL,
    Query(ge=-1e9, le=1e9, allow_inf_nan=False, description="Coordinate to the north, in units of the CRS.", examples=[5261000]),
]


class Location(BaseModel):
    """A place in degrees, and the CRS of the coordinates that it was requested by."""

    lon: float
    lat: float
    crs: str
    crs_name: str


@router.get(
    "/levels/{level}/location",
    summary="A place by coordinates",
    response_model=Location,
    responses=file_docs("The place.", [JSON_MEDIA_TYPE]),
    dependencies=[Depends(allow_only_parameters("x", "y"))],
)
async def location(request: Request, service: ServiceDep, level: LevelPath, x: XQuery, y: YQuery) -> Response:
    """Return longitude and latitude of a place that is given in the CRS of the level's own maps.

    The place may lie outside of the level's data.
    """
    served_level = await service.level(level)
    if served_level.world.off_earth_reason is not None:
        raise UnsupportedError(
            "level", served_level.name, f"{served_level.world.off_earth_reason}, so its places have no longitude"
        )
    lon, lat = await run_in_threadpool(_longitude_latitude, served_level.map_crs, x, y)
    crs = served_level.map_crs
    return json_response(request, Location(lon=lon, lat=lat, crs=crs.to_string(), crs_name=crs.name).model_dump())


def _longitude_latitude(crs: CRS, x: float, y: float) -> tuple[float, float]:
    """Return longitude and latitude of a point of ``crs`` in degrees. Raises ``InputError`` where the CRS has no such point."""
    try:
        lon, lat = transformer(crs, LONGITUDE_LATITUDE).transform(x, y)
        back = transformer(LONGITUDE_LATITUDE, crs).transform(lon, lat)
    except ProjError:
        lon, lat, back = math.inf, math.inf, (math.inf, math.inf)
    # Far outside of its area a projection returns infinity, or degrees of another place.
    if not np.allclose(back, (x, y), rtol=ROUND_TRIP_TOLERANCE, atol=ROUND_TRIP_TOLERANCE):
        raise InputError(
            "x", Problem(f"no place has the coordinates {x:.15g}, {y:.15g}"), "Use those of the CRS of the level's maps"
        )
    return float(lon), float(lat)
