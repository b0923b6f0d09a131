"""QGIS without a window opens the files of irradiation: rasters by month, hours of shade as bits, and polygons."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio
import shapely

from skugga.api.cli import main as cli
from tests.clients.test_qgis import PYTHON
from tests.rasters import write_geotiff

WEST, NORTH, CELL_M, SIDE = 500_000.0, 5_200_000.0, 30.0, 33

ROW, COL = 20, 12
"""The cell that QGIS identifies."""

TIMEOUT_S = 300


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a year of irradiation, hours of shade of a month, and polygons, as the command writes them."""
    folder = tmp_path_factory.mktemp("files")
    row, col = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2.0
    hill = 200.0 * np.exp(-(row**2 + col**2) / 60.0)
    hill[:3, :3] = np.nan
    dem = write_geotiff(folder / "dem.tif", hill.astype(np.float32), "EPSG:32632", WEST, NORTH, CELL_M)
    boxes = [
        shapely.box(WEST + west, NORTH - south, WEST + west + 150.0, NORTH - south + 150.0) for west, south in ((300, 600), (0, 90))
    ]
    fields = [
        {"type": "Feature", "properties": {"name": str(number)}, "geometry": json.loads(shapely.to_geojson(box))}
        for number, box in enumerate([*boxes, shapely.box(WEST - 900.0, NORTH, WEST - 800.0, NORTH + 100.0)])
    ]
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::32632"}}
    (folder / "fields.geojson").write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": fields}), "utf-8")
    for arguments in (
        ["irradiation", str(dem), "--year", "2023", "--days", "mean", "--per", "month", "-o", "year.tif"],
        ["irradiation", str(dem), "--date", "2023-06-21", "--polygons", "fields.geojson", "-o", "fields.gpkg"],
        ["compute", str(dem), "--product", "hourly_shade", "--month", "2023-03", "-o", "march.tif"],
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            patch.setattr(sys, "argv", ["skugga", *arguments])
            with pytest.raises(SystemExit) as exit_info:
                cli.main()
        assert not exit_info.value.code, arguments
    return folder


@pytest.fixture(scope="module")
def report(files: Path) -> dict[str, Any]:
    """Return what QGIS finds in the files."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    environment.pop("PYTHONPATH", None)
    if subprocess.run([PYTHON, "-c", "import qgis.core"], env=environment, capture_output=True).returncode != 0:
        pytest.skip("there is no QGIS: 'make test-clients' installs it, or 'apt-get install python3-qgis qgis-providers'")
    plan = {
        "rasters": {name: str(files / f"{name}.tif") for name in ("year", "march")},
        "vectors": {"fields": str(files / "fields.gpkg")},
        "point": [WEST + (COL + 0.5) * CELL_M, NORTH - (ROW + 0.5) * CELL_M],
    }
    process = subprocess.run(
        [PYTHON, Path(__file__).with_name("files_in_qgis.py"), files], input=json.dumps(plan), env=environment,
        capture_output=True, text=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-3000:]
    found = json.loads((files / "report.json").read_text())
    assert found["log"] == []
    return found


@pytest.mark.parametrize("name", ["year", "march"])
def test_qgis_reads_the_values_of_rasters(files, report, name):
    layer = report["rasters"][name]
    assert layer["valid"] and layer["crs"] == "EPSG:32632" and layer["size"] == [SIDE, SIDE] and all(layer["has_nodata"])
    with rasterio.open(files / f"{name}.tif") as dataset:
        values = dataset.read()
    np.testing.assert_allclose(layer["values"], values[:, ROW, COL], rtol=1e-6)
    assert len(set(layer["values"])) >= 3


def test_qgis_names_bands_by_month_and_by_hour(report):
    months, hours = (report["rasters"][name]["bands"] for name in ("year", "march"))
    assert months == [f"Band {n:02d}: irradiation 2023-{n:02d}" for n in range(1, 13)]
    assert hours == [f"Band {n + 1:02d}: days with sun in the hour from {n:02d}:00" for n in range(24)]


def test_qgis_reads_the_polygons(report):
    """All features come back with their geometry; one off the data has no values."""
    layer = report["vectors"]["fields"]
    assert layer["valid"] and layer["crs"] == "EPSG:32632" and "remark" in layer["fields"]
    on_hill, at_hole, off_data = layer["rows"]
    assert [row["area"] for row in layer["rows"]] == pytest.approx([22500.0, 22500.0, 10000.0])
    assert [row["cells"] for row in layer["rows"]] == [25, 6, 0]
    assert 4.0 < on_hill["kwh_m2"] < 9.0 and on_hill["kwh"] > 22500.0 * on_hill["kwh_m2"]
    assert at_hole["kwh_m2"] > 4.0 and off_data["kwh_m2"] is None
