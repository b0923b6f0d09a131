"""Programs that compute the beam of a period without air on the ground's own slope with one tool.

`benchmarks.irradiation` runs them as processes, in any interpreter:

    PYTHON programs.py skugga dem.tif out.npy FIRST LAST MINUTES
    PYTHON programs.py r.sun dem.tif out.tif DAY HOURS PLANE [DEGREES [clamped]]
    PYTHON programs.py saga dem.tif out.tif FIRST LAST LATITUDE SHADOW HOURS
    PYTHON programs.py insolation dem.tif out.npy SUNS
    PYTHON programs.py surtgis dem.tif out.npy LATITUDE DAY

FIRST and LAST are dates, DAY is the number of a day of the year, HOURS are those between two suns. A program reads the raster,
computes, writes the result in a unit of its own, and prints the seconds of computing. ``r.sun`` runs inside a GRASS session. Only
``skugga`` imports Skugga.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

SAGA_CHAIN = """<?xml version="1.0" encoding="UTF-8"?>
<toolchain saga-version="8.5.0">
  <group>irradiation</group>
  <identifier>beam</identifier>
  <name>Beam</name>
  <author>Skugga</author>
  <description>Potential Incoming Solar Radiation of given dates</description>
  <parameters>
    <option varname="GRID_SYSTEM" type="grid_system"><name>Grid System</name></option>
    <input varname="DEM" type="grid" parent="GRID_SYSTEM"><name>Elevation</name></input>
    <output varname="DIRECT" type="grid" parent="GRID_SYSTEM"><name>Direct</name></output>
  </parameters>
  <tools>
    <tool library="ta_lighting" tool="2" name="Potential Incoming Solar Radiation">
      <option id="PARAMETERS_GRID_SYSTEM" varname="true">GRID_SYSTEM</option>
      <input id="GRD_DEM">DEM</input>
      <output id="GRD_DIRECT">DIRECT</output>
      <output id="GRD_DIFFUS">DIFFUSE</output>
{options}
    </tool>
  </tools>
</toolchain>
"""
"""Tool chain of SAGA. The dates are options in it, because ``saga_cmd`` 8.5 ignores them on the command line and takes today."""


def _read(path: str) -> tuple[np.ndarray, float]:
    """Return the heights of a raster file, float64 (rows, cols), and the side of its cells in metres."""
    import numpy as np
    import rasterio

    with rasterio.open(path) as source:
        return source.read(1).astype(np.float64), source.transform.a


def skugga(path: str, out: str, first: str, last: str, minutes: str) -> float:
    """Compute Skugga's beam, kWh/m2, with the loops compiled."""
    from datetime import date

    import numpy as np

    from benchmarks.irradiation.constant_light import without_air
    from benchmarks.irradiation.hill_raster import view_of_cells
    from skugga.shadows.irradiation.dates import all_dates
    from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
    from skugga.terrain.geo.clock import SOLAR
    from skugga.terrain.geo.daily_windows import windows_between
    from skugga.terrain.level.level import load_level
    from skugga.terrain.scene import build_scene

    scene = build_scene(load_level(Path(path)))
    start = time.perf_counter()
    windows = windows_between(scene.world, date.fromisoformat(first), date.fromisoformat(last), 1, (0.0, 1440.0), SOLAR)
    with without_air():
        rules = IrradiationRules(("beam",), step_minutes=float(minutes), begin_later_each_day=True)
        (beam,) = irradiation(scene, view_of_cells(scene), all_dates(windows), rules)
    taken_s = time.perf_counter() - start
    np.save(out, beam)
    scene.close()
    return taken_s


def _grass(*arguments: str) -> None:
    """Run a command of GRASS. Raises ``RuntimeError`` with its last line if it fails."""
    process = subprocess.run(arguments, capture_output=True, text=True)
    if process.returncode:
        raise RuntimeError(f"{arguments[0]}: {(process.stderr.strip().splitlines() or ['no output'])[-1]}")


