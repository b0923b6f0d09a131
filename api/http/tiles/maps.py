"""Maps of any extent: one way for the route of maps and for WMS."""

from __future__ import annotations

from dataclasses import dataclass

from fastapi import Request, Response

from skugga.api.http.answers import GIVEN_SUN_S, OWN_SUN_S, cache_headers, drawn_headers, is_fresh, tag_of
from skugga.api.http.moments import time_headers
from skugga.api.http.parameters import TileQuery, check_pixels
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.http.state.service import Service
from skugga.api.http.tiles.map_extents import MapBounds
from skugga.api.layers import LAYERS, MAP_MEDIA_TYPES, MapFormat
from skugga.api.workers.block_tiles import check_format
from skugga.api.workers.jobs import MapJob, PictureRequest, Snapshot
from skugga.terrain.errors import InputError

SAME_DEGREES = {"OGC:CRS84": "EPSG:4326"}
"""CRSs that differ in the order of axes alone, which extents have no longer: then their maps share the grid of tiles."""

THINNEST = 4.0
"""How many times as long as wide pixels may be."""


@dataclass(frozen=True)
class MapQuery:
    """What is asked of a map: its extent in a CRS (its code; ``None`` in a flat world), (width, height) in pixels, what it shows,
    the format, and what is behind what is transparent (``RRGGBB``, or nothing).
    """

    bounds: MapBounds | None
    crs: str | None
    size: tuple[int, int]
    shown: TileQuery
    format: MapFormat
    background: str | None = None


async def map_answer(request: Request, service: Service, level: ServedLevel, asked: MapQuery) -> Response:
    """The map of a level, or 304 where the client has it. Raises ``SkuggaError``."""
    layer = asked.shown.layer
    check_format(layer, asked.format)
    check_pixels(asked.size, service.settings.max_snapshot_pixels)
    if asked.bounds is not None:
        _check_pixel_shape(asked.bounds, asked.size)
    hangs_on_light = asked.shown.sun_hours is None and LAYERS[layer].encoding is None
    crs = asked.crs and SAME_DEGREES.get(asked.crs, asked.crs)
    job = MapJob(
        level=level.key, bounds=asked.bounds, crs=crs, size=asked.size, layer=layer, format=asked.format,
        background=asked.background, sun_hours=asked.shown.sun_hours,
        request=asked.shown.picture if hangs_on_light else PictureRequest(),
    )  # fmt: skip
    tag_parts = (level.version, level.name, "map", job.model_dump(exclude={"level"}, exclude_none=True))
    fresh_s = service.fresh_s(request, OWN_SUN_S if hangs_on_light and asked.shown.picture.sun is None else GIVEN_SUN_S)
    of_time = time_headers(request) if hangs_on_light else {}
    headers = cache_headers(tag_of(service.pool.renderer, service.pool.plan_version(level.key), *tag_parts), fresh_s) | of_time
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    kept = service.pool.finished(job) is not None
    drawn = await service.done(request, job)
    assert isinstance(drawn, Snapshot)
    headers = cache_headers(tag_of(drawn.renderer, drawn.plan_version, *tag_parts), fresh_s)
    headers |= of_time | drawn_headers(drawn, "map", kept, drawn.encode_ms)
    return Response(drawn.body, headers=headers, media_type=MAP_MEDIA_TYPES[asked.format])


def _check_pixel_shape(bounds: MapBounds, size: tuple[int, int]) -> None:
    west, south, east, north = bounds
    wide, high = (east - west) / size[0], (north - south) / size[1]
    if max(wide, high) > THINNEST * min(wide, high):
        raise InputError(
            "size", f"{size[0]}x{size[1]}", f"pixels at most {THINNEST:g} times as long as wide: {wide:.3g} by {high:.3g}"
        )
