"""Ground materials: by slope and by land cover, fixed to the ground, filtered by pixels, and only on natural ground."""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np
import pytest
import shapely

from skugga.api.catalogue import find_level
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.ground_materials import EFFECT, angle_factor, apply_ground_materials, tree_line_m
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.geo.camera import look_at
from skugga.terrain.ground.land_cover import MEADOW, PLOUGHED, ROCK, STUBBLE
from skugga.terrain.ground.materials import COVER_ALBEDOS, meadow_color
from skugga.terrain.ground.noise import noise_at, noise_slopes_at
from skugga.terrain.ground.patterns import furrow_light, stripe_share
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.terrain.ground.test_land_cover import make_scene_of_polygons

GREEN_TINT = (0.474, 0.571, 0.347)


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Scene with a ploughed field, stubble, rock and a meadow, in strips of 200 m from west to east."""
    strips = [shapely.box(-500.0 + 200.0 * n, -400.0, -300.0 + 200.0 * n, 400.0) for n in range(4)]
    return make_scene_of_polygons(tmp_path, strips, {"class": ["ploughed", "stubble", "bare_rock", "meadow"]})


def colors_at(
    scene: Scene, points: np.ndarray, eye: np.ndarray, slope_deg: float = 0.0, kind: int = RELIEF, height_m: float = 300.0
) -> np.ndarray:
    """Return the albedo (n, 3) at points (n, 3) of the anchor's frame on a slope to the east, whose tint is ``GREEN_TINT``."""
    view = look_at(eye, points.mean(axis=0), np.array([0.0, 1.0, 0.0]), 40.0, 1, len(points))
    frame = view.frame(scene.world)
    ones = np.ones((1, len(points)), np.float32)
    angle = np.radians(slope_deg)
    normal = np.broadcast_to(np.array([np.sin(angle), 0.0, np.cos(angle)], np.float32), (1, len(points), 3))
    position = ((points - frame.origin_earth_m) @ frame.frame_from_earth.T)[None]
    buffer = GeometryBuffer(
        view, frame, ones > 0, position, height_m * ones, normal, normal, 0 * ones, np.full(ones.shape, kind, np.uint8)
    )
    albedo = np.broadcast_to(np.array(GREEN_TINT, np.float32), (1, len(points), 3)).copy()
    apply_ground_materials(albedo, ShadingBlock(scene, replace(view, focal_px=1000.0), buffer, {}))
    return albedo[0]


def test_only_natural_ground_in_perspective_has_materials(scene):
    descriptor = describe(scene, scene.view(), "map")
    assert not EFFECT.judge(descriptor).is_needed and "tints only" in EFFECT.judge(descriptor).reason
    for level, view in (("thesis_room_sun", "close"), ("thesis_boxgrid", "main")):
        floor = build_scene(load_level(find_level(level)))
        assert "no natural ground" in EFFECT.judge(describe(floor, floor.view(view), view)).reason
    wooded = build_scene(load_level(find_level("spatialace")))
    assert EFFECT.judge(describe(wooded, wooded.view("main"), "main")).is_needed
    night = wooded.with_sun(SunSpec(azimuth=180.0, altitude=-60.0))
    facts = dict(describe(night, night.view("main"), "main").facts["ground_materials"], steps=0.9)
    dark = describe(night, night.view("main"), "main")
    dark = dark.model_copy(update={"facts": {**dark.facts, "ground_materials": facts}})
    assert not EFFECT.judge(dark).is_needed and "too dark" in EFFECT.judge(dark).reason


@pytest.mark.parametrize("kind", [MESHES, FOREST])
def test_meshes_and_trees_keep_their_colour(scene, kind):
    points = np.column_stack([np.linspace(-500, 300, 90), np.zeros(90), np.zeros(90)])
    assert (colors_at(scene, points, np.array([0.0, 0.0, 60.0]), kind=kind) == np.float32(GREEN_TINT)).all()


@pytest.mark.parametrize("strip", range(4))
def test_fields_have_their_mean_colour_from_far_and_near(scene, strip):
    """Rows and furrows neither lighten nor darken a field, however many pixels it has."""
    rng = np.random.default_rng(strip)
    points = np.column_stack([rng.uniform(-470, -330, 6000) + 200.0 * strip, rng.uniform(-350, 350, 6000), np.zeros(6000)])
    near = colors_at(scene, points, np.array([-400.0 + 200.0 * strip, 0.0, 3.0]))
    far = colors_at(scene, points, np.array([-400.0 + 200.0 * strip, 0.0, 600_000.0]))
    assert far.std(axis=0).max() < 1e-3 and (strip == 3 or near.std(axis=0).max() > 0.01)
    # The thickest beds of rock are nearly as wide as the strip.
    assert near.mean(axis=0) == pytest.approx(far.mean(axis=0), rel=0.12 if strip == 2 else 0.06)
    cover = (PLOUGHED, STUBBLE, ROCK, MEADOW)[strip]
    assert far.mean(axis=0) == pytest.approx(np.array(COVER_ALBEDOS[cover]), rel=0.35)


