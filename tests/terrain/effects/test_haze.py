"""Haze: Koschmieder's law, where haze can show, what it hides, and pictures at the threshold of each."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from skugga.api.catalogue import find_level
from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.haze import (
    EFFECT,
    MAX_CHANGED_PIXEL_SHARE,
    MAX_NEAR_STEPS,
    RAYLEIGH_SCATTERING_PER_M,
    SRGB_ENCODER_BIN_WIDTH,
    _max_clipped_distance,
    _max_hiding_transmittance,
    _max_invisible_share,
    apply_haze,
    green_extinction_per_m,
    rgb_extinctions_per_m,
    shadow_hiding_distance_m,
    visibility_m_of,
)  # fmt: skip
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import Weather
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import encode_srgb, shade
from skugga.terrain.sky import CLEAR_AIR_VISIBILITY_M, horizon_colors, sky_color, sky_of

EAST = np.array([1.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
EYE_M = np.array([3.0, 4.0, 50.0])


@pytest.fixture
def make_floor_scene(tmp_path):
    """``make_floor_scene(eye, target, side, **keys)`` builds the scene of a flat floor, 400 m wide by default."""

    def make(eye=(0.0, -190.0, 10.0), target=(0.0, 0.0, 0.0), side=400, **keys) -> Scene:
        sun = keys.pop("sun", {"azimuth": 200, "altitude": 35})
        views = {"v": {"kind": "perspective", "eye": list(eye), "target": list(target), "fov": 40, "size": [160, 100]}}
        level = {"version": 1, "terrain": {"flat": {"size": [side, side], "cells": [8, 8]}}, "sun": sun, "views": views, **keys}
        level["shadows"] = {"algorithm": "none"}
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps(level), encoding="utf-8")
        return build_scene(load_level(path))

    return make


def hiding_distance_of_view_m(scene: Scene) -> float:
    """Return the distance from which haze hides shadows in the view ``v``."""
    return shadow_hiding_distance_m(scene, scene.view("v"))


def points_east_of_eye(
    scene: Scene, distance_m: np.ndarray, facing: np.ndarray, albedo: np.ndarray
) -> tuple[PerspectiveView, GeometryBuffer]:
    """Return a view and a buffer (1, n) of points at distances (n,) east of the eye, with normals (n, 3) and albedos (n, 3)."""
    view = look_at(EYE_M, EYE_M + EAST, UP, 40.0, 1, len(distance_m))
    frame = view.frame(scene.world)
    normal = facing[None].astype(np.float32)
    ones = np.ones((1, len(distance_m)), np.float32)
    position = (EYE_M + distance_m[:, None] * EAST - frame.origin_earth_m) @ frame.frame_from_earth.T
    kind = np.full(ones.shape, MESHES, np.uint8)
    buffer = GeometryBuffer(
        view, frame, ones > 0, position[None], 0 * ones, normal, normal, 0 * ones, kind, albedo=albedo[None].astype(np.float32)
    )
    return view, buffer


def hazed_colors(scene: Scene, color: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Return linear colours (n, 3) as they arrive at the eye from distances (n,)."""
    view, buffer = points_east_of_eye(scene, distance_m, np.tile(UP, (len(distance_m), 1)), color)
    out = color[None].astype(np.float32)
    apply_haze(out, ShadingBlock(scene, view, buffer, {}))
    return out[0]


def horizon_in_east(scene: Scene) -> np.ndarray:
    """Return the horizon's colour (3,) in the direction of ``points_east_of_eye``."""
    out = np.empty(3)
    sky_color(sky_of(scene), 0.0, np.sin(np.radians(scene.sun.azimuth_deg)), out)
    return out


def render_picture(scene: Scene, haze: str, name: str = "v", **view_options) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return a view's picture and the names of its passes, with haze ``on``, ``off`` or as the plan decides."""
    level = scene.loaded.level.model_copy(update={"effects": "auto" if haze == "auto" else {"haze": haze}})
    view = scene.view(name, **view_options)
    frame = render_frame(scene, view, make_plan(describe(scene, view, name), level, {}))
    return frame.color.astype(int), tuple(record.name for record in frame.passes)


