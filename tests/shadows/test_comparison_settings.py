"""Settings to compare with: they show the fault that they are for, are refused where unsound, and no policy chooses them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from skugga.selector.planner.planner import make_plan
from skugga.shadows.maps.camera import Camera, Light
from skugga.shadows.maps.post_perspective import post_perspectives
from skugga.shadows.maps.settings import SLOPE_BIAS, SLOPE_BIAS_LIMIT
from skugga.shadows.maps.slope_bias import move_by_slope_bias
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.describe import describe
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.level.level import Shadows
from skugga.terrain.lights import LightPosition
from skugga.terrain.scene import Scene
from tests.render import plan_of, render_points
from tests.shadows.boxes import box, build_mesh_scene
from tests.shadows.maps.test_bias import write_plane

OUTSIDE = {"kind": "perspective", "eye": [-25, -40, 25], "target": [0, 0, 1], "fov": 50, "size": [160, 128]}
INSIDE = {"kind": "perspective", "eye": [0, 9, 1.5], "target": [0, 30, 1], "fov": 50, "size": [160, 128]}
AXIS = {"kind": "perspective", "eye": [0, -40, 6], "target": [0, 0, 3], "fov": 50, "size": [160, 128]}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory) -> Scene:
    """A tall box under a sun in the south, seen from outside of its shadow and from inside."""
    folder = tmp_path_factory.mktemp("boxes")
    return build_mesh_scene(folder, [box((9, 6, 12)), box((3, 3, 3), 0, (-9, 14))], 180, 30, views={"out": OUTSIDE, "in": INSIDE})


def mesh_visibility(scene: Scene, view: str, algorithm: str, **overrides) -> np.ndarray:
    """Return the sun's visibility in a view by an algorithm for the meshes."""
    return render_points(scene, scene.view(view), algorithm={"meshes": algorithm}, **overrides).visibility


def acne_share(make_scene, raster: Path, **overrides) -> float:
    """Return the share of a plane that is not wholly lit by a map of 512 texels, though the sun faces it."""
    scene = make_scene(raster, 127, 20)
    view = scene.view(bounds=(-300, -300, 300, 300), size=(120, 120))
    frame = render_points(scene, view, algorithm="shadow_map", map_size=512, **overrides)
    return float((frame.visibility < 1.0).mean())


# -- bias


@pytest.mark.parametrize("bias", ["receiver_plane", "normal_offset", "polygon_offset"])
def test_bias_scale_0_shows_acne_and_the_default_none(gl, write_raster, make_scene, bias):
    raster = write_plane(write_raster, 60, 37)
    assert acne_share(make_scene, raster, bias=bias, filter=1) == 0.0
    assert acne_share(make_scene, raster, bias=bias, filter=1, bias_scale=0.0) > 0.3


def test_large_bias_scale_detaches_the_shadow(gl, boxes):
    """The shadow begins late, so there is less of it, and all of it lies where the right one does."""
    dark = {}
    for scale in (1.0, 12.0):
        frame = render_points(
            boxes, boxes.view("out"), algorithm={"meshes": "shadow_map"}, map_size=256, cascades=1, filter=1, bias="normal_offset",
            bias_scale=scale,
        )  # fmt: skip
        dark[scale] = (frame.visibility < 0.5).sum()
    assert dark[12.0] < 0.9 * dark[1.0]


