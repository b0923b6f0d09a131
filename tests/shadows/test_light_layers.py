"""Layers that show a light's maps: frustum, bounds, the light's view and the post-perspective space, by known geometry."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.api.compute import check_view, product_of_frame
from skugga.api.light_drawing import draw_lines_over_frame, draw_post_perspective, tone_map_light_view
from skugga.api.products import PRODUCTS
from skugga.shadows.line_drawing import Line, line_opacity
from skugga.shadows.maps.light_layers import box_lines, light_view
from skugga.shadows.maps.post_perspective_view import rays_to_light
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS
from skugga.shadows.passes import CASTER_LINE, MAP_LINE, RECEIVER_LINE
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.errors import InputError, UnsupportedError
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from tests.render import plan_of
from tests.shadows.boxes import box, build_mesh_scene

EYE = {"kind": "perspective", "eye": [-25, -40, 25], "target": [0, 0, 1], "fov": 50, "size": [160, 128]}
ALONG = {"kind": "perspective", "eye": [0, -40, 6], "target": [0, 0, 3], "fov": 50, "size": [160, 128]}
SPOT = {"kind": "spot", "position": [-12, 8, 20], "target": [0, 0, 0], "cutoff": 30}
BOX_SIDES_M = 8.0, 6.0, 5.0
NO_LAMP = {"meshes": "shadow_map", "lamp": "none"}


@pytest.fixture(scope="module")
def overhead(tmp_path_factory) -> Scene:
    """A box of 8 x 6 x 5 m in the middle of level ground, straight below the sun, and a spot."""
    folder = tmp_path_factory.mktemp("overhead")
    return build_mesh_scene(folder, [box(BOX_SIDES_M)], 180, 90, views={"eye": EYE}, lights={"lamp": SPOT})


def render_layers(scene: Scene, *layers: str, view: str = "eye", **overrides) -> Frame:
    """Render a view with layers of its algorithms, without samples of edges."""
    scene_view = scene.view(view)
    return render_frame(
        scene, scene_view, plan_of(scene, scene_view, **overrides), layers=frozenset(layers), pixel_sampling="points"
    )


def lines_of(frame: Frame, layer: str, light: str, role: float) -> np.ndarray:
    """Return the lines (n, 2, 3) of a role in a layer."""
    lines = frame.layers[layer][light]
    return lines[lines[:, 7] == role, :6].reshape(-1, 2, 3)


# -- what the light sees


def test_light_view_shows_the_top_of_a_box_at_its_place(gl, overhead):
    frame = render_layers(overhead, "light-view", "light-frustum", algorithm=NO_LAMP, map_size=512, cascades=1)
    seen = frame.layers["light-view"][SUN]
    top_m = frame.position_frame_m[np.isclose(frame.height_m, BOX_SIDES_M[2], atol=1e-3)]
    settings = frame.plan.settings[SUN]["meshes"]
    texel_m = np.array(settings.cascades[0].texel_m)
    held = np.isfinite(seen)
    np.testing.assert_allclose(seen[held], -top_m[0, 2], atol=2.0 * settings.cascades[0].depth_step_m + 1e-3)
    perimeter_texels = 2.0 * (BOX_SIDES_M[0] + BOX_SIDES_M[1]) / texel_m.min()
    assert abs(held.sum() - BOX_SIDES_M[0] * BOX_SIDES_M[1] / texel_m.prod()) <= perimeter_texels
    rotation, _ = overhead.light_space.transform_from_frame(frame.frame)
    corners = lines_of(frame, "light-frustum", SUN, MAP_LINE).reshape(-1, 3)
    from_middle = (rotation @ (np.array([0.0, 0.0, top_m[0, 2]]) + _middle_of_box(frame) - corners.mean(axis=0)))[:2] / texel_m
    row, col = np.argwhere(held).mean(axis=0)
    rows, cols = seen.shape
    np.testing.assert_allclose([col - (cols - 1) / 2, (rows - 1) / 2 - row], from_middle, atol=1.0)


def _middle_of_box(frame: Frame) -> np.ndarray:
    """Return the middle of the box in the frame (3,), from its visible top, without its height."""
    top_m = frame.position_frame_m[np.isclose(frame.height_m, BOX_SIDES_M[2], atol=1e-3)]
    return np.array([*(top_m.min(axis=0)[:2] + top_m.max(axis=0)[:2]) / 2.0, 0.0])


def test_light_view_of_a_perspective_map_is_in_metres(gl, overhead):
    """Under a sun at the zenith all that it holds of the box lies at its top, however the map is warped."""
    frame = render_layers(overhead, "light-view", algorithm={"meshes": "perspective_shadow_map", "lamp": "none"}, map_size=256)
    seen = frame.layers["light-view"][SUN]
    top_m = frame.position_frame_m[np.isclose(frame.height_m, BOX_SIDES_M[2], atol=1e-3)]
    assert np.isfinite(seen).sum() > 300 and not any(record.note for record in frame.passes)
    np.testing.assert_allclose(seen[np.isfinite(seen)], -top_m[0, 2], atol=0.01)


def test_hybrid_shows_its_own_map(gl, overhead):
    """Texels that the box touches hold its top. The casters' box ends with these texels."""
    frame = render_layers(
        overhead, "light-view", "light-frustum", "light-bounds", algorithm={"meshes": "hybrid", "lamp": "none"}, map_size=256
    )
    seen = frame.layers["light-view"][SUN]
    top_m = frame.position_frame_m[np.isclose(frame.height_m, BOX_SIDES_M[2], atol=1e-3)]
    np.testing.assert_allclose(seen[np.isfinite(seen)], -top_m[0, 2], atol=0.05)
    rotation, _ = overhead.light_space.transform_from_frame(frame.frame)
    assert len(lines_of(frame, "light-frustum", SUN, MAP_LINE)) == 12
    window_m = np.ptp(lines_of(frame, "light-frustum", SUN, MAP_LINE).reshape(-1, 3) @ rotation.T, axis=0)[:2]
    texel_m = window_m / np.array(seen.shape[::-1])
    sides_m = np.ptp(lines_of(frame, "light-bounds", SUN, CASTER_LINE).reshape(-1, 3) @ rotation.T, axis=0)[:2]
    assert (np.sort(sides_m) >= [6.0 - 1e-3, 8.0 - 1e-3]).all() and (
        np.sort(sides_m) <= np.array([6.0, 8.0]) + 2.0 * texel_m.max()
    ).all()


