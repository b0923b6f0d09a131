"""Cloud shadows: how much ground they shade, where they lie, and when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects import cloud_layer, clouds
from skugga.terrain.effects.cloud_layer import (
    CLOUD_EDGE_WIDTH,
    CLOUD_HEIGHT_M,
    MAX_NOISE,
    MAX_NOISE_SLOPE,
    MAX_OCTAVE_SUM,
    cloud_layer_of,
    density_at,
    noise_threshold_of,
)
from skugga.terrain.effects.clouds import apply_clouds
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.sky_clouds import cloud_opacity, sky_colors_with_clouds
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.ground.noise import noise_at
from skugga.terrain.scene import Scene
from skugga.terrain.sky import sky_pixel_colors
from tests.rasters import ENGINEERING

UTM = "EPSG:32616"


@pytest.fixture
def make_cloudy_scene(make_scene: Callable[..., Scene], write_raster) -> Callable[..., Scene]:
    """Return a factory of scenes: a plain with a low rise under clouds, ``size`` nodes of 50 m along each side."""

    def make(cover: float, size: int = 120, **keys) -> Scene:
        x = np.arange(size) - size / 2
        heights = 300.0 + 60.0 * np.exp(-(x[:, None] ** 2 + x**2) / size)
        return make_scene(
            write_raster(heights.astype(np.float32), UTM, 700_000.0, 4_000_000.0, 50.0), weather={"cloud_cover": cover}, **keys
        )

    return make


def sample_densities(cover: float, step_m: float = 130.7, side: int = 400) -> np.ndarray:
    """Return densities of clouds at points of a lattice with steps of ``step_m`` metres and ``side`` points a side."""
    threshold = noise_threshold_of(cover)
    return np.array([density_at(x * step_m, y * step_m, threshold) for x in range(side) for y in range(side)])


def cloud_transmittance(scene: Scene, view=None) -> np.ndarray:
    """Return the share of the sunlight that the clouds alone transmit."""
    view = view or scene.view()
    buffer = geometry_buffer(scene, view)
    light = np.ones(buffer.valid.shape, np.float32)
    apply_clouds(light, ShadingBlock(scene, view, buffer, {}))
    return light


def plan_of(scene: Scene, view, effect_switch: str = "auto") -> Plan:
    """Return a plan with the effect of clouds "on", "off" or "auto"."""
    level = scene.loaded.level.model_copy(update={"effects": {"clouds": effect_switch}})
    return make_plan(describe(scene, view), level, {})


@pytest.mark.parametrize("cover", [0.02, 0.1, 0.35, 0.5, 0.8, 0.97])
def test_shaded_share_of_the_ground_is_the_cloud_cover(cover: float) -> None:
    density = sample_densities(cover)
    assert np.mean(density > 0.5) == pytest.approx(cover, abs=0.03)
    assert density.mean() == pytest.approx(cover, abs=0.03)


def test_cover_0_has_no_cloud_and_cover_1_has_no_gap() -> None:
    assert noise_threshold_of(0.0) - CLOUD_EDGE_WIDTH / 2 >= MAX_OCTAVE_SUM
    assert noise_threshold_of(1.0) + CLOUD_EDGE_WIDTH / 2 <= -MAX_OCTAVE_SUM
    cover_values = np.linspace(0.0, 1.0, 401)
    thresholds = [noise_threshold_of(cover) for cover in cover_values]
    assert all(a > b for a, b in pairwise(thresholds))


@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(0.0, 0.999))
def test_density_grows_continuously_with_the_cover(x: float, y: float, cover: float) -> None:
    density, denser = (density_at(x, y, noise_threshold_of(c)) for c in (cover, cover + 1e-6))
    assert 0.0 <= density <= denser <= density + 0.05


@given(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.floats(0.0, 2 * np.pi), st.integers(0, 99))
@settings(max_examples=300)
def test_noise_and_its_slope_stay_within_their_bounds(x: float, y: float, azimuth_rad: float, seed: int) -> None:
    step = 1e-5
    noise, noise_ahead = noise_at(x, y, seed), noise_at(x + step * np.cos(azimuth_rad), y + step * np.sin(azimuth_rad), seed)
    assert abs(noise) <= MAX_NOISE
    assert abs(noise_ahead - noise) <= MAX_NOISE_SLOPE * step * (1.0 + 1e-3)


@given(st.floats(-2e4, 2e4), st.floats(-2e4, 2e4), st.floats(100.0, 3000.0), st.floats(1e-3, 0.2))
@settings(max_examples=20)
def test_max_density_bounds_every_place_in_a_box(west: float, south: float, side: float, cover: float) -> None:
    threshold = noise_threshold_of(cover)
    sampled_max = max(
        density_at(x, y, threshold) for x in np.linspace(west, west + side, 60) for y in np.linspace(south, south + side, 60)
    )
    bound = clouds._max_density(west, west + side, south, south + side, threshold)
    assert sampled_max <= bound
    sample_step_m = side / 59.0
    slope = cloud_layer.CLOUD_OCTAVES * MAX_NOISE_SLOPE / cloud_layer.COARSEST_CLOUD_WAVELENGTH_M * 1.5 / CLOUD_EDGE_WIDTH
    assert bound <= sampled_max + slope * (sample_step_m + 1.0)


def test_skipped_noise_octaves_do_not_change_the_density() -> None:
    threshold = noise_threshold_of(0.3)
    for x in range(0, 40_000, 997):
        full_noise = cloud_layer.cloud_noise(float(x), 0.7 * x, -np.inf, np.inf)
        assert density_at(float(x), 0.7 * x, threshold) == cloud_layer.density_of_noise(full_noise, threshold)


def test_cloud_shadow_follows_the_ray_to_the_sun(make_scene, write_raster) -> None:
    heights = np.full((40, 40), 300.0, np.float32)
    scene = make_scene(write_raster(heights, UTM, 500_000.0, 1000.0, 50.0), 90.0, 45.0, weather={"cloud_cover": 0.4})
    layer, view = cloud_layer_of(scene), scene.view()
    assert layer.height_m == pytest.approx(300.0 + CLOUD_HEIGHT_M)
    light, buffer = cloud_transmittance(scene, view), geometry_buffer(scene, view)
    points = buffer.position_frame_m @ buffer.frame.frame_from_earth + buffer.frame.origin_earth_m - scene.world.anchor_earth_m
    east, north, _ = np.moveaxis(points @ scene.world.earth_from_anchor, -1, 0)
    # The sun stands in the east at 45 degrees: the cloud that shades a point is as far east of it as it is high.
    for i, j in ((3, 5), (500, 500), (1000, 900)):
        expected = 1.0 - layer.max_opacity * density_at(east[i, j] + CLOUD_HEIGHT_M, north[i, j], layer.noise_threshold)
        assert light[i, j] == pytest.approx(expected, abs=2e-3)


def test_clouds_over_the_same_ground_agree_in_every_view(make_cloudy_scene) -> None:
    scene = make_cloudy_scene(0.4)
    full_view = scene.view()
    part = full_view.part(200, 300, 150, 170)
    assert np.array_equal(cloud_transmittance(scene, full_view)[200:350, 300:470], cloud_transmittance(scene, part))


def test_clouds_drift_with_the_clock(make_cloudy_scene) -> None:
    scene = make_cloudy_scene(0.4)
    layer, later_layer = cloud_layer_of(scene), cloud_layer_of(scene.at_second(60.0))
    east, north = later_layer.drift_m - layer.drift_m
    assert np.hypot(east, north) == pytest.approx(600.0)
    assert np.degrees(np.arctan2(east, north)) == pytest.approx(67.5)
    assert not np.array_equal(cloud_transmittance(scene), cloud_transmittance(scene.at_second(60.0)))


def test_pixels_wider_than_the_clouds_show_their_mean(make_cloudy_scene) -> None:
    scene = make_cloudy_scene(0.4, size=600)
    view = scene.view(size=(12, 12))
    light = cloud_transmittance(scene, view)[geometry_buffer(scene, view).valid]
    assert light.size > 50
    assert light == pytest.approx(1.0 - 0.4 * cloud_layer_of(scene).max_opacity, abs=1e-6)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"weather": {"cloud_cover": 0.0}}, "the level sets no clouds"),
        ({"weather": {"cloud_cover": 1.0}}, "overcast"),
        ({"weather": {"cloud_cover": 0.4}, "sun": "none"}, "no sun"),
        ({"weather": {"cloud_cover": 0.4}, "sun": {"azimuth": 90.0, "altitude": -3.0}}, "night"),
        ({"weather": {"cloud_cover": 1e-5}}, "block at most 0.0%"),
    ],
)
def test_clouds_are_left_out_with_a_reason(make_scene, write_raster, keys: dict, reason: str) -> None:
    heights = np.zeros((40, 40), np.float32)
    scene = make_scene(write_raster(heights, UTM, 700_000.0, 4_000_000.0, 50.0), **keys)
    view = scene.view(size=(60, 60))
    verdict = clouds.judge(describe(scene, view))
    assert not verdict.is_needed and reason in verdict.reason
    with_clouds, without_clouds = (
        render_frame(scene, view, plan_of(scene, view, effect_switch)).color for effect_switch in ("on", "off")
    )
    assert np.array_equal(with_clouds, without_clouds)


def test_clouds_are_needed_only_where_they_show(make_cloudy_scene) -> None:
    # At this cover a cloud lies over this ground at some times, and none at others.
    scene = make_cloudy_scene(0.02, size=40)
    run_count, invisible_count = 0, 0
    for second in range(0, 8000, 400):
        later_scene = scene.at_second(float(second))
        view = later_scene.view(size=(120, 120))
        with_clouds, without_clouds = (
            render_frame(later_scene, view, plan_of(later_scene, view, effect_switch)).color.astype(int)
            for effect_switch in ("on", "off")
        )
        difference = np.abs(with_clouds - without_clouds).max()
        if "clouds" in plan_of(later_scene, view).effect_names:
            run_count, invisible_count = run_count + 1, invisible_count + (difference == 0)
        else:
            assert difference <= 1
    assert 5 <= run_count <= 15
    assert invisible_count <= 0.1 * run_count + 1


@pytest.mark.parametrize("altitude", [0.0001, 0.003, 0.1, 0.5, 1.0])
def test_clouds_left_out_under_a_low_sun_do_not_show(make_scene, write_raster, altitude: float) -> None:
    heights = np.zeros((40, 40), np.float32)
    scene = make_scene(write_raster(heights, ENGINEERING, 0.0, 2000.0, 50.0), 90.0, altitude, weather={"cloud_cover": 0.6})
    view = scene.view(size=(160, 160))
    with_clouds, without_clouds = (
        render_frame(scene, view, plan_of(scene, view, effect_switch)).color.astype(int) for effect_switch in ("on", "off")
    )
    if "clouds" not in plan_of(scene, view).effect_names:
        assert np.abs(with_clouds - without_clouds).max() <= 1


def test_clouds_change_color_but_not_visibility(make_cloudy_scene) -> None:
    scene = make_cloudy_scene(0.5)
    view = scene.view(size=(160, 160))
    with_clouds, without_clouds = (
        render_frame(scene, view, plan_of(scene, view, effect_switch)) for effect_switch in ("on", "off")
    )
    assert np.array_equal(with_clouds.visibility, without_clouds.visibility)
    assert not np.array_equal(with_clouds.color, without_clouds.color)


def test_clouds_in_perspective_count_visible_ground_only(make_cloudy_scene) -> None:
    anchor = {"kind": "perspective", "fov": 40, "size": [96, 64]}
    scene = make_cloudy_scene(0.4, views={"down": {**anchor, "eye": [-84.77, 36.09, 400], "target": [-84.7701, 36.0901, 0]}})
    level = scene.loaded.level
    lon, lat = scene.world.anchor_lon_deg, scene.world.anchor_lat_deg
    spec = level.views["down"].model_copy(update={"eye": (lon, lat, 400.0), "target": (lon, lat + 1e-5, 0.0)})
    verdicts = []
    for second in range(0, 3000, 300):
        later_scene = scene.at_second(float(second))
        view = later_scene.view_from(spec)
        light = cloud_transmittance(later_scene, view)
        clouds_are_needed = clouds.judge(describe(later_scene, view, "down")).is_needed
        assert clouds_are_needed or np.nanmin(light) > 1.0 - clouds.MAX_INVISIBLE_LIGHT_SHARE
        verdicts.append(clouds_are_needed)
    assert any(verdicts) and not all(verdicts)


def eye_view(scene: Scene, direction_anchor: np.ndarray, up_m: float, pixels: int = 1) -> PerspectiveView:
    """Return a view from ``up_m`` metres above the anchor, in a direction in the anchor's axes, with pixels of 0.01 degrees."""
    earth_from_anchor, up = scene.world.earth_from_anchor, np.array([0.0, 0.0, 1.0])
    eye = scene.world.anchor_earth_m + earth_from_anchor @ (up_m * up)
    return look_at(eye, eye + 1000.0 * earth_from_anchor @ direction_anchor, earth_from_anchor @ up, 0.01 * pixels, pixels, pixels)


