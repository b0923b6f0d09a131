"""Generalised normals and the local light: planes, waves and ridges in closed form, no seams, and unchanged shadows."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.draw import SHADING_NEEDS, draw
from skugga.shadows.render import render_frame
from skugga.terrain.gbuffer.landforms import (
    GENERALISED_SLOPE_GAIN,
    generalised_normals,
    landform_margin_px,
    local_light_turn_deg,
    locally_lit_normals,
)
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.style import GENERALISED_PIXELS_M, STYLES
from tests.render import plan_of

UTM, X0, Y0, CELL_M, SIDE = "EPSG:32633", 450_000.0, 6_000_000.0, 512.0, 160


@pytest.fixture
def ground(write_raster, make_scene):
    """Return a function that makes a scene of large cells from heights by east and north, in cells, and the sun."""

    def make(heights, azimuth=180.0, altitude=45.0, **style) -> Scene:
        north, east = np.mgrid[SIDE - 1 : -1 : -1, :SIDE].astype(float)
        values = np.asarray(heights(east, north), np.float32)
        style = {"name": "swiss", "sky": "even", "local_light": 0.0, "generalisation": 0.0, **style}
        return make_scene(write_raster(values, UTM, X0, Y0, CELL_M), azimuth, altitude, style=style)

    return make


def view_of(scene: Scene) -> MapView:
    """Return the map of a scene's cells."""
    view = scene.view(size=(SIDE, SIDE))
    assert isinstance(view, MapView)
    return view


