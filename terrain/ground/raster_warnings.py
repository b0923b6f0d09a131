"""Warnings about a raster of heights that can be drawn but looks wrong."""

from __future__ import annotations

from skugga.terrain.ground.collar import detect_collar
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.overview import overviews_command
from skugga.terrain.level.level_source import option_remedy

FEET_WARNING = (
    "x and y are in feet, but heights have no unit and are read as metres. If they are feet, too, "
    f"{option_remedy('units', 'ft')}, or us-ft; otherwise m"
)


def raster_warnings(elevation: Elevation) -> tuple[str, ...]:
    """Return the warnings about a raster, each with its remedy."""
    collar, vertical = detect_collar(elevation), elevation.vertical
    in_feet = any("foot" in (axis.unit_name or "").lower() for axis in elevation.crs.axis_info)
    return (
        *(() if collar is None else (collar.warning,)),
        *elevation.undeclared_nodata.warnings(vertical, None if collar is None else collar.value),
        *((_nodata_warning(elevation),) if elevation.impossible_nodata else ()),
        *((_overviews_warning(elevation),) if elevation.lacks_overviews and not is_in_memory(elevation.name) else ()),
        *((FEET_WARNING,) if in_feet and vertical.unit_source is None else ()),
        *((_units_warning(elevation),) if vertical.conflicting_unit else ()),
    )


def is_in_memory(source: str) -> bool:
    """Return whether a raster is a file in memory, which commands cannot reach."""
    return source.startswith("/vsimem/")


def _overviews_warning(elevation: Elevation) -> str:
    """Return the warning about a large raster without overviews."""
    return (
        f"the raster of {elevation.rows * elevation.cols / 1e6:,.0f} million cells lacks overviews, so zoomed-out tiles read "
        f"most of it. Make overviews beside it with '{overviews_command(elevation.name)}'"
    )


def _nodata_warning(elevation: Elevation) -> str:
    """Return the warning about a declared nodata value that no cell can have."""
    return (
        f"the raster declares nodata {elevation.impossible_nodata}, which no cell of type {elevation.dtype} can have. "
        f"If another value means no data, {option_remedy('nodata', 'VALUE')}"
    )


def _units_warning(elevation: Elevation) -> str:
    """Return the warning about two units of heights that contradict each other."""
    return (
        f"{elevation.vertical.statement}, but {elevation.vertical.conflicting_unit}. State the right unit: "
        f"{option_remedy('units', 'UNIT')}"
    )
