"""``skugga irradiation --weather``: a file's light arrives on open ground, and what does not fit is told in one line."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas
import pvlib
import pytest
import rasterio
from pvlib import iotools, irradiance, location
from pyproj import Transformer

from tests.rasters import write_geotiff
from tests.shadows.irradiation.weather_files import Place, clear_sky_moments, local_hours, write_epw, write_pvgis_csv

pytestmark = pytest.mark.filterwarnings("ignore:DatetimeIndex.dayofyear")  # pvlib uses a name that pandas will drop

HERE = Place(9.0, 46.9, 1.0)
FAR_AWAY = Place(16.0, 46.9, 1.0)
CAROLINA = Place(-79.95, 36.1, -5.0)
"""The place of the TMY3 file 723170TYA.CSV that comes with pvlib."""
OTHER_HEMISPHERE = Place(9.0, -46.9, 1.0)


@pytest.fixture
def plain(tmp_path: Path) -> Path:
    """File of level ground at 250 m."""
    return write_geotiff(tmp_path / "plain.tif", np.full((9, 9), 250.0, np.float32), "EPSG:32632", 499_955.0, 5_194_300.0, 10.0)


def light_of(run, plain: Path, output: Path, *options: str) -> tuple[np.ndarray, dict[str, str], str]:
    """Return the values (rows, cols), tags and standard error of a run."""
    status, _, error = run("irradiation", str(plain), "-o", str(output), *options)
    assert status == 0, error
    with rasterio.open(output) as dataset:
        return dataset.read(1), dataset.tags(), error


def test_the_light_of_a_file_arrives_on_open_ground(run, plain, tmp_path):
    """Half of the powers of a clear sky on days in March give the file's own sums, and not those of a clear sky."""
    powers = 0.5 * local_hours(HERE)
    path = write_epw(tmp_path / "here.epw", HERE, powers)
    days = ["--date", "2023-03-10", "--to", "2023-03-12", "--clock", "+01:00"]
    values, tags, error = light_of(run, plain, tmp_path / "weather.tif", "--weather", str(path), *days)
    hours = slice(24 * (31 + 28 + 9), 24 * (31 + 28 + 12))
    # within an hour sunlight and its sine rise together, which one sun an hour does not see: 0.5 % of a level plane in March
    assert values[4, 4] == pytest.approx(powers[0, hours].sum() / 1000.0, rel=8e-3)
    assert tags["WEATHER"] == "here.epw" and "warning" not in error
    clear, tags, _ = light_of(run, plain, tmp_path / "clear.tif", *days)
    assert clear[4, 4] > 1.5 * values[4, 4] and tags["WEATHER"].startswith("clear sky")


def weather_by_pvlib(folder: Path, kind: str) -> tuple[Path, pandas.DataFrame, float]:
    """Return a weather file, what pvlib reads of it, and the minutes from its stamps to the middle of their hours."""
    tmy3 = Path(pvlib.__file__).parent / "data" / "723170TYA.CSV"
    frame, _ = iotools.read_tmy3(tmy3, map_variables=True, coerce_year=2023)
    if kind == "tmy3":
        return tmy3, frame, -30.0
    if kind == "epw":
        path = write_epw(folder / "a.epw", CAROLINA, frame[["ghi", "dni", "dhi"]].to_numpy().T, city="Greensboro")
        return path, iotools.read_epw(path, coerce_year=2023)[0], 30.0
    path = write_pvgis_csv(folder / "a.csv", CAROLINA, clear_sky_moments(CAROLINA, 10.566), 0.1761)
    return path, iotools.read_pvgis_tmy(path, map_variables=True)[0], 10.566


