"""Shadow outlines in closed form. ``tests.hard_cases.test_places`` has them for every kind of CRS."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from pyproj import CRS
from scipy.spatial import ConvexHull

from skugga.terrain.casters.reach import find_reach, longest_shadow_m
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, transformer
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING
from tests.render import plan_of, render_points, shadow

BLOCK_HEIGHT_M = 100.0
ALTITUDE_DEG = 30.0
UNIT_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
SHADOW_LENGTH_M = BLOCK_HEIGHT_M / np.tan(np.radians(ALTITUDE_DEG))  # 173.2 m
TAN_ALTITUDE = np.tan(np.radians(ALTITUDE_DEG))


def block_raster(write_raster: Callable[..., Path], crs: str, x: float, y: float, cell: float, cells: int = 81) -> Path:
    """Write a raster of a block on a level floor around (x, y), and return its path.

    ``cell`` is the side of cells in units of ``crs``, and ``cells`` their number along a side.
    """
    heights = np.zeros((cells, cells), np.float32)
    middle = cells // 2
    heights[middle - 2 : middle + 3, middle - 2 : middle + 3] = BLOCK_HEIGHT_M
    half = cells * cell / 2
    return write_raster(heights, crs, x - half, y + half, cell)


def distance_outside_hull(points: np.ndarray, outline: np.ndarray) -> np.ndarray:
    """Return the distance of points (..., 2) outside the convex hull of an outline (n, 2) in metres; negative inside."""
    hull = ConvexHull(outline)
    return np.max(points @ hull.equations[:, :2].T + hull.equations[:, 2], axis=-1)


def check_block(scene: Scene, view: MapView, to_local: Callable, corners: np.ndarray, azimuth: float) -> None:
    """Check that the block's shadow on the ground lies between the outlines of its roof, and of its roof and foot.

    The foot is one cell wider than the roof on each side, because a raster's walls are a cell wide.
    """
    plan = plan_of(scene, view, filter=1, map_size=1024)
    texel = plan.settings["sun"]["relief"].cascades[0].texel_m
    texel_m = max(texel[0], texel[1] / np.sin(np.radians(ALTITUDE_DEG)))
    assert texel_m < 1.5
    frame = render_points(scene, view, filter=1, map_size=1024)
    cols, rows = np.meshgrid(view.col0 + np.arange(view.cols) * view.col_step, view.row0 + np.arange(view.rows) * view.row_step)
    middle = view.centre
    points = np.stack(to_local(view.grid.x(cols) - middle[0], view.grid.y(rows) - middle[1]), axis=-1)
    roof, foot = (np.stack(to_local(*(side * corners).T), axis=-1) for side in (2.0, 3.0))
    shadow_direction = -np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
    ground, in_shadow = frame.height_m == 0.0, shadow(frame)
    outside = distance_outside_hull(points, np.concatenate([foot, roof + SHADOW_LENGTH_M * shadow_direction]))
    inside = distance_outside_hull(points, np.concatenate([roof, roof + SHADOW_LENGTH_M * shadow_direction]))
    assert (in_shadow & ground & (outside > texel_m)).sum() == 0, "shadow beyond the outline"
    assert (~in_shadow & ground & (inside < -texel_m)).sum() == 0, "light inside the outline"


@pytest.mark.parametrize("azimuth", [180.0, 222.0])
def test_shadow_of_a_block_in_an_engineering_crs(gl, azimuth, write_raster, make_scene):
    scene = make_scene(block_raster(write_raster, ENGINEERING, 0.0, 0.0, 10.0), azimuth, ALTITUDE_DEG)
    view = scene.view(bounds=(-300, -300, 300, 300), size=(350, 350))
    check_block(scene, view, lambda x, y: (x, y), 10.0 * UNIT_CORNERS, azimuth)


@pytest.mark.parametrize(("step_m", "end_m"), [(0.0, 150.5 - 30.0 / TAN_ALTITUDE), (10.0, 150.5 - 20.0 / TAN_ALTITUDE)])
def test_shadow_of_a_wall_on_level_ground_and_a_step(gl, step_m, end_m, write_raster, make_scene):
    """A wall casts h / tan(a) across level ground. On a step the shadow is shorter by the step's height."""
    heights = np.zeros((41, 201), np.float32)
    heights[:, 150:153] = 30.0  # the wall's western upper edge lies at the centre of cell 150: x = 150.5
    heights[:, :125] = step_m
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 41.0, 1.0), azimuth=90.0, altitude=ALTITUDE_DEG)
    view = scene.view(bounds=(80, 18, 160, 23), size=(1280, 80))
    frame = render_points(scene, view, filter=1, map_size=2048)
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    ends = np.array([x[row].min() for row in shadow(frame)])
    np.testing.assert_allclose(ends, end_m, atol=0.15)  # a texel on the ground


