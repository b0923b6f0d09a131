"""Bias against self-shadowing in shadow maps, and face culling."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.ndimage import binary_dilation

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.truth.truth import Truth, trace_truth
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from tests.rasters import ENGINEERING
from tests.render import plan_of
from tests.shadows.boxes import box, build_mesh_scene, visibility

EYE = {"kind": "perspective", "eye": [-15, -21, 14], "target": [-3, 1, 1], "fov": 45, "size": [320, 240]}
SPOT = {"kind": "spot", "position": [20, -12, 20], "target": [0, 0, 0], "cutoff": 40}
TAPS = [1, 2, 3, 5]


def write_plane(write_raster, slope_deg: float, towards_deg: float):
    """Write a plane of 960 m that faces an azimuth with a slope."""
    axis = (np.arange(96) - 47.5) * 10.0
    east, north = np.meshgrid(axis, -axis)
    facing = np.radians(towards_deg)
    rise = -np.tan(np.radians(slope_deg)) * (east * np.sin(facing) + north * np.cos(facing))
    return write_raster(rise.astype(np.float32), ENGINEERING, -480, 480, 10.0, name="plane.tif")


def shaded_share(make_scene, raster, azimuth: float, altitude: float, **overrides) -> float:
    """Return the share of a plane's pixels that are not wholly lit. The sun faces the plane."""
    scene = make_scene(raster, azimuth, altitude)
    view = scene.view(bounds=(-300, -300, 300, 300), size=(120, 120))
    assert not attached_shadow_mask(geometry_buffer(scene, view), scene).any()
    return float((visibility(scene, view, map_size=512, **overrides)[0] < 1.0).mean())


def interior_errors(rendered: np.ndarray, truth: Truth, buffer: GeometryBuffer) -> np.ndarray:
    """Return pixels of the wrong class, two pixels or more from shadow edges and from contacts of ground and meshes."""
    contact_pixels = binary_dilation(buffer.surface_kind == MESHES) & (buffer.surface_kind != MESHES)
    return truth.valid & ~binary_dilation(~truth.decidable | contact_pixels, iterations=2) & ((rendered >= 0.5) != truth.lit)


# -- bias


@pytest.mark.parametrize("taps", TAPS)
def test_normal_offset_is_no_larger_than_needed(gl, write_raster, make_scene, taps):
    """With 0.8 of the offset, a plane that the sun grazes along a texel diagonal shades itself."""
    raster = write_plane(write_raster, 60, 37)
    overrides = {"bias": "normal_offset", "filter": taps}
    assert shaded_share(make_scene, raster, 127, 20, **overrides) == 0.0
    assert shaded_share(make_scene, raster, 127, 20, bias_scale=0.8, **overrides) > 1e-3


@pytest.mark.parametrize(("taps", "sufficient_scale"), [(1, 1.0), (2, 2.0), (3, 3.0), (5, 5.0)])
def test_polygon_offset_suffices_only_for_one_tap(gl, write_raster, make_scene, taps, sufficient_scale):
    """Taps of n a side need a slope factor of n. The customary factor is 1.1."""
    raster = write_plane(write_raster, 60, 37)
    overrides = {"bias": "polygon_offset", "filter": taps}
    share = shaded_share(make_scene, raster, 127, 20, **overrides)
    assert share == 0.0 if taps == 1 else share > 0.05
    assert shaded_share(make_scene, raster, 127, 20, bias_scale=sufficient_scale, **overrides) == 0.0


@pytest.mark.parametrize("light", ["sun", "lamp"])
@pytest.mark.parametrize("bias", ["receiver_plane", "normal_offset", "polygon_offset"])
def test_bias_keeps_shadows_right_away_from_edges(gl, tmp_path, bias, light):
    scene = build_mesh_scene(
        tmp_path, [box((9, 6, 5)), box((3, 3, 3), 0, (-6, -5))], 110, 28, views={"eye": EYE}, lights={"lamp": SPOT}
    )
    view = scene.view("eye")
    rendered, buffer = visibility(scene, view, light, bias=bias, filter=1, map_size=4096)
    truth = trace_truth(buffer, scene, find_casters(scene, buffer), light=light)
    assert (truth.valid & ~truth.lit & ~truth.attached_shadow_mask).mean() > 0.03
    assert not interior_errors(rendered, truth, buffer).any()


def test_bias_methods_differ_in_the_picture(gl, tmp_path):
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28, views={"eye": EYE})
    rendered = [
        visibility(scene, scene.view("eye"), bias=name)[0] for name in ("receiver_plane", "normal_offset", "polygon_offset")
    ]
    for first, second in ((0, 1), (1, 2), (0, 2)):
        assert np.nanmax(np.abs(rendered[first] - rendered[second])) > 0.3


