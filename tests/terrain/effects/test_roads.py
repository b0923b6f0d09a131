"""Roads and rivers on the ground: exact coverage, equal in neighbouring tiles, and no lines that break into dots."""

from __future__ import annotations

import json

import numba
import numpy as np
import pytest
import shapely
from pyogrio import raw

from skugga.terrain.errors import InputError
from skugga.terrain.ground.draped_lines import ASPHALT, RIVER, find_cell, line_index, pixel_share
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff


def make_scene_of_lines(folder, geometry: shapely.Geometry, **keys: object) -> Scene:
    """Return a flat scene of 2 km with a road file of one geometry, in metres of an engineering CRS."""
    write_geotiff(folder / "floor.tif", np.zeros((50, 50), np.float32), ENGINEERING, -1000.0, 1000.0, 40.0)
    fields = [np.array(["track"], object), np.array([7.0])]
    raw.write(
        folder / "roads.gpkg", shapely.to_wkb(np.array([geometry], object)), fields, ["highway", "breadth"],
        geometry_type=geometry.geom_type, crs=ENGINEERING,
    )  # fmt: skip
    level = {"version": 1, "terrain": {"source": "floor.tif"}, "roads": [{"source": "roads.gpkg", **keys}]}
    (folder / "level.yaml").write_text(json.dumps(level))
    return build_scene(load_level(folder / "level.yaml"))


@pytest.mark.parametrize("pixel_m", [0.5, 2.0, 10.0, 40.0])
def test_coverage_of_a_line_keeps_its_area(pixel_m):
    """The shares of pixels across a line sum to its width, wherever the pixels' borders lie."""
    for shift in (0.0, 0.3, 0.5):
        centres = (np.arange(-200, 200) + shift) * pixel_m
        total_m = pixel_m * sum(pixel_share(abs(centre), 5.0, pixel_m) for centre in centres)
        assert total_m == pytest.approx(5.0)


def test_lines_fade_before_they_vanish():
    shares = [pixel_share(0.0, 1.0, pixel_m) for pixel_m in (1.0, 8.0, 12.0, 15.0, 16.0, 20.0)]
    assert shares[0] == 1.0 and shares[1] == pytest.approx(1 / 8) and shares[-2:] == [0.0, 0.0]
    assert all(first >= second for first, second in zip(shares[:-1], shares[1:], strict=True))


@numba.njit
def _find_cell(x, y, index):
    return find_cell(x, y, index)


def test_cells_hold_every_segment_in_reach():
    rng = np.random.default_rng(5)
    ends_m, width_m = rng.uniform(-900, 900, (40, 4)), rng.uniform(1, 20, 40)
    index = line_index(ends_m, width_m, np.full(40, ASPHALT, np.uint8))
    for x, y in rng.uniform(-1000, 1000, (500, 2)):
        cell = _find_cell(x, y, index)
        members = set() if cell < 0 else set(index.members[index.first[cell] : index.first[cell + 1]])
        start, along = ends_m[:, :2], ends_m[:, 2:] - ends_m[:, :2]
        share = np.clip((((x, y) - start) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
        distance = np.linalg.norm(start + share[:, None] * along - (x, y), axis=1)
        assert set(np.flatnonzero(distance < 8.5 * width_m)) <= members


@pytest.mark.parametrize(("width", "expected_m"), [(None, 3.0), (4.5, 4.5), ("breadth", 7.0)])
def test_width_is_a_number_an_attribute_or_a_tag(tmp_path, width, expected_m):
    road = shapely.LineString([(-300, 0), (300, 0)])
    lines = make_scene_of_lines(tmp_path, road, width=width).objects.lines
    assert set(lines.index.width_m) == {expected_m} and RIVER not in lines.index.kind
    lengths = np.linalg.norm(lines.ends_earth_m[:, 1] - lines.ends_earth_m[:, 0], axis=1)
    assert lengths.max() <= 201.0 and lengths.sum() == pytest.approx(600.0, rel=1e-3)


def test_points_and_lines_off_the_terrain_are_errors(tmp_path):
    with pytest.raises(InputError, match="not lines"):
        make_scene_of_lines(tmp_path, shapely.Point(0, 0)).objects.lines  # noqa: B018
    with pytest.raises(InputError, match="no line of"):
        make_scene_of_lines(tmp_path, shapely.LineString([(9000, 0), (9900, 0)])).objects.lines  # noqa: B018
