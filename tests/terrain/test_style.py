"""Styles: colours and light in closed form, and unchanged shadows."""

from __future__ import annotations

import json

import numpy as np
import pytest

from skugga.shadows.render import render_frame
from skugga.terrain.errors import InputError, LevelError
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.scene import Scene
from skugga.terrain.shading import LEVEL_GROUND_EXPOSURE, SKY_IRRADIANCE_SHARE, shade
from skugga.terrain.shading_loops import (
    MIN_SLOPE_SKY_FACTOR,
    TONE_CURVE_START,
    _exaggerated_cosines,
    _slope_direct_light,
    _slope_sky_factor,
    luminance_of,
    tone_curve,
)
from skugga.terrain.srgb import linear_of_srgb
from skugga.terrain.style import STYLES, TINT_HEIGHT_STEP_M, TINT_MIN_HEIGHT_M, tint_table
from tests.render import plan_of

UTM = "EPSG:32633"
X0, Y0 = 450_000.0, 6_000_000.0


def lightness(linear: np.ndarray) -> np.ndarray:
    """Return CIE L* of linear sRGB (n, 3); white is 100."""
    y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(y > (6 / 29) ** 3, 116.0 * np.cbrt(y) - 16.0, y * (29 / 3) ** 3)


def plane(write_raster, make_scene, east_rise: float, azimuth: float, altitude: float, base_m: float = 300.0, **keys) -> Scene:
    """Return ground that rises by ``east_rise`` per metre to the east, 60 x 60 cells of 10 m."""
    heights = np.broadcast_to(base_m + east_rise * 10.0 * (np.arange(60) - 30), (60, 60)).astype(np.float32)
    return make_scene(write_raster(heights, UTM, X0, Y0, 10.0), azimuth, altitude, **keys)


def centre_color(scene: Scene, sunlight: float) -> np.ndarray:
    """Return the linear colour (3,) at the centre of a map with a share of sunlight."""
    buffer = geometry_buffer(scene, scene.view(size=(60, 60)))
    return shade(buffer, scene, np.full(buffer.valid.shape, sunlight, np.float32))[30, 30].astype(float)


def color_of(scene: Scene) -> np.ndarray:
    """Return the colours (rows, cols, channels) of a map of a scene."""
    view = scene.view(size=(60, 60))
    return render_frame(scene, view, plan_of(scene, view)).color


# -- colours


@pytest.mark.parametrize("name", STYLES)
def test_higher_ground_is_not_darker(name):
    assert (np.diff(lightness(tint_table(STYLES[name].ramp, STYLES[name].has_latitude_tints)), axis=1) > -1e-9).all()


