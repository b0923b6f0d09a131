"""The irradiation of polygons, such as roofs and fields: means and sums over the cells whose centres lie in them.

A cell at the edge of a roof has the slope of the wall below it. So means, slopes and the area per cell are those of inner cells,
whose four neighbours lie in the polygon, too; a polygon without inner cells has those of all of its cells.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyogrio
import shapely
from pyogrio.errors import DataLayerError, DataSourceError, FeatureError, GeometryError
from pyproj import CRS

from skugga.api.compute import ProgressCallback
from skugga.api.products.irradiation import IrradiationOptions
from skugga.api.raster_view import raster_view
from skugga.shadows.horizons.block_ground import block_plane
from skugga.shadows.irradiation.irradiation import irradiation
from skugga.shadows.irradiation.surfaces import BlockSurfaces, block_surfaces
from skugga.terrain.atomic_files import atomic_path, write_error
from skugga.terrain.errors import InputError, SourceError
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.vectors import Features, attribute_names, read_features, vector_layer
from skugga.terrain.geo.world import transformer
from skugga.terrain.scene import Scene

DRIVER_BY_SUFFIX = {".gpkg": "GPKG", ".geojson": "GeoJSON", ".csv": "CSV"}
"""GDAL's drivers by the suffix of an output file."""

ATTRIBUTE_SUFFIX = "_"
"""End of the name of a polygon's attribute that is also the name of a figure, such as ``area_m2``."""

SIGNIFICANT_DIGITS = 6
"""Significant digits of figures in files. A year's sums err in the fourth digit (docs/reports/irradiation.md)."""

MAX_POLYGONS = 200_000
"""Limit of the polygons of a file."""

MIN_FACING_SLOPE_DEG = 0.05
"""Slope from which on a plane faces an azimuth."""

LONGITUDE_LATITUDE = CRS.from_epsg(4326)


@dataclass(frozen=True, eq=False)
class PolygonIrradiation:
    """The irradiation of n polygons.

    Attributes
    ----------
    features
        The polygons, in the CRS of the level's raster.
    crs
        This CRS.
    cells
        int (n,): cells whose centres lie in each polygon. One without any, since it is small or narrow, has a cell that it touches.
    area_m2
        (n,): area of these cells along the ground or the roof; with planes of a given tilt, on the map. NaN without cells.
    slope_deg, azimuth_deg
        (n,): tilt of the mean plane of the cells, and the azimuth that it faces, degrees; NaN without cells or level.
    mean_kwh_m2
        (n, bands): mean over the area; NaN without cells.
    band_names
        The bands: periods and parts.
    """

    features: Features
    crs: CRS
    cells: np.ndarray
    area_m2: np.ndarray
    slope_deg: np.ndarray
    azimuth_deg: np.ndarray
    mean_kwh_m2: np.ndarray
    band_names: tuple[str, ...]

    @property
    def sum_kwh(self) -> np.ndarray:
        """The energy on each polygon, (n, bands), kWh; NaN without cells."""
        return self.mean_kwh_m2 * self.area_m2[:, None]

    def columns(self) -> dict[str, np.ndarray]:
        """Return the columns of a table, by name: attributes of the polygons, then their irradiation.

        The name of an attribute that is also that of a figure ends with ``ATTRIBUTE_SUFFIX``.
        """
        figures = self._figures()
        taken = {name.lower() for name in figures}
        attributes = {
            f"{name}{ATTRIBUTE_SUFFIX}" if name.lower() in taken else name: _as_field(values)
            for name, values in self.features.attributes.items()
        }
        return {**attributes, **figures}

    def _figures(self) -> dict[str, np.ndarray]:
        """Return the columns that are not attributes, by name."""
        columns = {
            "feature": self.features.number_in_layer, "cells": self.cells, "area_m2": self.area_m2, "slope_deg": self.slope_deg,
            "azimuth_deg": self.azimuth_deg,
        }  # fmt: skip
        for band, name in enumerate(self.band_names):
            suffix = "" if len(self.band_names) == 1 else f" {name}"
            columns[f"kwh_m2{suffix}"], columns[f"kwh{suffix}"] = self.mean_kwh_m2[:, band], self.sum_kwh[:, band]
        columns = {name: _significant(values) for name, values in columns.items()}
        outside = np.where(self.cells > 0, "", "outside of the level's ground").astype(object)
        return {**columns, "remark": outside}


def _significant(values: np.ndarray) -> np.ndarray:
    """Return figures (n,) with ``SIGNIFICANT_DIGITS``; whole numbers are unchanged."""
    if values.dtype.kind != "f":
        return values
    return np.array([float(f"{value:.{SIGNIFICANT_DIGITS}g}") for value in values])


