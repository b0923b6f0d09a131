"""Cells that a file declares empty, in one or several ways, are neither ground, canopy nor imagery."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp, Resampling

from skugga.terrain.errors import SourceError
from skugga.terrain.ground import open_raster as module
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.imagery import Imagery
from skugga.terrain.trees.canopy import Canopy
from tests.rasters import write_geotiff

SIDE_CELLS = 64
FILLER_HEIGHT_M = 500
"""Value of empty cells: a wall if it is read as ground."""

OWN, STATED = 7, 9
"""Nodata values of the file and of the level."""


def empty_cells() -> dict[str, np.ndarray]:
    """Return the empty cells of each way to declare them."""
    cells = {name: np.zeros((SIDE_CELLS, SIDE_CELLS), bool) for name in ("beside", "nodata", "stated")}
    cells["beside"][12:29, 7:23] = True
    cells["nodata"][40:51, 33:47] = True
    cells["stated"][3:6, 50:60] = True
    return cells


MASK_DECLARATIONS = {
    "none": {},
    "nodata": {"nodata": OWN},
    "alpha": {"alpha": 2},
    "alpha in a third band": {"alpha": 3},
    "alpha and nodata": {"alpha": 2, "nodata": OWN},
    "mask": {"mask": "inside"},
    "msk": {"mask": "beside"},
    "mask and nodata": {"mask": "inside", "nodata": OWN},
    "msk and nodata": {"mask": "beside", "nodata": OWN},
    "msk and alpha": {"mask": "beside", "alpha": 2},
}


def write(path: Path, heights: np.ndarray, alpha=None, mask=None, nodata=None, overviews=()) -> tuple[Path, np.ndarray]:
    """Write a raster that declares its empty cells, and return its path and these cells."""
    cells, bands = empty_cells(), [heights]
    empty = np.zeros_like(cells["beside"])
    heights[cells["nodata"]], heights[cells["stated"]] = OWN, STATED
    if nodata is not None:
        empty |= cells["nodata"]
    transparent_cells = np.roll(cells["beside"], 20, axis=1) if mask and alpha else cells["beside"]
    for number in range(2, 1 + (alpha or 1)):
        opaque = 1 if heights.dtype.kind == "f" else np.iinfo(heights.dtype).max
        bands.append(np.where(transparent_cells, 0, opaque).astype(heights.dtype) if number == alpha else np.full_like(heights, 3))
    for declared, expected_valid in ((transparent_cells, alpha), (cells["beside"], mask)):
        if expected_valid:
            heights[declared], empty = (
                FILLER_HEIGHT_M % (np.iinfo("uint8").max if heights.dtype == np.uint8 else 10**9),
                empty | declared,
            )
    with (
        rasterio.Env(GDAL_TIFF_INTERNAL_MASK=mask == "inside"),
        rasterio.open(
            path, "w", driver="GTiff", width=SIDE_CELLS, height=SIDE_CELLS, count=len(bands), dtype=heights.dtype, crs="EPSG:32633",
            transform=rasterio.Affine(10, 0, 500e3, 0, -10, 5200e3), nodata=nodata, tiled=True, blockxsize=16, blockysize=16,
        ) as dataset,
    ):  # fmt: skip
        dataset.colorinterp = [ColorInterp.alpha if number == alpha else ColorInterp.gray for number in range(1, len(bands) + 1)]
        dataset.write(np.stack(bands))
        if mask:
            dataset.write_mask(~cells["beside"])
    if overviews:
        with rasterio.open(path, "r+") as dataset:
            dataset.build_overviews(overviews, Resampling.average)
    return path, empty


def valid_means(heights: np.ndarray, cell_valid: np.ndarray, factor: int) -> np.ndarray:
    """Return the means of the valid cells among factor x factor cells, NaN without any."""
    count, shape = SIDE_CELLS // factor, (SIDE_CELLS // factor, factor, SIDE_CELLS // factor, factor)
    valid_count = cell_valid.reshape(shape).sum(axis=(1, 3))
    total = np.where(cell_valid, heights, 0).astype(float).reshape(shape).sum(axis=(1, 3))
    return np.divide(total, valid_count, out=np.full((count, count), np.nan), where=valid_count > 0)


def heights_of_level(elevation: Elevation, level: int) -> np.ndarray:
    """Return the heights of a level's cells, NaN without a surface."""
    middle = np.arange(SIDE_CELLS // 2**level) * 2.0**level + (2**level - 1) / 2
    height, valid = elevation.heights_at(level, *np.meshgrid(middle, middle, indexing="ij"))
    return np.where(valid, height, np.nan)


@pytest.mark.parametrize("is_large", [False, True], ids=["small", "large"])
@pytest.mark.parametrize("stated", [None, STATED])
@pytest.mark.parametrize("dtype", ["float32", "int16", "uint16", "uint8"])
@pytest.mark.parametrize("declaration", MASK_DECLARATIONS)
def test_declared_empty_cells_are_no_ground_at_any_zoom(tmp_path, monkeypatch, declaration, dtype, stated, is_large):
    """A large raster is read from the overviews of its file if these were built with all declarations of empty cells."""
    if is_large:
        monkeypatch.setattr(module, "MAX_EXACT_MAXIMA_CELLS", 100)
    heights = np.random.default_rng(1).integers(100, 200, (SIDE_CELLS, SIDE_CELLS)).astype(dtype)
    path, empty = write(tmp_path / "dem.tif", heights, **MASK_DECLARATIONS[declaration], overviews=() if stated else (2, 4))
    if stated:
        empty = empty | (heights == STATED)
    elevation = Elevation(str(path), nodata=stated)
    for level in (0, 1, 2):
        expected = valid_means(heights, ~empty, 2**level)
        level_heights = heights_of_level(elevation, level)
        np.testing.assert_array_equal(np.isnan(level_heights), np.isnan(expected))
        by_overviews = level * is_large * (not stated) * 100.0  # means of means over more or fewer cells, without filler
        tolerance = 0.51 if np.dtype(dtype).kind in "iu" and level else 1e-3
        np.testing.assert_allclose(
            level_heights[~np.isnan(level_heights)], expected[~np.isnan(level_heights)], atol=max(tolerance, by_overviews)
        )
    elevation.close()


@pytest.mark.parametrize("declaration", MASK_DECLARATIONS)
def test_declared_empty_cells_have_no_trees(tmp_path, declaration):
    path, empty = write(tmp_path / "chm.tif", np.full((SIDE_CELLS, SIDE_CELLS), 20, np.float32), **MASK_DECLARATIONS[declaration])
    with rasterio.open(path, "r+") as dataset:
        values = dataset.read(1)
        values[empty] = 30.0
        values[empty & (empty_cells()["nodata"])] = OWN
        dataset.write(values, 1)
    canopy = Canopy(str(path))
    np.testing.assert_array_equal(canopy.heights_m(0, 0, SIDE_CELLS, SIDE_CELLS) > 0, ~empty)
    canopy.close()


@pytest.mark.parametrize("declared", ["alpha", "alpha and nodata", "alpha in a fifth band", "msk and nodata"])
def test_declared_empty_cells_are_no_imagery(tmp_path, declared):
    """Empty cells do not affect the brightness stretch of 16-bit imagery either."""
    empty, dark_cells = np.zeros((SIDE_CELLS, SIDE_CELLS), bool), np.zeros((SIDE_CELLS, SIDE_CELLS), bool)
    empty[:20], dark_cells[40:50] = True, "nodata" in declared
    color = np.full((3, SIDE_CELLS, SIDE_CELLS), 1000, np.uint16)
    color[:, empty], color[:, dark_cells] = 65535, 5
    alpha = 0 if "msk" in declared else 5 if "fifth" in declared else 4
    extra_bands = [np.where(empty, 0, 65535).astype(np.uint16)[None]] * max(alpha - 3, 0)
    path = tmp_path / "ortho.tif"
    bands = np.concatenate([color, *extra_bands])
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=False), rasterio.open(
        path, "w", driver="GTiff", width=SIDE_CELLS, height=SIDE_CELLS, count=len(bands), dtype="uint16", crs="EPSG:32633",
        transform=rasterio.Affine(10, 0, 500e3, 0, -10, 5200e3), nodata=5 if "nodata" in declared else None,
    ) as dataset:  # fmt: skip
        band_colors = [ColorInterp.red, ColorInterp.green, ColorInterp.blue, *[ColorInterp.undefined] * len(extra_bands)]
        dataset.colorinterp = [ColorInterp.alpha if number == alpha else name for number, name in enumerate(band_colors, 1)]
        dataset.write(bands)
        if not alpha:
            dataset.write_mask(~empty)
    row, col = np.mgrid[:SIDE_CELLS, :SIDE_CELLS].astype(np.float32)
    albedo = Imagery(str(path)).albedo(np.stack([row, col], axis=-1), 1.0)
    inside = ~np.isnan(albedo).any(axis=-1)
    valid = ~(empty | dark_cells)
    np.testing.assert_array_equal(inside[:-1], valid[:-1] & valid[1:])  # a colour is interpolated between two rows
    np.testing.assert_allclose(albedo[inside], 1.0, atol=1e-6)


