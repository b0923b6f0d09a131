"""Answer requests for maps of any extent, for the route of maps and for WMS."""

from __future__ import annotations

from dataclasses import dataclass

from fastapi import Request, Response

from skugga.api.encoding import check_format
from skugga.api.http.parameters import check_pixels
from skugga.api.http.responses import DEFAULT_SUN_MAX_AGE_S, REQUESTED_SUN_MAX_AGE_S
from skugga.api.http.state.job_responses import job_response
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import Service
from skugga.api.http.tiles.map_extents import MapBounds
from skugga.api.products.product import MEDIA_TYPES, MapFormat
from skugga.api.request import ProductRequest
from skugga.api.workers.jobs import MapJob
from skugga.terrain.errors import InputError

EQUIVALENT_CRS = {"OGC:CRS84": "EPSG:4326"}
"""CRSs that are replaced by a CRS that differs in axis order only.

Extents always have x first here, so maps in both CRSs can share their pixel grid with tiles."""

MAX_PIXEL_ASPECT = 4.0
"""Maximum ratio of the sides of a map's pixels, in units of its CRS."""


@dataclass(frozen=True)
class MapQuery:
    """A request for a map.

    Attributes
    ----------
    bounds : tuple of float or None
        West, south, east, north in units of the CRS; ``None``: the whole level, which is not on the earth.
    crs : str or None
        Code of the CRS; ``None`` for a level that is not on the earth.
    size : tuple of int
        (width, height) in pixels.
    product_request : ProductRequest
        The product with its options, its sun and its style.
    format : MapFormat
        The file format.
    background : str or None
        Colour behind transparent pixels, ``RRGGBB``; ``None`` keeps them transparent.
    """

    bounds: MapBounds | None
    crs: str | None
    size: tuple[int, int]
    product_request: ProductRequest
    format: MapFormat
    background: str | None = None


async def map_response(request: Request, service: Service, level: ServedLevel, query: MapQuery) -> Response:
    """Return the map of a level, or 304 if the client's copy is current. Raises ``SkuggaError``."""
    product_request, product = query.product_request, query.product_request.product_record
    check_format(product, query.format)
    check_pixels(query.size, service.settings.max_snapshot_pixels)
    if query.bounds is not None:
        _check_pixel_shape(query.bounds, query.size)
    crs = query.crs and EQUIVALENT_CRS.get(query.crs, query.crs)
    job = MapJob(
        level=level.key, bounds=query.bounds, crs=crs, size=query.size, format=query.format, background=query.background,
        request=product_request,
    )  # fmt: skip
    max_age_s = DEFAULT_SUN_MAX_AGE_S if product.when == "sun" and product_request.sun is None else REQUESTED_SUN_MAX_AGE_S
    return await job_response(request, service, job, level.name, "map", MEDIA_TYPES[query.format], max_age_s)


def _check_pixel_shape(bounds: MapBounds, size: tuple[int, int]) -> None:
    """Raise ``InputError`` if pixels are longer than ``MAX_PIXEL_ASPECT`` times their other side, in units of the CRS.

    ``bounds`` are west, south, east and north; ``size`` is (width, height) in pixels.
    """
    west, south, east, north = bounds
    pixel_width, pixel_height = (east - west) / size[0], (north - south) / size[1]
    if max(pixel_width, pixel_height) > MAX_PIXEL_ASPECT * min(pixel_width, pixel_height):
        raise InputError(
            "size",
            f"{size[0]}x{size[1]}",
            f"a size whose pixels are at most {MAX_PIXEL_ASPECT:g} times as long as wide; these cover {pixel_width:.3g} by "
            f"{pixel_height:.3g} units of the CRS",
        )
