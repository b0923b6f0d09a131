"""Snow: where it lies, what steep ground shows, and when it is needed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from skugga.selector.planner.planner import make_plan
from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects import snow
from skugga.terrain.effects.effect import PixelSize, ShadingBlock
from skugga.terrain.effects.snow import (
    MAX_FULL_SNOW_SLOPE_DEG,
    MIN_BARE_SLOPE_DEG,
    ROCK_ALBEDO,
    SNOW_ALBEDO,
    SNOW_EDGE_NOISE_DEG,
    apply_snow,
)
from skugga.terrain.gbuffer.geometry import GeometryBuffer, ShadingInputs
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.shading import albedo_of
from tests.rasters import ENGINEERING

EARTH_CENTRE = np.array([0.0, 0.0, -1e12])
"""The point from which "up" points away in a flat world."""


@pytest.fixture
def make_slope_scene(make_scene: Callable[..., Scene], write_raster) -> Callable[..., Scene]:
    """Return a factory of planes that rise eastwards from height 0 at an angle, with nodes 10 m apart."""

    def make(slope_deg: float, **keys) -> Scene:
        heights = np.tile(10.0 * np.tan(np.radians(slope_deg)) * np.arange(64), (64, 1)).astype(np.float32)
        return make_scene(write_raster(heights, ENGINEERING, 0.0, 640.0, 10.0), **{"weather": {"snow": True}, **keys})

    return make


def albedo_without_and_with_snow(scene: Scene) -> tuple[np.ndarray, np.ndarray, GeometryBuffer]:
    """Return the albedo of a small map before and after snow, and its buffer."""
    view = scene.view(size=(100, 100))
    assert isinstance(view, MapView)
    buffer = geometry_buffer(scene, view)
    albedo = albedo_of(buffer, scene)
    before = albedo.copy()
    apply_snow(albedo, ShadingBlock(scene, view, buffer, {}))
    return before, albedo, buffer


@pytest.mark.parametrize("slope_deg", [0.0, 15.0, MAX_FULL_SNOW_SLOPE_DEG - 1.6 * SNOW_EDGE_NOISE_DEG])
def test_snow_covers_gentle_slopes(make_slope_scene, slope_deg: float) -> None:
    _, albedo, buffer = albedo_without_and_with_snow(make_slope_scene(slope_deg))
    assert np.allclose(albedo[buffer.valid], SNOW_ALBEDO, atol=0.01)


@pytest.mark.parametrize("slope_deg", [MIN_BARE_SLOPE_DEG + 2 * SNOW_EDGE_NOISE_DEG, 75.0])
def test_steep_slopes_show_rock_without_tint(make_slope_scene, slope_deg: float) -> None:
    _, albedo, buffer = albedo_without_and_with_snow(make_slope_scene(slope_deg))
    assert np.allclose(albedo[buffer.valid], ROCK_ALBEDO, atol=0.01)


def test_the_edge_of_the_snow_is_irregular(make_slope_scene) -> None:
    _, albedo, buffer = albedo_without_and_with_snow(make_slope_scene((MAX_FULL_SNOW_SLOPE_DEG + MIN_BARE_SLOPE_DEG) / 2))
    share = (albedo[buffer.valid][:, 0] - ROCK_ALBEDO[0]) / (SNOW_ALBEDO[0] - ROCK_ALBEDO[0])
    assert 0.3 < share.mean() < 0.7
    assert share.std() > 0.1
    assert share.min() >= -1e-6 and share.max() <= 1 + 1e-6


def test_snow_share_is_1_on_gentle_and_0_on_steep_slopes() -> None:
    shares = [snow._slope_snow_share(slope_deg, 3.0, 4.0, 1.0) for slope_deg in np.linspace(0.0, 90.0, 200)]
    assert shares[0] == 1.0 and shares[-1] == 0.0
    assert (np.diff(shares)[np.linspace(0.0, 90.0, 200)[1:] < MAX_FULL_SNOW_SLOPE_DEG - 2 * SNOW_EDGE_NOISE_DEG] == 0.0).all()


def test_snow_noise_fades_out_in_wide_pixels() -> None:
    middle = (MAX_FULL_SNOW_SLOPE_DEG + MIN_BARE_SLOPE_DEG) / 2
    assert {float(snow._slope_snow_share(middle, 37.0 * k, 11.0 * k, snow.SNOW_EDGE_NOISE_WAVELENGTH_M)) for k in range(9)} == {0.5}
    assert len({float(snow._slope_snow_share(middle, 37.0 * k, 11.0 * k, 1.0)) for k in range(9)}) > 5


def test_snow_skips_water(make_slope_scene) -> None:
    scene = make_slope_scene(10.0, water={"level": 40.0})
    before, albedo, buffer = albedo_without_and_with_snow(scene)
    is_water = buffer.valid & (buffer.height_m <= 40.0)
    assert 0.2 < is_water.mean() < 0.8
    assert np.array_equal(albedo[is_water], before[is_water])
    assert np.allclose(albedo[buffer.valid & (buffer.height_m > 40.1)], SNOW_ALBEDO, atol=0.01)


def test_snow_covers_roofs_and_crown_tops_but_no_walls() -> None:
    normal = np.array([[[0, 0, 1], [1, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1]]], np.float32)
    kind = np.array([[MESHES, MESHES, FOREST, FOREST, RELIEF]], np.uint8)
    base_albedo = np.full((1, 5, 3), 0.1, np.float32)
    albedo = base_albedo.copy()
    shading_inputs = ShadingInputs(np.ones((1, 5), bool), kind, np.zeros((1, 5, 3)), np.zeros((1, 5), np.float32), normal)
    snow._apply_snow_albedo(
        albedo, shading_inputs, base_albedo, EARTH_CENTRE, (np.eye(3), np.zeros(3)), -np.inf, PixelSize(np.zeros(3), 0.0, 100.0)
    )
    roof, wall, top, side, ground = albedo[0]
    assert np.allclose(roof, SNOW_ALBEDO) and np.allclose(ground, SNOW_ALBEDO)
    assert np.allclose(wall, 0.1) and np.allclose(side, 0.1)
    assert (top > 0.2).all() and (top < SNOW_ALBEDO).all()


def test_steep_imagery_keeps_its_albedo() -> None:
    base_albedo = np.full((1, 1, 3), 0.3, np.float32)
    albedo = base_albedo.copy()
    shading_inputs = ShadingInputs(
        np.ones((1, 1), bool), np.full((1, 1), RELIEF, np.uint8), np.zeros((1, 1, 3)), np.zeros((1, 1), np.float32),
        np.array([[[1, 0, 0]]], np.float32),
    )  # fmt: skip
    snow._apply_snow_albedo(
        albedo, shading_inputs, base_albedo, EARTH_CENTRE, (np.eye(3), np.zeros(3)), -np.inf, PixelSize(np.zeros(3), 0.0, 1.0)
    )
    assert np.allclose(albedo, 0.3)


def test_snow_of_map_parts_agrees(make_slope_scene) -> None:
    scene = make_slope_scene((MAX_FULL_SNOW_SLOPE_DEG + MIN_BARE_SLOPE_DEG) / 2)
    full_view = scene.view(size=(100, 100))
    part = full_view.part(20, 30, 40, 50)
    albedos = []
    for view in (full_view, part):
        buffer = geometry_buffer(scene, view)
        albedo = albedo_of(buffer, scene)
        apply_snow(albedo, ShadingBlock(scene, view, buffer, {}))
        albedos.append(albedo)
    assert np.array_equal(albedos[0][20:60, 30:80], albedos[1])


@pytest.mark.parametrize(
    ("keys", "is_needed", "reason"),
    [
        ({}, True, "38 to 52 degrees"),
        ({"weather": {"snow": False}}, False, "the level sets no snow"),
        ({"water": {"level": 500.0}}, False, "all ground lies below the water level"),
        ({"water": {"level": 50.0}}, True, "slopes below"),
    ],
)
def test_snow_is_needed_only_where_it_shows(make_slope_scene, keys: dict, is_needed: bool, reason: str) -> None:
    scene = make_slope_scene(10.0, **keys)
    view = scene.view(size=(60, 60))
    verdict = snow.judge(describe(scene, view))
    assert verdict.is_needed is is_needed and reason in verdict.reason
    frames = []
    for setting in ("on", "off"):
        level = scene.loaded.level.model_copy(update={"effects": {"snow": setting}})
        frames.append(render_frame(scene, view, make_plan(describe(scene, view), level, {})).color.astype(int))
    assert (np.abs(frames[0] - frames[1]).max() > 1) == is_needed


def test_sunlit_snow_is_not_overexposed(make_slope_scene) -> None:
    scene = make_slope_scene(20.0, azimuth=270.0, altitude=30.0)
    frame = render_frame(scene, scene.view(size=(60, 60)), make_plan(describe(scene, scene.view()), scene.loaded.level, {}))
    assert 200 < frame.color[30, 30].min() <= frame.color[30, 30].max() < 250