def verdict(scene: Scene, name: str = "v"):
    """Return whether the view ``name`` requires the effect, and why."""
    return EFFECT.judge(describe(scene, scene.view(name), name))


def test_contrast_at_the_visibility_is_two_percent(make_floor_scene):
    scene = make_floor_scene(weather={"visibility": 500})
    black = hazed_colors(scene, np.zeros((3, 3)), np.array([0.0, 250.0, 500.0]))
    contrast = 1.0 - black / horizon_in_east(scene)
    assert contrast[:, 1] == pytest.approx(np.array([1.0, 0.02**0.5, 0.02]), rel=1e-5)
    assert green_extinction_per_m(500.0) == pytest.approx(3.912 / 500.0, rel=1e-4)


def test_extinction_is_rayleigh_in_clear_air_and_grey_in_mist():
    """At the visibility of air alone, extinction is Rayleigh's. Dust and drops add the same extinction to every colour."""
    air = np.array(RAYLEIGH_SCATTERING_PER_M)
    air_extinctions = rgb_extinctions_per_m(3.912023 / air[1])
    assert air_extinctions == pytest.approx(air, rel=1e-6)
    assert rgb_extinctions_per_m(2.0 * 3.912023 / air[1]) == pytest.approx(air / 2.0, rel=1e-6)
    haze_extinctions = rgb_extinctions_per_m(10_000.0)
    assert haze_extinctions[1] == pytest.approx(green_extinction_per_m(10_000.0))
    assert haze_extinctions - haze_extinctions[1] == pytest.approx(air - air[1], rel=1e-6)


def test_far_ground_fades_to_the_horizon_s_colour(make_floor_scene):
    scene = make_floor_scene(weather={"visibility": 100})
    far = hazed_colors(scene, np.array([[0.9, 0.1, 0.0]]), np.array([5000.0]))
    assert far[0] == pytest.approx(horizon_in_east(scene), abs=1e-6)


def test_haze_leaves_invalid_pixels_unchanged(make_floor_scene):
    scene = make_floor_scene(weather={"visibility": 100})
    view, buffer = points_east_of_eye(scene, np.array([50.0, 50.0]), np.tile(UP, (2, 1)), np.ones((2, 3)))
    buffer.valid[0, 1] = False
    color = np.full((1, 2, 3), 0.125, np.float32)
    apply_haze(color, ShadingBlock(scene, view, buffer, {}))
    assert (color[0, 1] == 0.125).all() and (color[0, 0] != 0.125).all()


def test_haze_is_not_needed_in_maps_near_views_and_sky(make_floor_scene):
    hazy_scene = make_floor_scene(weather={"visibility": 100})
    assert "no viewing distance" in verdict(hazy_scene, "map").reason and not verdict(hazy_scene, "map").is_needed
    near = make_floor_scene(eye=(0.0, 0.0, 3.0), target=(0.0, 0.5, 0.0))
    assert "100.0 km of visibility haze shows from" in verdict(near).reason and not verdict(near).is_needed
    sky_scene = make_floor_scene(target=(0.0, 0.0, 400.0), weather={"visibility": 100})
    assert "farther than 0.0 m" in verdict(sky_scene).reason and not verdict(sky_scene).is_needed


@pytest.mark.parametrize("view", ["main", "close"])
def test_haze_is_not_needed_in_a_room(gl, view):
    """Inside a sunlit room haze changes few dark pixels, by at most ``MAX_NEAR_STEPS``. In thick air it is needed."""
    scene = build_scene(load_level(find_level("thesis_room_sun")))
    decision = verdict(scene, view)
    assert not decision.is_needed and "none by more than" in decision.reason
    with_haze, without_haze = (render_picture(scene, haze, view)[0] for haze in ("on", "off"))
    change = np.abs(with_haze - without_haze).max(axis=-1)
    assert change.max() <= MAX_NEAR_STEPS and 0.0 < (change > 1).mean() <= MAX_CHANGED_PIXEL_SHARE
    hazy_level = scene.loaded.level.model_copy(update={"weather": Weather(visibility=5000.0)})
    hazy_scene = replace(scene, loaded=scene.loaded.model_copy(update={"level": hazy_level}))
    assert verdict(hazy_scene, view).is_needed


