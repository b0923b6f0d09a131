"""Shadows of spots and omni lights: outlines in closed form, and comparison with truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyogrio
import pytest
import shapely
import trimesh

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.render import Frame
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE, error_metrics
from skugga.shadows.truth.truth import trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING
from tests.render import render, render_points

VIEW_PX = 170


@pytest.fixture
def floor(write_raster) -> Path:
    """File of a raster of level ground."""
    return write_raster(np.zeros((41, 41), np.float32), ENGINEERING, -205.0, 205.0, 10.0)


def write_boxes(tmp_path: Path, *parts: tuple, name: str = "boxes.obj") -> dict:
    """Return a mesh of boxes (size, centre) at the middle of the floor. The lowest must stand on the floor."""
    meshes = []
    for size, centre in parts:
        mesh = trimesh.creation.box(extents=size)
        mesh.apply_translation(centre)
        meshes.append(mesh)
    trimesh.util.concatenate(meshes).export(tmp_path / name)
    return {"source": name, "at": [0, 0]}


def map_around_middle(scene: Scene, half: float) -> tuple:
    """Return a map around the middle, its pixels off the grid's nodes, and their coordinates (rows, cols)."""
    view = scene.view(bounds=(-half, -half, half, half), size=(VIEW_PX, VIEW_PX))
    x = view.grid.x(view.col0 + np.arange(VIEW_PX) * view.col_step)
    y = view.grid.y(view.row0 + np.arange(VIEW_PX) * view.row_step)
    return view, *np.meshgrid(x, y)


def distance_outside(x: np.ndarray, y: np.ndarray, outline: shapely.Geometry) -> np.ndarray:
    """Return the distance of points outside an outline in metres; negative inside."""
    points = shapely.points(x, y)
    border_distance = shapely.distance(outline.boundary, points)
    return np.where(shapely.contains(outline, points), -border_distance, border_distance)


def check_shadow_outline(frame: Frame, ground: np.ndarray, outside_m: np.ndarray, texel_m: float) -> None:
    """Check that ground is dark where ``outside_m`` (metres beyond the outline) is negative and lit elsewhere, within a texel."""
    dark = frame.visibilities["lamp"] < 0.5
    assert (dark & ground & (outside_m > texel_m)).sum() == 0, "shadow beyond the outline"
    assert (~dark & ground & (outside_m < -texel_m)).sum() == 0, "light inside the outline"
    assert (ground & (outside_m < -texel_m)).any() and (ground & (outside_m > texel_m)).any()


@pytest.mark.parametrize("kind", ["spot", "omni"])
@pytest.mark.parametrize(
    ("east", "turn", "algorithm"),
    [(0.0, 0.0, "shadow_map"), (5.0, 0.0, "shadow_map"), (4.0, 30.0, "shadow_map"), (4.0, 30.0, "truth")],
)
def test_lamp_shadow_of_a_box_is_its_projected_outline(gl, floor, make_scene, tmp_path, kind, east, turn, algorithm):
    """From lamp height H the roof at height h appears H / (H - h) times as large on the floor, scaled about the lamp's foot."""
    lamp = {"kind": kind, "position": [0, 0, 12]} | ({"target": [0, 0, 0], "cutoff": 60.0} if kind == "spot" else {})
    mesh = write_boxes(tmp_path, ((4.0, 3.0, 5.0), (0, 0, 2.5))) | {"at": [east, 0], "turn": turn}
    scene = make_scene(floor, sun="none", lights={"lamp": lamp}, meshes=[mesh])
    view, x, y = map_around_middle(scene, 17.0)
    frame = render_points(scene, view, algorithm=algorithm, map_size=1024, filter=1)
    roof = shapely.affinity.translate(shapely.affinity.rotate(shapely.box(-2, -1.5, 2, 1.5), turn, origin=(0, 0)), east)
    shadow = shapely.union(shapely.affinity.scale(roof, 12 / 7, 12 / 7, origin=(0, 0)), roof).convex_hull
    tangent = np.tan(np.radians(60.0)) if kind == "spot" else 1.0
    # An omni light's texels are slanted on the floor beside the lamp: longer by (distance / height) squared.
    slant = 1.0 if kind == "spot" else max(1.0, (np.hypot(x, y).max() / 12.0) ** 2)
    texel_m = 1e-3 if algorithm == "truth" else 2 * tangent * 12 / 1000 * slant
    in_frustum = np.hypot(x, y) < (1e9 if kind == "omni" else 12 * np.tan(np.radians(59.9)))
    check_shadow_outline(frame, in_frustum & (frame.height_m < 1e-3), distance_outside(x, y, shadow), texel_m)