@pytest.mark.parametrize("kind", ["tmy3", "epw", "pvgis"])
def test_a_tilted_plane_receives_what_pvlib_makes_of_a_file(run, tmp_path, kind):
    """The sums of months, by pvlib's own readers, its sun in the middle of each hour, and its transposition."""
    path, frame, minutes = weather_by_pvlib(tmp_path, kind)
    east, north = Transformer.from_crs(4326, 32617, always_xy=True).transform(CAROLINA.lon_deg, CAROLINA.lat_deg)
    plain = write_geotiff(tmp_path / "dem.tif", np.full((9, 9), 273.0, np.float32), "EPSG:32617", east - 45.0, north + 45.0, 10.0)
    middle = frame.index + pandas.Timedelta(minutes=minutes)
    sun = location.Location(CAROLINA.lat_deg, CAROLINA.lon_deg, altitude=273.0).get_solarposition(middle)
    power = irradiance.get_total_irradiance(
        35.0, 160.0, sun["apparent_zenith"].to_numpy(), sun["azimuth"].to_numpy(),
        *(frame[part].to_numpy() for part in ("dni", "ghi", "dhi")),
        dni_extra=irradiance.get_extra_radiation(middle).to_numpy(), albedo=0.2, model="perez-driesse",
    )["poa_global"]  # fmt: skip
    is_up = sun["apparent_elevation"].to_numpy() > 0.0
    month = middle.tz_convert("Etc/GMT+5").month
    expected = np.bincount(month, np.where(is_up, power, 0.0), 13)[1:] / 1000.0
    status, out, error = run(
        "point", str(plain), "--at", f"{CAROLINA.lon_deg},{CAROLINA.lat_deg}", "--irradiation", "--year", "2023",
        "--tilt", "35", "--azimuth", "160", "--weather", str(path), "--json",
    )  # fmt: skip
    assert status == 0, error
    received = np.array([month["total"] for month in json.loads(out)["months"]])
    np.testing.assert_allclose(received, expected, rtol=0.01)
    assert received.sum() == pytest.approx(expected.sum(), rel=2e-3)


def test_weather_of_another_place_is_told(run, plain, tmp_path):
    path = write_epw(tmp_path / "far.epw", FAR_AWAY, local_hours(FAR_AWAY))
    _, _, error = light_of(run, plain, tmp_path / "y.tif", "--weather", str(path), "--date", "2023-03-10")
    assert "warning: " in error and "km away" in error and "minutes" in error


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--weather", "south.epw"], "south.epw (EPW): is at 46.9 S, the level at 46.9 N"),
        (["--weather", "here.epw", "--days", "mean"], "--days: cannot be combined with weather"),
        (["--weather", "here.epw", "--linke", "3"], "--linke: cannot be combined with weather"),
        (["--weather", "here.epw", "--step", "30m"], "--step: cannot be combined with weather"),
        (["--weather", "missing.epw"], "missing.epw"),
        (["--weather-columns", "ghi=G"], "--weather: missing. Columns are those of a weather file"),
    ],
)
def test_wrong_weather_is_one_line(run, plain, tmp_path, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    write_epw(tmp_path / "south.epw", OTHER_HEMISPHERE, local_hours(OTHER_HEMISPHERE))
    write_epw(tmp_path / "here.epw", HERE, local_hours(HERE))
    status, _, error = run("irradiation", str(plain), "-o", "y.tif", "--date", "2023-03-10", *options)
    assert status == 2 and message in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "y.tif").exists()


def test_a_point_has_the_light_of_a_file(run, plain, tmp_path):
    powers = 0.5 * local_hours(HERE)
    path = write_epw(tmp_path / "here.epw", HERE, powers)
    status, out, error = run(
        "point", str(plain), "--at", "9.0,46.9018", "--irradiation", "--year", "2023", "--weather", str(path), "--json"
    )
    assert status == 0 and "warning" not in error, error
    report = json.loads(out)
    assert report["weather"] == "here.epw" and len(report["months"]) == 12
    assert report["all_months"]["total"] == pytest.approx(powers[0].sum() / 1000.0, rel=8e-3)
    status, _, error = run("point", str(plain), "--at", "9.0,46.9018", "--weather", str(path))
    assert status == 2 and "--weather: needs irradiation" in error