@pytest.mark.parametrize("name", STYLES)
def test_ramp_has_its_colours_at_its_heights(name):
    (table,), ramp = tint_table(STYLES[name].ramp), STYLES[name].ramp
    for height, color in ramp:
        expected = linear_of_srgb(np.array([int(color[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]))
        ramp_position = (height - TINT_MIN_HEIGHT_M) / TINT_HEIGHT_STEP_M
        lower_index, share = int(ramp_position), ramp_position - int(ramp_position)
        np.testing.assert_allclose(table[lower_index] + share * (table[lower_index + 1] - table[lower_index]), expected, atol=4e-3)


def test_height_has_one_colour_in_every_level(write_raster, make_scene):
    """Colours are not stretched to the height range of the level: 300 m looks the same below peaks of 4,000 m."""
    colors = []
    for peak in (320.0, 4000.0):
        heights = np.full((60, 60), 300.0, np.float32)
        heights[0, 0] = peak
        scene = make_scene(write_raster(heights, UTM, X0, Y0, 10.0), 180.0, 60.0, effects={"sky_view": "off"}, style="natural")
        colors.append(color_of(scene)[40:, 40:])
    assert np.array_equal(*colors) and colors[0].any()


def test_grey_style_is_grey(write_raster, make_scene):
    color = color_of(plane(write_raster, make_scene, 0.2, 250.0, 20.0, style="grey")).astype(int)
    assert np.ptp(color, axis=-1).max() <= 1


@pytest.mark.parametrize("name", ["natural", "swiss", "urban", "analysis"])
@pytest.mark.parametrize("base_m", [50.0, 800.0, 3000.0])
def test_shadows_are_bluish(write_raster, make_scene, name, base_m):
    """For any colour of the ground, blue is the strongest channel of level ground in shadow, which is darker than lit ground."""
    scene = plane(write_raster, make_scene, 1e-4, 200.0, 30.0, base_m, style=name)
    shadow_color, lit_color = centre_color(scene, 0.0), centre_color(scene, 1.0)
    assert shadow_color[2] > shadow_color[1] and shadow_color[2] > shadow_color[0]
    assert lightness(shadow_color[None])[0] < 0.8 * lightness(lit_color[None])[0]


def test_custom_ramp_replaces_that_of_the_style(write_raster, make_scene):
    scene = plane(
        write_raster, make_scene, 1e-4, 180.0, 60.0, style={"name": "analysis", "ramp": [[0, "#ff0000"], [600, "#0000ff"]]}
    )
    lit_color = centre_color(scene, 1.0)
    assert lit_color[0] == pytest.approx(lit_color[2], rel=0.25) and lit_color[1] < 0.3 * lit_color[0], (
        "half the way from red to blue, and greyed sky"
    )
    assert (centre_color(scene.with_style("analysis"), 1.0) > 0.5).all(), "a named style comes without it"


# -- light


def test_level_ground_keeps_its_brightness(write_raster, make_scene):
    """Level, lit, white ground shows ``LEVEL_GROUND_EXPOSURE`` of white for any sun above ``MIN_EXPOSURE_SUN_ALTITUDE_DEG``.

    The sky alone gives its share.
    """
    for altitude in (20.0, 45.0, 85.0):
        scene = plane(
            write_raster,
            make_scene,
            1e-5,
            180.0,
            altitude,
            effects={"sky_view": "off"},
            style={"name": "analysis", "ramp": [[0, "#ffffff"]]},
        )
        sky = (
            LEVEL_GROUND_EXPOSURE
            * SKY_IRRADIANCE_SHARE
            / (1.0 + SKY_IRRADIANCE_SHARE)
            * np.array(STYLES["analysis"].sky_light_color)
        )
        np.testing.assert_allclose(centre_color(scene, 0.0), sky, rtol=2e-3)
        np.testing.assert_allclose(
            centre_color(scene, 1.0),
            [tone_curve(LEVEL_GROUND_EXPOSURE / (1.0 + SKY_IRRADIANCE_SHARE) + sky_term) for sky_term in sky],
            rtol=2e-3,
        )


def test_shoulder_is_smooth_and_never_white():
    x = np.linspace(0.0, 20.0, 20001)
    y = np.array([tone_curve(value) for value in x])
    assert np.array_equal(y[x <= TONE_CURVE_START], x[x <= TONE_CURVE_START]) and (np.diff(y) > 0).all() and y.max() < 1.0
    assert np.abs(np.diff(np.diff(y))).max() < 1e-5, "no edge where it begins"


def test_shadowed_slopes_towards_the_sun_get_more_sky(write_raster, make_scene):
    """The closed form is 1 + k (a + cos s - 1) of the sky's share, with a = sin s towards the sun."""
    slope = np.arctan(0.5)
    facing_sun, facing_away = (
        centre_color(plane(write_raster, make_scene, rise, 270.0, 20.0, effects={"sky_view": "off"}, style="grey"), 0.0)[0]
        for rise in (0.5, -0.5)  # the plane that rises eastwards faces west
    )
    k = STYLES["grey"].sunward_sky_light_share
    factors = [max(1.0 + k * (side * np.sin(slope) + np.cos(slope) - 1.0), MIN_SLOPE_SKY_FACTOR) for side in (1.0, -1.0)]
    assert facing_sun / facing_away == pytest.approx(factors[0] / factors[1], rel=0.02)
    assert facing_sun > 1.5 * facing_away


def test_sky_factor_is_one_on_level_ground_and_bounded():
    for sine in (-0.1, 0.0, 0.3, 0.9, 1.0):
        assert _slope_sky_factor(sine, 1.0, sine, 0.8) == pytest.approx(1.0)
        assert _slope_sky_factor(-1.0, 0.0, sine, 1.0) >= MIN_SLOPE_SKY_FACTOR


def test_slopes_are_exaggerated_as_tangents():
    """A plane that rises t per metre towards the sun, exaggerated by a, has the normal (-a t, 1), normalized."""
    altitude = np.radians(25.0)
    sun = np.array([np.cos(altitude), np.sin(altitude)])
    for t in (-1.5, -0.2, 0.0, 0.3, 2.0):
        for a in (0.5, 1.0, 4.0):
            normal, exaggerated_normal = (np.array([-rise, 1.0]) / np.hypot(rise, 1.0) for rise in (t, a * t))
            facing, upright = _exaggerated_cosines(normal @ sun, normal[1], sun[1], a, 1e9)
            assert (facing, upright) == pytest.approx((exaggerated_normal @ sun, exaggerated_normal[1]), abs=1e-12)
        _, limited_upright = _exaggerated_cosines(normal @ sun, normal[1], sun[1], 100.0, 0.7)
        assert limited_upright >= np.cos(np.arctan(0.7)) - 1e-12, "no slope is drawn steeper than the limit"


def test_attached_shadow_starts_softly_on_slopes():
    for sine in (0.05, 0.5, 1.0):
        facing = np.linspace(-0.2, 1.0, 1201)
        direct_light = np.array([_slope_direct_light(cosine, sine, 0.5) for cosine in facing])
        assert (
            np.array_equal(direct_light[facing >= 0.5 * sine], facing[facing >= 0.5 * sine]) and (np.diff(direct_light) >= 0).all()
        )
        assert (direct_light[facing <= 0.0] == 0.0).all() and (direct_light <= np.maximum(facing, 0.0)).all()
        assert np.array_equal(np.array([_slope_direct_light(cosine, sine, 0.0) for cosine in facing]), np.maximum(facing, 0.0)), (
            "Lambert's law"
        )


def test_aerial_perspective_lowers_contrast_of_low_ground(write_raster, make_scene):
    """At sea level, lit and shadowed parts of a slope differ less than at 4,000 m."""
    contrast = {}
    for base_m in (10.0, 4000.0):
        scene = plane(write_raster, make_scene, 0.05, 250.0, 20.0, base_m, style={"name": "swiss", "ramp": [[0, "#cccccc"]]})
        contrast[base_m] = centre_color(scene, 1.0)[1] - centre_color(scene, 0.0)[1]
    assert contrast[10.0] / contrast[4000.0] == pytest.approx(
        (1 - STYLES["swiss"].air_veil_share * np.exp(-10 / 1500)) / (1 - STYLES["swiss"].air_veil_share * np.exp(-4000 / 1500)),
        rel=0.01,
    )


def test_slope_exaggeration_grows_with_pixel_size_to_three():
    style = STYLES["natural"]
    assert [style.slope_exaggeration_at(pixel_m) for pixel_m in (1.0, 60.0)] == [1.0, 1.0]
    assert style.slope_exaggeration_at(960.0) == pytest.approx(2.0) and style.slope_exaggeration_at(1e6) == 3.0
    assert STYLES["analysis"].slope_exaggeration_at(1e6) == 1.0


# -- unchanged shadows


@pytest.mark.parametrize("exaggeration", [None, 6.0])
@pytest.mark.parametrize("name", STYLES)
def test_styles_do_not_move_shadows(gl, write_raster, make_scene, name, exaggeration):
    rng = np.random.default_rng(3)
    heights = (500.0 + 60.0 * rng.normal(size=(60, 60)).cumsum(axis=0)).astype(np.float32)
    scene = make_scene(write_raster(heights, UTM, X0, Y0, 30.0), 235.0, 25.0)
    other, view = scene.with_style(name, exaggeration), scene.view(size=(90, 90))
    frames = [render_frame(styled_scene, view, plan_of(styled_scene, view)) for styled_scene in (scene, other)]
    assert np.array_equal(frames[0].visibility, frames[1].visibility, equal_nan=True)
    assert np.array_equal(frames[0].opacity, frames[1].opacity)
    if other.style != scene.style:
        assert not np.array_equal(frames[0].color, frames[1].color)


def test_luminance_has_standard_weights():
    assert luminance_of(1.0, 1.0, 1.0) == pytest.approx(1.0)
    assert luminance_of(0.0, 1.0, 0.0) > luminance_of(1.0, 0.0, 0.0) > luminance_of(0.0, 0.0, 1.0)


# -- default styles


@pytest.mark.parametrize(("trees", "name"), [(0, "urban"), (6, "urban"), (40, "urban"), (110, "natural")])
def test_fine_ground_is_urban_unless_it_is_wooded(write_raster, make_scene, tmp_path, trees, name):
    """The area is 60 x 60 m, or 3,600 m2, and each crown of 5 m covers 20 m2."""
    heights = np.zeros((60, 60), np.float32)
    heights[20:40, 20:40] = 9.0
    fine_raster = write_raster(heights, UTM, X0, Y0, 1.0)
    x, y = (edge + 6.0 * np.arange(1, 10) for edge in (X0, Y0 - 60.0))
    places = [[float(a) + 0.1 * number, float(b)] for number in range(2) for a in x for b in y][:trees]
    (tmp_path / "trees.geojson").write_text(json.dumps({
        "type": "FeatureCollection", "crs": {"type": "name", "properties": {"name": UTM}},
        "features": [{"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": at}} for at in places],
    }))  # fmt: skip
    forest = [{"source": str(tmp_path / "trees.geojson"), "height": [9, 12], "crown": [5, 5]}] if trees else []
    scene = make_scene(fine_raster, forest=forest)
    assert scene.objects.crown_area_share == pytest.approx(len(places) * np.pi * 2.5**2 / 3600.0, rel=0.01)
    assert (scene.objects.crown_area_share > 0.25) == (name == "natural") and scene.style.name == name
    assert make_scene(fine_raster, forest=forest, style="natural").style.name == "natural"


def test_coarse_ground_is_natural_unless_it_has_blocks(write_raster, make_scene):
    coarse_raster = write_raster(np.zeros((60, 60), np.float32), UTM, X0, Y0, 30.0)
    assert make_scene(coarse_raster).style.name == "natural"
    assert make_scene(coarse_raster, terrain={"surface": "blocks"}).style.name == "urban"


@pytest.mark.parametrize(
    ("style", "message"),
    [
        ("pretty", "style: .pretty. is not allowed. Allowed: .*swiss"),
        ({"name": "swiss", "ramp": []}, "with increasing heights"),
        ({"ramp": [[100, "#ffffff"], [0, "#000000"]]}, "with increasing heights"),
        ({"ramp": [[0, "white"]]}, "as '#b3c2a2'"),
        ({"slope_exaggeration": 0}, "style.slope_exaggeration"),
        ({"colour": "swiss"}, "style.colour"),
    ],
)
def test_invalid_style_is_rejected(write_raster, make_scene, style, message):
    raster = write_raster(np.zeros((5, 5), np.float32), UTM, X0, Y0, 10.0)
    with pytest.raises(LevelError, match=message):
        make_scene(raster, style=style)


def test_invalid_style_of_a_request_names_the_parameter(write_raster, make_scene):
    scene = plane(write_raster, make_scene, 0.1, 180.0, 30.0)
    with pytest.raises(InputError, match="style: .pretty. is not allowed. Allowed: .*swiss") as caught:
        scene.with_style("pretty")
    assert "natural" in str(caught.value)
    with pytest.raises(InputError, match="slope_exaggeration"):
        scene.with_style(None, 0.0)
