"""Haze: Koschmieder's law, where it can show, what it hides, and the pictures at the edge of either."""

from __future__ import annotations

import json

import numpy as np
import pyogrio
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.haze import (
    BIN,
    CLEAR_AIR_M,
    EFFECT,
    RAYLEIGH_PER_M,
    _farthest,
    _max_hiding_transmittance,
    _max_invisible_share,
    apply_haze,
    extinction,
    extinctions,
    hiding_distance_m,
    visibility_of,
)  # fmt: skip
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import shade, srgb_encoded
from skugga.terrain.sky import horizon_colors, sky_color, sky_of

EAST = np.array([1.0, 0.0, 0.0])
UP = np.array([0.0, 0.0, 1.0])
EYE_M = np.array([3.0, 4.0, 50.0])


@pytest.fixture
def floor(tmp_path):
    """``floor(views, **keys)`` is the scene of a flat floor 400 m wide."""

    def make(eye=(0.0, -190.0, 10.0), target=(0.0, 0.0, 0.0), side=400, **keys) -> Scene:
        sun = keys.pop("sun", {"azimuth": 200, "altitude": 35})
        views = {"v": {"kind": "perspective", "eye": list(eye), "target": list(target), "fov": 40, "size": [160, 100]}}
        level = {"version": 1, "terrain": {"flat": {"size": [side, side], "cells": [8, 8]}}, "sun": sun, "views": views, **keys}
        level["shadows"] = {"algorithm": "none"}
        path = tmp_path / "level.yaml"
        path.write_text(json.dumps(level), encoding="utf-8")
        return build_scene(load_level(path))

    return make


def hidden_beyond_m(scene: Scene) -> float:
    return hiding_distance_m(scene, scene.view("v"))


def points(scene: Scene, distance_m: np.ndarray, facing: np.ndarray, albedo: np.ndarray) -> tuple[PerspectiveView, GeometryBuffer]:
    """A buffer (1, n) of points at distances (n,) east of the eye with normals (n, 3) and albedos (n, 3)."""
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


def hazed(scene: Scene, color: np.ndarray, distance_m: np.ndarray) -> np.ndarray:
    """Linear colours (n, 3) as they arrive from distances (n,)."""
    view, buffer = points(scene, distance_m, np.tile(UP, (len(distance_m), 1)), color)
    out = color[None].astype(np.float32)
    apply_haze(out, ShadingBlock(scene, view, buffer, {}))
    return out[0]


def horizon_in_east(scene: Scene) -> np.ndarray:
    """The horizon's colour (3,) where ``points`` lie."""
    out = np.empty(3)
    sky_color(sky_of(scene), 0.0, np.sin(np.radians(scene.sun.azimuth_deg)), out)
    return out


def picture(scene: Scene, haze: str, name: str = "v", **asked) -> tuple[np.ndarray, tuple[str, ...]]:
    """The picture of a view with haze ``on``, ``off`` or as the plan says; and the passes that ran."""
    level = scene.loaded.level.model_copy(update={"effects": "auto" if haze == "auto" else {"haze": haze}})
    view = scene.view(name, **asked)
    frame = render_frame(scene, view, make_plan(describe(scene, view, name), level, {}))
    return frame.color.astype(int), tuple(record.name for record in frame.passes)


def verdict(scene: Scene, name: str = "v"):
    return EFFECT.called_for(describe(scene, scene.view(name), name))


def test_contrast_at_the_visibility_is_two_percent(floor):
    scene = floor(weather={"visibility": 500})
    black = hazed(scene, np.zeros((3, 3)), np.array([0.0, 250.0, 500.0]))
    contrast = 1.0 - black / horizon_in_east(scene)
    assert contrast[:, 1] == pytest.approx(np.array([1.0, 0.02**0.5, 0.02]), rel=1e-5)
    assert extinction(500.0) == pytest.approx(3.912 / 500.0, rel=1e-4)


