"""The route for maps: any extent of a level as one picture, in any CRS."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.http.numbers import PLAIN_INTEGER
from skugga.api.http.openapi_parts import LevelPath, example_query
from skugga.api.http.parameters import TILE_PARAMETERS, allow_only_parameters, map_query
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import ServiceDep
from skugga.api.http.tiles.map_extents import MapBounds, bounds_in, check_side, crs_code, crs_of_code, map_size, parse_bounds
from skugga.api.http.tiles.maps import MapQuery, map_response
from skugga.api.http.tiles.tile_docs import JPEG_LAYERS, PICTURE_DOCS
from skugga.api.products.product import MapFormat
from skugga.api.request import ProductRequest
from skugga.terrain.errors import InputError, Problem

router = APIRouter(tags=["maps"], responses=PICTURE_DOCS, default_response_class=Response)


@router.get(
    "/levels/{level}/map.{format}",
    summary="A map of any extent",
    dependencies=[Depends(allow_only_parameters("bbox", "crs", "width", "height", *TILE_PARAMETERS))],
    openapi_extra=example_query("bbox", "crs", "width"),
)
async def map_of_level(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    format: Annotated[MapFormat, Path(description=f"`tif` is georeferenced; JPEG is for {JPEG_LAYERS} alone.", examples=["png"])],
    product_request: Annotated[ProductRequest, Depends(map_query)],
    bbox: Annotated[
        str | None,
        Query(
            max_length=200,
            description="west,south,east,north in units of `crs`; default: the level's.",
            examples=["8.38,47.48,8.49,47.55"],
        ),
    ] = None,
    crs: Annotated[
        str | None, Query(max_length=60, description="As EPSG:3857; default: that of the level's own maps.", examples=["OGC:CRS84"])
    ] = None,
    width: Annotated[
        int | None,
        PLAIN_INTEGER,
        Query(description="Pixels; default: by the height, else 1024 for the longer side.", examples=[256]),
    ] = None,
    height: Annotated[int | None, PLAIN_INTEGER, Query(description="Pixels; default: by the width.", examples=[256])] = None,
) -> Response:
    """Return a map of an extent.

    The extent always has x (or longitude) first. Pixels without data are transparent, or nodata in arrays.
    """
    served_level = await service.level(level)
    sides = {name: check_side(name, value) for name, value in (("width", width), ("height", height)) if value is not None}
    if served_level.world.off_earth_reason is not None:
        query = _query_off_earth(served_level, bbox, crs, sides, product_request, format)
    else:
        query = await run_in_threadpool(_query_on_earth, served_level, bbox, crs, sides, product_request, format)
    return await map_response(request, service, served_level, query)


def _query_on_earth(
    level: ServedLevel, bbox: str | None, crs: str | None, sides: dict[str, int], product_request: ProductRequest, format: MapFormat
) -> MapQuery:
    """Return the request for a map of a level that lies on the earth.

    ``bbox`` and ``crs`` are texts of the query, or ``None``. ``sides`` has the requested ``width`` and ``height`` in pixels;
    either or both may be missing. Raises ``InputError``.
    """
    code = level.map_crs.to_string() if crs is None else crs_code(crs)
    bounds_crs = level.map_crs if crs is None else crs_of_code(code)
    bounds = bounds_in(level, bounds_crs) if bbox is None else parse_bounds(bbox)
    if bbox is not None and crs is None and _may_be_degrees(bounds) and not _overlap(bounds, bounds_in(level, bounds_crs)):
        raise InputError(
            "bbox", Problem(f"'{bbox}' lies outside of the level, whose maps are in {code}"), "For degrees add crs=OGC:CRS84"
        )
    west, south, east, north = bounds
    size = map_size(sides.get("width"), sides.get("height"), (east - west) / (north - south))
    return MapQuery(bounds, code, size, product_request, format)


def _may_be_degrees(bounds: MapBounds) -> bool:
    """Return whether bounds lie within the ranges of longitude and latitude."""
    west, south, east, north = bounds
    return -360.0 <= west and east <= 360.0 and -90.0 <= south and north <= 90.0


def _overlap(bounds: MapBounds, other_bounds: MapBounds) -> bool:
    """Return whether two extents, in units of one CRS, have a common area."""
    return all(bounds[i] < other_bounds[i + 2] and other_bounds[i] < bounds[i + 2] for i in (0, 1))


def _query_off_earth(
    level: ServedLevel, bbox: str | None, crs: str | None, sides: dict[str, int], product_request: ProductRequest, format: MapFormat
) -> MapQuery:
    """Return the request for a map of a whole level that does not lie on the earth. Raises ``InputError`` for ``bbox`` and ``crs``.

    ``sides`` has the requested ``width`` and ``height`` in pixels; either or both may be missing.
    """
    for name, value in (("bbox", bbox), ("crs", crs)):
        if value is not None:
            fault = Problem(f"cannot be used, since {level.world.off_earth_reason}")
            raise InputError(name, fault, "Leave it out: the map is the whole level")
    view_size = level.view_sizes["map"] or (1, 1)
    return MapQuery(
        None, None, map_size(sides.get("width"), sides.get("height"), view_size[0] / view_size[1]), product_request, format
    )
