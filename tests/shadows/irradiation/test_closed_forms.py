"""Irradiation without air against closed forms: a day at the equator and at the pole, and the ground round a box."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from benchmarks.irradiation.constant_light import BEAM_W_M2, without_air
from benchmarks.irradiation.hill_raster import lon_lat_of_middle, view_of_cells
from skugga.shadows.irradiation.dates import all_dates
from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import windows_between
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import write_geotiff

SceneOpener = Callable[..., Scene]

CELL_M, SIDE = 10.0, 21
EQUINOX, SUMMER, WINTER = date(2023, 3, 21), date(2023, 6, 21), date(2023, 12, 21)

DECLINATION_DEG = {EQUINOX: 0.23, SUMMER: 23.44, WINTER: -23.44}
"""Declination of the sun at noon UTC, by almanacs."""

BOX_HEIGHT_M, BOX_ROWS, BOX_COLS = 30.0, slice(30, 41), slice(20, 41)
"""Height, rows and columns of a box in a plain."""

EDGE_DEG = 0.05
"""A sun that stands closer to the edge of the box may be hidden or not."""


@pytest.fixture
def open_scene(tmp_path: Path):
    """A function that returns the scene of heights (rows, cols) in a CRS, with their middle at (x, y)."""
    scenes = []

    def make(heights: np.ndarray, crs: str, x: float, y: float, cell_m: float = CELL_M) -> Scene:
        left, top = x - cell_m * heights.shape[1] / 2.0, y + cell_m * heights.shape[0] / 2.0
        path = write_geotiff(tmp_path / f"{len(scenes)}.tif", heights.astype(np.float32), crs, left, top, cell_m)
        scenes.append(build_scene(load_level(path)))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def beam_of_day(scene: Scene, day: date, step_minutes: float, plane: str = "ground") -> tuple[np.ndarray, SunIntervals]:
    """Return the irradiation of a day without air, kWh/m2 (rows, cols), and its suns at the middle of the scene."""
    windows = windows_between(scene.world, day, day, 1, (0.0, 1440.0), SOLAR)
    with without_air():
        values = irradiation(
            scene, view_of_cells(scene), all_dates(windows), IrradiationRules(("beam",), plane, step_minutes=step_minutes)
        )[0]
    return values, sun_intervals(windows, step_minutes, *lon_lat_of_middle(scene))


def refraction_deg(altitude_deg: np.ndarray) -> np.ndarray:
    """Return refraction at altitudes without refraction, degrees (T. Saemundsson 1986); 0 well below the horizon."""
    angle = np.radians(altitude_deg + 10.3 / (altitude_deg + 5.11))
    return np.where(altitude_deg > -0.6, 1.02 / np.tan(angle) / 60.0 * 1.01325 / 1.01 * 283.0 / 285.0, 0.0)


def daily_beam_kwh(lat_deg: float, declination_deg: float, tilt_deg: float = 0.0, azimuth_deg: float = 180.0) -> float:
    """Return the beam of a day without air on an open plane, kWh/m2, by quadrature over the hour angle, with refraction."""
    lat, declination = np.radians([lat_deg, declination_deg])
    hour = np.linspace(-np.pi, np.pi, 86_401)[:-1]
    up = np.sin(lat) * np.sin(declination) + np.cos(lat) * np.cos(declination) * np.cos(hour)
    west = np.cos(declination) * np.sin(hour)
    north = np.cos(lat) * np.sin(declination) - np.sin(lat) * np.cos(declination) * np.cos(hour)
    altitude = np.arcsin(up)
    apparent = altitude + np.radians(refraction_deg(np.degrees(altitude)))
    level = np.cos(apparent) / np.maximum(np.hypot(west, north), 1e-12)
    tilt, azimuth = np.radians([tilt_deg, azimuth_deg])
    cosine = np.sin(apparent) * np.cos(tilt) + np.sin(tilt) * level * (north * np.cos(azimuth) - west * np.sin(azimuth))
    return float(np.where(apparent > 0.0, np.maximum(cosine, 0.0), 0.0).mean() * 24.0 * BEAM_W_M2 / 1000.0)


@pytest.mark.parametrize("day", [EQUINOX, SUMMER, WINTER])
def test_a_day_at_the_equator_has_its_closed_form(open_scene: SceneOpener, day: date):
    """Without refraction it is 24/pi cos(declination) kWh/m2; refraction adds a thousandth."""
    scene = open_scene(np.zeros((SIDE, SIDE)), "EPSG:32632", 500e3, 0.0)
    values, _ = beam_of_day(scene, day, 5.0, "level")
    without_refraction = 24.0 / np.pi * np.cos(np.radians(DECLINATION_DEG[day]))
    assert values == pytest.approx(daily_beam_kwh(0.0, DECLINATION_DEG[day]), rel=5e-4)
    assert values == pytest.approx(without_refraction, rel=3e-3)


def test_a_day_at_the_pole_has_its_closed_form(open_scene: SceneOpener):
    """The sun of midsummer circles at the altitude of its declination, and shines for 24 hours."""
    scene = open_scene(np.zeros((SIDE, SIDE)), "EPSG:3413", 0.0, 0.0)
    altitude_deg = DECLINATION_DEG[SUMMER] + float(refraction_deg(np.array(DECLINATION_DEG[SUMMER])))
    values, suns = beam_of_day(scene, SUMMER, 60.0, "level")
    assert suns.hours.sum() == pytest.approx(24.0, abs=0.01)
    assert values == pytest.approx(24.0 * np.sin(np.radians(altitude_deg)), rel=5e-4)
    night, _ = beam_of_day(scene, WINTER, 60.0, "level")
    assert np.all(night == 0.0)


@pytest.mark.parametrize("azimuth", [0.0, 77.0, 180.0])
def test_slopes_at_the_pole_have_a_closed_form(open_scene: SceneOpener, azimuth: float):
    """All slopes of a tilt receive the same there, wherever they fall to."""
    row, col = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2.0
    tilt_deg, scale = 40.0, 0.97
    fall = col * np.sin(np.radians(azimuth)) - row * np.cos(np.radians(azimuth))
    scene = open_scene(500.0 - np.tan(np.radians(tilt_deg)) * CELL_M * fall, "EPSG:3413", 0.0, 0.0, CELL_M * scale)
    expected = daily_beam_kwh(90.0, DECLINATION_DEG[SUMMER], tilt_deg)
    values, _ = beam_of_day(scene, SUMMER, 5.0)
    assert values[SIDE // 2, SIDE // 2] == pytest.approx(expected, rel=2e-3)


@pytest.fixture
def box_scene(open_scene: SceneOpener) -> Scene:
    heights = np.zeros((61, 61))
    heights[BOX_ROWS, BOX_COLS] = BOX_HEIGHT_M
    return open_scene(heights, "EPSG:32632", 500e3, 5_200e3, CELL_M * 0.9996)


def is_before_box(col: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return whether (fractional) columns are those of the box, which is made wider by a margin in columns on each side."""
    return (col >= BOX_COLS.start - margin) & (col <= BOX_COLS.stop - 1 + margin)


