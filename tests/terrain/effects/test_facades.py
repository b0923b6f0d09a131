"""Façades: whole bays and storeys, exact filters that keep a wall's mean, and patterns that are fixed to the world."""

from __future__ import annotations

import json

import numba
import numpy as np
import pyogrio
import pytest
import shapely

from skugga.selector.planner.planner import make_plan
from skugga.shadows.registry import NO_SHADOWS
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects import facade_pattern
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.facades import _COLORS, EFFECT, apply_facades, max_contrast
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import load_level
from skugga.terrain.meshes import facade_layout as columns
from skugga.terrain.meshes.facade_layout import BuildingSizes, WallPlaces, building_kinds, uniform, wall_layouts
from skugga.terrain.meshes.facades import FLAT, SEAMS, TILES, WALL
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

PLASTER = np.array([0.5, 0.45, 0.4])


def make_scene(folder, geometry, height_m, roof="auto", ground=None, **keys: object) -> Scene:
    """Return a scene of buildings with a height of ``height_m``, on flat ground of 2 km or on the heights ``ground`` (50, 50)."""
    heights = np.zeros((50, 50), np.float32) if ground is None else ground
    write_geotiff(folder / "floor.tif", heights, ENGINEERING, -1000.0, 1000.0, 40.0)
    geometry = np.atleast_1d(np.array(geometry, object))
    pyogrio.raw.write(
        folder / "houses.gpkg", shapely.to_wkb(geometry), [np.broadcast_to(float(height_m), len(geometry))], ["height"],
        geometry_type="Polygon", crs=ENGINEERING,
    )  # fmt: skip
    level = {
        "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": 200, "altitude": 40},
        "meshes": [{"source": "houses.gpkg", "height": "height", "roof": roof}], **keys,
    }  # fmt: skip
    (folder / "level.yaml").write_text(json.dumps(level))
    return build_scene(load_level(folder / "level.yaml"))


def eye_view(eye, target, fov=40.0, size=(160, 120)) -> dict[str, object]:
    return {"kind": "perspective", "eye": list(eye), "target": list(target), "fov": fov, "size": list(size)}


def layout_of(length_m=(12.0, 9.0, 12.0, 9.0), eaves_m=5.8, hash_bits=1, ground_m=(0.0,) * 4, **sizes: object) -> np.ndarray:
    """Return the layouts of the four walls of a house."""
    length = np.array(length_m)
    ground = np.array(ground_m, np.float64)
    walls = WallPlaces(length, np.zeros(4), ground, np.roll(ground, -1), np.zeros(4, np.int64))
    area = float(length[0] * length[1])
    values = {"area_m2": area, "height_m": eaves_m, "has_sloped_roof": True, "is_on_ground": True, **sizes}
    return wall_layouts(
        walls,
        BuildingSizes(
            np.array([hash_bits], np.uint64), np.array([values["area_m2"]]), np.array([eaves_m]), np.array([values["height_m"]]),
            np.array([values["has_sloped_roof"]]), np.array([values["is_on_ground"]]),
        ),
    )  # fmt: skip


def test_bays_and_storeys_fill_the_wall_in_whole_numbers():
    for eaves_m in (3.0, 5.8, 8.4, 21.0):
        for length_m in (4.1, 5.6, 9.0, 17.3, 60.0):
            layout = layout_of((length_m, 30.0, length_m, 30.0), eaves_m)[0]
            bays, storeys = layout[columns.BAY_COUNT], layout[columns.STOREY_COUNT]
            assert bays == np.rint(bays) >= 1 and storeys == np.rint(storeys) >= 1
            assert bays * layout[columns.BAY_PITCH] == pytest.approx(length_m, rel=1e-6)
            assert storeys * layout[columns.STOREY_PITCH] == pytest.approx(eaves_m, rel=1e-6)
            assert 1.9 <= layout[columns.BAY_PITCH] <= 5.0 and 2.0 <= layout[columns.STOREY_PITCH] <= 4.5


