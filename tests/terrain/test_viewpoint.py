"""Proposed perspective views: they show the most interesting side of known ground."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import WGS84
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.viewpoint import find_viewpoint
from tests.rasters import ENGINEERING, write_geotiff

CELL_M = 30.0


def scene_of(folder: Path, heights: np.ndarray, crs: str = "EPSG:32633", cell_m: float = CELL_M, **options) -> Scene:
    """Return the scene of heights (rows, cols)."""
    raster = write_geotiff(folder / "dem.tif", heights.astype(np.float32), crs, 500e3, 5200e3, cell_m, **options)
    return build_scene(load_level(LevelSource(path=raster)))


def hills(rows: int = 160, cols: int = 160) -> np.ndarray:
    """Return heights of hills in metres (rows, cols)."""
    row, col = np.mgrid[:rows, :cols]
    return 600 + 250 * np.sin(col / 11) * np.cos(row / 9)


def picture_points_on_map(scene: Scene) -> np.ndarray:
    """Return map coordinates (n, 2) of the corners, edge centres and centre of the proposed picture.

    Rays meet the ground as a plane at its mean height. Upward rays have NaN.
    """
    spec = find_viewpoint(scene.world, scene.elevation, scene.sun)
    assert spec is not None
    level = scene.loaded.level
    loaded = scene.loaded.model_copy(update={"level": level.model_copy(update={"views": {"view": spec}})})
    view = build_scene(loaded).view("view")
    assert isinstance(view, PerspectiveView)
    frame = scene.world.frame_near_earth(view.eye_earth_m)
    eye = frame.points_from_earth(view.eye_earth_m)
    points = []
    for i, j in ((0, 0), (0, 0.5), (0, 1), (0.5, 0), (0.5, 0.5), (0.5, 1), (1, 0), (1, 0.5), (1, 1)):
        camera = np.array([(view.col0 + j * (view.cols - 1)), (view.row0 + i * (view.rows - 1)), view.focal_px])
        ray = frame.directions_from_earth(view.earth_from_camera @ camera)
        eye_height_m = eye[2] - float(np.nanmean(scene.elevation.overview.mean_heights_m))
        points.append(eye + ray * (eye_height_m / -ray[2]) if ray[2] < 0 else np.full(3, np.nan))
    x, y, _ = scene.world.map_position(scene.elevation.crs, frame.points_to_earth(np.array(points)))
    return np.column_stack([x, y])


def test_picture_is_filled_with_ground(tmp_path):
    scene = scene_of(tmp_path, hills())
    places = picture_points_on_map(scene)
    west, south, east, north = scene.elevation.bounds
    margin = 12 * CELL_M  # relief moves the points that rays meet
    assert np.isfinite(places).all()
    assert (places[:, 0] > west - margin).all() and (places[:, 0] < east + margin).all()
    assert (places[:, 1] > south - margin).all() and (places[:, 1] < north + margin).all()


def test_view_looks_at_relief_and_not_at_a_plain(tmp_path):
    """Only the north-east quarter has hills."""
    row, col = np.mgrid[:160, :160]
    ramp = np.clip((col - 80) / 10, 0, 1) * np.clip((80 - row) / 10, 0, 1)
    scene = scene_of(tmp_path, 100 + ramp * (hills() - 300))
    x, y = picture_points_on_map(scene)[4]
    assert x > 500e3 + 70 * CELL_M and y > 5200e3 - 95 * CELL_M


def test_sun_is_on_one_side_of_the_view(tmp_path):
    scene = scene_of(tmp_path, hills())
    spec = find_viewpoint(scene.world, scene.elevation, scene.sun)
    assert spec is not None and scene.sun is not None
    north, east = spec.target[1] - spec.eye[1], (spec.target[0] - spec.eye[0]) * np.cos(np.radians(spec.eye[1]))
    assert abs(np.sin(np.arctan2(east, north) - np.radians(scene.sun.azimuth_deg))) > 0.5


def test_view_avoids_holes(tmp_path):
    heights = hills()
    heights[:, :70] = -9999.0
    scene = scene_of(tmp_path, heights, nodata=-9999.0)
    assert (picture_points_on_map(scene)[:, 0] > 500e3 + 60 * CELL_M).all()


@pytest.mark.parametrize("crs", [ENGINEERING, "EPSG:4326", "EPSG:3031"])
def test_good_view_in_every_kind_of_crs(tmp_path, crs):
    scene = scene_of(tmp_path, hills()) if crs != "EPSG:4326" else None
    if crs == "EPSG:4326":
        raster = write_geotiff(tmp_path / "deg.tif", hills().astype(np.float32), crs, 12.0, 47.0, 3e-4)
        scene = build_scene(load_level(raster))
    elif crs != "EPSG:32633":
        raster = write_geotiff(
            tmp_path / "other.tif", hills().astype(np.float32), crs, 0.0, 1.5e6 if "3031" in crs else 0.0, CELL_M
        )
        scene = build_scene(load_level(raster))
    assert scene is not None and np.isfinite(picture_points_on_map(scene)[4]).all()


def test_view_of_a_wide_level_looks_at_rugged_ground(tmp_path):
    """The level is a plain of 1,000 km with mountains in a corner."""
    row, col = np.mgrid[:500, :500]
    heights = 50 + np.where((row < 60) & (col > 420), 1500 + 900 * np.sin(col / 3) * np.cos(row / 3), 0)
    scene = scene_of(tmp_path, heights, cell_m=2000.0)
    x, y = picture_points_on_map(scene)[4]
    assert x > 500e3 + 400 * 2000.0 and y > 5200e3 - 80 * 2000.0


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (2, 2)])
def test_too_little_ground_has_no_view(tmp_path, shape):
    elevation = Elevation(
        str(write_geotiff(tmp_path / "few.tif", np.full(shape, 5.0, np.float32), "EPSG:32633", 500e3, 5200e3, CELL_M))
    )
    scene = build_scene(load_level(tmp_path / "few.tif"))
    assert find_viewpoint(scene.world, elevation, scene.sun) is None


def test_coarse_cells_are_viewed_from_far_away(tmp_path):
    """Cells of a kilometre fill a dozen pixels of the picture, not a hundred."""
    row, col = np.mgrid[:300, :300]
    ridges = 1500 + 1200 * np.sin(col / 3) * np.cos(row / 4) * np.exp(-(((row - 150) / 60) ** 2))
    scene = scene_of(tmp_path, ridges, crs="EPSG:2193", cell_m=1000.0)
    spec = find_viewpoint(scene.world, scene.elevation, scene.sun)
    assert spec is not None
    (lon, lat, high_m), (to_lon, to_lat, _) = spec.eye, spec.target
    distance_m = float(np.hypot(WGS84.inv(lon, lat, to_lon, to_lat)[2], high_m))
    assert 1024 / (2 * np.tan(np.radians(spec.fov) / 2)) * 1000.0 / distance_m < 40.0
