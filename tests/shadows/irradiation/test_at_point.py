"""Irradiation at a point: open planes against pvlib, walls against geometry, losses by cause, the pole and the equator."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from pyproj import Transformer

from benchmarks.sweep_speed import fractal_heights_m
from skugga.shadows.irradiation.at_point import PARTS, PointIrradiation, irradiation_at_point
from skugga.shadows.irradiation.dates import all_dates
from skugga.shadows.irradiation.ground_plane import ground_plane
from skugga.shadows.irradiation.irradiation import IrradiationRules, irradiation
from skugga.shadows.irradiation.light import SkyLight, clear_sky_light
from skugga.shadows.irradiation.planes import TiltedPlane
from skugga.shadows.irradiation.suns import SunIntervals, sun_intervals
from skugga.shadows.point.horizon import Surroundings, horizon_profile, load_surroundings
from skugga.shadows.point.place import place_at
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import DailyWindow, windows_between
from skugga.terrain.scene import Scene
from tests.rasters import write_geotiff
from tests.shadows.irradiation.test_irradiation import PLACES, SPRING, WINTER, cells_of, days_of, pvlib_parts

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

PLANES = [(0, 180), (5, 90), (20, 200), (35, 180), (60, 270), (75, 340), (90, 180), (90, 20), (120, 200), (150, 140)]

CRS, EAST, NORTH, CELL_M, SIDE = "EPSG:32633", 500_000.0, 5_300_000.0, 4.0, 64
MIDDLE = EAST, NORTH - SIDE * CELL_M / 2.0

SceneOf = Callable[..., Scene]


@pytest.fixture
def scene_of(tmp_path: Path, make_scene):
    """Return ``scene_of(heights, houses, trees, crs, north)``: ground whose middle lies on the meridian of its zone.

    A house is (west, south, east, north, height), a tree (east, north, height), in metres from the middle. Scenes are closed
    afterwards.
    """
    scenes = []

    def make(heights=None, houses=(), trees=(), crs: str = CRS, north: float = NORTH, cell_m: float = CELL_M) -> Scene:
        heights = np.zeros((SIDE, SIDE)) if heights is None else heights
        side = len(heights)
        left = 500_000.0 - side * cell_m / 2.0
        write_geotiff(tmp_path / "dem.tif", heights.astype(np.float32), crs, left, north, cell_m)
        degrees = Transformer.from_crs(crs, "OGC:CRS84", always_xy=True)

        def lon_lat(east_m: float, north_m: float) -> list[float]:
            return list(degrees.transform(500_000.0 + east_m, north - side * cell_m / 2.0 + north_m))

        keys = {}
        if houses:
            rings = [[(w, s), (e, s), (e, n), (w, n), (w, s)] for w, s, e, n, _ in houses]
            shapes = [("Polygon", [[lon_lat(*corner) for corner in ring]]) for ring in rings]
            write_geojson(tmp_path / "houses.geojson", shapes, [house[4] for house in houses])
            keys["meshes"] = [{"source": "houses.geojson", "height": "height"}]
        if trees:
            shapes = [("Point", lon_lat(*tree[:2])) for tree in trees]
            write_geojson(tmp_path / "trees.geojson", shapes, [tree[2] for tree in trees])
            keys["forest"] = [{"source": "trees.geojson", "height": "height", "species": "conifer"}]
        scenes.append(make_scene(tmp_path / "dem.tif", **keys))
        return scenes[-1]

    yield make
    for scene in scenes:
        scene.close()


def write_geojson(path: Path, shapes: list[tuple[str, list]], heights_m: list[float]) -> None:
    """Write geometries with heights as a GeoJSON file."""
    features = [
        {"type": "Feature", "properties": {"height": height}, "geometry": {"type": kind, "coordinates": coordinates}}
        for (kind, coordinates), height in zip(shapes, heights_m, strict=True)
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}), encoding="utf-8")


def eye(scene: Scene, east_m: float = 0.0, north_m: float = 0.0, height_m: float = 0.0) -> Surroundings:
    """Return the surroundings of a place in metres from the middle of a raster."""
    x0, y0, x1, y1 = scene.elevation.bounds
    middle = (x0 + x1) / 2.0 + east_m, (y0 + y1) / 2.0 + north_m
    return load_surroundings(scene, place_at(scene, middle, scene.elevation.crs, height_m))


def suns_at(surroundings: Surroundings, days: list[DailyWindow], step_min: float = 60.0) -> SunIntervals:
    """Return the suns of days at a place."""
    place = surroundings.place
    return sun_intervals(days, step_min, place.lon_deg, place.lat_deg)


def light_at(surroundings: Surroundings, suns: SunIntervals, linke: float | None = None) -> SkyLight:
    """Return the light of a clear sky at a place."""
    place = surroundings.place
    return clear_sky_light(suns, place.lon_deg, place.lat_deg, np.array([place.eye_elevation_m]), linke)


def sums_of(surroundings: Surroundings, plane: TiltedPlane, days: list[DailyWindow], albedo: float = 0.2) -> PointIrradiation:
    """Return the irradiation of all days together."""
    suns = suns_at(surroundings, days)
    return irradiation_at_point(surroundings, plane, suns, light_at(surroundings, suns), np.zeros(len(suns), int), 1, albedo)


def sunlight(suns: SunIntervals, power_w_m2: float = 1000.0) -> SkyLight:
    """Return sunlight of constant power in a world without air."""
    dark = np.zeros((1, len(suns)))
    return SkyLight(np.full((1, len(suns)), power_w_m2), dark, dark, dark, dark)


def without_refraction(suns: SunIntervals) -> SunIntervals:
    """Return suns where they are in a world without air."""
    return replace(suns, altitude_deg=suns.altitude_deg - suns.refraction_deg, refraction_deg=np.zeros(len(suns)))


@pytest.mark.parametrize("place", PLACES)
def test_open_planes_receive_what_pvlib_says(scene_of, place):
    """Planes of ten tilts, walls and overhangs among them, receive the total and the parts of pvlib to a thousandth."""
    crs, north = PLACES[place]
    scene = scene_of(np.full((31, 31), 500.0), crs=crs, north=north, cell_m=10.0)
    surroundings, days = eye(scene), days_of(scene, SPRING, WINTER, 55)
    for tilt, azimuth in PLANES:
        expected = pvlib_parts(scene, days, tilt, azimuth, 500.0)
        result = sums_of(surroundings, TiltedPlane(tilt, azimuth), days)
        assert result.received["total"][0] == pytest.approx(expected["total"], rel=1e-3), (tilt, azimuth)
        for part in ("beam", "circumsolar", "sky", "reflected"):
            assert result.received[part][0] == pytest.approx(expected[part], rel=1e-3, abs=1e-4), (tilt, azimuth, part)
        for by_cause in result.lost.values():
            assert all(values[0] == 0.0 for values in by_cause.values())


def test_received_light_and_losses_are_the_open_sky(scene_of):
    """In each month, for planes in a valley with houses and trees, all losses and the light received make the open sky."""
    row, col = np.mgrid[:SIDE, :SIDE]
    valley = np.abs(col - 30.0) * 2.0 + 3.0 * np.sin(row / 5.0)
    scene = scene_of(valley, [(-20, -15, 20, -8, 12.0)], [(-9.0, north_m, 11.0) for north_m in (-4.0, -1.0, 2.0, 5.0)])
    surroundings = eye(scene, height_m=1.5)
    days = days_of(scene, date(2023, 1, 15), date(2023, 12, 15), 30)
    suns = suns_at(surroundings, days)
    month = suns.moments.astype("datetime64[M]").astype(int) % 12
    for plane in (TiltedPlane(0.0, 0.0), TiltedPlane(40.0, 180.0), TiltedPlane(90.0, 300.0), TiltedPlane(130.0, 90.0)):
        result = irradiation_at_point(surroundings, plane, suns, light_at(surroundings, suns), month, 12, 0.3)
        losses = sum(values for by_cause in result.lost.values() for values in by_cause.values())
        np.testing.assert_allclose(result.received["total"] + losses, result.open_sky["total"], rtol=1e-12)
        np.testing.assert_allclose(sum(result.received[part] for part in PARTS), result.received["total"], rtol=1e-12)
        assert result.sky_view <= result.sky_view_of_relief < result.open_sky_view
    level = irradiation_at_point(surroundings, TiltedPlane(0.0, 0.0), suns, light_at(surroundings, suns), month, 12, 0.3)
    for light in ("beam", "sky"):
        assert all(level.lost[light][cause].sum() > 0.0 for cause in ("relief", "solids", "forest"))
    assert all(level.lost["reflected"][cause].sum() < 0.0 for cause in ("relief", "solids", "forest"))


def test_the_north_side_of_a_box_has_sun_from_the_north(scene_of):
    """Its beam is that of the suns north of the wall's plane, and the south side's that of the others."""
    scene = scene_of(houses=[(-15.0, -10.0, 15.0, 10.0, 12.0)])
    days = days_of(scene, date(2023, 6, 1), date(2023, 6, 30), 5)
    for north_m, azimuth_deg in ((10.05, 0.0), (-10.05, 180.0)):
        surroundings = eye(scene, 1.0, north_m, 4.0)
        suns = suns_at(surroundings, days)
        light = light_at(surroundings, suns)
        azimuth, altitude = np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg)
        towards_wall = np.cos(altitude) * np.cos(azimuth - np.radians(azimuth_deg))
        expected = float((light.beam[0] * towards_wall * suns.hours)[towards_wall > 0.0].sum() / 1000.0)
        result = sums_of(surroundings, TiltedPlane(90.0, azimuth_deg), days)
        assert expected > 1.0
        assert result.received["beam"][0] == pytest.approx(expected, rel=1e-9), azimuth_deg
        assert result.lost["beam"]["solids"][0] == 0.0
        assert result.sky_view == pytest.approx(0.5, abs=2e-3)


def test_a_box_hides_the_suns_that_geometry_says(scene_of):
    """On level ground north of a box the suns behind its roof's edge give no beam, counted by hand."""
    scene = scene_of(houses=[(-60.0, -25.0, 60.0, -5.0, 12.0)])
    surroundings = eye(scene)
    days = days_of(scene, date(2023, 2, 1), date(2023, 4, 30), 8)
    suns = suns_at(surroundings, days)
    light = light_at(surroundings, suns)
    azimuth, altitude = np.radians(suns.azimuth_deg), np.radians(suns.altitude_deg)
    southward, eastward = -np.cos(azimuth), np.sin(azimuth)
    scale = 0.9996  # metres of the map per metre
    enters_m = np.where(southward > 0.0, 5.0 / scale / np.maximum(southward, 1e-9), np.inf)
    is_in_front = (southward > 0.0) & (np.abs(eastward * enters_m) < 60.0 / scale)
    is_hidden = is_in_front & (np.tan(altitude) * enters_m < 12.0)
    energy = light.beam[0] * np.sin(altitude) * suns.hours / 1000.0
    assert 20 < is_hidden.sum() < len(suns) - 20
    result = sums_of(surroundings, TiltedPlane(0.0, 0.0), days)
    assert result.received["beam"][0] == pytest.approx(energy[~is_hidden].sum(), rel=1e-6)
    circumsolar = (light.circumsolar[0] * np.sin(altitude) * suns.hours / 1000.0)[is_hidden].sum()
    assert result.lost["beam"]["solids"][0] == pytest.approx(energy[is_hidden].sum() + circumsolar, rel=1e-6)


