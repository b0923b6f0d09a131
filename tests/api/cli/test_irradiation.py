"""``skugga irradiation``: its file, its blocks, its options, and their errors in one line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import rasterio

from benchmarks.sweep_speed import fractal_heights_m
from skugga.api.products import PRODUCTS
from skugga.shadows.horizons import block_ground
from skugga.terrain.geo.world import World
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.rasters import ENGINEERING, write_geotiff


@pytest.fixture
def raster(tmp_path: Path) -> Path:
    """File of fractal mountains."""
    return write_geotiff(tmp_path / "own.tif", fractal_heights_m(150), "EPSG:32632", 500e3, 5200e3, 30.0)


@pytest.fixture
def world(raster: Path) -> World:
    """The world of the mountains."""
    scene = build_scene(load_level(raster))
    scene.close()
    return scene.world


def read(path: Path) -> tuple[np.ndarray, dict[str, str]]:
    """Return the values (rows, cols) and the tags of a file."""
    with rasterio.open(path) as dataset:
        return dataset.read(1), {**dataset.tags(), "unit": dataset.units[0]}


def test_a_file_holds_the_sum_of_its_dates(run, raster, tmp_path):
    days = ["2024-06-21", "2024-06-22"]
    sums = []
    for first, last in ((days[0], days[0]), (days[1], days[1]), (days[0], days[1])):
        path = tmp_path / f"{first}-{last}.tif"
        status, _, error = run("irradiation", str(raster), "-o", str(path), "--date", first, "--to", last, "--plane", "level")
        assert status == 0, error
        values, tags = read(path)
        sums.append(values)
    assert tags["unit"] == "kWh/m2" and tags["PART"] == "total" and tags["DATES"] == "2"
    np.testing.assert_allclose(sums[0] + sums[1], sums[2], rtol=1e-5)
    assert 6.0 < np.median(sums[0]) < 10.0, "a clear day in June at 47 degrees north"


def test_a_year_is_all_of_its_dates(run, raster, tmp_path):
    status, _, error = run(
        "irradiation", str(raster), "-o", str(tmp_path / "year.tif"), "--year", "2023", "--part", "sky", "--bounds",
        "500300,5199400,500600,5199700",
    )  # fmt: skip
    assert status == 0, error
    values, tags = read(tmp_path / "year.tif")
    assert (tags["DATE"], tags["DATE_TO"], tags["DATES"]) == ("2023-01-01", "2023-12-31", "365")
    assert (values > 50.0).all() and (values < 700.0).all()


def test_blocks_of_irradiation_join(run, raster, tmp_path, monkeypatch):
    values = []
    for side in (block_ground.BLOCK_SIDE_NODES, 64):
        monkeypatch.setattr(block_ground, "BLOCK_SIDE_NODES", side)
        monkeypatch.setattr(block_ground, "MIN_BLOCK_SIDE_NODES", min(side, block_ground.MIN_BLOCK_SIDE_NODES))
        path = tmp_path / f"{side}.tif"
        status, _, error = run("irradiation", str(raster), "-o", str(path), "--date", "2024-03-21", "--step", "60m")
        assert status == 0, error
        values.append(read(path)[0])
    difference = np.abs(values[1] - values[0])
    assert difference.mean() < 2e-3 * values[0].mean()
    assert np.median(difference[:, 62:66]) < 4e-3 * values[0].mean(), "no seam between blocks"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "--year: missing. Give a year, or --date"),
        (["--year", "2023", "--date", "2023-01-01"], "--date: cannot be combined with --year"),
        (["--year", "2023", "--to", "2023-02-01"], "--to: cannot be combined with --year"),
        (["--year", "1500"], "--year: '1500' is not allowed"),
        (["--date", "2023-02-29"], "--date: '2023-02-29' is not allowed"),
        (["--date", "2023-02-02", "--to", "2023-02-01"], "--to: '2023-02-01' is not allowed. Allowed: 2023-02-02 or later"),
        (["--year", "2023", "--albedo", "-0.1"], "--albedo: '-0.1' is not allowed. Allowed: 0 to 1"),
        (["--year", "2023", "--albedo", "nan"], "--albedo: 'nan' is not allowed"),
        (["--year", "2023", "--linke", "0"], "--linke: '0.0' is not allowed"),
        (["--year", "2023", "--part", "moon"], "--part: 'moon' is not allowed"),
        (["--year", "2023", "--plane", "wall"], "--plane: 'wall' is not allowed"),
        (["--year", "2023", "--step", "2h"], "--step: '2h' is not allowed"),
        (["--year", "2023", "--clock", "Europe/Gotham"], "--clock: 'Europe/Gotham'"),
        (["--year", "2023", "-o", "year.png"], "--output: 'year.png'"),
        (["--year", "2023", "--tilt", "190"], "--tilt: '190.0' is not allowed"),
        (["--year", "2023", "--azimuth", "90"], "--tilt: missing. An azimuth needs the tilt of the plane"),
        (["--year", "2023", "--tilt", "30", "--plane", "level"], "--plane: cannot be combined with tilt"),
        (["--year", "2023", "--per", "hour"], "--per: 8760 bands"),
        (["--year", "2023", "--per", "week"], "--per: 'week' is not allowed"),
        (["--year", "2023", "--per", "day", "--days", "mean"], "--per: cannot be combined with days=mean"),
        (["--date", "2023-03-26", "--per", "hour", "--clock", "Europe/Oslo"], "clock: 'Europe/Oslo' is not allowed"),
        (["--year", "2023", "--transmissivity", "2"], "--transmissivity: '2.0' is not allowed. Allowed: 0 to 1"),
    ],
)
def test_wrong_options_are_one_line(run, raster, tmp_path, options, message):
    status, _, error = run("irradiation", str(raster), "-o", str(tmp_path / "y.tif"), *options)
    assert status == 2
    assert message in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "y.tif").exists()


def test_an_engineering_crs_has_no_year(run, tmp_path):
    flat = write_geotiff(tmp_path / "flat.tif", np.zeros((9, 9), np.float32), ENGINEERING, 0.0, 90.0, 10.0)
    status, _, error = run("irradiation", str(flat), "-o", str(tmp_path / "y.tif"), "--year", "2023")
    assert status == 2 and "engineering" in error and len(error.strip().splitlines()) == 1


def test_flat_tops_of_cells_are_refused(run, tmp_path):
    write_geotiff(tmp_path / "flat.tif", np.zeros((9, 9), np.float32), "EPSG:32632", 500e3, 5200e3, 10.0)
    level = tmp_path / "level.yaml"
    level.write_text("version: 1\nterrain: {source: flat.tif, surface: blocks}\nsun: none\n", encoding="utf-8")
    status, _, error = run("irradiation", str(level), "-o", str(tmp_path / "y.tif"), "--year", "2023")
    assert status == 2 and "smooth ground" in error and len(error.strip().splitlines()) == 1


@pytest.mark.parametrize(("part", "low", "high"), [("total", 8.0, 20.0), ("reflected", 1.0, 4.0), ("beam", 8.0, 20.0)])
def test_the_color_scale_holds_open_ground(world, part, low, high):
    product = PRODUCTS["irradiation"]
    assert product.color_scale is not None
    scale = product.color_scale(product.options_of({"date": "2024-06-21", "part": part}), world)
    assert scale.low == 0.0 and low <= scale.high <= high and "21 June 2024" in scale.title
    winter = product.color_scale(product.options_of({"date": "2024-12-21", "part": part}), world)
    assert winter.high < scale.high