def test_air_alone_takes_blue_first_and_mist_is_grey():
    """As far as air alone lets one see, extinction is Rayleigh's; dust and drops on top of it take as much of every colour."""
    air = np.array(RAYLEIGH_PER_M)
    alone = extinctions(3.912023 / air[1])
    assert alone == pytest.approx(air, rel=1e-6)
    assert extinctions(2.0 * 3.912023 / air[1]) == pytest.approx(air / 2.0, rel=1e-6)
    hazy = extinctions(10_000.0)
    assert hazy[1] == pytest.approx(extinction(10_000.0))
    assert hazy - hazy[1] == pytest.approx(air - air[1], rel=1e-6)


def test_far_ground_goes_over_into_the_skys_foot(floor):
    scene = floor(weather={"visibility": 100})
    far = hazed(scene, np.array([[0.9, 0.1, 0.0]]), np.array([5000.0]))
    assert far[0] == pytest.approx(horizon_in_east(scene), abs=1e-6)


def test_sky_and_what_is_not_there_stay_as_they_are(floor):
    scene = floor(weather={"visibility": 100})
    view, buffer = points(scene, np.array([50.0, 50.0]), np.tile(UP, (2, 1)), np.ones((2, 3)))
    buffer.valid[0, 1] = False
    color = np.full((1, 2, 3), 0.125, np.float32)
    apply_haze(color, ShadingBlock(scene, view, buffer, {}))
    assert (color[0, 1] == 0.125).all() and (color[0, 0] != 0.125).all()


def test_maps_what_is_near_and_the_sky_alone_have_no_haze(floor):
    hazy = floor(weather={"visibility": 100})
    assert "no viewing distance" in verdict(hazy, "map").reason and not verdict(hazy, "map").called_for
    near = floor(eye=(0.0, 0.0, 3.0), target=(0.0, 0.5, 0.0))
    assert "100.0 km of visibility haze shows from" in verdict(near).reason and not verdict(near).called_for
    heaven = floor(target=(0.0, 0.0, 400.0), weather={"visibility": 100})
    assert "farther than 0.0 m" in verdict(heaven).reason and not verdict(heaven).called_for


def test_forced_on_without_distance_changes_nothing(floor):
    scene = floor(weather={"visibility": 100})
    on, off = (picture(scene, haze, "map", size=(96, 96))[0] for haze in ("on", "off"))
    assert (on == off).all()


def test_where_a_level_sets_none_the_air_is_clear(floor):
    color = np.full((1, 3), 0.1)
    unset = hazed(floor(), color, np.array([9000.0]))
    up = EYE_M[2] / 8000.0
    said = hazed(floor(weather={"visibility": CLEAR_AIR_M * up / -np.expm1(-up)}), color, np.array([9000.0]))
    np.testing.assert_allclose(unset, said, rtol=1e-6)
    assert (unset > color).all() and unset[0, 2] > unset[0, 1] > unset[0, 0]


def test_the_encoders_bins():
    first = np.arange(round(1.0 / BIN)) * BIN
    assert (srgb_encoded(first) == srgb_encoded(first + 0.999 * BIN)).all()
    assert (np.diff(srgb_encoded(first[:4]).astype(int)) == 1).all()  # at black each bin has a code of its own


@given(st.floats(0.0, 1.0), st.floats(0.012, 0.92))
def test_what_shows_nowhere_moves_no_colour_by_two(color, horizon):
    share = _max_invisible_share((horizon,), (horizon,))
    near = np.linspace(max(color - 2 * BIN, 0.0), min(color + 2 * BIN, 1.0), 400)
    moved = near + share * (horizon - near)
    assert np.abs(srgb_encoded(moved).astype(int) - srgb_encoded(near)).max() <= 1


@pytest.mark.parametrize("horizon", [0.0144, 0.1, 0.5, 0.92])
def test_a_tenth_more_than_what_shows_nowhere_shows(horizon):
    share = 1.1 * _max_invisible_share((horizon,), (horizon,))
    color = np.linspace(0.0, 1.0, 200_000)
    moved = color + share * (horizon - color)
    assert np.abs(srgb_encoded(moved).astype(int) - srgb_encoded(color)).max() == 2


