"""Irradiation: open planes against pvlib, walls against hours of sun, polar night, heights, and sums of parts."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pandas
import pytest
from pvlib import irradiance, location
from pyproj import Transformer

from benchmarks.sweep_speed import fractal_heights_m
from skugga.shadows.horizons.azimuths import evenly_spaced_azimuths_deg
from skugga.shadows.horizons.grid import grid_of_array
from skugga.shadows.horizons.sky_view import ground_slopes
from skugga.shadows.irradiation.dates import all_dates
from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
from skugga.shadows.irradiation.light import Part, weather_light
from skugga.shadows.irradiation.planes import TiltedPlane, normals_of_slopes
from skugga.shadows.irradiation.sky import sky_of_grid
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.shadows.irradiation.weather_records import Weather
from skugga.shadows.sun_hours.sun_hours import SunRules, sun_hours
from skugga.shadows.sun_hours.suns import window_suns
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import DailyWindow, windows_between
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

SceneOpener = Callable[..., Scene]

CELL_M, SIDE = 10.0, 31
GROUND_CELL_M = CELL_M / 0.9996  # a cell on the ground, on the meridian of a zone of UTM
MERIDIAN_EAST = 500e3
SPRING, WINTER = date(2024, 3, 21), date(2024, 12, 21)
PLACES = {"equator": ("EPSG:32632", 30e3), "alps": ("EPSG:32632", 5_200e3), "patagonia": ("EPSG:32718", 4_700e3)}
PLANES = [(5, 180), (20, 90), (30, 200), (30, 340), (45, 135), (60, 270), (75, 10)]
PARTS: tuple[Part, ...] = get_args(Part)


@pytest.fixture
def open_scene(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols), centred on the zone's meridian. Scenes are closed afterwards."""
    scenes = []

    def make(heights: np.ndarray, crs: str = "EPSG:32632", north: float = 5_200e3, cell: float = CELL_M) -> Scene:
        left = MERIDIAN_EAST - cell * heights.shape[1] / 2.0
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), crs, left, north, cell)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def cells_of(scene: Scene) -> MapView:
    """Return the map of a raster with one pixel per cell."""
    elevation = scene.elevation
    (x0, x1), (y0, _) = elevation.xy(np.array([0.0, 1.0]), np.array([0.0, 1.0]))
    return MapView(Grid(elevation.crs, float(x0), float(y0), float(x1 - x0)), 0.0, 0.0, 1.0, 1.0, elevation.rows, elevation.cols)


def days_of(scene: Scene, first: date = SPRING, last: date | None = None, every: int = 1) -> list[DailyWindow]:
    """Return whole days from ``first`` to ``last``."""
    return windows_between(scene.world, first, last or first, every, (0.0, 1440.0), SOLAR)


def sums(scene: Scene, view: MapView, days: list[DailyWindow], part: Part = "total", **rules: Any) -> np.ndarray:
    """Return the irradiation of a part over all days together, (rows, cols), kWh/m2."""
    (values,) = irradiation(scene, view, all_dates(days), IrradiationRules((part,), **rules))
    return values


def plane_heights(tilt_deg: float, azimuth_deg: float) -> np.ndarray:
    """Return the heights of a plane that falls towards an azimuth, with its middle at 500 m."""
    row, col = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2.0
    fall = col * np.sin(np.radians(azimuth_deg)) - row * np.cos(np.radians(azimuth_deg))
    return 500.0 - np.tan(np.radians(tilt_deg)) * GROUND_CELL_M * fall


def suns_of(scene: Scene, days: list[DailyWindow], step_min: float = 60.0) -> tuple[SunIntervals, float, float]:
    """Return the suns at the middle of a scene, and its longitude and latitude."""
    view = cells_of(scene)
    row, col = view.centre_node
    lon, lat = scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row))
    return sun_intervals(days, step_min, float(lon), float(lat)), float(lon), float(lat)


