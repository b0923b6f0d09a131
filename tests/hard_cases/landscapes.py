"""Terrains whose shadows are known in closed form, and views of them for every algorithm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import Geod, Transformer
from scipy.optimize import brentq

from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.visibility import fill_steps
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View
from tests.rasters import ENGINEERING

MERIDIAN_DEG, TIP_DEG = 15.0, 45.0
"""Longitude and latitude where the shadow of a distant ridge ends."""

GEODESIC = Geod(ellps="WGS84")


def tilted_plane(trial: Trial, slope_deg: float, aspect_deg: float) -> Path:
    """Return the raster of a plane 960 m wide, at height 0 in the middle, that descends by a slope towards an azimuth."""
    axis = (np.arange(96) - 47.5) * 10.0
    east, north = np.meshgrid(axis, -axis)
    aspect_rad = np.radians(aspect_deg)
    descent_m = np.tan(np.radians(slope_deg)) * (east * np.sin(aspect_rad) + north * np.cos(aspect_rad))
    name = f"plane_{slope_deg:g}_{aspect_deg:g}"
    return trial.raster((-descent_m).astype(np.float32), ENGINEERING, -480, 480, 10.0, name=name)


def plane_normal(slope_deg: float, aspect_deg: float) -> np.ndarray:
    """Return the unit normal (3,) of a plane by slope and aspect: east, north, up."""
    slope, aspect_rad = np.radians(slope_deg), np.radians(aspect_deg)
    return np.array([np.sin(slope) * np.sin(aspect_rad), np.sin(slope) * np.cos(aspect_rad), np.cos(slope)])


def views_of(trial: Trial, scene: Scene, size: int, **map_options: Any) -> Iterator[View]:
    """Return the map and the perspective view ``eye``; only the latter for algorithms without maps."""
    if trial.serves_maps:
        yield scene.view(size=(size, size), **map_options)
    yield scene.view("eye", size=(size, size))


SettingsChange = Callable[[AlgorithmSettings], AlgorithmSettings]


def with_changed_settings(rendered: RenderedView, change: SettingsChange) -> RenderedView:
    """Return the same picture by a plan with changed settings."""
    settings = {
        light: {kind: change(kind_settings) for kind, kind_settings in kinds.items()}
        for light, kinds in rendered.plan.settings.items()
    }
    plan = rendered.plan.model_copy(update={"settings": settings})
    log = PassLog()
    visibility = fill_steps(
        plan.steps_of_light(rendered.light), rendered.buffer, rendered.scene, rendered.casters, plan.effect_names, log
    )
    visibility[attached_shadow_mask(rendered.buffer, rendered.scene, rendered.light)] = 0.0
    visibility[~rendered.buffer.valid] = np.nan
    return replace(rendered, plan=plan, visibility=visibility, log=log)


@dataclass(frozen=True, eq=False)
class FarPeak:
    """A mesa in the south whose shadow ends ``length_m`` from its northern upper edge, under a sun in the south.

    ``edge`` is the middle of that edge in the raster's CRS. ``half_width`` is the lateral range that is compared, in the same
    units. ``map_bounds`` and the view ``eye`` of the scene show where the shadow ends.
    """

    scene: Scene
    length_m: float
    edge: tuple[float, float]
    half_width: float
    map_bounds: tuple[float, float, float, float]

    def lengths_m(self, rendered: RenderedView) -> np.ndarray:
        """Return the distance of a picture's points from the mesa's edge on the ground, (rows, cols), metres; NaN outside the
        lateral range.
        """
        frame = rendered.buffer.frame
        earth = frame.origin_earth_m + rendered.buffer.position_frame_m @ frame.frame_from_earth
        x, y, _ = self.scene.world.map_position(self.scene.elevation.crs, earth)
        in_lateral_range = np.abs(x - self.edge[0]) <= self.half_width
        result = np.full(x.shape, np.nan)
        if self.scene.world.is_flat:
            result[in_lateral_range] = y[in_lateral_range] - self.edge[1]
        else:
            edge = np.full(np.count_nonzero(in_lateral_range), self.edge[1])
            result[in_lateral_range] = GEODESIC.inv(x[in_lateral_range], edge, x[in_lateral_range], y[in_lateral_range])[2]
        return result

    def length_error(self, rendered: RenderedView) -> float:
        """Return the largest error of the shadow's length behind the mesa's middle, as a share of the length."""
        distance_m = self.lengths_m(rendered)
        dark, lit = distance_m[rendered.dark], distance_m[rendered.buffer.valid & ~rendered.dark]
        dark, lit = dark[np.isfinite(dark)], lit[np.isfinite(lit)]
        assert dark.size > 500 and lit.size > 500, "the end of the shadow is in the picture"
        return float(max(dark.max() - self.length_m, self.length_m - lit.min(), 0.0) / self.length_m)


def far_peak(trial: Trial, height_m: float, altitude_deg: float, view_radius_m: float, curved: bool) -> FarPeak:
    """Return a mesa 4 km wide on level ground. On the globe the sun's altitude applies at the anchor, where the shadow ends."""
    make = _peak_on_the_globe if curved else _peak_on_the_plane
    return make(trial, height_m, altitude_deg, view_radius_m)


