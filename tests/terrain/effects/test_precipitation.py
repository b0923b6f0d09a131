"""Rain and falling snow: what moves, what hides it, and how far one sees."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.haze import visibility_m_of
from skugga.terrain.effects.precipitation import (
    FALL_M_PER_S,
    LAYER_DISTANCE_RATIO,
    NEAREST_LAYER_M,
    OPACITY,
    apply_precipitation,
    drop_opacity,
    drops_of,
)
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.parts import Weather
from skugga.terrain.scene import Scene
from tests.rasters import ENGINEERING


@pytest.fixture
def make_wet_scene(make_scene, write_raster):
    """Return a factory of scenes: level ground with a view over it, under rain or falling snow."""

    def make(eye_up_m: float = 30.0, **weather) -> Scene:
        raster = write_raster(np.zeros((40, 40), np.float32), ENGINEERING, 0.0, 2000.0, 50.0)
        view = {"kind": "perspective", "eye": [0, -500, eye_up_m], "target": [0, 500, 0], "fov": 50, "size": [160, 120]}
        return make_scene(raster, 180.0, 40.0, weather=weather, views={"v": view})

    return make


def drawn(scene: Scene) -> np.ndarray:
    """Return what drops add to a black picture (rows, cols, 3)."""
    view = scene.view("v")
    buffer = geometry_buffer(scene, view)
    color = np.zeros((*buffer.valid.shape, 3), np.float32)
    apply_precipitation(color, ShadingBlock(scene, view, buffer, {}))
    return color


@pytest.mark.parametrize(("layer", "pixel_tangent"), [(0, 1e-4), (6, 2e-3)])
@pytest.mark.parametrize("kind", ["rain", "snowfall"])
def test_drops_fall_along_one_line(make_wet_scene, kind: str, layer: int, pixel_tangent: float) -> None:
    """After a time, the opacity at a place is the earlier one where the drop came from. Far streaks are longer than drops."""
    distance_m = NEAREST_LAYER_M * LAYER_DISTANCE_RATIO**layer
    scene, fall_m, moved = make_wet_scene(precipitation=kind).at_second(300.0), 0.09 * (1 + layer), []
    drops, later = drops_of(scene), drops_of(scene.at_second(300.0 + fall_m / FALL_M_PER_S[kind]))
    for azimuth in np.linspace(0.1, 0.6, 400):
        before = drop_opacity(layer, azimuth, 0.1, pixel_tangent, drops)
        fallen = drop_opacity(layer, azimuth, 0.1 - fall_m / distance_m, pixel_tangent, later)
        assert fallen == pytest.approx(before, abs=0.02 * OPACITY[kind])
        moved.append(before - drop_opacity(layer, azimuth, 0.1, pixel_tangent, later))
    assert np.abs(moved).max() > 0.04


def test_more_rain_draws_more_and_repeats_exactly(make_wet_scene) -> None:
    light, heavy = (drawn(make_wet_scene(precipitation="rain", precipitation_rate=rate)) for rate in (1.0, 30.0))
    assert heavy.mean() > 2.0 * light.mean() > 0.0
    np.testing.assert_array_equal(light, drawn(make_wet_scene(precipitation="rain", precipitation_rate=1.0)))


def test_near_ground_hides_drops(make_wet_scene) -> None:
    """An eye one metre above the ground sees fewer drops before the ground than an eye far above it."""
    low, high = (drawn(make_wet_scene(up_m, precipitation="snowfall"))[-10:] for up_m in (0.6, 60.0))
    assert low.mean() < 0.5 * high.mean()


def test_finer_pixels_see_the_same_rain(make_wet_scene) -> None:
    """The mean opacity hardly depends on the size of pixels: a narrow streak is drawn wider and fainter."""
    drops = drops_of(make_wet_scene(precipitation="rain", precipitation_rate=1.0))
    azimuths, rises = np.linspace(-3.0, 3.0, 4001), np.linspace(-0.3, 0.3, 61)
    fine, coarse = (
        np.mean([drop_opacity(1, azimuth, rise, tangent, drops) for azimuth in azimuths for rise in rises])
        for tangent in (1e-4, 2e-3)
    )
    assert coarse == pytest.approx(fine, rel=0.25)


def test_visibility_falls_with_the_rate(make_wet_scene) -> None:
    """Attenuations of ITU-R P.1814: 1.076 dB/km in rain of 1 mm/h, 3.84 dB/km in wet snow."""
    assert Weather(precipitation="rain", precipitation_rate=1.0).precipitation_extinction_per_m == pytest.approx(2.477e-4, rel=1e-3)
    scene = make_wet_scene(precipitation="snowfall", precipitation_rate=1.0, visibility=1e7)
    assert visibility_m_of(scene, scene.view("v")) == pytest.approx(3.912 / (3.84 / 4343.0), rel=1e-2)
    distances = []
    for rate in (0.1, 1.0, 10.0, 100.0):
        scene = make_wet_scene(precipitation="rain", precipitation_rate=rate)
        distances.append(visibility_m_of(scene, scene.view("v")))
    assert (np.diff(distances) < 0.0).all()


def test_clear_weather_has_no_drops(make_wet_scene) -> None:
    assert drops_of(make_wet_scene()) is None and drawn(make_wet_scene()).max() == 0.0