@pytest.mark.parametrize("cutoff", [10.0, 35.0, 65.0, 84.0])
def test_spot_lights_a_disc(gl, floor, make_scene, tmp_path, cutoff):
    """The radius is H tan(cutoff) for any map: the border does not depend on sampling."""
    height = 15.0 / np.tan(np.radians(cutoff))
    lamp = {"kind": "spot", "position": [2, -3, height], "target": [2, -3, 0], "cutoff": cutoff}
    mesh = write_boxes(tmp_path, ((1.0, 1.0, height / 20), (0, 0, height / 40))) | {"at": [-60, 60]}
    scene = make_scene(floor, sun="none", lights={"lamp": lamp}, meshes=[mesh])
    view, x, y = map_around_middle(scene, 20.0)
    frame = render_points(scene, view, map_size=512)
    axis_distance = np.hypot(x - 2, y + 3)
    assert (frame.visibilities["lamp"][axis_distance < 15.0 - 1e-3] == 1.0).all()
    assert (frame.visibilities["lamp"][axis_distance > 15.0 + 1e-3] == 0.0).all()
    assert (axis_distance < 14.9).any() and (axis_distance > 15.1).any()


@pytest.mark.parametrize("tilt", [20.0, 50.0])
def test_tilted_spot_lights_an_ellipse_and_shades_a_post(gl, floor, make_scene, tmp_path, tilt):
    """The cone meets the floor where the angle from its axis is the cutoff. A post's shadow points away from the lamp's foot."""
    lamp = {"kind": "spot", "position": [0, 0, 10], "target": [10 * np.tan(np.radians(tilt)), 0, 0], "cutoff": 25.0}
    mesh = write_boxes(tmp_path, ((0.8, 0.8, 3.0), (0, 0, 1.5))) | {"at": [8, 1.0]}
    scene = make_scene(floor, sun="none", lights={"lamp": lamp}, meshes=[mesh])
    view, x, y = map_around_middle(scene, 25.0)
    frame = render_points(scene, view, map_size=2048, filter=1)
    ground = frame.height_m < 1e-3
    axis = np.array([np.sin(np.radians(tilt)), 0.0, -np.cos(np.radians(tilt))])
    ray = np.stack([x, y, np.full_like(x, -10.0)], axis=-1)
    angle = np.degrees(np.arccos(np.clip(ray @ axis / np.linalg.norm(ray, axis=-1), -1, 1)))
    assert (frame.visibilities["lamp"][ground & (angle > 25.001)] == 0.0).all()
    roof = shapely.box(7.6, 0.6, 8.4, 1.4)
    shadow = shapely.union(shapely.affinity.scale(roof, 10 / 7, 10 / 7, origin=(0, 0)), roof).convex_hull
    check_shadow_outline(frame, ground & (angle < 24.99), distance_outside(x, y, shadow), 0.12)


def segment_meets_cube(lamp: np.ndarray, points: np.ndarray, centre: np.ndarray, half: float) -> np.ndarray:
    """Return whether the segment from a lamp to points (n, 3) meets a cube."""
    direction = points - lamp
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = (
            (centre - lamp - np.sign(direction) * half) / direction,
            (centre - lamp + np.sign(direction) * half) / direction,
        )
    near, far = np.nan_to_num(near, nan=-np.inf).max(axis=1), np.nan_to_num(far, nan=np.inf).min(axis=1)
    return (near < far) & (far > 0) & (near < 1)


LAMP_POSITION = np.array([0.0, 0.0, 12.0])
ROOM_HALF_SIDE_M = 10.0
"""Half the side of the room around the lamp."""


