"""Weather files: what their stamps mean, by the sun; energy, dates, columns, places, and bad input."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pandas
import pvlib
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from skugga.shadows.irradiation.light import CLEAR_SKY_TOLERANCE, clear_sky_light, weather_light
from skugga.shadows.irradiation.suns import SunIntervals
from skugga.shadows.irradiation.weather import (
    Weather,
    check_weather_place,
    missing_weather,
    parse_weather_columns,
    read_weather,
)  # fmt: skip
from skugga.shadows.irradiation.weather_sun import extraterrestrial_w_m2, time_shift_min
from skugga.terrain.errors import InputError
from skugga.terrain.geo.daily_windows import DailyWindow
from tests.shadows.irradiation.weather_files import (
    PLACES,
    TMY3_HEADER,
    Place,
    clear_sky_hours,
    clear_sky_moments,
    hours_of_year,
    local_hours,
    rolled,
    write_csv,
    write_epw,
    write_pvgis_csv,
    write_pvgis_json,
    write_tmy3,
)  # fmt: skip

ALPS = PLACES["alps"]

SAMPLES = Path(pvlib.__file__).parent / "data"

MAX_ASYMMETRY_MIN = 1.5
"""Minutes from the sun's noon to the middle of the light of clear days. A shift of the times by half an hour moves it by 30."""

DAY_HEADER = ("time", "ghi", "dni", "dhi")


def days(first: date, count: int, place: Place = ALPS, every: int = 1) -> list[DailyWindow]:
    """Return windows of 24 hours, each from a place's mean solar midnight."""
    midnight = timedelta(hours=-place.lon_deg / 15.0)
    dates = [first + timedelta(days=every * number) for number in range(count)]
    return [DailyWindow(day, datetime.combine(day, datetime.min.time(), UTC) + midnight, 1440.0, 0.0) for day in dates]


def hour_angle_min(suns: SunIntervals, lat_deg: float) -> np.ndarray:
    """Return the minutes from the sun's noon (n,), from the suns' azimuths and true altitudes."""
    azimuth, lat = np.radians(suns.azimuth_deg - 180.0), np.radians(lat_deg)
    altitude = np.radians(suns.altitude_deg - suns.refraction_deg)
    across, along = np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude) * np.sin(lat)
    return np.degrees(np.arctan2(across, along + np.sin(altitude) * np.cos(lat))) * 4.0


def asymmetry_min(weather: Weather, place: Place) -> float:
    """Return the minutes from the sun's noon to the middle of the light of some days."""
    suns, light = weather_light(weather, days(date(2023, 1, 5), 12, place, 30), place.lon_deg, place.lat_deg)
    energy = light.level[0] * suns.hours
    return float(energy @ hour_angle_min(suns, place.lat_deg) / energy.sum())


def level_kwh(weather: Weather, windows: list[DailyWindow], place: Place = ALPS) -> float:
    """Return the light of windows on a level plane, kWh/m2."""
    suns, light = weather_light(weather, windows, place.lon_deg, place.lat_deg)
    return float(light.level[0] @ suns.hours / 1000.0)


def hourly_weather(ghi: np.ndarray, dni: np.ndarray | None = None, dhi: np.ndarray | None = None, year: int = 2023) -> Weather:
    """Return weather of the hours (n,) from the start of a year."""
    return Weather("test", hours_of_year(year)[: len(ghi)], np.full(len(ghi), 60.0), ghi, dni, dhi)


# What stamps mean


def utc_texts(moments: np.ndarray) -> list[str]:
    """Return moments as times with an offset."""
    return [f"{moment}Z" for moment in moments.astype("datetime64[s]")]


