"""Rasters that are opened while file descriptors are exhausted."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from tests.api.conftest import write_level

PROGRAM = """
import os, resource, sys
from contextlib import suppress
import rasterio
from skugga.terrain.level.rasters import open_raster
resource.setrlimit(resource.RLIMIT_NOFILE, (64, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
held = []
with suppress(OSError):
    while True:
        held.append(os.open(os.devnull, os.O_RDONLY))
for _ in range(int(sys.argv[2])):
    os.close(held.pop())
try:
    print(open_raster(sys.argv[1]).crs.to_epsg())
except OSError as error:
    print(error.errno)
"""
"""Program that opens a raster with a number of free file descriptors, and prints the EPSG code of its CRS or an error number."""


@pytest.mark.parametrize(("free", "outcome"), [(0, errno.EMFILE), (1, errno.EMFILE), (6, 3857)])
def test_open_raster_needs_free_descriptors(tmp_path: Path, free: int, outcome: int):
    """Without a descriptor for PROJ's database, GDAL reads a projected CRS as an engineering CRS, without an error."""
    raster = write_level(tmp_path, "hills").with_suffix(".tif")
    command = [sys.executable, "-c", PROGRAM, str(raster), str(free)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout
    assert printed.strip() == str(outcome)