def test_light_view_of_a_lamp_is_the_distance_from_it(gl, overhead):
    algorithm = {"relief": "none", "meshes": "none", "lamp": "shadow_map"}
    frame = render_layers(overhead, "light-view", algorithm=algorithm, map_size=256)
    seen = frame.layers["light-view"]["lamp"]
    assert seen.shape == (256, 256)
    position, axis, _ = overhead.lamps["lamp"].in_frame(frame.frame)
    middle = seen[127:129, 127:129].mean()  # the axis meets the box's top 5 m above the target
    assert middle == pytest.approx(15.0 / -axis[2], rel=2e-3)
    to_top_m = np.linalg.norm(frame.position_frame_m[np.isclose(frame.height_m, 5.0, atol=1e-3)] - position, axis=1).min()
    assert np.nanmin(seen) == pytest.approx(to_top_m, rel=0.02)


def test_large_light_view_keeps_the_nearest_texels(gl, overhead, monkeypatch):
    monkeypatch.setattr("skugga.shadows.maps.light_layers.MAX_VIEW_TEXELS", 64)
    frame = render_layers(overhead, "light-view", algorithm=NO_LAMP, map_size=256, cascades=1)
    seen = frame.layers["light-view"][SUN]
    assert max(seen.shape) <= 64 and np.isfinite(seen).any()


def test_tone_map_is_bright_near_the_light_and_transparent_elsewhere():
    depths = np.full((8, 12), np.nan, np.float32)
    depths[:, :4], depths[:, 4:8] = 3.0, 40.0
    picture = tone_map_light_view(depths, np.zeros(0))
    assert picture.dtype == np.uint8 and (picture[:, 8:] == 0).all() and (picture[:, :8, 3] == 255).all()
    assert picture[4, 1, 0] > picture[4, 6, 0] + 100


# -- lines


