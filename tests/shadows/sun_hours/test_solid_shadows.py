"""Sun hours among buildings: closed forms for a box on a floor, and for its roof in the shadow of a wall of ground."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from pyproj import Transformer

from skugga.shadows.sun_hours.sun_hours import SunHours, SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.terrain.facts import mesh_rays
from skugga.terrain.facts.mesh_rays import bvh_of
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff
from tests.shadows.sun_hours.test_sun_hours import (
    CELL_M,
    EAST,
    NORTH,
    SPRING,
    forbid_plan,
    grid_north_deg,
    raster_cell_view,
    sun_by_minute,
    window_of,
)

FOOTPRINT = 18, 22, 28, 32
"""First and last row, and first and last column (exclusive) of the cells on which the building stands."""


@pytest.fixture
def open_scene_with_building(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols) with a building of a height on the cells of ``FOOTPRINT``.

    Scenes are closed after the test.
    """
    scenes = []

    def make(heights: np.ndarray, building_m: float) -> Scene:
        write_geotiff(tmp_path / "ground.tif", heights.astype(np.float32), "EPSG:32632", EAST, NORTH, CELL_M)
        top, bottom, left, right = FOOTPRINT
        box = shapely.box(EAST + left * CELL_M, NORTH - bottom * CELL_M, EAST + right * CELL_M, NORTH - top * CELL_M)
        to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform
        geometry = json.loads(shapely.to_geojson(shapely.transform(box, to_degrees, interleaved=False)))
        feature = {"type": "Feature", "properties": {"high": building_m}, "geometry": geometry}
        (tmp_path / "house.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}), encoding="utf-8")
        level = tmp_path / "level.yaml"
        text = "version: 1\nterrain: {source: ground.tif}\nmeshes: [{source: house.geojson, height: high}]\nsun: none\n"
        level.write_text(text, encoding="utf-8")
        scenes.append(build_scene(load_level(level)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def hours_without_pictures(scene: Scene) -> SunHours:
    """Return the sun hours of all cells on a spring day by the default step. A picture of the shadows fails."""
    days = window_suns(scene.world, [window_of(scene, SPRING)])
    return sun_hours(scene, raster_cell_view(scene), days, SunRules(), forbid_plan)


def sun_directions(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return the minutes with the sun up on a spring day, and vectors (n, 3) towards it along the grid's east and north, and up."""
    minutes, azimuth, altitude = sun_by_minute(scene, SPRING)
    azimuth_of_grid, altitude = np.radians(azimuth - grid_north_deg(scene)), np.radians(altitude)
    towards = np.stack([np.sin(azimuth_of_grid), np.cos(azimuth_of_grid), np.tan(altitude)], axis=1)
    return minutes[altitude > 0.0], towards[altitude > 0.0]


def rays_meet_box(x_m: float, y_m: float, size_m: tuple[float, float, float], towards: np.ndarray) -> np.ndarray:
    """Return which rays from a point on a floor meet a box of a size on that floor, whose south-west corner is the origin."""
    enter, leave = np.zeros(len(towards)), np.full(len(towards), np.inf)
    for start, size, component in zip((x_m, y_m, 0.0), size_m, towards.T, strict=True):
        ends = np.stack([-start / component, (size - start) / component])
        enter, leave = np.maximum(enter, ends.min(axis=0)), np.minimum(leave, ends.max(axis=0))
    return enter < leave


def test_sun_hours_round_a_building_match_a_closed_form(open_scene_with_building):
    scene = open_scene_with_building(np.zeros((40, 60)), 45.0)
    result = hours_without_pictures(scene)
    _, towards = sun_directions(scene)
    top, bottom, left, right = FOOTPRINT
    size_m = (right - left) * CELL_M, (bottom - top) * CELL_M, 45.0
    hours = {}
    for cell in ((17, 30), (12, 30), (20, 33), (19, 24), (15, 36), (24, 30), (2, 2)):
        x_m, y_m = (cell[1] + 0.5 - left) * CELL_M, (bottom - cell[0] - 0.5) * CELL_M
        hours[cell] = 0.1 / 60.0 * (~rays_meet_box(x_m, y_m, size_m, towards)).sum()
        assert 60.0 * result.hours[cell] == pytest.approx(60.0 * hours[cell], abs=2.1), cell  # a step of two minutes
    assert hours[17, 30] < 4.0 and hours[24, 30] > 12.0  # north of the building, and south of it
    assert 60.0 * result.hours[20, 30] == pytest.approx(0.1 * len(towards), abs=0.5)  # the roof


def test_sun_hours_of_a_roof_behind_a_wall_of_ground(open_scene_with_building):
    heights = np.zeros((40, 90))
    heights[:, 50] = 80.0  # 20 cells to the east of the building
    scene = open_scene_with_building(heights, 30.0)
    result = hours_without_pictures(scene)
    minutes, towards = sun_directions(scene)
    clears_wall = towards[:, 2] * 20.0 * CELL_M > (80.0 - 30.0) * towards[:, 0]
    assert result.first[20, 30] == pytest.approx(minutes[clears_wall][0], abs=0.5)
    assert result.first[20, 30] < result.first[10, 30] - 20.0  # the ground beside it


def test_bounding_volumes_are_built_once(open_scene_with_building, monkeypatch):
    """Also if they exceed the limit of their cache, as those of a city of millions of triangles do."""
    scene, builds = open_scene_with_building(np.zeros((40, 60)), 45.0), []
    monkeypatch.setattr(mesh_rays.caster_bvh.cache, "limit_bytes", 1000)
    monkeypatch.setattr(mesh_rays, "bvh_of", lambda *args: builds.append(1) or bvh_of(*args))
    hours_without_pictures(scene)
    assert len(builds) == 1


def test_low_building_casts_in_a_level_of_any_extent(open_scene_with_building, monkeypatch):
    """Rays start beside the surface by a length that grows with the level only to a limit."""
    hours = [hours_without_pictures(open_scene_with_building(np.zeros((40, 60)), 1.0)).hours]
    monkeypatch.setattr(mesh_rays, "RAY_OFFSET_SHARE", 1.0)  # as in a level a million times as wide
    hours.append(hours_without_pictures(open_scene_with_building(np.zeros((40, 60)), 1.0)).hours)
    np.testing.assert_allclose(hours[1], hours[0], atol=2.1 / 60.0)


def test_roof_over_a_hole_has_sun_hours(open_scene_with_building):
    heights = np.zeros((40, 60))
    heights[19:21, 31:36] = np.nan
    result = hours_without_pictures(open_scene_with_building(heights, 45.0))
    expected = np.isnan(heights)
    expected[:, : FOOTPRINT[3]] = False
    np.testing.assert_array_equal(np.isnan(result.hours), expected)
    assert result.hours[19, 31] == pytest.approx(result.hours[19, 30], abs=1e-3)