def test_sky_views_beside_a_long_wall(scene_of):
    """A wall of 500 m, 12 m high and 8 m away: level planes, the planes that face it and those that face away."""
    scene = scene_of(houses=[(-250.0, 8.0, 250.0, 20.0, 12.0)], cell_m=12.0)
    surroundings, days = eye(scene), days_of(scene)
    angle = np.arctan(12.0 / (8.0 / 0.9996))
    for tilt, azimuth, expected in (
        (0.0, 0.0, (1.0 + np.cos(angle)) / 2.0), (90.0, 0.0, (1.0 - np.sin(angle)) / 2.0), (90.0, 180.0, 0.5),
    ):  # fmt: skip
        result = sums_of(surroundings, TiltedPlane(tilt, azimuth), days)
        assert result.sky_view == pytest.approx(expected, abs=5e-4), (tilt, azimuth)
        assert result.sky_view_of_relief == pytest.approx(result.open_sky_view, abs=1e-9)


def test_a_tree_beside_a_roof_takes_light(scene_of):
    """Trees south of a panel on a roof take beam in winter, and the house takes nothing from its own roof."""
    house, totals = (-6.0, -5.0, 6.0, 5.0, 6.0), []
    for trees in ((), tuple((east_m, -14.0, 16.0) for east_m in range(-9, 10, 3))):
        scene = scene_of(houses=[house], trees=trees)
        days = days_of(scene, date(2023, 11, 1), date(2024, 1, 31), 7)
        result = sums_of(eye(scene, height_m=6.1), TiltedPlane(30.0, 180.0), days)
        totals.append(result.received["total"][0])
        assert result.lost["beam"]["solids"][0] == 0.0
        taken = result.lost["beam"]["forest"][0], result.lost["sky"]["forest"][0]
        if trees:
            assert taken[0] > 0.03 * result.open_sky["total"][0] and taken[1] > 0.0
            net = sum(by_cause["forest"][0] for by_cause in result.lost.values())
            assert totals[0] - totals[1] == pytest.approx(net, rel=1e-9), "the loss by trees is what felling them would gain"
        else:
            assert taken == (0.0, 0.0)


