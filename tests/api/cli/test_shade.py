"""``skugga shade``: many times, file names, and one line for what is wrong."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from api.cli.times import suns_of
from terrain.errors import InputError
from tests.rasters import write_geotiff


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    row, col = np.mgrid[:90, :120].astype(np.float32)
    return write_geotiff(tmp_path / "dem.tif", 300 * np.sin(col / 9) * np.cos(row / 13), "EPSG:32633", 500e3, 5200e3, 30.0)


def test_from_a_raster_to_its_mask_is_one_command(run, raster, tmp_path):
    status, out, err = run("shade", str(raster), "-o", str(tmp_path / "mask.tif"))
    assert (status, out) == (0, "") and err.startswith("skugga: dem is drawn with its own light")
    with rasterio.open(tmp_path / "mask.tif") as dataset:
        assert 0.02 < (dataset.read(1) == 0).mean() < 0.7


def test_on_a_terminal_it_is_said_which_sun_nobody_chose(run, raster, tmp_path, monkeypatch):
    monkeypatch.setattr("api.cli.warnings.sys", SimpleNamespace(stderr=SimpleNamespace(isatty=lambda: True)))
    status, _, err = run("shade", str(raster), "-o", str(tmp_path / "mask.tif"))
    assert status == 0 and err.startswith("skugga: dem is drawn with its own light, the sun ") and "--time" in err
    asked = "--azimuth", "200", "--altitude", "30"
    status, _, err = run("shade", str(raster), *asked, "-o", str(tmp_path / "mask.tif"))
    assert status == 0 and "own light" not in err


def test_a_day_of_masks(run, raster, tmp_path):
    day = ("--from", "2024-03-21T08:00:00+01:00", "--to", "2024-03-21T12:00:00+01:00", "--step", "2h")
    assert run("shade", str(raster), *day, "-o", str(tmp_path / "m_{time}.tif")) == (0, "", "")
    names = sorted(path.name for path in tmp_path.glob("m_*.tif"))
    assert names == ["m_20240321T070000Z.tif", "m_20240321T090000Z.tif", "m_20240321T110000Z.tif"]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("-o", "m.png"), ("--output", "m.png", ".tif")),
        (("-o", "m.tif", "--layer", "depth"), ("--layer", "depth", "mask", "cosi")),
        (("-o", "m.tif", "--times", "2024-03-21T08:00Z,2024-03-21T09:00Z"), ("{time}",)),
        (("-o", "m{time}.tif", "--times", "2024-03-21T08:00Z,2024-03-21T08:00Z"), ("--times", "twice")),
        (("-o", "m.tif", "--times", "2024-02-30T08:00Z"), ("time", "2024-02-30")),
        (("-o", "m.tif", "--like", "nowhere.tif"), ("nowhere.tif", "GDAL")),
        (("-o", "nowhere/m.tif",), ("nowhere/m.tif",)),
        (("-o", "m.tif", "--bounds", "0,0,9,9"), ("bounds", "UTM zone 33N")),
    ],
)  # fmt: skip
def test_wrong_input(run, raster, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    status, out, err = run("shade", "dem.tif", *options)
    assert status in (1, 2) and out == "" and err.count("\n") == 1
    for word in words:
        assert word in err
    assert [path.name for path in tmp_path.iterdir()] == ["dem.tif"]


def test_times_from_to_by_steps():
    suns = suns_of(None, None, "2024-03-21T08:00+01:00", "2024-03-21T09:00+01:00", "15m")
    assert [sun.time.isoformat() for sun in suns if sun] == [f"2024-03-21T08:{m:02}:00+01:00" for m in (0, 15, 30, 45)] + [
        "2024-03-21T09:00:00+01:00"
    ]
    assert suns_of(None, None, None, None, None) == [None]


@pytest.mark.parametrize(
    "given",
    [
        (None, None, "2024-03-21T08:00Z", None, None), (None, None, "2024-03-21T08:00Z", "2024-03-21T09:00Z", "0m"),
        (None, None, "2024-03-21T09:00Z", "2024-03-21T08:00Z", "15m"), (None, "2024-03-21T09:00Z", "2024-03-21T08:00Z", None, None),
        (None, None, "2024-03-21T08:00Z", "2034-03-21T09:00Z", "1s"), (None, None, "2024-03-21T08:00Z", "2024-03-21T09:00Z", "15x"),
    ],
)  # fmt: skip
def test_times_that_are_none(given):
    with pytest.raises(InputError):
        suns_of(*given)