def test_haze_forced_on_in_a_map_changes_nothing(make_floor_scene):
    scene = make_floor_scene(weather={"visibility": 100})
    with_haze, without_haze = (render_picture(scene, haze, "map", size=(96, 96))[0] for haze in ("on", "off"))
    assert (with_haze == without_haze).all()


def test_air_is_clear_if_a_level_sets_no_visibility(make_floor_scene):
    color = np.full((1, 3), 0.1)
    with_default = hazed_colors(make_floor_scene(), color, np.array([9000.0]))
    up = EYE_M[2] / 8000.0
    with_visibility = hazed_colors(
        make_floor_scene(weather={"visibility": CLEAR_AIR_VISIBILITY_M * up / -np.expm1(-up)}), color, np.array([9000.0])
    )
    np.testing.assert_allclose(with_default, with_visibility, rtol=1e-6)
    assert (with_default > color).all() and with_default[0, 2] > with_default[0, 1] > with_default[0, 0]


def test_srgb_encoder_is_constant_within_bins():
    first = np.arange(round(1.0 / SRGB_ENCODER_BIN_WIDTH)) * SRGB_ENCODER_BIN_WIDTH
    assert (encode_srgb(first) == encode_srgb(first + 0.999 * SRGB_ENCODER_BIN_WIDTH)).all()
    assert (np.diff(encode_srgb(first[:4]).astype(int)) == 1).all()  # at black each bin has a code of its own


@given(st.floats(0.0, 1.0), st.floats(0.012, 0.92))
def test_max_invisible_share_moves_no_colour_by_two_steps(color, horizon):
    share = _max_invisible_share((horizon,), (horizon,))
    near = np.linspace(max(color - 2 * SRGB_ENCODER_BIN_WIDTH, 0.0), min(color + 2 * SRGB_ENCODER_BIN_WIDTH, 1.0), 400)
    blended = near + share * (horizon - near)
    assert np.abs(encode_srgb(blended).astype(int) - encode_srgb(near)).max() <= 1


@pytest.mark.parametrize("horizon", [0.0144, 0.1, 0.5, 0.92])
def test_max_invisible_share_is_tight_within_a_tenth(horizon):
    share = 1.1 * _max_invisible_share((horizon,), (horizon,))
    color = np.linspace(0.0, 1.0, 200_000)
    blended = color + share * (horizon - color)
    assert np.abs(encode_srgb(blended).astype(int) - encode_srgb(color)).max() == 2


@given(st.floats(0.0, 1.0), st.floats(0.012, 0.92), st.floats(0.05, 1.0), st.sampled_from([1.0, 0.8, 0.5, 0.2]))
def test_max_hiding_transmittance_equates_sun_and_shadow(dark, horizon, white, part):
    share = _max_hiding_transmittance((horizon,) * 3, (white,) * 3)
    dark = (1.0 - white) * dark + np.linspace(0.0, 8 * SRGB_ENCODER_BIN_WIDTH, 400)
    shadow = part * ((1.0 - share) * horizon + share * dark)
    sun = shadow + part * share * white
    assert np.abs(encode_srgb(np.minimum(sun, 1.0)).astype(int) - encode_srgb(np.minimum(shadow, 1.0))).max() <= 1


SUN_ALTITUDES_DEG = {"day": 50.0, "low": 14.0, "evening": 2.0, "sunset": 0.5}