def sky_color_of(scene: Scene, view: PerspectiveView, **keys: float) -> np.ndarray:
    """Return the colour (3,) of the first pixel's sky with clouds, or without them if ``keys`` has a ``cloud_cover``."""
    pixel = np.zeros(1, np.int64)
    return (sky_pixel_colors(scene, view, pixel, pixel, **keys) if keys else sky_colors_with_clouds(scene, view, pixel, pixel))[0]


@pytest.mark.parametrize("crs", [UTM, ENGINEERING])
@pytest.mark.parametrize("altitude", [8.0, 40.0])
def test_cloud_before_the_sun_shades_the_eye(make_scene, write_raster, crs: str, altitude: float) -> None:
    """The sun is hidden in the sky exactly when the clouds take sunlight from the eye."""
    raster = write_raster(np.full((40, 40), 300.0, np.float32), crs, 500_000.0, 1000.0, 50.0)
    still = make_scene(raster, 230.0, altitude, weather={"cloud_cover": 0.4, "visibility": 1e7})
    hidden, shaded = [], []
    for second in range(0, 3000, 40):
        scene = still.at_second(float(second))
        layer = cloud_layer_of(scene)
        view = eye_view(scene, layer.to_sun_anchor, 320.0)
        points, heights = np.array([[0.0, 0.0, 320.0]]), np.array([320.0])
        (position,) = clouds._layer_positions(points, heights, layer)
        density = density_at(*position, layer.noise_threshold)
        if 0.0 < density < 0.1:
            continue
        shaded.append(density > 0.0)
        hidden.append(np.abs(sky_color_of(scene, view) - sky_color_of(scene, view, cloud_cover=0.0)).max() > 0.004)
    assert hidden == shaded
    assert 5 < sum(shaded) < len(shaded) - 5