@pytest.mark.parametrize("day", [EQUINOX, SUMMER, WINTER])
def test_the_north_side_of_a_box_has_the_beam_of_geometry(box_scene: Scene, day: date):
    """North of a box a sun is hidden if its altitude is below the edge, and its azimuth leads to the box."""
    values, suns = beam_of_day(box_scene, day, 15.0, "level")
    rows, cols = np.mgrid[BOX_ROWS.start - 15 : BOX_ROWS.start, BOX_COLS.start + 2 : BOX_COLS.stop - 2]
    north_m = (BOX_ROWS.start - rows) * CELL_M
    azimuth, altitude = np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg)
    least, most = np.zeros(rows.shape), np.zeros(rows.shape)
    for number in range(len(suns)):
        hidden, undecided = np.zeros(rows.shape, bool), np.zeros(rows.shape, bool)
        southward = -np.cos(azimuth[number])
        if southward > 0.0:
            edge = np.arctan(BOX_HEIGHT_M * southward / north_m)
            is_low, is_low_or_near = (altitude[number] < edge + np.radians(side * EDGE_DEG) for side in (-1.0, 1.0))
            # the wall is a cell thick: it begins a cell before the edge
            to_east = np.sin(azimuth[number]) / southward / CELL_M
            at_foot, at_edge = cols + (north_m - CELL_M) * to_east, cols + north_m * to_east
            hidden = is_low & is_before_box(at_foot, -1.05) & is_before_box(at_edge, -1.05)
            undecided = is_low_or_near & (is_before_box(at_foot, 1.05) | is_before_box(at_edge, 1.05)) & ~hidden
        power = np.sin(altitude[number]) * suns.hours[number] * BEAM_W_M2 / 1000.0
        least += np.where(hidden | undecided, 0.0, power)
        most += np.where(hidden, 0.0, power)
    found = values[rows, cols]
    assert np.all(found >= 0.999 * least - 1e-3) and np.all(found <= 1.001 * most + 1e-3)
    assert np.median(most - least) < 0.04 * values[0, 0], "few suns are undecided"
    assert most.min() < (0.98 if day == SUMMER else 0.6) * values[0, 0], "the box hides suns"


@pytest.mark.parametrize("day", [EQUINOX, SUMMER, WINTER])
def test_the_edge_of_a_box_leans_to_the_north(box_scene: Scene, day: date):
    """The northern edge of the box sees all suns. Its plane falls to the north, and only suns before it count."""
    values, suns = beam_of_day(box_scene, day, 15.0)
    tilt = np.arctan(BOX_HEIGHT_M / (2.0 * CELL_M))
    azimuth, altitude = np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg)
    cosine = np.sin(altitude) * np.cos(tilt) + np.cos(altitude) * np.sin(tilt) * np.cos(azimuth)
    expected = float(np.maximum(cosine, 0.0) @ suns.hours) * BEAM_W_M2 / 1000.0
    assert values[BOX_ROWS.start, 30] == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert day != SUMMER or expected > 1.0
    assert day != WINTER or expected == 0.0