def test_filler_behind_an_alpha_band_casts_no_shadow(tmp_path):
    """With the sun at 39.8 degrees, a wall of 500 m would cast a shadow of 600 m, or 60 cells."""
    import skugga

    heights = np.zeros((2, SIDE_CELLS, 2 * SIDE_CELLS), np.float32)
    heights[1] = 1.0
    heights[0, :, :20], heights[1, :, :20] = 500.0, 0.0
    heights[0, 30:34, 70:74] = 50.0  # a tower with a valid shadow of 6 cells
    path = tmp_path / "dem.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=2 * SIDE_CELLS, height=SIDE_CELLS, count=2, dtype="float32", crs="EPSG:32633",
        transform=rasterio.Affine(10, 0, 500e3, 0, -10, 5200e3),
    ) as dataset:  # fmt: skip
        dataset.colorinterp = [ColorInterp.gray, ColorInterp.alpha]
        dataset.write(heights)
    with skugga.open_level(path) as level:
        mask = level.shade("mask", azimuth=270.0, altitude=float(np.degrees(np.arctan2(500.0, 600.0))))
    assert (mask[:, :20] == 128).all() and (mask[:, 20:70] == 255).all()
    assert (mask[32, 75:79] == 0).all() and (mask[:, 82:] == 255).all()


