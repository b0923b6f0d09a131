"""What is served: levels and their TileJSON."""

from __future__ import annotations

from typing import Annotated, Any
from urllib.parse import quote

from fastapi import APIRouter, Depends, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from api.http.answers import json_answer
from api.http.parameters import PICTURE_PARAMETERS, LayerQuery, allow_only, picture_query
from api.http.problems import problem_docs
from api.http.service import TheService
from api.layers import PictureFormat
from api.workers.jobs import PictureRequest

router = APIRouter(tags=["levels"], responses=problem_docs(404, 422))


@router.get("/levels", summary="The levels", dependencies=[Depends(allow_only())], response_model=list[dict[str, Any]])
async def levels(request: Request, service: TheService) -> Response:
    """Every level: its name, title, attribution, bounds in degrees, zooms, views, lights, layers, algorithms, sun, and
    `warnings` on what may be wrong with its files.

    `view_kinds` says of each view whether it is a `map` or `perspective`, and its width and height in pixels.
    `bounds`, `minzoom` and `maxzoom` are null where a level has no place on earth.
    """
    served = await run_in_threadpool(service.levels.all)
    return json_answer(request, [level.summary() for level in served])


@router.get("/levels/{level}", summary="A level", dependencies=[Depends(allow_only())], response_model=dict[str, Any])
async def level(request: Request, service: TheService, level: str) -> Response:
    """One level, as in the list."""
    return json_answer(request, (await service.level(level)).summary())


@router.get(
    "/levels/{level}/{tms}/tilejson.json",
    summary="TileJSON",
    dependencies=[Depends(allow_only("layer", "format", *PICTURE_PARAMETERS))],
    response_model=dict[str, Any],
)
async def tilejson(
    request: Request,
    service: TheService,
    level: str,
    tms: str,
    wanted: Annotated[PictureRequest, Depends(picture_query)],
    layer: LayerQuery = "color",
    format: Annotated[PictureFormat, Query(description="Of the tiles.")] = "png",
) -> Response:
    """TileJSON 3.0.0 for map clients; what is asked of the picture is asked of its tiles.

    Beyond the standard, `skugga` has the `layer`, the `tile_matrix_set` and the `sun`: its `azimuth` and apparent
    `altitude` in degrees at the level's anchor, and its `time` where one was given (null: the level has no sun).
    """
    served = await service.level(level)
    zooms = served.zooms_in(tms)
    sun = await run_in_threadpool(served.sun, wanted.sun)
    where: dict[str, Any] | None = None
    if sun is not None:
        time_default = {} if sun.time is None else {"time": sun.time.isoformat()}
        where = {**time_default, "azimuth": sun.azimuth_deg, "altitude": sun.altitude_deg}
    assert served.bounds is not None  # it has zooms, so it has a place on earth
    west, south, east, north = served.bounds
    query = wanted.query(**({} if layer == "color" else {"layer": layer}))
    address = f"{_base_url(request, service.settings.public_url)}/levels/{quote(served.name)}/tiles/{tms}"
    tiles = f"{address}/{{z}}/{{x}}/{{y}}.{format}"
    return json_answer(
        request,
        {
            "tilejson": "3.0.0",
            "name": served.loaded.level.title or served.name,
            "attribution": served.loaded.level.attribution,
            "scheme": "xyz",
            "tiles": [f"{tiles}?{query}" if query else tiles],
            "minzoom": zooms.first,
            "maxzoom": zooms.last,
            "bounds": [west, south, east, north],
            "center": [(west + east) / 2, (south + north) / 2, zooms.first],
            "skugga": {"layer": layer, "tile_matrix_set": tms, "sun": where},
        },
    )


def _base_url(request: Request, public_url: str | None) -> str:
    return (public_url or str(request.base_url)).rstrip("/")