def _as_field(values: np.ndarray) -> np.ndarray:
    """Return the values (n,) of an attribute as numbers or texts, since lists cannot be written to every format."""
    if values.dtype != object:
        return values
    return np.array([value if value is None or isinstance(value, str) else str(value) for value in values], object)


def read_polygons(path: Path, scene: Scene) -> Features:
    """Read polygons and all their attributes into the CRS of a level's raster.

    Raises ``SourceError`` for a file without polygons or with too many.
    """
    source = str(path)
    layer = vector_layer(source, (2,))
    names = attribute_names(source, 0 if layer.name is None else layer.name)
    features = read_features(source, scene.elevation.crs, optional_attributes=names, layer=layer)
    is_polygon = shapely.get_dimensions(features.geometry) == 2
    if not is_polygon.any():
        raise SourceError(source, "no polygons", "Use a file with polygons, such as roofs or fields")
    features = features[np.flatnonzero(is_polygon)]
    if len(features.geometry) > MAX_POLYGONS:
        raise SourceError(source, f"{len(features.geometry)} polygons", f"Use at most {MAX_POLYGONS}")
    return features


def polygon_irradiation(
    scene: Scene, features: Features, options: IrradiationOptions, on_step: ProgressCallback | None = None
) -> PolygonIrradiation:
    """Return the irradiation of polygons on the cells of a level's raster. Raises ``InputError`` if none lies on the raster.

    ``features`` are those of ``read_polygons``. ``on_step(done, total)`` is called after each date of each block.
    """
    west, south, east, north = (float(value) for value in shapely.total_bounds(features.geometry))
    side = abs(raster_view(scene).view.grid.step)
    try:
        view = raster_view(scene, (west - side, south - side, east + side, north + side)).view.with_pixels_as_nodes()
    except InputError as error:
        raise InputError("--polygons", features.name, f"polygons on the level's ground ({error})") from None
    sums = _PolygonSums(scene, features, len(options.band_names))
    blocks = options.blocks(scene, view)
    dates, done = options.dates(scene.world), 0

    def report() -> None:
        nonlocal done
        done += 1
        if on_step is not None:
            on_step(done, len(blocks) * options.date_count)

    for block, _, _ in blocks:
        if not sums.numbers_in(block).size:
            for _ in dates.windows:
                report()
            continue
        surfaces = block_surfaces(scene, block, options.rules.plane, options.rules.transmissivity)
        values = irradiation(
            scene, block, dates, options.rules, report, options.store_of(scene, block), options.read_weather(), surfaces
        )
        sums.add(block, surfaces, values)
    return sums.result(scene.elevation.crs, options.band_names)


