"""Light of the whole sky in maps: closed forms of a wall and of slopes, seams, and both ways to draw a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from skugga.selector.select import plan_of_view
from skugga.shadows.ground_pictures import ground_picture
from skugga.shadows.passes import PassLog
from skugga.shadows.render import render_frame
from skugga.shadows.sky_light.luminance import OVERCAST, relative_luminance
from skugga.shadows.sky_light.sky_light import block_sky_light
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

CELL_M = 2.0
SIDE = 160


def scene_of(folder: Path, heights: np.ndarray, sky: str, crs: str = ENGINEERING) -> Scene:
    write_geotiff(folder / "dem.tif", heights.astype(np.float32), crs, 0.0 if crs == ENGINEERING else 5e5, 5.3e6, CELL_M)
    keys = f"version: 1\nterrain: {{source: dem.tif}}\nsun: {{azimuth: 200, altitude: 40}}\nstyle: {{name: natural, sky: {sky}}}\n"
    (folder / "level.yaml").write_text(keys)
    return build_scene(load_level(folder / "level.yaml"))


def factors(scene: Scene, view: MapView) -> np.ndarray:
    buffer = geometry_buffer(scene, view)
    return np.where(buffer.valid, block_sky_light(ShadingBlock(scene, view, buffer, {})), np.nan)


def test_ground_before_a_long_wall(gl, tmp_path: Path):
    """A wall 60 m high to the east, 320 m long: level ground before it sees the sky above horizons of known angles."""
    heights = np.zeros((SIDE, SIDE))
    heights[:, SIDE - 20 :] = 60.0
    scene = scene_of(tmp_path, heights, "overcast")
    factor = factors(scene, scene.view("map", size=(SIDE, SIDE)))
    altitude, azimuth = (np.arange(400) + 0.5) / 400 * np.pi / 2, (np.arange(720) + 0.5) / 720 * 2 * np.pi
    light = relative_luminance(OVERCAST, altitude, np.zeros(400), 1.0, 0.0) * np.cos(altitude) * np.sin(altitude)
    for distance_m in (20.0, 50.0, 100.0):
        col = SIDE - 20 - round(distance_m / CELL_M)
        to_wall_m = (SIDE - 20 - col - 0.5) * CELL_M  # the wall stands between two cells
        # Its ends lie 160 m to the north and to the south.
        along_m = to_wall_m * np.abs(np.cos(azimuth)) / np.maximum(np.sin(azimuth), 1e-9)
        rise = np.where((np.sin(azimuth) > 0.0) & (along_m < 160.0), 60.0 * np.sin(azimuth) / to_wall_m, 0.0)
        visible = altitude > np.arctan(rise)[:, None]
        expected = float((visible * light).sum() / (len(azimuth) * light.sum()))
        assert factor[SIDE // 2, col] == pytest.approx(expected, abs=0.02)


def test_open_slopes_face_a_part_of_the_sky(gl, tmp_path: Path):
    """A roof-shaped hill: its sides see the sky above the plane only, brighter to the sun's side under a clear sky."""
    x = (np.arange(SIDE) - SIDE / 2 + 0.5) * CELL_M
    scene = scene_of(tmp_path, np.tile(100.0 - 0.5 * np.abs(x), (SIDE, 1)), "overcast")
    view = scene.view("map", size=(SIDE, SIDE))
    overcast = factors(scene, view)
    np.testing.assert_allclose(overcast[40:120, 40], overcast[40:120, SIDE - 41], atol=0.01)
    assert 0.85 < overcast[80, 40] < 0.97
    clear_scene = scene.with_style(None, None, "clear")
    clear = factors(clear_scene, view)
    assert clear[80, 40] > clear[80, SIDE - 41] + 0.02, "azimuth 200 lies to the west of south"


def test_parts_of_a_map_meet_without_a_seam(gl, tmp_path: Path):
    rng = np.random.default_rng(3)
    heights = rng.normal(0.0, 4.0, (SIDE, SIDE)).cumsum(axis=0).cumsum(axis=1) * 0.02
    scene = scene_of(tmp_path, heights, "clear")
    view = scene.view("map", size=(SIDE, SIDE))
    whole = factors(scene, view)
    left, right = factors(scene, view.part(0, 0, SIDE, 71)), factors(scene, view.part(0, 71, SIDE, SIDE - 71))
    difference = np.abs(np.concatenate([left, right], axis=1) - whole)
    assert np.nanmax(difference) < 0.004, "a step of 255 at most"


def test_both_ways_to_draw_a_map_agree(gl, tmp_path: Path):
    y, x = np.mgrid[0:SIDE, 0:SIDE] * CELL_M
    heights = 40.0 * np.sin(x / 40.0) * np.cos(y / 55.0)
    scene = scene_of(tmp_path, heights, "clear", "EPSG:32633")
    view = scene.view("map", size=(SIDE, SIDE))
    plan = plan_of_view(scene, view, "map", {})
    assert {"sky_light", "texture_shading"} <= plan.effect_names and "sky_view" not in plan.effect_names
    picture = ground_picture(scene, view, plan, frozenset({"color"}), PassLog())
    assert picture is not None and picture.color is not None
    frame = render_frame(scene, view, plan)
    difference = np.abs(picture.color.astype(int) - frame.color)
    assert difference.max() <= 1 and (difference > 0).mean() < 2e-3
