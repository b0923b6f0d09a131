"""Routes for archives of tiles, which are served without rendering."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Depends, Path, Request, Response

from skugga.api.archive_format import ARCHIVED_MEDIA_TYPES
from skugga.api.errors import ArchiveError, NotServedError
from skugga.api.http.openapi_parts import LEVEL_ERROR_STATUSES, ColumnPath, RowPath, ZoomPath, file_docs, problem_docs
from skugga.api.http.parameters import allow_only_parameters
from skugga.api.http.responses import DEFAULT_SUN_MAX_AGE_S, JSON_MEDIA_TYPE, base_url, cache_headers, entity_tag, json_response
from skugga.api.http.state.served_archives import archive_summary
from skugga.api.http.state.service import ServiceDep
from skugga.api.http.tiles.archived_tiles import archived_tile, read_tile
from skugga.api.http.tiles.tilejson import tilejson_response
from skugga.api.products import PRODUCTS

router = APIRouter(
    tags=["archives"], dependencies=[Depends(allow_only_parameters())], responses=problem_docs(*LEVEL_ERROR_STATUSES)
)

ArchivePath = Annotated[str, Path(description="An archive by its name, as `/archives` lists them.", examples=["shadows"])]
TileFormatPath = Annotated[str, Path(description="The format that the archive's tiles have.", examples=["png"])]


@router.get(
    "/archives",
    summary="The archives of tiles",
    response_model=list[dict[str, Any]],
    responses=file_docs("All archives.", [JSON_MEDIA_TYPE]),
)
async def archives(request: Request, service: ServiceDep) -> Response:
    """Return every archive that the service was started with: name, title, attribution, bounds in degrees, zooms and format.

    The layer is included if this service's own command made the archive.
    """
    summaries = []
    for name in service.archives.names():
        try:
            summaries.append(archive_summary(name, await service.archives.current(name)))
        except ArchiveError:  # already logged
            continue
    return json_response(request, summaries)


@router.get(
    "/archives/{archive}/tilejson.json",
    summary="TileJSON of an archive",
    response_model=dict[str, Any],
    responses=file_docs("TileJSON.", [JSON_MEDIA_TYPE]),
)
async def archive_tilejson(request: Request, service: ServiceDep, archive: ArchivePath) -> Response:
    """Return TileJSON 3.0.0 for map clients. Layers of heights have their `encoding`; `skugga` is that of the metadata."""
    archive_file = await service.archives.current(archive)
    facts = archive_summary(archive, archive_file)
    address = f"{base_url(request, service.settings.public_url)}/archives/{quote(archive)}"
    product = PRODUCTS.get(str(facts["layer"]))
    extra_entries = {} if product is None or product.encoding is None else {"encoding": product.encoding}
    return tilejson_response(
        request, facts["title"], facts["attribution"], f"{address}/{{z}}/{{x}}/{{y}}.{archive_file.format}",
        (facts["minzoom"], facts["maxzoom"]), archive_file.bounds,
        extra_entries | ({"skugga": archive_file.skugga_metadata} if archive_file.skugga_metadata else {}),
    )  # fmt: skip


@router.get(
    "/archives/{archive}/{z}/{x}/{y}.{format}",
    summary="A tile of an archive",
    response_class=Response,
    responses={
        **file_docs("The tile as it lies in the archive.", ARCHIVED_MEDIA_TYPES.values()),
        204: {"description": "The archive has no such tile (404 where `SKUGGA_EMPTY_TILE` is so)."},
    },
)
async def archive_tile(
    request: Request, service: ServiceDep, archive: ArchivePath, z: ZoomPath, x: ColumnPath, y: RowPath, format: TileFormatPath
) -> Response:
    """Return a tile in Web Mercator, byte for byte as in the archive.

    A tile that the archive lacks, inside its zooms, is a tile without data.
    """
    archive_file = await service.archives.current(archive)
    if format != archive_file.format:
        raise NotServedError("format", f"format: the tiles of {archive} are not {format[:20]}. Use {archive_file.format}.")
    if z not in archive_file.zooms:
        raise NotServedError("z", f"z: {archive} has no zoom {z}. Use {archive_file.zooms[0]} to {archive_file.zooms[-1]}.")
    if not (0 <= x < 2**z and 0 <= y < 2**z):
        raise NotServedError("x", f"x: tile {x}, {y} is outside of zoom {z}. Use columns and rows 0 to {2**z - 1}.")
    body = await read_tile(archive_file, z, x, y)
    if body is None:
        if service.settings.empty_tile == "404":
            raise NotServedError("x", f"x: {archive} has no tile {x}, {y} at zoom {z}.")
        return Response(status_code=204, headers=cache_headers(entity_tag(archive_file.version, z, x, y), DEFAULT_SUN_MAX_AGE_S))
    return archived_tile(body, archive_file, DEFAULT_SUN_MAX_AGE_S).response(request)
