"""Routes for liveness, readiness and metrics."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Depends
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from skugga.api.errors import NotReadyError, UnhealthyError
from skugga.api.http.openapi_parts import problem_docs
from skugga.api.http.parameters import allow_only_parameters
from skugga.api.http.state.metrics import METRICS_MEDIA_TYPE
from skugga.api.http.state.service import ServiceDep

router = APIRouter(tags=["health"], dependencies=[Depends(allow_only_parameters())])

NO_STORE_HEADERS = {"Cache-Control": "no-store"}


@router.get("/healthz", summary="Whether the service is alive", responses=problem_docs(503), response_model=dict[str, str])
async def healthz(service: ServiceDep) -> JSONResponse:
    """Return 200 while the service runs, even if it cannot render yet; 503 if it must be restarted."""
    if not service.pool.is_healthy:
        raise UnhealthyError("the supervisor of a render process has ended")
    return JSONResponse({"status": "ok"}, headers=NO_STORE_HEADERS)


@router.get("/readyz", summary="Whether the service can draw", responses=problem_docs(503), response_model=dict[str, Any])
async def readyz(service: ServiceDep) -> JSONResponse:
    """Return 200 if a render process is ready; 503 until the first one has warmed up, and while none runs.

    A service of archives only renders nothing and is ready at once.

    `calibration` is the state of the device's calibration, which predictions of plans need: `calibrated`; `waiting` (for an idle
    service), `running`, `paused`; `failed`, `off`, `none` (no device to calibrate). `probes_waiting` is the number of pending
    probes: one for each level and class of suns, run while the service is idle.

    `preparing` describes the compilation of loops: the numbers `done` and `total` (0 while unknown), and `elapsed_s`, the seconds
    since its start; `null` when it is complete. Tiles wait for loops that are compiled before the service is ready. No request has
    needed the loops that are compiled later.
    """
    pool = service.pool
    preparing: dict[str, Any] | None = None
    if pool.preparing is not None:
        preparing = {**asdict(pool.preparing), "elapsed_s": round(time.monotonic() - pool.preparing_since_s, 1)}
    if service.can_render and not pool.is_ready:
        raise NotReadyError("No render process is ready. If this lasts, see the service's log.", preparing)
    return JSONResponse(
        {
            "status": "ready",
            "renderer": pool.renderer,
            "workers": len(pool.ready_pids),
            "queued": pool.queued_count,
            "calibration": pool.idle_calibration.state,
            "probes_waiting": pool.idle_probes.requested_count,
            "preparing": preparing,
        },
        headers=NO_STORE_HEADERS,
    )


@router.get("/metrics", summary="Metrics", response_class=PlainTextResponse, response_model=str)
async def metrics(service: ServiceDep) -> Response:
    """Return the metrics in Prometheus' text format."""
    return Response(service.metrics.text(), headers=NO_STORE_HEADERS, media_type=METRICS_MEDIA_TYPE)
