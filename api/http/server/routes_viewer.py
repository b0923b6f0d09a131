"""The viewer on ``/``, or a plain page if the viewer was not built."""

from __future__ import annotations

from html import escape
from pathlib import Path
from urllib.parse import quote

from fastapi import FastAPI
from fastapi.responses import FileResponse, HTMLResponse, JSONResponse, Response
from starlette.concurrency import run_in_threadpool
from starlette.staticfiles import StaticFiles

from skugga.api.base_maps import tile_sources
from skugga.api.http.server.request_middleware import content_security_policy
from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET
from skugga.api.http.state.service import ServiceDep

STATIC_FOLDER = Path(__file__).parents[2] / "static"

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Skugga</title>
<link rel="icon" href="data:,"></head><body>
<h1>Skugga</h1>
<p>The viewer was not built (<code>make viewer</code> builds it); the service works without it.</p>
<ul>{items}</ul>
<p><a href="levels">Levels</a>, <a href="docs">interface</a></p>
</body></html>
"""


def install_viewer(app: FastAPI, folder: Path) -> None:
    """Serve the viewer from a folder: its page on ``/``, its parts under ``/assets``, all files under ``/static``."""

    @app.get("/", include_in_schema=False)
    async def index(service: ServiceDep) -> Response:
        page = folder / "index.html"
        if await run_in_threadpool(page.is_file):
            # Users may name any server for a base map unless the operator forbids it. Scripts come from this service only.
            sources = tile_sources(service.settings.base_maps, has_others=not service.settings.base_maps_only)
            policy = content_security_policy(tile_sources=sources)
            return FileResponse(page, headers={"Cache-Control": "no-cache", "Content-Security-Policy": policy})
        levels = await service.all_levels()
        items = "".join(
            f'<li>{escape(level.loaded.level.title or level.name)}: '
            f'<a href="levels/{quote(level.name)}/{DEFAULT_MATRIX_SET}/tilejson.json">TileJSON</a></li>'
            for level in levels
        )  # fmt: skip
        return HTMLResponse(_PAGE.format(items=items))

    @app.get("/base-maps.json", include_in_schema=False)
    async def base_maps(service: ServiceDep) -> Response:
        settings = service.settings
        document = {"base_maps": [base_map.model_dump() for base_map in settings.base_maps], "only": settings.base_maps_only}
        return JSONResponse(document, headers={"Cache-Control": "no-cache"})

    # The page has relative links to its parts.
    for path, part in (("/assets", folder / "assets"), ("/static", folder)):
        if part.is_dir():
            app.mount(path, StaticFiles(directory=part), name=path.strip("/"))