def pvlib_parts(
    scene: Scene, days: list[DailyWindow], tilt_deg: float, azimuth_deg: float, height_m: float, step_min: float = 60.0
) -> dict[Part, float]:
    """Return the irradiation of an open plane at the middle of a scene by pvlib alone, kWh/m2, by part."""
    suns, lon, lat = suns_of(scene, days, step_min)
    times = pandas.DatetimeIndex(suns.moments.astype("datetime64[ns]"), tz="UTC")
    zenith = pandas.Series(90.0 - suns.altitude_deg, times)
    azimuth = pandas.Series(suns.azimuth_deg, times)
    position = pandas.DataFrame(
        {"apparent_zenith": zenith, "zenith": zenith, "azimuth": azimuth, "apparent_elevation": 90.0 - zenith}
    )
    sky = location.Location(lat, lon, altitude=height_m).get_clearsky(times, solar_position=position)
    extra = irradiance.get_extra_radiation(times)
    total = irradiance.get_total_irradiance(
        tilt_deg,
        azimuth_deg,
        zenith,
        azimuth,
        sky["dni"],
        sky["ghi"],
        sky["dhi"],
        dni_extra=extra,
        albedo=0.2,
        model="perez-driesse",
    )
    diffuse = irradiance.perez_driesse(
        tilt_deg, azimuth_deg, sky["dhi"], sky["dni"], extra, zenith, azimuth, return_components=True
    )
    power: dict[Part, pandas.Series] = {
        "total": total["poa_global"], "beam": total["poa_direct"], "reflected": total["poa_ground_diffuse"],
        "circumsolar": diffuse["poa_circumsolar"], "sky": diffuse["poa_isotropic"], "horizon_band": diffuse["poa_horizon"],
    }  # fmt: skip
    return {part: float(values.to_numpy() @ suns.hours) / 1000.0 for part, values in power.items()}