@pytest.mark.parametrize("pixel_m", [10.0, 2.0])
def test_shadow_of_a_far_ridge_and_a_clipped_reach(gl, pixel_m, write_raster, make_scene):
    """A ridge of 1,500 m lies 39 km outside the view, under a sun at 2 degrees. Its shadow ends at the closed form on a sphere."""
    cell, rows, cols = 100.0, 400, 1000
    heights = np.zeros((rows, cols), np.float32)
    heights[:, 498:503] = 1500.0
    x0, y0 = 450_000.0, 5_020_000.0  # near UTM zone 33's central meridian: grid north is true north
    ridge_x = x0 + 502.5 * cell - cell / 2  # the ridge's eastern upper edge
    length = longest_shadow_m(1500.0, 2.0)
    assert length == pytest.approx(39_460, abs=20)
    west = ridge_x + 39_000.0
    bounds = (west, y0 - 21_000, west + 512 * pixel_m, y0 - 21_000 + 96 * pixel_m)
    frames = []
    for name, first in (("whole", 0), ("cut", 600)):
        raster = write_raster(heights[:, first:], "EPSG:32633", x0 + first * cell, y0, cell, name=f"{name}.tif")
        scene = make_scene(raster, 270.0, 2.0)
        # Sun angles count at the anchor, which the cut moves. The test means the sun of the whole raster.
        frames.append((scene, render_points(scene, scene.view(bounds=bounds, size=(512, 96)), filter=1)))
    (scene, full_frame), (_, clipped_frame) = frames
    assert not full_frame.reach.clipped and full_frame.reach.needed_m == pytest.approx(39_000, abs=1500)
    assert shadow(full_frame)[:, :40].all()
    assert clipped_frame.reach.clipped and clipped_frame.reach.used_m < clipped_frame.reach.needed_m
    assert not shadow(clipped_frame).any()


def test_reach_without_casters_reports_missing_ground(gl, write_raster, make_scene):
    """Level ground ends 700 m towards the sun, and an unknown mountain beyond could shade it.

    Some of a picture's points give the same reach as all of them.
    """
    raster = write_raster(np.zeros((120, 120), np.float32), "EPSG:32633", 450_000.0, 5_020_000.0, 30.0)
    to_degrees = transformer(CRS.from_epsg(32633), LONGITUDE_LATITUDE).transform
    eye, target = (
        [*to_degrees(451_800.0, 5_020_000.0 - south_m), above_m] for south_m, above_m in ((2_900.0, 120.0), (1_500.0, 0.0))
    )
    view_spec = {"kind": "perspective", "eye": eye, "target": target, "fov": 50, "size": [200, 150]}
    scene = make_scene(raster, 180.0, 40.0, views={"eye": view_spec})
    view = scene.view("eye")
    frame = render_points(scene, view)
    assert not frame.plan.casts_shadows
    assert frame.reach.clipped and frame.reach.used_m < frame.reach.needed_m
    full_reach = find_reach(scene, geometry_buffer(scene, view))
    assert frame.reach.needed_m == pytest.approx(full_reach.needed_m, rel=0.02)
    assert frame.reach.used_m == pytest.approx(full_reach.used_m, rel=0.02, abs=30.0)