def declination_rad(suns: SunIntervals) -> float:
    """Return the sun's declination in the middle of a day by the Astronomical Almanac's formula, right to 0.01 degrees."""
    middle = suns.moments[0] + (suns.moments[-1] - suns.moments[0]) / 2
    n = (middle - np.datetime64("2000-01-01T12:00")) / np.timedelta64(1, "D")
    mean, anomaly = 280.460 + 0.9856474 * n, np.radians(357.528 + 0.9856003 * n)
    longitude = np.radians(mean + 1.915 * np.sin(anomaly) + 0.020 * np.sin(2.0 * anomaly))
    return float(np.arcsin(np.sin(np.radians(23.439 - 4e-7 * n)) * np.sin(longitude)))


def beam_without_air(surroundings: Surroundings, plane: TiltedPlane, suns: SunIntervals) -> float:
    """Return the sunlight of 1 kW/m2 that a plane receives in a world without air, kWh/m2."""
    suns = without_refraction(suns)
    result = irradiation_at_point(surroundings, plane, suns, sunlight(suns), np.zeros(len(suns), int), 1, 0.2)
    return float(result.received["total"][0])


@pytest.mark.parametrize("day", [date(2023, 6, 21), date(2023, 5, 10)])
def test_a_day_at_the_pole_without_air(write_raster, make_scene, day):
    """The sun circles at the height of its declination: 24 hours of its sine on level planes, of its cosine over pi on walls."""
    scene = make_scene(write_raster(np.zeros((21, 21), np.float32), "EPSG:3413", -105.0, 105.0, 10.0))
    surroundings = load_surroundings(scene, place_at(scene, (0.5, 0.5), scene.elevation.crs))
    (window,) = windows_between(scene.world, day, day, 1, (0.0, 1440.0), SOLAR)
    suns = suns_at(surroundings, [window], 15.0)
    declination = declination_rad(suns)
    assert suns.hours.sum() == pytest.approx(24.0, abs=0.02)
    for tilt, expected in ((0.0, np.sin(declination)), (90.0, np.cos(declination) / np.pi)):
        assert beam_without_air(surroundings, TiltedPlane(tilt, 50.0), suns) == pytest.approx(expected * 24.0, rel=1e-3)


