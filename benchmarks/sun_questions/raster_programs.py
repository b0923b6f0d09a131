"""Programs that compute horizons or sky view factors of a whole raster with one tool.

`sun_questions` runs them as processes, in any interpreter:

    PYTHON raster_programs.py horizons dem.tif out.npy COUNT
    PYTHON raster_programs.py sky_view dem.tif out.npy COUNT KIND
    PYTHON raster_programs.py TOOL_horizons dem.tif out.npy COUNT [FIRST STRIDE]
    PYTHON raster_programs.py TOOL_sky_view dem.tif out.npy COUNT [RADIUS]
    PYTHON raster_programs.py r.horizon dem.tif out.npy COUNT POINTS
    PYTHON raster_programs.py r.skyview dem.tif out.tif COUNT

COUNT azimuths go clockwise round the grid's north, the first of them north. A program for horizons computes the azimuths FIRST,
FIRST + STRIDE and so on of them, and writes degrees, float32 (azimuths, rows, cols). RADIUS is in cells. A program reads the
raster, computes, writes the result, and prints the seconds of computing, which include those of compiling loops. ``r.horizon`` and
``r.skyview`` run inside a GRASS session. Only ``horizons`` and ``sky_view`` import Skugga.
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def _read(path: str) -> tuple[np.ndarray, float]:
    """Return the heights of a raster file, float32 (rows, cols), and the side of its cells in metres."""
    import numpy as np
    import rasterio

    with rasterio.open(path) as source:
        return source.read(1).astype(np.float32), source.transform.a


def _timed(compute: Callable[[], np.ndarray], out: str) -> float:
    """Write the result of ``compute`` as float32, and return the seconds of computing."""
    import numpy as np

    start = time.perf_counter()
    result = compute()
    taken_s = time.perf_counter() - start
    np.save(out, np.asarray(result, np.float32))
    return taken_s


def _azimuths(count: str, first: str, stride: str) -> list[float]:
    """Return some of ``count`` azimuths, degrees."""
    return [360.0 * k / int(count) for k in range(int(first), int(count), int(stride))]


def horizons(path: str, out: str, count: str) -> float:
    """Compute Skugga's horizons."""
    import skugga

    height_m, cell_m = _read(path)
    return _timed(lambda: skugga.horizons(height_m, cell_m, azimuths=int(count)), out)


def sky_view(path: str, out: str, count: str, kind: str) -> float:
    """Compute Skugga's sky view factors of a kind."""
    import skugga

    height_m, cell_m = _read(path)
    return _timed(lambda: skugga.sky_view(height_m, cell_m, kind=kind, azimuths=int(count)), out)


def topocalc_horizons(path: str, out: str, count: str, first: str = "0", stride: str = "1") -> float:
    """Compute horizons by topocalc, which returns their sines. Its azimuths are 0 in the south and positive in the east."""
    import numpy as np
    from topocalc.horizon import horizon

    height_m, cell_m = _read(path)
    heights = height_m.astype(np.float64)

    def compute() -> np.ndarray:
        directions = [(360.0 - azimuth) % 360.0 - 180.0 for azimuth in _azimuths(count, first, stride)]
        return np.stack([np.degrees(np.arcsin(horizon(direction, heights, cell_m))).astype(np.float32) for direction in directions])

    return _timed(compute, out)


def topocalc_sky_view(path: str, out: str, count: str) -> float:
    """Compute topocalc's sky view factors."""
    import numpy as np
    from topocalc.viewf import viewf

    height_m, cell_m = _read(path)
    return _timed(lambda: viewf(height_m.astype(np.float64), cell_m, nangles=int(count))[0], out)


def surtgis_horizons(path: str, out: str, count: str, first: str = "0", stride: str = "1") -> float:
    """Compute horizons by SurtGIS to the raster's rim. It returns radians."""
    import numpy as np
    import surtgis

    height_m, cell_m = _read(path)
    heights, reach_cells = height_m.astype(np.float64), int(np.ceil(np.hypot(*height_m.shape)))

    def compute() -> np.ndarray:
        return np.stack([
            np.degrees(surtgis.horizon_angle_map_compute(heights, cell_m, azimuth, reach_cells)).astype(np.float32)
            for azimuth in _azimuths(count, first, stride)
        ])  # fmt: skip

    return _timed(compute, out)


def surtgis_sky_view(path: str, out: str, count: str, radius: str) -> float:
    """Compute SurtGIS's sky view factors."""
    import numpy as np
    import surtgis

    height_m, cell_m = _read(path)
    return _timed(lambda: surtgis.sky_view_factor_compute(height_m.astype(np.float64), cell_m, int(count), int(radius)), out)


