"""The HTML page of status 404 for browsers."""

from __future__ import annotations

from html import escape
from urllib.parse import quote

from fastapi import Request
from fastapi.responses import HTMLResponse

from skugga.api.http.responses import base_url
from skugga.api.http.state.service import service_of

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Skugga: not found</title><link rel="icon" href="data:,"></head><body>
<h1>Not found</h1>
<p>{detail}</p>
<p>Served here: <a href="{base}/">the viewer</a>, <a href="{base}/docs">the interface</a>, and these levels:</p>
<ul>{items}</ul>
</body></html>
"""


def not_found_page(request: Request, detail: str) -> HTMLResponse:
    """Return a page with the text ``detail`` and links to the served levels. Reads no file."""
    service = service_of(request)
    base = base_url(request, service.settings.public_url)
    items = "".join(
        f'<li><a href="{escape(f"{base}/levels/{quote(level.name)}.html")}">{escape(level.loaded.level.title or level.name)}</a>'
        for level in service.levels.cached_levels()
    )
    page = _PAGE.format(detail=escape(detail), base=escape(base), items=items or "<li>none")
    return HTMLResponse(page, 404, {"Cache-Control": "no-store", "Vary": "Accept"})