class _PolygonSums:
    """Sums over the cells of polygons, block by block."""

    def __init__(self, scene: Scene, features: Features, bands: int) -> None:
        self._scene, self._features = scene, features
        self._bounds = shapely.bounds(features.geometry)
        self._inner_points = shapely.get_coordinates(shapely.point_on_surface(features.geometry))
        count = len(features.geometry)
        self._cells, self._map_m2, self._area_m2 = np.zeros(count, int), np.zeros(count), np.zeros(count)
        self._normals, self._energy_kwh = np.zeros((count, 3)), np.zeros((count, bands))
        self._averaged_m2 = np.zeros(count)
        shapely.prepare(features.geometry)

    def numbers_in(self, block: MapView) -> np.ndarray:
        """Return the numbers of the polygons whose bounds touch a block."""
        x, y = _cell_centers(block)
        (west, east), (south, north) = ((min(axis[0], axis[-1]), max(axis[0], axis[-1])) for axis in (x, y))
        half_m = 0.5 * abs(block.grid.step)
        low_x, low_y, high_x, high_y = self._bounds.T
        touches = (low_x <= east + half_m) & (high_x >= west - half_m) & (low_y <= north + half_m) & (high_y >= south - half_m)
        return np.flatnonzero(touches)

    def add(self, block: MapView, surfaces: BlockSurfaces, values: np.ndarray) -> None:
        """Add the cells of a block; ``values`` (bands, rows, cols) is their irradiation."""
        cell_m2 = abs(np.linalg.det(block_plane(self._scene.world, block, *block.centre_node).east_north_of_cell_m))
        shown, (x, y) = np.isfinite(surfaces.height_m), _cell_centers(block)
        for number in self.numbers_in(block):
            row, col = self._cells_of(number, x, y, abs(block.grid.step))
            is_shown = shown[row, col]
            row, col = row[is_shown], col[is_shown]
            self._cells[number] += len(row)
            self._map_m2[number] += len(row) * cell_m2
            is_inner = _is_inner(row, col)
            if is_inner.any():
                row, col = row[is_inner], col[is_inner]
            normals = np.stack([component[row, col] for component in surfaces.normals.components], axis=1).astype(np.float64)
            # a sloped cell has more area than its square on the map; planes of a given tilt count by the square
            area_m2 = cell_m2 / normals[:, 2] if surfaces.plane == "ground" else np.full(len(row), cell_m2)
            self._averaged_m2[number] += len(row) * cell_m2
            self._area_m2[number] += area_m2.sum()
            self._normals[number] += normals.sum(axis=0)
            self._energy_kwh[number] += values[:, row, col].astype(np.float64) @ area_m2

    def _cells_of(self, number: int, x: np.ndarray, y: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns of the cells whose centres, at ``x`` and ``y``, lie in a polygon.

        A polygon that holds no centre, since it is small or narrow, has the cell in which a point of it lies.
        """
        west, south, east, north = self._bounds[number]
        rows, cols = np.flatnonzero((y >= south) & (y <= north)), np.flatnonzero((x >= west) & (x <= east))
        inside = shapely.contains_xy(self._features.geometry[number], *np.meshgrid(x[cols], y[rows]))
        if inside.any():
            row, col = np.nonzero(inside)
            return rows[row], cols[col]
        at_x, at_y = self._inner_points[number]
        return np.meshgrid(np.flatnonzero(_is_within(y, at_y, side)), np.flatnonzero(_is_within(x, at_x, side)), indexing="ij")

    def result(self, crs: CRS, band_names: tuple[str, ...]) -> PolygonIrradiation:
        """Return the means."""
        with np.errstate(invalid="ignore", divide="ignore"):
            mean_kwh_m2 = self._energy_kwh / self._area_m2[:, None]
            slope_deg = np.degrees(np.arccos(np.clip(self._normals[:, 2] / np.linalg.norm(self._normals, axis=1), -1.0, 1.0)))
        azimuth_deg = np.degrees(np.arctan2(self._normals[:, 0], self._normals[:, 1])) % 360.0
        azimuth_deg[~(slope_deg > MIN_FACING_SLOPE_DEG)] = np.nan
        with np.errstate(invalid="ignore"):
            area_m2 = np.where(self._cells > 0, self._map_m2 * self._area_m2 / self._averaged_m2, np.nan)
        return PolygonIrradiation(self._features, crs, self._cells, area_m2, slope_deg, azimuth_deg, mean_kwh_m2, band_names)


def _is_inner(row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return which of some cells have their four neighbours among them."""
    mask = np.zeros((np.ptp(row) + 3, np.ptp(col) + 3) if len(row) else (3, 3), np.bool_)
    at = (row - row.min() + 1, col - col.min() + 1) if len(row) else (row, col)
    mask[at] = True
    inner = mask.copy()
    inner[1:-1, 1:-1] &= mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    return inner[at]


def _cell_centers(block: MapView) -> tuple[np.ndarray, np.ndarray]:
    """Return x of the columns and y of the rows of a block."""
    x = block.grid.x(block.col0 + np.arange(block.cols) * block.col_step)
    y = block.grid.y(block.row0 + np.arange(block.rows) * block.row_step)
    return np.asarray(x), np.asarray(y)


def _is_within(centers: np.ndarray, value: float, side: float) -> np.ndarray:
    """Return which cells of a row or column hold a value: the lower side of a cell belongs to it, the upper one does not."""
    return (centers - 0.5 * side <= value) & (value < centers + 0.5 * side)


def write_polygon_irradiation(path: Path, answer: PolygonIrradiation) -> None:
    """Write polygons with their irradiation as GeoPackage, GeoJSON (in longitude and latitude) or CSV, atomically.

    Raises ``OSError``.
    """
    columns, driver = answer.columns(), DRIVER_BY_SUFFIX[path.suffix.lower()]
    geometry, crs = answer.features.geometry, answer.crs
    if driver == "GeoJSON":
        to_degrees = transformer(crs, LONGITUDE_LATITUDE)
        geometry, crs = shapely.transform(geometry, to_degrees.transform, interleaved=False), LONGITUDE_LATITUDE
    is_table = driver == "CSV"
    with atomic_path(path) as target:
        try:
            pyogrio.raw.write(
                target, geometry=None if is_table else shapely.to_wkb(geometry), field_data=list(columns.values()),
                fields=np.array(list(columns), object), geometry_type=None if is_table else "Unknown",
                crs=None if is_table else crs.to_wkt(), driver=driver,
            )  # fmt: skip
        except (DataSourceError, DataLayerError, GeometryError, FeatureError) as error:
            raise write_error(target, "the polygons", error) from error
