"""Planar shadows on any plane: sloping ground, roofs and façades, by hand, by symmetry and against truth."""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows import planar
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.planar import PlanarSettings, plane_projection
from skugga.shadows.planar_receivers import GROUND_NUMBER, caster_boxes, find_receivers
from skugga.shadows.render import render_frame
from skugga.shadows.requirements import MAX_RECEIVER_PLANES, ground_kind
from skugga.shadows.truth.truth import TruthSettings, trace_truth
from skugga.shadows.truth.truth import fill_visibility as truth_fill
from skugga.shadows.work import Workload
from skugga.terrain.casters.caster_types import NO_CASTERS
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.antialias import multisampled
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene
from tests.conftest import write_geotiff
from tests.render import plan_of, render_points

Build = Callable[..., Scene]

RAMP_DEG = 30.0
EYE_VIEW = {"kind": "perspective", "eye": [-30, -48, 45], "target": [3, 2, 2], "fov": 45, "size": [240, 180]}
LOW_VIEW = {"kind": "perspective", "eye": [34, -40, 16], "target": [3, 0, 3], "fov": 40, "size": [240, 180]}
OMNI = {"kind": "omni", "position": [-20, -10, 16]}
SPOT = {"kind": "spot", "position": [-20, -10, 17], "target": [2, 2, 0], "cutoff": 50}
LIGHTS = {"sun": {}, "spot": {"lights": {"spot": SPOT}, "sun": "none"}, "omni": {"lights": {"omni": OMNI}, "sun": "none"}}
BOX = trimesh.creation.box(bounds=[[-4, -3, 0], [4, 3, 5]])
WALL_AND_ROOF = trimesh.util.concatenate(
    [trimesh.creation.box(bounds=[[-6, -15, 0], [-5, 15, 10]]), trimesh.creation.box(bounds=[[0, -10, 0], [20, 10, 4]])]
)


def gable(x: float, ridge_m: float) -> trimesh.Trimesh:
    """Return a house 8 m wide with its middle at ``x``, walls of 3 m, and a ridge of a height along y."""
    outline = [[x - 4, 0], [x + 4, 0], [x + 4, 3], [x, ridge_m], [x - 4, 3]]
    points = [[px, y, z] for y in (-8.0, 8.0) for px, z in outline]
    return trimesh.convex.convex_hull(np.array(points))


@pytest.fixture
def build(tmp_path) -> Build:
    """Return ``build(mesh, slope)``: a mesh on flat ground, or on a raster with a slope (per metre east, and per metre north)."""

    def level(
        mesh: trimesh.Trimesh | None,
        slope: tuple[float, float] | None = None,
        azimuth: float = 200.0,
        altitude: float = 35.0,
        **keys,
    ) -> Scene:
        terrain: dict = {"flat": {"size": [120, 120], "cells": [60, 60]}}
        if slope is not None:
            middle = np.arange(-60, 60) + 0.5
            heights = 100.0 + slope[0] * middle[None, :] - slope[1] * middle[:, None]
            terrain = {
                "source": str(write_geotiff(tmp_path / "slope.tif", heights.astype(np.float32), ENGINEERING_CRS_WKT, -60, 60, 1.0))
            }
        if mesh is not None:
            mesh.export(tmp_path / "mesh.obj")
            keys = {"meshes": [{"source": "mesh.obj", "at": [0, 0]}], **keys}
        sun = keys.pop("sun", {"azimuth": azimuth, "altitude": altitude})
        text = {"version": 1, "terrain": terrain, "sun": sun, "views": {"eye": EYE_VIEW, "low": LOW_VIEW}, **keys}
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps(text), encoding="utf-8")
        return build_scene(load_level(path))

    return level


def map_of(scene: Scene, half_m: float = 30.0, px: int = 600):
    """Return a square map round the origin."""
    return scene.view(bounds=(-half_m, -half_m, half_m, half_m), size=(px, px))


