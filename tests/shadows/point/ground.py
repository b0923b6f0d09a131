"""Grounds with known horizons, as rasters of a metric CRS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from skugga.shadows.point.horizon import Surroundings, load_surroundings
from skugga.shadows.point.place import place_at
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING

CELL_M = 10.0


def flat_world(tmp_path: Path, make_scene: Callable[..., Scene], heights: np.ndarray, cell_m: float = CELL_M, **keys) -> Scene:
    """Return a scene over heights (rows, cols), odd numbers of nodes, whose middle node is at (0, 0)."""
    from tests.rasters import write_geotiff

    raster = write_geotiff(tmp_path / "dem.tif", heights.astype(np.float32), ENGINEERING, 0.0, 0.0, cell_m)
    return make_scene(raster, **keys)


def offsets_from_middle(side: int, cell_m: float = CELL_M) -> tuple[np.ndarray, np.ndarray]:
    """Return the nodes' distances east and north of the middle node, metres (side, side)."""
    axis_m = (np.arange(side) - side // 2) * cell_m
    return np.meshgrid(axis_m, -axis_m)


def middle_surroundings(scene: Scene, height_m: float = 0.0) -> Surroundings:
    """Return the middle of a flat world and its surroundings."""
    return load_surroundings(scene, place_at(scene, (0.0, 0.0), height_m=height_m))
