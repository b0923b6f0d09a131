"""STAC items: the acquisition time, the sun and the cell grid of a satellite scene.

The fields are those of the item specification and of its view and projection extensions:

* ``datetime``, or the middle between ``start_datetime`` and ``end_datetime``;
* ``view:sun_azimuth`` and ``view:sun_elevation``, degrees at the scene's centre;
* ``proj:transform``, ``proj:shape`` and ``proj:code`` (or ``proj:epsg``), of the item or of an asset.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from affine import Affine
from pydantic import ValidationError
from pyproj import CRS
from pyproj.exceptions import CRSError

from skugga.api.raster_file import RasterCells
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.level import parse_sun
from skugga.terrain.level.parts import SunSpec

SUN_FIELDS = ("view:sun_azimuth", "view:sun_elevation")
"""Fields of the sun's angles in degrees: clockwise from true north, and above the horizon."""


@dataclass(frozen=True, eq=False)
class StacItem:
    """The sun and the cell grid of a satellite scene.

    Attributes
    ----------
    sun
        The sun, by its angles or by the acquisition time.
    cells
        The finest cell grid; ``None`` if the item states none.
    """

    sun: SunSpec
    cells: RasterCells | None


def read_stac_item(path: Path) -> StacItem:
    """Read a STAC item. If it states both angles, its sun has these; otherwise the sun follows from the acquisition time.

    Raises ``InputError`` for a file that is not an item, or that has neither angles nor a time. Raises ``OSError`` if it cannot be
    read.
    """
    try:
        item = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise InputError("--stac", Problem(f"{path} is not JSON ({error})"), "Use a STAC item") from None
    if not isinstance(item, dict) or item.get("type") != "Feature" or not isinstance(item.get("properties"), dict):
        kind = item.get("type") if isinstance(item, dict) else None
        raise InputError(
            "--stac", Problem(f"{path} is not a STAC item" + (f" but a {kind}" if kind else "")), "Use JSON of the type Feature"
        )
    return StacItem(_sun(path, item["properties"]), _finest_cells(path, item))


def _sun(path: Path, properties: Mapping[str, Any]) -> SunSpec:
    """Return the sun of an item from its ``properties``: by its angles, or by the acquisition time. Raises ``InputError``."""
    azimuth, elevation = (properties.get(name) for name in SUN_FIELDS)
    if azimuth is not None and elevation is not None:
        try:
            return SunSpec(azimuth=azimuth, altitude=elevation)
        except ValidationError:
            raise InputError(
                f"{path}: {', '.join(SUN_FIELDS)}", f"{azimuth}, {elevation}", "degrees, with an elevation from -90 to 90"
            ) from None
    moments = [
        _sun_at_time(path, name, properties[name])
        for name in ("datetime", "start_datetime", "end_datetime")
        if properties.get(name)
    ]
    if properties.get("datetime"):
        return moments[0]
    if len(moments) == 2:
        start, end = (moment.time for moment in moments)
        assert start is not None and end is not None
        return SunSpec(time=start + (end - start) / 2)
    raise InputError(
        "--stac", Problem(f"{path} has neither a time nor the sun's angles"),
        f"Use an item with datetime, with start_datetime and end_datetime, or with {' and '.join(SUN_FIELDS)}",
    )  # fmt: skip


def _sun_at_time(path: Path, name: str, text: Any) -> SunSpec:
    """Return the sun at the time ``text`` of the field ``name``. Raises ``InputError``."""
    try:
        moment = parse_sun(str(text), None, None)
    except InputError as error:
        raise InputError(f"{path}: {name}", text, error.allowed) from None
    assert moment is not None
    return moment


def _finest_cells(path: Path, item: Mapping[str, Any]) -> RasterCells | None:
    """Return the grid with the smallest cells among those of an item and its assets; ``None`` if they state none."""
    grids = list(_all_cells(path, item))
    return min(grids, key=lambda cells: abs(cells.transform.determinant), default=None)


def _all_cells(path: Path, item: Mapping[str, Any]) -> Iterator[RasterCells]:
    """Yield the cell grids of an item and its assets. Raises ``InputError`` for an invalid one."""
    common = {name: value for name, value in item["properties"].items() if name.startswith("proj:")}
    assets = item.get("assets")
    for asset in ({}, *(assets.values() if isinstance(assets, dict) else ())):
        fields = {**common, **{name: value for name, value in asset.items() if name.startswith("proj:")}}
        code = fields.get("proj:code") or fields.get("proj:epsg")
        transform, shape = fields.get("proj:transform"), fields.get("proj:shape")
        if code is None or transform is None or shape is None:
            continue
        try:
            rows, cols = (int(count) for count in shape)
            a, b, c, d, e, f = (float(number) for number in transform[:6])
            crs = CRS.from_user_input(code)
        except (TypeError, ValueError, CRSError):
            given_text = f"{code}, {transform}, {shape}"
            raise InputError(
                f"{path}: proj:code, proj:transform, proj:shape",
                given_text,
                "a CRS code, a transform of six or nine numbers, and a shape of rows and columns",
            ) from None
        yield RasterCells(str(path), crs, Affine(a, b, c, d, e, f), rows, cols)