def test_share_of_the_sky_behind_clouds_is_the_cover(make_scene, write_raster) -> None:
    scene = make_scene(write_raster(np.zeros((40, 40), np.float32), UTM, 500_000.0, 1000.0, 50.0), 180.0, 50.0,
                       weather={"cloud_cover": 0.4, "visibility": 1e7})  # fmt: skip
    zenith = np.array([0.02, 0.0, 1.0]) / np.hypot(0.02, 1.0)
    behind = []
    for second in range(0, 40_000, 100):
        at = scene.at_second(float(second))
        view = eye_view(at, zenith, 2.0)
        behind.append(np.abs(sky_color_of(at, view) - sky_color_of(at, view, cloud_cover=0.0)).max() > 0.15)
    assert np.mean(behind) == pytest.approx(0.4, abs=0.12)


def test_clouds_fade_into_the_even_sky_at_the_horizon(make_scene, write_raster) -> None:
    scene = make_scene(write_raster(np.zeros((40, 40), np.float32), UTM, 500_000.0, 1000.0, 50.0), 180.0, 50.0,
                       weather={"cloud_cover": 0.4})  # fmt: skip
    for azimuth in np.radians(np.arange(0.0, 360.0, 30.0)):
        low = np.array([np.sin(azimuth), np.cos(azimuth), 0.003])
        view = eye_view(scene, low, 2.0)
        np.testing.assert_allclose(sky_color_of(scene, view), sky_color_of(scene, view, cloud_cover=0.4), atol=0.03)


def test_eye_above_the_clouds_sees_the_even_sky(make_scene, write_raster) -> None:
    scene = make_scene(write_raster(np.zeros((40, 40), np.float32), UTM, 500_000.0, 1000.0, 50.0), 180.0, 50.0,
                       weather={"cloud_cover": 0.4})  # fmt: skip
    view = eye_view(scene, np.array([0.6, 0.0, 0.8]), CLOUD_HEIGHT_M + 1.0)
    np.testing.assert_array_equal(sky_color_of(scene, view), sky_color_of(scene, view, cloud_cover=0.4))


def test_frayed_edges_leave_gaps_and_middles_alone() -> None:
    for x in range(0, 5000, 37):
        assert cloud_opacity(float(x), 3.0 * x, 0.0, 1.0) == 0.0 and cloud_opacity(float(x), 3.0 * x, 1.0, 1.0) == 1.0
        assert 0.0 <= cloud_opacity(float(x), 3.0 * x, 0.5, 1.0) <= 1.0
        assert cloud_opacity(float(x), 3.0 * x, 0.5, 200.0) == 0.5