FILES: dict[str, Callable[[Path, Place], Path]] = {
    "epw": lambda folder, place: write_epw(folder / "a.epw", place, local_hours(place)),
    "tmy3": lambda folder, place: write_tmy3(folder / "a.csv", place, local_hours(place)),
    "pvgis-csv": lambda folder, place: write_pvgis_csv(folder / "a.csv", place, clear_sky_moments(place, 10.566), 0.1761),
    "pvgis-json": lambda folder, place: write_pvgis_json(folder / "a.json", place, clear_sky_hours(place), 0.5),
    "pvgis-without-offset": lambda folder, place: write_pvgis_csv(folder / "a.csv", place, clear_sky_moments(place, 10.566), None),
    "pvgis-epw-in-utc": lambda folder, place: write_epw(
        folder / "a.epw", place, clear_sky_moments(place, 10.566), "ECMWF/ERA", "unknown", ",Irradiance Time Offset (h):-0.8239"
    ),
    "pvgis-epw-in-its-zone": lambda folder, place: write_epw(
        folder / "a.epw", place, rolled(clear_sky_moments(place, 10.566), place.zone_hours - 1), "ECMWF/ERA", "unknown"
    ),
    "csv-end": lambda folder, place: write_csv(
        folder / "end.csv", DAY_HEADER, utc_texts(hours_of_year(2023) + np.timedelta64(1, "h")), *clear_sky_hours(place)
    ),
}  # fmt: skip


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("kind", FILES)
def test_stamps_of_a_format_fit_the_sun(tmp_path, kind, place):
    """The light of clear days is symmetric about the sun's noon, and is not if the times are half an hour or an hour off."""
    columns = {"stamp": "end"} if kind == "csv-end" else None
    weather = read_weather(FILES[kind](tmp_path, place), columns)
    assert len(weather) == 8760 and weather.warnings == ()
    assert abs(asymmetry_min(weather, place)) < MAX_ASYMMETRY_MIN
    if place == ALPS:
        for shift_min in (-60, -30, 30, 60):
            shifted = replace(weather, start=weather.start + np.timedelta64(shift_min, "m"))
            assert asymmetry_min(shifted, place) == pytest.approx(shift_min, abs=7.0)
    for parts in (weather.ghi, weather.dni, weather.dhi):
        assert parts is not None and parts.min() == 0.0


@pytest.mark.parametrize("name", ["703165TY.csv", "723170TYA.CSV"])
def test_stamps_of_published_tmy3_fit_the_sun(name):
    """GHI - DHI is the sun's part on level ground, which no shift of times by a minute or more would fit better."""
    if not (SAMPLES / name).exists():
        pytest.skip("this pvlib has no sample files")
    weather = read_weather(SAMPLES / name)
    assert weather.lon_deg is not None and weather.lat_deg is not None
    parts = [weather.ghi, weather.dni, weather.dhi]
    assert abs(time_shift_min(weather.middle, *parts, weather.lon_deg, weather.lat_deg)) < 1.0
    off = weather.middle + np.timedelta64(30, "m")
    assert time_shift_min(off, *parts, weather.lon_deg, weather.lat_deg) == pytest.approx(-30.0, abs=1.0)
    assert check_weather_place(weather, weather.lon_deg, weather.lat_deg, weather.height_m) == ()


@pytest.mark.parametrize("place", PLACES.values(), ids=PLACES)
@pytest.mark.parametrize("shift_min", [-700, -75, 0, 12, 300])
def test_time_shift_is_that_of_the_times(place, shift_min):
    moments = hours_of_year() + np.timedelta64(30, "m")
    shifted = moments - np.timedelta64(shift_min, "m")
    found = time_shift_min(shifted, *clear_sky_hours(place), place.lon_deg, place.lat_deg)
    assert found == pytest.approx(shift_min, abs=1.0)


def test_time_shift_needs_sunlight_that_fits():
    moments = hours_of_year() + np.timedelta64(30, "m")
    ghi, dni, dhi = clear_sky_hours(ALPS)
    assert time_shift_min(moments, dhi, 0.0 * dni, dhi, ALPS.lon_deg, ALPS.lat_deg) is None
    assert time_shift_min(moments, ghi, 2.0 * dni, dhi, ALPS.lon_deg, ALPS.lat_deg) is None


@pytest.mark.parametrize(("stamp", "minutes"), [("start", 0), ("middle", 30), ("end", 60)])
def test_csv_stamps_are_start_middle_or_end(tmp_path, stamp, minutes):
    starts = hours_of_year(2023)[:48]
    times = utc_texts(starts + np.timedelta64(minutes, "m"))
    weather = read_weather(write_csv(tmp_path / "a.csv", DAY_HEADER, times, *clear_sky_hours(ALPS)[:, :48]), {"stamp": stamp})
    np.testing.assert_array_equal(weather.start, starts)
    np.testing.assert_array_equal(weather.length_min, 60.0)


