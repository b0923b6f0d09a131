"""Swagger UI on ``/docs``, from files of this installation."""

from __future__ import annotations

from fastapi import FastAPI
from fastapi.responses import HTMLResponse, Response
from starlette.staticfiles import StaticFiles

SWAGGER_UI_FOLDER = "fastapi_offline", "static"
"""The package with the files of Swagger UI, and their folder in it."""

_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Skugga, the interface</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="docs/assets/swagger-ui.css">
</head>
<body>
<div id="swagger-ui"><noscript>The interface is in <a href="openapi.json">openapi.json</a>.</noscript></div>
<script src="docs/assets/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
"""The page. Its links are relative, so it works behind a proxy that adds a path prefix."""

_START_SCRIPT = """SwaggerUIBundle({
  url: 'openapi.json',
  dom_id: '#swagger-ui',
  presets: [SwaggerUIBundle.presets.apis],
  deepLinking: true,
  validatorUrl: null, // no external validator gets the document
});
"""
"""The script that starts Swagger UI. It is a separate file, since the content security policy forbids inline scripts."""


def install_docs(app: FastAPI) -> None:
    """Serve Swagger UI on ``/docs`` and its files below."""

    @app.get("/docs", include_in_schema=False)
    async def docs_page() -> Response:
        return HTMLResponse(_PAGE)

    @app.get("/docs/start.js", include_in_schema=False)
    async def start_script() -> Response:
        return Response(_START_SCRIPT, media_type="text/javascript")

    app.mount("/docs/assets", StaticFiles(packages=[SWAGGER_UI_FOLDER]), name="docs")