def test_slope_bias_moves_points_by_the_clamped_tangent():
    """On ground at 45 degrees to the sun the tangent is 1. Grazing ground reaches the limit."""
    depth_map = SimpleNamespace(uniforms={"lamp": False, "window_m": (50.0, 50.0, 200.0)})
    points, normals = np.array([[3.0, 4.0, 5.0], [0.0, 1.0, 2.0], [7.0, 0.0, 0.0]]), np.zeros((3, 3))
    sun = LightPosition(np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    normals[0], normals[1], normals[2] = [0, 0, 1.0], [0.7072, 0.0, -0.707], sun[:3]
    moved = move_by_slope_bias(depth_map, points, normals, sun, 2.0) - points
    np.testing.assert_allclose(moved[0], 2.0 * SLOPE_BIAS * 200.0 * np.array(sun[:3]))
    np.testing.assert_allclose(moved[1], 2.0 * SLOPE_BIAS_LIMIT * 200.0 * np.array(sun[:3]))
    np.testing.assert_allclose(moved[2], 0.0, atol=1e-9)


def test_slope_bias_of_a_lamp_is_a_share_of_its_depth():
    near, far = 2.0, 80.0
    uniforms = {"lamp": True, "near_far_m": (near, far), "light_from_frame": tuple(np.diag([1.0, -1.0, -1.0]).T.ravel())}
    depth_map = SimpleNamespace(uniforms=uniforms, face_rotations=(np.eye(3),))
    points = np.array([[12.0, 0.0, 0.0]], np.float32)
    moved = move_by_slope_bias(depth_map, points, np.array([[0.0, 0.0, 1.0]]), LightPosition(0.0, 0.0, 24.0, 1.0), 1.0)

    def depth(z: float) -> float:
        return 0.5 + 0.5 * ((far + near) - 2.0 * far * near / z) / (far - near)

    assert moved.dtype == np.float32
    assert depth(24.0) - depth(24.0 - moved[0, 2]) == pytest.approx(SLOPE_BIAS * 12.0 / 24.0, rel=1e-3)
    assert moved[0, 0] / (24.0 - moved[0, 2]) == pytest.approx(0.5)


def test_slope_clamped_bias_knows_no_texels(gl, write_raster, make_scene):
    """The same bias that suffices for fine texels shows acne on coarse ones."""
    raster = write_plane(write_raster, 60, 37)
    assert acne_share(make_scene, raster, bias="slope_clamped", filter=1) > 0.01
    assert acne_share(make_scene, raster, bias="slope_clamped", filter=1, bias_scale=10.0) == 0.0


# -- counting and mask


@pytest.mark.parametrize("algorithm", ["shadow_volume", "hybrid"])
def test_z_pass_equals_z_fail_outside_of_volumes(gl, boxes, algorithm):
    z_pass, z_fail = (mesh_visibility(boxes, "out", algorithm, counting=counting) for counting in ("z_pass", "z_fail"))
    np.testing.assert_array_equal(z_pass, z_fail)
    assert 0.02 < (z_pass < 0.5).mean() < 0.9


@pytest.mark.parametrize("algorithm", ["shadow_volume", "hybrid"])
def test_z_pass_is_refused_inside_a_volume(gl, boxes, algorithm):
    with pytest.raises(UnsupportedError, match="counting: 'z_pass' is not supported here: .*inside a shadow volume"):
        mesh_visibility(boxes, "in", algorithm, counting="z_pass")
    assert np.isfinite(mesh_visibility(boxes, "in", algorithm, counting="auto")).any()


def test_hybrid_without_mask_equals_volumes(gl, boxes):
    """All receivers are left to volumes. With the conservative mask no pixel differs here, either."""
    frame = render_points(boxes, boxes.view("out"), algorithm={"meshes": "hybrid"}, mask="off")
    volumes = mesh_visibility(boxes, "out", "shadow_volume")
    np.testing.assert_array_equal(frame.visibility, volumes)
    np.testing.assert_array_equal(mesh_visibility(boxes, "out", "hybrid", mask="conservative"), volumes)
    marked = {record.name.rpartition(": ")[2]: record.marked for record in frame.passes}["stencil"]
    assert marked > (volumes > 0.5).sum()


# -- slide-back


def test_without_slide_back_the_camera_stays_at_the_eye():
    camera = Camera(np.array([0.0, -40.0, 6.0]), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]))
    light = Light(np.array([np.sqrt(0.5), -0.1, np.sqrt(0.49), 0.0]), np.zeros(3))
    points = np.random.default_rng(5).uniform([-15, -30, 0], [15, 60, 4], (400, 3))
    candidates = post_perspectives(camera, light, points, 0.95, slides_back=False)
    assert [candidate.slide_back_m for candidate in candidates] == [0.0]
    along_axis = Light(np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(3))
    assert post_perspectives(camera, along_axis, points, 0.95, slides_back=False) == []


