"""Answer requests for tiles of a level: from an archive, from the cache, or by rendering."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.encoding import ARRAY_FORMATS, check_format
from skugga.api.errors import ArchiveError, NotServedError
from skugga.api.http.request_times import time_headers
from skugga.api.http.responses import (
    DEFAULT_SUN_MAX_AGE_S,
    REQUESTED_SUN_MAX_AGE_S,
    cache_headers,
    entity_tag,
    has_current_copy,
    reach_headers,
    render_headers,
)
from skugga.api.http.state.encoded_tiles import EncodedTile
from skugga.api.http.state.service import Service
from skugga.api.http.tiles.archived_tiles import archived_tile, read_tile
from skugga.api.matrices import check_tile, is_quadtree_zoom, matrix_set_of, shows_no_data, tile_view
from skugga.api.products.product import MEDIA_TYPES, MapFormat
from skugga.api.request import ProductRequest
from skugga.api.workers.block_tiles import block_and_position, empty_file, empty_tile
from skugga.api.workers.jobs import BlockJob, BlockTiles
from skugga.terrain.geo.grid import TILE_PX


async def tile_response(
    request: Request,
    service: Service,
    level_name: str,
    tms: str,
    zxy: tuple[int, int, int],
    scale: int,
    format: MapFormat,
    product_request: ProductRequest,
) -> Response:
    """Return a tile of a level as a response, or 304 if the client's copy is current.

    Parameters
    ----------
    request, service
        The request and the service.
    level_name
        Name of the level.
    tms
        Name of the tile matrix set.
    zxy
        Zoom, column and row.
    scale
        1 for 256 x 256 pixels, or 2 for 512 x 512.
    format
        The file format.
    product_request
        The product with its options, its sun and its style.

    Raises
    ------
    SkuggaError
        The parameters are wrong, or the job fails.
    """
    level, matrix_set = await service.level(level_name), matrix_set_of(tms)
    check_tile(matrix_set, level.zooms_in(tms), *zxy)
    if scale == 2 and not is_quadtree_zoom(matrix_set, zxy[0]):
        raise NotServedError("z", f"z: {tms} has no @2x tiles at zoom {zxy[0]}. Use tiles without @2x.")
    product = product_request.product_record
    check_format(product, format)
    assert level.data_bounds is not None  # it has zooms, so it has a place on earth
    is_empty = shows_no_data(matrix_set, *zxy, level.data_bounds)
    default_max_age_s = DEFAULT_SUN_MAX_AGE_S if product.when != "days" and product_request.sun is None else REQUESTED_SUN_MAX_AGE_S
    render_versions: tuple[str | None, ...] = service.pool.renderer, service.pool.plan_version(level.key)
    archives = await service.archives.archives_of_level(level)
    archive = (
        archives.archive_of(product.name, format, tms, product_request.product_query(), zxy[0])
        if scale == 1 and not is_empty
        else None
    )
    if archive is not None:
        with suppress(ArchiveError):  # already logged; the tile is rendered instead
            body = await read_tile(archive, *zxy)
            if body is not None:
                max_age_s, request_parts = service.max_age_s(request, default_max_age_s), (level_name, zxy, product_request.query())
                encoded_tile = archived_tile(body, archive, max_age_s, *request_parts, **time_headers(request))
                service.tiles.put(request, encoded_tile, level_name, (level.version, *render_versions, archives.version))
                return encoded_tile.response(request)
            is_empty = True
    if is_empty and service.settings.empty_tile == "404":
        raise NotServedError("x", f"x: {level_name} has no data in tile {zxy[1]}, {zxy[2]} at zoom {zxy[0]}.")

    tag_parts: tuple[object, ...] = (level.version, level_name, tms, zxy, scale, format, product.name, product_request.query())
    if archive is not None and is_empty:
        tag_parts += (archive.version,)  # without this archive the tile would be rendered, and may have data
    sun_time_headers = time_headers(request)
    headers = (
        cache_headers(entity_tag(*render_versions, *tag_parts), service.max_age_s(request, default_max_age_s)) | sun_time_headers
    )
    if has_current_copy(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if is_empty:
        if service.settings.empty_tile == "204":
            return Response(status_code=204, headers=headers)
        if format in ARRAY_FORMATS:
            shape, view = (scale * TILE_PX, scale * TILE_PX), tile_view(matrix_set, *zxy, scale)
            body = await run_in_threadpool(empty_file, product_request, shape, format, level.lowest_ground_m, view)
        else:
            body = await run_in_threadpool(empty_tile, product_request, format, scale, level.lowest_ground_m)
        return Response(body, headers={**headers, **reach_headers("none")}, media_type=MEDIA_TYPES[format])

    tile = service.tiles.get(headers["ETag"])
    if tile is not None:
        tile = replace(tile, headers=tile.headers | headers)
        service.tiles.put(request, tile, level_name, (level.version, *render_versions, archives.version))
        return tile.response(request)
    (block_x, block_y), position = block_and_position(zxy[1] * scale, zxy[2] * scale, scale)
    job = BlockJob(
        level=level.key, matrix_set=tms, zoom=zxy[0] + scale - 1, block_x=block_x, block_y=block_y, format=format,
        tiles_per_side=scale,
        request=product_request,
    )  # fmt: skip
    is_cached = service.pool.cached_picture(job) is not None
    block = await service.run_job(request, job)
    assert isinstance(block, BlockTiles)
    render_versions = block.renderer, block.plan_version
    tag = entity_tag(*render_versions, *tag_parts)
    max_age_s = service.max_age_s(request, default_max_age_s)  # computed again: a pending probe shortens the lifetime
    sent_headers, cached_headers = (
        cache_headers(tag, max_age_s) | sun_time_headers | render_headers(block, "block", is_cached, block.encode_ms)
        for is_cached in (is_cached or not block.is_newly_drawn, True)
    )  # fmt: skip
    tile = EncodedTile(block.tiles[position], cached_headers, MEDIA_TYPES[format])
    service.tiles.put(request, tile, level_name, (level.version, *render_versions, archives.version))
    return Response(tile.body, headers=sent_headers, media_type=tile.media_type)