def row_of(scene: Scene, view) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, whether a point is dark, and its kind of surface, along the middle row of a map drawn by `planar`."""
    frame = render_points(scene, view, algorithm="planar")
    buffer = geometry_buffer(scene, view)
    middle = view.rows // 2
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    return x, frame.visibility[middle] < 0.5, buffer.surface_kind[middle]


def wrong_points(scene: Scene, view, light: str) -> tuple[int, int]:
    """Return how many decidable points of ground and meshes differ from truth, and how many are in cast shadow on meshes."""
    frame = render_points(scene, view, algorithm="planar")
    assert frame.plan.settings[light]["meshes"] == PlanarSettings()
    buffer = geometry_buffer(scene, view)
    reference = trace_truth(buffer, scene, find_casters(scene, buffer), light=light)
    wrong = reference.decidable & ((frame.visibilities[light] < 0.5) != ~reference.lit)
    cast = reference.decidable & ~reference.lit & ~attached_shadow_mask(buffer, scene, light) & (buffer.surface_kind == MESHES)
    return int(wrong.sum()), int(cast.sum())


# -- arithmetic


@given(
    angles=st.tuples(st.floats(-3.0, 3.0), st.floats(0.0, 3.1)),
    light=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(20.0, 1e3), st.sampled_from([0.0, 1.0])),
    point=st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.0, 10.0)),
)
def test_plane_projection_onto_any_plane_follows_the_ray(angles, light, point):
    """Light and point are given along the axes of a rotated plane. The image lies in the plane, on the line to the light."""
    turn, tilt = angles
    normal = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)])
    side = np.cross(normal, [1.0, 0.0, 0.0] if abs(normal[0]) < 0.9 else [0.0, 1.0, 0.0])
    axes = np.column_stack([side / np.linalg.norm(side), np.cross(normal, side / np.linalg.norm(side)), normal])
    light_m = np.append(axes @ light[:3], light[3])
    x, y, z, w = plane_projection(light_m, np.append(normal, 0.0)) @ np.append(axes @ point, 1.0)
    projected = np.array([x, y, z]) / w
    scale = max(np.linalg.norm(projected), 1.0)
    assert w > 0.0 and abs(normal @ projected) <= 1e-9 * scale
    to_light = light_m[:3] - light_m[3] * (axes @ point)
    assert np.linalg.norm(np.cross(projected - axes @ point, to_light)) <= 1e-9 * np.linalg.norm(to_light) * scale


@pytest.mark.parametrize("light", [np.array([0.6, 0.0, 0.8, 0.0]), np.array([3.0, 1.0, 20.0, 1.0])])
def test_caster_boxes_leave_out_what_cannot_shade(light):
    """A receiver of 2 m lies on the ground. Only the plate between it and the light may shade it."""
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    direction = light[:3] / light[2]
    plates = {
        "between": square + 5.0 * direction,
        "beside": square + [30, 30, 5],
        "below": square - 5.0 * direction,
        "in plane": square,
    }
    receivers = find_receivers_of_square(square)
    for name, plate in plates.items():
        _, found = caster_boxes([(plate, triangles)], light).triangles_before(receivers)
        assert len(found) == (2 if name == "between" else 0), name


def find_receivers_of_square(square: np.ndarray) -> planar.ReceiverPlane:
    """Return the receiving plane of a square (4, 3) on level ground."""
    return planar.ReceiverPlane(2, square[0], np.array([0.0, 0.0, 1.0]), 1e-6, square)


# -- sloping ground by hand


@pytest.mark.parametrize(("azimuth", "altitude"), [(270.0, 35.0), (270.0, 70.0), (90.0, 50.0), (90.0, 75.0)])
def test_planar_shadow_of_a_box_on_a_ramp(gl, build, azimuth, altitude):
    """The ramp of 30 degrees rises to the east. A ray over the box's top edge at 4 m, 5 m high, meets it uphill or downhill.

    From the west: 5 - (x - 4) tan a = x tan 30. From the east: 5 + (x + 4) tan a = x tan 30.
    """
    rise, sun = np.tan(np.radians(RAMP_DEG)), np.tan(np.radians(altitude))
    scene = build(BOX, (rise, 0.0), azimuth, altitude)
    x, is_dark, kind = row_of(scene, map_of(scene))
    dark_ground = x[is_dark & (kind == RELIEF)]
    if azimuth == 270.0:
        assert dark_ground.max() == pytest.approx((5.0 + 4.0 * sun) / (rise + sun), abs=0.1) and dark_ground.min() > 4.0
    else:
        assert dark_ground.min() == pytest.approx((5.0 + 4.0 * sun) / (rise - sun), abs=0.1) and dark_ground.max() < -4.0


@pytest.mark.parametrize("slope", [(0.3, -0.2), (-0.45, 0.1)])
@pytest.mark.parametrize("light", ["sun", "omni"])
def test_planar_on_a_floor_tilted_about_both_axes(gl, build, slope, light):
    """Each point of the floor is dark where the line to the light meets the box, by the slab test."""
    scene = build(BOX, slope, **LIGHTS[light])
    view = map_of(scene, 25.0, 250)
    frame, buffer = render_points(scene, view, algorithm="planar"), geometry_buffer(scene, view)
    points = buffer.position_frame_m
    corner = buffer.frame.points_from_earth(scene.objects.solids.vertices_earth_m)
    low, high = corner.min(axis=0), corner.max(axis=0)
    *position, w = scene.light_position(light, buffer.frame)
    way = np.array(position) - w * points
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = np.sort(np.stack([(low - points) / way, (high - points) / way]), axis=0)
    depth = np.minimum(far.min(axis=-1), 1.0 if w else np.inf) - np.maximum(near.max(axis=-1), 0.0)
    is_ground = buffer.surface_kind == RELIEF
    is_sure = is_ground & (np.abs(depth) * np.linalg.norm(way, axis=-1) > 0.02)
    is_dark = frame.visibilities[light] < 0.5
    assert (is_dark & is_ground).sum() > 300
    np.testing.assert_array_equal(is_dark[is_sure], depth[is_sure] > 0.0)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("slope", [(np.tan(np.radians(RAMP_DEG)), 0.0), (0.3, -0.2)])
def test_planar_on_slopes_equals_truth(gl, build, slope, light):
    """No decidable point is wrong, in a map and in perspective (measured: none of 60,000)."""
    boxes = trimesh.util.concatenate([BOX, trimesh.creation.box(bounds=[[7, -9, 0], [11, 8, 9]])])
    scene = build(boxes, slope, **LIGHTS[light])
    for view in (scene.view("eye"), map_of(scene, 30.0, 200)):
        assert wrong_points(scene, view, light)[0] == 0


@pytest.mark.parametrize("azimuth", [80.0, 90.0])
def test_planar_slope_shades_what_stands_on_it(gl, build, azimuth):
    """The sun stands lower than the slope behind the box, which then shades walls that face the sun. Level ground never does."""
    scene = build(BOX, (np.tan(np.radians(RAMP_DEG)), 0.0), azimuth, 25.0, effects={"cast_shadows": "on"})
    wrong, cast = wrong_points(scene, scene.view("low"), SUN)
    assert wrong == 0 and cast > 100


# -- roofs and façades


@pytest.mark.parametrize("altitude", [25.0, 40.0])
def test_planar_shadow_of_a_wall_on_a_roof(gl, build, altitude):
    """A wall 10 m high ends at x = -5. Under a sun in the west its shadow on the roof, 4 m high, ends 6 m / tan(a) farther."""
    scene = build(WALL_AND_ROOF, azimuth=270.0, altitude=altitude)
    x, is_dark, kind = row_of(scene, map_of(scene))
    dark_roof = x[is_dark & (kind == MESHES) & (x > -0.05)]
    end_m = -5.0 + 6.0 / np.tan(np.radians(altitude))
    assert dark_roof.max() == pytest.approx(end_m, abs=0.1) and len(dark_roof) == pytest.approx(10.0 * end_m, abs=1.5)


def test_planar_shadow_of_a_wall_on_a_roof_under_a_lamp(gl, build):
    """The line from (-20, 0, 16) over the wall's edge at x = -5, z = 10 is 4 m high at x = -20 + 15 * 12 / 6."""
    lamp = {"kind": "omni", "position": [-20, 0, 16]}
    scene = build(WALL_AND_ROOF, sun="none", lights={"lamp": lamp})
    x, is_dark, kind = row_of(scene, map_of(scene))
    assert x[is_dark & (kind == MESHES) & (x > -0.05)].max() == pytest.approx(10.0, abs=0.1)


