"""QGIS without a window reads the service by WMS, WMTS, XYZ tiles and the file of layers: what it draws is what the service has."""

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
"""The one that QGIS's packages are installed for."""

ZOOM = 12
SIDE = 512
MAX_S = 900
"""QGIS draws 20 pictures, two of them of hours of sun."""

TIMES = {
    "morning": ("2024-06-21T12:00:00Z", "2024-06-21T13:00:00Z"),
    "evening": ("2024-06-21T22:30:00Z", "2024-06-21T23:30:00Z"),
}

Box = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class Seen:
    """What QGIS has found, and the pictures that it has drawn, in a folder."""

    found: dict[str, Any]
    folder: Path
    bounds: Box
    degrees: Box
    corner: tuple[int, int]
    """Column and row of the upper left one of the four tiles of the bounds."""

    def picture(self, name: str) -> np.ndarray:
        """RGBA, (rows, cols, 4) uint8."""
        return np.asarray(Image.open(self.folder / f"{name}.png").convert("RGBA"))


def served(client: Client, bounds: Box, layer: str = "color", **query: str) -> np.ndarray:
    """The service's own map of an extent, RGBA."""
    asked = {"bbox": ",".join(map(repr, bounds)), "crs": "EPSG:3857", "width": str(SIDE), "height": str(SIDE), "layer": layer}
    if layer == "sunhours":
        asked["date"] = own_date(client)
    return patiently(client, f"/levels/{LEVEL}/map.png", **{**asked, **query})


def tile(client: Client, x: int, y: int, layer: str = "color", **query: str) -> np.ndarray:
    """A tile of the service, RGBA."""
    if layer == "sunhours":
        query["date"] = own_date(client)
    return patiently(client, f"/levels/{LEVEL}/tiles/{DEFAULT_MATRIX_SET}/{ZOOM}/{x}/{y}.png", layer=layer, **query)


def own_date(client: Client) -> str:
    """The date that the level is shown at."""
    return client.get(f"/levels/{LEVEL}").json()["sun"]["time"][:10]


def patiently(client: Client, address: str, **query: str) -> np.ndarray:
    """A picture, RGBA, however long its turn takes to come."""
    end = time.monotonic() + MAX_S
    while (answer := client.get(address, params=query)).status_code == 503:
        assert time.monotonic() < end, answer.text
        time.sleep(int(answer.headers["retry-after"]))
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


