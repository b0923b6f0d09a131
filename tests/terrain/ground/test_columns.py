"""Column surfaces: cells with flat tops and vertical walls, in maps of any CRS."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.errors import LevelError
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.ground.columns import Columns
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

UTM = "EPSG:32632"


def scene_of(
    folder: Path, heights: np.ndarray, crs: str, cell: Any, x0: float = 0.0, y0: float | None = None, **keys: Any
) -> Scene:
    """Return the scene of a raster as columns, with the south-west corner at (0, 0) by default."""
    options = {"transform": keys.pop("transform")} if "transform" in keys else {}
    north = len(heights) * (cell[1] if isinstance(cell, tuple) else cell) if y0 is None else y0
    source = write_geotiff(folder / "dsm.tif", heights.astype(np.float32), crs, x0, north, cell, **options)
    level = {"version": 1, "terrain": {"source": str(source), "surface": "blocks"}, "sun": {"azimuth": 200, "altitude": 25}, **keys}
    (folder / "level.yaml").write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(folder / "level.yaml"))


def test_sheet_has_a_top_per_cell_and_walls_at_height_steps(tmp_path: Path):
    scene = scene_of(tmp_path, np.array([[1.0, 1.0, 5.0], [2.0, 1.0, np.nan]]), ENGINEERING, 2.0)
    columns = Columns(scene.world, scene.elevation, 0)
    sheet = columns.window(0, 0, 2, 3, scene.world.frame_near_earth(np.zeros(3))).sheet
    corners = sheet.position_frame_m.reshape(-1, 3)[sheet.triangles]
    col_side, row_side = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(col_side, row_side)
    area = np.linalg.norm(normal, axis=1) / 2.0
    tops = normal[:, 2] > 0.5
    assert (area > 0.0).all() and set(corners[tops][:, :, 2].ravel()) == {1.0, 2.0, 5.0}
    assert area[tops].sum() == pytest.approx(6 * 4.0)  # the hole is filled for casting
    assert not normal[~tops][:, 2].any()  # walls are upright
    filled_height_m = sheet.height_m[1, 2]
    steps = abs(np.diff(sheet.height_m, axis=0)).sum() + abs(np.diff(sheet.height_m, axis=1)).sum()
    assert area[~tops].sum() == pytest.approx(2.0 * steps) and np.isfinite(filled_height_m)


def test_cell_grid_follows_cell_sides_and_level_of_detail(tmp_path: Path):
    heights = np.arange(48.0).reshape(6, 8)
    scene = scene_of(tmp_path, heights, UTM, (3.0, 2.0), 500000.0, 5000000.0)
    fine_columns, coarse_columns = (Columns(scene.world, scene.elevation, level) for level in (0, 1))
    assert (fine_columns.grid.x(7.0), fine_columns.grid.y(5.0)) == pytest.approx((500022.5, 4999989.0))
    assert (coarse_columns.grid.x(0.0), coarse_columns.grid.y(0.0)) == pytest.approx((500003.0, 4999998.0))
    assert fine_columns.grid.row(fine_columns.grid.y(2.5)) == pytest.approx(2.5)
    np.testing.assert_array_equal(fine_columns.heights(0, 0, 6, 8)[0], heights)
    np.testing.assert_array_equal(coarse_columns.heights(0, 0, 3, 4)[0], heights.reshape(3, 2, 4, 2).mean(axis=(1, 3)))


@pytest.mark.parametrize("crs", ["EPSG:3857", "EPSG:32633"])
def test_pixel_of_another_crs_shows_the_centre_of_its_column(tmp_path: Path, crs: str):
    heights = np.random.default_rng(1).uniform(0.0, 30.0, (40, 40))
    scene = scene_of(tmp_path, heights, UTM, 10.0, 500000.0, 5000000.0)
    buffer = geometry_buffer(scene, scene.view(crs=crs, size=(150, 150)))
    x, y, height = scene.world.map_position(
        scene.elevation.crs, buffer.frame.points_to_earth(buffer.position_frame_m[buffer.valid])
    )
    row, col = scene.elevation.cell_of(x, y)
    assert buffer.valid.mean() > 0.5
    np.testing.assert_allclose([row, col], np.rint([row, col]), atol=1e-4)
    np.testing.assert_allclose(height, heights.astype(np.float32)[np.rint(row).astype(int), np.rint(col).astype(int)], atol=1e-3)
    np.testing.assert_array_equal(buffer.normal_frame, buffer.shading_normal_frame)


def test_higher_cell_wins_on_a_border(tmp_path: Path):
    scene = scene_of(tmp_path, np.array([[1.0, 9.0, 3.0], [1.0, 2.0, 3.0]]), ENGINEERING, 1.0)
    view = scene.view(bounds=(0.5, 0.0, 2.5, 2.0), size=(2, 1))  # two pixels of 1 m by 2 m, with their centres on corners
    assert geometry_buffer(scene, view).height_m.tolist() == [[9.0, 9.0]]


@pytest.mark.parametrize(
    ("text", "allowed"),
    [
        ("terrain: {source: jacksboro, surface: cubes}\n", "'smooth' or 'blocks'"),
        (
            "terrain: {source: jacksboro, surface: blocks}\n"
            "views: {eye: {kind: perspective, eye: [-84.3, 36.6, 50], target: [-84.2, 36.6, 0]}}\n",
            "smooth: blocks works in maps only, and eye is a perspective view",
        ),
    ],
)
def test_invalid_surface_names_its_key(tmp_path: Path, text: str, allowed: str):
    (tmp_path / "level.yaml").write_text("version: 1\n" + text, encoding="utf-8")
    with pytest.raises(LevelError, match="terrain.surface") as caught:
        load_level(tmp_path / "level.yaml")
    assert allowed in str(caught.value)


def test_rotated_raster_is_rejected(tmp_path: Path):
    from affine import Affine

    with pytest.raises(LevelError, match=r"terrain\.surface.*blocks.*smooth"):
        scene_of(tmp_path, np.ones((4, 4)), UTM, 1.0, transform=Affine(1.0, 0.5, 500000.0, 0.5, -1.0, 5000000.0))


def test_meshes_stand_on_column_tops(tmp_path: Path):
    heights = np.zeros((20, 20))
    heights[:, 10:] = 12.0
    scene = scene_of(
        tmp_path,
        heights,
        ENGINEERING,
        1.0,
        meshes=[{"generate": "tetrahedra", "at": [0.3, 0.0]}, {"generate": "rocks", "at": [-5, 3]}],
    )
    assert scene.elevation.ground_m(10.1, 10.0) == 12.0 and scene.elevation.ground_m(9.9, 10.0) == 0.0
    buffer = geometry_buffer(scene, scene.view(size=(40, 40)))
    rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
    assert lit_mask(buffer, scene, "sun", rays).any()