def test_planar_roofs_shade_each_other_symmetrically(gl, build):
    """Of two gables the one on the sun's side shades the other. Under the mirrored sun the picture is mirrored."""
    houses = trimesh.util.concatenate([gable(-6.0, 9.0), gable(6.0, 9.0)])
    dark = {}
    for azimuth in (90.0, 270.0):
        scene = build(houses, azimuth=azimuth, altitude=20.0)
        view = map_of(scene, 20.0, 201)
        frame, buffer = render_points(scene, view, algorithm="planar"), geometry_buffer(scene, view)
        dark[azimuth] = (frame.visibility < 0.5) & ~attached_shadow_mask(buffer, scene)
        x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
        shaded_side = x < 0.0 if azimuth == 90.0 else x > 0.0
        on_roof = buffer.surface_kind == MESHES
        assert (dark[azimuth] & on_roof)[:, shaded_side].sum() > 200 and not (dark[azimuth] & on_roof)[:, ~shaded_side].any()
    assert (dark[90.0] != dark[270.0][:, ::-1]).mean() <= 1e-3  # pixels on edges


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("mesh", ["wall and roof", "gables"])
def test_planar_on_facets_equals_truth(gl, build, mesh, light):
    """Façades and roofs receive as truth has it (measured: no decidable point is wrong)."""
    gables = trimesh.util.concatenate([gable(-6.0, 9.0), gable(6.0, 7.0)])
    scene = build({"wall and roof": WALL_AND_ROOF, "gables": gables}[mesh], azimuth=250.0, altitude=22.0, **LIGHTS[light])
    results = [wrong_points(scene, view, light) for view in (scene.view("eye"), scene.view("low"), map_of(scene, 30.0, 200))]
    assert all(wrong == 0 for wrong, _ in results) and sum(cast for _, cast in results) > 100


