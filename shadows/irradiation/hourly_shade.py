"""The hours of a month at which cells see the sun, a bit for each day, in the form of the Solar API's ``hourlyShade``."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from skugga.shadows.irradiation.dates import Dates
from skugga.shadows.irradiation.direct import DirectLight
from skugga.shadows.irradiation.suns import sun_intervals
from skugga.shadows.irradiation.surfaces import block_surfaces
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

HOURS_PER_DAY = 24

NODATA = -9999


def hourly_shade(scene: Scene, view: MapView, dates: Dates, on_date: Callable[[], None] = lambda: None) -> np.ndarray:
    """Return which hours of which days see the sun at a block's cells, int32 (24, rows, cols); ``NODATA`` without ground.

    ``dates`` are days of one month. Bit d - 1 of hour h is set where the sun of hour h, in the middle of the time that it is up in
    the hour, is seen on day d. Trees are opaque. ``on_date()`` is called after each date. Raises ``InputError`` for years outside
    of the sun's ephemeris.
    """
    surfaces = block_surfaces(scene, view, "level", 0.0)
    out = np.zeros((HOURS_PER_DAY, view.rows, view.cols), np.int32)
    shown = np.isfinite(surfaces.height_m)
    if shown.any():
        row, col = view.centre_node
        lon, lat = (float(axis) for axis in scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row)))
        suns = sun_intervals(dates.windows, 60.0, lon, lat)
        date_of, starts = dates.date_numbers(suns.moments), dates.starts
        light = DirectLight(scene, surfaces, np.zeros(shown.shape, np.float32))
        for number, window in enumerate(dates.windows):
            for sun in np.flatnonzero(date_of == number):
                elapsed_min = (suns.moments[sun] - starts[number]) / np.timedelta64(1, "m")
                hour = int(window.clock_time_min(float(elapsed_min)) // 60.0) % HOURS_PER_DAY
                out[hour] |= np.left_shift(light.lit_cells(suns, int(sun)).astype(np.int32), window.date.day - 1)
            on_date()
    out[:, ~shown] = NODATA
    return out