# -- culling


@pytest.mark.parametrize("light", ["sun", "lamp"])
def test_front_culling_of_closed_bodies_needs_no_bias(gl, tmp_path, light):
    """Lit sides have no acne without bias; with front faces drawn they have much. Shadows on the ground do not change."""
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28, views={"eye": EYE}, lights={"lamp": SPOT})
    view = scene.view("eye")
    rendered = {}
    for culling in ("none", "front"):
        for scale in (0.0, 1.0):
            rendered[culling, scale], buffer = visibility(scene, view, light, scale, culling=culling, filter=1, map_size=1024)
    lit_side = (buffer.surface_kind == MESHES) & ~attached_shadow_mask(buffer, scene, light)
    inside = lit_side & ~binary_dilation(~lit_side, iterations=3)
    assert inside.mean() > 0.02
    assert (rendered["none", 0.0][inside] < 1.0).mean() > 0.05
    assert (rendered["front", 0.0][inside] == 1.0).all() and (rendered["front", 1.0][inside] == 1.0).all()
    ground = buffer.surface_kind == RELIEF
    assert (rendered["none", 1.0][ground] < 0.5).mean() > 0.02
    contact = binary_dilation(buffer.surface_kind == MESHES, iterations=3)
    np.testing.assert_array_equal(rendered["none", 1.0][ground & ~contact], rendered["front", 1.0][ground & ~contact])


def test_front_culling_leaves_open_meshes_whole(gl, tmp_path):
    """The meshes are a box without a face, a box inside out and a sheet, on the ground."""
    lidless, inside_out = box((6, 6, 5)), box((4, 4, 4), 0, (-9, 5))
    lidless = trimesh.Trimesh(lidless.vertices, lidless.faces[2:], process=False)
    inside_out.invert()
    sheet = trimesh.Trimesh([[6, -8, 3], [10, -8, 3], [10, -4, 4], [6, -4, 4]], [[0, 1, 2], [0, 2, 3]], process=False)
    scene = build_mesh_scene(tmp_path, [lidless, inside_out, sheet], 110, 28, views={"eye": EYE})
    rendered = [visibility(scene, scene.view("eye"), culling=culling)[0] for culling in ("none", "front")]
    assert (rendered[0] < 0.5).mean() > 0.02
    np.testing.assert_array_equal(*rendered)


def test_front_culling_keeps_the_shadow_of_an_open_sheet(gl, tmp_path):
    """The sheet stands beside a closed box."""
    sheet = trimesh.Trimesh([[6, -8, 3], [10, -8, 3], [10, -4, 3], [6, -4, 3]], [[0, 1, 2], [0, 2, 3]], process=False)
    scene = build_mesh_scene(tmp_path, [box((4, 4, 4), 0, (-9, 5)), sheet], 110, 28, views={"eye": EYE})
    rendered, buffer = visibility(scene, scene.view("eye"), culling="front", filter=1, map_size=4096)
    truth = trace_truth(buffer, scene, find_casters(scene, buffer))
    assert not interior_errors(rendered, truth, buffer).any()


# -- plans


def test_plan_gives_reasons_for_bias_and_culling(gl, tmp_path):
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28, views={"eye": EYE})
    view = scene.view("eye")
    plan = plan_of(scene, view, algorithm="shadow_map")
    settings = plan.settings["sun"]["meshes"]
    assert (settings.bias, settings.culling, settings.filter) == ("receiver_plane", "none", 3)
    assert {"bias receiver_plane", "culling none"} <= {reason.name for reason in plan.reasons}
    plan = plan_of(scene, view, bias="polygon_offset", culling="front", filter=2)
    settings = plan.settings["sun"]["meshes"]
    assert (settings.bias, settings.culling, settings.filter) == ("polygon_offset", "front", 2)
    reasons = {reason.name: reason.reason for reason in plan.reasons}
    assert reasons["bias polygon_offset"] == reasons["culling front"] == "set by the request"


@pytest.mark.parametrize(("key", "value"), [("bias", "slope"), ("culling", "back"), ("filter", "moon")])
def test_plan_refuses_unknown_values(tmp_path, key, value):
    scene = build_mesh_scene(tmp_path, [box((9, 6, 5))], 110, 28)
    with pytest.raises(InputError, match=f"{key}: '{value}' is not allowed") as raised:
        plan_of(scene, scene.view(), **{key: value})
    assert raised.value.name == key
