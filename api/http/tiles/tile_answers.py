"""Answer requests for tiles of a level: from an archive, from the cache, or by rendering."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from fastapi import Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.encoding import ARRAY_FORMATS, check_format
from skugga.api.errors import ArchiveError, NotServedError
from skugga.api.http.answers import (
    DEFAULT_SUN_FRESH_S,
    REQUESTED_SUN_FRESH_S,
    cache_headers,
    entity_tag,
    is_fresh,
    reach_headers,
    render_headers,
)
from skugga.api.http.request_times import time_headers
from skugga.api.http.state.encoded_tiles import EncodedTile
from skugga.api.http.state.service import Service
from skugga.api.http.tiles.archived_tiles import archived_tile, read_tile
from skugga.api.matrices import check_tile, is_quadtree_level, matrix_set_of, off_data, tile_view
from skugga.api.products.product import MEDIA_TYPES, MapFormat
from skugga.api.request import ProductRequest
from skugga.api.workers.block_tiles import empty_file, empty_tile, place_in_block
from skugga.api.workers.jobs import BlockJob, BlockTiles
from skugga.terrain.geo.grid import TILE_PX


async def tile_answer(
    request: Request,
    service: Service,
    name: str,
    tms: str,
    zxy: tuple[int, int, int],
    scale: int,
    format: MapFormat,
    wanted: ProductRequest,
) -> Response:
    """Return a tile of a level.

    Parameters
    ----------
    request, service
        The request and the service.
    name
        Name of the level.
    tms
        Name of the tile matrix set.
    zxy
        Zoom, column and row.
    scale
        1, or 2 for twice the pixels a side.
    format
        The file format.
    wanted
        The product and its picture settings.

    Raises
    ------
    SkuggaError
        The parameters are wrong, or the job fails.
    """
    level, matrix_set = await service.level(name), matrix_set_of(tms)
    check_tile(matrix_set, level.zooms_in(tms), *zxy)
    if scale == 2 and not is_quadtree_level(matrix_set, zxy[0]):
        raise NotServedError("z", f"z: {tms} has no @2x tiles at zoom {zxy[0]}. Use tiles without @2x.")
    product = wanted.record
    check_format(product, format)
    assert level.data_bounds is not None  # it has zooms, so it has a place on earth
    empty = off_data(matrix_set, *zxy, level.data_bounds)
    longest_s = DEFAULT_SUN_FRESH_S if product.when != "days" and wanted.sun is None else REQUESTED_SUN_FRESH_S
    by: tuple[str | None, ...] = service.pool.renderer, service.pool.plan_version(level.key)
    archives = await service.archives.of_level(level)
    archive = archives.archive_of(product.name, format, tms, wanted.product_query(), zxy[0]) if scale == 1 and not empty else None
    if archive is not None:
        with suppress(ArchiveError):  # already logged; the tile is rendered instead
            body = await read_tile(archive, *zxy)
            if body is not None:
                fresh_s, asked = service.fresh_s(request, longest_s), (name, zxy, wanted.query())
                read = archived_tile(body, archive, fresh_s, *asked, **time_headers(request))
                service.tiles.put(request, read, name, (level.version, *by, archives.version))
                return read.answer(request)
            empty = True
    if empty and service.settings.empty_tile == "404":
        raise NotServedError("x", f"x: {name} has no data in tile {zxy[1]}, {zxy[2]} at zoom {zxy[0]}.")

    tag_parts: tuple[object, ...] = (level.version, name, tms, zxy, scale, format, product.name, wanted.query())
    if archive is not None and empty:
        tag_parts += (archive.version,)  # a rendered tile may differ
    of_time = time_headers(request)
    headers = cache_headers(entity_tag(*by, *tag_parts), service.fresh_s(request, longest_s)) | of_time
    if is_fresh(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    if empty:
        if service.settings.empty_tile == "204":
            return Response(status_code=204, headers=headers)
        if format in ARRAY_FORMATS:
            shape, where = (scale * TILE_PX, scale * TILE_PX), tile_view(matrix_set, *zxy, scale)
            body = await run_in_threadpool(empty_file, wanted, shape, format, level.lowest_m, where)
        else:
            body = await run_in_threadpool(empty_tile, wanted, format, scale, level.lowest_m)
        return Response(body, headers={**headers, **reach_headers("none")}, media_type=MEDIA_TYPES[format])

    tile = service.tiles.get(headers["ETag"])
    if tile is not None:
        tile = replace(tile, headers=tile.headers | headers)
        service.tiles.put(request, tile, name, (level.version, *by, archives.version))
        return tile.answer(request)
    (block_x, block_y), place = place_in_block(zxy[1] * scale, zxy[2] * scale, scale)
    job = BlockJob(
        level=level.key, matrix_set=tms, zoom=zxy[0] + scale - 1, block_x=block_x, block_y=block_y, format=format, tiles=scale,
        request=wanted,
    )  # fmt: skip
    kept = service.pool.finished(job) is not None
    block = await service.done(request, job)
    assert isinstance(block, BlockTiles)
    by = block.renderer, block.plan_version
    tag = entity_tag(*by, *tag_parts)
    fresh_s = service.fresh_s(request, longest_s)  # computed again: a pending probe shortens the lifetime
    made, again = (
        cache_headers(tag, fresh_s) | of_time | render_headers(block, "block", kept, block.encode_ms)
        for kept in (kept or not block.drawn, True)
    )  # fmt: skip
    tile = EncodedTile(block.tiles[place], again, MEDIA_TYPES[format])
    service.tiles.put(request, tile, name, (level.version, *by, archives.version))
    return Response(tile.body, headers=made, media_type=tile.media_type)
