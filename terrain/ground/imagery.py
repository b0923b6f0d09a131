"""Ground imagery: an RGB raster draped over the ground as its albedo."""

from __future__ import annotations

import numpy as np
from affine import Affine
from pyproj import CRS
from pyproj.exceptions import CRSError, ProjError
from rasterio.enums import Resampling
from rasterio.errors import RasterioError

from skugga.terrain.compiled import compiled
from skugga.terrain.errors import SourceError
from skugga.terrain.geo.axes import axes_of
from skugga.terrain.geo.world import World, is_longitude_latitude, transformer
from skugga.terrain.ground.georeference import check_cells, check_geotransform
from skugga.terrain.ground.open_raster import open_masked_raster
from skugga.terrain.interpolation_loops import blend_corners, cell_interval
from skugga.terrain.level.rasters import open_raster
from skugga.terrain.srgb import linear_of_srgb

MAX_SIDE_CELLS = 4096
"""Longest side at which imagery is read: 48 MiB of colours. Larger rasters are averaged down to it."""


class Imagery:
    """An RGB raster in memory, with mip levels: averages of 2, 4, 8, ... cells a side.

    Raises ``SourceError`` for a file that is no georeferenced raster with three bands of integers.
    """

    def __init__(self, source: str) -> None:
        self.name = source
        try:
            with open_raster(source) as file:
                dtype = np.dtype(file.dtypes[0] if file.count else "uint8")
            with open_masked_raster(source, (1, 2, 3)) as dataset:
                check_geotransform(source, dataset)
                if dataset.count < 3 or dataset.crs is None:
                    problem = f"it has {dataset.count} bands" if dataset.count < 3 else "it has no coordinate reference system"
                    raise SourceError(source, problem, "Give a raster with a CRS and red, green and blue as its first bands")
                check_cells(source, dataset)
                factor = max(int(np.ceil(max(dataset.width, dataset.height) / MAX_SIDE_CELLS)), 1)
                shape = max(dataset.height // factor, 1), max(dataset.width // factor, 1)
                data = dataset.read((1, 2, 3), out_shape=(3, *shape), resampling=Resampling.average)
                valid = dataset.dataset_mask(out_shape=shape) > 0
                self.crs = CRS.from_user_input(dataset.crs.to_wkt())
                gt = axes_of(self.crs).affine @ dataset.transform
                x_factor, y_factor = dataset.width / shape[1], dataset.height / shape[0]
                self._cell_from_crs = ~Affine(gt.a * x_factor, gt.b * y_factor, gt.c, gt.d * x_factor, gt.e * y_factor, gt.f)
        except (RasterioError, CRSError, OSError) as error:
            reason = str(error).replace(f"'{source}'", "the file").replace(source, "the file").strip().rstrip(".")
            raise SourceError(source, reason or "it cannot be opened", "Give an RGB raster that GDAL reads") from None
        if data.dtype != dtype:  # integers were converted to floats, with NaN for nodata
            data = np.rint(np.where(valid, data, 0)).astype(dtype)
        self._levels = _mip_levels(_linear_colors(data, valid, source), valid)

    def cells_at(self, crs: CRS, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return (fractional) rows and columns (n, 2) in the imagery of map coordinates (n,); NaN where they have none.

        Raises ``SourceError`` if the map's CRS cannot be transformed into the imagery's.
        """
        try:
            if crs != self.crs and not (is_longitude_latitude(crs) and is_longitude_latitude(self.crs)):
                x, y = transformer(crs, self.crs).transform(x, y)
        except ProjError:
            problem = f"its CRS '{self.crs.name}' cannot be transformed into '{crs.name}'"
            raise SourceError(self.name, problem, "Give imagery in another CRS") from None
        inverse = self._cell_from_crs
        x, y = np.asarray(x), np.asarray(y)
        row, col = inverse.d * x + inverse.e * y + inverse.f - 0.5, inverse.a * x + inverse.b * y + inverse.c - 0.5
        out = np.stack([row, col], axis=-1)
        return np.where(np.isfinite(out), out, np.nan)

    def cell_m(self, world: World) -> float:
        """Return the side of a cell on the ground at the level's anchor, metres."""
        if self.crs.is_geographic:
            degree_m = np.radians(world.radius_m)
            return float(np.sqrt(abs(1.0 / self._cell_from_crs.determinant) * np.cos(np.radians(world.anchor_lat_deg)))) * degree_m
        unit = float(self.crs.axis_info[0].unit_conversion_factor or 1.0) if self.crs.axis_info else 1.0
        return float(np.sqrt(abs(1.0 / self._cell_from_crs.determinant))) * unit

    def albedo(self, cells: np.ndarray, cells_per_pixel: np.ndarray | float) -> np.ndarray:
        """Return the linear albedo (rows, cols, 3) float32 of pixels; NaN off the imagery and where it has no data.

        ``cells`` (rows, cols, 2) are the pixels' (fractional) rows and columns in the imagery. ``cells_per_pixel`` is the width of
        a pixel in cells, which selects the mip level. Colours are bilinear in that level.
        """
        mip = np.clip(np.floor(np.log2(np.maximum(cells_per_pixel, 1.0)) + 0.5), 0, len(self._levels) - 1).astype(np.int64)
        out = np.full((*cells.shape[:2], 3), np.nan, np.float32)
        mip = np.broadcast_to(mip, cells.shape[:2])
        for number in np.unique(mip):
            _sample_bilinear(self._levels[number], cells.astype(np.float64), mip == number, float(2**number), out)
        return out


def _linear_colors(data: np.ndarray, valid: np.ndarray, source: str) -> np.ndarray:
    """Return linear colours (rows, cols, 3) float32 of 8-bit sRGB values or of 16-bit values.

    16-bit values are scaled so that the 98th percentile of the valid ones becomes 1.
    """
    if data.dtype == np.uint8:
        coded = data.astype(np.float32) / 255.0
    elif data.dtype.kind in "ui":
        top = float(np.percentile(data[:, valid], 98)) if valid.any() else 1.0
        top = top or 1.0
        coded = np.clip(data.astype(np.float32) / top, 0.0, 1.0)
    else:
        raise SourceError(source, f"its bands are of type {data.dtype}", "Give bands of integers")
    return np.moveaxis(linear_of_srgb(coded), 0, -1).astype(np.float32)


def _mip_levels(colors: np.ndarray, valid: np.ndarray) -> list[np.ndarray]:
    """Return the mip levels (rows, cols, 3) float32, the finest first: averages of 1, 2, 4, ... cells a side.

    A cell of a mip level is NaN if any of its cells is not ``valid`` (rows, cols).
    """
    colors = np.where(valid[..., None], colors, np.float32(np.nan))
    levels = [colors]
    while min(levels[-1].shape[:2]) >= 4:
        last = levels[-1]
        rows, cols = last.shape[0] // 2, last.shape[1] // 2
        levels.append(last[: 2 * rows, : 2 * cols].reshape(rows, 2, cols, 2, 3).mean(axis=(1, 3)))
    return levels


@compiled
def _sample_bilinear(colors, cells, mask, factor, out):
    """Write the bilinear colours of a mip level to ``out`` (rows, cols, 3) in pixels that the mask ``mask`` selects.

    Pixels off the imagery do not change. ``colors`` (m, n, 3) are those of the mip level, whose cells are ``factor`` cells of the
    imagery a side. ``cells`` (rows, cols, 2) are the pixels' fractional rows and columns in the imagery.
    """
    rows, cols, _ = colors.shape
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            if not mask[i, j]:
                continue
            r, c = (cells[i, j, 0] + 0.5) / factor - 0.5, (cells[i, j, 1] + 0.5) / factor - 0.5
            if not (r >= -0.5 and c >= -0.5 and r <= rows - 0.5 and c <= cols - 0.5):
                continue
            r, c = min(max(r, 0.0), rows - 1.0), min(max(c, 0.0), cols - 1.0)
            r0, r1, row_fraction = cell_interval(r, rows)
            c0, c1, col_fraction = cell_interval(c, cols)
            for k in range(3):
                out[i, j, k] = blend_corners(
                    colors[r0, c0, k], colors[r0, c1, k], colors[r1, c0, k], colors[r1, c1, k], row_fraction, col_fraction
                )
