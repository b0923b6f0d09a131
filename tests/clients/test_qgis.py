"""QGIS without a window reads WMS, WMTS, XYZ tiles and the layer definition; its pictures equal the service's."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import time
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET
from tests.api.conftest import Client
from tests.clients.conftest import LEVEL, MATRIX_SET
from tests.golden import OUTPUT

PYTHON = Path("/usr/bin/python3")
"""The Python that QGIS's packages are installed for."""

ZOOM = 12
SIDE = 512
TIMEOUT_S = 900
"""QGIS draws 20 pictures, two of them of hours of sun."""

TIMES = {
    "morning": ("2024-06-21T12:00:00Z", "2024-06-21T13:00:00Z"),
    "evening": ("2024-06-21T22:30:00Z", "2024-06-21T23:30:00Z"),
}

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class QgisResult:
    """The findings of QGIS, and the folder of its pictures."""

    report: dict[str, Any]
    folder: Path
    bounds: Box
    degrees: Box
    corner: tuple[int, int]
    """Column and row of the upper left of the four tiles of the bounds."""

    def picture(self, name: str) -> np.ndarray:
        """Return a picture of QGIS, RGBA, (rows, cols, 4) uint8."""
        return np.asarray(Image.open(self.folder / f"{name}.png").convert("RGBA"))


def fetch_map(client: Client, bounds: Box, layer: str = "color", **query: str) -> np.ndarray:
    """Return the service's map of an extent, RGBA."""
    parameters = {"bbox": ",".join(map(repr, bounds)), "crs": "EPSG:3857", "width": str(SIDE), "height": str(SIDE), "layer": layer}
    if layer == "sunhours":
        parameters["date"] = level_date(client)
    return fetch_picture_with_retry(client, f"/levels/{LEVEL}/map.png", **{**parameters, **query})


def fetch_tile(client: Client, x: int, y: int, layer: str = "color", **query: str) -> np.ndarray:
    """Return a tile of the service, RGBA."""
    if layer == "sunhours":
        query["date"] = level_date(client)
    return fetch_picture_with_retry(client, f"/levels/{LEVEL}/tiles/{DEFAULT_MATRIX_SET}/{ZOOM}/{x}/{y}.png", layer=layer, **query)


def level_date(client: Client) -> str:
    """Return the date of the level's own time."""
    return client.get(f"/levels/{LEVEL}").json()["sun"]["time"][:10]


def fetch_picture_with_retry(client: Client, address: str, **query: str) -> np.ndarray:
    """Return a picture, RGBA; retry while the service is busy."""
    end = time.monotonic() + TIMEOUT_S
    while (answer := client.get(address, params=query)).status_code == 503:
        assert time.monotonic() < end, answer.text
        time.sleep(int(answer.headers["retry-after"]))
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


