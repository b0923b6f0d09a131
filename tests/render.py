"""Rendering for tests: a scene and a view on the same path as for users."""

from __future__ import annotations

from typing import Any

import numpy as np
from morecantile import tms as matrix_sets

from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.describe import describe
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.scene import Scene


def plan_of(scene: Scene, view: MapView, **overrides: Any) -> Plan:
    """Return the plan of a map by the fixed rules. ``overrides`` replace keys of the level's ``shadows``."""
    return make_plan(describe(scene, view), scene.loaded.level, overrides)


def render(scene: Scene, view: MapView | None = None, **overrides: Any) -> Frame:
    """Return a frame. ``overrides`` are map_size, depth_bits, filter, algorithm."""
    view = view or scene.view()
    return render_frame(scene, view, plan_of(scene, view, **overrides))


def render_points(scene: Scene, view: MapView | None = None, **overrides: Any) -> Frame:
    """Return a frame without antialiasing of edges, its slower part. It suffices for tests of visibility at pixel centres."""
    view = view or scene.view()
    return render_frame(scene, view, plan_of(scene, view, **overrides), pixel_sampling="points")


def shadow(frame: Frame) -> np.ndarray:
    """Return the class of each pixel: True in shadow, False where lit or without a surface."""
    return np.nan_to_num(frame.visibility, nan=1.0) < 0.5


def block_at(lon: float, lat: float, zoom: int, tms: str = "WebMercatorQuad") -> MapView:
    """Return the block of the tile that contains a place."""
    matrix_set = matrix_sets.get(tms)
    tile = matrix_set.tile(lon, lat, zoom)
    row, col = (index * 256 // BLOCK_PX * BLOCK_PX for index in (tile.y, tile.x))
    return MapView(tile_grid(matrix_set, zoom), float(row), float(col), 1.0, 1.0, BLOCK_PX, BLOCK_PX)
