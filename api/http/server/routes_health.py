"""Is it alive, can it draw, and how does it do?"""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import Any

from fastapi import APIRouter, Depends
from fastapi.responses import JSONResponse, PlainTextResponse, Response

from skugga.api.errors import NotReadyError, UnhealthyError
from skugga.api.http.documented import problem_docs
from skugga.api.http.parameters import allow_only
from skugga.api.http.state.metrics import MEDIA_TYPE_OF_METRICS
from skugga.api.http.state.service import TheService

router = APIRouter(tags=["health"], dependencies=[Depends(allow_only())])

_UNCACHED = {"Cache-Control": "no-store"}


@router.get("/healthz", summary="Whether the service is alive", responses=problem_docs(503), response_model=dict[str, str])
async def healthz(service: TheService) -> JSONResponse:
    """Answers while the service runs, whether or not it can draw; 503 where it is to be started anew."""
    if not service.pool.whole:
        raise UnhealthyError("what keeps a render process running has ended")
    return JSONResponse({"status": "ok"}, headers=_UNCACHED)


@router.get("/readyz", summary="Whether the service can draw", responses=problem_docs(503), response_model=dict[str, Any])
async def readyz(service: TheService) -> JSONResponse:
    """503 until a render process has warmed up, and while none runs. `calibration` says whether plans go by predictions:
    `calibrated`; `waiting` (for an idle service), `running`, `paused`; `failed`, `off`, `none` (no device to calibrate).
    `probes_waiting` is how many levels, each under a class of suns, are still to be probed while nothing is drawn. Where archives
    of tiles are served alone nothing is drawn, and the service is ready at once.

    `preparing` is what is compiled, with the numbers of loops `done` and in `total` (0 while unknown), and `elapsed_s`, the
    seconds since the service began to prepare; `null` where nothing is left. Before the service is ready tiles wait for it;
    after that it is what no request has needed yet.
    """
    pool = service.pool
    preparing: dict[str, Any] | None = None
    if pool.preparing is not None:
        preparing = {**asdict(pool.preparing), "elapsed_s": round(time.monotonic() - pool.preparing_since, 1)}
    if service.draws and not pool.ready:
        raise NotReadyError("No render process is ready; the service's log says why if this lasts.", preparing)
    return JSONResponse(
        {
            "status": "ready",
            "renderer": pool.renderer,
            "workers": len(pool.pids),
            "queued": pool.queued,
            "calibration": pool.calibrating.state,
            "probes_waiting": pool.probing.waiting,
            "preparing": preparing,
        },
        headers=_UNCACHED,
    )


@router.get("/metrics", summary="Metrics", response_class=PlainTextResponse, response_model=str)
async def metrics(service: TheService) -> Response:
    """For Prometheus, in its text format."""
    return Response(service.metrics.text(), headers=_UNCACHED, media_type=MEDIA_TYPE_OF_METRICS)
