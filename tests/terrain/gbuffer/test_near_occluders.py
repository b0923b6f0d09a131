"""Ambient occlusion beside meshes: against rays in all directions, closed forms, and parts of a picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from skugga.selector.select import plan_of_view
from skugga.shadows.render import render_frame
from skugga.terrain.gbuffer.near_occluders import LATTICE_PX, MAX_EVEN_DIFFERENCE, REFLECTED_SHARE, open_share
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

SIZE = 160, 120

RAYS = 20_000


@pytest.fixture
def scene_of(tmp_path: Path) -> Callable[..., Scene]:
    """Return a function that makes a scene of one mesh on a level floor, and a view from above."""

    def make(mesh: trimesh.Trimesh, switch: str = "auto") -> Scene:
        write_geotiff(tmp_path / "floor.tif", np.zeros((64, 64), np.float32), ENGINEERING, -320.0, 320.0, 10.0)
        mesh.export(tmp_path / "mesh.obj")
        keys = {
            "version": 1, "terrain": {"source": "floor.tif"}, "sun": {"azimuth": 250.0, "altitude": 40.0},
            "meshes": [{"source": "mesh.obj", "at": [0.0, 0.0]}], "effects": {"ambient_occlusion": switch},
            "views": {"above": {"kind": "perspective", "eye": [25, -30, 28], "target": [0, 0, 2], "fov": 45, "size": list(SIZE)}},
        }  # fmt: skip
        (tmp_path / "level.yaml").write_text(json.dumps(keys), encoding="utf-8")
        return build_scene(load_level(tmp_path / "level.yaml"))

    return make


def upward_rays() -> np.ndarray:
    """Return directions (n, 3) with a density that falls with the cosine from the zenith."""
    rng = np.random.default_rng(5)
    radius, azimuth = np.sqrt(rng.random(RAYS)), 2.0 * np.pi * rng.random(RAYS)
    return np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1.0 - radius**2)])


def hidden_by_box(point: np.ndarray, half_m: np.ndarray, height_m: float) -> float:
    """Return the share of upward rays from a point of the floor that meet a box in the middle of the floor."""
    with np.errstate(divide="ignore"):
        rays = upward_rays()
        low, high = (np.array([*(sign * half_m), end]) for sign, end in ((-1.0, 0.0), (1.0, height_m)))
        near, far = np.minimum((low - point) / rays, (high - point) / rays), np.maximum((low - point) / rays, (high - point) / rays)
    return float((near.max(axis=1) < np.minimum(far.min(axis=1), np.inf)).mean())


def hidden_by_sphere(point: np.ndarray, middle: np.ndarray, radius_m: float) -> float:
    along = upward_rays() @ (middle - point)
    squares = np.sum((middle - point) ** 2) - along**2
    return float(((along > 0.0) & (squares < radius_m**2)).mean())


def shares_on_floor(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return points (n, 3) of the floor, metres from the foot of the mesh, and their open shares (n,)."""
    view = scene.view("above")
    buffer = geometry_buffer(scene, view)
    shares = open_share(buffer, scene.objects.solids)
    row, col = np.nonzero(buffer.valid & (buffer.surface_kind == RELIEF))
    chosen = slice(None, None, len(row) // 150)
    assert buffer.solids_frame_m is not None
    low, high = buffer.solids_frame_m.min(axis=0), buffer.solids_frame_m.max(axis=0)
    foot = np.array([*(0.5 * (low + high)[:2]), low[2]])
    return buffer.position_frame_m[row, col][chosen] - foot, shares[row, col][chosen]


def test_floor_beside_a_box_sees_what_rays_see(gl, scene_of):
    half_m, height_m = np.array([4.0, 6.0]), 7.0
    box = trimesh.creation.box((*(2.0 * half_m), height_m))
    points, shares = shares_on_floor(scene_of(box))
    expected = np.array([1.0 - (1.0 - REFLECTED_SHARE) * hidden_by_box(point, half_m, height_m) for point in points])
    assert expected.min() < 0.8 and (expected < 0.95).sum() > 10
    assert np.abs(shares - expected).max() < 0.03
    assert np.abs(shares - expected).mean() < 0.008


def test_round_bodies_of_many_triangles_are_spheres(gl, scene_of):
    ball = trimesh.creation.icosphere(3, 5.0)
    points, shares = shares_on_floor(scene_of(ball))
    expected = np.array([1.0 - (1.0 - REFLECTED_SHARE) * hidden_by_sphere(p, np.array([0.0, 0.0, 5.0]), 5.0) for p in points])
    assert expected.min() < 0.9 and (expected < 0.95).sum() > 10
    assert np.abs(shares - expected).max() < 0.04


def test_faces_of_a_convex_body_hide_nothing_from_each_other(gl, scene_of):
    scene = scene_of(trimesh.creation.box((8.0, 12.0, 7.0)))
    buffer = geometry_buffer(scene, scene.view("above"))
    shares = open_share(buffer, scene.objects.solids)
    assert (buffer.surface_kind == MESHES).sum() > 500
    np.testing.assert_array_equal(shares[buffer.surface_kind == MESHES], 1.0)


def test_a_part_of_a_view_is_a_part_of_its_picture(gl, scene_of):
    scene = scene_of(trimesh.creation.box((8.0, 12.0, 7.0)))
    view = scene.view("above")
    assert isinstance(view, PerspectiveView)
    whole, part = (open_share(geometry_buffer(scene, drawn), scene.objects.solids) for drawn in (view, view.part(37, 50, 41, 62)))
    inner = slice(LATTICE_PX, -LATTICE_PX), slice(LATTICE_PX, -LATTICE_PX)
    np.testing.assert_array_equal(part[inner], whole[37:78, 50:112][inner])
    np.testing.assert_allclose(part, whole[37:78, 50:112], atol=MAX_EVEN_DIFFERENCE)


def test_nothing_floats_in_the_shadow_of_a_box(gl, scene_of):
    """In shadow the ground gets darker towards the wall, and keeps its colour far from it."""
    colors, masks = [], []
    for switch in ("on", "off"):
        scene = scene_of(trimesh.creation.box((8.0, 12.0, 7.0)), switch)
        frame = render_frame(scene, scene.view("above"), plan_of_view(scene, scene.view("above"), "above"))
        assert ("ambient_occlusion" in frame.effects) == (switch == "on")
        colors.append(frame.color.astype(float).sum(axis=-1))
        masks.append(frame.valid & (frame.visibility == 0.0) & (frame.height_m < 0.01))
    change = (colors[0] / colors[1])[masks[0] & masks[1]]
    assert change.size > 300
    assert change.min() < 0.85 and change.max() > 0.97 and np.median(change) > 0.9
