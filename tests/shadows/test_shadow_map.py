"""The shadow map: a bias that is exactly enough, seams that do not show, options that do something."""

from __future__ import annotations

import numpy as np
import pytest

from shadows import shadow_map
from shadows.attached import attached
from shadows.passes import PassLog
from terrain.geometry import map_geometry
from terrain.grid import MapView
from terrain.level import load_level
from terrain.level_parts import SunSpec
from terrain.reach import casters_of
from terrain.scene import Scene, build_scene
from terrain.world import FRAME_PITCH_DEG, LocalFrame, geocentric
from tests.rasters import ENGINEERING
from tests.render import block_at, plan_of, render, shadow


@pytest.fixture(scope="module")
def jacksboro() -> Scene:
    return build_scene(load_level("configs/jacksboro.yaml"))


def visibility(scene: Scene, view: MapView, frame: LocalFrame, bias_scale: float = 1.0, **overrides) -> np.ndarray:
    """The sun's visibility of a view in a given frame, attached shadow included, NaN where there is no surface."""
    settings = plan_of(scene, view, **overrides).settings["sun"]["relief"]
    settings = settings.model_copy(update={"bias_scale": bias_scale})
    buffer = map_geometry(scene.surface(view.grid), view, frame)
    seen = shadow_map.fill(buffer, scene, "sun", ("relief",), casters_of(scene, buffer), settings, PassLog())
    seen[attached(buffer, scene)] = 0.0
    seen[~buffer.there] = np.nan
    return seen


def tilted_plane(write_raster, slope_deg: float, towards_deg: float):
    """A plane that rises by a slope away from the azimuth it faces."""
    cells, cell = 96, 10.0
    axis = (np.arange(cells) - cells / 2) * cell
    east, north = np.meshgrid(axis, -axis)
    facing = np.radians(towards_deg)
    rise = -np.tan(np.radians(slope_deg)) * (east * np.sin(facing) + north * np.cos(facing))
    return write_raster(rise.astype(np.float32), ENGINEERING, -480, 480, cell, name="plane.tif")


@pytest.mark.parametrize("taps", [1, 2, 3, 5])
@pytest.mark.parametrize(("slope", "azimuth"), [(1, 0), (20, 37), (45, 203), (70, 290), (80, 111)])
def test_planes_are_lit_whatever_their_slope(gl, write_raster, make_scene, slope, azimuth, taps):
    """No acne: every pixel of a plane that faces the sun at all is fully lit."""
    raster = tilted_plane(write_raster, slope, azimuth)
    for altitude, aside in ((75.0, 0.0), (30.0, 50.0), (8.0, -75.0), (3.0, 110.0)):
        scene = make_scene(raster, azimuth + aside, altitude)
        view = scene.view(bounds=(-300, -300, 300, 300), size=(256, 256))
        buffer = map_geometry(scene.surface(view.grid), view, scene.world.frame_near(view.grid.crs, *view.centre))
        faces = ~attached(buffer, scene)
        if not faces.all():
            continue
        seen = visibility(scene, view, buffer.frame, filter=taps, map_size=512)
        assert (seen == 1.0).all(), (altitude, aside)


def test_less_bias_than_derived_shows_acne(gl, write_raster, make_scene):
    """The bias is tight: at 0.7 times it, planes that the sun grazes (over 60 degrees) shadow themselves."""
    for slope, aside, altitude in ((2, 0, 8.0), (60, 90.0, 20.0), (30, 160.0, 40.0)):
        scene = make_scene(tilted_plane(write_raster, slope, 37.0), 37.0 + aside, altitude)
        view = scene.view(bounds=(-300, -300, 300, 300), size=(300, 300))
        frame = scene.world.frame_near(view.grid.crs, *view.centre)
        full = visibility(scene, view, frame, 1.0, filter=1, map_size=512)
        less = visibility(scene, view, frame, 0.7, filter=1, map_size=512)
        assert (full == 1.0).all()
        assert (less < 0.5).mean() > 1e-3, (slope, aside, altitude)


