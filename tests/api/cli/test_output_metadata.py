"""Tags and messages about the outputs of ``shade``, ``sunhours``, ``point`` and ``levels``."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
from rasterio.enums import ColorInterp
from rich.console import Console

from skugga.api.catalogue import bundled_levels
from skugga.api.cli.tables import table_with_names
from tests.rasters import write_geotiff

SUN = ("--azimuth", "250", "--altitude", "12")


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    """File of a raster of hills."""
    row, col = np.mgrid[:90, :120].astype(np.float32)
    return write_geotiff(tmp_path / "dem.tif", 300 * np.sin(col / 9) * np.cos(row / 13), "EPSG:32633", 500e3, 5200e3, 30.0)


@pytest.fixture
def stderr_is_terminal(monkeypatch) -> None:
    """Make warnings believe that standard error is a terminal."""
    monkeypatch.setattr("skugga.api.cli.warnings.sys", SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: True)))


@pytest.mark.parametrize("layer", ["mask", "visibility", "cosi"])
def test_a_shade_raster_has_tags_of_sun_layer_and_algorithm(run, raster, tmp_path, layer):
    out = tmp_path / "out.tif"
    sun = ("--time", "2024-03-21T09:00:00+01:00")
    assert run("shade", str(raster), *sun, "--layer", layer, "--algorithm", "sweep", "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset:
        tags, (description,), (unit,) = dataset.tags(), dataset.descriptions, dataset.units
        assert dataset.colorinterp == (ColorInterp.gray,)
        assert dataset.crs.to_epsg() == 32633 and dataset.shape == (90, 120)
    assert tags["LAYER"] == layer and tags["LEVEL"] == "dem"
    assert tags.get("ALGORITHM") == (None if layer == "cosi" else "sweep")  # cosi has no cast shadows
    assert tags["TIME"] == "2024-03-21T09:00:00+01:00" and tags["TIFFTAG_SOFTWARE"] == f"Skugga {version('skugga')}"
    # By hand, for 46.94 degrees north at 15 degrees east, an hour angle of -46.8 and a declination of 0.3 degrees.
    assert float(tags["SUN_AZIMUTH_DEG"]) == pytest.approx(124.2, abs=0.5)
    assert float(tags["SUN_ALTITUDE_DEG"]) == pytest.approx(28.2, abs=0.5)
    assert description and description in tags["TIFFTAG_IMAGEDESCRIPTION"]
    assert unit == (None if layer == "mask" else "1")


@pytest.mark.parametrize(("altitude", "algorithm"), [("12", "sweep"), ("-1", "none")])
def test_a_shade_raster_states_the_algorithm_that_ran(run, raster, tmp_path, altitude, algorithm):
    out = tmp_path / "out.tif"
    assert run("shade", str(raster), "--azimuth", "250", "--altitude", altitude, "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset:
        assert dataset.tags()["ALGORITHM"] == algorithm


@pytest.mark.parametrize("layer", ["color", "shadow"])
def test_colour_bands_have_names_and_interpretations(run, raster, tmp_path, layer):
    assert run("shade", str(raster), *SUN, "--layer", layer, "-o", str(tmp_path / "out.tif")) == (0, "", "")
    with rasterio.open(tmp_path / "out.tif") as dataset:
        assert dataset.colorinterp == (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
        assert dataset.descriptions == ("red", "green", "blue", "alpha")
        assert dataset.tags()["SUN_AZIMUTH_DEG"] == "250.0000" and "TIME" not in dataset.tags()


def test_each_of_many_rasters_has_its_own_time(run, raster, tmp_path):
    times = "2024-03-21T08:00:00+01:00,2024-03-21T10:00:00+01:00"
    assert run("shade", str(raster), "--times", times, "-o", str(tmp_path / "m_{time}.tif")) == (0, "", "")
    tag_times = []
    for path in sorted(tmp_path.glob("m_*.tif")):
        with rasterio.open(path) as dataset:
            tag_times.append(dataset.tags()["TIME"])
    assert tag_times == times.split(",")


@pytest.mark.parametrize(
    ("quantity", "unit", "expected_text"),
    [("hours", "h", "direct sun"), ("first", "min", "midnight"), ("longest", "h", "longest"), ("days", "d", "days")],
)
def test_a_raster_of_hours_has_dates_clock_and_unit(run, raster, tmp_path, quantity, unit, expected_text):
    out = tmp_path / "hours.tif"
    day = ("--date", "2024-12-20", "--to", "2024-12-22", "--window", "08:00-16:00", "--clock", "+01:00", "--step", "60m")
    assert run("sunhours", str(raster), *day, "--quantity", quantity, "-o", str(out)) == (0, "", "")
    with rasterio.open(out) as dataset:
        tags, (description,) = dataset.tags(), dataset.descriptions
        assert dataset.units == (unit,)
    assert expected_text in description
    expected_tags = {
        "QUANTITY": quantity, "DATE": "2024-12-20", "DATE_TO": "2024-12-22", "DATES": "3", "WINDOW": "08:00-16:00",
        "CLOCK": "+01:00", "STEP_MIN": "60", "LEAST_ALTITUDE_DEG": "0", "HEIGHT_M": "0",
    }  # fmt: skip
    assert {name: tags.get(name) for name in expected_tags} == expected_tags
    assert tags.get("THRESHOLD_H") == ("2" if quantity == "days" else None)


def test_a_whole_day_of_solar_time_has_the_window_0_to_24(run, raster, tmp_path):
    assert run("sunhours", str(raster), "--date", "2024-12-21", "--step", "60m", "-o", str(tmp_path / "h.tif")) == (0, "", "")
    with rasterio.open(tmp_path / "h.tif") as dataset:
        assert dataset.tags()["WINDOW"] == "00:00-24:00" and dataset.tags()["CLOCK"] == "solar"


def test_the_default_light_is_reported_without_a_terminal(run, raster, tmp_path):
    status, out, err = run("shade", str(raster), "-o", str(tmp_path / "mask.tif"))
    assert (status, out, err.count("\n")) == (0, "", 1)
    assert "dem is drawn with its default light, the sun " in err and "--time" in err
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\nterrain: {source: dem.tif}\nsun: {azimuth: 235, altitude: 22}\n")
    assert run("shade", str(level), "-o", str(tmp_path / "mask.tif")) == (0, "", "")


def test_a_terminal_shows_what_was_written(run, raster, tmp_path, stderr_is_terminal):
    out = tmp_path / "mask.tif"
    status, _, err = run("shade", str(raster), *SUN, "-o", str(out))
    assert status == 0 and err.count("\n") == 1
    assert f"wrote {out}: mask, gray: 0 shadow, 255 lit" in err and "120 x 90 cells, WGS 84 / UTM zone 33N" in err
    status, _, err = run("sunhours", str(raster), "--date", "2024-12-21", "--step", "60m", "-o", str(tmp_path / "h.tif"))
    assert status == 0 and "hours of direct sun, mean of the dates (h), 120 x 90 cells" in err


def test_a_date_alone_reports_no_sun_position(run, raster):
    place = ("--at", "501500,5199000", "--crs", "EPSG:32633")
    for options in (("--date", "2024-12-21"), ()):
        status, out, _ = run("point", str(raster), *place, *options)
        assert status == 0 and "own sun" not in out and "azimuth" not in out and "sunrise" in out
    status, out, _ = run("point", str(raster), *place, "--time", "2024-12-21T12:00:00+01:00")
    assert status == 0 and "2024-12-21T12:00:00+01:00: " in out and "sun at azimuth" in out


def test_names_of_levels_are_never_truncated(run, monkeypatch):
    monkeypatch.setenv("COLUMNS", "50")
    status, out, _ = run("levels")
    assert status == 0
    first_words = {line.split()[0] for line in out.splitlines() if line.split()}
    assert {path.stem for path in bundled_levels()} <= first_words
    assert "…" not in out


def test_the_first_column_of_a_narrow_table_is_whole(capsys):
    table = table_with_names("name", "title", "views", box=None)
    table.add_row("a_name_that_somebody_has_to_type", "a long title of some words " * 3, "map, ridge")
    Console(width=60).print(table)
    assert "a_name_that_somebody_has_to_type" in capsys.readouterr().out
