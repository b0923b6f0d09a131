"""Default sun of a level without a sun."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

CELL_M, CELLS = 30.0, 64


def scene_over(folder: Path, heights: np.ndarray, crs: str = ENGINEERING, x0: float = 0.0, y0: float = 0.0) -> Scene:
    """Return the scene of heights (rows, cols) whose north-west corner is (x0, y0)."""
    return build_scene(load_level(write_geotiff(folder / "ground.tif", heights.astype(np.float32), crs, x0, y0, CELL_M)))


def inclined_plane(slope_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return a plane (CELLS, CELLS) in metres that rises towards an azimuth."""
    row, col = np.mgrid[:CELLS, :CELLS] * CELL_M
    towards = col * np.sin(np.radians(azimuth_deg)) - row * np.cos(np.radians(azimuth_deg))
    return towards * np.tan(np.radians(slope_deg))


@pytest.mark.parametrize("slope_deg", [6.0, 15.0, 28.0])
def test_default_sun_is_as_high_as_slopes_are_steep(tmp_path, slope_deg):
    scene = scene_over(tmp_path, inclined_plane(slope_deg, 240.0))
    assert scene.sun is not None
    assert (scene.sun.azimuth_deg, scene.sun.altitude_deg) == (240.0, pytest.approx(slope_deg, abs=0.5))


@pytest.mark.parametrize(
    ("heights", "altitude_deg"), [(np.zeros((8, 8)), 30.0), (inclined_plane(2.0, 240.0), 4.0), (inclined_plane(60, 240), 35.0)]
)
def test_default_sun_altitude_is_bounded(tmp_path, heights, altitude_deg):
    scene = scene_over(tmp_path, heights)
    assert scene.sun is not None and scene.sun.altitude_deg == altitude_deg


@pytest.mark.parametrize(("zone", "north_m"), [(32633, 1_000_000), (32633, 5_300_000), (32633, 7_800_000), (32733, 6_200_000)])
def test_default_sun_is_a_real_position(tmp_path, zone, north_m):
    """The sun stands there on an afternoon of the equinox, or of midsummer beyond 60 degrees north."""
    row, col = np.mgrid[:CELLS, :CELLS]
    scene = scene_over(tmp_path, 300 * np.sin(col / 5.0) * np.cos(row / 7.0), f"EPSG:{zone}", 500_000, north_m)
    assert scene.sun is not None
    lon, lat = scene.world.anchor_lon_deg, scene.world.anchor_lat_deg
    noon = datetime(2024, 6, 20, 11, tzinfo=UTC) if lat > 60 else datetime(2024, 3, 20, 11, tzinfo=UTC)
    path = sun_path([noon + timedelta(minutes=minutes) for minutes in range(0, 13 * 60, 2)], lon, lat)
    angle_deg = np.hypot(path.azimuth_deg - scene.sun.azimuth_deg, path.altitude_deg - scene.sun.altitude_deg)
    assert angle_deg.min() < 1.5
    assert 180 < scene.sun.azimuth_deg < 360 and scene.sun.altitude_deg > 0


def test_default_sun_at_a_pole(tmp_path):
    scene = scene_over(tmp_path, inclined_plane(20, 240), "EPSG:3413", -CELLS * CELL_M / 2, CELLS * CELL_M / 2)
    assert scene.sun is not None and 0 < scene.sun.altitude_deg <= 22


def test_default_sun_is_up_over_a_whole_country(tmp_path):
    """On gentle ground 1,500 km wide in the southern hemisphere, the sun is low but above the horizon everywhere."""
    row, col = np.mgrid[:100, :150] * 10_000.0
    heights = (500 * np.sin(col / 1.3e4) * np.cos(row / 1.7e4)).astype(np.float32)
    scene = build_scene(load_level(write_geotiff(tmp_path / "g.tif", heights, "EPSG:2193", 1_000e3, 6_000e3, (10_000.0, 10_000.0))))
    assert scene.sun is not None and scene.sun.altitude_deg < 15.0
    west, south, east, north = scene.elevation.bounds
    _, up = scene.world.points_at_zero_height(
        scene.elevation.crs, np.array([west, west, east, east]), np.array([south, north, south, north])
    )
    corners_deg = np.degrees(np.arcsin(up @ scene.sun.to_sun_earth))
    assert 2.0 < corners_deg.min() < 8.0


def test_sun_of_a_level_takes_precedence(tmp_path, make_scene):
    raster = write_geotiff(tmp_path / "g.tif", inclined_plane(15, 240).astype(np.float32), ENGINEERING, 0, 0, CELL_M)
    scene = make_scene(raster, 100, 50)
    assert scene.sun is not None and (scene.sun.azimuth_deg, scene.sun.altitude_deg) == (100, 50)