@pytest.mark.parametrize("sloped", [True, False])
@pytest.mark.parametrize("size", [(5.0, 4.0, 4.5), (12.0, 9.0, 5.8), (30.0, 20.0, 12.0), (40.0, 30.0, 6.0), (6.0, 6.0, 20.0)])
def test_windows_doors_and_bands_do_not_overlap(size, sloped):
    for hash_bits in range(1, 40):
        first, second, eaves_m = size
        for row in layout_of((first, second, first, second), eaves_m, hash_bits, has_sloped_roof=sloped):
            if row[columns.BAY_COUNT]:
                half, pitch = row[columns.HALF_WIDTH] + row[columns.SHUTTER], row[columns.BAY_PITCH]
                assert half > 0.1 and 2.0 * half < pitch
                assert 2.0 * (row[columns.HALF_WIDTH] + facade_pattern.SILL_OVERHANG_M) < pitch or not row[columns.SILL_DEPTH]
                assert row[columns.PLINTH] <= row[columns.SILL] - row[columns.SILL_DEPTH]
                assert row[columns.HEAD] <= row[columns.STOREY_PITCH] - row[columns.FASCIA] + 1e-5
            if row[columns.DOOR_HALF_WIDTH]:
                assert (
                    row[columns.DOOR_HALF_WIDTH] <= row[columns.DOOR_CENTRE] <= row[columns.LENGTH] - row[columns.DOOR_HALF_WIDTH]
                )
                assert row[columns.DOOR_TOP] <= row[columns.TOP] - row[columns.FASCIA] + 0.15


def test_a_house_has_one_door_on_a_longest_wall():
    for hash_bits in range(50):
        doors = layout_of(hash_bits=hash_bits)[:, columns.DOOR_HALF_WIDTH] > 0.0
        assert doors.sum() == 1 and doors[[0, 2]].any()
    assert not layout_of(is_on_ground=False)[:, columns.DOOR_HALF_WIDTH].any()


def test_windows_below_the_ground_are_left_out():
    first = layout_of(ground_m=(4.0, 4.0, -1.0, -1.0))[:, columns.FIRST_STOREY]
    assert first.tolist() == [2.0, 2.0, 0.0, 2.0] or first.tolist() == [1.0, 1.0, 0.0, 1.0]
    assert layout_of()[:, columns.FIRST_STOREY].tolist() == [0.0] * 4


def test_kinds_follow_from_size_and_roof():
    sizes = BuildingSizes(
        np.arange(6, dtype=np.uint64), np.array([100.0, 20.0, 25.0, 1000.0, 800.0, 300.0]),
        np.array([5.0, 2.6, 20.0, 6.0, 20.0, 12.0]), np.array([8.0, 2.8, 20.0, 6.0, 20.0, 12.0]),
        np.array([True, False, False, False, False, False]), np.ones(6, np.bool_),
    )  # fmt: skip
    kinds = building_kinds(sizes)
    assert kinds[[0, 1, 2, 3, 5]].tolist() == [columns.HOUSE, columns.SHED, columns.TOWER, columns.HALL, columns.FLATS]
    assert kinds[4] in (columns.OFFICE_GRID, columns.OFFICE_RIBBON)


def test_random_numbers_are_uniform_and_independent():
    bits = np.arange(20_000, dtype=np.uint64)
    numbers = np.array([uniform(bits, stream) for stream in range(12)])
    assert numbers.min() >= 0.0 and numbers.max() < 1.0
    np.testing.assert_allclose(numbers.mean(axis=1), 0.5, atol=0.01)
    assert np.abs(np.corrcoef(numbers) - np.eye(12)).max() < 0.04


@numba.njit
def _wall_colors(u, v, half_u, half_v, fade_u, fade_v, layout, colors, wall):
    """Return the albedos (n, 3) of points on the first wall of a layout."""
    out = np.empty((len(u), 3))
    for n in range(len(u)):
        facade_pattern.write_wall_color(out[n], wall, u[n], v[n], half_u, half_v, fade_u, fade_v, layout, 0, colors)
    return out


def wall_colors(layout, u, v, pixel_m, fade=1.0):
    return _wall_colors(u, v, 0.5 * pixel_m, 0.5 * pixel_m, fade, fade, layout, _COLORS, PLASTER)


@pytest.mark.parametrize("hash_bits", [1, 2, 3, 5, 8, 13])
def test_filter_equals_the_mean_of_fine_samples(hash_bits):
    """The albedo of a pixel is the mean of the albedos of its parts, wherever it lies on the wall."""
    layout = layout_of((12.0, 9.0, 12.0, 9.0), 5.8, hash_bits)
    layout = layout[np.argsort(-layout[:, columns.DOOR_HALF_WIDTH])]  # the wall with the door first
    rng, parts, pixel_m = np.random.default_rng(hash_bits), 80, 0.7
    offset = (np.arange(parts) + 0.5) / parts - 0.5
    for u, v in zip(rng.uniform(0.4, 11.6, 25), rng.uniform(0.4, 5.4, 25), strict=True):
        fine_u, fine_v = (grid.ravel() for grid in np.meshgrid(u + pixel_m * offset, v + pixel_m * offset))
        fine = wall_colors(layout, fine_u, fine_v, pixel_m / parts)
        np.testing.assert_allclose(wall_colors(layout, np.array([u]), np.array([v]), pixel_m)[0], fine.mean(axis=0), atol=2e-3)