@pytest.mark.parametrize("light", LIGHTS)
def test_planar_samples_on_facets_match_rays(gl, build, light):
    """Further samples at edges have their own planes."""
    scene = build(trimesh.util.concatenate([gable(-6.0, 9.0), gable(6.0, 7.0)]), azimuth=250.0, altitude=22.0, **LIGHTS[light])
    view = scene.view("low")
    buffer = multisampled(scene, view).buffer
    kinds = scene.objects.caster_kinds
    visibility = planar.fill_visibility(buffer, scene, light, kinds, NO_CASTERS, PlanarSettings(), PassLog())
    reference = truth_fill(buffer, scene, light, kinds, find_casters(scene, buffer), TruthSettings(), PassLog())
    samples = (buffer.surface_kind == MESHES) & ~attached_shadow_mask(buffer, scene, light)
    samples[: view.rows] = False
    assert samples.sum() > 500 and (visibility != reference)[samples].mean() <= 0.01


# -- stencil


def test_planar_roof_is_darkened_once(gl, build):
    """Two walls in line with the sun shade one roof. The stencil counts each of its pixels once, and each plane apart."""
    walls = [trimesh.creation.box(bounds=[[-6 - 3 * n, -15, 0], [-5 - 3 * n, 15, 10 + 2 * n]]) for n in range(2)]
    scene = build(trimesh.util.concatenate([*walls, WALL_AND_ROOF]), azimuth=270.0, altitude=30.0)
    view = map_of(scene, 30.0, 300)
    frame = render_frame(scene, view, plan_of(scene, view, algorithm="planar"), layers=frozenset({"stencil"}))
    stencil = frame.layers["stencil"][SUN]
    assert set(np.unique(stencil)) == {planar.LIT_VALUE, planar.SHADED_VALUE}, "all points lie in planes"
    assert set(np.unique(frame.visibility)) == {0.0, 1.0}
    on_roof = (geometry_buffer(scene, view).surface_kind == MESHES) & (stencil == planar.SHADED_VALUE)
    assert on_roof.sum() > 1000 and len(np.unique(frame.color[on_roof], axis=0)) == 1


