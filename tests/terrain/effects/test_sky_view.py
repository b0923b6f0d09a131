"""Sky view factors: horizons against closed forms, places in rasters, and the predicate against pictures."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.render import render_frame
from skugga.terrain.describe import describe
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.effects.sky_view import EFFECT, apply_sky_view, max_darkening_steps
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, view_frame
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.sky_view_factor import mip_pyramid, sky_occlusion, sky_view, sky_view_nodes
from tests.render import plan_of, render

NODE_OFFSETS = np.arange(129) - 64.0


def occluded_share(height_m: np.ndarray, across_m: float = 1.0, down_m: float = 1.0, curvature: float = 0.0) -> np.ndarray:
    """Return the occluded share of the sky at each node (rows, cols). ``across_m`` and ``down_m`` are the sides of cells."""
    rows = len(height_m)
    return sky_occlusion(height_m, np.full(rows, across_m), np.full(rows, down_m), curvature)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.3, 3))
def test_a_plane_hides_no_sky(east: float, south: float, down_m: float) -> None:
    """The horizon of a plane is its own slope, so only rounding is lost; on level ground nothing is."""
    height = east * np.arange(24.0) + south * np.arange(20.0)[:, None]
    assert occluded_share(height, down_m=down_m).max() < 1e-6
    assert not occluded_share(np.full((20, 24), 7.0)).any()


@pytest.mark.parametrize("slope_deg", [10.0, 30.0, 45.0, 70.0])
@pytest.mark.parametrize("axis", ["rows", "columns", "diagonal"])
def test_sky_view_at_the_bottom_of_a_valley(slope_deg: float, axis: str) -> None:
    """The bottom line of an endless valley with straight sides sees the share cos(slope) of the sky."""
    axis_distance = {"rows": NODE_OFFSETS[:, None] + 0 * NODE_OFFSETS, "columns": NODE_OFFSETS + 0 * NODE_OFFSETS[:, None]}.get(
        axis
    )
    axis_distance = (NODE_OFFSETS + NODE_OFFSETS[:, None]) / np.sqrt(2.0) if axis_distance is None else axis_distance
    sky_share = 1.0 - occluded_share(np.abs(axis_distance) * np.tan(np.radians(slope_deg)))[64, 64]
    assert sky_share == pytest.approx(np.cos(np.radians(slope_deg)), abs=0.012)


@pytest.mark.parametrize("slope_deg", [10.0, 45.0, 70.0])
def test_sky_view_at_the_bottom_of_a_funnel(slope_deg: float) -> None:
    """The tip sees cos^2(slope). Ground between nodes is straight, which raises the innermost ring around the tip."""
    sky_share = 1.0 - occluded_share(np.hypot(NODE_OFFSETS, NODE_OFFSETS[:, None]) * np.tan(np.radians(slope_deg)))[64, 64]
    assert sky_share == pytest.approx(np.cos(np.radians(slope_deg)) ** 2, abs=0.02)


def test_sky_view_is_uniform_in_a_hollow_half_sphere() -> None:
    """In an integrating sphere every place sees the same share of the opening: half of the sky for a half sphere."""
    radius = 60.0
    square = NODE_OFFSETS**2 + (NODE_OFFSETS**2)[:, None]
    height = -np.sqrt(np.maximum(radius**2 - square, 0.0))
    tilted_sky_share = 0.5 + 0.5 * np.sqrt(np.maximum(1.0 - square / radius**2, 0.0))
    sky_share = tilted_sky_share * (1.0 - occluded_share(height))
    assert sky_share[square < (0.8 * radius) ** 2] == pytest.approx(0.5, abs=0.012)


def test_sky_view_before_a_wall() -> None:
    """An endless wall whose top has the elevation angle h leaves (1 + cos h) / 2 of level ground's sky."""
    height = np.zeros((1025, 65))
    height[:, 40:] = 10.0
    for distance_cells in (4, 10, 30):
        expected = 0.5 - 0.5 * np.cos(np.arctan2(10.0, distance_cells))
        assert occluded_share(height)[512, 40 - distance_cells] == pytest.approx(expected, abs=0.012)
    assert not occluded_share(height)[512, 45:].any()


@given(st.sampled_from([(0, 0), (1, 0), (0, 1), (1, 1)]), st.booleans(), st.floats(0.4, 2.5))
def test_sky_view_follows_mirrored_and_turned_ground(mirrored: tuple[int, int], turned: bool, down_m: float) -> None:
    """The hidden share moves with the ground, because all azimuths are treated alike."""
    height = np.random.default_rng(3).normal(size=(19, 23)).cumsum(axis=1)
    mirrored_height, cells = height[:: 1 - 2 * mirrored[0], :: 1 - 2 * mirrored[1]], (1.0, down_m)
    occlusion = occluded_share(mirrored_height.T if turned else mirrored_height, *(cells[::-1] if turned else cells))
    restored = (occlusion.T if turned else occlusion)[:: 1 - 2 * mirrored[0], :: 1 - 2 * mirrored[1]]
    np.testing.assert_allclose(restored, occluded_share(height, *cells), atol=1e-6)


