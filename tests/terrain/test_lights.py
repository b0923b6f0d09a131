"""Lamps: position, direction, falloff, and independence of lights from each other."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from skugga.api.compute import product_of_frame
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.lamps import apply_lamps
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.world import geocentric
from skugga.terrain.level.level import SUN, parse_algorithm
from skugga.terrain.lights import CONE_EDGE_FADE_SHARE, axes_along
from skugga.terrain.scene import Scene
from skugga.terrain.shading import FLAT_GROUND_ALBEDO, LEVEL_GROUND_EXPOSURE, shade
from tests.rasters import ENGINEERING
from tests.render import plan_of, render

UTM = "EPSG:32633"
X0, Y0 = 450_000.0, 6_000_000.0


@pytest.fixture
def floor(write_raster) -> Path:
    """File of a raster of level ground."""
    return write_raster(np.zeros((41, 41), np.float32), ENGINEERING, -205.0, 205.0, 10.0)


@pytest.fixture
def post_mesh(tmp_path) -> list[dict]:
    """Return a mesh that casts shadows: a box 3 m high, with its centre 30 m east of the floor's centre."""
    trimesh.creation.box(extents=(4.0, 4.0, 3.0)).export(tmp_path / "post.obj")
    return [{"source": "post.obj", "at": [30, 0]}]


def omni_light(height: float = 10.0, **keys) -> dict:
    """Return the keys of a lamp at a height above the origin."""
    return {"lamp": {"kind": "omni", "position": [0, 0, height], **keys}}


def spot(height: float = 10.0, cutoff: float = 30.0, **keys) -> dict:
    """Return the keys of a spot light that points down at the origin. ``cutoff`` is in degrees."""
    return {"lamp": {"kind": "spot", "position": [0, 0, height], "target": [0, 0, 0], "cutoff": cutoff, **keys}}


def square_map(scene: Scene, half: float = 40.0, px: int = 80):
    """Return a map around the centre, and the coordinates of its pixels."""
    view = scene.view(bounds=(-half, -half, half, half), size=(px, px))
    x, y = view.grid.x(view.col0 + np.arange(px) * view.col_step), view.grid.y(view.row0 + np.arange(px) * view.row_step)
    x, y = np.meshgrid(x, y)
    return view, x, y