@pytest.fixture(scope="session")
def seen(service: Client, tmp_path_factory: pytest.TempPathFactory) -> Seen:
    """All that ``in_qgis.py`` does, once."""
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    environment.pop("PYTHONPATH", None)
    here = subprocess.run([PYTHON, "-c", "import qgis.core"], env=environment, capture_output=True, text=True)
    if here.returncode != 0:
        pytest.skip("there is no QGIS: 'make test-clients' installs it, or 'apt-get install python3-qgis qgis-providers'")
    west, south, east, north = service.get(f"/levels/{LEVEL}").json()["bounds"]
    zooms = service.get(f"/levels/{LEVEL}").json()["tile_matrix_sets"][DEFAULT_MATRIX_SET]
    middle = MATRIX_SET.tile((west + east) / 2, (south + north) / 2, ZOOM)
    corner, other = MATRIX_SET.xy_bounds(middle.x - 1, middle.y - 1, ZOOM), MATRIX_SET.xy_bounds(middle.x, middle.y, ZOOM)
    bounds = corner.left, other.bottom, other.right, corner.top
    lon_lat = MATRIX_SET.bounds(middle.x, middle.y, ZOOM)
    degrees = lon_lat.left, lon_lat.bottom, lon_lat.left + 0.0625, lon_lat.bottom + 0.0625
    fine = MATRIX_SET.xy_bounds(middle.x * 16, middle.y * 16, ZOOM + 4)
    deep = fine.left, fine.bottom, fine.right, fine.top
    # Hours of sun take longest: tiles that would wait 20 s for their turn are refused, and QGIS leaves them out.
    served(service, bounds, "sunhours")
    for x, y in product(range(middle.x - 1, middle.x + 2), range(middle.y - 1, middle.y + 2)):
        tile(service, x, y, "sunhours")
    folder = tmp_path_factory.mktemp("qgis")
    plan = {
        "bounds": bounds, "degrees": degrees, "deep": deep, "side": SIDE, "times": TIMES,
        "zooms": [zooms["minzoom"], zooms["maxzoom"]],
    }  # fmt: skip
    done = subprocess.run(
        [PYTHON, Path(__file__).with_name("in_qgis.py"), str(service.base_url), LEVEL, folder],
        input=json.dumps(plan), env=environment, capture_output=True, text=True, timeout=MAX_S,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads((folder / "found.json").read_text())
    shutil.copytree(folder, OUTPUT / "qgis", dirs_exist_ok=True, ignore=shutil.ignore_patterns("profile"))
    print(f"QGIS {found['version']}: {len(found['requests'])} requests; its pictures lie in {OUTPUT / 'qgis'}")
    return Seen(found, folder, bounds, degrees, (middle.x - 1, middle.y - 1))


def test_all_layers_are_valid_and_nothing_is_complained_of(seen: Seen):
    by_wms = {f"wms-{name}" for name in ("color", "shadow", "mask", "sunhours", "degrees")}
    by_file = {f"qlr-{name}" for name in ("color", "shadow", "sunhours", "heights")}
    assert set(seen.found["layers"]) == by_wms | by_file | {"wmts", "wmts-span", "xyz"}
    for name, layer in seen.found["layers"].items():
        assert layer["valid"] and layer["crs"] == ("EPSG:4326" if name == "wms-degrees" else "EPSG:3857"), (name, layer)
    assert not seen.found["log"]


def test_wms_draws_the_services_maps(service: Client, seen: Seen):
    """To the bit, since the canvas is the map that is asked for; of a CRS whose latitude comes first, too."""
    for layer in ("color", "shadow", "mask", "sunhours"):
        assert np.array_equal(seen.picture(f"wms-{layer}"), served(service, seen.bounds, layer)), layer
    assert np.array_equal(seen.picture("wms-degrees"), served(service, seen.degrees, crs="EPSG:4326"))


def test_the_temporal_controller_moves_time(service: Client, seen: Seen):
    """Its range begins at the time that is drawn, and QGIS knows the year's begin and end."""
    for name, (begin, _) in TIMES.items():
        assert np.array_equal(seen.picture(f"wms-{name}"), served(service, seen.bounds, time=begin)), name
    assert (seen.picture("wms-morning") != seen.picture("wms-evening")).any(axis=-1).mean() > 0.5
    assert seen.found["layers"]["wms-color"]["times"] == ["2024-01-01T00:05:00Z", "2024-12-31T23:55:00Z"]
    asked = [each.partition("&TIME=")[2].partition("&")[0] for each in seen.found["requests"] if "REQUEST=GetMap" in each]
    assert {begin for begin, _ in TIMES.values()} <= set(asked)


def test_tiles_lie_beside_one_another(service: Client, seen: Seen):
    """At the scale of a zoom QGIS draws tiles as they are."""

    def laid(layer: str = "color", **query: str) -> np.ndarray:
        x, y = seen.corner
        return np.vstack([np.hstack([tile(service, x + col, y + row, layer, **query) for col in (0, 1)]) for row in (0, 1)])

    for name in ("wmts", "xyz", "qlr-color"):
        assert np.array_equal(seen.picture(name), laid()), name
    for layer in ("shadow", "sunhours"):
        assert np.array_equal(seen.picture(f"qlr-{layer}"), laid(layer)), layer
    # QGIS 3.22 does not know what the colours of heights mean; newer ones make numbers of them, which was not looked at.
    if seen.found["version"].startswith("3.22."):
        assert np.array_equal(seen.picture("qlr-heights"), laid("terrarium"))
    # Whoever picks the whole span of times in the browser sees its begin.
    assert np.array_equal(seen.picture("wmts-span"), laid(time="2024-01-01T00:05:00Z"))


@pytest.mark.parametrize("name", ["wmts-deep", "xyz-deep"])
def test_past_the_last_zoom_its_tiles_are_enlarged(seen: Seen, name: str):
    picture = seen.picture(name)
    assert (picture[..., 3] == 255).all() and len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 100


def test_what_is_at_a_point(seen: Seen):
    html, text = seen.found["identified"]["html"], seen.found["identified"]["text"]
    assert "<th>Elevation</th>" in html and "Elevation: " in text and f"Level: {LEVEL}\n" in text
    assert "Direct sun: " in text


def test_legends(seen: Seen):
    """Of hours of sun there is one; the others are asked for none."""
    assert seen.found["legends"] == {"color": None, "shadow": None, "mask": None, "sunhours": [[340, 85]]}
