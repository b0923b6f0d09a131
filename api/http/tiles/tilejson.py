"""Build TileJSON 3.0.0 documents of levels and archives."""

from __future__ import annotations

from typing import Any

from fastapi import Request, Response

from skugga.api.http.responses import json_response


def tilejson_response(
    request: Request,
    name: str,
    attribution: str | None,
    tiles: str,
    zooms: tuple[int, int],
    bounds: tuple[float, float, float, float],
    extra_entries: dict[str, Any],
) -> Response:
    """Return a TileJSON document, or 304 if the client's copy is current.

    ``name`` is the title. ``tiles`` is the URL template of the tiles, and ``zooms`` has their first and last zoom. ``bounds`` are
    west, south, east and north in degrees. ``extra_entries`` are added to the document.
    """
    west, south, east, north = bounds
    return json_response(
        request,
        {
            "tilejson": "3.0.0",
            "name": name,
            "attribution": attribution,
            "scheme": "xyz",
            "tiles": [tiles],
            "minzoom": zooms[0],
            "maxzoom": zooms[1],
            "bounds": [west, south, east, north],
            "center": [(west + east) / 2, (south + north) / 2, zooms[0]],
            **extra_entries,
        },
    )