@given(st.floats(0.0, 1.0), st.floats(0.012, 0.92), st.floats(0.05, 1.0), st.sampled_from([1.0, 0.8, 0.5, 0.2]))
def test_what_is_hidden_is_alike_in_sun_and_shadow(dark, horizon, white, part):
    share = _max_hiding_transmittance((horizon,) * 3, (white,) * 3)
    dark = (1.0 - white) * dark + np.linspace(0.0, 8 * BIN, 400)
    shadow = part * ((1.0 - share) * horizon + share * dark)
    sun = shadow + part * share * white
    assert np.abs(srgb_encoded(np.minimum(sun, 1.0)).astype(int) - srgb_encoded(np.minimum(shadow, 1.0))).max() <= 1


SUNS = {"day": 50.0, "low": 14.0, "evening": 2.0, "sunset": 0.5}


def difference_of_sunlight(scene: Scene, distance_m: float) -> np.ndarray:
    """Steps (n,) between sun and shadow on points of all colours and directions at a distance."""
    rng = np.random.default_rng(0)
    count = 20_000
    facing = rng.normal(size=(count, 3))
    facing[: count // 2] = scene.sun.to_sun_earth
    facing /= np.linalg.norm(facing, axis=1)[:, None]
    albedo = rng.random((count, 3)) ** 0.2
    view, buffer = points(scene, np.full(count, distance_m), facing, albedo)
    pictures = []
    for share in (0.0, 1.0):
        color = shade(buffer, scene, np.full(buffer.valid.shape, share, np.float32))
        apply_haze(color, ShadingBlock(scene, view, buffer, {}))
        pictures.append(srgb_encoded(color).astype(int))
    return np.abs(pictures[0] - pictures[1]).max(axis=-1).ravel()


@pytest.mark.parametrize("altitude", SUNS.values(), ids=SUNS.keys())
@pytest.mark.parametrize("visibility", [80, 5000])
def test_beyond_its_distance_haze_hides_what_the_sun_does_and_before_it_does_not(floor, altitude, visibility):
    scene = floor(sun={"azimuth": 130, "altitude": altitude}, weather={"visibility": visibility})
    beyond_m = hiding_distance_m(scene, scene.view("v"))
    assert difference_of_sunlight(scene, beyond_m * 1.0001).max() <= 1
    assert difference_of_sunlight(scene, 2.0 * beyond_m).max() <= 1
    assert difference_of_sunlight(scene, 0.8 * beyond_m).max() > 1


def test_clear_air_hides_little_and_at_night_all_is_hidden(floor):
    assert 1.0 * CLEAR_AIR_M < hidden_beyond_m(floor()) < 3.0 * CLEAR_AIR_M
    assert hidden_beyond_m(floor(weather={"visibility": 100}, sun={"azimuth": 0, "altitude": -20})) == 0.0
    assert hidden_beyond_m(floor(weather={"visibility": 100}, sun="none")) == 0.0


def test_visibility_scales_what_is_hidden(floor):
    """In proportion in mist, of which air is no part to speak of."""
    one, two = (hidden_beyond_m(floor(weather={"visibility": v})) for v in (20, 40))
    assert two == pytest.approx(2.0 * one, rel=1e-3)


def test_the_horizon_that_the_predicate_goes_by_holds_every_direction(floor):
    scene, out = floor(sun={"azimuth": 130, "altitude": 3}), np.empty(3)
    some = horizon_colors(scene)
    for azimuth in np.linspace(0.0, np.pi, 1001):
        sky_color(sky_of(scene), 0.0, np.cos(azimuth), out)
        assert (out >= some.min(axis=0) - 2e-4).all() and (out <= some.max(axis=0) + 2e-4).all()


def test_clear_air_thins_with_the_height_of_the_eye(floor):
    """By the mean of exp(-z / 8 km) up to the eye, summed by hand; a level's own visibility does not."""
    for up_m in (10.0, 3000.0, 40_000.0):
        scene, z = floor(eye=(0.0, -190.0, up_m)), (np.arange(20_000) + 0.5) * up_m / 20_000
        thin = np.exp(-z / 8000.0).mean()
        assert visibility_of(scene, scene.view("v")) == pytest.approx(CLEAR_AIR_M / thin, rel=1e-4)
        hazy = floor(eye=(0.0, -190.0, up_m), weather={"visibility": 5000})
        assert visibility_of(hazy, hazy.view("v")) == 5000.0


@pytest.mark.long
@pytest.mark.parametrize("away", [0.98, 1.02])
@pytest.mark.parametrize("altitude", [35, -20])
def test_at_the_edge_of_being_called_for(gl, floor, altitude, away):
    """The visibility at which the farthest thing seen lies just before, or just beyond, where haze can show."""
    keys = {
        "sun": {"azimuth": 200, "altitude": altitude},
        "meshes": [{"generate": "boxgrid"}],
        "eye": (0.0, -60.0, 40.0),
    }
    probe = floor(weather={"visibility": 1e7}, **keys)
    facts = describe(probe, probe.view("v"), "v").facts["haze"]
    visibility = 1e7 * facts["farthest_m"] / facts["shows_from_m"] / away
    scene = floor(weather={"visibility": visibility}, **keys)
    chosen, passes = picture(scene, "auto")
    without = picture(scene, "off")[0]
    if verdict(scene).called_for:
        assert away > 1.0 and "haze" in passes and (chosen != without).any()
    else:
        assert "haze" not in passes and (chosen == without).all()
        assert np.abs(picture(scene, "on")[0] - without).max() <= 1


WALL_M = np.array([[-9.0, 0.0, -2.0], [9.0, 0.0, -2.0], [9.0, 0.0, 3.0], [-9.0, 0.0, 3.0], [0.0, -500.0, 0.0], [1.0, -500.0, 0.0]])
WALL = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 4]], np.int32)