def test_colours_stay_fixed_when_the_camera_moves(scene):
    points = np.column_stack([np.linspace(-480, 280, 500), np.linspace(5, 9, 500), np.zeros(500)])
    first, second = (colors_at(scene, points, np.array([x, 7.0, 40.0])) for x in (-12.0, 12.5))
    assert np.abs(first - second).mean() < 0.01 and first.std() > 0.05


def test_rock_begins_with_the_slope_and_not_on_gentle_ground(scene):
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-200, 200, (3000, 2)) + [0.0, 5000.0], np.zeros(3000)])  # beyond the land cover
    eye = np.array([0.0, 5000.0, 800.0])
    meadow, gentle, steep = (colors_at(scene, points, eye, slope) for slope in (0.0, 12.0, 60.0))
    assert (meadow == meadow[0]).all() and np.array_equal(meadow, gentle)
    saturation = 1.0 - steep.min(axis=1) / steep.max(axis=1)
    assert saturation.max() < 0.3 < 1.0 - meadow[0].min() / meadow[0].max()
    greens = [(np.argmax(colors_at(scene, points, eye, slope), axis=1) == 1).mean() for slope in (24.0, 32.0, 38.0, 46.0, 60.0)]
    assert greens[0] > 0.95 and greens[-1] < 0.02 and (np.diff(greens) <= 0.0).all()


def test_water_and_rock_of_the_land_cover_stay_on_steep_ground(scene):
    points = np.column_stack([np.linspace(-80, 80, 200), np.linspace(-200, 200, 200), np.zeros(200)])  # the strip of rock
    eye = np.array([0.0, 0.0, 2000.0])
    assert colors_at(scene, points, eye, 0.0).mean() == pytest.approx(colors_at(scene, points, eye, 60.0).mean(), rel=0.25)


def test_high_ground_and_coarse_rasters_have_rock_earlier(scene):
    assert angle_factor(scene) == pytest.approx(1.0 - 0.08 * np.log10(40.0))
    assert tree_line_m(scene) == 1600.0  # a flat world
    assert tree_line_m(build_scene(load_level(find_level("jacksboro_alpine")))) == 1600.0
    points = np.column_stack([np.linspace(-200, 200, 800), np.linspace(4900, 5100, 800), np.zeros(800)])
    low, high = (colors_at(scene, points, np.array([0.0, 5000.0, 800.0]), 27.0, height_m=height_m) for height_m in (300.0, 2600.0))
    assert np.ptp(high.mean(axis=0)) < 0.7 * np.ptp(low.mean(axis=0))


@numba.njit
def _stripe_share(position_m, period_m, width_m, pixel_m):
    return stripe_share(position_m, period_m, width_m, pixel_m)


@numba.njit
def _furrow_light(position_m, period_m, pixel_m, sun_across):
    return furrow_light(position_m, period_m, pixel_m, sun_across)


@numba.njit
def _noise_slopes_at(x, y, seed):
    return noise_slopes_at(x, y, seed)


@numba.njit
def _meadow_color(red, green, blue):
    return meadow_color(red, green, blue)


@pytest.mark.parametrize("pixel_m", [0.3, 5.0, 24.0, 500.0])
def test_stripes_keep_their_area_in_pixels_of_any_width(pixel_m):
    centres = (np.arange(-480, 480) + 0.5) * pixel_m
    shares = [_stripe_share(centre, 24.0, 0.55, pixel_m) for centre in centres]
    assert np.mean(shares) == pytest.approx(0.55 / 24.0, rel=0.02) and -1e-9 <= min(shares) <= max(shares) <= 1.0 + 1e-9
    if pixel_m >= 500.0:
        assert np.ptp(shares) < 0.002


def test_furrows_are_lighter_on_the_side_of_the_sun_and_vanish_in_wide_pixels():
    positions = np.linspace(0.0, 0.9, 181)[:-1]
    east, west = (np.array([_furrow_light(x, 0.9, 0.01, sun) for x in positions]) for sun in (1.0, -1.0))
    assert np.mean(east) == pytest.approx(0.0, abs=1e-9) and np.argmax(east) < 90 < np.argmax(west)
    assert _furrow_light(0.1, 0.9, 0.46, 1.0) == 0.0


def test_noise_slopes_are_the_derivatives_of_the_noise():
    for x, y in np.random.default_rng(4).uniform(-900, 900, (200, 2)):
        value, slope_x, slope_y = _noise_slopes_at(x, y, 9)
        assert value == noise_at(x, y, 9)
        assert slope_x == pytest.approx((noise_at(x + 1e-5, y, 9) - noise_at(x - 1e-5, y, 9)) / 2e-5, abs=1e-6)
        assert slope_y == pytest.approx((noise_at(x, y + 1e-5, 9) - noise_at(x, y - 1e-5, 9)) / 2e-5, abs=1e-6)


def test_meadows_are_darker_and_more_saturated_than_tints_and_snow_stays_white():
    red, green, blue = _meadow_color(*GREEN_TINT)
    assert green > red > blue and blue / green < 0.75 * GREEN_TINT[2] / GREEN_TINT[1] and green < 0.8 * GREEN_TINT[1]
    assert _meadow_color(0.92, 0.92, 0.92) == pytest.approx((0.92, 0.92, 0.92))