def test_planar_planes_have_their_own_pixels(gl, build):
    """Coplanar roofs of two houses are one plane; each wall, and the ground, have a number of their own."""
    houses = [trimesh.creation.box(bounds=[[x, -4, 0], [x + 5, 4, 6]]) for x in (-10.0, 3.0)]
    scene = build(trimesh.util.concatenate(houses))
    buffer = geometry_buffer(scene, scene.view("low"))
    receivers = find_receivers(buffer, scene)
    numbers = receivers.plane_of_point
    assert [plane.number for plane in receivers.planes] == list(range(1, len(receivers.planes) + 1))
    assert (numbers[buffer.surface_kind == RELIEF] == GROUND_NUMBER).all()
    up = (buffer.surface_kind == MESHES) & (buffer.normal_frame[..., 2] > 0.9)
    assert len(np.unique(numbers[up])) == 1 and len(receivers.planes) == 1 + 1 + 1 + 2  # ground, roofs, southern and eastern walls
    for plane in receivers.planes:
        points = buffer.position_frame_m[numbers == plane.number]
        assert np.abs((points - plane.origin_frame_m) @ plane.normal_frame).max() <= 1e-4


# -- refusals and plans


@pytest.mark.parametrize("view_name", ["eye", "map"])
def test_planar_refuses_curved_receivers_on_a_slope(build, view_name):
    """A sphere of 320 facets is curved, although few samples show it."""
    scene = build(trimesh.creation.icosphere(subdivisions=2, radius=9.0), (0.2, 0.1))
    view = scene.view("eye") if view_name == "eye" else map_of(scene)
    assert 0.5 < describe(scene, view).plane_share < 1.0
    with pytest.raises(UnsupportedError, match=f"not flat: planar projects onto at most {MAX_RECEIVER_PLANES} planes"):
        plan_of(scene, view, algorithm="planar")


def test_planar_refuses_ground_of_two_planes(build, tmp_path, make_scene):
    middle = np.abs(np.arange(-60, 60) + 0.5)
    raster = write_geotiff(
        tmp_path / "ridge.tif", np.tile(30.0 - 0.3 * middle, (120, 1)).astype(np.float32), ENGINEERING_CRS_WKT, -60, 60, 1.0
    )
    scene = make_scene(raster)
    assert describe(scene, scene.view()).receiver_planes is None
    with pytest.raises(UnsupportedError, match="the ground is not flat"):
        plan_of(scene, scene.view(), algorithm="planar")


def test_planar_receivers_are_not_on_uneven_ground(gl, tmp_path, make_scene):
    """A plan may miss ground that its coarse view does not show. Such points lie in no plane and stay lit."""
    middle = np.abs(np.arange(-60, 60) + 0.5)
    raster = write_geotiff(
        tmp_path / "ridge.tif", np.tile(30.0 - 0.3 * middle, (120, 1)).astype(np.float32), ENGINEERING_CRS_WKT, -60, 60, 1.0
    )
    scene = make_scene(raster)
    receivers = find_receivers(geometry_buffer(scene, scene.view(size=(60, 60))), scene)
    assert not receivers.plane_of_point.any()


def test_planar_leaves_curved_bodies_lit(gl, build):
    """On level ground a sphere behind a wall stays lit, and its plate and the ground receive."""
    parts = [trimesh.creation.box(bounds=[[-6, -15, 0], [-5, 15, 14]]), trimesh.creation.box(bounds=[[0, -5, 0], [9, 5, 1]])]
    sphere = trimesh.creation.icosphere(subdivisions=2, radius=3.0)
    sphere.apply_translation([12.0, 0.0, 3.0])
    names = []
    scene = build(None)
    folder = scene.loaded.path.parent
    for number, mesh in enumerate([*parts, sphere]):
        mesh.export(folder / f"part{number}.obj")
        names.append({"source": f"part{number}.obj", "at": [0, 0]})
    scene = build(None, azimuth=270.0, altitude=35.0, meshes=names)
    view = map_of(scene, 25.0, 250)
    frame, buffer = render_points(scene, view, algorithm="planar"), geometry_buffer(scene, view)
    facing = (buffer.surface_kind == MESHES) & ~attached_shadow_mask(buffer, scene)
    x = buffer.position_frame_m[..., 0]
    assert (frame.visibility[facing & (x > 9.0)] == 1.0).all() and (frame.visibility[facing & (x > 0.0) & (x < 9.0)] == 0.0).all()
    assert (frame.visibility[buffer.surface_kind == RELIEF] == 0.0).any()