@pytest.mark.parametrize("kind", [{}, {"has_sloped_roof": False, "area_m2": 900.0, "height_m": 12.0}])
def test_mean_of_the_wall_is_that_of_its_pattern(kind):
    """Without contrast all pixels have the mean albedo of the wall, so brightness does not change with distance."""
    layout = layout_of((24.0, 9.0, 24.0, 9.0), 11.6, 7, **kind)
    layout = layout[np.argsort(-layout[:, columns.DOOR_HALF_WIDTH])]
    u, v = (grid.ravel() for grid in np.meshgrid((np.arange(960) + 0.5) / 40.0, (np.arange(464) + 0.5) / 40.0))
    mean = wall_colors(layout, u, v, 1.0 / 40.0).mean(axis=0)
    np.testing.assert_allclose(wall_colors(layout, u[:1], v[:1], 1.0, fade=0.0)[0], mean, atol=2e-3)
    assert np.abs(mean - PLASTER).max() > 0.02  # windows are darker than plaster


def test_contrast_falls_to_zero_at_two_pixels():
    assert max_contrast(np.array([3.0, 3.0, 3.0, 50.0]), np.array([0.7, 1.5, 1.6, 2.3])).tolist() == [1.0, 0.0, 0.0, 0.0]


def test_each_wall_has_its_own_coordinates(tmp_path):
    """The corners of each wall lie at 0 and at its length, and at the ground floor and the eaves."""
    scene = make_scene(tmp_path, shapely.box(-6.0, -4.0, 6.0, 4.0), 8.0)
    facades, solids = scene.objects.facades, scene.objects.solids
    assert facades is not None and solids is not None
    rows = facades.row_of_triangle
    assert set(facades.kind[rows[rows >= 0]].tolist()) <= {WALL, TILES, SEAMS} and (rows < 0).sum() == 2  # the floor
    for triangle, row in zip(solids.triangles, rows, strict=True):
        if row < 0:
            continue
        points = solids.vertices_earth_m[triangle] - facades.origin_earth_m[row]
        u, v = points @ facades.along_earth[row], points @ facades.up_earth[row]
        if facades.kind[row] != WALL:
            assert v.min() == pytest.approx(0.0, abs=1e-6) and v.max() == pytest.approx(np.hypot(4.0, 2.8), abs=0.02)
            continue
        length, top = facades.layout[row, [columns.LENGTH, columns.TOP]]
        outward = np.cross(facades.along_earth[row], facades.up_earth[row])
        assert np.abs(points @ outward).max() < 1e-5
        corners = solids.vertices_earth_m[triangle]
        assert np.cross(corners[1] - corners[0], corners[2] - corners[0]) @ outward > 0.0  # the building lies on the left
        assert u.min() == pytest.approx(0.0, abs=1e-5) and u.max() == pytest.approx(length, abs=1e-5)
        assert top == pytest.approx(5.2) and v.min() in (pytest.approx(-0.5, abs=1e-5), pytest.approx(top, abs=1e-5))
        assert {round(float(length)), 0} <= {8, 12, 0}


def test_buildings_alone_have_facades(tmp_path):
    from trimesh.creation import box

    box((4.0, 4.0, 12.0)).export(tmp_path / "post.obj")
    scene = make_scene(tmp_path, [shapely.box(-6.0, -4.0, 6.0, 4.0), shapely.box(20.0, 0.0, 50.0, 20.0)], 8.0)
    own = [{"source": "houses.gpkg", "height": "height", "roof": "auto"}, {"source": "post.obj", "at": [60.0, 0.0]}]
    (tmp_path / "level.yaml").write_text(json.dumps({"version": 1, "terrain": {"source": "floor.tif"}, "meshes": own[::-1]}))
    both = build_scene(load_level(tmp_path / "level.yaml"))
    first, second = scene.objects.facades, both.objects.facades
    assert first is not None and second is not None
    assert (second.row_of_triangle[:12] == -1).all() and (second.row_of_triangle[12:] == first.row_of_triangle).all()
    np.testing.assert_array_equal(first.layout, second.layout)
    assert FLAT in first.kind
    (tmp_path / "level.yaml").write_text(json.dumps({"version": 1, "terrain": {"source": "floor.tif"}, "meshes": own[1:]}))
    assert build_scene(load_level(tmp_path / "level.yaml")).objects.facades is None