def unshadowed_light(scene: Scene, view, names: tuple[str, ...]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return visibilities without cast shadows by light, and the light (rows, cols, 3) of the lamps among them."""
    buffer = geometry_buffer(scene, view)
    shines = {name: np.where(attached_shadow_mask(buffer, scene, name), 0.0, 1.0).astype(np.float32) for name in names}
    lamplight = np.zeros((*buffer.valid.shape, 3), np.float32)
    apply_lamps(lamplight, ShadingBlock(scene, view, buffer, shines))
    return shines, lamplight


def color_under_lights(scene: Scene, view, names: tuple[str, ...]) -> np.ndarray:
    """Return the linear colour (rows, cols, 3) of a view under some lights, without cast shadows."""
    buffer = geometry_buffer(scene, view)
    shines, lamplight = unshadowed_light(scene, view, names)
    return shade(buffer, scene, shines.get("sun", np.zeros(buffer.valid.shape, np.float32)), lamplight=lamplight)


# -- position and direction


@given(st.tuples(*[st.floats(-1, 1)] * 3).map(np.array), st.tuples(*[st.floats(-1, 1)] * 3).map(np.array))
def test_axes_are_right_handed_upright_and_forward(forward, up):
    if min(np.linalg.norm(forward), np.linalg.norm(up)) < 0.1:
        return
    forward, up = forward / np.linalg.norm(forward), up / np.linalg.norm(up)
    for direction in (forward, up, -up):
        axes = axes_along(direction, up)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0) and np.allclose(axes[:, 2], direction)
        if np.linalg.norm(np.cross(direction, up)) > 1e-3:
            assert axes[:, 0] @ up == pytest.approx(0.0, abs=1e-9) and axes[:, 1] @ up < 0.0


@pytest.mark.parametrize("number", range(3))
def test_axes_along_the_vertical_are_orthonormal(number):
    """The vertical can be any direction on the globe, including the coordinate axes."""
    up = np.eye(3)[number]
    for direction in (up, -up):
        axes = axes_along(direction, up)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)


def test_spot_on_the_globe_has_its_position_and_target(write_raster, make_scene):
    """Position and target are heights above the local ground. At the distance of the target, the intensity is 1."""
    raster = write_raster(np.full((40, 40), 250.0, np.float32), UTM, X0, Y0, 10.0)
    to = Transformer.from_crs(UTM, "EPSG:4326", always_xy=True).transform
    a, b = to(X0 + 100, Y0 - 200), to(X0 + 200, Y0 - 100)
    light = {"kind": "spot", "position": [*a, 30], "target": [*b, 2], "cutoff": 25, "intensity": 3}
    scene = make_scene(raster, lights={"beam": light, "bulb": {"kind": "omni", "position": [*a, 0.4]}})
    beam, bulb = scene.lamps["beam"], scene.lamps["bulb"]
    (p, up), (q, up_q) = geocentric(*map(np.float64, a)), geocentric(*map(np.float64, b))
    position, target = p + 280.0 * up, q + 252.0 * up_q
    np.testing.assert_allclose(beam.position_earth_m, position, atol=1e-6)
    np.testing.assert_allclose(beam.earth_from_lamp[:, 2], (target - position) / np.linalg.norm(target - position), atol=1e-12)
    assert beam.reference_distance_m == pytest.approx(np.linalg.norm(target - position)) and beam.cutoff_deg == 25.0
    np.testing.assert_allclose(bulb.earth_from_lamp[:, 2], -up, atol=1e-12)
    assert bulb.cutoff_deg == 180.0 and bulb.reference_distance_m == 1.0  # at least a metre
    assert scene.light_names == (SUN, "beam", "bulb")


# -- falloff


def test_omni_light_falls_off_with_the_squared_distance(floor, make_scene):
    """On a floor the irradiance is h / r^3, and at the foot of the lamp it equals the stated intensity."""
    scene = make_scene(floor, sun="none", lights=omni_light(10.0, intensity=0.7, color=[1.0, 0.5, 0.25]))
    view, x, y = square_map(scene)
    lamp_color = color_under_lights(scene, view, ("lamp",)) - color_under_lights(scene, view, ())
    r = np.sqrt(x**2 + y**2 + 100.0)
    expected = FLAT_GROUND_ALBEDO * LEVEL_GROUND_EXPOSURE * 0.7 * np.array([1.0, 0.5, 0.25]) * (1000.0 / r**3)[..., None]
    np.testing.assert_allclose(lamp_color, expected, atol=1e-5)


def test_spot_fades_out_at_its_rim(floor, make_scene):
    """The light is full within nine tenths of the half angle and zero outside of the cone."""
    scene = make_scene(floor, sun="none", lights=spot(20.0, 40.0, intensity=0.5))
    view, x, y = square_map(scene)
    lamp_color = (color_under_lights(scene, view, ("lamp",)) - color_under_lights(scene, view, ()))[..., 0]
    angle = np.degrees(np.arctan2(np.hypot(x, y), 20.0))
    full_light = FLAT_GROUND_ALBEDO * LEVEL_GROUND_EXPOSURE * 0.5 * np.cos(np.radians(angle)) ** 3
    inside, outside = angle < 40.0 * (1 - CONE_EDGE_FADE_SHARE), angle > 40.0
    np.testing.assert_allclose(lamp_color[inside], full_light[inside], atol=1e-5)
    np.testing.assert_allclose(lamp_color[outside], 0.0, atol=1e-6)
    rim = ~inside & ~outside
    share = lamp_color[rim] / full_light[rim]
    assert rim.sum() > 100 and (share > -1e-4).all() and (share < 1.0001).all()
    order = np.argsort(angle[rim])
    assert (np.diff(share[order]) < 1e-3).all()


def test_lit_area_of_a_spot_is_its_cone(floor, make_scene):
    """Attached shadow starts exactly at a circle of radius h tan(cutoff)."""
    scene = make_scene(floor, sun="none", lights=spot(15.0, 50.0))
    view, x, y = square_map(scene, px=200)
    is_unlit = attached_shadow_mask(geometry_buffer(scene, view), scene, "lamp")
    np.testing.assert_array_equal(is_unlit, np.hypot(x, y) > 15.0 * np.tan(np.radians(50.0)))


# -- many lights


def test_visibilities_of_lights_are_independent(gl, floor, make_scene, post_mesh):
    """The sun's visibility is that without the lamp, and the lamp's that without the sun. The colours add up."""
    lit_by_both = make_scene(floor, 250.0, 25.0, lights=omni_light(8.0), meshes=post_mesh)
    lit_by_sun = make_scene(floor, 250.0, 25.0, meshes=post_mesh)
    night = make_scene(floor, sun="none", lights=omni_light(8.0), meshes=post_mesh)
    view = lit_by_both.view(bounds=(10, -20, 50, 20), size=(150, 150))  # pixels are off the nodes: no whole blocks
    frames = [render(scene, view, map_size=1024, filter=1) for scene in (lit_by_both, lit_by_sun, night)]
    assert list(frames[0].visibilities) == [SUN, "lamp"] and list(frames[1].visibilities) == [SUN]
    assert list(frames[2].visibilities) == ["lamp"]
    for light, other in ((SUN, frames[1]), ("lamp", frames[2])):
        visibility = frames[0].visibilities[light]
        assert 0.01 < (visibility < 0.5).mean() < 0.4
        np.testing.assert_array_equal(visibility, other.visibilities[light])
    lit_by_sun_only = (frames[0].visibilities["lamp"] == 0) & (frames[0].visibilities[SUN] == 1)
    lit_by_sun_and_lamp = (frames[0].visibilities["lamp"] == 1) & (frames[0].visibilities[SUN] == 1)
    assert frames[0].color[lit_by_sun_and_lamp].mean() > frames[0].color[lit_by_sun_only].mean()


def test_frame_under_another_light(gl, floor, make_scene, post_mesh):
    scene = make_scene(floor, 250.0, 25.0, lights=omni_light(8.0), meshes=post_mesh)
    frame = render(scene, scene.view(bounds=(10, -20, 50, 20), size=(60, 60)))
    assert frame.with_light_first(None) is frame
    lamp_frame = frame.with_light_first("lamp")
    np.testing.assert_array_equal(product_of_frame(scene, lamp_frame, "visibility"), frame.visibilities["lamp"])
    np.testing.assert_array_equal(product_of_frame(scene, frame, "visibility"), frame.visibilities[SUN])
    assert (product_of_frame(scene, lamp_frame, "mask") != product_of_frame(scene, frame, "mask")).any()
    np.testing.assert_array_equal(lamp_frame.color, frame.color)
    with pytest.raises(InputError, match="light: 'moon'.*sun, lamp") as caught:
        frame.with_light_first("moon")
    assert "\n" not in str(caught.value)


def test_scene_without_light_is_dark_but_drawn(gl, floor, make_scene, post_mesh):
    scene = make_scene(floor, sun="none", meshes=post_mesh)
    assert scene.light_names == () and scene.light_space is None and not scene.sun_is_up
    frame = render(scene, scene.view(bounds=(10, -20, 50, 20), size=(60, 60)))
    assert list(frame.visibilities) == [SUN] and (frame.visibility == 0.0).all() and frame.valid.all()
    assert [record.name for record in frame.passes] == frame.plan.passes == ["geometry", "attached", "shading"]
    assert frame.plan.algorithms_text == "none"
    assert 0 < frame.color.mean() < 60


def test_lamps_shine_at_night(gl, floor, make_scene, post_mesh):
    """A sun below the horizon gives no light and needs no passes. The lamp and its shadows are drawn."""
    scene = make_scene(floor, 250.0, -30.0, lights=omni_light(8.0), meshes=post_mesh)
    view = scene.view(bounds=(-20, -20, 50, 20), size=(133, 76))
    frame = render(scene, view)
    assert (frame.visibilities[SUN] == 0.0).all()
    lamp = frame.visibilities["lamp"]
    assert 0.02 < (lamp == 0.0).mean() < 0.3 and (lamp == 1.0).mean() > 0.6
    assert not any(name.startswith("sun/") for name in frame.plan.passes) and any(n.startswith("lamp/") for n in frame.plan.passes)
    night_frame = render(make_scene(floor, 250.0, -30.0, meshes=post_mesh), view)
    x = view.grid.x(view.col0 + np.arange(view.cols) * view.col_step)
    assert frame.color[:, np.abs(x) < 5].mean() > night_frame.color[:, np.abs(x) < 5].mean() + 40


def test_each_light_may_have_its_own_algorithm(gl, floor, make_scene, post_mesh):
    scene = make_scene(floor, 250.0, 25.0, lights=omni_light(8.0), meshes=post_mesh)
    view = scene.view(bounds=(10, -20, 50, 20), size=(60, 60))
    plan = plan_of(scene, view, algorithm=parse_algorithm("sun=none,lamp=truth"))
    assert set(plan.algorithm[SUN].values()) == {"none"} and plan.algorithm["lamp"]["meshes"] == "truth"
    frame = render(scene, view, algorithm=parse_algorithm("sun=none,lamp=truth"))
    ground = frame.height_m < 1e-3
    assert (frame.visibilities[SUN][ground] == 1.0).all() and (frame.visibilities["lamp"][ground] == 0.0).any()


@pytest.mark.parametrize("algorithm", ["moon=shadow_map", "lamp=shadow_map,moon=none", "moon=truth,relief=none"])
def test_unknown_light_in_an_override_is_rejected_in_one_line(floor, make_scene, post_mesh, algorithm):
    scene = make_scene(floor, lights=omni_light(8.0), meshes=post_mesh)
    view = scene.view(size=(16, 16))
    with pytest.raises(InputError, match="algorithm.*sun, lamp.*relief, meshes, forest") as caught:
        plan_of(scene, view, algorithm=parse_algorithm(algorithm))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("light", "expected_text"),
    [
        ({"kind": "omni", "position": [500, 0, 5]}, "lights.lamp.position"),
        ({"kind": "spot", "position": [0, 0, 5], "target": [0, 900, 0]}, "lights.lamp.target"),
    ],
)
def test_lamp_off_the_data_is_rejected_in_one_line(floor, make_scene, light, expected_text):
    scene = make_scene(floor, lights={"lamp": light})
    with pytest.raises(LevelError, match=expected_text) as caught:
        _ = scene.lamps
    assert "\n" not in str(caught.value) and "terrain's data" in str(caught.value)


def moving_lamp(kind: str, *keys: dict, **lamp_keys) -> dict:
    """Return the keys of a moving lamp of a kind with a path of keys."""
    motion = {name: lamp_keys.pop(name) for name in ("loop", "above") if name in lamp_keys}
    return {"lamp": {"kind": kind, "motion": {"path": list(keys), **motion}, **lamp_keys}}


def test_moving_lamp_keeps_its_intensity(floor, make_scene):
    """The ground nearby is as bright as at the first key, except for the squared distance and the angle of incidence."""
    path = {"seconds": 0, "position": [0, 0, 10]}, {"seconds": 8, "position": [50, 0, 40]}
    scene = make_scene(floor, lights=moving_lamp("omni", *path))
    static_scene = make_scene(floor, lights=omni_light(10.0))
    view, x, y = square_map(scene)
    first_light, static_light, later_light = (
        unshadowed_light(lamp_scene, view, ("lamp",))[1][..., 0] for lamp_scene in (scene, static_scene, scene.at_second(8.0))
    )
    np.testing.assert_array_equal(first_light, static_light)
    distance_m = np.hypot(39.5 - 50, 40)
    masks = {east: (np.abs(x - east) < 0.6) & (np.abs(y) < 0.6) for east in (0.0, 39.5)}
    assert later_light[masks[39.5]].mean() == pytest.approx(
        first_light[masks[0.0]].mean() * 10**2 / distance_m**2 * 40 / distance_m, rel=0.02
    )


def test_searchlight_turns_to_its_moving_target(floor, make_scene):
    """The position is fixed. Targets have heights above the sea, too."""
    aims = {"seconds": 2, "target": [-30, 0, 0]}, {"seconds": 6, "target": [30, 0, 0]}
    scene = make_scene(floor, lights=moving_lamp("spot", *aims, position=[0, 0, 30], cutoff=8, above="sea"))
    for seconds, aim in ((0.0, -30), (4.0, 0), (6.0, 30)):
        lamp = scene.at_second(seconds).lamps["lamp"]
        np.testing.assert_allclose(lamp.position_earth_m, [0, 0, 30], atol=1e-6)
        np.testing.assert_allclose(lamp.earth_from_lamp[:, 2] * np.hypot(aim, 30), [aim, 0, -30], atol=1e-6)
        assert lamp.reference_distance_m == pytest.approx(np.hypot(30, 30))
        view, x, y = square_map(scene)
        is_lit = unshadowed_light(scene.at_second(seconds), view, ("lamp",))[1].sum(axis=-1) > 0
        assert x[is_lit].mean() == pytest.approx(aim, abs=3.0) and np.abs(y[is_lit]).max() < 8


@pytest.mark.parametrize(
    ("light", "expected_text"),
    [
        (
            moving_lamp("omni", {"seconds": 0, "position": [0, 0, 5]}, {"seconds": 3, "position": [0, 400, 5]}),
            "lights.lamp.motion.path.1.position: '(0.0, 400.0, 5.0)' is not allowed. Allowed: a position on the terrain: within",
        ),
        (
            moving_lamp("omni", {"seconds": 0, "position": [0, 0, 5]}, {"seconds": 4, "position": [0, 40, -5]}),
            "lights.lamp.motion.path: at -",
        ),
        (
            moving_lamp("spot", {"seconds": 0, "position": [-10, 0, 5]}, {"seconds": 4, "position": [10, 0, 5]}, target=[0, 0, 5]),
            "lights.lamp.motion.path: the light meets its target at second 2. Keep the light at least 0.1 m from its target",
        ),
        (
            moving_lamp("spot", {"seconds": 0, "target": [-10, 0, 0]}, {"seconds": 4, "target": [600, 0, 0]}, position=[0, 0, 9]),
            "lights.lamp.motion.path.1.target: '(600.0, 0.0, 0.0)' is not allowed",
        ),
    ],
)
def test_invalid_lamp_path_is_rejected_in_one_line(floor, make_scene, light, expected_text):
    scene = make_scene(floor, lights=light)
    with pytest.raises(LevelError) as caught:
        _ = scene.lamps
    assert expected_text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "light", "expected_text"),
    [
        ("lamp", {"kind": "spot", "position": [0, 0, 5]}, "target"),
        ("lamp", {"kind": "omni", "position": [0, 0, 5], "target": [0, 0, 0]}, "target"),
        ("lamp", {"kind": "spot", "position": [0, 0, 5], "target": [0, 0, 5]}, "target"),
        ("lamp", {"kind": "spot", "position": [0, 0, 5], "target": [0, 0, 0], "cutoff": 85}, "cutoff"),
        ("lamp", {"kind": "omni", "position": [0, 0, 5], "intensity": 0}, "intensity"),
        ("lamp", {"kind": "omni", "position": [0, 0, 5], "color": [0, 0, 2]}, "color"),
        ("lamp", {"kind": "area", "position": [0, 0, 5]}, "kind"),
        ("sun", {"kind": "omni", "position": [0, 0, 5]}, "lights"),
        ("relief", {"kind": "omni", "position": [0, 0, 5]}, "lights"),
        ("shadow_map", {"kind": "omni", "position": [0, 0, 5]}, "lights"),
        ("a lamp", {"kind": "omni", "position": [0, 0, 5]}, "lights"),
    ],
)
def test_invalid_lamp_is_rejected_in_one_line(floor, make_scene, name, light, expected_text):
    with pytest.raises(LevelError, match=expected_text) as caught:
        make_scene(floor, lights={name: light})
    assert "\n" not in str(caught.value)