@pytest.mark.parametrize("clock", ["Europe/Oslo", "+01:00", "offsets"])
def test_csv_clock_leads_to_utc(tmp_path, clock):
    """Also over both changes of summer time, in which an hour is skipped or comes twice."""
    starts = hours_of_year(2023)
    zone = ZoneInfo("Europe/Oslo")
    moments = [moment.replace(tzinfo=UTC) for moment in starts.tolist()]
    if clock == "Europe/Oslo":
        times = [f"{moment.astimezone(zone):%Y-%m-%d %H:%M}" for moment in moments]
    elif clock == "offsets":
        times = [moment.astimezone(zone).isoformat() for moment in moments]
    else:
        times = [f"{moment + timedelta(hours=1):%Y-%m-%dT%H:%M:%S}" for moment in moments]
    columns = {"stamp": "start"} | ({} if clock == "offsets" else {"clock": clock})
    weather = read_weather(write_csv(tmp_path / "a.csv", DAY_HEADER, times, *clear_sky_hours(ALPS)), columns)
    np.testing.assert_array_equal(weather.start, starts)


# Columns and units


@pytest.mark.parametrize(
    ("title", "columns", "factor"),
    [
        ("ghi", {}, 1.0),
        ("GHI [W/m\u00b2]", {}, 1.0),
        ("ghi_kwh_m2", {}, 1 / 3000.0),
        ("GHI (Wh/m2)", {}, 1 / 3.0),
        ("ghi [kJ m-2]", {}, 1.2),
        ("Global", {"ghi": "Global:MJ/m2"}, 1.2e-3),
        ("Global [J/cm^2]", {"ghi": "Global [J/cm^2]"}, 0.12),
        ("G(h)", {}, 1.0),
        ("a:b", {"ghi": "a:b"}, 1.0),
    ],
)
def test_units_of_columns_are_converted(tmp_path, title, columns, factor):
    """Records of 20 minutes: 1 W/m2 is 1.2 kJ/m2."""
    times = [f"2023-06-21T{hour:02d}:{minute:02d}Z" for hour in range(24) for minute in (0, 20, 40)]
    ghi = np.linspace(30.0, 900.0, 72)
    path = write_csv(tmp_path / "a.csv", ("time", title), times, ghi * factor)
    weather = read_weather(path, {"stamp": "start", **columns})
    np.testing.assert_allclose(weather.ghi, ghi, rtol=1e-4)
    np.testing.assert_array_equal(weather.length_min, 20.0)
    assert weather.dni is None and weather.dhi is None
    assert weather.warnings == (
        "a.csv (CSV): has GHI alone. Direct and diffuse light follow from it by the model of Erbs and Driesse.",
    )


def test_semicolons_and_decimal_commas_are_read(tmp_path):
    times = ["2023-06-21T10:00Z", "2023-06-21T11:00Z"]
    path = write_csv(tmp_path / "a.csv", ("time", "ghi"), times, np.array([500.25, 600.5]), separator=";")
    np.testing.assert_array_equal(read_weather(path, {"stamp": "end"}).ghi, [500.25, 600.5])


def test_weather_columns_are_parsed():
    assert parse_weather_columns("ghi=Global:kJ/m2, clock=+01:00,stamp=end") == {
        "ghi": "Global:kJ/m2", "clock": "+01:00", "stamp": "end",
    }  # fmt: skip
    for text in ("ghi", "ghi=", "ghi=a,ghi=b", "albedo=a"):
        with pytest.raises(InputError, match="weather_columns"):
            parse_weather_columns(text)


def test_records_without_data_are_left_out(tmp_path):
    times = [f"2023-06-21T{hour:02d}:00Z" for hour in range(24)]
    ghi = np.full(24, 100.0)
    ghi[[3, 12]] = np.nan
    weather = read_weather(write_csv(tmp_path / "a.csv", ("time", "ghi"), times, ghi), {"stamp": "start"})
    assert len(weather) == 22 and not np.isnan(weather.ghi).any()
    powers = np.full((3, 8760), 50.0)
    powers[1, 100] = 9999.0
    assert len(read_weather(write_epw(tmp_path / "a.epw", ALPS, powers))) == 8759
    powers[1, 100] = -9900.0
    assert len(read_weather(write_tmy3(tmp_path / "b.csv", ALPS, powers))) == 8759


# Energy


@pytest.mark.parametrize("name", ["703165TY.csv", "723170TYA.CSV"])
def test_energy_of_a_year_is_that_of_the_file(name):
    """Beam, circumsolar and sky light together differ by the file's own closure, for one sun an hour: by 0.1 % here."""
    if not (SAMPLES / name).exists():
        pytest.skip("this pvlib has no sample files")
    weather = read_weather(SAMPLES / name)
    place = Place(weather.lon_deg, weather.lat_deg, 0.0)
    suns, light = weather_light(weather, days(date(2023, 1, 1), 365, place), place.lon_deg, place.lat_deg)
    sine = np.sin(np.radians(suns.altitude_deg))
    assert light.level.shape == light.beam.shape == (2, len(suns))
    assert light.level[0] @ suns.hours == pytest.approx(weather.ghi.sum(), rel=1e-6)
    assert light.beam[0] @ suns.hours == pytest.approx(weather.dni.sum(), rel=1e-6)
    parts = (light.beam + light.circumsolar) * sine + light.isotropic
    assert parts[0] @ suns.hours == pytest.approx(weather.ghi.sum(), rel=1e-3)