@pytest.mark.parametrize("day", [date(2023, 3, 21), date(2023, 6, 21), date(2023, 11, 5)])
def test_a_day_at_the_equator_without_air(scene_of, day):
    """A level plane has 24 hours over pi times the cosine of the declination.

    A wall to the east has half of that, and the minutes in which refraction shows a sun that is below the horizon.
    """
    scene = scene_of(np.zeros((21, 21)), crs="EPSG:32632", north=42.0, cell_m=4.0)
    surroundings = eye(scene)
    (window,) = windows_between(scene.world, day, day, 1, (0.0, 1440.0), SOLAR)
    suns = suns_at(surroundings, [window], 10.0)
    cosine = np.cos(declination_rad(suns))
    of_wall_h = 12.0 / np.pi * (1.0 - np.cos(np.pi / 24.0 * suns.hours.sum()))
    for tilt, azimuth, hours in ((0.0, 0.0, 24.0 / np.pi), (90.0, 90.0, of_wall_h), (90.0, 270.0, of_wall_h)):
        value = beam_without_air(surroundings, TiltedPlane(tilt, azimuth), suns)
        assert value == pytest.approx(hours * cosine, rel=1e-3), (tilt, azimuth)


def test_points_agree_with_rasters(scene_of):
    """On cells of fractal hills the parts of the ground's own plane are those of the raster.

    Only a sun within half a degree of a ridge may be seen by one and hidden from the other. The raster's skylight is that of 72
    azimuths.
    """
    scene = scene_of(fractal_heights_m(60), cell_m=30.0)
    view, days = cells_of(scene), days_of(scene, date(2023, 2, 1), date(2023, 11, 1), 40)
    # The climate of turbidity has steps between its cells, one of which lies in the raster.
    values = irradiation(scene, view, all_dates(days), IrradiationRules(PARTS, linke_turbidity=3.0))
    rasters = dict(zip(PARTS, values, strict=True))
    exact = 0
    for cell in ((12, 20), (25, 31), (30, 30), (41, 17), (47, 44), (36, 50), (18, 8), (52, 29)):
        position = float(view.grid.x(view.col0 + cell[1])), float(view.grid.y(view.row0 + cell[0]))
        surroundings = load_surroundings(scene, place_at(scene, position, view.grid.crs))
        plane, suns = ground_plane(scene, surroundings.place), suns_at(surroundings, days)
        light = light_at(surroundings, suns, 3.0)
        result = irradiation_at_point(surroundings, plane, suns, light, np.zeros(len(suns), int), 1, 0.2)
        above_deg = suns.altitude_deg - horizon_profile(surroundings, suns.azimuth_deg).elevation_deg
        weight = plane.cosine_towards(suns.azimuth_deg, suns.altitude_deg) * suns.hours / 1000.0 * (np.abs(above_deg) < 0.5)
        doubtful = {"beam": float(light.beam[0] @ weight), "circumsolar": float(light.circumsolar[0] @ weight)}
        scale = result.open_sky["total"][0]
        for part in PARTS:
            error = abs(result.received[part][0] - float(rasters[part][cell]))
            is_direct = part in doubtful
            assert error < (1e-3 * scale + doubtful[part] if is_direct else 4e-3 * scale), (cell, part)
        exact += doubtful["beam"] == 0.0
    assert exact >= 4


