"""``skugga shade``: several times, file names, and errors in one line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from skugga.api.cli.times import suns_from_options
from skugga.terrain.errors import InputError
from tests.rasters import write_geotiff


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    """File of a raster of hills."""
    row, col = np.mgrid[:90, :120].astype(np.float32)
    return write_geotiff(tmp_path / "dem.tif", 300 * np.sin(col / 9) * np.cos(row / 13), "EPSG:32633", 500e3, 5200e3, 30.0)


def test_shade_writes_the_mask_of_a_raster(run, raster, tmp_path):
    status, out, err = run("shade", str(raster), "-o", str(tmp_path / "mask.tif"))
    assert (status, out) == (0, "") and err.startswith("skugga: dem is drawn with its default light")
    with rasterio.open(tmp_path / "mask.tif") as dataset:
        assert 0.02 < (dataset.read(1) == 0).mean() < 0.7


def test_a_terminal_shows_which_default_light_is_used(run, raster, tmp_path, monkeypatch):
    monkeypatch.setattr("skugga.api.cli.warnings.sys", SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: True)))
    status, _, err = run("shade", str(raster), "-o", str(tmp_path / "mask.tif"))
    assert status == 0 and err.startswith("skugga: dem is drawn with its default light, the sun ") and "--time" in err
    sun_options = "--azimuth", "200", "--altitude", "30"
    status, _, err = run("shade", str(raster), *sun_options, "-o", str(tmp_path / "mask.tif"))
    assert status == 0 and "default light" not in err


def test_several_times_write_one_file_each(run, raster, tmp_path):
    day = ("--from", "2024-03-21T08:00:00+01:00", "--to", "2024-03-21T12:00:00+01:00", "--step", "2h")
    assert run("shade", str(raster), *day, "-o", str(tmp_path / "m_{time}.tif")) == (0, "", "")
    names = sorted(path.name for path in tmp_path.glob("m_*.tif"))
    assert names == ["m_20240321T070000Z.tif", "m_20240321T090000Z.tif", "m_20240321T110000Z.tif"]


@pytest.mark.parametrize(
    ("options", "expected_texts"),
    [
        (("-o", "m.png"), ("--output", "m.png", ".tif")),
        (("-o", "m.tif", "--layer", "depth"), ("--layer", "depth", "mask", "cosi")),
        (("-o", "m.tif", "--times", "2024-03-21T08:00Z,2024-03-21T09:00Z"), ("{time}",)),
        (("-o", "m{time}.tif", "--times", "2024-03-21T08:00Z,2024-03-21T08:00Z"), ("--times", "twice")),
        (("-o", "m.tif", "--times", "2024-02-30T08:00Z"), ("time", "2024-02-30")),
        (("-o", "m.tif", "--like", "nowhere.tif"), ("nowhere.tif", "GDAL")),
        (("-o", "nowhere/m.tif",), ("nowhere/m.tif",)),
        (("-o", "m.tif", "--slope-exaggeration", "2"), ("--slope-exaggeration", "mask", "--layer color")),
        (("-o", "m.tif", "--layer", "color", "--sky", "dark"), ("sky", "dark", "overcast")),
        (("-o", "m.tif", "--layer", "color", "--style", "pretty"), ("--style", "pretty", "swiss", ".yaml")),
        (("-o", "m.tif", "--layer", "color", "--style", "none.yaml"), ("none.yaml", "No such file")),
        (("-o", "m.tif", "--bounds", "0,0,9,9"), ("bounds", "UTM zone 33N")),
    ],
)  # fmt: skip
def test_wrong_input_of_shade_is_one_line(run, raster, tmp_path, monkeypatch, options, expected_texts):
    monkeypatch.chdir(tmp_path)
    status, out, err = run("shade", "dem.tif", *options)
    assert status in (1, 2) and out == "" and err.count("\n") == 1
    for text in expected_texts:
        assert text in err
    assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]


COMMANDS = ("shade", "--azimuth", "200", "--altitude", "30"), ("sunhours", "--date", "2024-03-21", "--step", "1h")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command[0])
@pytest.mark.parametrize(
    ("crs", "corner", "cell", "overlap"),
    [
        ("EPSG:32633", (500e3, 5200e3), 30.0, "within"),
        ("EPSG:32633", (500e3 - 20.0, 5200e3 + 20.0), 30.0, "within"),  # less than a cell
        ("EPSG:32633", (499.1e3, 5200e3), 30.0, "in part"),
        ("EPSG:32633", (503.6e3, 5200e3), 30.0, "not"),
        ("EPSG:4326", (15.001, 46.952), 3e-4, "within"),
        ("EPSG:4326", (375.001, 46.952), 3e-4, "within"),  # 360 degrees further
        ("EPSG:4326", (15.03, 46.952), 3e-4, "in part"),
        ("EPSG:4326", (-15.0, 46.952), 3e-4, "not"),
    ],
)
def test_like_reports_an_extent_outside_the_level(run, raster, tmp_path, command, crs, corner, cell, overlap):
    """The raster of ``--like`` has 60 x 60 cells; the level has 90 x 120."""
    like_raster, output = (
        write_geotiff(tmp_path / "like.tif", np.zeros((60, 60), np.uint8), crs, *corner, cell),
        tmp_path / "out.tif",
    )
    status, _, err = run(command[0], str(raster), *command[1:], "--like", str(like_raster), "-o", str(output))
    assert output.exists() == (overlap != "not")
    if overlap == "within":
        assert (status, err) == (0, "")
        return
    west, north = corner
    extents = f"{west:.9g},{north - 60 * cell:.9g},{west + 60 * cell:.9g},{north:.9g}", ("500000,5197300,503600,5200000")
    assert err.count("\n") == 1 and extents[0] in err and (extents[1] in err or crs == "EPSG:4326")
    assert (status, "skugga: warning: " in err) == ((2, False) if overlap == "not" else (0, True))
    if overlap == "in part":
        with rasterio.open(output) as dataset:
            assert 0.0 < dataset.dataset_mask().astype(bool).mean() < 1.0


def test_from_to_and_step_give_times():
    suns = suns_from_options(None, None, "2024-03-21T08:00+01:00", "2024-03-21T09:00+01:00", "15m")
    assert [sun.time.isoformat() for sun in suns if sun] == [f"2024-03-21T08:{m:02}:00+01:00" for m in (0, 15, 30, 45)] + [
        "2024-03-21T09:00:00+01:00"
    ]
    assert suns_from_options(None, None, None, None, None) == [None]


@pytest.mark.parametrize(
    "arguments",
    [
        (None, None, "2024-03-21T08:00Z", None, None), (None, None, "2024-03-21T08:00Z", "2024-03-21T09:00Z", "0m"),
        (None, None, "2024-03-21T09:00Z", "2024-03-21T08:00Z", "15m"), (None, "2024-03-21T09:00Z", "2024-03-21T08:00Z", None, None),
        (None, None, "2024-03-21T08:00Z", "2034-03-21T09:00Z", "1s"), (None, None, "2024-03-21T08:00Z", "2024-03-21T09:00Z", "15x"),
    ],
)  # fmt: skip
def test_invalid_times_are_refused(arguments):
    with pytest.raises(InputError):
        suns_from_options(*arguments)


def test_a_style_file_gives_the_colours(run, raster, tmp_path):
    style = tmp_path / "style.yaml"
    style.write_text("name: analysis\nramp: [[0, '#ff0000']]\n", encoding="utf-8")
    for name, options, is_red in (("file", ("--style", str(style)), True), ("name", ("--style", "analysis"), False)):
        path = tmp_path / f"{name}.tif"
        arguments = ("-o", str(path), "--layer", "color", "--azimuth", "225", "--altitude", "60", *options)
        assert run("shade", str(raster), *arguments) == (0, "", "")
        with rasterio.open(path) as dataset:
            red, green, blue = dataset.read([1, 2, 3]).astype(int)
        assert ((red > 100).any() and (green < red / 2).all() and (blue < red / 2).all()) == is_red


def test_colour_rasters_follow_the_style_and_its_sky(run, raster, tmp_path):
    pictures = []
    for name, options in (("level", ()), ("swiss", ("--style", "swiss")), ("overcast", ("--sky", "overcast"))):
        path = tmp_path / f"{name}.tif"
        arguments = ("-o", str(path), "--layer", "color", "--azimuth", "225", "--altitude", "20", *options)
        assert run("shade", str(raster), *arguments) == (0, "", "")
        with rasterio.open(path) as dataset:
            pictures.append(dataset.read([1, 2, 3]).astype(int))
    assert all(np.abs(picture - pictures[0]).max() > 10 for picture in pictures[1:])