def middle(values: np.ndarray) -> float:
    """Return the value of the middle cell."""
    return float(values[values.shape[0] // 2, values.shape[1] // 2])


@pytest.mark.parametrize("place", PLACES)
def test_open_level_ground_receives_what_pvlib_says(open_scene, place):
    crs, north = PLACES[place]
    scene = open_scene(np.full((SIDE, SIDE), 500.0), crs, north)
    days = days_of(scene, SPRING, WINTER, 55)
    expected = pvlib_parts(scene, days, 0.0, 180.0, 500.0)
    for plane in ("ground", "level"):
        for part in PARTS:
            values = sums(scene, cells_of(scene), days, part, plane=plane)
            assert middle(values) == pytest.approx(expected[part], rel=1e-3, abs=1e-4), part
            assert np.ptp(values) < 1e-3 * expected["total"]


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(("tilt_deg", "azimuth_deg"), PLANES)
def test_open_slopes_receive_what_pvlib_says(open_scene, place, tilt_deg, azimuth_deg):
    """Every part is right to a thousandth, also where a slope turns from the sun for a part of the day."""
    crs, north = PLACES[place]
    scene = open_scene(plane_heights(tilt_deg, azimuth_deg), crs, north)
    days = days_of(scene, SPRING, WINTER, 55)
    expected = pvlib_parts(scene, days, tilt_deg, azimuth_deg, 500.0)
    for part in PARTS if tilt_deg in (30, 75) else ("total",):
        value = middle(sums(scene, cells_of(scene), days, part))
        assert value == pytest.approx(expected[part], rel=1e-3, abs=1e-4), part


@pytest.mark.parametrize("tilt_deg", [120.0, 165.0, 175.0])
def test_overhangs_under_an_overcast_sky_receive_what_pvlib_says(open_scene, tilt_deg):
    """There the band at the horizon takes more than the sky gives to planes that nearly face down, and pvlib stops at 0."""
    scene = open_scene(np.full((SIDE, SIDE), 500.0))
    view = cells_of(scene)
    row, col = view.centre_node
    lon, lat = (float(axis) for axis in scene.world.lon_lat(view.grid.crs, view.grid.x(col), view.grid.y(row)))
    day = [DailyWindow(SPRING, datetime(2024, 3, 21, 9, tzinfo=UTC), 240.0, 0.0)]
    hours = np.arange("2024-03-21T08", "2024-03-21T16", dtype="datetime64[h]").astype("datetime64[us]")
    dark, grey = np.zeros(len(hours)), np.full(len(hours), 200.0)
    weather = Weather("overcast", hours, np.full(len(hours), 60.0), grey, dark, grey)
    suns, _ = weather_light(weather, day, lon, lat)
    assert suns.hours.tolist() == [1.0] * 4
    extra = irradiance.get_extra_radiation(pandas.DatetimeIndex(suns.moments, tz="UTC"))
    zenith, azimuth = 90.0 - suns.altitude_deg, suns.azimuth_deg
    diffuse = irradiance.perez_driesse(tilt_deg, 180.0, grey[:4], dark[:4], extra, zenith, azimuth, return_components=True)
    expected = float(np.sum(diffuse["poa_sky_diffuse"])) / 1000.0
    unlimited = float(sum(np.sum(diffuse[f"poa_{part}"]) for part in ("isotropic", "circumsolar", "horizon"))) / 1000.0
    assert unlimited < -1e-3 if tilt_deg > 150.0 else unlimited == pytest.approx(expected)
    rules = IrradiationRules(("sky", "circumsolar", "horizon_band"), TiltedPlane(tilt_deg))
    received = irradiation(scene, view, all_dates(day), rules, weather=weather)
    assert middle(received.sum(axis=0)) == pytest.approx(expected, rel=1e-3, abs=2e-5)


def test_parts_add_up_to_the_total(open_scene):
    scene = open_scene(fractal_heights_m(60), cell=30.0)
    view, days = cells_of(scene), days_of(scene)
    values = {part: sums(scene, view, days, part) for part in PARTS}
    total = values.pop("total")
    np.testing.assert_allclose(sum(values.values()), total, rtol=1e-5)
    assert values["beam"].min() < 0.5 * values["beam"].max(), "terrain shades some cells"


def test_a_wall_takes_the_hours_that_hours_of_sun_say(open_scene):
    """South of the cells runs a wall, and the light of each hour is there or not as its sun is."""
    heights = np.zeros((40, 61))
    heights[30, 23:38] = 60.0
    scene = open_scene(heights)
    view, cell = cells_of(scene), (18, 30)
    (day,) = days_of(scene, WINTER)
    open_beam = pvlib_parts_by_hour(scene, day)
    seen, hidden = 0, 0
    for hour, expected in open_beam.items():
        (window,) = windows_between(scene.world, WINTER, WINTER, 1, (60.0 * hour, 60.0 * hour + 60.0), SOLAR)
        value = float(sums(scene, view, [window], "beam", plane="level")[cell])
        (sun,) = window_suns(scene.world, [window])
        hours = float(sun_hours(scene, view, [sun], SunRules(step_minutes=2.0), no_plan).hours[cell])
        if hours > 0.999:
            assert value == pytest.approx(expected, rel=1e-3)
            seen += 1
        elif hours < 0.001:
            assert value == 0.0
            hidden += 1
        else:
            assert value == 0.0 or value == pytest.approx(expected, rel=1e-3)
    assert seen >= 2 and hidden >= 3


def no_plan(_: Scene):
    """Fail: bare ground needs no plan."""
    raise AssertionError


def pvlib_parts_by_hour(scene: Scene, day: DailyWindow) -> dict[int, float]:
    """Return direct sunlight on open level ground in the hours between sunrise and sunset of a day, by solar hour, kWh/m2."""
    hours = range(8, 16)
    windows = {
        hour: windows_between(scene.world, day.date, day.date, 1, (60.0 * hour, 60.0 * hour + 60.0), SOLAR) for hour in hours
    }
    return {hour: pvlib_parts(scene, window, 0.0, 180.0, 0.0)["beam"] for hour, window in windows.items()}


def test_polar_night_is_dark(open_scene):
    scene = open_scene(fractal_heights_m(30), "EPSG:32633", 8_700e3, cell=30.0)
    for part in PARTS:
        values = sums(scene, cells_of(scene), days_of(scene, WINTER), part)
        np.testing.assert_array_equal(values, 0.0)


def test_light_grows_with_the_height_of_the_ground(open_scene):
    """Level planes on a slope from 0 to 3000 m have the light of their own heights, by pvlib."""
    heights = np.repeat(np.linspace(3000.0, 0.0, 61)[:, None], 21, axis=1)
    scene = open_scene(heights, cell=100.0)
    days = days_of(scene)
    values = sums(scene, cells_of(scene), days, plane="level")
    beam, sky = (sums(scene, cells_of(scene), days, part, plane="level") for part in ("beam", "sky"))
    for height_m in (850.0, 1500.0, 2250.0):
        row = int(np.flatnonzero(heights[:, 0] == height_m)[0])
        expected = pvlib_parts(scene, days, 0.0, 180.0, height_m)
        assert beam[row, 10] == pytest.approx(expected["beam"], rel=1e-3)
        assert sky[row, 10] < expected["sky"] < 1.1 * sky[row, 10], "the slope above hides some of the sky"
    assert values[5, 10] > 1.02 * values[-5, 10]


def test_cells_without_ground_have_no_value(open_scene):
    heights = np.full((SIDE, SIDE), 100.0)
    heights[4:7, 8:12] = np.nan
    scene = open_scene(heights)
    values = sums(scene, cells_of(scene), days_of(scene))
    np.testing.assert_array_equal(np.isnan(values), np.isnan(heights))


def test_days_are_reported(open_scene):
    scene = open_scene(np.zeros((9, 9)))
    for part in ("total", "sky"):
        calls: list[int] = []
        days = days_of(scene, SPRING, SPRING + timedelta(days=4))
        irradiation(scene, cells_of(scene), all_dates(days), IrradiationRules((part,)), lambda seen=calls: seen.append(1))
        assert len(calls) == len(days)


def test_a_ring_of_mountains_hides_the_horizons_band():
    """The floor's slope sees the band of an open horizon, and none of it behind walls of ten degrees."""
    row, col = np.mgrid[:81, :81] - 40.0
    floor = -0.1 * 10.0 * row
    distance_m = 10.0 * np.hypot(row, col)
    ring = floor + np.where(distance_m > 300.0, 120.0, 0.0)
    factors = []
    for heights in (floor, ring):
        grid = grid_of_array(heights.astype(np.float32), (10.0, 10.0))
        factors.append(float(sky_of_grid(grid, normals_of_slopes(*ground_slopes(grid)))[1][40, 40]))
    assert factors[0] == pytest.approx(np.sin(np.arctan(0.1)), rel=1e-3)
    assert factors[1] == 0.0
    assert len(evenly_spaced_azimuths_deg(72)) == 72


@pytest.mark.parametrize("place", PLACES)
def test_the_suns_of_a_day_last_as_long_as_its_daylight(open_scene, place):
    """Intervals of an hour cover the time between sunrise and sunset, and their light differs little from that of minutes."""
    crs, north = PLACES[place]
    scene = open_scene(np.zeros((SIDE, SIDE)), crs, north)
    days = days_of(scene)
    suns, _, _ = suns_of(scene, days)
    of_minutes, _, _ = suns_of(scene, days, 1.0)
    assert suns.hours.sum() == pytest.approx(of_minutes.hours.sum(), abs=20.0 / 3600.0)
    assert suns.hours.max() == pytest.approx(1.0, abs=1e-3) and len(suns) in (12, 13, 14)
    hourly, by_minute = (pvlib_parts(scene, days, 0.0, 180.0, 0.0, step)["total"] for step in (60.0, 1.0))
    assert hourly == pytest.approx(by_minute, rel=5e-3)


def test_the_place_of_a_scene_is_its_middle(open_scene):
    scene = open_scene(np.zeros((SIDE, SIDE)))
    _, lon, lat = suns_of(scene, days_of(scene))
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(lon, lat)
    assert (x, y) == pytest.approx((MERIDIAN_EAST, 5_200e3 - CELL_M * SIDE / 2.0), abs=0.01)
