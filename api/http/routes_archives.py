"""Archives of tiles, served as they are: nothing is drawn."""

from __future__ import annotations

import hashlib
import logging
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Depends, Path, Request, Response
from starlette.concurrency import run_in_threadpool

from skugga.api.archive_format import ARCHIVED_MEDIA_TYPES
from skugga.api.errors import ArchiveError, NotServedError
from skugga.api.http.answers import OWN_SUN_S, base_url, cache_headers, json_answer, tag_of
from skugga.api.http.archive_file import ArchiveFile
from skugga.api.http.documented import LEVEL_ERRORS, ColumnPath, RowPath, ZoomPath, file_docs, problem_docs
from skugga.api.http.encoded_tiles import EncodedTile
from skugga.api.http.parameters import allow_only
from skugga.api.http.routes_levels import JSON_MEDIA, TILEJSON_ENCODINGS
from skugga.api.http.served_archives import archive_facts
from skugga.api.http.service import TheService
from skugga.api.layers import LAYERS

log = logging.getLogger("skugga")

router = APIRouter(tags=["archives"], dependencies=[Depends(allow_only())], responses=problem_docs(*LEVEL_ERRORS))

ArchivePath = Annotated[str, Path(description="An archive by its name, as `/archives` lists them.", examples=["shadows"])]
EndingPath = Annotated[str, Path(description="The format that the archive's tiles have.", examples=["png"])]


@router.get(
    "/archives",
    summary="The archives of tiles",
    response_model=list[dict[str, Any]],
    responses=file_docs("All archives.", [JSON_MEDIA]),
)
async def archives(request: Request, service: TheService) -> Response:
    """Every archive that the service was started with: its name, title, attribution, bounds in degrees, zooms, its tiles' format,
    and their layer where this service's own command has drawn them.
    """
    found = []
    for name in service.archives.names():
        try:
            found.append(archive_facts(name, await service.archives.current(name)))
        except ArchiveError:  # the log tells
            continue
    return json_answer(request, found)


@router.get(
    "/archives/{archive}/tilejson.json",
    summary="TileJSON of an archive",
    response_model=dict[str, Any],
    responses=file_docs("TileJSON.", [JSON_MEDIA]),
)
async def archive_tilejson(request: Request, service: TheService, archive: ArchivePath) -> Response:
    """TileJSON 3.0.0 for map clients. Layers of heights have their `encoding`; `skugga` is what the archive itself says there."""
    served = await service.archives.current(archive)
    facts = archive_facts(archive, served)
    west, south, east, north = served.bounds
    address = f"{base_url(request, service.settings.public_url)}/archives/{quote(archive)}"
    layer = LAYERS.get(str(facts["layer"]))
    encoding = None if layer is None else layer.encoding
    return json_answer(
        request,
        {
            "tilejson": "3.0.0",
            "name": facts["title"],
            "attribution": facts["attribution"],
            "scheme": "xyz",
            "tiles": [f"{address}/{{z}}/{{x}}/{{y}}.{served.format}"],
            "minzoom": facts["minzoom"],
            "maxzoom": facts["maxzoom"],
            "bounds": facts["bounds"],
            "center": [(west + east) / 2, (south + north) / 2, facts["minzoom"]],
            **({"encoding": encoding} if encoding in TILEJSON_ENCODINGS else {}),
            **({"skugga": served.of_skugga} if served.of_skugga else {}),
        },
    )


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
    request: Request, service: TheService, archive: ArchivePath, z: ZoomPath, x: ColumnPath, y: RowPath, format: EndingPath
) -> Response:
    """A tile in Web Mercator, byte by byte as it lies in the archive. Inside of the archive's zooms, a tile that it has not is one
    without data.
    """
    served = await service.archives.current(archive)
    if format != served.format:
        raise NotServedError("format", f"The tiles of {archive} are {served.format}.")
    if z not in served.zooms:
        raise NotServedError("z", f"{archive} has tiles of zooms {served.zooms[0]} to {served.zooms[-1]}.")
    if not (0 <= x < 2**z and 0 <= y < 2**z):
        raise NotServedError("x", f"Zoom {z} has columns and rows 0 to {2**z - 1}.")
    body = await read_tile(served, z, x, y)
    if body is None:
        if service.settings.empty_tile == "404":
            raise NotServedError("x", f"{archive} has no tile {x}, {y} of zoom {z}.")
        return Response(status_code=204, headers=cache_headers(tag_of(served.version, z, x, y), OWN_SUN_S))
    return archived_tile(body, served, OWN_SUN_S).answer(request)


async def read_tile(archive: ArchiveFile, zoom: int, x: int, y: int) -> bytes | None:
    """A tile of an archive, read in a thread; ``None`` where it has none. Raises ``ArchiveError``, of which the log tells."""
    try:
        return await run_in_threadpool(archive.tile, zoom, x, y)
    except ArchiveError as error:
        log.error("archive %s", error)
        raise


def archived_tile(body: bytes, archive: ArchiveFile, fresh_s: int, *asked: object, **more: str) -> EncodedTile:
    """A tile that was read, with ``more`` headers. The tag is of its bytes and of what was ``asked``: it stays the same in all
    services that have the tile, and where an archive is replaced that has it again.
    """
    tag = tag_of("archived", hashlib.blake2b(body, digest_size=16).hexdigest(), *asked)
    return EncodedTile(body, {**cache_headers(tag, fresh_s), "Server-Timing": "archive;desc=read", **more}, archive.media_type)