@pytest.mark.parametrize("part", ["dni", "dhi", "neither"])
def test_missing_parts_keep_the_energy(part):
    """All light on level ground is that of the file, and closure finds the sunlight, but for that of a sun near the horizon."""
    weather = hourly_weather(*clear_sky_hours(ALPS))
    windows = days(date(2023, 1, 1), 60, every=6)
    suns, reference = weather_light(weather, windows, ALPS.lon_deg, ALPS.lat_deg)
    _, light = weather_light(
        weather if part == "neither" else replace(weather, **{part: None}), windows, ALPS.lon_deg, ALPS.lat_deg
    )
    np.testing.assert_allclose(light.level, reference.level, rtol=1e-9)
    level = (light.beam + light.circumsolar) * np.sin(np.radians(suns.altitude_deg)) + light.isotropic
    # in an hour of the morning sunlight and its sine rise together: the mean of their product is above the product of means
    assert level[0] @ suns.hours == pytest.approx(light.level[0] @ suns.hours, rel=3e-3)
    is_high = suns.altitude_deg > 20.0
    np.testing.assert_allclose(light.beam[0][is_high], reference.beam[0][is_high], rtol=0.02)


def test_global_light_alone_is_split_by_erbs_and_driesse():
    ghi, _, _ = clear_sky_hours(ALPS)
    suns, light = weather_light(hourly_weather(0.7 * ghi), days(date(2023, 1, 1), 12, every=30), ALPS.lon_deg, ALPS.lat_deg)
    extra = extraterrestrial_w_m2(suns.moments)
    expected = pvlib.irradiance.erbs_driesse(light.level[0], 90.0 - suns.altitude_deg, dni_extra=extra)
    is_high = suns.altitude_deg > 10.0
    assert light.beam[0][is_high].max() > 100.0
    np.testing.assert_allclose(light.beam[0][is_high], expected["dni"][is_high], rtol=1e-9)
    level = (light.beam + light.circumsolar) * np.sin(np.radians(suns.altitude_deg)) + light.isotropic
    np.testing.assert_allclose(level[0][is_high], light.level[0][is_high], rtol=1e-9)


def test_global_light_follows_from_its_parts():
    ghi, dni, dhi = clear_sky_hours(ALPS)
    weather, windows = hourly_weather(ghi, dni, dhi), days(date(2023, 1, 1), 12, every=30)
    assert level_kwh(replace(weather, ghi=None), windows) == pytest.approx(level_kwh(weather, windows), rel=3e-3)


def test_sunlight_from_closure_has_no_spikes_at_a_low_sun():
    """Diffuse light that is measured too low by 15 W/m2 would be 500 W/m2 of sunlight at an altitude of 1.7 degrees."""
    ghi, dni, dhi = clear_sky_hours(ALPS)
    weather = hourly_weather(ghi, None, np.maximum(dhi - 15.0, 0.0))
    windows = days(date(2023, 1, 1), 60, every=6)
    suns, light = weather_light(weather, windows, ALPS.lon_deg, ALPS.lat_deg)
    clear = clear_sky_light(suns, ALPS.lon_deg, ALPS.lat_deg, np.zeros(1), None)
    is_low = suns.altitude_deg < 10.0
    assert is_low.sum() > 100
    assert np.all(light.beam[0][is_low] <= CLEAR_SKY_TOLERANCE * clear.beam[0][is_low] * (1.0 + 1e-9))
    assert np.all(light.beam <= 1420.0)
    level = (light.beam + light.circumsolar) * np.sin(np.radians(suns.altitude_deg)) + light.isotropic
    assert level[0] @ suns.hours == pytest.approx(light.level[0] @ suns.hours, rel=3e-3)


def test_measured_sunlight_stays_below_the_extraterrestrial():
    ghi, dni, dhi = clear_sky_hours(ALPS)
    sunny = hourly_weather(ghi, np.where(dni > 0.0, 900.0, 0.0), dhi)
    suns, light = weather_light(sunny, days(date(2023, 1, 1), 60, every=6), ALPS.lon_deg, ALPS.lat_deg)
    assert suns.hours.min() < 0.6 and light.beam.max() < 1420.0