def normals_of(scene: Scene, view: MapView, function) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals of a map's ground, and what a function of this module makes of them.

    Both are (rows, cols, 3), in the frame of the whole map.
    """
    buffer = geometry_buffer(scene, view)
    up = buffer.position_frame_m - scene.world.up_origin(buffer.frame)
    up = (up / np.linalg.norm(up, axis=-1, keepdims=True)).astype(np.float32)
    normal = buffer.shading_normal_frame
    to_map = scene.world.frame_near(view.grid.crs, *view_of(scene).centre).frame_from_earth @ buffer.frame.frame_from_earth.T
    return normal @ to_map.T, function(scene, view, buffer.frame, normal, up) @ to_map.T


def slopes(normal: np.ndarray) -> np.ndarray:
    """Return the slopes to the east and to the north (..., 2) of normals in the middle of a map."""
    inner = normal[60:-60, 60:-60].astype(float)
    return -inner[..., :2] / inner[..., 2:]


def test_a_plane_keeps_its_direction_and_steepens(ground):
    scene = ground(lambda east, north: 0.1 * CELL_M * east + 0.05 * CELL_M * north, generalisation=0.5)
    before, after = (slopes(normal) for normal in normals_of(scene, view_of(scene), generalised_normals))
    assert after == pytest.approx((0.5 + 0.5 * GENERALISED_SLOPE_GAIN) * before, abs=5e-3)  # the earth is curved


@pytest.mark.parametrize(("period", "low", "high"), [(5.0, 0.3, 0.6), (80.0, 1.5, 1.7)])
def test_small_waves_fade_and_large_ones_grow(ground, period, low, high):
    scene = ground(lambda east, north: 0.02 * period * CELL_M * np.sin(2.0 * np.pi * east / period), generalisation=0.5)
    before, after = (slopes(normal)[..., 0] for normal in normals_of(scene, view_of(scene), generalised_normals))
    assert low < after.std() / before.std() < high


def test_generalisation_begins_at_small_scales():
    first, last = GENERALISED_PIXELS_M
    shares = [STYLES["swiss"].generalisation_at(pixel_m) for pixel_m in (1.0, first, np.sqrt(first * last), last, 1e5)]
    assert shares == pytest.approx([0.0, 0.0, 0.5 * shares[-1], STYLES["swiss"].generalisation, STYLES["swiss"].generalisation])
    assert all(style.generalisation == style.local_light == 0.0 for name, style in STYLES.items() if name != "swiss")


def rough(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """Return heights of ridges in several directions, metres."""
    return 400.0 * np.sin(east / 3.0) * np.cos(north / 5.0) + 600.0 * np.sin((east - 2.0 * north) / 11.0)


@pytest.mark.parametrize("function", [generalised_normals, locally_lit_normals])
def test_windows_meet_without_a_seam(ground, function):
    scene = ground(rough, 243.0, local_light=30.0, generalisation=0.6)
    view = view_of(scene)
    before, whole = normals_of(scene, view, function)
    for row, col in ((20, 21), (51, 64)):
        _, part = normals_of(scene, view.part(row, col, 40, 48), function)
        assert np.abs(part - whole[row : row + 40, col : col + 48]).max() < 1e-5
    assert np.nanmax(np.abs(whole - before)) > 0.1, "the comparison is not vacuous"


def test_far_ground_has_no_effect(ground):
    def hill(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        return rough(east, north) + np.where(east > SIDE - 30, 2000.0, 0.0)

    far = SIDE - 30 - landform_margin_px() - 2
    normals = [
        normals_of(scene, view_of(scene), function)[1][:, :far]
        for function in (generalised_normals, locally_lit_normals)
        for scene in (ground(heights, 243.0, local_light=30.0, generalisation=0.6) for heights in (rough, hill))
    ]
    assert np.array_equal(normals[0], normals[1]) and np.array_equal(normals[2], normals[3])


@pytest.mark.parametrize(("azimuth", "turn_deg"), [(180.0, 30.0), (0.0, 30.0), (90.0, 0.0), (135.0, 0.0)])
def test_light_turns_where_relief_runs_along_it(ground, azimuth, turn_deg):
    """A ridge from south to north: under a sun in the south the light turns to the southwest, so the western flank is lighter."""
    scene = ground(lambda east, north: 0.3 * CELL_M * np.abs(east - SIDE / 2), azimuth, 45.0, local_light=30.0)
    before, after = normals_of(scene, view_of(scene), locally_lit_normals)
    angle = [np.degrees(np.arctan2(normal[80, 68:92, 0], normal[80, 68:92, 1]).astype(float)) for normal in (before, after)]
    turned = (angle[0] - angle[1] + 180.0) % 360.0 - 180.0
    flanks = np.abs(np.arange(68, 92) - SIDE / 2) > 3
    assert turned[flanks] == pytest.approx(turn_deg, abs=1.5)
    assert np.linalg.norm(after, axis=-1)[80, 68:92] == pytest.approx(1.0, abs=1e-5)


def test_flanks_along_the_light_differ(ground):
    def heights(east: np.ndarray, north: np.ndarray) -> np.ndarray:
        return 0.3 * CELL_M * (SIDE / 2 - np.abs(east - SIDE / 2))

    light = {}
    for local_light in (0.0, 30.0):
        scene = ground(heights, 180.0, 45.0, local_light=local_light)
        view = view_of(scene)
        color = draw(scene, view, plan_of(scene, view), SHADING_NEEDS).color.astype(float)
        light[local_light] = color[80, 40:70].mean() - color[80, 90:120].mean()
    assert abs(light[0.0]) < 10.0 and light[30.0] > light[0.0] + 20.0, "the western flank faces the turned light"


@pytest.mark.parametrize(("altitude", "expected"), [(60.0, 30.0), (22.0, 18.9), (5.0, 4.0)])
def test_a_low_sun_turns_less(ground, altitude, expected):
    scene = ground(rough, 180.0, altitude, local_light=30.0)
    assert local_light_turn_deg(scene) == pytest.approx(expected, abs=0.1)


def test_shadows_stay_where_they_are(ground):
    pictures = []
    for style in ({}, {"local_light": 30.0, "generalisation": 0.65}):
        scene = ground(rough, 250.0, 15.0, **style)
        view = view_of(scene)
        pictures.append(draw(scene, view, plan_of(scene, view), SHADING_NEEDS))
    plain, styled = pictures
    assert np.array_equal(plain.opacity, styled.opacity) and {0, 255} <= set(np.unique(plain.opacity))
    assert (plain.color != styled.color).any()
    frame = render_frame(scene, view, plan_of(scene, view))
    assert np.abs(frame.color.astype(int) - styled.color).max() <= 1, "a geometry buffer gives the same picture"
