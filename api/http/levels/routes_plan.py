"""Routes for plans and descriptors of a level's view or tiles, and for the plan of a client's descriptor.

A plan is the selector's choice of shadow algorithms and settings. A descriptor has the facts of a scene and a view that the
selector chooses by.
"""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import APIRouter, Body, Depends, Query, Request, Response

from skugga.api.errors import NotServedError
from skugga.api.http.levels.sent_descriptor import SentDescriptor
from skugga.api.http.numbers import PLAIN_INTEGER
from skugga.api.http.openapi_parts import PLAN_DOCS, WORK_ERROR_STATUSES, LevelPath, ResponseDocs, problem_docs
from skugga.api.http.parameters import (
    PLAN_PARAMETERS,
    SUN_PARAMETERS,
    PlanQuery,
    ViewQuery,
    allow_only_parameters,
    plan_query,
    sun_query,
)
from skugga.api.http.request_times import time_headers
from skugga.api.http.responses import json_response
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET, ServedLevel
from skugga.api.http.state.service import ServiceDep
from skugga.api.matrices import matrix_set_of
from skugga.api.request import PictureRequest
from skugga.api.workers.jobs import DescriptorJob, DescriptorPlanJob, DescriptorResult, PlanJob, PlanResult, ZoomTiles
from skugga.terrain.errors import InputError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.parts import SunSpec

router = APIRouter(tags=["plans"], responses=problem_docs(*WORK_ERROR_STATUSES))

DESCRIPTOR_EXAMPLE: dict[str, Any] = {
    "view": "map", "view_kind": "map", "flat_world": False, "pixel_m": 10.0, "node_m": 30.0, "casters": ["relief"],
    "relief_m": 700.0, "block_relief_m": 450.0, "sun_azimuth_deg": 235.0, "sun_altitude_deg": 22.0, "highest_sun_deg": 22.5,
    "receivers_light_m": [10000.0, 9000.0, 600.0],
}  # fmt: skip
"""Example of a client's descriptor for ``POST /plan``, with the required facts only."""

NOT_MODIFIED_DOCS: ResponseDocs = {304: {"description": "The client has it (`If-None-Match`)."}}

ZoomQuery = Annotated[
    int | None,
    PLAIN_INTEGER,
    Query(description="Instead of `view`: the tiles of a zoom, of which all have the same plan.", examples=[12]),
]
MatrixSetQuery = Annotated[
    str | None, Query(max_length=100, description=f"Of the tiles; default: {DEFAULT_MATRIX_SET}.", examples=[DEFAULT_MATRIX_SET])
]

VIEW_PARAMETERS = ("view", "zoom", "tms")


@router.get(
    "/levels/{level}/plan",
    summary="The plan of a view",
    response_model=None,
    responses=PLAN_DOCS | NOT_MODIFIED_DOCS,
    dependencies=[Depends(allow_only_parameters(*VIEW_PARAMETERS, *SUN_PARAMETERS, *PLAN_PARAMETERS))],
)
async def plan(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    sun: Annotated[SunSpec | None, Depends(sun_query)],
    plan_request: Annotated[PlanQuery, Depends(plan_query)],
    view: ViewQuery = None,
    zoom: ZoomQuery = None,
    tms: MatrixSetQuery = None,
) -> Any:
    """Return the selector's choice for a view, or for the tiles of a zoom, with its reasons."""
    served_level = await service.level(level)
    view_or_tiles = _view_or_tiles(served_level, view, zoom, tms)
    job = PlanJob(
        level=served_level.key,
        view=view_or_tiles,
        policy=plan_request.policy,
        request=PictureRequest(sun=sun, overrides=plan_request.overrides),
    )
    answer = await service.run_job(request, job)
    assert isinstance(answer, PlanResult)
    return json_response(request, json.loads(answer.plan_json), **time_headers(request))


@router.get(
    "/levels/{level}/descriptor",
    summary="The facts of a view",
    response_model=Descriptor,
    responses=NOT_MODIFIED_DOCS,
    dependencies=[Depends(allow_only_parameters(*VIEW_PARAMETERS, *SUN_PARAMETERS))],
)
async def descriptor(
    request: Request,
    service: ServiceDep,
    level: LevelPath,
    sun: Annotated[SunSpec | None, Depends(sun_query)],
    view: ViewQuery = None,
    zoom: ZoomQuery = None,
    tms: MatrixSetQuery = None,
) -> Any:
    """Return the facts from which plans of a view, or of the tiles of a zoom, are made. `POST /plan` accepts them."""
    served_level = await service.level(level)
    job = DescriptorJob(level=served_level.key, view=_view_or_tiles(served_level, view, zoom, tms), request=PictureRequest(sun=sun))
    answer = await service.run_job(request, job)
    assert isinstance(answer, DescriptorResult)
    return json_response(request, json.loads(answer.descriptor_json), **time_headers(request))


@router.post(
    "/plan",
    summary="The plan of a descriptor",
    response_model=None,
    responses=PLAN_DOCS | problem_docs(413),
    dependencies=[Depends(allow_only_parameters(*PLAN_PARAMETERS))],
)
async def plan_of_descriptor(
    request: Request,
    service: ServiceDep,
    sent_descriptor: Annotated[
        SentDescriptor,
        Body(
            description="The facts of a scene and a view, as `/levels/{level}/descriptor` gives them.",
            examples=[DESCRIPTOR_EXAMPLE],
        ),
    ],
    plan_request: Annotated[PlanQuery, Depends(plan_query)],
) -> Any:
    """Return the selector's choice for a scene and a view that are given by their facts, with its reasons.

    The facts do not include a level's settings of shadows and effects: all settings are automatic here, unless the query sets them.
    Predictions are for the service's own device.
    """
    job = DescriptorPlanJob(
        descriptor_json=sent_descriptor.as_descriptor_json(),
        policy=plan_request.policy,
        request=PictureRequest(overrides=plan_request.overrides),
    )
    answer = await service.run_job(request, job)
    assert isinstance(answer, PlanResult)
    return Response(answer.plan_json, headers={"Cache-Control": "no-store"}, media_type="application/json")


def _view_or_tiles(level: ServedLevel, view: str | None, zoom: int | None, tms: str | None) -> str | ZoomTiles:
    """Return the checked name of a view, or the tiles of a zoom if the query has ``zoom``.

    Raises ``InputError`` for an unknown view, for ``view`` together with ``zoom``, and for ``tms`` without ``zoom``. Raises
    ``NotServedError`` for an unknown tile matrix set or zoom.
    """
    if zoom is None and tms is None:
        return level.view_named(view)
    if view is not None or zoom is None:
        raise InputError.conflict("view", "zoom") if zoom is not None else InputError.missing("zoom", "Give a zoom with tms")
    matrix_set = tms or DEFAULT_MATRIX_SET
    matrix_set_of(matrix_set)
    zooms = level.zooms_in(matrix_set)
    if not zooms.first <= zoom <= zooms.last:
        raise NotServedError("zoom", f"zoom: {zoom} is not served. Use {zooms.first} to {zooms.last}.")
    return ZoomTiles(matrix_set=matrix_set, zoom=zoom)