@pytest.fixture
def town(build) -> Scene:
    """Return a scene of 100 small houses, each with a roof and a height of its own, and a wall in the west that shades a plate."""
    houses = [
        trimesh.creation.box(bounds=[[x, y, 0], [x + 2, y + 2, 3 + 0.01 * (10 * x + y)]])
        for x in range(-20, 20, 4)
        for y in range(-20, 20, 4)
    ]
    plate, wall = (
        trimesh.creation.box(bounds=bounds) for bounds in ([[-40, -20, 0], [-24, 20, 1]], [[-42, -25, 0], [-41, 25, 20]])
    )
    scene = build(None)
    meshes = [*houses, plate, wall]
    for number, mesh in enumerate(meshes):
        mesh.export(scene.loaded.path.parent / f"mesh{number}.obj")
    return build(None, None, 270.0, 50.0, meshes=[{"source": f"mesh{number}.obj", "at": [0, 0]} for number in range(len(meshes))])


def test_planar_draws_the_ground_alone_in_maps_of_many_planes(gl, town):
    """Tiles would not agree on the planes. The plan gives the reason."""
    view = map_of(town, 45.0, 250)
    plan = plan_of(town, view, algorithm="planar")
    assert MAX_RECEIVER_PLANES < describe(town, view).receiver_planes and plan.settings == {}
    assert any(f"more than {MAX_RECEIVER_PLANES}" in reason.reason for reason in plan.reasons if "receivers" in reason.name)
    frame = render_frame(town, view, plan, pixel_sampling="points")
    buffer = geometry_buffer(town, view)
    assert (frame.visibility[buffer.surface_kind == MESHES] == 1.0).all()
    assert (frame.visibility[buffer.surface_kind == RELIEF] == 0.0).any()


def test_planar_draws_the_largest_of_many_planes_in_perspective(gl, town):
    """The plate in the wall's shadow is large and receives. No point is dark that truth has lit."""
    view = town.view("eye", size=(640, 480))
    frame = render_points(town, view, algorithm="planar")
    assert MAX_RECEIVER_PLANES < describe(town, view).receiver_planes
    assert frame.plan.settings[SUN]["meshes"] == PlanarSettings(receivers="largest")
    buffer = geometry_buffer(town, view)
    assert len(find_receivers(buffer, town).planes) > len(find_receivers(buffer, town, MAX_RECEIVER_PLANES).planes) == 65
    reference = trace_truth(buffer, town, find_casters(town, buffer))
    is_plate = (buffer.surface_kind == MESHES) & (np.abs(buffer.position_frame_m[..., 2] - 1.0) < 1e-3)
    shaded_plate = reference.decidable & is_plate & ~reference.lit
    assert shaded_plate.sum() > 500 and (frame.visibility[shaded_plate] == 0.0).all()
    assert not ((frame.visibility < 0.5) & reference.decidable & reference.lit).any()


@pytest.mark.parametrize(("share", "count", "kind"), [
    (1.0, MAX_RECEIVER_PLANES, "planes"), (1.0, MAX_RECEIVER_PLANES + 1, "uneven"), (1.0, None, "uneven"), (0.999, 3, "uneven"),
])  # fmt: skip
def test_ground_kind_near_the_bounds(build, share, count, kind):
    scene = build(BOX, (0.2, 0.1))
    descriptor = describe(scene, scene.view("eye"))
    assert descriptor.plane_share == 1.0 and descriptor.receiver_planes == 4 and ground_kind(descriptor) == "planes"
    assert ground_kind(descriptor.model_copy(update={"plane_share": share, "receiver_planes": count})) == kind


def test_planar_work_counts_casters_for_each_plane(build):
    scene = build(WALL_AND_ROOF)
    descriptor = describe(scene, scene.view("eye"))
    workload = Workload(descriptor, SUN, ("meshes",))
    (ground_only,), (planes,) = (planar.ALGORITHM.work(workload, settings).values() for settings in (None, PlanarSettings()))
    assert planes["triangles"] == descriptor.receiver_planes * ground_only["triangles"] > 0
    assert planes["pixels"] == ground_only["pixels"]