def sun_shadow_steps(scene: Scene, distance_m: float) -> np.ndarray:
    """Return sRGB steps (n,) between sun and shadow, for points of all colours and directions at a distance."""
    rng = np.random.default_rng(0)
    count = 20_000
    facing = rng.normal(size=(count, 3))
    facing[: count // 2] = scene.sun.to_sun_earth
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    albedo = rng.random((count, 3)) ** 0.2
    view, buffer = points_east_of_eye(scene, np.full(count, distance_m), facing, albedo)
    pictures = []
    for share in (0.0, 1.0):
        color = shade(buffer, scene, np.full(buffer.valid.shape, share, np.float32))
        apply_haze(color, ShadingBlock(scene, view, buffer, {}))
        pictures.append(encode_srgb(color).astype(int))
    return np.abs(pictures[0] - pictures[1]).max(axis=-1).ravel()


@pytest.mark.parametrize("altitude", SUN_ALTITUDES_DEG.values(), ids=SUN_ALTITUDES_DEG.keys())
@pytest.mark.parametrize("visibility", [80, 5000])
def test_hiding_distance_is_where_sunlight_ceases_to_show(make_floor_scene, altitude, visibility):
    scene = make_floor_scene(sun={"azimuth": 130, "altitude": altitude}, weather={"visibility": visibility})
    beyond_m = shadow_hiding_distance_m(scene, scene.view("v"))
    assert sun_shadow_steps(scene, beyond_m * 1.0001).max() <= 1
    assert sun_shadow_steps(scene, 2.0 * beyond_m).max() <= 1
    assert sun_shadow_steps(scene, 0.8 * beyond_m).max() > 1


def test_hiding_distance_is_long_in_clear_air_and_0_at_night(make_floor_scene):
    assert 1.0 * CLEAR_AIR_VISIBILITY_M < hiding_distance_of_view_m(make_floor_scene()) < 3.0 * CLEAR_AIR_VISIBILITY_M
    assert hiding_distance_of_view_m(make_floor_scene(weather={"visibility": 100}, sun={"azimuth": 0, "altitude": -20})) == 0.0
    assert hiding_distance_of_view_m(make_floor_scene(weather={"visibility": 100}, sun="none")) == 0.0


def test_hiding_distance_is_proportional_to_visibility(make_floor_scene):
    """This holds in mist, where the extinction of the air itself is negligible."""
    distance_m, doubled_distance_m = (hiding_distance_of_view_m(make_floor_scene(weather={"visibility": v})) for v in (20, 40))
    assert doubled_distance_m == pytest.approx(2.0 * distance_m, rel=1e-3)


def test_horizon_colors_bound_every_direction(make_floor_scene):
    scene, color = make_floor_scene(sun={"azimuth": 130, "altitude": 3}), np.empty(3)
    bounding_colors = horizon_colors(scene)
    for azimuth in np.linspace(0.0, np.pi, 1001):
        sky_color(sky_of(scene), 0.0, np.cos(azimuth), color)
        assert (color >= bounding_colors.min(axis=0) - 2e-4).all() and (color <= bounding_colors.max(axis=0) + 2e-4).all()


def test_clear_air_visibility_grows_with_the_eye_s_height(make_floor_scene):
    """Visibility is divided by the mean of exp(-z / 8 km) up to the eye, summed numerically. A level's own visibility is not."""
    for up_m in (10.0, 3000.0, 40_000.0):
        scene, z = make_floor_scene(eye=(0.0, -190.0, up_m)), (np.arange(20_000) + 0.5) * up_m / 20_000
        mean_density = np.exp(-z / 8000.0).mean()
        assert visibility_m_of(scene, scene.view("v")) == pytest.approx(CLEAR_AIR_VISIBILITY_M / mean_density, rel=1e-4)
        hazy_scene = make_floor_scene(eye=(0.0, -190.0, up_m), weather={"visibility": 5000})
        assert visibility_m_of(hazy_scene, hazy_scene.view("v")) == 5000.0


@pytest.mark.long
@pytest.mark.parametrize("distance_ratio", [0.98, 1.02])
@pytest.mark.parametrize("altitude", [35, -20])
def test_haze_is_needed_exactly_where_it_shows(gl, make_floor_scene, altitude, distance_ratio):
    """The visibility puts the farthest visible point just before, or just beyond, the distance from which haze can show."""
    keys = {
        "sun": {"azimuth": 200, "altitude": altitude},
        "meshes": [{"generate": "boxgrid"}],
        "eye": (0.0, -60.0, 40.0),
    }
    probe = make_floor_scene(weather={"visibility": 1e7}, **keys)
    facts = describe(probe, probe.view("v"), "v").facts["haze"]
    visibility = 1e7 * facts["farthest_m"] / facts["shows_from_m"] / distance_ratio
    scene = make_floor_scene(weather={"visibility": visibility}, **keys)
    auto_color, passes = render_picture(scene, "auto")
    without_haze = render_picture(scene, "off")[0]
    if verdict(scene).is_needed:
        assert distance_ratio > 1.0 and "haze" in passes and (auto_color != without_haze).any()
    else:
        assert "haze" not in passes and (auto_color == without_haze).all()
        assert np.abs(render_picture(scene, "on")[0] - without_haze).max() <= 1


WALL_VERTICES_M = np.array(
    [[-9.0, 0.0, -2.0], [9.0, 0.0, -2.0], [9.0, 0.0, 3.0], [-9.0, 0.0, 3.0], [0.0, -500.0, 0.0], [1.0, -500.0, 0.0]]
)
WALL_TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 4]], np.int32)