def test_sky_view_allows_for_the_earth_s_curvature() -> None:
    """A ridge 1000 m high and 120 km away lies below the earth's horizon (113 km), but above that of a plane."""
    height = np.zeros((3, 121))
    height[:, 120] = 1000.0
    assert occluded_share(height, 1000.0, 1000.0)[1, 0] > 0.0
    assert occluded_share(height, 1000.0, 1000.0, 1.0 / 6_371_000.0)[1, 0] == 0.0
    assert occluded_share(height, 1000.0, 1000.0, 1.0 / 6_371_000.0)[1, 20] > 0.0


def test_nodata_hides_no_sky() -> None:
    """Unknown ground leaves the sky open, and ground beyond a hole still counts."""
    height = np.zeros((65, 65))
    height[:, 40:] = 10.0
    holes = height.copy()
    holes[:, 35:45] = np.nan
    assert not occluded_share(holes)[:, 35:45].any()
    assert 0.0 < occluded_share(holes)[32, 30] < occluded_share(height)[32, 30]


def test_pyramid_reduces_pairs_down_to_one_node() -> None:
    """Each level reduces nodes two by two. An odd last node is reduced with itself."""
    values, table = mip_pyramid(np.arange(15, dtype=np.float32).reshape(3, 5), np.max)
    assert table[:, 1:].tolist() == [[3, 5], [2, 3], [1, 2], [1, 1]]
    assert values[table[1, 0] : table[2, 0]].tolist() == [6.0, 8.0, 9.0, 11.0, 13.0, 14.0]
    assert values[-1] == 14.0


@pytest.mark.parametrize(
    ("crs", "x0", "y0", "cell"),
    [
        ("EPSG:32633", 500_000.0, 5_300_000.0, 900.0),
        ("EPSG:4326", 10.0, 47.0, 0.01),
        ("EPSG:4326", 179.8, 85.0, 0.01),
        ("EPSG:3413", -20_000.0, 30_000.0, 900.0),
        ('ENGCRS["floor",EDATUM["floor"],CS[Cartesian,2],AXIS["x",east],AXIS["y",north],LENGTHUNIT["metre",1]]', 5.0, 9.0, 2.0),
    ],
)
def test_sky_view_nodes_agree_with_proj(write_raster, make_scene, crs: str, x0: float, y0: float, cell: float) -> None:
    """Points at any height lie in the cells that PROJ gives, within a hundredth of a node."""
    rng = np.random.default_rng(1)
    scene = make_scene(write_raster(rng.normal(size=(60, 80)) * 100.0 + 1000.0, crs, x0, y0, cell))
    row, col, height = rng.uniform(0, 59, 200), rng.uniform(0, 79, 200), rng.uniform(0, 4000, 200)
    point, up = scene.world.points_at_zero_height(scene.elevation.crs, *scene.elevation.xy(row, col))
    frame = scene.world.frame_near_earth(point[0])
    position = (point + height[:, None] * up - frame.origin_earth_m) @ frame.frame_from_earth.T
    nodes = sky_view_nodes(sky_view(scene.elevation, scene.world), frame, position, height)
    np.testing.assert_allclose(nodes, np.stack([row, col], axis=-1), atol=0.01)


def valley_heights(depth_m: float) -> np.ndarray:
    """Return a valley along the middle of an otherwise level plain."""
    return np.broadcast_to(-depth_m * np.exp(-((np.arange(96) - 48.0) ** 2) / 50.0), (96, 96)).astype(np.float32)


@pytest.mark.parametrize("weather", [{}, {"cloud_cover": 1.0}])
@pytest.mark.parametrize("altitude", [40.0, 8.0, -3.0, -30.0])
def test_sky_view_predicate_agrees_with_pictures(write_raster, make_scene, altitude: float, weather: dict) -> None:
    """Valleys range from too shallow to deep enough.

    Left out, the effect would change no channel by over a step; run, it changes some.
    """
    verdicts = set()
    for depth_m in (2.0, 12.0, 18.0, 25.0, 35.0, 50.0, 70.0, 120.0):
        path = write_raster(valley_heights(depth_m), "EPSG:32633", 500_000.0, 5_300_000.0, 30.0, name=f"valley{depth_m:g}.tif")
        pictures = []
        for effect_switch in ("on", "off"):
            scene = make_scene(path, 90.0, altitude, weather=weather, effects={"sky_view": effect_switch})
            pictures.append(render(scene, scene.view(size=(96, 96)), algorithm="sweep").color.astype(int))
        verdict = EFFECT.judge(describe(scene, scene.view(size=(96, 96))))
        change = np.abs(pictures[0] - pictures[1]).max()
        assert change >= 1 if verdict.is_needed else change <= 1, (depth_m, change, verdict.reason)
        verdicts.add(verdict.is_needed)
    assert verdicts == {True, False}


