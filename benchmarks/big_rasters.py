"""Rasters of 2,500 to 100,000 cells a side over the same real relief, made in a folder for ``benchmarks.big_elevation``.

A mirrored raster of mountains becomes a *sheet* of ``SHEET_CELLS`` cells a side that tiles seamlessly. Every raster repeats the
sheet. All rasters have the same middle cell at the same coordinates. So they have the same ground round the middle.

Rasters of up to 40,000 cells a side are COGs. The raster of 100,000 cells a side is a virtual raster (VRT) of 2,377 parts. The
files of the parts are hard links, so that the disk holds their cells only once. 24 more parts are absent (sparse). ``skugga
overviews`` writes its overviews. One of its corners is a plain with one mountain.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import rasterio
from affine import Affine
from pyproj import CRS
from rasterio.enums import Resampling

from skugga.api.products.product import RasterProfile
from skugga.api.raster_file import open_cog

SHEET_CELLS = 2048
"""Cells a side of a sheet: a power of two, so that the cells of all its overviews align with those of its neighbours."""

CELL_M = 30.0
"""Side of a cell, metres."""
EPSG = 32611
"""EPSG code of the rasters' CRS: UTM zone 11."""
MIDDLE_XY_M = 500_000.0, 3_800_000.0
"""Middle of every raster, easting and northing in metres."""