def test_mask_applies_also_if_a_level_states_nodata(tmp_path):
    """An impossible nodata value is still rejected by name."""
    path, empty = write(tmp_path / "dem.tif", np.full((SIDE_CELLS, SIDE_CELLS), 100, np.uint16), mask="inside")
    assert np.isnan(heights_of_level(Elevation(str(path), nodata=STATED), 0))[empty].all()
    with pytest.raises(SourceError, match="dem.tif: nodata: .*uint16"):
        Elevation(str(path), nodata=-1.0)


@pytest.mark.parametrize(("dtype", "word"), [("int16", "nan"), ("uint16", "-9999"), ("uint8", "1e+20")])
def test_nodata_value_that_no_cell_can_have_is_reported(tmp_path, make_scene, dtype, word):
    write_geotiff(tmp_path / "cells.tif", np.full((SIDE_CELLS, SIDE_CELLS), 100, dtype), "EPSG:32633", 500e3, 5200e3, 10.0)
    path = tmp_path / "dem.vrt"
    path.write_text(
        f'<VRTDataset rasterXSize="{SIDE_CELLS}" rasterYSize="{SIDE_CELLS}"><SRS>EPSG:32633</SRS>'
        "<GeoTransform>500000, 10, 0, 5200000, 0, -10</GeoTransform>"
        f'<VRTRasterBand dataType="{module._VRT_TYPES[dtype]}" band="1"><NoDataValue>{word}</NoDataValue><SimpleSource>'
        '<SourceFilename relativeToVRT="1">cells.tif</SourceFilename><SourceBand>1</SourceBand></SimpleSource>'
        "</VRTRasterBand></VRTDataset>"
    )
    (warning,) = make_scene(path).warnings
    assert f"nodata {word}," in warning and dtype in warning and "nodata=VALUE" in warning
    assert make_scene(path, terrain={"nodata": 99}).warnings == ()