def farthest_of_wall_m(wall_distance_m: float, col: float, row: float, half: float) -> float:
    """Return the farthest distance within a pyramid, for a wall north of an eye at the origin and a body behind the eye.

    The pyramid is centred on the tangents ``col`` to the east and ``row`` up.
    """
    inward = np.array([[0, 1, 0], [1, half - col, 0], [-1, half + col, 0], [0, half - row, 1], [0, half + row, -1.0]])
    return _max_clipped_distance(
        WALL_VERTICES_M + [0.0, wall_distance_m, 0.0] * (WALL_VERTICES_M[:, 1:2] == 0.0), WALL_TRIANGLES, np.zeros(3), inward
    )


@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(5.0, 300.0), st.floats(1e-4, 0.5))
def test_farthest_is_the_farthest_point_within_the_pyramid(col, row, wall_distance_m, half):
    west, east = max(col - half, -9.0 / wall_distance_m), min(col + half, 9.0 / wall_distance_m)
    low, high = max(row - half, -2.0 / wall_distance_m), min(row + half, 3.0 / wall_distance_m)
    corner = np.hypot(max(abs(west), abs(east)), max(abs(low), abs(high)))
    expected = wall_distance_m * np.sqrt(1.0 + corner**2) if west < east and low < high else 0.0
    assert farthest_of_wall_m(wall_distance_m, col, row, half) == pytest.approx(expected, rel=1e-6)


def test_farthest_bounds_every_point_of_a_picture(gl, make_floor_scene):
    """Every point of the picture at full size is compared with a bound that ignores occlusion."""
    scene = make_floor_scene(eye=(0.0, -60.0, 50.0), weather={"visibility": 1e7}, meshes=[{"generate": "boxgrid"}])
    view, descriptor = scene.view("v"), describe(scene, scene.view("v"), "v")
    frame = render_frame(scene, view, make_plan(descriptor, scene.loaded.level, {}))
    seen_m = np.nanmax(np.linalg.norm(frame.position_earth_m - view.eye_earth_m, axis=-1))
    assert seen_m <= descriptor.facts["haze"]["farthest_m"] <= 1.1 * seen_m


def test_haze_counts_trees_that_the_coarse_view_omits(gl, make_floor_scene, tmp_path):
    """A tree rises into a view that otherwise shows only sky."""
    keys = {"eye": (0.0, -60.0, 2.0), "target": (0.0, -30.0, 15.0), "weather": {"visibility": 100}}
    treeless_scene = make_floor_scene(**keys)
    tree = shapely.to_wkb(np.array([shapely.Point(0.0, -40.0)]))
    pyogrio.raw.write(tmp_path / "tree.gpkg", tree, [], [], geometry_type="Point", crs=treeless_scene.world.crs.to_wkt())
    forest = [{"source": "tree.gpkg", "height": [30, 30]}]
    assert not verdict(treeless_scene).is_needed
    assert verdict(make_floor_scene(**keys, forest=forest)).is_needed
