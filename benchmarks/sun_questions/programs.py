"""Programs that answer a question about the sun with one tool. `sun_questions` runs them as processes, in any interpreter.

    PYTHON programs.py sunhours dem.tif hours.tif DATE MINUTES
    PYTHON programs.py time_in_daylight dem.tif share.tif DAY DEGREES
    PYTHON programs.py r.sun dem.tif hours.tif DAY MINUTES [DEGREES]
    PYTHON programs.py point dem.tif horizon.npy X Y
    PYTHON programs.py topocalc dem.tif horizon.npy X Y DEGREES
    PYTHON programs.py r.horizon dem.tif horizon.csv X Y DEGREES DISTANCE

A program reads the raster, compiles or loads its loops, computes, writes the result, and prints the seconds of computing.
``r.sun`` and ``r.horizon`` run inside a GRASS session. Only the programs ``sunhours`` and ``point`` import Skugga.
"""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path


def sunhours(path: str, out: str, date: str, minutes: str) -> float:
    """Compute Skugga's hours of sun as an array. The timed run is the second one, with compiled loops and cached heights."""
    import numpy as np

    from skugga import open_level

    with open_level(path) as level:
        level.sun_hours(date, step_min=60.0)
        start = time.perf_counter()
        hours = level.sun_hours(date, step_min=float(minutes))
        taken_s = time.perf_counter() - start
    np.save(out, np.asarray(hours))
    return taken_s


def time_in_daylight(path: str, out: str, day: str, degrees: str) -> float:
    """Compute Whitebox's share of the day during which a cell is in the sun."""
    import numpy as np
    from whitebox_workflows import WbEnvironment

    environment = WbEnvironment()
    raster = environment.read_raster(path)
    start = time.perf_counter()
    share = environment.time_in_daylight(raster, az_fraction=float(degrees), start_day=int(day), end_day=int(day))
    taken_s = time.perf_counter() - start
    np.save(out, np.asarray(share.to_numpy(), np.float32))
    return taken_s


def _grass(*arguments: str) -> str:
    """Run a command of GRASS, and return its standard output. Raises ``CalledProcessError`` if it fails."""
    return subprocess.run(arguments, check=True, capture_output=True, text=True).stdout


def _import_dem(path: str) -> None:
    """Import a raster file into the GRASS session as the map ``dem``, and set the session's region to it."""
    _grass("r.in.gdal", "--quiet", f"input={path}", "output=dem")
    _grass("g.region", "raster=dem")


def r_sun(path: str, out: str, day: str, minutes: str, degrees: str = "") -> float:
    """Compute GRASS's hours of insolation, on two threads.

    With ``degrees``, r.sun reads horizon maps at azimuth steps of so many degrees. Without, it traces its own rays.
    """
    _import_dem(path)
    options = ["elevation=dem", f"day={day}", f"step={float(minutes) / 60.0:.6f}", "insol_time=hours", "nprocs=2"]
    start = time.perf_counter()
    if degrees:
        _grass("r.horizon", "--quiet", "elevation=dem", f"step={degrees}", "output=horizon")
        options += ["horizon_basename=horizon", f"horizon_step={degrees}"]
    _grass("r.sun", "--quiet", *options)
    taken_s = time.perf_counter() - start
    _grass("r.out.gdal", "-c", "--quiet", "--overwrite", "input=hours", f"output={out}", "type=Float32")
    return taken_s


def point(path: str, out: str, x: str, y: str) -> float:
    """Compute Skugga's horizon in 720 directions.

    An untimed horizon of another point opens the level and compiles the loops first.
    """
    import numpy as np

    from skugga.api.raster_view import raster_view
    from skugga.shadows.point.horizon import horizon_profile, load_surroundings
    from skugga.shadows.point.place import place_at
    from skugga.terrain.level.level import load_level
    from skugga.terrain.scene import build_scene

    scene = build_scene(load_level(Path(path)))
    crs, view = scene.elevation.crs, raster_view(scene).view
    elsewhere = view.grid.x(view.cols / 3.0), view.grid.y(view.rows / 3.0)
    horizon_profile(load_surroundings(scene, place_at(scene, elsewhere, crs)))
    start = time.perf_counter()
    profile = horizon_profile(load_surroundings(scene, place_at(scene, (float(x), float(y)), crs)))
    taken_s = time.perf_counter() - start
    np.save(out, np.stack([profile.azimuth_deg, profile.elevation_deg]))
    scene.close()
    return taken_s


def topocalc(path: str, out: str, x: str, y: str, degrees: str) -> float:
    """Compute the horizons of a whole raster in azimuth steps of ``degrees``, and write those of one cell.

    The package cannot compute single points.
    """
    import numpy as np
    import rasterio
    from topocalc.horizon import horizon

    with rasterio.open(path) as source:
        height_m, cell_m, (row, col) = source.read(1).astype(np.float64), source.transform.a, source.index(float(x), float(y))
    azimuths, sines = np.arange(float(degrees) / 4.0, 360.0, float(degrees)), []
    start = time.perf_counter()
    for azimuth in azimuths:
        sines.append(horizon((360.0 - azimuth) % 360.0 - 180.0, height_m, cell_m)[row, col])
    taken_s = time.perf_counter() - start
    np.save(out, np.stack([azimuths, np.degrees(np.arcsin(sines))]))
    return taken_s


def r_horizon(path: str, out: str, x: str, y: str, degrees: str, distance: str) -> float:
    """Compute GRASS's horizon round a point, in azimuth steps of ``degrees``. ``distance`` is the sampling step, in cells.

    Its directions are 0 in the east and grow anticlockwise.
    """
    _import_dem(path)
    start = time.perf_counter()
    _grass("r.horizon", "-d", "--quiet", "--overwrite", "elevation=dem", "direction=0", f"step={degrees}", f"coordinates={x},{y}",
           f"distance={distance}", f"file={out}")  # fmt: skip
    return time.perf_counter() - start


PROGRAMS = {
    "sunhours": sunhours,
    "time_in_daylight": time_in_daylight,
    "r.sun": r_sun,
    "point": point,
    "topocalc": topocalc,
    "r.horizon": r_horizon,
}

if __name__ == "__main__":
    print(f"\n{PROGRAMS[sys.argv[1]](*sys.argv[2:]):.6f}")
