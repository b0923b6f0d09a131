"""TileJSON 3.0.0, of levels and of archives."""

from __future__ import annotations

from typing import Any

from fastapi import Request, Response

from skugga.api.http.answers import json_answer


def tilejson_answer(
    request: Request,
    name: str,
    attribution: str | None,
    tiles: str,
    zooms: tuple[int, int],
    bounds: tuple[float, float, float, float],
    more: dict[str, Any],
) -> Response:
    """TileJSON of tiles at a template of addresses, of the first to the last of ``zooms``, or 304 where the client has it.

    ``bounds`` are west, south, east and north in degrees; ``more`` are entries beyond those that every TileJSON has.
    """
    west, south, east, north = bounds
    return json_answer(
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
            **more,
        },
    )