@pytest.mark.parametrize("algorithm", ["shadow_map", "truth"])
def test_omni_light_casts_in_all_directions(gl, floor, make_scene, tmp_path, algorithm):
    """Six cubes surround a lamp in a room of thin slabs. Each wall has its cube's shadow; corners and edges of the room have none.

    Two cameras in opposite corners see all walls. The room reaches below the floor, which is moved out of the way.
    """
    slabs, cubes = [], []
    for axis in range(3):
        for side in (-1.0, 1.0):
            normal = np.eye(3)[axis] * side
            size = np.where(np.abs(normal) > 0, 0.1, 2 * ROOM_HALF_SIDE_M + 0.2)
            slabs.append((size, LAMP_POSITION + normal * (ROOM_HALF_SIDE_M + 0.05)))
            cubes.append(LAMP_POSITION + 4.0 * normal)
    parts = [*slabs, *[((1.4, 1.4, 1.4), cube) for cube in cubes], ((0.1, 0.1, 0.1), (0, 150, 0.05))]
    mesh = write_boxes(tmp_path, *parts)
    corner = ROOM_HALF_SIDE_M - 0.6
    views = {
        name: {
            "kind": "perspective", "eye": [s * corner, s * corner, 12 + s * corner], "target": [0, 0, 12],
            "fov": 110, "size": [200, 200],
        }
        for name, s in (("low", -1.0), ("high", 1.0))
    }  # fmt: skip
    scene = make_scene(floor, sun="none", lights={"lamp": {"kind": "omni", "position": [0, 0, 12]}}, meshes=[mesh], views=views)
    walls_seen = set()
    for name in views:
        view = scene.view(name)
        frame = render_points(scene, view, algorithm=algorithm, map_size=1024, filter=1)
        point = frame.position_earth_m
        lamp_offset = np.abs(point - LAMP_POSITION)
        margin = 1e-3 if algorithm == "truth" else 0.03  # a texel of 20 mm and a half
        # Where two walls meet, a texel centre may lie on the other wall.
        wall = (
            frame.valid
            & (np.abs(lamp_offset.max(axis=-1) - ROOM_HALF_SIDE_M) < 1e-3)
            & (np.sort(lamp_offset, axis=-1)[..., 1] < ROOM_HALF_SIDE_M - margin)
        )
        assert wall.mean() > 0.5
        points = point[wall]
        surely_dark = np.any([segment_meets_cube(LAMP_POSITION, points, cube, 0.7 - margin) for cube in cubes], axis=0)
        surely_lit = ~np.any([segment_meets_cube(LAMP_POSITION, points, cube, 0.7 + margin) for cube in cubes], axis=0)
        lit = frame.visibilities["lamp"][wall] >= 0.5
        assert not lit[surely_dark].any() and lit[surely_lit].all()
        assert (surely_dark | surely_lit).mean() > 0.9
        side = np.argmax(lamp_offset[wall], axis=1)
        signs = np.sign((points - LAMP_POSITION)[np.arange(len(side)), side])
        walls_seen |= {(int(a), int(s)) for a, s, d in zip(side, signs, surely_dark, strict=True) if d}
    assert walls_seen == {(axis, side) for axis in range(3) for side in (-1, 1)}


def test_spot_straight_up_lights_a_ceiling(gl, floor, make_scene, tmp_path):
    """The ceiling's underside shows a disc, with a hole where a cube occludes the lamp."""
    parts = [((60.0, 60.0, 0.2), (0, 0, 20.1)), ((2.0, 2.0, 2.0), (0, 0, 10.0)), ((0.1, 0.1, 0.1), (0, 40, 0.05))]
    views = {"eye": {"kind": "perspective", "eye": [1, -15, 1], "target": [0, 0, 20], "fov": 80, "size": [160, 160]}}
    lamp = {"kind": "spot", "position": [0, 0, 2], "target": [0, 0, 20], "cutoff": 30.0}
    scene = make_scene(floor, sun="none", lights={"lamp": lamp}, meshes=[write_boxes(tmp_path, *parts)], views=views)
    frame = render_points(scene, scene.view("eye"), map_size=1024, filter=1)
    ceiling = frame.valid & (np.abs(frame.height_m - 20.0) < 1e-3)
    x, y = frame.position_earth_m[ceiling][:, :2].T
    disc = np.hypot(x, y) - 18.0 * np.tan(np.radians(30.0))
    hole = np.maximum(np.abs(x), np.abs(y)) - 18.0 / 7.0  # the hole is that of the cube's underside, 7 m above the lamp
    lit = frame.visibilities["lamp"][ceiling] >= 0.5
    assert ceiling.mean() > 0.3 and not lit[disc > 1e-3].any() and not lit[hole < -0.05].any()
    assert lit[(disc < -0.01) & (hole > 0.05)].all() and (hole < -0.05).any()