def test_frustum_of_a_spot_begins_at_the_lamp(gl, overhead):
    """All side edges pass through the lamp, at the tangent of the map's corners, and end just behind the farthest receiver."""
    algorithm = {"relief": "none", "meshes": "none", "lamp": "shadow_map"}
    frame = render_layers(overhead, "light-frustum", algorithm=algorithm, map_size=256)
    position, axis, rotation = overhead.lamps["lamp"].in_frame(frame.frame)
    lines = lines_of(frame, "light-frustum", "lamp", MAP_LINE)
    assert lines.shape == (12, 2, 3)
    depth_m = (lines - position) @ axis
    is_side = np.abs(depth_m[:, 0] - depth_m[:, 1]) > 1.0
    assert is_side.sum() == 4
    for start, end in lines[is_side]:
        along = (end - start) / np.linalg.norm(end - start)
        assert np.linalg.norm(np.cross(position - start, along)) < 1e-6
        tangent = np.linalg.norm(np.cross(along, axis)) / abs(along @ axis)
        assert tangent == pytest.approx(np.sqrt(2.0) * np.tan(np.radians(30)) * 256 / (256 - 2 * MAP_BORDER_TEXELS))
    points = (frame.position_frame_m[frame.valid] - position) @ rotation.T
    limit = np.tan(np.radians(30)) * 256 / (256 - 2 * MAP_BORDER_TEXELS)
    inside = (points[:, 2] > 0.0) & (np.abs(points[:, :2]).max(axis=1) <= limit * points[:, 2])
    assert depth_m.max() == pytest.approx(1.02 * points[inside, 2].max(), rel=1e-6)
    assert depth_m.min() == pytest.approx(0.98 * points[inside, 2].min(), rel=1e-6)


def test_bounds_are_those_of_receivers_and_casters(gl, overhead):
    """Below a sun at the zenith the casters' box is the box itself. Receivers reach from the ground to its top."""
    frame = render_layers(overhead, "light-bounds", algorithm=NO_LAMP, map_size=512)
    casters = lines_of(frame, "light-bounds", SUN, CASTER_LINE).reshape(-1, 3) - _middle_of_box(frame)
    rotation, _ = overhead.light_space.transform_from_frame(frame.frame)
    sides = np.ptp(casters @ rotation.T, axis=0)
    np.testing.assert_allclose(sorted(sides), sorted(BOX_SIDES_M), atol=1e-3)
    receivers = lines_of(frame, "light-bounds", SUN, RECEIVER_LINE).reshape(-1, 3) @ rotation.T
    points = frame.position_frame_m[frame.valid & (frame.visibilities[SUN] > 0.5)] @ rotation.T
    np.testing.assert_allclose(receivers.min(axis=0), points.min(axis=0), atol=0.6)
    np.testing.assert_allclose(receivers.max(axis=0), points.max(axis=0), atol=0.6)


def test_edges_of_a_box_end_before_infinity():
    """Of a projective box that reaches beyond infinity, only the edges before it remain."""
    matrix = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, -1.0], [0, 0, 1.0, 0]])  # z is -1 / depth
    lines = box_lines(matrix, np.array([-1.0, -1.0, -1.0]), np.array([1.0, 1.0, 0.5]), 3, MAP_LINE)
    assert len(lines) == 8 and (lines[:, 6] == 3).all()
    depth = lines[:, [2, 5]]
    assert depth.min() == pytest.approx(1.0) and 100.0 < depth.max() < np.inf


def test_hidden_lines_are_dashed():
    surface = np.full((21, 120), -np.inf)
    surface[:, 60:] = 1.0
    opacity = line_opacity([Line(np.array([5.0, 10.0]), np.array([114.0, 10.0]), 0.5, 0.5)], surface)
    row = opacity[10]
    assert (row[6:59] > 0.95).all() and (opacity[:8] == 0.0).all()
    hidden = row[62:113]
    assert hidden.max() < 0.8 and hidden.min() == 0.0 and 0.2 < (hidden > 0.0).mean() < 0.8
    assert not line_opacity([Line(np.array([-50.0, 3.0]), np.array([-2.0, 9.0]), 0.5, 0.5)], surface).any()


def test_lines_over_a_frame_change_only_their_pixels(gl, overhead):
    frame = render_layers(overhead, "light-frustum", "light-bounds", algorithm=NO_LAMP, map_size=256)
    for layer in ("light-frustum", "light-bounds"):
        picture = draw_lines_over_frame(product_of_frame(overhead, frame, layer), frame)
        changed = (picture != frame.color).any(axis=-1)
        assert picture.shape == frame.color.shape and 0.005 < changed.mean() < 0.4


def test_each_cascade_has_a_frustum(gl, overhead):
    frame = render_layers(overhead, "light-frustum", algorithm=NO_LAMP, map_size=256, cascades=2)
    lines = frame.layers["light-frustum"][SUN]
    assert len(lines) == 24 and set(lines[:, 6]) == {0.0, 1.0}