def albedo_in_view(scene: Scene, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a view's albedo of meshes (rows, cols, 3) with façades, and without."""
    view = scene.view(name)
    buffer = geometry_buffer(scene, view)
    assert buffer.albedo is not None
    albedo = buffer.albedo.copy()
    apply_facades(albedo, ShadingBlock(scene, view, buffer, {}))
    return albedo, buffer.albedo


def test_pattern_is_fixed_to_the_wall_and_keeps_its_mean(tmp_path):
    """In pixels much smaller than windows, and in pixels where windows are gone, a wall has the mean of the plain one."""
    sizes = ((320, 240), (160, 120), (40, 30), (20, 15))
    views = {f"of{size[0]}": eye_view((0, -60, 5.5), (0, 0, 5.5), 30.0, size) for size in sizes}
    scene = make_scene(tmp_path, shapely.box(-15.0, 0.0, 15.0, 12.0), 11.0, "flat", views=views)
    means, deviations = [], []
    for name in views:
        albedo, plain = albedo_in_view(scene, name)
        is_wall = np.isfinite(plain[..., 0])
        means.append(albedo[is_wall].mean(axis=0) / plain[is_wall].mean(axis=0))
        deviations.append(albedo[is_wall][:, 0].std())
    assert deviations[0] > 0.1 and deviations[-1] < 1e-6
    np.testing.assert_allclose(means, 1.0, atol=0.05)


def test_far_walls_are_plain(tmp_path):
    scene = make_scene(
        tmp_path, shapely.box(-15.0, 0.0, 15.0, 12.0), 11.0, "flat",
        views={"far": eye_view((0, -900, 40), (0, 0, 3), 60.0)},
    )  # fmt: skip
    albedo, plain = albedo_in_view(scene, "far")
    assert np.isfinite(plain).any()
    np.testing.assert_array_equal(albedo, plain)


def test_shadows_do_not_depend_on_facades(gl, tmp_path):
    views = {"eye": eye_view((30, -40, 12), (0, 0, 3))}
    layers = []
    for state in ("on", "off"):
        scene = make_scene(tmp_path, shapely.box(-15.0, 0.0, 15.0, 12.0), 11.0, "flat", views=views, effects={"facades": state})
        view = scene.view("eye")
        plan = make_plan(describe(scene, view, "eye"), scene.loaded.level)
        frame = render_frame(scene, view, plan)
        assert ("facades" in frame.plan.effect_names) == (state == "on") and plan.algorithm["sun"].get("meshes") != NO_SHADOWS
        layers.append((frame.visibility, frame.color))
    np.testing.assert_array_equal(layers[0][0], layers[1][0])
    assert (layers[0][1] != layers[1][1]).any()


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"style": {"name": "analysis"}}, "shows no materials"),
        ({"meshes": []}, "no buildings"),
    ],
)
def test_reasons_name_what_is_missing(tmp_path, keys, reason):
    scene = make_scene(tmp_path, shapely.box(-15.0, 0.0, 15.0, 12.0), 11.0, views={"eye": eye_view((0, -40, 4), (0, 0, 3))}, **keys)
    verdict = EFFECT.verdict("facades", describe(scene, scene.view("eye"), "eye"))
    assert not verdict.is_needed and reason in verdict.reason


def test_buildings_above_the_ground_have_no_door_and_no_plinth(tmp_path):
    write_geotiff(tmp_path / "floor.tif", np.full((50, 50), 123.4, np.float32), ENGINEERING, -1000.0, 1000.0, 40.0)
    polygons = [shapely.box(x, 0.0, x + 12.0, 9.0) for x in (-40.0, 0.0, 40.0)]
    pyogrio.raw.write(
        tmp_path / "houses.gpkg", shapely.to_wkb(np.array(polygons, object)),
        [np.array([9.1, 9.1, 9.1]), np.array([0.0, 3.3, 4.7])], ["height", "min_height"], geometry_type="Polygon", crs=ENGINEERING,
    )  # fmt: skip
    level = {"version": 1, "terrain": {"source": "floor.tif"}, "meshes": [{"source": "houses.gpkg"}]}
    (tmp_path / "level.yaml").write_text(json.dumps(level))
    facades = build_scene(load_level(tmp_path / "level.yaml")).objects.facades
    assert facades is not None
    walls = facades.layout[facades.kind == WALL].reshape(3, 4, -1)
    assert (walls[..., columns.DOOR_HALF_WIDTH] > 0.0).sum(axis=1).tolist() == [1, 0, 0]
    assert (walls[:, 0, columns.PLINTH] > 0.0).tolist() == [True, False, False]
    np.testing.assert_allclose(walls[:, 0, columns.TOP], [9.1, 5.8, 4.4], atol=1e-4)
