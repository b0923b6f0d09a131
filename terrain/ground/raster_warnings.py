"""Warnings about a raster of heights that can be drawn but looks wrong."""

from __future__ import annotations

from skugga.terrain.ground.collar import collar_of
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.overview import command_for
from skugga.terrain.level.level_source import remedy

FEET_WARNING = (
    "x and y are in feet, but heights have no unit and are read as metres. If they are feet, too, write terrain: {units: ft} or "
    "us-ft (of a raster without a level file: --units ft), otherwise units: m"
)


def raster_warnings(elevation: Elevation) -> tuple[str, ...]:
    """Return the warnings about a raster, each with its remedy."""
    collar, vertical = collar_of(elevation), elevation.vertical
    in_feet = any("foot" in (axis.unit_name or "").lower() for axis in elevation.crs.axis_info)
    return (
        *(() if collar is None else (collar.warning,)),
        *elevation.unmarked.warnings(vertical, None if collar is None else collar.value),
        *((_of_nodata(elevation),) if elevation.impossible_nodata else ()),
        *((_of_overviews(elevation),) if elevation.lacks_overviews else ()),
        *((FEET_WARNING,) if in_feet and vertical.unit_from is None else ()),
        *((_of_units(elevation),) if vertical.other_unit else ()),
    )


def _of_overviews(elevation: Elevation) -> str:
    return (
        f"the raster of {elevation.rows * elevation.cols / 1e6:,.0f} million cells lacks overviews, so zoomed-out tiles read "
        f"most of it. Make overviews beside it with '{command_for(elevation.name)}'"
    )


def _of_nodata(elevation: Elevation) -> str:
    return (
        f"the raster declares nodata {elevation.impossible_nodata}, which no cell of type {elevation.dtype} can have. "
        f"If another value means no data, {remedy('nodata', 'VALUE')}"
    )


def _of_units(elevation: Elevation) -> str:
    return f"{elevation.vertical.statement}, but {elevation.vertical.other_unit}. State the right unit: {remedy('units', 'UNIT')}"
