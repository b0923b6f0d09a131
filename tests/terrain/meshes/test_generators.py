"""Generated scenes: expected triangle counts, closed bodies on the floor, reproducible results, and valid level files."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import shapely

from skugga.configs import LEVELS_FOLDER
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import MapSpec, MeshGenerator, PerspectiveSpec
from skugga.terrain.meshes.generators import GENERATORS, shapes
from skugga.terrain.scene import build_scene

TRIANGLE_COUNTS = {"boxgrid": 12_000, "rocks": 63_000, "street": 400, "room": 19_000, "water_tower": 12_500}
"""Counts of the thesis, section 7."""

GRAY = (0.5, 0.5, 0.5)
LEVELS = sorted(LEVELS_FOLDER.glob("thesis_*.yaml"))


@pytest.fixture(scope="module")
def scenes():
    """Meshes of all generators, by name."""
    return {name: generate() for name, generate in GENERATORS.items()}


def test_generators_equal_the_schema():
    assert set(GENERATORS) == set(get_args(MeshGenerator))


@pytest.mark.parametrize("name", TRIANGLE_COUNTS)
def test_triangle_counts_are_those_of_the_thesis(scenes, name):
    assert sum(len(body.triangles) for body in scenes[name]) == pytest.approx(TRIANGLE_COUNTS[name], rel=0.02)


@pytest.mark.parametrize("name", ["boxgrid", "street"])
def test_exact_triangle_counts(scenes, name):
    assert sum(len(body.triangles) for body in scenes[name]) == TRIANGLE_COUNTS[name]


@pytest.mark.parametrize("name", GENERATORS)
def test_bodies_are_closed_and_face_outwards(scenes, name):
    for number, body in enumerate(scenes[name]):
        assert body.is_closed, f"body {number}"
        assert body.volume_m3 > 0, f"body {number}"
        assert ((body.albedo > 0) & (body.albedo < 1)).all()


@pytest.mark.parametrize("name", GENERATORS)
def test_scenes_are_reproducible(scenes, name):
    for body, repeated_body in zip(scenes[name], GENERATORS[name](), strict=True):
        assert (body.vertices_m == repeated_body.vertices_m).all()
        assert (body.triangles == repeated_body.triangles).all()
        assert (body.albedo == repeated_body.albedo).all()


@pytest.mark.parametrize("name", GENERATORS)
def test_scenes_stand_on_the_ground_or_hover(scenes, name):
    lowest = min(body.vertices_m[:, 2].min() for body in scenes[name])
    if name in ("boxgrid", "tetrahedra"):
        assert lowest > 2
    elif name == "wood_hill":
        assert lowest < -10  # a footing, for slopes
    else:
        assert lowest == 0


def test_stones_have_flat_feet(scenes):
    standing_stones = [body for body in scenes["rocks"] if body.vertices_m[:, 2].min() < 1.0]
    assert len(standing_stones) == 5 * 21
    for body in standing_stones:
        assert (body.vertices_m[:, 2] == 0).sum() > 9


def test_lintels_rest_on_their_uprights(scenes):
    stones = scenes["rocks"][: len(scenes["rocks"]) // 5]
    lintels = [body.vertices_m for body in stones if body.vertices_m[:, 2].min() > 1.0]
    heads = [body.vertices_m[body.vertices_m[:, 2].argmax()] for body in stones if body.vertices_m[:, 2].min() == 0.0]
    assert len(lintels) == 12
    for lintel in lintels:
        below = [head for head in heads if np.linalg.norm(lintel[:, :2] - head[:2], axis=1).min() < 0.6 and head[2] > 3]
        assert len(below) >= 2
        assert all(head[2] > lintel[:, 2].min() for head in below)


def test_five_rings_are_copies(scenes):
    volumes = np.array([body.volume_m3 for body in scenes["rocks"]]).reshape(5, -1)
    assert volumes == pytest.approx(np.tile(volumes[0], (5, 1)))


def test_boxes_of_the_grid_do_not_touch(scenes):
    middles = np.array([body.vertices_m.mean(axis=0) for body in scenes["boxgrid"]])
    sides = np.array([np.ptp(body.vertices_m, axis=0) for body in scenes["boxgrid"]])
    assert len(middles) == 1000
    distance = np.abs(middles[:, None] - middles[None]).max(axis=2) + 100 * np.eye(1000)
    assert distance.min() > sides.max()


def test_figure_is_two_regular_tetrahedra_on_the_up_axis(scenes):
    points = np.concatenate([body.vertices_m for body in scenes["tetrahedra"]])
    assert np.ptp(points[:, 2]) == pytest.approx(30)
    for body in scenes["tetrahedra"]:
        assert len(body.triangles) == 4
        edges = np.linalg.norm(body.vertices_m[:, None] - body.vertices_m[None], axis=2)[np.triu_indices(4, 1)]
        assert edges == pytest.approx(np.full(6, edges[0]))
        assert body.vertices_m[:, :2].mean(axis=0) == pytest.approx([0, 0], abs=1e-12)


def test_wood_hill_is_convex(scenes):
    (body,) = scenes["wood_hill"]
    corner = body.vertices_m[body.triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    plane_distance = np.einsum("ij,kj->ik", normal, body.vertices_m) - np.einsum("ij,ij->i", normal, corner[:, 0])[:, None]
    assert plane_distance.max() < 1e-6


@pytest.mark.parametrize("path", LEVELS, ids=lambda path: path.stem)
def test_levels_load_and_fit_their_floor(scenes, path: Path):
    level = load_level(path).level
    assert "Sindholt" in level.attribution
    assert 2 * np.prod(level.terrain.flat.cells) == 20_000
    half = np.array(level.terrain.flat.size) / 2
    (mesh,) = level.meshes
    assert path.stem.removeprefix("thesis_").removesuffix("_sun") == mesh.generate
    for body in scenes[mesh.generate]:
        assert (np.abs(body.vertices_m[:, :2]) < half).all()
    assert (level.sun == "none") == (not path.stem.endswith("_sun")) == bool(level.lights)
    assert isinstance(level.views["map"], MapSpec)
    assert set(level.views) == {"main", "overview", "close", "map"}
    eyes = [view.eye for view in level.views.values() if isinstance(view, PerspectiveSpec)]
    assert all(view.size == (1280, 1024) for view in level.views.values() if isinstance(view, PerspectiveSpec))
    for position in [*eyes, *(light.position for light in level.lights.values())]:
        assert (np.abs(position[:2]) < half).all() and position[2] > 0


def test_each_thesis_scene_has_a_spot_and_a_sun_level():
    assert {path.stem for path in LEVELS} == {f"thesis_{name}{light}" for name in TRIANGLE_COUNTS for light in ("", "_sun")}


@pytest.mark.parametrize("stem", sorted({path.stem.removesuffix("_sun") for path in LEVELS}))
def test_sun_level_differs_only_in_its_light(stem):
    spot, sun = (load_level(LEVELS_FOLDER / f"{stem}{light}.yaml").level for light in ("", "_sun"))
    shared_keys = ("terrain", "meshes", "views", "attribution", "shadows", "effects")
    assert all(getattr(spot, key) == getattr(sun, key) for key in shared_keys)


def test_spatialace_has_ten_thousand_triangles():
    loaded = load_level(LEVELS_FOLDER / "spatialace.yaml")
    assert all(Path(source).is_file() for source in loaded.sources)
    level = loaded.level
    generated_ground = level.terrain.generate
    assert 2 * np.prod(np.array(generated_ground.size) / generated_ground.cell) == pytest.approx(10_000, rel=0.03)
    assert loaded.level.moving_keys == ("meshes.1",)
    assert [mesh.motion.spin for mesh in level.meshes if mesh.generate == "tetrahedra"] == [30]
    assert level.views["main"].size == (800, 600)


def test_spatialace_figure_flies_clear_of_trees():
    """The path starts at the position of the static figure, so that pictures of second 0 are unchanged."""
    scene = build_scene(load_level(LEVELS_FOLDER / "spatialace.yaml"))
    path = scene.objects.placement.visible_bodies[-1].motion.path
    trees = scene.objects.trees_in_crs(scene.elevation.crs)[:, :2]
    start_earth_m = path.at_second(0.0).point_earth_m
    np.testing.assert_array_equal(start_earth_m, scene.geolocator.point_above_ground((150, -22, 0), "here")[0])
    for seconds in np.arange(0.0, 40.0, 0.5):
        position_earth_m, _, above_m = path.at_second(float(seconds))
        assert np.linalg.norm(trees - position_earth_m[:2], axis=1).min() > 20.0 and 0.0 <= above_m <= 20.0
        np.testing.assert_allclose(path.at_second(float(seconds) + 400.0).point_earth_m, position_earth_m, atol=1e-6)
    assert path.at_second(20.0).above_ground_m == pytest.approx(20.0)


# Shapes, compared with known volumes.


def test_tube_and_lathe_are_regular_prisms():
    area = 0.5 * 12 * np.sin(2 * np.pi / 12)  # a regular 12-gon in the unit circle
    bar = shapes.tube([(1, 2, 3), (1, 6, 6)], 1.0, 12, GRAY)
    assert bar.is_closed and len(bar.triangles) == 4 * 12
    assert bar.volume_m3 == pytest.approx(5 * area)
    can = shapes.lathe([(0, 0), (1, 0), (1, 5), (0, 5)], 12, GRAY)
    assert can.is_closed and len(can.triangles) == 4 * 12
    assert can.volume_m3 == pytest.approx(5 * area)


def test_ring_has_the_volume_of_its_prisms():
    washer = shapes.ring([(1, 0), (2, 0), (2, 0.5), (1, 0.5)], 6, GRAY)
    assert washer.is_closed and len(washer.triangles) == 2 * 4 * 6
    assert washer.volume_m3 == pytest.approx(0.5 * (4 - 1) * 0.5 * 6 * np.sin(np.pi / 3))


def test_bent_tube_and_loft_are_closed():
    hoop = shapes.tube(shapes.arc((0, 0, 1), 2.0, -90, 90, 9), 0.1, 6, GRAY)
    assert hoop.is_closed and hoop.volume_m3 == pytest.approx(np.pi * 2 * 0.5 * 6 * 0.01 * np.sin(np.pi / 3), rel=0.03)
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], float)
    assert shapes.loft(np.stack([square, square + [0, 0, 2]]), GRAY).volume_m3 == pytest.approx(2)


@pytest.mark.parametrize("end", [(4.0, 0.0), (0.0, 4.0), (-2.4, -3.2)])
def test_wall_stands_left_of_its_line(end):
    pane = shapely.Polygon([(0, 0), (4, 0), (4, 3), (0, 3)], [[(1, 1), (1, 2), (3, 2), (3, 1)]])
    body = shapes.wall(pane, (0.0, 0.0), end, 0.5, GRAY)
    assert body.is_closed
    assert body.volume_m3 == pytest.approx((12 - 2) * 0.5)
    assert body.vertices_m[:, 2].min() == 0 and body.vertices_m[:, 2].max() == 3
    left = np.array([-end[1], end[0]]) / 4
    line_distance = body.vertices_m[:, :2] @ left
    assert line_distance.min() == pytest.approx(0) and line_distance.max() == pytest.approx(0.5)


def test_cell_box_is_the_cube():
    points, triangles = shapes.cell_box((3, 4, 5))
    body = shapes.solid(points, triangles, GRAY)
    assert body.is_closed and len(triangles) == 4 * (12 + 20 + 15)
    assert body.volume_m3 == pytest.approx(8)
    assert np.abs(points).max(axis=1) == pytest.approx(np.ones(len(points)))


def test_gable_and_cuboid_volumes():
    roof = shapes.gable((0, 0), (4, 10), 3.0, 5.0, GRAY)
    assert roof.is_closed and len(roof.triangles) == 8
    assert roof.volume_m3 == pytest.approx(4 * 2 / 2 * 10)
    assert shapes.cuboid((0, 0, 1), (1, 2, 4), GRAY).volume_m3 == pytest.approx(6)
