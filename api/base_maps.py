"""Base maps that an operator offers in the viewer, from the setting ``SKUGGA_BASE_MAPS``."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, field_validator
from pydantic_core import PydanticCustomError

ALLOWED_BASE_MAPS = (
    'a JSON list, such as [{"title": "Streets", "tiles": "https://example.org/{z}/{x}/{y}.png", "attribution": "© them"}]'
)

MAX_BASE_MAPS = 20

_SERVER_PATTERN = r"https?://[A-Za-z0-9.-]+(:[0-9]{1,5})?/"
_PATH_PATTERN = r"(levels|archives|static)/"
TILES_PATTERN = rf"^({_SERVER_PATTERN}|{_PATH_PATTERN})[^\s\"'<>\\]*$"
"""Addresses of tiles: of any server, whose name is whole, or relative to this service."""


class BaseMap(BaseModel):
    """A base map of XYZ tiles in Web Mercator.

    Attributes
    ----------
    title
        The name that users choose it by.
    tiles
        The address of its tiles with ``{z}``, ``{x}`` and ``{y}``; without a server it is relative to this service.
    attribution
        The HTML of its attribution on the map.
    maxzoom
        The largest zoom that has tiles of 256 pixels.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    title: str = Field(min_length=1, max_length=40)
    tiles: str = Field(max_length=1000, pattern=TILES_PATTERN)
    attribution: str = Field(default="", max_length=1000)
    maxzoom: int = Field(default=19, ge=0, le=30)

    @field_validator("tiles")
    @classmethod
    def _check_places(cls, value: str) -> str:
        if not all(part in value for part in ("{z}", "{x}", "{y}")):
            raise PydanticCustomError("tiles", "an address with {{z}}, {{x}} and {{y}}")
        return value

    @property
    def origin(self) -> str | None:
        """Scheme and host of the tiles, such as https://example.org; ``None`` for this service."""
        parts = urlsplit(self.tiles)
        return f"{parts.scheme}://{parts.netloc}" if parts.scheme else None


def parse_base_maps(value: Any) -> Any:
    """Return the items of a text of JSON, and any other value unchanged. Raises a pydantic error for another text."""
    if not isinstance(value, str):
        return value
    try:
        items = json.loads(value)
    except ValueError:
        items = None
    if not isinstance(items, list):
        raise PydanticCustomError("base_maps", "{allowed}", {"allowed": ALLOWED_BASE_MAPS})
    return tuple(items)


def tile_sources(base_maps: Iterable[BaseMap], has_others: bool) -> str:
    """Return the sources of a Content-Security-Policy for tiles: this service, and servers of base maps.

    ``has_others``: users may name any server.
    """
    origins = ("https:", "http:") if has_others else sorted({base_map.origin for base_map in base_maps if base_map.origin})
    return " ".join(("'self'", *origins))
