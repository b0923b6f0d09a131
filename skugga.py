"""Skugga for users of Python: true cast shadows of terrain, from arrays, rasters and level files.

    import skugga

    dark = skugga.shadow(height_m, 30.0, azimuth_deg=250.0, altitude_deg=12.0)
    with skugga.open_level("dem.tif") as level:
        mask = level.shade("mask", time="2024-03-21T09:00:00+01:00")
        hours = level.sun_hours("2024-03-21")
        day = level.point(7.45, 46.02, date="2024-12-21").day

With xarray and rioxarray installed, ``import skugga`` gives every DataArray of heights the accessor ``da.skugga``.
"""

from __future__ import annotations

from api.library.arrays import shadow
from api.library.arrays import sun_hours_of_array as sun_hours
from api.library.opened_level import OpenLevel, open_heights, open_level
from shadows.sweep.grid import sunlit
from shadows.sweep.horizon import horizon_deg as horizon
from terrain.errors import SkuggaError

__all__ = ["OpenLevel", "SkuggaError", "horizon", "open_heights", "open_level", "shadow", "sun_hours", "sunlit"]

try:
    import api.library.accessor  # noqa: F401  # registers ``da.skugga``
except ImportError:  # without xarray, rioxarray
    pass