@pytest.fixture(scope="session")
def qgis_result(service: Client, tmp_path_factory: pytest.TempPathFactory) -> QgisResult:
    """Run ``in_qgis.py`` once, and return its findings."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    environment.pop("PYTHONPATH", None)
    import_check = subprocess.run([PYTHON, "-c", "import qgis.core"], env=environment, capture_output=True, text=True)
    if import_check.returncode != 0:
        pytest.skip("there is no QGIS: 'make test-clients' installs it, or 'apt-get install python3-qgis qgis-providers'")
    west, south, east, north = service.get(f"/levels/{LEVEL}").json()["bounds"]
    zooms = service.get(f"/levels/{LEVEL}").json()["tile_matrix_sets"][DEFAULT_MATRIX_SET]
    middle = MATRIX_SET.tile((west + east) / 2, (south + north) / 2, ZOOM)
    north_west, south_east = MATRIX_SET.xy_bounds(middle.x - 1, middle.y - 1, ZOOM), MATRIX_SET.xy_bounds(middle.x, middle.y, ZOOM)
    bounds = north_west.left, south_east.bottom, south_east.right, north_west.top
    lon_lat = MATRIX_SET.bounds(middle.x, middle.y, ZOOM)
    degrees = lon_lat.left, lon_lat.bottom, lon_lat.left + 0.0625, lon_lat.bottom + 0.0625
    small_bounds = MATRIX_SET.xy_bounds(middle.x * 16, middle.y * 16, ZOOM + 4)
    fine_bounds = small_bounds.left, small_bounds.bottom, small_bounds.right, small_bounds.top
    # Hours of sun take longest: the service refuses tiles that would wait for 20 s, and QGIS leaves them out.
    fetch_map(service, bounds, "sunhours")
    for x, y in product(range(middle.x - 1, middle.x + 2), range(middle.y - 1, middle.y + 2)):
        fetch_tile(service, x, y, "sunhours")
    folder = tmp_path_factory.mktemp("qgis")
    plan = {
        "bounds": bounds, "degrees": degrees, "deep": fine_bounds, "side": SIDE, "times": TIMES,
        "zooms": [zooms["minzoom"], zooms["maxzoom"]],
    }  # fmt: skip
    process = subprocess.run(
        [PYTHON, Path(__file__).with_name("in_qgis.py"), str(service.base_url), LEVEL, folder],
        input=json.dumps(plan), env=environment, capture_output=True, text=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-3000:]
    report = json.loads((folder / "report.json").read_text())
    shutil.copytree(folder, OUTPUT / "qgis", dirs_exist_ok=True, ignore=shutil.ignore_patterns("profile"))
    print(f"QGIS {report['version']}: {len(report['requests'])} requests; its pictures lie in {OUTPUT / 'qgis'}")
    return QgisResult(report, folder, bounds, degrees, (middle.x - 1, middle.y - 1))


def test_qgis_layers_are_valid_and_log_nothing(qgis_result: QgisResult):
    by_wms = {f"wms-{name}" for name in ("color", "shadow", "mask", "sky_view", "sunhours", "degrees")}
    by_file = {f"qlr-{name}" for name in ("color", "shadow", "sunhours", "heights")}
    assert set(qgis_result.report["layers"]) == by_wms | by_file | {"wmts", "wmts-span", "xyz"}
    for name, layer in qgis_result.report["layers"].items():
        assert layer["valid"] and layer["crs"] == ("EPSG:4326" if name == "wms-degrees" else "EPSG:3857"), (name, layer)
    assert not qgis_result.report["log"]


def test_qgis_wms_equals_the_maps_of_the_service(service: Client, qgis_result: QgisResult):
    """They are equal bit for bit, because the canvas is the requested map; also in a CRS with latitude first."""
    for layer in ("color", "shadow", "mask", "sky_view", "sunhours"):
        assert np.array_equal(qgis_result.picture(f"wms-{layer}"), fetch_map(service, qgis_result.bounds, layer)), layer
    assert np.array_equal(qgis_result.picture("wms-degrees"), fetch_map(service, qgis_result.degrees, crs="EPSG:4326"))


def test_qgis_temporal_controller_sets_the_time(service: Client, qgis_result: QgisResult):
    """QGIS draws the begin of the controller's range, and knows the begin and the end of the year."""
    for name, (begin, _) in TIMES.items():
        assert np.array_equal(qgis_result.picture(f"wms-{name}"), fetch_map(service, qgis_result.bounds, time=begin)), name
    assert (qgis_result.picture("wms-morning") != qgis_result.picture("wms-evening")).any(axis=-1).mean() > 0.5
    assert qgis_result.report["layers"]["wms-color"]["times"] == ["2024-01-01T00:05:00Z", "2024-12-31T23:55:00Z"]
    requested_times = [
        url.partition("&TIME=")[2].partition("&")[0] for url in qgis_result.report["requests"] if "REQUEST=GetMap" in url
    ]
    assert {begin for begin, _ in TIMES.values()} <= set(requested_times)


def test_qgis_tiles_equal_those_of_the_service(service: Client, qgis_result: QgisResult):
    """At the scale of a zoom QGIS draws tiles without resampling."""

    def service_tiles(layer: str = "color", **query: str) -> np.ndarray:
        x, y = qgis_result.corner
        return np.vstack([np.hstack([fetch_tile(service, x + col, y + row, layer, **query) for col in (0, 1)]) for row in (0, 1)])

    for name in ("wmts", "xyz", "qlr-color"):
        assert np.array_equal(qgis_result.picture(name), service_tiles()), name
    for layer in ("shadow", "sunhours"):
        assert np.array_equal(qgis_result.picture(f"qlr-{layer}"), service_tiles(layer)), layer
    # QGIS 3.22 draws encoded heights as colours; newer versions decode them, which was not examined.
    if qgis_result.report["version"].startswith("3.22."):
        assert np.array_equal(qgis_result.picture("qlr-heights"), service_tiles("terrarium"))
    # The whole span of times, chosen in the browser, shows its begin.
    assert np.array_equal(qgis_result.picture("wmts-span"), service_tiles(time="2024-01-01T00:05:00Z"))


@pytest.mark.parametrize("name", ["wmts-deep", "xyz-deep"])
def test_qgis_enlarges_tiles_past_the_last_zoom(qgis_result: QgisResult, name: str):
    picture = qgis_result.picture(name)
    assert (picture[..., 3] == 255).all() and len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 100


def test_qgis_identifies_a_point(qgis_result: QgisResult):
    html, text = qgis_result.report["identified"]["html"], qgis_result.report["identified"]["text"]
    assert "<th>Elevation</th>" in html and "Elevation: " in text and f"Level: {LEVEL}\n" in text
    assert "Direct sun: " in text


def test_qgis_shows_the_legend_of_sun_hours_only(qgis_result: QgisResult):
    """Layers of numbers have a legend; QGIS requests none of the other layers."""
    assert qgis_result.report["legends"] == {
        "color": None,
        "shadow": None,
        "mask": None,
        "sky_view": [[340, 85]],
        "sunhours": [[340, 85]],
    }