def whitebox_horizons(path: str, out: str, count: str, first: str = "0", stride: str = "1") -> float:
    """Compute horizons by Whitebox Workflows."""
    import numpy as np
    from whitebox_workflows import WbEnvironment

    environment = WbEnvironment()
    raster = environment.read_raster(path)

    def compute() -> np.ndarray:
        return np.stack([
            np.asarray(environment.horizon_angle(raster, azimuth).to_numpy(), np.float32)
            for azimuth in _azimuths(count, first, stride)
        ])  # fmt: skip

    return _timed(compute, out)


def rvt_sky_view(path: str, out: str, count: str, radius: str) -> float:
    """Compute the sky view factors of the Relief Visualization Toolbox, without its removal of noise."""
    import rvt.vis

    height_m, cell_m = _read(path)
    return _timed(lambda: rvt.vis.sky_view_factor(height_m, cell_m, svf_n_dir=int(count), svf_r_max=int(radius))["svf"], out)


def xrspatial_sky_view(path: str, out: str, count: str, radius: str) -> float:
    """Compute xarray-spatial's sky view factors."""
    import xarray
    from xrspatial.sky_view_factor import sky_view_factor

    height_m, cell_m = _read(path)
    raster = xarray.DataArray(height_m, dims=("y", "x"), attrs={"res": (cell_m, cell_m)})
    return _timed(lambda: sky_view_factor(raster, max_radius=int(radius), n_directions=int(count)).to_numpy(), out)


def _grass(*arguments: str, stdin: str = "") -> str:
    """Run a command of GRASS, and return its standard output. Raises ``RuntimeError`` with its last line if it fails."""
    process = subprocess.run(arguments, input=stdin, capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(f"{arguments[0]}: {(process.stderr.strip().splitlines() or ['no output'])[-1]}")
    return process.stdout


def _import_dem(path: str) -> None:
    """Import a raster file into the GRASS session as the map ``dem``, and set the session's region to it."""
    _grass("r.in.gdal", "--quiet", f"input={path}", "output=dem")
    _grass("g.region", "raster=dem")


def r_horizon(path: str, out: str, count: str, points: str) -> float:
    """Compute GRASS's horizons as raster maps, and write those of n points, degrees (n, azimuths).

    A line of the file ``points`` has an easting and a northing. The directions of GRASS are 0 in the east and grow anticlockwise.
    """
    import numpy as np

    _import_dem(path)
    directions = [(90.0 - azimuth) % 360.0 for azimuth in _azimuths(count, "0", "1")]
    start = time.perf_counter()
    _grass("r.horizon", "-d", "--quiet", "elevation=dem", "output=horizon", f"step={360.0 / int(count):g}")
    taken_s = time.perf_counter() - start
    maps = ",".join(f"horizon_{direction:03.0f}" for direction in directions)
    table = _grass("r.what", f"map={maps}", "separator=,", "null_value=nan", stdin=Path(points).read_text("utf-8"))
    np.save(out, np.array([line.split(",")[-len(directions) :] for line in table.split()], np.float64))
    return taken_s


def r_skyview(path: str, out: str, count: str) -> float:
    """Compute GRASS's sky view factors as its addon r.skyview does: all horizons by r.horizon, then r.mapcalc."""
    _import_dem(path)
    start = time.perf_counter()
    _grass("r.horizon", "-d", "--quiet", "elevation=dem", "output=horizon", f"step={360.0 / int(count):g}")
    names = _grass("g.list", "type=raster", "pattern=horizon_*").split()
    terms = " + ".join(f"sin(max({name}, 0))" for name in names)
    _grass("r.mapcalc", "--quiet", f"expression=sky = 1 - ({terms}) / {len(names)}.")
    taken_s = time.perf_counter() - start
    _grass("r.out.gdal", "-cf", "--quiet", "--overwrite", "input=sky", f"output={out}", "type=Float32")
    return taken_s


PROGRAMS: dict[str, Callable[..., float]] = {
    "horizons": horizons,
    "sky_view": sky_view,
    "topocalc_horizons": topocalc_horizons,
    "topocalc_sky_view": topocalc_sky_view,
    "surtgis_horizons": surtgis_horizons,
    "surtgis_sky_view": surtgis_sky_view,
    "whitebox_horizons": whitebox_horizons,
    "rvt_sky_view": rvt_sky_view,
    "xrspatial_sky_view": xrspatial_sky_view,
    "r.horizon": r_horizon,
    "r.skyview": r_skyview,
}

if __name__ == "__main__":
    print(f"\n{PROGRAMS[sys.argv[1]](*sys.argv[2:]):.6f}")
