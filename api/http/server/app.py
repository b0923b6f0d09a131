"""The HTTP application: middleware, error handlers and all routes."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from pathlib import Path

from fastapi import FastAPI, Request, Response
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from skugga.api.animations.animations import Animations
from skugga.api.animations.drawing import frame_renderer, write_animation
from skugga.api.errors import TooLargeError
from skugga.api.http import problems
from skugga.api.http.levels import routes_level_page, routes_levels, routes_location, routes_plan
from skugga.api.http.ogc import routes_wms, routes_wmts
from skugga.api.http.points import routes_point, routes_point_irradiation
from skugga.api.http.responses import EXPOSED_HEADERS, VERSION
from skugga.api.http.server import routes_docs, routes_health, routes_viewer
from skugga.api.http.server.bearer_token import BearerTokenMiddleware
from skugga.api.http.server.cross_origin import SharedCacheCorsMiddleware
from skugga.api.http.server.first_blocks import central_blocks
from skugga.api.http.server.openapi import install_openapi
from skugga.api.http.server.problem_handlers import install_problem_handlers
from skugga.api.http.server.request_middleware import CACHED_ROUTE_KEY, CLIENT_CLOSED_REQUEST, RequestMiddleware
from skugga.api.http.server.tile_cache_middleware import TileCacheMiddleware
from skugga.api.http.state.encoded_tiles import EncodedTiles
from skugga.api.http.state.metrics import ServiceMetrics
from skugga.api.http.state.rate_limiter import RateLimiter
from skugga.api.http.state.served_archives import ServedArchives
from skugga.api.http.state.served_levels import ServedLevels
from skugga.api.http.state.service import ClientDisconnectedError, Service
from skugga.api.http.tiles import routes_archives, routes_map, routes_tiles
from skugga.api.http.views import routes_animations, routes_snapshot
from skugga.api.settings import Settings
from skugga.api.workers.idle_calibration import measure_profile
from skugga.api.workers.idle_probes import Probe, probe_level
from skugga.api.workers.jobs import LevelKey
from skugga.api.workers.piped_process import SpawnedWorker, WorkerTarget
from skugga.api.workers.pool import Pool
from skugga.api.workers.worker_main import worker_main
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.terrain.errors import Problem
from skugga.terrain.level.level_source import LevelSource


def create_app(
    settings: Settings,
    levels: Sequence[Path | LevelSource],
    worker_target: WorkerTarget = worker_main,
    measure: Callable[[], DeviceProfile] = measure_profile,
    probe: Probe = probe_level,
    archives: Sequence[Path] = (),
    spawned_worker: SpawnedWorker | None = None,
) -> FastAPI:
    """Return the application for some levels and archives.

    Its render processes run from startup to shutdown, unless it serves archives only.

    Parameters
    ----------
    settings
        The service's settings. The level files in the folder ``settings.levels`` are served, too.
    levels
        Level files, or sources of levels.
    worker_target
        Main function of a render process.
    measure
        Function that calibrates the device (measures how fast it runs the algorithms) while the service is idle.
    probe
        Function that probes a level (tries algorithms on its maps) while the service is idle.
    archives
        PMTiles archives.
    spawned_worker
        The first render process, if it has been started already.

    Returns
    -------
    FastAPI
        The application.

    Raises
    ------
    LevelError, SourceError, InputError
        One of ``levels`` cannot be served. A level of the folder that cannot be served is logged and left out instead.
    ArchiveError
        One of ``archives``, or an archive that one of ``levels`` names, cannot be served. An archive that a level of the folder
        names is logged and left out instead.
    """
    served_levels = ServedLevels(
        levels, settings.remote_sources, settings.level_check_s, settings.level_timeout_s, settings.levels, settings.data_roots
    )
    source_levels = served_levels.cached_source_levels()
    served_archives = ServedArchives(archives, settings.level_check_s, settings.level_timeout_s)
    for level in source_levels:
        served_archives.open_level_archives(level)
    pool = Pool(settings, worker_target, lambda: central_blocks(served_levels), measure, probe, spawned_worker)
    tiles = EncodedTiles(settings.tile_cache_bytes)

    async def current_level_key(name: str) -> LevelKey:
        return (await served_levels.current(name)).key

    animations = Animations(settings, frame_renderer(pool, current_level_key), write_animation)
    metrics = ServiceMetrics(pool, tiles, animations)
    service = Service(
        settings, served_levels, served_archives, pool, tiles, RateLimiter(settings.new_suns_per_minute), animations, metrics
    )

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        if service.can_render:
            service.pool.open()
        try:
            yield
        finally:
            await service.close()

    app = FastAPI(
        title="Skugga", version=VERSION, description="Terrain with the sun's true cast shadows, as map tiles and pictures.",
        lifespan=lifespan, docs_url=None, redoc_url=None,
    )  # fmt: skip
    app.state.service = service
    app.add_middleware(TileCacheMiddleware, service=service)
    app.add_middleware(HeadAsGetMiddleware)
    app.add_middleware(BodyLimitMiddleware, max_bytes=settings.max_body_bytes)
    if settings.api_token is not None:
        app.add_middleware(BearerTokenMiddleware, token=settings.api_token.get_secret_value())
    # CORS wraps the middleware that rejects requests, so pages of other origins can read the reason. Requests carry no credentials
    # such as cookies, so all request headers are allowed.
    app.add_middleware(
        SharedCacheCorsMiddleware, allow_origins=list(settings.cors_origins), allow_methods=["GET", "HEAD", "POST", "DELETE"],
        allow_headers=["*"], expose_headers=list(EXPOSED_HEADERS),
    )  # fmt: skip
    app.add_middleware(RequestMiddleware, metrics=metrics, access_log=settings.access_log)
    install_problem_handlers(app)
    app.add_exception_handler(ClientDisconnectedError, _client_disconnected)
    for routes in (
        routes_wmts, routes_wms, routes_level_page, routes_levels, routes_location, routes_plan, routes_point,
        routes_point_irradiation, routes_tiles, routes_map, routes_snapshot, routes_animations, routes_archives,
        routes_health,
    ):  # fmt: skip
        app.include_router(routes.router)
    routes_docs.install_docs(app)
    routes_viewer.install_viewer(app, routes_viewer.STATIC_FOLDER)
    install_openapi(app, service)
    return app


class HeadAsGetMiddleware:
    """Middleware that answers HEAD like GET, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application; run it for GET if the request is HEAD."""
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self.app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        get_scope = {**scope, "method": "GET"}
        await self.app(get_scope, receive, send_head)
        scope.update({key: get_scope[key] for key in (CACHED_ROUTE_KEY, "route") if key in get_scope})


class BodyLimitMiddleware:
    """Middleware that rejects request bodies of more than ``max_bytes`` bytes.

    A body with a Content-Length is rejected before it is read.
    """

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self.app, self.max_bytes = app, max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Run the application, or answer 413 if the request's body is too long."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        error = TooLargeError(
            "body",
            Problem(f"more than {self.max_bytes} bytes"),
            "Send a smaller body, or have the operator raise SKUGGA_MAX_BODY_BYTES",
        )
        content_length = dict(scope["headers"]).get(b"content-length", b"0")
        if content_length.isdigit() and int(content_length) > self.max_bytes:
            await problems.logged_error_response(Request(scope), error)(scope, receive, send)
            return
        read = 0

        async def receive_limited() -> Message:
            nonlocal read
            message = await receive()
            read += len(message.get("body", b""))
            if read > self.max_bytes:
                raise HTTPException(413, str(error))
            return message

        await self.app(scope, receive_limited, send)


async def _client_disconnected(request: Request, error: Exception) -> Response:
    """Answer a request whose client has disconnected. Only logs and metrics see the status."""
    return Response(status_code=CLIENT_CLOSED_REQUEST)