# -- post-perspective space


@pytest.mark.parametrize("algorithm", ["perspective_shadow_map", "light_space_perspective_map"])
def test_post_perspective_enlarges_what_is_near(gl, tmp_path, algorithm):
    boxes = [box((3, 3, 4), 0, (-5, -20)), box((3, 3, 4), 0, (5, 25))]
    scene = build_mesh_scene(tmp_path, boxes, 250, 40, views={"eye": ALONG})
    frame = render_layers(scene, "post-perspective", algorithm={"meshes": algorithm})
    layer = frame.layers["post-perspective"][SUN]
    assert layer.shape[2] == 5 and 0.03 < np.isfinite(layer[..., 0]).mean() < 0.9
    eye, camera_from_frame = frame.view.in_frame(frame.frame)
    ground_m = float(np.nanmedian(frame.position_frame_m[np.isclose(frame.height_m, 0.0, atol=1e-3)][:, 2]))
    on_box = layer[..., 2] > ground_m + 0.5
    forward_m = (layer[..., :3] - eye) @ camera_from_frame[2]
    near, far = (on_box & (forward_m < 40.0)).sum(), (on_box & (forward_m > 40.0)).sum()
    assert near > 2 * far > 0
    assert layer[..., 3].max() > 0.9 and layer[..., 4].max() > 0.9
    picture = draw_post_perspective(layer, frame)
    assert picture.shape == (*layer.shape[:2], 3) and picture.dtype == np.uint8


def test_rays_to_the_light_meet_in_it():
    for light in (np.array([3.0, -8.0, 1.5, 0.5]), np.array([3.0, -8.0, 1.5, -0.5])):
        rays = rays_to_light(light)
        for start, end in rays:
            assert np.linalg.norm(np.cross(end - start, light[:3] / light[3] - start)) < 1e-9
    parallel = rays_to_light(np.array([0.0, -2.0, 0.0, 0.0]))
    np.testing.assert_allclose(parallel[:, 1] - parallel[:, 0], np.broadcast_to([0.0, -0.7, 0.0], (len(parallel), 3)))


def test_uniform_map_has_no_post_perspective_space(gl, tmp_path):
    scene = build_mesh_scene(tmp_path, [box((3, 3, 4))], 180, 4.3, views={"eye": {**ALONG, "target": [0, 0, 3]}})
    frame = render_layers(scene, "post-perspective", algorithm={"meshes": "perspective_shadow_map"})
    with pytest.raises(InputError, match="post-perspective in this view: a uniform map: the light is"):
        product_of_frame(scene, frame, "post-perspective")


# -- refusals


@pytest.mark.parametrize(
    ("algorithm", "layer", "capable"),
    [
        ("shadow_volume", "light-view", "shadow_map, perspective_shadow_map, light_space_perspective_map"),
        ("planar", "light-frustum", "shadow_map, perspective_shadow_map, light_space_perspective_map"),
        ("shadow_map", "post-perspective", "perspective_shadow_map, light_space_perspective_map"),
    ],
)
def test_light_layer_of_another_algorithm_is_refused(overhead, algorithm, layer, capable):
    with pytest.raises(UnsupportedError) as caught:
        render_layers(overhead, layer, algorithm={"meshes": algorithm, "lamp": algorithm})
    assert layer in str(caught.value) and algorithm in str(caught.value) and capable in str(caught.value)


@pytest.mark.parametrize("layer", ["light-frustum", "light-bounds", "post-perspective"])
def test_light_layers_of_the_eye_are_refused_in_maps(overhead, layer):
    with pytest.raises(InputError, match=f"{layer}.*the layers of a map view"):
        check_view(PRODUCTS[layer], overhead.view("map"))


def test_light_view_reads_the_drawn_depths(gl, overhead, monkeypatch):
    """Depths of the light's view are those of the map that was drawn, not others."""
    values = []
    original = light_view
    monkeypatch.setattr(
        "skugga.shadows.maps.light_layers.read_depths", lambda gl, depth_map, target: np.ones(depth_map.face_size[::-1], np.float32)
    )
    monkeypatch.setattr("skugga.shadows.maps.light_layers.light_view", lambda *args: values.append(original(*args)) or values[-1])
    render_layers(overhead, "light-view", algorithm=NO_LAMP, map_size=256)
    assert values and np.isnan(values[0]).all()