def test_sky_view_in_perspective_depends_on_visible_ground(write_raster, make_scene) -> None:
    """A camera that looks into the valley needs the effect. A camera over the plain, looking away from the valley, does not."""
    path = write_raster(valley_heights(400.0), "EPSG:32633", 500_000.0, 5_300_000.0, 30.0)
    scene = make_scene(path)
    lon, lat = (float(v) for v in scene.world.lon_lat(scene.elevation.crs, np.array(501_440.0), np.array(5_298_560.0)))
    views = {
        "valley": {"kind": "perspective", "eye": [lon, lat, 3000], "target": [lon + 1e-4, lat, 0], "fov": 40, "size": [96, 80]},
        "plain": {
            "kind": "perspective",
            "eye": [lon + 0.015, lat, 20],
            "target": [lon + 0.018, lat, 0],
            "fov": 30,
            "size": [96, 80],
        },
    }
    scene = make_scene(path, views=views)
    assert EFFECT.judge(describe(scene, scene.view("valley"))).is_needed
    assert not EFFECT.judge(describe(scene, scene.view("plain"))).is_needed
    pictures = []
    for effect_switch in ("on", "off"):
        scene = make_scene(path, views=views, effects={"sky_view": effect_switch})
        pictures.append(render(scene, scene.view("plain"), algorithm="shadow_map").color.astype(int))
    assert np.abs(pictures[0] - pictures[1]).max() <= 1
    scene = make_scene(path, views=views)
    view = scene.view("valley")
    assert "sky_view" in [record.name for record in render_frame(scene, view, plan_of(scene, view)).passes]


def test_sky_view_of_map_parts_agrees(write_raster, make_scene) -> None:
    """The same ground loses the same share of the sky in every part of a map and in every frame."""
    scene = make_scene(write_raster(valley_heights(4000.0), "EPSG:4326", 10.0, 47.0, 0.004))
    full_view = scene.view(size=(128, 128))

    def skylight_of_view(view: MapView) -> np.ndarray:
        skylight = np.ones((view.rows, view.cols), np.float32)
        apply_sky_view(skylight, ShadingBlock(scene, view, geometry_buffer(scene, view), {}))
        return skylight

    part = full_view.part(96, 44, 32, 40)
    assert view_frame(scene, part).key != view_frame(scene, full_view).key
    assert skylight_of_view(full_view).min() < 0.99
    np.testing.assert_allclose(skylight_of_view(part), skylight_of_view(full_view)[96:128, 44:84], atol=2e-7)


def test_sky_view_is_not_needed_on_level_ground(write_raster, make_scene) -> None:
    """A floor needs no horizon search, and the reason says so."""
    scene = make_scene(write_raster(np.full((8, 8), 3.0, np.float32), "EPSG:32633", 500_000.0, 5_300_000.0, 30.0))
    verdict = EFFECT.judge(describe(scene, scene.view()))
    assert not verdict.is_needed and "open sky" in verdict.reason


def test_sky_view_averages_over_large_pixels(write_raster, make_scene) -> None:
    """A narrow gorge is lost in large pixels: the hidden share falls with the zoom and ends at the level's mean."""
    height = np.zeros((256, 256), np.float32)
    height[:, 128] = -60.0
    scene = make_scene(write_raster(height, "EPSG:32633", 500_000.0, 5_300_000.0, 30.0))
    shares = [describe(scene, scene.view(size=(n, n))).facts["sky_view"]["hidden"] for n in (256, 64, 16)]
    assert shares[0] > 1.5 * shares[1] > 2.0 * shares[2] > 0.0


@given(st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_darkening_steps_grow_with_hidden_sky_and_light(light: float, share: float) -> None:
    """Steps grow with the hidden share and with the light that it can hide."""
    assert max_darkening_steps(light, 0.0) == 0
    assert max_darkening_steps(light, share) <= max_darkening_steps(light, 1.0) == max_darkening_steps(light, 1.0)
    assert max_darkening_steps(light / 2.0, share) <= max_darkening_steps(light, share) + 1
