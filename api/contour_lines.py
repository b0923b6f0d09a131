"""Contour lines of a raster, written to a GeoPackage. Lines are traced window by window and joined at window borders."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rasterio
from rasterio.windows import Window

from skugga.terrain.atomic_files import atomic_path, write_error
from skugga.terrain.errors import InputError

WINDOW_CELLS = 2048
"""Cells along a window. Adjacent windows share a row or column, so that their lines end at the same points."""

MAX_VERTICES = 20_000_000
"""Maximum number of vertices of all lines together. They take about a gigabyte."""


def write_contours(raster: Path, values: Sequence[float], output: Path) -> int:
    """Write the contours of a raster's first band into a GeoPackage, and return the number of lines.

    Vertices are interpolated between cell centres. Each feature has the attribute ``value``. The file is written atomically.

    Parameters
    ----------
    raster
        Raster file.
    values
        Values of the contours.
    output
        GeoPackage to write.

    Raises
    ------
    InputError
        The lines have too many vertices.
    OSError
        The file cannot be written.
    """
    import pyogrio  # imported late, because it imports pandas if that is installed
    import shapely
    from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, GeometryError

    with rasterio.open(raster) as dataset:
        parts: dict[float, list[np.ndarray]] = {value: [] for value in values}
        vertices = 0
        for row in range(0, max(dataset.height - 1, 1), WINDOW_CELLS - 1):
            for col in range(0, max(dataset.width - 1, 1), WINDOW_CELLS - 1):
                window = Window(col, row, min(WINDOW_CELLS, dataset.width - col), min(WINDOW_CELLS, dataset.height - row))
                for value, line in _contour_lines(dataset.read(1, window=window), row, col, values):
                    parts[value].append(line)
                    vertices += len(line)
                if vertices > MAX_VERTICES:
                    raise InputError.over_limit(
                        "--contours", f"{vertices} vertices in {output}", f"{MAX_VERTICES}", "Use --bounds or fewer --levels"
                    )
        transform, crs = dataset.transform, dataset.crs
    geometries, labels = [], []
    for value, lines in parts.items():
        if not lines:
            continue
        merged_lines = shapely.line_merge(shapely.multilinestrings([shapely.linestrings(line) for line in lines]))
        single_lines = shapely.get_parts(merged_lines)
        geometries.append(
            shapely.transform(single_lines, lambda cell: np.stack(transform @ (cell[:, 0] + 0.5, cell[:, 1] + 0.5), axis=1))
        )
        labels.append(np.full(len(single_lines), value))
    all_lines = np.concatenate(geometries) if geometries else np.empty(0, object)
    with atomic_path(output) as path:
        try:
            pyogrio.raw.write(
                path, geometry=shapely.to_wkb(all_lines), field_data=[np.concatenate(labels) if labels else np.empty(0)],
                fields=np.array(["value"], object), geometry_type="LineString", crs=crs.to_wkt(), driver="GPKG", layer="contours",
            )  # fmt: skip
            written_count = len(pyogrio.raw.read(path)[2])
        except (DataSourceError, DataLayerError, GeometryError, FeatureError) as error:
            raise write_error(path, "the contours", error) from error
        if written_count != len(all_lines):
            raise write_error(path, "the contours", ValueError(f"only {written_count} of {len(all_lines)} lines were written"))
    return len(all_lines)


def _contour_lines(values: np.ndarray, row: int, col: int, contour_values: Sequence[float]) -> list[tuple[float, np.ndarray]]:
    """Return pairs of a value and a contour line at this value, in a window of raster cells.

    ``values`` are the cells' values, (rows, cols). ``row`` and ``col`` are the window's first cell in the raster.
    ``contour_values`` are the values to trace. Lines are float64 (n, 2): column and row in the raster.
    """
    from contourpy import contour_generator

    if min(values.shape) < 2:
        return []
    x, y = np.arange(values.shape[1], dtype=np.float64) + col, np.arange(values.shape[0], dtype=np.float64) + row
    generator = contour_generator(x, y, np.ma.masked_invalid(values.astype(np.float64)), line_type="Separate", corner_mask=True)
    return [(level, line) for level in contour_values for line in generator.lines(level) if isinstance(line, np.ndarray)]