def test_polar_night_is_dark(scene_of):
    scene = scene_of(fractal_heights_m(30), north=8_700e3, cell_m=30.0)
    result = sums_of(eye(scene), TiltedPlane(35.0, 180.0), days_of(scene, WINTER))
    assert all(values[0] == 0.0 for values in (*result.received.values(), *result.open_sky.values()))
    assert not result.has_sun[0]


def test_a_dark_horizon_takes_no_more_than_the_sky_gives(scene_of):
    """Where the parts of skylight add up to less than nothing the sky gives nothing, as in pvlib."""
    scene = scene_of()
    surroundings = eye(scene)
    suns = suns_at(surroundings, days_of(scene))
    dark, sky = np.zeros((1, len(suns))), np.full((1, len(suns)), 100.0)
    light = SkyLight(dark, dark, sky, -0.8 * sky, dark)
    for tilt, expected_w in ((0.0, 100.0), (60.0, 75.0 - 80.0 * np.sin(np.radians(60.0))), (120.0, 0.0)):
        result = irradiation_at_point(surroundings, TiltedPlane(tilt, 0.0), suns, light, np.zeros(len(suns), int), 1, 0.2)
        expected_kwh = expected_w * suns.hours.sum() / 1000.0
        assert result.received["total"][0] == pytest.approx(expected_kwh, rel=1e-3, abs=1e-9)
        assert result.received["sky"][0] + result.received["horizon_band"][0] == pytest.approx(expected_kwh, rel=1e-3, abs=1e-9)