def test_light_at_dawn_comes_with_the_first_sun():
    """An hour before the sun has 5 W/m2. It counts as skylight, also in the parts."""
    windows = days(date(2023, 6, 21), 1)
    ghi, dni, dhi = clear_sky_hours(ALPS)
    plain, (suns, light) = hourly_weather(ghi, dni, dhi), weather_light(hourly_weather(ghi, dni, dhi), windows, 8.0, 45.0)
    first = int(np.searchsorted(plain.start, suns.moments[0], side="right")) - 1
    dawn_ghi, dawn_dhi = ghi.copy(), dhi.copy()
    dawn_ghi[first - 1] += 5.0
    dawn_dhi[first - 1] += 5.0
    dawn_suns, dawn_light = weather_light(hourly_weather(dawn_ghi, dni, dawn_dhi), windows, 8.0, 45.0)
    gain = dawn_light.level[0] * dawn_suns.hours - light.level[0] * suns.hours
    assert gain[0] == pytest.approx(5.0) and not gain[1:].any()
    assert dawn_light.isotropic[0][0] > light.isotropic[0][0]
    assert dawn_light.beam[0][0] == light.beam[0][0]


def test_light_of_a_date_without_sun_is_left_out():
    weather = hourly_weather(np.full(8760, 3.0), np.zeros(8760), np.full(8760, 3.0))
    suns, light = weather_light(weather, days(date(2023, 12, 20), 2), 15.0, 78.0)
    assert len(suns) == 0 and light.level.shape == (2, 0)