def _mesa(rows: int, cols: int, edge_row: int, height_m: float) -> np.ndarray:
    """Return heights (rows, cols) of a plain with a mesa of 12 x 28 cells. ``edge_row`` is its northernmost row."""
    heights = np.zeros((rows, cols), np.float32)
    heights[edge_row : edge_row + 12, cols // 2 - 14 : cols // 2 + 14] = height_m
    return heights


def _peak_on_the_plane(trial: Trial, height_m: float, altitude_deg: float, view_radius_m: float) -> FarPeak:
    """Return a mesa in a flat world under a sun in the south. Views show a square of 2 ``view_radius_m`` round its shadow's end."""
    cell, cols = 250.0, 60
    length_m = height_m / np.tan(np.radians(altitude_deg))
    rows = round(length_m / cell) + 60
    edge_row = rows - 30
    raster = trial.raster(_mesa(rows, cols, edge_row, height_m), ENGINEERING, -cols * cell / 2, rows * cell, cell, name="plane")
    edge, tip = (rows - edge_row - 0.5) * cell, (rows - edge_row - 0.5) * cell + length_m
    eye = {"kind": "perspective", "eye": [0, tip - rows * cell / 2 - 2 * view_radius_m, 2 * view_radius_m], "fov": 50,
           "target": [0, tip - rows * cell / 2, 0]}  # fmt: skip
    scene = trial.scene(raster, (180, altitude_deg), name="plane", views={"eye": eye})
    return FarPeak(
        scene, length_m, (0.0, edge), 8 * cell, (-view_radius_m / 2, tip - view_radius_m, view_radius_m / 2, tip + view_radius_m)
    )


def _peak_on_the_globe(trial: Trial, height_m: float, altitude_deg: float, view_radius_m: float) -> FarPeak:
    """Return the mesa on the globe. In the meridian's plane the shadow ends where the ray past the edge meets the ellipsoid."""
    cell, cols, rows = 0.002, 60, 1001
    middle = rows // 2  # the centres of this row's cells lie on the parallel of the anchor
    earth = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)

    def point(lat: float, up_m: float = 0.0) -> np.ndarray:
        return np.array(earth.transform(MERIDIAN_DEG, lat, up_m))

    up = point(TIP_DEG, 1.0) - point(TIP_DEG)
    south = point(TIP_DEG - 1e-4) - point(TIP_DEG + 1e-4)
    south /= np.linalg.norm(south)
    to_sun = np.sin(np.radians(altitude_deg)) * up + np.cos(np.radians(altitude_deg)) * south
    east = np.cross(up, south)

    def above_ray(lat: float, edge_lat: float) -> float:
        """Return the height of the edge above the sun's ray to the ground at a latitude, metres."""
        return float(np.cross(point(edge_lat, height_m) - point(lat), to_sun) @ east)

    guess = brentq(lambda lat: above_ray(TIP_DEG, lat), TIP_DEG - 1.5, TIP_DEG - 0.05)
    edge_row = middle + round((TIP_DEG - guess) / cell)
    edge_lat = TIP_DEG - (edge_row - middle) * cell
    tip_lat = brentq(lambda lat: above_ray(lat, edge_lat), edge_lat + 0.05, TIP_DEG + 0.1)
    length_m = GEODESIC.inv(MERIDIAN_DEG, edge_lat, MERIDIAN_DEG, tip_lat)[2]
    raster = trial.raster(
        _mesa(rows, cols, edge_row, height_m), "EPSG:4326", MERIDIAN_DEG - cols * cell / 2, TIP_DEG + rows * cell / 2, cell,
        name="globe",
    )  # fmt: skip
    eye = {"kind": "perspective", "eye": [MERIDIAN_DEG, TIP_DEG - 2 * view_radius_m / 111_000, 2 * view_radius_m], "fov": 50,
           "target": [MERIDIAN_DEG, TIP_DEG, 0]}  # fmt: skip
    scene = trial.scene(raster, (180, altitude_deg), name="globe", views={"eye": eye})
    _, y = Transformer.from_crs("EPSG:4326", "EPSG:32633", always_xy=True).transform(MERIDIAN_DEG, tip_lat)
    bounds = (500_000 - view_radius_m / 2, y - view_radius_m, 500_000 + view_radius_m / 2, y + view_radius_m)
    return FarPeak(scene, length_m, (MERIDIAN_DEG, edge_lat), 8 * cell, bounds)