VRT_CELLS = 100_000
"""Cells a side of the virtual raster."""
COG_SIDES = 2_500, 10_000, 40_000
"""Cells a side of the COGs."""
PARTS_PER_SIDE = -(-VRT_CELLS // SHEET_CELLS)
"""Number of files along each side of the virtual raster."""

NODATA = -32768
PLAIN_HEIGHT_M, MOUNTAIN_HEIGHT_M = 500, 4000
PLAIN_PARTS, MOUNTAIN_PART = (slice(4, 9), slice(4, 9)), (6, 7)
"""Rows and columns of the parts that are a plain, and of the part whose middle is the mountain's foot."""

MOUNTAIN_SIGMA_CELLS = 60.0
"""Standard deviation of the mountain's Gaussian profile, cells."""
ABSENT_PARTS = slice(30, 34), slice(40, 46)
"""Rows and columns of the absent parts."""

STRIP_ROWS = 1024
"""Rows of a COG that are written at a time."""


@dataclass(frozen=True)
class BigRaster:
    """A square raster file.

    Attributes
    ----------
    path
        Its file.
    side_cells
        Cells along each side.
    write_s
        Seconds to write the file; 0 if it existed.
    """

    path: Path
    side_cells: int
    write_s: float


def make_sheet(raster: Path) -> np.ndarray:
    """Return a seamless sheet, int16 (``SHEET_CELLS``, ``SHEET_CELLS``) in metres: a raster's first band, mirrored and repeated."""
    with rasterio.open(raster) as dataset:
        heights = dataset.read(1, masked=True)[8:-8, 8:-8].astype(np.float64)
    quarter = np.ma.filled(heights, heights.mean())
    for axis in (0, 1):  # as many mirror images as a quarter needs
        while quarter.shape[axis] < SHEET_CELLS // 2:
            quarter = np.concatenate([quarter, np.flip(quarter, axis)], axis)
    quarter = np.rint(quarter[: SHEET_CELLS // 2, : SHEET_CELLS // 2]).astype(np.int16)
    half = np.concatenate([quarter, quarter[:, ::-1]], axis=1)
    return np.concatenate([half, half[::-1]], axis=0)


def centred_transform(side: int) -> Affine:
    """Return the geotransform of a raster of ``side`` x ``side`` cells with its middle at ``MIDDLE_XY_M``."""
    half_m = side / 2 * CELL_M
    return Affine(CELL_M, 0.0, MIDDLE_XY_M[0] - half_m, 0.0, -CELL_M, MIDDLE_XY_M[1] + half_m)


def make_cog(folder: Path, sheet: np.ndarray, side: int) -> BigRaster:
    """Write a deflated COG of ``side`` x ``side`` cells with overviews, strip by strip, unless it exists.

    ``sheet`` is the result of ``make_sheet``.
    """
    path, start = folder / f"relief_{side}.tif", time.perf_counter()
    if path.is_file():
        return BigRaster(path, side, 0.0)
    phase = (VRT_CELLS - side) // 2 % SHEET_CELLS  # the virtual raster's sheets begin at its corner
    cols = (np.arange(side) + phase) % SHEET_CELLS
    with open_cog(
        path, CRS.from_epsg(EPSG), centred_transform(side), (side, side), RasterProfile("int16", 1, NODATA), is_smooth=True
    ) as file:
        for row in range(0, side, STRIP_ROWS):
            rows = (np.arange(row, min(row + STRIP_ROWS, side)) + phase) % SHEET_CELLS
            file.write(row, 0, sheet[np.ix_(rows, cols)])
    return BigRaster(path, side, time.perf_counter() - start)


def _write_sheet(path: Path, sheet: np.ndarray) -> None:
    """Write a sheet as a tiled GeoTIFF with overviews, around ``MIDDLE_XY_M``."""
    with rasterio.open(
        path, "w", driver="GTiff", width=SHEET_CELLS, height=SHEET_CELLS, count=1, dtype="int16", crs=f"EPSG:{EPSG}", nodata=NODATA,
        transform=centred_transform(SHEET_CELLS), tiled=True, blockxsize=512, blockysize=512, compress="deflate",
    ) as dataset:  # fmt: skip
        dataset.write(sheet, 1)
        dataset.build_overviews([2**level for level in range(1, 10)], Resampling.average)


def mountain_heights_m() -> np.ndarray:
    """Return heights of a round hill on the plain, int16 (``SHEET_CELLS``, ``SHEET_CELLS``) in metres."""
    distance_cells = np.arange(SHEET_CELLS) - SHEET_CELLS / 2 + 0.5
    bell = np.exp(-(distance_cells[:, None] ** 2 + distance_cells[None, :] ** 2) / (2.0 * MOUNTAIN_SIGMA_CELLS**2))
    return np.rint(PLAIN_HEIGHT_M + MOUNTAIN_HEIGHT_M * bell).astype(np.int16)


def mountain_xy() -> tuple[float, float]:
    """Return easting and northing of the mountain's top."""
    row, col = ((index + 0.5) * SHEET_CELLS for index in MOUNTAIN_PART)
    return centred_transform(VRT_CELLS) * (col, row)


def make_vrt(folder: Path, sheet: np.ndarray) -> BigRaster:
    """Write the virtual raster of ``VRT_CELLS`` x ``VRT_CELLS`` cells and its files, unless it exists.

    ``sheet`` is the result of ``make_sheet``.
    """
    path, start = folder / f"relief_{VRT_CELLS}.vrt", time.perf_counter()
    if path.is_file():
        return BigRaster(path, VRT_CELLS, 0.0)
    parts = folder / "parts"
    parts.mkdir(exist_ok=True)
    sheets = {"relief": sheet, "plain": np.full_like(sheet, PLAIN_HEIGHT_M), "mountain": mountain_heights_m()}
    for name, heights in sheets.items():
        _write_sheet(parts / f"{name}.tif", heights)
    root = ElementTree.Element("VRTDataset", rasterXSize=str(VRT_CELLS), rasterYSize=str(VRT_CELLS))
    ElementTree.SubElement(root, "SRS").text = f"EPSG:{EPSG}"
    ElementTree.SubElement(root, "GeoTransform").text = ", ".join(map(repr, centred_transform(VRT_CELLS).to_gdal()))
    band = ElementTree.SubElement(root, "VRTRasterBand", dataType="Int16", band="1")
    ElementTree.SubElement(band, "NoDataValue").text = str(NODATA)
    for row in range(PARTS_PER_SIDE):
        for col in range(PARTS_PER_SIDE):
            if _contains_part(ABSENT_PARTS, row, col):
                continue
            kind = "mountain" if (row, col) == MOUNTAIN_PART else "plain" if _contains_part(PLAIN_PARTS, row, col) else "relief"
            part = parts / f"part_{row:02}_{col:02}.tif"
            part.unlink(missing_ok=True)
            os.link(parts / f"{kind}.tif", part)
            source = ElementTree.SubElement(band, "ComplexSource")
            ElementTree.SubElement(source, "SourceFilename", relativeToVRT="1").text = f"parts/{part.name}"
            ElementTree.SubElement(source, "SourceBand").text = "1"
            ElementTree.SubElement(
                source, "SourceProperties", RasterXSize=str(SHEET_CELLS), RasterYSize=str(SHEET_CELLS), DataType="Int16",
                BlockXSize="512", BlockYSize="512",
            )  # fmt: skip
            size = {
                "xSize": str(min(SHEET_CELLS, VRT_CELLS - col * SHEET_CELLS)),
                "ySize": str(min(SHEET_CELLS, VRT_CELLS - row * SHEET_CELLS)),
            }
            ElementTree.SubElement(source, "SrcRect", xOff="0", yOff="0", **size)
            ElementTree.SubElement(source, "DstRect", xOff=str(col * SHEET_CELLS), yOff=str(row * SHEET_CELLS), **size)
            ElementTree.SubElement(source, "NODATA").text = str(NODATA)
    ElementTree.ElementTree(root).write(path)
    return BigRaster(path, VRT_CELLS, time.perf_counter() - start)


def _contains_part(slices: tuple[slice, slice], row: int, col: int) -> bool:
    """Return whether a part of the virtual raster, by its row and column of parts, lies in slices of rows and columns."""
    return slices[0].start <= row < slices[0].stop and slices[1].start <= col < slices[1].stop


def make_rasters(folder: Path, raster: Path) -> list[BigRaster]:
    """Write the missing rasters into ``folder``, and return all rasters in order of size. ``raster`` is a file with real relief."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet = make_sheet(raster)
    return [*(make_cog(folder, sheet, side) for side in COG_SIDES), make_vrt(folder, sheet)]


def raster_paths(folder: Path) -> list[Path]:
    """Return the paths of a folder's rasters, in order of size."""
    return [*(folder / f"relief_{side}.tif" for side in COG_SIDES), folder / f"relief_{VRT_CELLS}.vrt"]
