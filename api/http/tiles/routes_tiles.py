"""Routes for tiles."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Depends, Path, Request, Response

from skugga.api.http.openapi_parts import ColumnPath, LevelPath, MatrixSetPath, RowPath, ZoomPath
from skugga.api.http.parameters import TILE_PARAMETERS, allow_only_parameters, tile_query
from skugga.api.http.state.service import ServiceDep
from skugga.api.http.tiles.tile_docs import DATA_LAYERS, EMPTY_TILE_DOCS, JPEG_LAYERS, PICTURE_DOCS
from skugga.api.http.tiles.tile_responses import tile_response
from skugga.api.products.product import MapFormat
from skugga.api.request import ProductRequest

router = APIRouter(
    tags=["tiles"],
    dependencies=[Depends(allow_only_parameters(*TILE_PARAMETERS))],
    responses=PICTURE_DOCS | EMPTY_TILE_DOCS,
    default_response_class=Response,
)

FormatPath = Annotated[
    MapFormat,
    Path(
        description=f"WebP is lossless for {DATA_LAYERS}; JPEG is for {JPEG_LAYERS} alone; `tif` is georeferenced, `npy` an array.",
        examples=["png"],
    ),
]


@router.get("/levels/{level}/tiles/{tms}/{z}/{x}/{y}@2x.{format}", summary="A tile of 512 x 512 pixels")
async def double_tile(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    tms: MatrixSetPath,
    z: ZoomPath,
    x: ColumnPath,
    y: RowPath,
    format: FormatPath,
    product_request: Annotated[ProductRequest, Depends(tile_query)],
) -> Response:
    """Return a tile with twice the pixels a side, for dense screens: the four tiles of the next zoom in one picture."""
    return await tile_response(request, service, level, tms, (z, x, y), 2, format, product_request)


@router.get("/levels/{level}/tiles/{tms}/{z}/{x}/{y}.{format}", summary="A tile of 256 x 256 pixels")
async def tile(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    tms: MatrixSetPath,
    z: ZoomPath,
    x: ColumnPath,
    y: RowPath,
    format: FormatPath,
    product_request: Annotated[ProductRequest, Depends(tile_query)],
) -> Response:
    """Return a tile of a level.

    A tile without data inside the level's zooms is transparent; a setting makes it 204 or 404.
    """
    return await tile_response(request, service, level, tms, (z, x, y), 1, format, product_request)
