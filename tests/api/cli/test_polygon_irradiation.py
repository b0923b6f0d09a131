"""``skugga irradiation --polygons``: means, sums, slopes and azimuths of polygons, and what has none."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely

from tests.rasters import write_geotiff

WEST, NORTH, CELL_M, SIDE = 500_000.0, 5_200_000.0, 10.0, 40
TILT_DEG = 30.0


@pytest.fixture
def slope(tmp_path: Path) -> Path:
    """File of a plane that falls to the east, with a hole in a corner."""
    heights = np.tile(np.float32(500.0 - np.tan(np.radians(TILT_DEG)) * CELL_M / 0.9996 * np.arange(SIDE)), (SIDE, 1))
    heights[:4, :4] = np.nan
    return write_geotiff(tmp_path / "slope.tif", heights, "EPSG:32632", WEST, NORTH, CELL_M)


def square(west: float, north: float, side: float) -> dict:
    """Return a square as a GeoJSON feature; west and north are cells from the raster's corner, the side is cells too."""
    box = shapely.box(WEST + west * CELL_M, NORTH - (north + side) * CELL_M, WEST + (west + side) * CELL_M, NORTH - north * CELL_M)
    return {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(box))}


def write_squares(path: Path, *squares: dict) -> Path:
    """Write squares as a GeoJSON file in the raster's CRS."""
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": list(squares)}), "utf-8")
    return path


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a CSV."""
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_polygon_has_the_mean_and_the_sum_of_its_cells(run, slope, tmp_path):
    squares = write_squares(
        tmp_path / "squares.geojson", square(10, 12, 5), square(20.2, 20.2, 0.4), square(60, 5, 5), square(0, 0, 4)
    )
    options = ["--date", "2024-06-21"]
    status, _, error = run("irradiation", str(slope), "-o", str(tmp_path / "day.tif"), *options)
    assert status == 0, error
    status, _, error = run("irradiation", str(slope), "--polygons", str(squares), "-o", str(tmp_path / "day.csv"), *options)
    assert status == 0, error
    with rasterio.open(tmp_path / "day.tif") as dataset:
        values = dataset.read(1)
    whole, small, outside, hole = table(tmp_path / "day.csv")
    mean = values[13:16, 11:14].mean()  # inner cells
    cell_m2 = (CELL_M / 0.9996) ** 2 / np.cos(np.radians(TILT_DEG))
    assert whole["cells"] == "25" and float(whole["kwh_m2"]) == pytest.approx(mean, rel=1e-4)  # suns at the middle of each block
    assert float(whole["area_m2"]) == pytest.approx(25 * cell_m2, rel=1e-3)
    assert float(whole["kwh"]) == pytest.approx(25 * cell_m2 * mean, rel=1e-3)
    assert float(whole["slope_deg"]) == pytest.approx(TILT_DEG, abs=0.05)
    assert float(whole["azimuth_deg"]) == pytest.approx(90.0, abs=0.1)
    assert all(len(whole[name].replace(".", "")) <= 6 for name in ("area_m2", "slope_deg", "azimuth_deg", "kwh_m2", "kwh"))
    assert small["cells"] == "1" and float(small["kwh_m2"]) == pytest.approx(values[20, 20], rel=1e-4)
    for row in (outside, hole):
        assert row["cells"] == "0" and row["kwh_m2"] == "" and row["remark"] == "outside of the level's ground"


@pytest.mark.parametrize("suffix", [".csv", ".gpkg", ".geojson"])
def test_polygons_keep_their_attributes(run, slope, tmp_path, suffix):
    beds, out = [square(10, 12, 5), square(20, 20, 5)], tmp_path / f"beds{suffix}"
    beds[0]["properties"] = {"name": "Möhren, früh", "row": 3, "area_m2": 1.5, "crops": ["carrot", "leek"]}
    beds[1]["properties"] = {"name": None, "row": 4, "area_m2": 2.5, "crops": []}
    squares = write_squares(tmp_path / "squares.geojson", *beds)
    status, _, error = run("irradiation", str(slope), "--polygons", str(squares), "-o", str(out), "--date", "2024-06-21")
    assert status == 0, error
    meta, _, _, columns = pyogrio.raw.read(out, read_geometry=False)
    values = dict(zip(meta["fields"], columns, strict=True))
    assert list(values)[:5] == ["name", "row", "area_m2_", "crops", "feature"]
    assert values["name"][0] == "Möhren, früh" and values["name"][1] in (None, "")
    np.testing.assert_allclose(values["row"].astype(float), [3, 4])
    np.testing.assert_allclose(values["area_m2_"].astype(float), [1.5, 2.5])
    assert "carrot" in values["crops"][0] and "leek" in values["crops"][0]
    assert (values["area_m2"].astype(float) > 2000.0).all()


def test_a_narrow_polygon_between_centres_has_a_cell(run, slope, tmp_path):
    strip = shapely.box(WEST + 10.6 * CELL_M, NORTH - 25.0 * CELL_M, WEST + 10.9 * CELL_M, NORTH - 12.0 * CELL_M)
    feature = {"type": "Feature", "properties": {}, "geometry": json.loads(shapely.to_geojson(strip))}
    squares = write_squares(tmp_path / "strip.geojson", feature)
    arguments = ["--polygons", str(squares), "--date", "2024-06-21", "-o", str(tmp_path / "strip.csv")]
    status, _, error = run("irradiation", str(slope), *arguments)
    assert status == 0, error
    (row,) = table(tmp_path / "strip.csv")
    assert row["cells"] == "1" and float(row["slope_deg"]) == pytest.approx(TILT_DEG, abs=0.05) and row["remark"] == ""


def test_polygons_have_a_column_for_each_month(run, slope, tmp_path):
    squares = write_squares(tmp_path / "squares.geojson", square(10, 12, 5))
    output = tmp_path / "months.geojson"
    status, _, error = run(
        "irradiation", str(slope), "--polygons", str(squares), "-o", str(output), "--year", "2023", "--days", "mean", "--per",
        "month", "--tilt", "35",
    )  # fmt: skip
    assert status == 0, error
    meta, _, geometry, columns = pyogrio.raw.read(output)
    values = {name: column[0] for name, column in zip(meta["fields"], columns, strict=True)}
    months = [values[f"kwh_m2 irradiation 2023-{month:02d}"] for month in range(1, 13)]
    assert min(months) in (months[0], *months[10:])
    assert 1200.0 < sum(months) < 2600.0 and values["slope_deg"] == pytest.approx(35.0, abs=0.01)
    assert shapely.bounds(shapely.from_wkb(geometry[0]))[0] == pytest.approx(9.0, abs=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "year.tif"], "--output: 'year.tif' is not allowed. Allowed: a table of polygons: .gpkg, .geojson, .csv"),
        (["-o", "year.csv", "--resolution", "5"], "--resolution: cannot be combined with --polygons"),
    ],
)
def test_wrong_options_are_one_line(run, slope, tmp_path, options, message):
    squares = write_squares(tmp_path / "squares.geojson", square(10, 12, 5))
    status, _, error = run("irradiation", str(slope), "--polygons", str(squares), "--date", "2024-06-21", *options)
    assert status == 2 and message in error and len(error.strip().splitlines()) == 1


def test_polygons_off_the_data_are_one_line(run, slope, tmp_path):
    squares = write_squares(tmp_path / "squares.geojson", square(400, 12, 5))
    arguments = ["--polygons", str(squares), "--date", "2024-06-21", "-o", str(tmp_path / "day.csv")]
    status, _, error = run("irradiation", str(slope), *arguments)
    assert status == 2 and "squares.geojson" in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "day.csv").exists()


def test_a_flat_roof_of_a_surface_model_has_its_own_area(run, tmp_path):
    """Cells at the edge of a block of 20 m have the slope of its walls, which does not count."""
    heights = np.zeros((60, 60), np.float32)
    heights[20:40, 20:40] = 20.0
    raster = write_geotiff(tmp_path / "block.tif", heights, "EPSG:32632", WEST, NORTH, CELL_M)
    squares = write_squares(tmp_path / "roof.geojson", square(20, 20, 20))
    arguments = ["--polygons", str(squares), "--date", "2024-06-21", "-o", str(tmp_path / "roof.csv")]
    status, _, error = run("irradiation", str(raster), *arguments)
    assert status == 0, error
    (roof,) = table(tmp_path / "roof.csv")
    assert roof["cells"] == "400" and float(roof["area_m2"]) == pytest.approx(400 * (CELL_M / 0.9996) ** 2, rel=1e-3)
    assert float(roof["slope_deg"]) < 0.05 and roof["azimuth_deg"] == ""