def farthest_of_wall_m(away: float, col: float, row: float, half: float) -> float:
    """Of a wall north of an eye at the origin and a thing behind it, what a pyramid round tangents to the east and up holds."""
    inward = np.array([[0, 1, 0], [1, half - col, 0], [-1, half + col, 0], [0, half - row, 1], [0, half + row, -1.0]])
    return _farthest(WALL_M + [0.0, away, 0.0] * (WALL_M[:, 1:2] == 0.0), WALL, np.zeros(3), inward)


@given(st.floats(-0.9, 0.9), st.floats(-0.9, 0.9), st.floats(5.0, 300.0), st.floats(1e-4, 0.5))
def test_the_bound_is_the_farthest_point_within_the_pyramid(col, row, away, half):
    west, east = max(col - half, -9.0 / away), min(col + half, 9.0 / away)
    low, high = max(row - half, -2.0 / away), min(row + half, 3.0 / away)
    corner = np.hypot(max(abs(west), abs(east)), max(abs(low), abs(high)))
    expected = away * np.sqrt(1.0 + corner**2) if west < east and low < high else 0.0
    assert farthest_of_wall_m(away, col, row, half) == pytest.approx(expected, rel=1e-6)


def test_the_bound_holds_what_a_picture_shows(gl, floor):
    """Every point of the picture at full size, against a bound that knows nothing of what hides what."""
    scene = floor(eye=(0.0, -60.0, 50.0), weather={"visibility": 1e7}, meshes=[{"generate": "boxgrid"}])
    view, descriptor = scene.view("v"), describe(scene, scene.view("v"), "v")
    frame = render_frame(scene, view, make_plan(descriptor, scene.loaded.level, {}))
    seen_m = np.nanmax(np.linalg.norm(frame.position_earth_m - view.eye_earth_m, axis=-1))
    assert seen_m <= descriptor.facts["haze"]["farthest_m"] <= 1.1 * seen_m


def test_trees_count_although_the_look_leaves_them_out(gl, floor, tmp_path):
    """A tree that rises into a view of nothing but sky."""
    keys = {"eye": (0.0, -60.0, 2.0), "target": (0.0, -30.0, 15.0), "weather": {"visibility": 100}}
    bare = floor(**keys)
    tree = shapely.to_wkb(np.array([shapely.Point(0.0, -40.0)]))
    pyogrio.raw.write(tmp_path / "tree.gpkg", tree, [], [], geometry_type="Point", crs=bare.world.crs.to_wkt())
    forest = [{"source": "tree.gpkg", "height": [30, 30]}]
    assert not verdict(bare).called_for
    assert verdict(floor(**keys, forest=forest)).called_for