def test_windows_cut_records_without_loss():
    """Windows that begin at half hours share the light of records by the time that the sun is up in each."""
    weather = hourly_weather(*clear_sky_hours(ALPS))
    (day,) = days(date(2023, 3, 21), 1)
    lengths = np.diff([0.0, 371.0, 400.0, 725.5, 1100.0, 1440.0]).tolist()
    starts = [day.start + timedelta(minutes=minutes) for minutes in np.cumsum([0.0, *lengths[:-1]])]
    pieces = [DailyWindow(day.date, start, length, 0.0) for start, length in zip(starts, lengths, strict=True)]
    assert level_kwh(weather, pieces) == pytest.approx(level_kwh(weather, [day]), rel=1e-9)
    assert sum(level_kwh(weather, [piece]) for piece in pieces[:1]) < 0.2 * level_kwh(weather, [day])


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**32 - 1), minutes=st.sampled_from([10, 20, 60, 180]), lat_deg=st.floats(-60.0, 60.0))
def test_energy_is_kept_for_any_light(seed, minutes, lat_deg):
    """Noise of any size, also at night, adds up to the energy of the records."""
    random = np.random.default_rng(seed)
    starts = np.datetime64("2023-03-01", "us") + np.arange(3 * 1440 // minutes) * np.timedelta64(minutes, "m")
    dhi = random.uniform(0.0, 300.0, len(starts))
    weather = Weather(
        "test", starts, np.full(len(starts), float(minutes)), dhi + 100.0, random.uniform(0.0, 900.0, len(starts)), dhi
    )
    windows = [DailyWindow(date(2023, 3, day), datetime(2023, 3, day, tzinfo=UTC), 1440.0, 0.0) for day in (1, 2, 3)]
    expected = weather.ghi.sum() * minutes / 60e3
    assert level_kwh(weather, windows, Place(0.0, lat_deg, 0.0)) == pytest.approx(expected, rel=1e-9)


def test_a_clear_sky_from_a_file_is_that_of_the_model():
    """The suns of records are those of intervals: light and directions agree with the clear sky of the same hours."""
    windows = [DailyWindow(date(2023, 6, 21), datetime(2023, 6, 21, tzinfo=UTC), 1440.0, 0.0)]
    suns, light = weather_light(hourly_weather(*clear_sky_hours(ALPS)), windows, ALPS.lon_deg, ALPS.lat_deg)
    clear = clear_sky_light(suns, ALPS.lon_deg, ALPS.lat_deg, np.zeros(1), 3.0)
    is_high = suns.altitude_deg > 10.0
    np.testing.assert_allclose(light.beam[0][is_high], clear.beam[0][is_high], rtol=0.02)
    np.testing.assert_allclose(light.isotropic[0][is_high], clear.isotropic[0][is_high], rtol=0.05)
    assert light.level[0] @ suns.hours == pytest.approx(clear.level[0] @ suns.hours, rel=0.01)


# Dates and places


def test_a_typical_year_serves_every_year(tmp_path):
    """Months and days keep their light; 29 February has that of the 28th, and the days after it their own."""
    powers = np.zeros((3, 8760))
    powers[:, :] = (np.arange(8760) // 24 + 1.0) / 2.0  # half the number of the day
    weather = read_weather(write_epw(tmp_path / "a.epw", Place(0.0, 45.0, 0.0), powers))
    for day, number in {
        date(2023, 1, 1): 1, date(2023, 2, 28): 59, date(2023, 3, 1): 60, date(2024, 2, 28): 59, date(2024, 2, 29): 59,
        date(2024, 3, 1): 60, date(2024, 12, 31): 365, date(1995, 7, 4): 185,
    }.items():  # fmt: skip
        (window,) = days(day, 1, Place(0.0, 45.0, 0.0))
        assert level_kwh(weather, [window], Place(0.0, 45.0, 0.0)) == pytest.approx(24.0 * number / 2000.0), day
        assert missing_weather(weather, [window], 0.0, 45.0) == ()


@pytest.mark.parametrize("kind", ["epw", "tmy3", "pvgis-csv"])
def test_a_typical_year_has_no_gaps(tmp_path, kind):
    """Over the turn of leap years, on the side of the earth where dates of UTC and of the clock differ."""
    for place in (PLACES["sydney"], PLACES["rockies"]):
        weather = read_weather(FILES[kind](tmp_path, place))
        windows = days(date(2023, 12, 30), 64, place)
        assert missing_weather(weather, windows, place.lon_deg, place.lat_deg) == ()
        assert level_kwh(weather, windows, place) > 100.0


def test_missing_daylight_is_counted(tmp_path):
    weather = hourly_weather(*clear_sky_hours(ALPS))
    is_kept = np.ones(8760, bool)
    is_kept[[24 * 171 + 11, 24 * 171 + 12, 24 * 172 + 23]] = False  # two hours of daylight on 21 June, one of the night
    gaps = replace(weather, **{name: getattr(weather, name)[is_kept] for name in ("start", "length_min", "ghi", "dni", "dhi")})
    windows = days(date(2023, 6, 20), 4)
    assert missing_weather(weather, windows, 8.0, 45.0) == ()
    assert missing_weather(gaps, windows, 8.0, 45.0) == (
        "test: 2 hours of daylight have no record, the first from 2023-06-21 11:00 UTC on. They count as without light.",
    )
    lost = weather.ghi[~is_kept].sum() / 1000.0
    assert level_kwh(gaps, windows) == pytest.approx(level_kwh(weather, windows) - lost, rel=1e-9)


def test_a_year_without_weather_is_refused():
    weather = hourly_weather(*clear_sky_hours(ALPS))
    windows = days(date(2022, 6, 1), 3)
    for use in (weather_light, missing_weather):
        with pytest.raises(
            InputError, match=r"weather: '2022-06-01' is not allowed. Allowed: dates of test, 2023-01-01 to 2023-12-31\."
        ):
            use(weather, windows, 8.0, 45.0)


def test_weather_of_daylight_alone_serves_a_polar_night():
    """A file of daylight has no record of a polar night, which lacks none."""
    weather = hourly_weather(*clear_sky_hours(ALPS)[:, :2400])
    assert missing_weather(weather, days(date(2023, 12, 20), 2), 15.0, 78.0) == ()
    assert len(weather_light(weather, days(date(2023, 12, 20), 2), 15.0, 78.0)[0]) == 0


def test_the_place_of_weather_is_compared():
    ghi, dni, dhi = clear_sky_hours(ALPS)
    weather = replace(hourly_weather(ghi, dni, dhi), lon_deg=8.0, lat_deg=45.0, height_m=250.0)
    assert check_weather_place(weather, 8.2, 45.3, 500.0) == ()
    assert check_weather_place(weather, 8.0, 46.0, 900.0) == (
        "test: the weather is that of a place 111 km away.", "test: the weather is that of a place 650 m lower.",
    )  # fmt: skip
    (text,) = check_weather_place(replace(weather, lon_deg=None, lat_deg=None), 23.0, 45.0, 250.0)
    assert text.startswith("test: its light fits the sun here if its times are 60 minutes earlier.")
    (text,) = check_weather_place(replace(weather, start=weather.start + np.timedelta64(30, "m")), 8.0, 45.0, 250.0)
    assert text.startswith("test: its light fits the sun here if its times are 30 minutes earlier.")
    with pytest.raises(InputError, match=r"is at 45.0 N, the level at 45.0 S"):
        check_weather_place(weather, 8.0, -45.0, 250.0)
    tropics = replace(weather, lat_deg=1.0)
    assert any("km away" in text for text in check_weather_place(tropics, 8.0, -2.0, 250.0))


# Bad input


def csv_text(*rows: str, header: str = "time,ghi") -> str:
    """Return the text of a CSV."""
    return "\n".join([header, *rows])


DAY = [f"2023-06-21T{hour:02d}:00Z,{100 * hour}" for hour in range(8, 13)]

BAD_FILES = {
    "empty": ("a.csv", "", {}, "a.csv: is empty."),
    "header": ("a.csv", "time,ghi", {"stamp": "end"}, "a.csv: has no records."),
    "text": ("a.csv", "Dear reader\nhow are you", {}, "a.csv: is not a weather file."),
    "binary": ("a.epw", "a\0b", {}, "a.epw: is not a text file."),
    "no-epw": ("a.epw", "time,ghi\n1,2", {}, "a.epw: is neither EPW nor a TMY of PVGIS."),
    "short-epw": ("a.epw", "LOCATION,a,b", {}, "a.epw: cannot be read as EPW"),
    "json": ("a.json", "{}", {}, "a.json: cannot be read as PVGIS's JSON (no outputs)."),
    "no-json": ("a.json", "{", {}, "a.json: cannot be read as PVGIS's JSON"),
    "short-pvgis": ("a.csv", "Latitude (decimal degrees): 45\nLongitude (decimal degrees): 8\n", {}, "cannot be read as PVGIS"),
    "short-tmy3": ("a.csv", f"1,a,b,-7,40,-105,9\n{TMY3_HEADER}", {}, "a.csv"),
    "no-time": ("a.csv", csv_text(*DAY, header="when,ghi"), {"stamp": "end"}, "a.csv: has no column time. Name it: time=NAME"),
    "no-ghi": ("a.csv", csv_text(*DAY, header="time,dni"), {"stamp": "end"}, "has neither a column ghi nor both dni and dhi"),
    "named": ("a.csv", csv_text(*DAY), {"ghi": "Global"}, "weather_columns: ghi: 'Global' is not allowed. Allowed: a column of"),
    "key": ("a.csv", csv_text(*DAY), {"albedo": "a"}, "weather_columns: 'albedo' is not allowed"),
    "unit": ("a.csv", csv_text(*DAY, header="time,ghi [BTU/ft2]"), {"stamp": "end"}, "unit of ghi [BTU/ft2]: 'BTU/ft2' is"),
    "no-stamp": ("a.csv", csv_text(*DAY), {}, "stamp: missing. Say whether times of"),
    "stamp": ("a.csv", csv_text(*DAY), {"stamp": "begin"}, "'begin' is not allowed. Allowed: start, middle, end."),
    "no-zone": ("a.csv", csv_text(*DAY).replace("Z,", ","), {"stamp": "end"}, "has times without a UTC offset. Name their clock"),
    "zones": ("a.csv", csv_text(*DAY, "2023-06-21T13:00,1"), {"stamp": "end"}, "has times with and without a UTC offset"),
    "clock": ("a.csv", csv_text(*DAY), {"stamp": "end", "clock": "utc"}, "clock: cannot be used with the UTC offsets in the times"),
    "solar": ("a.csv", csv_text(*DAY).replace("Z,", ","), {"stamp": "end", "clock": "solar"}, "'solar' is not allowed"),
    "no-clock": ("a.csv", csv_text(*DAY).replace("Z,", ","), {"stamp": "end", "clock": "Europe/Oslö"}, "clock: 'Europe/Oslö'"),
    "skipped": (
        "a.csv", csv_text("2023-03-26T02:30,1", "2023-03-26T03:30,1"), {"stamp": "end", "clock": "Europe/Oslo"}, "it skips some",
    ),
    "date": ("a.csv", csv_text("21.6.2023 12:00Z,1", *DAY), {"stamp": "end"}, "time: cannot be read"),
    "no-date": ("a.csv", csv_text(" ,1", ",2"), {"stamp": "end", "clock": "utc"}, "time"),
    "negative": ("a.csv", csv_text(*DAY, "2023-06-21T13:00Z,-300"), {"stamp": "start"}, "GHI is -300 W/m2 at 2023-06-21 13:00 UTC"),
    "absurd": ("a.csv", csv_text(*DAY, "2023-06-21T13:00Z,2100"), {"stamp": "start"}, "GHI is 2100 W/m2 at 2023-06-21 13:00 UTC"),
    "infinite": ("a.csv", csv_text("2023-06-21T12:00Z,nan", "2023-06-21T13:00Z,nan"), {"stamp": "end"}, "has no record with data"),
    "word": ("a.csv", csv_text(*DAY, "2023-06-21T13:00Z,much"), {"stamp": "end"}, "ghi of row 7: 'much' is not allowed"),
    "row": ("a.csv", csv_text(*DAY, "2023-06-21T13:00Z"), {"stamp": "end"}, "row 7 has 1 values, the header 2"),
    "twice": ("a.csv", csv_text(*DAY, DAY[-1]), {"stamp": "end"}, "has two records at 2023-06-21T12:00:00 UTC"),
    "one": ("a.csv", csv_text(DAY[0]), {"stamp": "end"}, "has one record, so its length is not known"),
    "uneven": ("a.csv", csv_text(*DAY, "2023-06-21T12:30Z,1"), {"stamp": "end"}, "of 60 minutes, and one only 30 minutes"),
    "daily": ("a.csv", csv_text("2023-06-21T00:00Z,1", "2023-06-22T00:00Z,1"), {"stamp": "end"}, "has records of 1440 minutes"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_refused_in_one_line(tmp_path, monkeypatch, case):
    name, text, columns, message = BAD_FILES[case]
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(text)
    with pytest.raises(InputError) as caught:
        read_weather(name, columns)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert name in str(caught.value) or "weather_columns" in str(caught.value)


def test_other_errors_than_those_of_a_clock_are_not_blamed_on_it(tmp_path, monkeypatch):
    """A want of memory while times are localised is no fault of the clock."""

    def fail(*_, **__):
        raise MemoryError

    monkeypatch.setattr(pandas.DatetimeIndex, "tz_localize", fail)
    path = tmp_path / "a.csv"
    path.write_text(csv_text("2023-03-26T02:30Z,1", "2023-03-26T03:30Z,1").replace("Z,", ","))
    with pytest.raises(MemoryError):
        read_weather(path, {"stamp": "end", "clock": "Europe/Oslo"})


def test_files_that_cannot_be_read_are_refused(tmp_path):
    for path in (tmp_path, tmp_path / "none.epw"):
        with pytest.raises(InputError, match="cannot be read"):
            read_weather(path)


def test_columns_are_those_of_a_csv(tmp_path):
    path = write_epw(tmp_path / "a.epw", ALPS, np.zeros((3, 8760)))
    with pytest.raises(InputError, match="weather_columns: cannot be used with EPW"):
        read_weather(path, {"ghi": "ghi"})


def test_a_typical_year_with_an_hour_twice_is_refused(tmp_path):
    path = write_epw(tmp_path / "a.epw", ALPS, np.zeros((3, 8760)))
    path.write_bytes(path.read_bytes() + b"\n" + path.read_bytes().splitlines()[-1])
    with pytest.raises(InputError, match=r"has two records at 12-31 23:00\. Use a typical year"):
        read_weather(path)


def test_pvgis_without_times_that_fit_is_refused(tmp_path):
    """Without sunlight there is nothing to find the times by."""
    ghi, _, _ = clear_sky_hours(ALPS)
    overcast = np.stack([0.2 * ghi, 0.0 * ghi, 0.2 * ghi])
    with pytest.raises(InputError, match="fits no sun, so its times are not known"):
        read_weather(write_epw(tmp_path / "a.epw", ALPS, overcast, "ECMWF/ERA"))
    with pytest.raises(InputError, match="has no irradiance time offset"):
        read_weather(write_pvgis_csv(tmp_path / "a.csv", ALPS, overcast, None))
    assert len(read_weather(write_pvgis_csv(tmp_path / "a.csv", ALPS, overcast, 0.1761))) == 8760


def test_small_light_is_reported(tmp_path):
    times = [f"2023-06-21T{hour:02d}:00Z" for hour in range(24)]
    path = write_csv(tmp_path / "a.csv", DAY_HEADER, times, *(np.full(24, 0.9) for _ in range(3)))
    assert read_weather(path, {"stamp": "end"}).warnings == ("a.csv (CSV): its light reaches 0.9 W/m2. Check the unit.",)


def test_light_below_zero_at_night_is_none(tmp_path):
    times = [f"2023-06-21T{hour:02d}:00Z" for hour in range(24)]
    path = write_csv(tmp_path / "a.csv", DAY_HEADER, times, *(np.linspace(-3.0, 500.0, 24) for _ in range(3)))
    assert read_weather(path, {"stamp": "end"}).ghi.min() == 0.0
