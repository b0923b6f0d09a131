"""The HTTP service: an application of its routes, and the server that runs it."""

from __future__ import annotations

import logging
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

import uvicorn
from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException
from starlette.middleware.cors import CORSMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from api.errors import TooLargeError
from api.http import (
    problems,
    routes_health,
    routes_level_page,
    routes_levels,
    routes_map,
    routes_plan,
    routes_point,
    routes_snapshot,
    routes_tiles,
    routes_viewer,
    routes_wms,
    routes_wmts,
)
from api.http.answers import EXPOSED_HEADERS, VERSION
from api.http.encoded_tiles import EncodedTiles, SentBefore
from api.http.first_pictures import served_pictures
from api.http.ogc_times import OFFERED_STEP, CurrentTimeError
from api.http.served_levels import ServedLevels
from api.http.service import ClientGoneError, Service
from api.settings import Settings
from api.workers.pool import Pool
from api.workers.render_worker import worker_main
from api.workers.worker_process import WorkerTarget
from terrain.level.level_source import LevelSource

CLIENT_GONE = 499
"""Status in the access log of a request whose client has gone, as nginx has it; nobody reads it."""

LAST_ANSWERS_S = 3
"""How long a stopping server waits for clients to read their answers."""

LOG_CONFIG: dict[str, Any] = {
    "version": 1,
    "disable_existing_loggers": False,
    "formatters": {"line": {"format": "%(asctime)s %(levelname)s %(message)s"}},
    "handlers": {"stderr": {"class": "logging.StreamHandler", "formatter": "line"}},
    "loggers": {
        "skugga": {"handlers": ["stderr"], "level": "INFO", "propagate": False},
        "uvicorn.error": {"handlers": ["stderr"], "level": "WARNING", "propagate": False},
        "uvicorn.access": {"handlers": ["stderr"], "level": "INFO", "propagate": False},
    },
}

log = logging.getLogger("skugga")


def create_app(settings: Settings, levels: Sequence[Path | LevelSource], worker_target: WorkerTarget = worker_main) -> FastAPI:
    """The application over some levels; its render processes run from its start-up to its shutdown.

    Raises ``LevelError``, ``SourceError`` or ``InputError`` for a level that cannot be served.
    """
    served = ServedLevels(levels, settings.remote_sources)
    service = Service(
        settings,
        served,
        Pool(settings, worker_target, lambda: served_pictures(served)),
        EncodedTiles(settings.tile_cache_bytes),
    )

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        service.pool.open()
        try:
            yield
        finally:
            await service.pool.close()

    app = FastAPI(
        title="Skugga", version=VERSION, description="Terrain with the sun's true cast shadows, as map tiles and pictures.",
        lifespan=lifespan, redoc_url=None,
    )  # fmt: skip
    app.state.service = service
    app.add_middleware(SentBefore, service=service)
    app.add_middleware(
        CORSMiddleware, allow_origins=list(settings.cors_origins), allow_methods=["GET", "HEAD", "POST"],
        allow_headers=["Content-Type"],
        expose_headers=list(EXPOSED_HEADERS),
    )  # fmt: skip
    app.add_middleware(HeadAsGet)
    app.add_middleware(BoundedBody, max_bytes=settings.max_body_bytes)
    problems.install_problem_handlers(app)
    app.add_exception_handler(ClientGoneError, _nobody_reads)
    app.add_exception_handler(CurrentTimeError, _at_the_instant)
    for routes in (
        routes_wmts, routes_wms, routes_level_page, routes_levels, routes_plan, routes_point, routes_tiles, routes_map,
        routes_snapshot, routes_health,
    ):  # fmt: skip
        app.include_router(routes.router)
    routes_viewer.install_viewer(app, routes_viewer.STATIC_FOLDER)
    return app


class HeadAsGet:
    """Answers HEAD as GET without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        await self.app({**scope, "method": "GET"}, receive, send_head)


class BoundedBody:
    """Refuses bodies of more than so many bytes, before they are read where they tell their length."""

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self.app, self.max_bytes = app, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        error = TooLargeError(
            "body", f"more than {self.max_bytes} bytes", f"at most {self.max_bytes} bytes (SKUGGA_MAX_BODY_BYTES)"
        )
        content_length = dict(scope["headers"]).get(b"content-length", b"0")
        if content_length.isdigit() and int(content_length) > self.max_bytes:
            await problems.domain_problem(Request(scope), error)(scope, receive, send)
            return
        read = 0

        async def receive_some() -> Message:
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            if read > self.max_bytes:
                raise HTTPException(413, str(error))
            return message

        await self.app(scope, receive_some, send)


class Server(uvicorn.Server):
    """Says where it listens, and stops without waiting for pictures that are still to be drawn."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self._service = service

    async def startup(self, sockets: Any = None) -> None:
        """Listen."""
        names = ", ".join(level.name for level in self._service.levels.all())
        await super().startup(sockets)
        if self.started:
            host, port = self.servers[0].sockets[0].getsockname()[:2]
            log.info("Skugga serves %s on http://%s:%d", names, f"[{host}]" if ":" in host else host, port)

    async def shutdown(self, sockets: Any = None) -> None:
        """End the render processes, answer what waits for them, and stop."""
        await self._service.pool.close()
        await super().shutdown(sockets)
        log.info("Skugga has stopped")


def serve(settings: Settings, levels: Sequence[Path | LevelSource]) -> None:
    """Serve levels until SIGINT or SIGTERM. Raises as ``create_app`` does."""
    app = create_app(settings, levels)
    config = uvicorn.Config(
        app, host=settings.host, port=settings.port, access_log=settings.access_log, log_config=LOG_CONFIG,
        server_header=False, timeout_graceful_shutdown=LAST_ANSWERS_S,
    )  # fmt: skip
    with suppress(KeyboardInterrupt):
        Server(config, app.state.service).run()


async def _at_the_instant(request: Request, error: Exception) -> Response:
    assert isinstance(error, CurrentTimeError)
    return Response(
        status_code=307, headers={"Location": error.location, "Cache-Control": f"public, max-age={OFFERED_STEP.seconds // 10}"}
    )


async def _nobody_reads(request: Request, error: Exception) -> Response:
    return Response(status_code=CLIENT_GONE)
