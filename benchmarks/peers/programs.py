"""Programs that compute a shadow mask of a raster with one tool. `benchmarks.peers` runs them as processes, in any interpreter.

    PYTHON programs.py TOOL dem.tif AZIMUTH ALTITUDE mask.tif [LINES]
    PYTHON programs.py --version PACKAGE MODULE

A program reads the raster, compiles its loops on a few cells, computes the mask, and writes 1 where the sun is visible and 0
elsewhere. It prints the seconds of computing. Only the program ``sweep`` imports Skugga, so the other packages may be installed in
an environment of their own. ``r.horizon`` runs inside a GRASS session, and writes angles.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    MaskFunction = Callable[[float, float], np.ndarray]
    """A function of azimuth, clockwise from north, and altitude, degrees; it returns where the sun is visible (rows, cols)."""

TINY_CELLS = 64
"""Cells a side of the terrain that loops are compiled on."""

COMPILED_PROGRAMS = ("insolation", "sweep")
"""Programs whose loops are compiled on the first call."""


def insolation(path: str, height_m: np.ndarray, cell_m: float) -> MaskFunction:
    """Return a function of a sun that computes Corripio's mask: a running maximum along lines from the border.

    Its y axis points south.
    """
    import numpy as np
    from insolation import insolf

    def compute_mask(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
        azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
        to_sun_south = np.array([np.sin(azimuth) * np.cos(altitude), -np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
        return insolf.doshade(height_m, cell_m, to_sun_south)

    return compute_mask


def topocalc(path: str, height_m: np.ndarray, cell_m: float) -> MaskFunction:
    """Return a function of a sun that computes a mask from horizons after Dozier and Frew.

    The package returns sines of horizon angles. Its azimuths are 0 in the south and positive in the east, within 180 degrees.
    """
    import numpy as np
    from topocalc.horizon import horizon

    height_m = height_m.astype(np.float64)

    def compute_mask(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
        from_south_deg = (360.0 - azimuth_deg) % 360.0 - 180.0
        return horizon(from_south_deg, height_m, cell_m) <= np.sin(np.radians(altitude_deg))

    return compute_mask


def solweig(path: str, height_m: np.ndarray, cell_m: float) -> MaskFunction:
    """Return a function of a sun that computes a mask as the maximum of shifted copies of the terrain.

    It runs on the CPU, because its GPU path is slower on software devices.
    """
    os.environ["SOLWEIG_NO_GPU"] = "1"
    import numpy as np
    from solweig.rustalgos import shadowing

    shadowing.disable_gpu()

    def compute_mask(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
        shadows = shadowing.calculate_shadows_wall_ht_25(azimuth_deg, altitude_deg, cell_m, float(np.ptp(height_m)), height_m)
        return shadows.bldg_sh > 0.5

    return compute_mask


def whitebox(path: str, height_m: np.ndarray, cell_m: float) -> MaskFunction:
    """Return a function of a sun that computes a mask from horizon angles in degrees. The package has a raster type of its own."""
    from whitebox_workflows import WbEnvironment

    environment = WbEnvironment()
    raster = environment.read_raster(path)

    def compute_mask(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
        return environment.horizon_angle(raster, azimuth_deg).to_numpy() <= altitude_deg

    return compute_mask


def sweep(path: str, height_m: np.ndarray, cell_m: float) -> MaskFunction:
    """Return a function of a sun that computes the mask by Skugga's line sweep, on all cores.

    The last argument of the command line is the number of lines per cell.
    """
    from skugga.shadows.sweep.grid import sunlit_nodes

    lines, cores = int(sys.argv[6]), os.cpu_count() or 1
    return lambda azimuth_deg, altitude_deg: sunlit_nodes(height_m, cell_m, azimuth_deg, altitude_deg, lines=lines, cores=cores)


MASK_FUNCTION_FACTORIES: dict[str, Callable[[str, np.ndarray, float], MaskFunction]] = {
    "insolation": insolation,
    "topocalc": topocalc,
    "solweig": solweig,
    "whitebox": whitebox,
    "sweep": sweep,
}
"""Functions of a raster's path, heights (rows, cols) and cell side in metres, by name of the program."""


def write_mask(name: str, path: str, azimuth_deg: float, altitude_deg: float, out: str) -> float:
    """Write the mask of a raster by the tool ``name``, and return the seconds of computing."""
    import numpy as np
    import rasterio

    with rasterio.open(path) as source:
        height_m, cell_m, profile = source.read(1), source.transform.a, source.profile
    if name in COMPILED_PROGRAMS:
        tiny_m = np.random.default_rng(1).random((TINY_CELLS, TINY_CELLS), np.float32)
        MASK_FUNCTION_FACTORIES[name](path, tiny_m, cell_m)(azimuth_deg, altitude_deg)
    compute_mask = MASK_FUNCTION_FACTORIES[name](path, height_m, cell_m)
    start = time.perf_counter()
    lit = compute_mask(azimuth_deg, altitude_deg)
    taken_s = time.perf_counter() - start
    with rasterio.open(out, "w", **{**profile, "dtype": "uint8", "nodata": None}) as target:
        target.write(np.asarray(lit, np.uint8).reshape(height_m.shape), 1)
    return taken_s


def write_horizon_angles(path: str, azimuth_deg: float, out: str) -> float:
    """Write horizon angles in degrees with GRASS r.horizon, inside a GRASS session. Return the seconds that the module takes.

    Its directions are 0 in the east and grow anticlockwise.
    """

    def grass(*arguments: str) -> str:
        return subprocess.run(arguments, check=True, capture_output=True, text=True).stdout

    grass("r.in.gdal", "--quiet", f"input={path}", "output=dem")
    grass("g.region", "raster=dem")
    start = time.perf_counter()
    grass("r.horizon", "-d", "--quiet", "elevation=dem", f"direction={(90.0 - azimuth_deg) % 360.0:g}", "output=horizon")
    taken_s = time.perf_counter() - start
    raster_name = grass("g.list", "type=raster", "pattern=horizon*").split()[0]
    grass("r.out.gdal", "-c", "--quiet", "--overwrite", f"input={raster_name}", f"output={out}", "type=Float32")
    return taken_s


def main(arguments: list[str]) -> Any:
    """Run the program of the command line, and return what it prints: the package's version, or seconds of computing."""
    if arguments[0] == "--version":
        importlib.import_module(arguments[2])
        return version(arguments[1])
    name, path, azimuth_deg, altitude_deg, out, *_ = arguments
    if name == "r.horizon":
        return write_horizon_angles(path, float(azimuth_deg), out)
    return write_mask(name, path, float(azimuth_deg), float(altitude_deg), out)


if __name__ == "__main__":
    print(main(sys.argv[1:]))
