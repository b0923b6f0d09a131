"""Is it alive, and can it draw?"""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Depends
from fastapi.responses import JSONResponse

from api.errors import NotReadyError
from api.http.parameters import allow_only
from api.http.problems import problem_docs
from api.http.service import TheService

router = APIRouter(tags=["health"], dependencies=[Depends(allow_only())])

_UNCACHED = {"Cache-Control": "no-store"}


@router.get("/healthz", summary="Whether the service is alive", response_model=dict[str, str])
async def healthz() -> JSONResponse:
    """Answers while the service runs, whether or not it can draw."""
    return JSONResponse({"status": "ok"}, headers=_UNCACHED)


@router.get("/readyz", summary="Whether the service can draw", responses=problem_docs(503), response_model=dict[str, Any])
async def readyz(service: TheService) -> JSONResponse:
    """503 until a render process has warmed up, and while none runs."""
    pool = service.pool
    if not pool.ready:
        raise NotReadyError("No render process is ready; the service's log says why if this lasts.")
    return JSONResponse(
        {"status": "ready", "renderer": pool.renderer, "workers": len(pool.pids), "queued": pool.queued},
        headers=_UNCACHED,
    )