@pytest.fixture
def grove(write_raster, make_scene, tmp_path) -> Scene:
    """Return rolling ground with trees and a house under a spot and an omni light, seen from the side and from above."""
    y, x = np.mgrid[0:60, 0:60] / 59.0
    heights = 3 * np.sin(6 * x + 1) + 2.5 * np.cos(7 * y)
    raster = write_raster(heights.astype(np.float32), ENGINEERING, -60.0, 60.0, 2.0)
    rng = np.random.default_rng(11)
    points = [shapely.Point(*p) for p in rng.uniform(-35, 35, (25, 2)) if np.hypot(*p) > 8]
    wkb = shapely.to_wkb(np.array(points, object))
    pyogrio.raw.write(
        tmp_path / "trees.gpkg", wkb, [rng.uniform(4, 9, len(points))], ["height"], geometry_type="Point", crs=ENGINEERING
    )
    house = write_boxes(tmp_path, ((8.0, 6.0, 5.0), (12, 5, 2.5)), ((0.5, 0.5, 8.0), (-10, -6, 4.0)))
    lights = {
        "beam": {"kind": "spot", "position": [-25, -20, 22], "target": [0, 0, 0], "cutoff": 40},
        "bulb": {"kind": "omni", "position": [2, -3, 9]},
    }
    views = {"eye": {"kind": "perspective", "eye": [-30, -45, 18], "target": [2, 0, 1], "fov": 45, "size": [200, 160]}}
    forest = [{"source": "trees.gpkg", "height": "height"}]
    return make_scene(raster, sun="none", lights=lights, meshes=[house], forest=forest, views=views)


@pytest.mark.parametrize("light", ["beam", "bulb"])
@pytest.mark.parametrize("kind", ["perspective", "map"])
def test_lamp_map_agrees_with_truth(gl, grove, light, kind):
    """Shadows and lit areas have no interior error on ground, walls and trees, and few errors at their borders."""
    view = grove.view("eye") if kind == "perspective" else grove.view(bounds=(-40, -40, 40, 40), size=(211, 211))
    frame = render_points(grove, view, algorithm="shadow_map", map_size=2048, filter=1)
    buffer = geometry_buffer(grove, view)
    truth = trace_truth(buffer, grove, find_casters(grove, buffer), light=light)
    metrics = error_metrics(frame.visibilities[light], truth, describe(grove, view).pixel_m, 1.0)
    cast_shadow = ~truth.lit & ~truth.attached_shadow_mask & truth.valid
    assert 0.02 < cast_shadow.sum() / truth.valid.sum() < 0.8 and truth.decidable.mean() > 0.3
    assert metrics.interior <= MAX_INTERIOR_SHARE and metrics.wrong < 0.02 and metrics.wrong_cast < 0.05
    dark = frame.visibilities[light] < 0.5
    assert (dark[attached_shadow_mask(buffer, grove, light) & buffer.valid]).all()


def test_lamp_that_lights_nothing_visible_leaves_it_dark(gl, floor, make_scene, tmp_path):
    """The spot shines past the view. All is dark, and the passes are still those of the plan."""
    lamp = {"kind": "spot", "position": [150, 150, 5], "target": [190, 190, 5], "cutoff": 5.0}
    mesh = write_boxes(tmp_path, ((4.0, 3.0, 5.0), (0, 0, 2.5)))
    scene = make_scene(floor, sun="none", lights={"lamp": lamp}, meshes=[mesh])
    view, _, _ = map_around_middle(scene, 17.0)
    frame = render(scene, view)
    assert (frame.visibilities["lamp"] == 0.0).all() and [record.name for record in frame.passes] == frame.plan.passes


@pytest.mark.parametrize("bits", [16, 24, 32])
def test_lamp_depths_of_all_bits_show_no_acne(gl, floor, make_scene, tmp_path, bits):
    """Under a close lamp, from vertical to grazing light, the floor is lit except for the box's shadow."""
    mesh = write_boxes(tmp_path, ((0.5, 0.5, 0.5), (0, 0, 0.25))) | {"at": [150, 150]}
    scene = make_scene(floor, sun="none", lights={"lamp": {"kind": "omni", "position": [3.3, 1.7, 4.0]}}, meshes=[mesh])
    view, _, _ = map_around_middle(scene, 60.0)
    for taps in (1, 3):
        frame = render_points(scene, view, map_size=512, filter=taps, depth_bits=bits, algorithm="shadow_map")
        assert (frame.visibilities["lamp"] == 1.0).all()