def r_sun(path: str, out: str, day: str, hours: str, plane: str, degrees: str = "", clamped: str = "") -> float:
    """Compute GRASS's beam of a day, Wh/m2, on two threads, with a turbidity of 0.

    ``plane`` is ``ground``, its own slope, or ``level``. With ``degrees``, r.sun reads horizon maps at azimuth steps of so many
    degrees. Without, it walks along its own rays. With ``clamped``, negative horizons are made 0 before.
    """
    _grass("r.in.gdal", "--quiet", f"input={path}", "output=dem")
    _grass("g.region", "raster=dem")
    options = ["elevation=dem", "linke_value=0", f"day={day}", f"step={hours}", "nprocs=2"]
    start = time.perf_counter()
    if plane == "ground":
        _grass("r.slope.aspect", "--quiet", "elevation=dem", "slope=slope", "aspect=aspect")
        options += ["slope=slope", "aspect=aspect"]
    if degrees:
        _grass("r.horizon", "--quiet", "elevation=dem", f"step={degrees}", "output=horizon")
        options += ["horizon_basename=horizon", f"horizon_step={degrees}"]
        if clamped:
            names = [f"{direction:03d}" for direction in range(0, 360, int(degrees))]
            clamped_maps = "\n".join(f"clamped_{name} = max(horizon_{name}, 0)" for name in names)
            _grass("r.mapcalc", "--quiet", f"expression={clamped_maps}")
            options[-2] = "horizon_basename=clamped"
    _grass("r.sun", "--quiet", *options, "beam_rad=beam")
    taken_s = time.perf_counter() - start
    _grass("r.out.gdal", "-c", "--quiet", "--overwrite", "input=beam", f"output={out}", "type=Float32")
    return taken_s


def saga(path: str, out: str, first: str, last: str, latitude: str, shadow: str, hours: str) -> float:
    """Compute SAGA's direct insolation, kWh/m2, with a transmittance of 100 %. It takes every fifth of several dates, its default.

    The seconds are those of its process.
    """
    values = {
        "LOCATION": "0", "LATITUDE": latitude, "PERIOD": "1" if first == last else "2", "DAY": first, "DAY_STOP": last,
        "HOUR_STEP": hours, "METHOD": "2", "LUMPED": "100", "SHADOW": shadow,
    }  # fmt: skip
    folder = Path(out).parent / "saga_chains"
    folder.mkdir(exist_ok=True)
    options = "\n".join(f'      <option id="{name}">{value}</option>' for name, value in values.items())
    (folder / "irradiation.xml").write_text(SAGA_CHAIN.format(options=options), "utf-8")
    start = time.perf_counter()
    command = ["saga_cmd", "-f=s", "irradiation", "beam", "-DEM", path, "-DIRECT", out]
    process = subprocess.run(command, capture_output=True, text=True, env=os.environ | {"SAGA_TLB": str(folder)})
    if process.returncode:
        raise RuntimeError(f"saga_cmd: {(process.stdout.strip().splitlines() or ['no output'])[-1]}")
    return time.perf_counter() - start


def insolation(path: str, out: str, suns: str) -> float:
    """Add up the package's hillshading of cells without its cast shadow, kWh/m2 of a beam of 1000 W/m2.

    ``suns`` is a file of azimuths, altitudes and hours (3, n).
    """
    import numpy as np
    from insolation import insolf

    height_m, cell_m = _read(path)
    start = time.perf_counter()
    total = np.zeros(height_m.shape)
    for azimuth, altitude, hours in np.load(suns).T:
        towards = insolf.normalvector(90.0 - altitude, azimuth)
        total += hours * np.maximum(insolf.hillshading(height_m, cell_m, towards), 0.0) * insolf.doshade(height_m, cell_m, towards)
    taken_s = time.perf_counter() - start
    np.save(out, total)
    return taken_s


def surtgis(path: str, out: str, latitude: str, day: str) -> float:
    """Compute SurtGIS's radiation of a day, Wh/m2: the sum of direct and diffuse light under its own air."""
    import numpy as np
    import surtgis as package

    height_m, cell_m = _read(path)
    start = time.perf_counter()
    total = package.solar_radiation_compute(height_m, cell_m, float(latitude), int(day))
    taken_s = time.perf_counter() - start
    np.save(out, total)
    return taken_s


PROGRAMS = {"skugga": skugga, "r.sun": r_sun, "saga": saga, "insolation": insolation, "surtgis": surtgis}

if __name__ == "__main__":
    print(f"\n{PROGRAMS[sys.argv[1]](*sys.argv[2:]):.6f}")
