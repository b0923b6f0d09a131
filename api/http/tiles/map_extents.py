"""Parse and check the extent of a map: CRS codes, axis order, bounding boxes and sizes."""

from __future__ import annotations

import re

import numpy as np
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError

from skugga.api.http.numbers import parse_decimal
from skugga.api.http.state.served_levels import ServedLevel
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.geo.axes import check_axes
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
from skugga.terrain.scene import MAX_PERSPECTIVE_SIDE_PX

MapBounds = tuple[float, float, float, float]
"""Type of an extent: west, south, east, north in units of a CRS, always with x first."""

DEFAULT_SIDE_PX = 1024
"""Longer side in pixels of a map whose request has no size."""

CRS_DESCRIPTION = "a projected or geographic CRS by its code, as EPSG:3857 or OGC:CRS84"

_CODE_PATTERN = re.compile(r"(EPSG|ESRI|OGC|IGNF):(?::)?[A-Za-z0-9]{1,16}", re.IGNORECASE)
_URN_PATTERN = re.compile(r"urn:ogc:def:crs:(\w+):[\w.]*:(\w+)", re.IGNORECASE)
_WMS_CRS_CODES = {"CRS:84": "OGC:CRS84", "CRS:83": "OGC:CRS83", "CRS:27": "OGC:CRS27"}
"""PROJ's codes of the CRSs of longitude and latitude that WMS 1.3.0 names in B.3 to B.5."""


def crs_code(text: str) -> str:
    """Return the code of a CRS as PROJ spells it, such as EPSG:3857.

    ``text`` may be a code, an EPSG number, a URN (``urn:ogc:def:crs``), or a name that WMS defines, such as CRS:84. Raises
    ``InputError`` for other texts. PROJ would accept some of them as names of files.
    """
    urn = _URN_PATTERN.fullmatch(text)
    code = _WMS_CRS_CODES.get(
        text.upper(), f"{urn[1]}:{urn[2]}" if urn else f"EPSG:{text}" if text.isascii() and text.isdigit() else text
    )
    if not _CODE_PATTERN.fullmatch(code):
        raise InputError("crs", text, CRS_DESCRIPTION)
    return code.upper()


@cached("process", MIB, size_of=lambda _: 2**14)
def crs_of_code(code: str) -> CRS:
    """Return the CRS of a code from ``crs_code``. Raises ``InputError`` if it is unknown, or neither projected nor geographic."""
    try:
        crs = CRS.from_user_input(code)
    except CRSError:
        raise InputError("crs", code, CRS_DESCRIPTION) from None
    if not (crs.is_projected or crs.is_geographic):
        raise InputError("crs", code, CRS_DESCRIPTION)
    check_axes("crs", crs)
    return crs


def is_north_first(crs: CRS) -> bool:
    """Return whether a CRS's first axis is northing or latitude. WMS 1.3.0 orders extents by the axes of the CRS."""
    name = crs.axis_info[0].name.lower() if crs.axis_info else ""
    return "northing" in name or "latitude" in name


def parse_bounds(text: str, name: str = "bbox", is_south_first: bool = False) -> MapBounds:
    """Return (west, south, east, north) from a text of four numbers with commas.

    The text has the same order, or south, west, north, east if ``is_south_first`` is set. Raises ``InputError``, which names the
    parameter ``name``.
    """
    values = [value for part in text.split(",") if (value := parse_decimal(part)) is not None]
    if len(values) != 4 or text.count(",") != 3:
        raise InputError(
            name, text[:100], "four numbers: " + ("south,west,north,east" if is_south_first else "west,south,east,north")
        )
    west, south, east, north = (values[i] for i in ((1, 0, 3, 2) if is_south_first else (0, 1, 2, 3)))
    if not (west < east and south < north):
        raise InputError(name, text[:100], "west < east and south < north, in the order of the CRS's axes")
    if max(map(abs, values)) > 1e9:
        raise InputError(name, text[:100], "coordinates between -1e9 and 1e9")
    return west, south, east, north


def bounds_in(level: ServedLevel, crs: CRS) -> MapBounds:
    """Return the bounds of a level in units of a CRS.

    Raises ``InputError`` if the CRS does not cover the level, or if the level is not on the earth.
    """
    if level.bounds is None:
        raise UnsupportedError("level", level.name, f"{level.world.off_earth_reason}, so its maps have no CRS and no bbox")
    try:
        west, south, east, north = transformer(LONGITUDE_LATITUDE, crs).transform_bounds(*level.bounds, densify_pts=21)
    except ProjError:
        west = south = east = north = np.inf
    if not (np.isfinite([west, south, east, north]).all() and west < east and south < north):
        raise InputError("crs", crs.name, "a CRS that covers the level")
    return west, south, east, north


def map_size(width: int | None, height: int | None, aspect: float) -> tuple[int, int]:
    """Return (width, height) of a map in pixels.

    A missing side follows from the other one by ``aspect`` (width / height). If both are missing, the longer side is
    ``DEFAULT_SIDE_PX``.
    """
    if width is None and height is None:
        width, height = (DEFAULT_SIDE_PX, None) if aspect >= 1.0 else (None, DEFAULT_SIDE_PX)
    if width is None:
        assert height is not None
        return max(round(height * aspect), 1), height
    return width, height or max(round(width / aspect), 1)


def check_side(name: str, pixels: int) -> int:
    """Return the width or height of a map in pixels after a check. Raises ``InputError`` about the parameter ``name``."""
    if not 1 <= pixels <= MAX_PERSPECTIVE_SIDE_PX:
        raise InputError(name, pixels, f"1 to {MAX_PERSPECTIVE_SIDE_PX} pixels")
    return pixels
