"""Assembly of meshes: position, orientation, motion, caster meshes, and rejected input."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pyproj import CRS

from skugga.terrain.errors import LevelError, SourceError
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, geocentric, transformer
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes.assemble import place_meshes, solids
from skugga.terrain.meshes.body import srgb_albedo
from skugga.terrain.scene import build_scene

UTM = "EPSG:32633"
FLOOR_TERRAIN = {"flat": {"size": [200, 100], "cells": [20, 10]}}


@pytest.fixture
def scene_of(tmp_path):
    """Return ``scene_of(terrain, *meshes)``, which builds the scene of a level.

    The level's folder contains an arrow (12 triangles) and a ball (320 triangles).
    """
    arrow = trimesh.creation.box(extents=(6, 2, 4))
    arrow.apply_translation((3, 0, 2))
    arrow.export(tmp_path / "arrow.ply")
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / "ball.ply")

    def make(terrain: dict, *meshes: dict):
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps({"version": 1, "terrain": terrain, "meshes": meshes}), encoding="utf-8")
        return build_scene(load_level(path))

    return make


def lon_lat_of(x: float, y: float) -> tuple[float, float]:
    """Return longitude and latitude of a position in UTM."""
    return transformer(CRS(UTM), LONGITUDE_LATITUDE).transform(x, y)


def assemble_solids(scene, seconds: float = 0.0):
    """Return the solids of a scene at a time, seconds."""
    return solids(place_meshes(scene.loaded, scene.world, scene.elevation), seconds)


@pytest.fixture
def hill(write_raster) -> Path:
    """Write a raster of 4 km a side that rises 1 m per 10 m east, from 100 m."""
    return write_raster(np.tile(np.arange(400, dtype=np.float32) + 100, (400, 1)), UTM, 500000, 5004000, 10)


def test_level_without_meshes_has_no_solids(scene_of):
    scene = scene_of(FLOOR_TERRAIN)
    assert scene.objects.solids is None and not len(assemble_solids(scene).triangles)
    assert not scene.objects.solid_creases.size and scene.objects.tallest_object_m == 0


def test_model_is_placed_turned_and_scaled(scene_of):
    mesh = {"source": "arrow.ply", "at": [20, 10], "scale": 2, "turn": 90, "color": [0.5, 0.5, 0.5]}
    result = assemble_solids(scene_of(FLOOR_TERRAIN, mesh))
    np.testing.assert_allclose(result.vertices_earth_m.min(axis=0), [18, 10, 0], atol=1e-6)
    np.testing.assert_allclose(result.vertices_earth_m.max(axis=0), [22, 22, 8], atol=1e-6)
    np.testing.assert_allclose(result.albedo, np.tile(srgb_albedo((0.5, 0.5, 0.5)), (12, 1)))
    assert result.is_closed == (True,)
    assert result.triangles.dtype == np.int32 and result.albedo.dtype == np.float32
    assert result.caster_vertices_earth_m is result.vertices_earth_m and result.caster_triangles is result.triangles


def test_normals_turn_with_the_body(scene_of):
    result = assemble_solids(scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "turn": 30}))
    corner = result.vertices_earth_m[result.triangles]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    np.testing.assert_allclose(result.corner_normals_earth, np.repeat(face[:, None], 3, axis=1), atol=1e-6)
    assert result.corner_normals_earth.dtype == np.float32


def test_spinning_model_rotates_around_its_up_axis(scene_of):
    scene = scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "at": [20, 10], "motion": {"spin": 30}})
    at_start, after_quarter_turn, after_full_turn = (assemble_solids(scene, seconds) for seconds in (0.0, 3.0, 12.0))
    arm = at_start.vertices_earth_m - (20, 10, 0)
    np.testing.assert_allclose(
        after_quarter_turn.vertices_earth_m - (20, 10, 0), arm @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-9
    )
    np.testing.assert_allclose(after_full_turn.vertices_earth_m, at_start.vertices_earth_m, atol=1e-9)
    assert scene.loaded.level.moving_keys == ("meshes.0",)


def make_path_scene(scene_of, **motion):
    """Return a scene of an arrow that moves for eight seconds."""
    keys = [{"seconds": 0, "position": [-40, -30]}, {"seconds": 8, "position": [40, 30, 5]}]
    return scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "turn": -90, "motion": {"path": keys, **motion}})


def test_model_on_a_path_follows_its_keys(scene_of):
    """Without ``face``, only ``turn`` applies: the arrow, which points east, points south."""
    scene = make_path_scene(scene_of)
    for seconds, origin in (
        (-9.0, (-40, -30, 0)),
        (0.0, (-40, -30, 0)),
        (4.0, (0, 0, 2.5)),
        (8.0, (40, 30, 5)),
        (1e6, (40, 30, 5)),
    ):
        corners = assemble_solids(scene, seconds).vertices_earth_m - origin
        np.testing.assert_allclose(corners.min(axis=0), [-1, -6, 0], atol=1e-6)
        np.testing.assert_allclose(corners.max(axis=0), [1, 0, 4], atol=1e-6)
    assert scene.at_second(4.0).objects.tallest_object_m == pytest.approx(6.5) and scene.loaded.level.moving_keys == ("meshes.0",)


def test_face_along_points_the_south_side_forward(scene_of):
    """The arrow, turned to the south, points along its path: 4 east for 3 north. A spin adds to this direction."""
    forward = np.array([0.8, 0.6, 0.0])
    for scene, seconds, direction in (
        (make_path_scene(scene_of, face="along"), 0.0, forward),
        (make_path_scene(scene_of, face="along"), 4.0, forward),
        (make_path_scene(scene_of, face="along", spin=45), 2.0, np.array([-0.6, 0.8, 0.0])),
    ):
        result = assemble_solids(scene, seconds)
        origin = scene.objects.placement.visible_bodies[0].motion.path.at_second(seconds).point_earth_m
        along_m = (result.vertices_earth_m - origin) @ direction
        across_m = (result.vertices_earth_m - origin) @ np.cross([0, 0, 1], direction)
        assert (along_m.min(), along_m.max()) == pytest.approx((0, 6), abs=1e-4)
        assert (across_m.min(), across_m.max()) == pytest.approx((-1, 1), abs=1e-4)
        corner = result.vertices_earth_m[result.triangles]
        face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        face /= np.linalg.norm(face, axis=1, keepdims=True)
        np.testing.assert_allclose(result.corner_normals_earth, np.repeat(face[:, None], 3, axis=1), atol=1e-6)


def test_path_moves_all_bodies_and_their_casters(scene_of):
    keys = [{"seconds": 0, "position": [-40, -30]}, {"seconds": 8, "position": [40, 30, 5]}]
    scene = scene_of(FLOOR_TERRAIN, {"generate": "tetrahedra", "caster": "arrow.ply", "motion": {"path": keys}})
    before, after = assemble_solids(scene, 0.0), assemble_solids(scene, 8.0)
    shift = np.broadcast_to([80, 60, 5], before.vertices_earth_m.shape)
    np.testing.assert_allclose(after.vertices_earth_m - before.vertices_earth_m, shift, atol=1e-9)
    np.testing.assert_allclose((after.caster_vertices_earth_m - before.caster_vertices_earth_m)[:8], shift[:8], atol=1e-9)
    assert len(after.caster_triangles) == 12


def test_path_at_second_zero_equals_static_model(scene_of):
    """A level whose mesh is set in motion keeps its picture at the first second, bit for bit."""
    static_scene = scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "at": [20.1, 10.7], "motion": {"spin": 30}})
    keys = [{"seconds": 0, "position": [20.1, 10.7]}, {"seconds": 7, "position": [0, 0, 9]}]
    path_scene = scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "motion": {"path": keys, "spin": 30}})
    np.testing.assert_array_equal(assemble_solids(path_scene).vertices_earth_m, assemble_solids(static_scene).vertices_earth_m)
    np.testing.assert_array_equal(
        assemble_solids(path_scene).corner_normals_earth, assemble_solids(static_scene).corner_normals_earth
    )


def test_model_on_a_path_is_upright_on_the_globe(scene_of, hill):
    """Halfway up the hill, which rises 1 m per 10 m, the model stands on the ground with its nose to the east."""
    keys = [{"seconds": n * 10, "position": list(lon_lat_of(x, 5001000))} for n, x in enumerate((501000, 503000))]
    scene = scene_of({"source": str(hill)}, {"source": "arrow.ply", "turn": -90, "motion": {"path": keys, "face": "along"}})
    lon, lat = lon_lat_of(502000, 5001000)
    point, up = geocentric(np.float64(lon), np.float64(lat))
    ground = 100 + (2000 - 5) / 10
    local = (assemble_solids(scene, 5.0).vertices_earth_m - (point + ground * up)) @ scene.world.earth_from_enu(point, up)
    np.testing.assert_allclose(local.min(axis=0), [0, -1, 0], atol=2e-2)
    np.testing.assert_allclose(local.max(axis=0), [6, 1, 4], atol=2e-2)


def test_another_second_reads_no_file_again(scene_of, monkeypatch, tmp_path):
    shell = trimesh.creation.icosphere(subdivisions=2)
    shell.invert()
    shell.export(tmp_path / "shell.ply")
    scene = scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "at": [20, 10], "motion": {"spin": 30}}, {"source": "shell.ply"})
    at_rest = scene.objects
    later_objects = scene.at_second(3.0).objects
    assert at_rest.at_second(0.0) is at_rest and later_objects.placement is at_rest.placement
    monkeypatch.setattr("skugga.terrain.meshes.assemble.place_meshes", None)
    np.testing.assert_array_equal(later_objects.solids.vertices_earth_m, assemble_solids(scene, 3.0).vertices_earth_m)
    assert abs(later_objects.solids.vertices_earth_m - at_rest.solids.vertices_earth_m).max() > 5
    # The arrow has only edges. Facets of the shell, which is seen from inside, differ by some degrees.
    assert later_objects.solid_creases is at_rest.solid_creases and (at_rest.solid_creases[:12] == 0).all()
    assert 0.1 < at_rest.solid_creases[12:].min() and at_rest.solid_creases.max() < 0.5


def test_meshes_without_motion_ignore_the_clock(scene_of):
    objects = scene_of(FLOOR_TERRAIN, {"source": "ball.ply", "scale": 4}).objects
    assert objects.at_second(9.0) is objects
    assert objects.tallest_object_m == pytest.approx(8.0)


def test_several_positions_are_several_bodies(scene_of):
    result = assemble_solids(scene_of(FLOOR_TERRAIN, {"source": "arrow.ply", "at": [[0, 0], [50, 20]]}, {"source": "ball.ply"}))
    assert result.is_closed == (True, True, True)
    assert np.bincount(result.body_index).tolist() == [12, 12, 320]
    assert result.triangles.max() == len(result.vertices_earth_m) - 1
    shift = result.vertices_earth_m[8:16] - result.vertices_earth_m[:8]
    np.testing.assert_allclose(shift, np.tile([50, 20, 0], (8, 1)), atol=1e-9)


def test_caster_mesh_stands_in_place_of_its_model(scene_of):
    meshes = (
        {"source": "ball.ply", "at": [[10, 0], [-30, 5]], "scale": 3, "caster": "arrow.ply"},
        {"source": "arrow.ply", "at": [60, 0]},
    )
    result = assemble_solids(scene_of(FLOOR_TERRAIN, *meshes))
    assert len(result.triangles) == 2 * 320 + 12
    assert len(result.caster_triangles) == 3 * 12
    first = result.caster_vertices_earth_m[:8]
    np.testing.assert_allclose(first.min(axis=0), [10, -3, 0], atol=1e-6)
    np.testing.assert_allclose(first.max(axis=0), [28, 3, 12], atol=1e-6)


def test_generated_mesh_is_placed_at_its_position(scene_of):
    result = assemble_solids(scene_of(FLOOR_TERRAIN, {"generate": "tetrahedra", "at": [5, 5]}, {"generate": "tetrahedra"}))
    half = len(result.vertices_earth_m) // 2
    np.testing.assert_allclose(result.vertices_earth_m[:half] - (5, 5, 0), result.vertices_earth_m[half:], atol=1e-9)


def test_model_is_upright_on_the_globe(scene_of, hill):
    lon, lat = lon_lat_of(503000, 5001000)
    scene = scene_of({"source": str(hill)}, {"source": "arrow.ply", "at": [lon, lat]})
    result = assemble_solids(scene)
    point, up = geocentric(np.float64(lon), np.float64(lat))
    axes = scene.world.earth_from_enu(point, up)
    ground = 100 + (3000 - 5) / 10
    local = (result.vertices_earth_m - (point + ground * up)) @ axes
    np.testing.assert_allclose(local.min(axis=0), [0, -1, 0], atol=1e-2)
    np.testing.assert_allclose(local.max(axis=0), [6, 1, 4], atol=1e-2)


def test_model_without_a_position_stands_at_the_anchor(scene_of, hill):
    scene = scene_of({"source": str(hill)}, {"source": "ball.ply"})
    x, y, _ = scene.world.map_position(scene.elevation.crs, assemble_solids(scene).vertices_earth_m.mean(axis=0))
    assert (float(x), float(y)) == pytest.approx((scene.world.anchor_x, scene.world.anchor_y), abs=0.01)


def test_holes_under_a_model_are_filled(scene_of, write_raster):
    heights = np.full((40, 40), 80.0, np.float32)
    heights[15:25, 15:25] = np.nan
    dem = write_raster(heights, UTM, 500000, 5000400, 10)
    scene = scene_of({"source": str(dem)}, {"source": "ball.ply"})
    height = scene.world.map_position(scene.elevation.crs, assemble_solids(scene).vertices_earth_m)[2]
    assert height.min() == pytest.approx(80.0, abs=1e-3)
    assert scene.objects.tallest_object_m == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize(
    "mesh, kind, expected_text",
    [
        ({"source": "arrow.ply", "at": [101, 0]}, None, []),  # on the outermost half cell
        ({"source": "arrow.ply", "at": [120, 0]}, LevelError, ["meshes.0.at", "(120.0, 0.0)", "-105.00, -55.00, 105.00, 55.00"]),
        ({"source": "arrow.ply", "at": [[0, 0], [0, 80]]}, LevelError, ["meshes.0.at", "(0.0, 80.0)", "within"]),
        (
            {"source": "arrow.ply", "motion": {"path": [{"seconds": n, "position": [n * 80, 0]} for n in range(3)]}},
            LevelError, ["meshes.0.motion.path.2.position", "(160.0, 0.0, 0.0)", "-105.00, -55.00, 105.00, 55.00"],
        ),
        (
            {"source": "arrow.ply", "motion": {"path": [{"seconds": n, "position": [n, 0, 2 - 4 * n]} for n in range(2)]}},
            LevelError,
            ["meshes.0.motion.path: at -", "under the ground, which is at 0.00 m", "Keep all of the path above the ground"],
        ),
        (
            {"source": "none.geojson", "motion": {"path": [{"seconds": n, "position": [n, 0]} for n in range(2)]}},
            LevelError, ["meshes.0.motion: ", "footprints, whose file holds their positions"],
        ),
        ({"source": "arrow.ply", "height": 4}, LevelError, ["meshes.0.height", "footprints"]),
        ({"generate": "boxgrid", "surface": "a.tif", "ground": "b.tif"}, LevelError, ["meshes.0.surface", "footprints"]),
        ({"source": "none.obj"}, SourceError, ["none.obj", "no such file"]),
        ({"source": "arrow.ply", "caster": "none.obj"}, SourceError, ["none.obj", "no such file"]),
        ({"source": "none.geojson", "height": 3}, SourceError, ["none.geojson", "no such file"]),
    ],
)  # fmt: skip
def test_mesh_error_names_the_key_in_one_line(scene_of, mesh, kind, expected_text):
    scene = scene_of(FLOOR_TERRAIN, mesh)
    if kind is None:
        assert assemble_solids(scene) is not None
        return
    with pytest.raises(kind) as caught:
        assemble_solids(scene)
    assert all(part in str(caught.value) for part in expected_text), str(caught.value)
    assert "\n" not in str(caught.value)


def test_position_off_the_raster_names_bounds_in_degrees(scene_of, hill):
    with pytest.raises(LevelError, match=r"meshes\.0\.at: '\(15\.0, 46\.0\)' .* within 15\.0\d+, 45\.1\d+, 15\.0\d+, 45\.1\d+"):
        assemble_solids(scene_of({"source": str(hill)}, {"source": "arrow.ply", "at": [15.0, 46.0]}))
    with pytest.raises(LevelError, match=r"meshes\.0\.at"):
        assemble_solids(scene_of({"source": str(hill)}, {"source": "arrow.ply", "at": [15.0, 500.0]}))
