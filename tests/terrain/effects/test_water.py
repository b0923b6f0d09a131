"""Standing water: its surface wherever ground lies below it, its colour, and its reflections."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import dblquad

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects import water
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.shading import albedo_of, water_mask
from skugga.terrain.sky import Sky

UTM = "EPSG:32633"
WATER_LEVEL_M = 100.0


@pytest.fixture
def bowl_m() -> np.ndarray:
    """Return heights (60, 80) of a round bowl: 60 m at its middle and 206 m at the corners."""
    row, col = np.mgrid[:60, :80]
    return (60.0 + 0.06 * ((row - 29.5) ** 2 + (col - 39.5) ** 2)).astype(np.float32)


@pytest.fixture
def make_lake(write_raster, make_scene, bowl_m):
    """Return a factory of scenes with water in the bowl, seen from above and from its rim."""

    def make(altitude: float = 40.0, level_m: float = WATER_LEVEL_M, heights_m: np.ndarray = bowl_m, **keys):
        path = write_raster(heights_m, UTM, 500_000, 5_000_600, 10)
        views = {
            "map": {"kind": "map", "size": [80, 60]},
            "rim": {
                "kind": "perspective",
                "eye": [15.0020, 45.1562, 40],
                "target": [15.0065, 45.1562, 0],
                "fov": 45,
                "size": [96, 64],
            },
            "down": {
                "kind": "perspective",
                "eye": [15.0051, 45.1562, 300],
                "target": [15.0052, 45.1562, 0],
                "fov": 30,
                "size": [64, 64],
            },
            "away": {
                "kind": "perspective",
                "eye": [15.0005, 45.1562, 40],
                "target": [15.0001, 45.1562, 30],
                "fov": 45,
                "size": [96, 64],
            },
        }
        return make_scene(path, 90.0, altitude, water={"level": level_m}, views=views, **keys)

    return make


def render_lake(scene, name: str, water_on: bool):
    """Return the colours (rows, cols, 3) of a view with or without water, as integers."""
    view = scene.view(name)
    level = scene.loaded.level.model_copy(update={"effects": {"haze": "off", "water": "on" if water_on else "off"}})
    return render_frame(scene, view, make_plan(describe(scene, view, name), level, {})).color.astype(int)


def verdict(scene, name: str):
    """Return whether the view ``name`` requires the effect, and why."""
    return water.judge(describe(scene, scene.view(name), name))


def test_heights_are_the_maximum_of_ground_and_water(write_raster, bowl_m):
    path = str(write_raster(bowl_m, UTM, 0, 600, 10))
    dry_elevation, flooded_elevation = Elevation(path), Elevation(path, water_m=WATER_LEVEL_M)
    row, col = np.meshgrid(np.linspace(-0.5, 59.5, 130), np.linspace(-0.5, 79.5, 170), indexing="ij")
    for level in (0, 1, 2):
        ground_m, valid = dry_elevation.heights_at(level, row, col)
        height_m, flooded_valid = flooded_elevation.heights_at(level, row, col)
        np.testing.assert_array_equal(height_m, np.maximum(ground_m, np.float32(WATER_LEVEL_M)))
        np.testing.assert_array_equal(flooded_valid, valid)
    assert flooded_elevation.ground_m(395.0, 305.0) == WATER_LEVEL_M == flooded_elevation.filled_ground_m(395.0, 305.0)
    assert (
        flooded_elevation.overview.mean_heights_m.min() == WATER_LEVEL_M
        and flooded_elevation.overview.lowest_ground_m == bowl_m.min()
    )


def test_overviews_of_large_rasters_are_flooded(write_raster):
    heights_m = np.full((600, 1100), 120.0, np.float32)
    heights_m[:300] = 40.0
    heights_m[5, 5] = 10.0
    overview = Elevation(str(write_raster(heights_m, UTM, 0, 6000, 10)), water_m=WATER_LEVEL_M).overview
    assert overview.lod == 2 and overview.lowest_ground_m == 10.0
    for values in (overview.mean_heights_m, overview.max_heights_m):
        assert set(np.unique(values)) == {100.0, 120.0}


def test_water_does_not_fill_nodata(write_raster):
    heights_m = np.full((40, 40), 50.0, np.float32)
    heights_m[10:20, 10:20] = -9999
    elevation = Elevation(str(write_raster(heights_m, UTM, 0, 400, 10, nodata=-9999)), water_m=WATER_LEVEL_M)
    height_m, valid = elevation.heights_at(0, np.array([[15.0, 30.0]]), np.array([[15.0, 30.0]]))
    np.testing.assert_array_equal(valid, [[False, True]])
    assert height_m[0, 1] == WATER_LEVEL_M and np.isnan(elevation.ground_m(155.0, 245.0))


def test_exaggeration_raises_the_ground_but_not_the_water(write_raster):
    elevation = Elevation(str(write_raster(np.full((9, 9), 60.0), UTM, 0, 90, 10)), exaggeration=2.0, water_m=WATER_LEVEL_M)
    assert elevation.ground_m(45.0, 45.0) == 120.0


def test_water_far_below_all_ground_changes_nothing(write_raster, bowl_m):
    path = str(write_raster(bowl_m, UTM, 0, 600, 10))
    row, col = np.mgrid[0:59:0.7, 0:79:0.7]
    for a, b in zip(Elevation(path).heights_at(0, row, col), Elevation(path, water_m=-50.0).heights_at(0, row, col), strict=True):
        np.testing.assert_array_equal(a, b)


def test_water_is_painted_up_to_its_round_shore(make_lake):
    scene = make_lake()
    buffer = geometry_buffer(scene, scene.view("map", size=(800, 600)))
    is_water = water_mask(buffer, scene)
    albedo = albedo_of(buffer, scene)
    np.testing.assert_allclose(albedo[is_water], np.broadcast_to(scene.style.water_albedo, albedo[is_water].shape), atol=1e-6)
    assert not np.isclose(albedo[~is_water & buffer.valid], scene.style.water_albedo, atol=1e-3).all(axis=-1).any()
    area_m2 = is_water.sum() * 100.0 / 100.0
    assert area_m2 == pytest.approx(np.pi * (WATER_LEVEL_M - 60.0) / 0.06 * 100.0, rel=0.02)


def test_trees_do_not_stand_in_water(make_lake, tmp_path):
    places = [[15.0051, 45.1562], [15.0009, 45.1562]]  # the middle of the bowl, its rim
    features = [{"type": "Feature", "properties": {}, "geometry": {"type": "Point", "coordinates": place}} for place in places]
    path = tmp_path / "trees.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")
    trees = [make_lake(level_m=m, forest=[{"source": str(path)}]).objects.trees for m in (0.0, WATER_LEVEL_M)]
    assert [len(tree_set.thinning_rank) for tree_set in trees] == [2, 1]


@given(cosine=st.floats(0.0, 1.0))
def test_seen_facets_match_integrals_over_all_facets(cosine):
    s = np.sqrt(0.5 * water.MEAN_SQUARE_WAVE_SLOPE)
    sine = np.sqrt(1.0 - cosine * cosine)
    z = np.linspace(-8.0 * s, 8.0 * s, 20001)
    visible_density = np.exp(-0.5 * (z / s) ** 2) / (s * np.sqrt(2.0 * np.pi)) * np.maximum(cosine + z * sine, 0.0)
    area, slope = water._visible_facet_area_and_slope(cosine, water.MEAN_SQUARE_WAVE_SLOPE)
    assert area == pytest.approx(np.trapezoid(visible_density, z), rel=1e-4, abs=1e-6)
    assert slope == pytest.approx(np.trapezoid(z * visible_density, z) / np.trapezoid(visible_density, z), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("altitude_deg", [90.0, 50.0, 20.0])
def test_glint_carries_the_fresnel_share_of_sunlight(altitude_deg):
    """A white matt surface reflects pi times its radiance upwards, so the integral is divided by pi.

    Waves hide some of the light from each other.
    """
    sun_up_cosine = np.sin(np.radians(altitude_deg))
    sun = np.array([np.sqrt(1.0 - sun_up_cosine * sun_up_cosine), 0.0, sun_up_cosine])

    def radiance(azimuth, eye_up_cosine):
        eye_horizontal = np.sqrt(1.0 - eye_up_cosine * eye_up_cosine)
        eye_sun_cosine = eye_horizontal * np.cos(azimuth) * sun[0] + eye_up_cosine * sun[2]
        area, _ = water._visible_facet_area_and_slope(eye_up_cosine, water.MEAN_SQUARE_WAVE_SLOPE)
        return (
            water._glint_share(eye_up_cosine, sun_up_cosine, eye_sun_cosine, area, water.MEAN_SQUARE_WAVE_SLOPE)
            / np.pi
            * eye_up_cosine
        )

    power, _ = dblquad(radiance, 1e-3, 1.0, 0.0, 2.0 * np.pi, epsabs=1e-6, epsrel=1e-4)
    flat = sun_up_cosine * (
        water.NORMAL_INCIDENCE_REFLECTANCE + (1.0 - water.NORMAL_INCIDENCE_REFLECTANCE) * (1.0 - sun_up_cosine) ** 5
    )
    assert 0.8 * flat < power < 1.25 * flat


def test_water_seen_vertically_reflects_a_fiftieth():
    color = np.full((1, 1, 3), 0.4, np.float32)
    foot, zenith = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.6, 0.7])
    sky = Sky(foot, foot, zenith, np.ones(3), 1.0, np.full(3, 4.0), np.array([0.5, 0.5]))
    valid, centre = np.ones((1, 1), bool), np.array([0.0, 0.0, -1e12])
    water._add_reflections(
        color, valid, np.zeros((1, 1, 3)), None, centre, sky, water.MEAN_SQUARE_WAVE_SLOPE, np.zeros(3), None, None
    )
    share = 1.0 - np.exp(-4.0)
    np.testing.assert_allclose(color[0, 0], 0.98 * 0.4 + 0.02 * ((1.0 - share) * foot + share * zenith), atol=1e-6)


def test_glint_peaks_under_the_sun_and_is_symmetric():
    sun_up_cosine, eye_up_cosine = np.sin(np.radians([30.0, 25.0]))
    area, _ = water._visible_facet_area_and_slope(eye_up_cosine, water.MEAN_SQUARE_WAVE_SLOPE)
    horizontal_product = np.sqrt((1.0 - sun_up_cosine**2) * (1.0 - eye_up_cosine**2))
    off_deg = np.arange(-90.0, 91.0, 5.0)  # angle between the eye's azimuth and the sun's
    glint = [
        water._glint_share(
            eye_up_cosine,
            sun_up_cosine,
            sun_up_cosine * eye_up_cosine - horizontal_product * np.cos(np.radians(offset_deg)),
            area,
            water.MEAN_SQUARE_WAVE_SLOPE,
        )
        for offset_deg in off_deg
    ]
    np.testing.assert_allclose(glint, glint[::-1], rtol=1e-9)
    assert np.argmax(glint) == len(off_deg) // 2 and (np.diff(glint[: len(off_deg) // 2 + 1]) >= 0).all()


@pytest.mark.parametrize("name", ["map", "rim", "down"])
def test_water_is_needed_by_day_and_changes_only_water(make_lake, name):
    scene = make_lake()
    assert verdict(scene, name).is_needed
    with_water, without_water = (render_lake(scene, name, water_on) for water_on in (True, False))
    is_changed = (with_water != without_water).any(axis=-1)
    buffer = geometry_buffer(scene, scene.view(name))
    assert is_changed.any() and (np.abs(with_water - without_water).max() > 1)
    far = ~water_mask(buffer, scene)
    if name == "map":
        assert not (is_changed & far).any()


@pytest.mark.parametrize("name", ["map", "rim", "down"])
@pytest.mark.parametrize("altitude", [20.0, -3.0, -8.0, -9.0, -9.5, -10.0, -10.5, -11.2, -12.0, -40.0])
def test_water_that_the_plan_omits_does_not_show(make_lake, name, altitude):
    scene = make_lake().with_sun(SunSpec(azimuth=90.0, altitude=altitude))
    change = np.abs(render_lake(scene, name, True) - render_lake(scene, name, False)).max()
    if verdict(scene, name).is_needed:
        assert change > 0
    else:
        assert change <= 1


def test_a_map_by_night_needs_no_reflections(make_lake):
    water_verdict = verdict(make_lake(altitude=-30.0), "map")
    assert not water_verdict.is_needed and "of 255" in water_verdict.reason


@pytest.mark.parametrize(
    ("level_m", "name", "reason"),
    [(20.0, "map", "no ground lies below the water level, 20.0 m"), (WATER_LEVEL_M, "away", "the water at 100.0 m is out of view")],
)
def test_water_is_left_out_with_a_reason(make_lake, level_m, name, reason):
    scene = make_lake(level_m=level_m)
    water_verdict = verdict(scene, name)
    assert (water_verdict.is_needed, water_verdict.reason) == (False, reason)
    np.testing.assert_array_equal(render_lake(scene, name, True), render_lake(scene, name, False))


def test_a_level_without_water_says_so(write_raster, make_scene, bowl_m):
    scene = make_scene(write_raster(bowl_m, UTM, 500_000, 5_000_600, 10))
    assert verdict(scene, "map").reason == "the level has no water"


def test_glint_needs_the_sun_mirrored_towards_the_eye(make_lake):
    scene = make_lake(altitude=70.0)
    assert water.has_glint(scene, scene.view("map"))
    low_sun_scene, night_scene = (scene.with_sun(SunSpec(azimuth=90.0, altitude=a)) for a in (20.0, -5.0))
    assert not water.has_glint(low_sun_scene, low_sun_scene.view("map")) and not water.has_glint(
        night_scene, night_scene.view("rim")
    )
    towards, from_behind = (scene.with_sun(SunSpec(azimuth=a, altitude=20.0)) for a in (90.0, 270.0))
    assert water.has_glint(towards, towards.view("rim")) and not water.has_glint(from_behind, from_behind.view("rim"))


def test_glint_stays_out_of_shadow(make_lake):
    scene = make_lake(altitude=25.0)
    view = scene.view("rim")
    buffer = geometry_buffer(scene, view)
    is_water = water_mask(buffer, scene)
    colors = []
    for sun_visibility in (0.0, 1.0):
        color = np.full((*is_water.shape, 3), 0.2, np.float32)
        water.apply_water(color, ShadingBlock(scene, view, buffer, {"sun": np.full(is_water.shape, sun_visibility, np.float32)}))
        colors.append(color[is_water])
    assert (colors[1] >= colors[0]).all() and (colors[1] - colors[0]).max() > 0.2
    assert colors[1].max() <= 1.0


def test_a_pond_between_coarse_view_points_is_not_missed(make_lake, bowl_m):
    """The water covers a few distant pixels, wherever the camera is shifted."""
    heights_m = np.full_like(bowl_m, 100.3)
    heights_m[28:31, 38:41] = 90.0
    scene = make_lake(heights_m=heights_m, level_m=100.0)
    eye = scene.view("rim")
    view_count_with_water = 0
    for shift in range(8):
        view = eye.shifted(shift, 3 * shift)
        on_water = water_mask(geometry_buffer(scene, view), scene).any()
        assert water.judge(describe(scene, view, "rim")).is_needed >= on_water
        view_count_with_water += on_water
    assert view_count_with_water > 0
