"""Truth by rays: the beam of a period at cells of a raster, sun by sun, traced with Embree against the ground's triangles.

Each cell has its own vertical, normal and height. So the truth shares the triangles, the moments of the suns and the light with
Skugga, and neither its sweep nor its planes of blocks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.ndimage import binary_erosion

from benchmarks.sun_hours_accuracy import CellRays
from skugga.shadows.irradiation.light import clear_sky_light
from skugga.shadows.irradiation.suns import SunIntervals
from skugga.terrain.gbuffer.bare_nodes import HALO_NODES, bare_nodes
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.scene import Scene

SlopeFit = Literal["level", "central", "horn", "quad"]
"""How a plane is fitted to a cell: not at all, but level; by central differences; by those of three rows and columns (B. K. P. Horn
1981); or to the quad of cells in the north-east of it."""

MARGIN_CELLS = 3
"""Minimum distance of sampled cells from the rim and from holes."""

LIGHT_STEP_M = 25.0
"""Metres between two heights at which the clear sky is computed."""


@dataclass(frozen=True, eq=False)
class SampledCells:
    """Random cells of a raster.

    Attributes
    ----------
    row, col
        (n,): their rows and columns.
    height_m
        (n,): heights.
    rays
        Rays from the cells.
    position_frame_m
        (3, 3, n, 3): the points of the cells and their neighbours by row and column, in the frame of the rays.
    upwards
        (n, 3): unit vectors of the cells' verticals.
    frame_from_enu
        (3, 3): the rotation from east, north and up at the middle of the raster to the frame.
    lon_deg, lat_deg
        Position of the middle of the raster.
    """

    row: np.ndarray
    col: np.ndarray
    height_m: np.ndarray
    rays: CellRays
    position_frame_m: np.ndarray
    upwards: np.ndarray
    frame_from_enu: np.ndarray
    lon_deg: float
    lat_deg: float

    def normals(self, fit: SlopeFit) -> np.ndarray:
        """Return the unit normals (n, 3) of the cells' planes."""
        if fit == "level":
            return self.upwards
        around = self.position_frame_m
        if fit == "quad":
            west, east, south, north = around[:2, 1], around[:2, 2], around[1, 1:], around[0, 1:]
            to_east, to_north = (east - west).sum(axis=0), (north - south).sum(axis=0)
        else:
            weights = np.array([1.0, 2.0, 1.0] if fit == "horn" else [0.0, 1.0, 0.0])[:, None, None]
            to_east = (weights * (around[:, 2] - around[:, 0])).sum(axis=0)
            to_north = (weights * (around[0] - around[2])).sum(axis=0)
        normal = np.cross(to_east, to_north)
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))

    def beam_kwh(self, suns: SunIntervals, power: np.ndarray, fit: SlopeFit = "central") -> np.ndarray:
        """Return the beam (n,) of suns, kWh/m2. ``power`` (n, suns) is their light on planes that face them, W/m2."""
        normals, total = self.normals(fit), np.zeros(len(self.row))
        for number in range(len(suns)):
            towards = self.frame_from_enu @ direction_enu(float(suns.azimuth_deg[number]), float(suns.altitude_deg[number]))
            cosine = normals @ towards
            faces = cosine > 0.0
            if faces.any():
                lit = faces & self.rays.sun_visible(towards)
                total[lit] += cosine[lit] * power[lit, number] * suns.hours[number] / 1000.0
        return total

    def clear_sky_beam(self, suns: SunIntervals) -> np.ndarray:
        """Return pvlib's beam of the clear sky (n, suns) at the cells' heights, W/m2."""
        low_m, high_m = float(self.height_m.min()), float(self.height_m.max()) + 1.0
        heights_m = np.linspace(low_m, high_m, int(np.ceil((high_m - low_m) / LIGHT_STEP_M)) + 1)
        light = clear_sky_light(suns, self.lon_deg, self.lat_deg, heights_m, None).beam
        position = np.interp(self.height_m, heights_m, np.arange(len(heights_m)))
        below = np.minimum(position.astype(int), len(heights_m) - 2)
        share = (position - below)[:, None]
        return np.asarray(light[below] + share * (light[below + 1] - light[below]))


def sample_cells(scene: Scene, view: MapView, count: int, seed: int = 1) -> SampledCells:
    """Return ``count`` random cells of a map with one pixel per cell, away from its rim and its holes."""
    nodes = bare_nodes(scene, view, 1)
    row, col = np.nonzero(binary_erosion(nodes.shows_ground, iterations=MARGIN_CELLS))
    sample = np.random.default_rng(seed).choice(len(row), min(count, len(row)), replace=False)
    row, col = row[sample], col[sample]
    window = int(view.row0) - HALO_NODES, int(view.col0) - HALO_NODES, view.rows + 2 * HALO_NODES, view.cols + 2 * HALO_NODES
    surface = scene.surface(view.grid).window(*window, nodes.frame)  # includes the rim that casts
    points = surface.position_frame_m
    around = np.array([[points[row + HALO_NODES + i, col + HALO_NODES + j] for j in (-1, 0, 1)] for i in (-1, 0, 1)])
    upwards = around[1, 1] - scene.world.up_origin(nodes.frame)
    upwards /= np.linalg.norm(upwards, axis=1, keepdims=True)
    middle_row, middle_col = view.centre_node
    x, y = view.grid.x(middle_col), view.grid.y(middle_row)
    lon, lat = scene.world.lon_lat(view.grid.crs, x, y)
    point, up = scene.world.points_at_zero_height(view.grid.crs, x, y)
    earth_from_enu = scene.world.earth_from_enu(point, up)
    return SampledCells(
        row, col, nodes.height_m[row, col].astype(np.float64), CellRays(surface.with_rim.sheet, around[1, 1], upwards), around,
        upwards, nodes.frame.directions_from_earth(earth_from_enu.T).T, float(lon), float(lat),
    )  # fmt: skip


@dataclass(frozen=True)
class BeamErrors:
    """Errors of the beam of cells, as shares of the cells' mean: the mean without sign, the 95th percentile, and the bias."""

    mean: float
    p95: float
    bias: float


def beam_errors(found: np.ndarray, truth: np.ndarray) -> BeamErrors:
    """Return the errors of values (n,) beside those of truth (n,)."""
    error = (found - truth) / truth.mean()
    return BeamErrors(float(np.abs(error).mean()), float(np.percentile(np.abs(error), 95)), float(error.mean()))
