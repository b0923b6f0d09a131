"""Commands of the tools, their versions, and a raster that every tool accepts."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer

from benchmarks.peers.tools import PROGRAMS_FILE as PEERS_PROGRAMS
from benchmarks.peers.tools import installed_version, write_dem

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS_FILE = Path(__file__).with_name("programs.py")

DATE = "2024-03-21"

SKUGGA_PYTHON = ["env", f"PYTHONPATH={ROOT}", sys.executable]
"""Command that runs Python with this checkout's packages."""

SKUGGA_COMMAND = [*SKUGGA_PYTHON, "-c", "from skugga.api.cli.main import main; main()"]

SKUGGA_RASTER_COMMAND = [*SKUGGA_PYTHON, str(Path(__file__).with_name("raster_programs.py"))]
"""Command that computes horizons or sky view factors of a whole raster with Skugga, with the arguments of ``raster_programs``."""

RASTERS = {
    "Big Tujunga": ("mountain/bigtujunga_30m_utm11.tif", "EPSG:32611", "SRTM of the Big Tujunga catchment, California"),
    "Essen": ("urban/essen_dom1_32_356_5699_1_nw_2020.tif", "EPSG:25832", "surface model of a part of Essen, Germany"),
}
"""File below the folder of data, CRS of its UTM zone, and description, by name of the raster."""

WHOLE_RASTERS = RASTERS | {
    "Quebec": ("forest/quebec_DSM.tif", "EPSG:32619", "surface model of a forest in Quebec"),
}
"""The same of the rasters whose horizons and sky view factors are computed."""


@dataclass(frozen=True)
class QuestionDem:
    """A raster file of heights with square cells, whose middle lies on the central meridian of its UTM zone.

    So grid north is true north within a tenth of a degree.

    Attributes
    ----------
    name, path
        Name and file of the raster.
    height_m
        Heights, float32 (rows, cols).
    cell_m
        Side of a cell, metres.
    crs
        Its CRS.
    middle_m
        Easting and northing of its middle.
    """

    name: str
    path: Path
    height_m: np.ndarray
    cell_m: float
    crs: str
    middle_m: tuple[float, float]

    @cached_property
    def lon_lat(self) -> tuple[float, float]:
        """Longitude and latitude of its middle, degrees."""
        return Transformer.from_crs(self.crs, "EPSG:4326", always_xy=True).transform(*self.middle_m)

    def xy(self, row: int, col: int) -> tuple[float, float]:
        """Return easting and northing of the middle of a cell."""
        rows, cols = self.height_m.shape
        return (
            self.middle_m[0] + (col + 0.5 - cols / 2) * self.cell_m,
            self.middle_m[1] - (row + 0.5 - rows / 2) * self.cell_m,
        )


def write_question_dem(name: str, height_m: np.ndarray, cell_m: float, crs: str, northing_m: float, folder: Path) -> QuestionDem:
    """Write heights as a raster whose middle lies on the central meridian of its zone.

    ``height_m`` is (rows, cols), float32. ``crs`` is a UTM zone. ``northing_m`` is that of the raster's middle.
    """
    path, middle = folder / f"{name.replace(' ', '_')}_{height_m.shape[0]}.tif", (500_000.0, northing_m)
    write_dem(path, height_m, cell_m, crs, middle)
    return QuestionDem(name, path, height_m, cell_m, crs, middle)


def read_dem(data: Path, name: str, side: int | None, folder: Path) -> QuestionDem | None:
    """Read a raster of ``WHOLE_RASTERS``, or its middle of at most ``side`` x ``side`` cells; ``None`` if its file is absent.

    The result is written into ``folder`` as a raster on the central meridian.
    """
    file, crs, _ = WHOLE_RASTERS[name]
    if not (data / file).exists():
        return None
    with rasterio.open(data / file) as source:
        height_m, transform = source.read(1).astype(np.float32), source.transform
    rows, cols = height_m.shape
    northing = transform.f + transform.e * rows / 2
    part_size = [min(side or length, length) for length in (rows, cols)]
    top, left = (rows - part_size[0]) // 2, (cols - part_size[1]) // 2
    part = np.ascontiguousarray(height_m[top : top + part_size[0], left : left + part_size[1]])
    return write_question_dem(name, part, transform.a, crs, northing, folder)


def tool_versions(python: str) -> dict[str, str]:
    """Return the versions of the available tools by name. Python packages are those of the interpreter ``python``."""
    packages = {
        "Whitebox Workflows": "whitebox-workflows whitebox_workflows",
        "topocalc": "topocalc topocalc.horizon",
        "xarray-spatial": "xarray-spatial xrspatial",
        "RVT": "rvt-py rvt.vis",
        "SurtGIS": "surtgis surtgis",
    }
    commands = {
        name: [python, str(PEERS_PROGRAMS), "--version", *packages_of_tool.split()] for name, packages_of_tool in packages.items()
    }
    commands |= {
        "GRASS": ["grass", "--version"],
        "SAGA": ["saga_cmd", "--version"],
        "Skugga": [sys.executable, str(PEERS_PROGRAMS), "--version", "skugga", "numpy"],
    }
    versions = {name: installed_version(command) for name, command in commands.items()}
    return {name: number for name, number in versions.items() if number is not None}