def test_no_slide_back_is_refused_along_the_axis_and_drawn_across(gl, tmp_path):
    across = build_mesh_scene(tmp_path, [box((3, 3, 4))], 260, 40, views={"eye": AXIS})
    with_slide, without = (
        mesh_visibility(across, "eye", "perspective_shadow_map", slide_back=value, map_size=128) for value in ("auto", "off")
    )
    assert (with_slide != without).any() and ((with_slide < 0.5) == (without < 0.5)).mean() > 0.97
    along = build_mesh_scene(tmp_path, [box((3, 3, 4))], 180, 4.3, views={"eye": AXIS})
    with pytest.raises(UnsupportedError, match="slide_back: 'off' is not supported here: .*use auto"):
        mesh_visibility(along, "eye", "perspective_shadow_map", slide_back="off")


# -- plans


def test_plan_names_the_fault_of_each_setting(boxes):
    view = boxes.view("out")

    def reasons(algorithm: str, **overrides) -> dict[str, str]:
        plan = make_plan(describe(boxes, view, "out"), boxes.loaded.level, {"algorithm": {"meshes": algorithm}, **overrides})
        return {entry.name: entry.reason for entry in plan.reasons}

    assert "acne" in reasons("shadow_map", bias_scale=0.0)["bias_scale 0.0"]
    assert "peter-panning" in reasons("shadow_map", bias="normal_offset", bias_scale=8.0)["bias_scale 8.0"]
    assert "coarse maps show acne" in reasons("shadow_map", bias="slope_clamped")["bias slope_clamped"]
    assert "refused" in reasons("shadow_volume", counting="z_pass")["counting z_pass"]
    assert "volumes decide all pixels" in reasons("hybrid", mask="off")["mask off"]
    assert "virtual camera" in reasons("perspective_shadow_map", slide_back="off")["slide_back off"]
    assert "without effect" in reasons("light_space_perspective_map", slide_back="off")["slide_back off"]
    assert "without effect" in reasons("shadow_volume", bias_scale=0.0)["bias_scale 0.0"]


def test_policies_search_no_setting_to_compare_with():
    compared = {("bias", "slope_clamped"), ("counting", "z_pass"), ("mask", "off"), ("slide_back", "off")}
    for algorithm in ALGORITHMS.values():
        search = algorithm.search
        assert "bias_scale" not in search.search_space
        searched = {(key, value) for key, values in search.search_space.items() for value in values}
        varied = {item for overrides in (*search.resolution_variants, *search.other_variants) for item in overrides.items()}
        assert not compared & (searched | varied)


def test_settings_have_limits():
    assert Shadows(bias_scale=0).bias_scale == 0.0 and Shadows().bias_scale == "auto"
    for wrong in ({"bias_scale": -1}, {"bias_scale": float("nan")}, {"slide_back": "on"}, {"mask": "none"}):
        with pytest.raises(ValueError, match="bias_scale|slide_back|mask"):
            Shadows(**wrong)


def test_default_settings_keep_their_names(boxes):
    """Names of candidates show a setting only if it differs from its default."""
    view = boxes.view("out")
    for algorithm in ("shadow_map", "perspective_shadow_map"):
        plain, scaled = (
            plan_of(boxes, view, algorithm={"meshes": algorithm}, map_size=512, **overrides).settings["sun"]["meshes"].label_parts
            for overrides in ({}, {"bias_scale": 0.5})
        )
        assert scaled == [*plain, "bias_scale_0.5"]