@pytest.mark.parametrize("altitude", [30.0, 10.0, 2.0])
def test_a_border_strip_is_the_same_from_both_neighbours(gl, jacksboro, altitude):
    """From two blocks of one frame and of two neighbouring frames: at most 1e-4 of the pixels differ."""
    scene = jacksboro.with_sun(SunSpec(azimuth=237, altitude=altitude))
    block = block_at(-84.25, 36.58, 13)
    frame = scene.world.frame_near(block.grid.crs, *block.centre)
    pitch = FRAME_PITCH_DEG / np.cos(np.radians(scene.world.anchor_lat_deg))
    lon = np.float64(scene.world.anchor_lon_deg + (frame.key[0] + 1) * pitch)
    lat = np.float64(scene.world.anchor_lat_deg + frame.key[1] * FRAME_PITCH_DEG)
    origin, up = geocentric(lon, lat)
    other_frame = LocalFrame((frame.key[0] + 1, frame.key[1]), origin, scene.world.earth_from_enu(origin, up).T)
    strip = 128
    here = visibility(scene, block, frame)[:, -strip:]
    assert 1e-4 < (here < 0.5).mean() < 0.999
    for its_frame in (frame, other_frame):
        there = visibility(scene, block.part(0, 1024 - strip, 1024, 1024), its_frame)[:, :strip]
        assert np.array_equal(np.isnan(here), np.isnan(there))
        assert ((here < 0.5) != (there < 0.5)).mean() <= 1e-4


def test_a_tile_is_cut_from_the_same_pixels_as_a_bigger_map(gl, jacksboro):
    """Byte for byte: one tile, and a map of 3 x 2 tiles at that zoom that crosses a block's border."""
    block = block_at(-84.25, 36.58, 12)
    tile = block.part(256, 512, 256, 256)
    bigger = block.part(256, 256, 512, 1024)
    low_sun = jacksboro.with_sun(SunSpec(azimuth=237, altitude=8))
    small, large = render(low_sun, tile), render(low_sun, bigger)
    assert 0.01 < shadow(small).mean() < 0.99
    np.testing.assert_array_equal(small.color, large.color[:256, 256:512])
    np.testing.assert_array_equal(small.visibility, large.visibility[:256, 256:512])


@pytest.mark.parametrize(
    "change",
    [{"map_size": 256}, {"filter": 1}, {"filter": 5}, {"algorithm": "none"}],
    ids=lambda change: "=".join(str(part) for part in next(iter(change.items()))),
)
def test_every_option_changes_the_picture(gl, jacksboro, change):
    view = block_at(-84.25, 36.58, 12).part(0, 0, 512, 512)
    usual = render(jacksboro, view)
    changed = render(jacksboro, view, **change)
    assert (usual.color != changed.color).any(axis=-1).mean() > 1e-3


def test_two_runs_give_the_same_bytes(gl, jacksboro):
    view = block_at(-84.25, 36.58, 12).part(0, 0, 300, 300)
    one, other = render(jacksboro, view), render(jacksboro, view)
    np.testing.assert_array_equal(one.color, other.color)
    np.testing.assert_array_equal(one.visibility, other.visibility)


def test_holes_and_islands_throw_no_walls(gl, write_raster, make_scene):
    """Level ground with holes stays lit round them, and the holes are transparent."""
    heights = np.full((80, 80), 50.0, np.float32)
    heights[30:50, 30:50] = -9999.0
    heights[10, 10] = -9999.0
    scene = make_scene(write_raster(heights, ENGINEERING, 0, 800, 10.0, nodata=-9999.0), 201, 5)
    frame = render(scene, scene.view(size=(400, 400)))
    assert not frame.there[150:250, 150:250].any()
    assert np.nanmin(frame.visibility) == 1.0
    island = np.full((80, 80), -9999.0, np.float32)
    island[40, 40] = 10.0
    alone = make_scene(write_raster(island, ENGINEERING, 0, 800, 10.0, name="island.tif", nodata=-9999.0), 201, 5)
    frame = render(alone, alone.view(size=(400, 400)))
    assert frame.there.sum() == 25 and np.nanmin(frame.visibility) == 1.0


@pytest.mark.parametrize("altitude", [0.01, 0.0, -0.01, -20.0])
def test_the_sun_at_and_below_the_horizon(gl, jacksboro, altitude):
    """No error and no NaN: a picture that fades continuously, all in shadow once the sun has set."""
    view = block_at(-84.25, 36.58, 11)
    frame = render(jacksboro.with_sun(SunSpec(azimuth=250, altitude=altitude)), view)
    assert frame.there.any() and frame.color[frame.there].any()
    if altitude == -20.0:
        assert np.nanmax(frame.visibility) == 0.0
        assert frame.plan.algorithm == {"sun": {"relief": "none"}}


def test_colours_fade_into_the_night_without_a_jump(gl, jacksboro):
    view = block_at(-84.25, 36.58, 11)
    means = [
        render(jacksboro.with_sun(SunSpec(azimuth=250, altitude=altitude)), view).color.astype(float).mean()
        for altitude in (0.02, 0.01, -0.01, -0.02)
    ]
    assert np.abs(np.diff(means)).max() < 0.01 * means[0]
