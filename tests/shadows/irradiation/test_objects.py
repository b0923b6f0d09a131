"""Irradiation with buildings and trees: roofs, the shadow of a house, and what trees let through."""

from __future__ import annotations

from datetime import date

import numpy as np
import pytest
from pyproj import Transformer

import skugga
from skugga.api.raster_view import raster_view
from skugga.shadows.irradiation.dates import all_dates
from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
from skugga.shadows.irradiation.light import clear_sky_light
from skugga.shadows.irradiation.planes import TiltedPlane
from skugga.shadows.irradiation.suns import sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import windows_between

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

HOUSE = (80.0, 100.0, 90.0, 110.0, 10.0)
"""West, east, south and north side of the house, metres from the raster's corner, and its height."""

OPEN, ROOF, NORTH_OF_HOUSE = (20, 20), (100, 90), (83, 90)
"""Rows and columns of cells: far from all objects, on the roof, and 6 m north of the house."""


def sums(level, rules: IrradiationRules, day=date(2023, 3, 21), last=None) -> np.ndarray:
    """Return the irradiation of the cells of a level over dates, (rows, cols), kWh/m2, of the first part."""
    scene = level._scene
    dates = all_dates(windows_between(scene.world, day, last or day, 1, (0.0, 1440.0), SOLAR))
    return irradiation(scene, raster_view(scene).view.with_pixels_as_nodes(), dates, rules)[0]


def sees_past_box(x: float, y: float, towards: np.ndarray, grown_m: float) -> np.ndarray:
    """Return which directions (n, 3) from a point on the ground miss the house, grown on each side."""
    west, east, south, north, top = HOUSE
    low = np.array([west - grown_m, south - grown_m, -1.0]) - (x, y, 0.0)
    high = np.array([east + grown_m, north + grown_m, top + grown_m]) - (x, y, 0.0)
    ends = np.sort(np.stack([low / towards, high / towards]), axis=0)
    return ends[0].max(axis=1) > ends[1].min(axis=1)


def test_a_cell_north_of_a_house_has_the_beam_that_geometry_says(level_with_objects):
    """The beam of the suns whose rays miss the box; its walls lie within a cell."""
    scene, row_col = level_with_objects._scene, NORTH_OF_HOUSE
    values = sums(level_with_objects, IrradiationRules(("beam",), "level"))
    view = raster_view(scene).view
    lon, lat = scene.world.lon_lat(view.grid.crs, view.grid.x(view.centre_node[1]), view.grid.y(view.centre_node[0]))
    day = windows_between(scene.world, date(2023, 3, 21), date(2023, 3, 21), 1, (0.0, 1440.0), SOLAR)
    suns = sun_intervals(day, 60.0, float(lon), float(lat))
    light = clear_sky_light(suns, float(lon), float(lat), np.array([100.0]), None).beam[0]
    azimuth, altitude = np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg)
    towards = np.stack([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)], axis=1)
    power = light * np.sin(altitude) * suns.hours / 1000.0
    x, y = row_col[1] + 0.5, 200.0 - row_col[0] - 0.5
    low, high = (float(power[sees_past_box(x, y, towards, grown)].sum()) for grown in (1.0, -1.0))
    assert low - 1e-3 <= values[row_col] <= high + 1e-3
    assert high < 0.75 * values[OPEN], "the house takes its hours around noon"


def test_a_roof_is_open_ground(level_with_objects):
    for plane in ("ground", "level", TiltedPlane(35.0)):
        values = sums(level_with_objects, IrradiationRules(("total",), plane))
        assert values[ROOF] == pytest.approx(values[OPEN], rel=6e-3)


def test_a_wall_that_faces_the_house_loses_more_than_one_that_faces_away(level_with_objects):
    south, north = (
        sums(level_with_objects, IrradiationRules(("sky",), TiltedPlane(90.0, a)))[NORTH_OF_HOUSE] for a in (180.0, 0.0)
    )
    assert south < 0.75 * north


def test_trees_let_their_share_through(level_with_objects):
    opaque, half, clear = (
        sums(level_with_objects, IrradiationRules(("total",), "level", transmissivity=share)) for share in (0.0, 0.5, 1.0)
    )
    in_wood = slice(60, 140), slice(145, 175)
    assert np.median(opaque[in_wood]) == 0.0
    np.testing.assert_allclose(clear[in_wood], clear[OPEN], rtol=0.03)
    np.testing.assert_allclose(half, 0.5 * (opaque + clear), rtol=1e-4, atol=1e-4)
    shaded_by_wood = 100, 136
    assert opaque[shaded_by_wood] < 0.9 * clear[shaded_by_wood]


@pytest.mark.long
def test_far_mountains_shade_a_village_as_they_shade_bare_ground():
    """Cells so small that far ground is coarser: behind the cells it casts no shadow, towards the sun it does."""
    x, y = Transformer.from_crs(4326, 32616, always_xy=True).transform(-84.1584, 36.2273)
    beam = []
    for name, transmissivity in (("jacksboro", 0.0), ("jacksboro_wooded", 1.0)):
        with skugga.open_level(name) as level:
            values = level.irradiation(
                "2023-12-21", part="beam", plane="level", bounds=(x - 40.0, y - 40.0, x + 40.0, y + 40.0), crs="EPSG:32616",
                resolution=0.7, transmissivity=transmissivity,
            )  # fmt: skip
        beam.append(np.nanpercentile(values, 90.0))
    assert beam[1] == pytest.approx(beam[0], rel=0.02) and beam[0] > 1.5


def test_reflected_light_under_trees_is_that_of_points(level_with_objects):
    """Under the crowns of a deep wood the ground sends next to nothing. Far from it, it is what pvlib says."""
    level, plane = level_with_objects, TiltedPlane(60.0, 180.0)
    raster = sums(level, IrradiationRules(("reflected",), plane))
    grid = raster_view(level._scene).view.grid

    def at_point(row: int, col: int) -> float:
        """Return the reflected light at the middle of a cell, kWh/m2."""
        place = float(grid.x(col)), float(grid.y(row))
        report = level.point_irradiation(*place, date="2023-03-21", tilt=60.0, crs=level._scene.elevation.crs, step_min=60.0)
        return report.all_months.reflected

    open_ground = at_point(*OPEN)
    assert open_ground > 0.2 and raster[OPEN] == pytest.approx(open_ground, rel=0.03)
    in_wood = [(row, col) for row in (80, 100, 120) for col in (155, 160, 165)]
    assert np.median([raster[cell] for cell in in_wood]) == 0.0
    assert np.median([at_point(*cell) for cell in in_wood]) < 0.06 * open_ground
    before_the_wood = 100, 130
    assert at_point(*before_the_wood) == pytest.approx(raster[before_the_wood], rel=0.1)
    assert 0.5 * open_ground < raster[before_the_wood]
