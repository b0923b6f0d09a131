"""Sun hours: closed forms for walls, bowls, slopes and polar days, and rays over a small fractal."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from pyproj import Geod, Transformer

from benchmarks.sun_hours_accuracy import ray_truth
from benchmarks.sweep_speed import fractal_heights_m
from skugga.shadows.sun_hours.sun_hours import SunHours, SunRules, sun_hours
from skugga.shadows.sun_hours.suns import sun_spans, window_suns
from skugga.terrain.geo.clock import SOLAR, Clock
from skugga.terrain.geo.daily_windows import DailyWindow, daily_window
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff

CELL_M = 10.0
SPRING, SUMMER, WINTER = date(2024, 3, 21), date(2024, 6, 21), date(2024, 12, 21)
EAST, NORTH = 720e3, 5200e3  # 2.9 degrees east of the zone's meridian, where grid north is 2.1 degrees off

SceneOpener = Callable[..., Scene]


@pytest.fixture
def open_scene(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols), whose north-west corner is (x, y).

    Scenes are closed after the test.
    """
    scenes = []

    def make(heights: np.ndarray, crs: str = "EPSG:32632", x: float = EAST, y: float = NORTH, cell: float = CELL_M) -> Scene:
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), crs, x, y, cell)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def raster_cell_view(scene: Scene) -> MapView:
    """Return the map of a raster with one pixel per cell."""
    elevation = scene.elevation
    (x0, x1), (y0, _) = elevation.xy(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    return MapView(Grid(elevation.crs, float(x0), float(y0), float(x1 - x0)), 0.0, 0.0, 1.0, 1.0, elevation.rows, elevation.cols)


def window_of(scene: Scene, day: date, clock: Clock = UTC, first: float = 0.0, last: float = 1440.0) -> DailyWindow:
    """Return a window of a day from minute ``first`` to minute ``last`` of a clock."""
    return daily_window(day, first, last, clock, scene.world)


def forbid_plan(scene: Scene):
    """Fail, because sun hours of bare ground must not ask for a plan."""
    raise AssertionError("bare ground needs no plan")


def compute_sun_hours(scene: Scene, *windows: DailyWindow, **rules: float) -> SunHours:
    """Return the sun hours of all cells in the windows, with steps of five minutes. ``rules`` are fields of ``SunRules``."""
    return sun_hours(
        scene, raster_cell_view(scene), window_suns(scene.world, windows), SunRules(**{"step_minutes": 5.0, **rules}), forbid_plan
    )


def grid_north_deg(scene: Scene) -> float:
    """Return the clockwise angle from true north to grid north at a scene's middle, from a point a kilometre to the north."""
    lon, lat = scene.world.anchor_lon_deg, scene.world.anchor_lat_deg
    north_lon, north_lat, _ = Geod(ellps="WGS84").fwd(lon, lat, 0.0, 1000.0)
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform
    (x0, y0), (x1, y1) = to_map(lon, lat), to_map(north_lon, north_lat)
    return -float(np.degrees(np.arctan2(x1 - x0, y1 - y0)))


def sun_by_minute(scene: Scene, day: date) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the minutes of a day in UTC in steps of a tenth, and the sun's azimuths and altitudes, degrees."""
    minutes = np.arange(0.0, 1440.0, 0.1)
    start = datetime(day.year, day.month, day.day, tzinfo=UTC)
    path = sun_path([start + timedelta(minutes=float(m)) for m in minutes], scene.world.anchor_lon_deg, scene.world.anchor_lat_deg)
    return minutes, path.azimuth_deg, path.altitude_deg


@pytest.mark.parametrize(("day", "step"), [(SPRING, 2.0), (WINTER, 5.0)], ids=str)
def test_sun_hours_behind_a_wall(open_scene, day, step):
    heights = np.zeros((301, 121))
    heights[:, 60] = 80.0  # the wall runs along grid north
    scene = open_scene(heights)
    result = compute_sun_hours(scene, window_of(scene, day), step_minutes=step)
    minutes, azimuth, altitude = sun_by_minute(scene, day)
    convergence_deg = grid_north_deg(scene)
    assert abs(convergence_deg) > 2.0
    sun_across_wall = np.sin(np.radians(azimuth - convergence_deg))  # component across the wall of a metre towards the sun
    for cells in (6, 20, 45):
        clears_wall = (altitude > 0.0) & (np.tan(np.radians(altitude)) * cells * CELL_M > 80.0 * np.abs(sun_across_wall))
        morning, evening = sun_across_wall > 0.0, sun_across_wall < 0.0
        west, east = (150, 60 - cells), (150, 60 + cells)
        assert result.first[west] == pytest.approx(minutes[clears_wall & morning][0], abs=0.5), cells
        assert result.last[east] == pytest.approx(minutes[clears_wall & evening][-1], abs=0.5), cells
        is_up = altitude > 0.0
        assert result.last[west] == pytest.approx(minutes[is_up & evening][-1], abs=0.5)
        assert result.hours[west] * 60.0 == pytest.approx(result.last[west] - result.first[west], abs=0.01)
        assert result.longest[east] == pytest.approx(result.hours[east], abs=1e-3)


@pytest.mark.parametrize("step", [20.0, 5.0])
def test_sun_hours_of_deep_pits_are_zero_at_dusk_too(open_scene, step):
    """On a wide raster the sun sets in the east while it is up in the west. Over America a UTC window begins at that time."""
    heights = np.zeros((41, 41))
    heights[5:36:5, 5:36:5] = -9000.0  # pits of one cell, 3 km wide, with a horizon 72 degrees high
    scene = open_scene(heights, "EPSG:32611", 500e3, 3800e3, 3000.0)
    result = compute_sun_hours(scene, window_of(scene, WINTER), step_minutes=step)
    pits = heights < 0.0
    assert (result.hours[pits] == 0.0).all() and np.isnan(result.first[pits]).all()
    assert (result.hours[0] > 9.0).all()


def test_sun_hours_in_a_bowl(open_scene):
    row, col = np.mgrid[-100:101, -100:101]
    distance_cells = np.hypot(row, col)
    scene = open_scene(np.where(distance_cells < 30.0, 0.0, distance_cells * CELL_M * np.tan(np.radians(25.0))))
    result = compute_sun_hours(scene, window_of(scene, SPRING), step_minutes=5.0)
    minutes, _, altitude = sun_by_minute(scene, SPRING)
    minutes_above_rim = minutes[altitude > 25.0]
    assert result.hours[100, 100] * 60.0 == pytest.approx(minutes_above_rim[-1] - minutes_above_rim[0], abs=1.0)
    assert result.first[100, 100] == pytest.approx(minutes_above_rim[0], abs=0.5)


def test_sun_hours_of_a_slope_follow_its_incidence_angle(open_scene):
    tilt_deg = 30.0
    heights = np.arange(80)[:, None] * CELL_M * np.tan(np.radians(tilt_deg)) * np.ones((1, 60))  # falls towards grid north
    scene = open_scene(heights)
    result = compute_sun_hours(scene, window_of(scene, SPRING), step_minutes=5.0)
    minutes, azimuth, altitude = sun_by_minute(scene, SPRING)
    convergence_deg = grid_north_deg(scene)
    incidence_cosine = np.sin(np.radians(altitude)) * np.cos(np.radians(tilt_deg)) + np.cos(np.radians(altitude)) * np.sin(
        np.radians(tilt_deg)
    ) * np.cos(np.radians(azimuth - convergence_deg))
    is_sunlit = (incidence_cosine > 0.0) & (altitude > 0.0)
    assert 60.0 * result.hours[40, 30] == pytest.approx(0.1 * is_sunlit.sum(), abs=0.5)
    assert result.first[40, 30] == pytest.approx(minutes[is_sunlit][0], abs=0.5)
    winter = compute_sun_hours(scene, window_of(scene, WINTER), step_minutes=5.0)
    assert winter.hours[40, 30] == 0.0 and np.isnan(winter.first[40, 30]) and np.isnan(winter.last[40, 30])


def test_sun_hours_of_polar_day_and_night(open_scene):
    scene = open_scene(np.full((40, 40), 100.0), "EPSG:32633", 500e3, 8_900e3)
    day = compute_sun_hours(scene, window_of(scene, SUMMER), step_minutes=15.0)
    assert (day.hours == 24.0).all() and (day.longest == 24.0).all() and (day.days == 1.0).all()
    assert (day.first == 0.0).all() and (day.last == 1440.0).all()
    night = compute_sun_hours(scene, window_of(scene, WINTER), step_minutes=15.0)
    assert (night.hours == 0.0).all() and (night.days == 0.0).all() and np.isnan(night.first).all()


def test_sun_hours_with_window_least_altitude_and_height(open_scene):
    heights = np.zeros((121, 121))
    heights[:, 60] = 80.0
    scene = open_scene(heights)
    minutes, azimuth, altitude = sun_by_minute(scene, SPRING)
    noon = window_of(scene, SPRING, UTC, 600.0, 720.0)
    noon_hours = compute_sun_hours(scene, noon)
    assert noon_hours.hours[60, 110] == pytest.approx(2.0, abs=1e-4)  # clear of the wall throughout
    assert (noon_hours.first[60, 110], noon_hours.last[60, 110]) == (600.0, 720.0)
    high_sun_hours = compute_sun_hours(scene, window_of(scene, SPRING), min_altitude_deg=20.0)
    high_sun_minutes = minutes[altitude > 20.0]
    assert high_sun_hours.last[60, 40] == pytest.approx(high_sun_minutes[-1], abs=0.2)
    assert high_sun_hours.hours.max() * 60.0 == pytest.approx(high_sun_minutes[-1] - high_sun_minutes[0], abs=0.4)
    convergence_deg = grid_north_deg(scene)
    sun_across_wall = np.sin(np.radians(azimuth - convergence_deg))
    clears_wall = (
        (altitude > 0.0) & (np.tan(np.radians(altitude)) * 200.0 > (80.0 - 30.0) * sun_across_wall) & (sun_across_wall > 0.0)
    )
    raised_hours = compute_sun_hours(scene, window_of(scene, SPRING), height_m=30.0)
    assert raised_hours.first[60, 40] == pytest.approx(minutes[clears_wall][0], abs=0.5)


def test_sun_hours_over_dates_average_hours_and_count_days(open_scene):
    heights = np.zeros((61, 61))
    heights[:, 30] = 60.0
    scene = open_scene(heights)
    windows = [window_of(scene, day) for day in (SPRING, SUMMER, WINTER)]
    daily_results = [compute_sun_hours(scene, window, step_minutes=30.0, threshold_h=9.0) for window in windows]
    combined = compute_sun_hours(scene, *windows, step_minutes=30.0, threshold_h=9.0)
    np.testing.assert_allclose(combined.hours, np.mean([daily_result.hours for daily_result in daily_results], axis=0), atol=1e-4)
    np.testing.assert_array_equal(combined.days, np.sum([daily_result.days for daily_result in daily_results], axis=0))
    assert set(np.unique(combined.days)) >= {1.0, 2.0}
    np.testing.assert_array_equal(combined.first, np.nanmin([daily_result.first for daily_result in daily_results], axis=0))
    np.testing.assert_array_equal(combined.longest, np.max([daily_result.longest for daily_result in daily_results], axis=0))


def test_sun_hours_follow_the_clock_and_23_hour_days(open_scene):
    scene = open_scene(np.zeros((21, 21)))
    before, after = (
        compute_sun_hours(scene, window_of(scene, date(2024, 3, day), ZoneInfo("Europe/Oslo")), step_minutes=30.0)
        for day in (30, 31)
    )
    assert after.first[10, 10] - before.first[10, 10] == pytest.approx(
        58.0, abs=1.0
    )  # an hour later by the clock, less a day's change of sunrise
    assert after.hours[10, 10] == pytest.approx(before.hours[10, 10] + 3.4 / 60.0, abs=0.02)
    solar_clock_day = compute_sun_hours(scene, window_of(scene, date(2024, 11, 3), SOLAR), step_minutes=30.0)
    assert solar_clock_day.first[10, 10] + solar_clock_day.last[10, 10] == pytest.approx(
        1440.0, abs=1.0
    )  # noon is midway between first and last sun


def test_sun_hours_of_a_wide_raster_have_local_sunrise(open_scene):
    scene = open_scene(np.zeros((20, 70)), cell=2000.0)
    result = compute_sun_hours(scene, window_of(scene, SPRING), step_minutes=15.0)
    start, minutes = datetime(2024, 3, 21, tzinfo=UTC), np.arange(0.0, 1440.0, 0.25)
    to_degrees = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform
    for col in (2, 35, 67):
        lon, lat = to_degrees(EAST + (col + 0.5) * 2000.0, NORTH - 10.5 * 2000.0)
        sunlit_minutes = minutes[sun_path([start + timedelta(minutes=float(m)) for m in minutes], lon, lat).altitude_deg > 0.0]
        assert result.first[10, col] == pytest.approx(sunlit_minutes[0], abs=2.0)  # refraction lifts the sun at the middle only
        assert result.last[10, col] == pytest.approx(sunlit_minutes[-1], abs=3.5)
    assert result.first[10, 2] - result.first[10, 67] > 6.0  # 1.7 degrees of longitude


def test_sun_hours_keep_nodata(open_scene):
    heights = np.zeros((40, 50))
    heights[10:20, 30:35] = np.nan
    scene = open_scene(heights)
    result = compute_sun_hours(scene, window_of(scene, SPRING), step_minutes=30.0)
    for values in (result.hours, result.longest, result.days):
        np.testing.assert_array_equal(np.isnan(values), np.isnan(heights))


def test_sun_hours_match_rays_over_fractal_mountains(open_scene):
    scene = open_scene(fractal_heights_m(128), cell=30.0)
    view, window = raster_cell_view(scene), window_of(scene, SPRING)
    row, col = (np.random.default_rng(2).integers(3, 125, 300) for _ in range(2))
    (day,) = window_suns(scene.world, [window])
    hours, first, last = ray_truth(scene, view, row, col, day, step_min=0.5)
    result = compute_sun_hours(scene, window, step_minutes=2.0)
    error_minutes = 60.0 * np.abs(result.hours[row, col] - hours)
    assert error_minutes.mean() < 0.5 and np.percentile(error_minutes, 99) < 3.0
    for computed, expected in ((result.first, first), (result.last, last)):
        assert np.nanpercentile(np.abs(computed[row, col] - expected), 90) < 1.0  # a missed glance of sun shifts it by hours


def test_sun_hours_locate_crossings_between_steps(open_scene):
    scene = open_scene(fractal_heights_m(128), cell=30.0)
    noon = window_of(scene, SPRING, UTC, 600.0, 800.0)
    fine_hours, coarse_hours = (compute_sun_hours(scene, noon, step_minutes=step).hours for step in (1.0, 5.0))
    difference_min = 60.0 * np.abs(coarse_hours - fine_hours)[3:-3, 3:-3]
    assert (difference_min > 0.0).mean() > 0.1 and difference_min[
        difference_min > 0.0
    ].mean() < 0.7  # counting whole frames would give 1.25 for each crossing


def test_sun_spans_sample_sunrise_and_sunset(open_scene):
    scene = open_scene(np.zeros((10, 10)))
    (day,) = window_suns(scene.world, [window_of(scene, SPRING)])
    (span,) = sun_spans(day, raster_cell_view(scene), scene.world, 0.0, 15.0)
    minutes, _, altitude = sun_by_minute(scene, SPRING)
    sunlit_minutes = minutes[altitude > 0.0]
    assert span.samples_minutes[0] == pytest.approx(sunlit_minutes[0], abs=0.2) and span.samples_minutes[-1] == pytest.approx(
        sunlit_minutes[-1], abs=0.2
    )
    assert (span.samples_minutes[1:-1] % 15.0 == 0.0).all()
    assert not sun_spans(day, raster_cell_view(scene), scene.world, 80.0, 15.0)


def test_window_suns_refuse_a_flat_world(open_scene):
    scene = open_scene(np.zeros((10, 10)), ENGINEERING, 0.0, 0.0)
    with pytest.raises(Exception, match="date: '2024-03-21' is not supported here: an engineering CRS"):
        window_suns(scene.world, [window_of(scene, SPRING)])
