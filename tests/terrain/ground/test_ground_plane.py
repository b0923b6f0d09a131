"""Ground that lies in one plane: rasters of constant slope in a flat world, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.ground.ground_plane import ground_plane

ROW, COL = np.mgrid[:40, :50].astype(np.float64)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.5, 0.0), (-0.31, 0.27), (1e-3, 2.0)])
@pytest.mark.parametrize("height_m", [0.0, 120.0, 2500.0])
def test_ground_plane_of_a_constant_slope(write_raster, make_scene, slope, height_m):
    """The slope is that of the heights, per cell of 2 m, east and south. Corners lie on the raster's corner cells."""
    heights = height_m + 2.0 * slope[0] * COL + 2.0 * slope[1] * ROW
    scene = make_scene(write_raster(heights.astype(np.float32), ENGINEERING_CRS_WKT, 10, 90, 2.0))
    plane = ground_plane(scene.world, scene.elevation)
    frame = scene.world.frame_near_earth(scene.world.anchor_earth_m)
    normal = np.array([-slope[0], slope[1], 1.0])
    np.testing.assert_allclose(plane.normal_in_frame(frame), normal / np.linalg.norm(normal), atol=1e-5)
    # earth-fixed coordinates of a flat world begin in the raster's middle
    expected = [[-49, 39, heights[0, 0]], [49, 39, heights[0, -1]], [49, -39, heights[-1, -1]], [-49, -39, heights[-1, 0]]]
    np.testing.assert_allclose(plane.corners_earth_m, expected, rtol=1e-6, atol=1e-3)


def test_ground_plane_refuses_a_millimetre(write_raster, make_scene):
    """One cell that is a millimetre higher is a step: float32 resolves 8 micrometres at 100 m."""
    for bump_m, is_plane in ((0.0, True), (1e-3, False)):
        heights = 100.0 + 0.25 * COL
        heights[20, 20] += bump_m
        scene = make_scene(write_raster(heights.astype(np.float32), ENGINEERING_CRS_WKT, 0, 80, 2.0, name=f"{bump_m}.tif"))
        assert (ground_plane(scene.world, scene.elevation) is not None) is is_plane


@pytest.mark.parametrize("case", ["hole", "blocks", "earth"])
def test_ground_plane_refuses_other_ground(write_raster, make_scene, case):
    """A raster with a hole has a rim inside; blocks are steps; on the earth a slope bends with it."""
    heights = (100.0 + 0.25 * COL).astype(np.float32)
    if case == "hole":
        heights[20, 20] = np.nan
    raster = write_raster(heights, "EPSG:32632" if case == "earth" else ENGINEERING_CRS_WKT, 500000, 5200000, 2.0)
    scene = make_scene(raster, terrain={"surface": "blocks"} if case == "blocks" else {})
    assert ground_plane(scene.world, scene.elevation) is None
