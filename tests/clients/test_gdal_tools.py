"""GDAL's tools, as Debian packages them, read the service: the line of a level's page, and WMS with a time."""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

from skugga.terrain.level.gdal_guard import SETTINGS_AGAINST_REMOTE_READS
from tests.api.conftest import Client
from tests.clients.conftest import LEVEL, MATRIX_SET

TIME = "2024-12-21T15:00:00Z"


@pytest.fixture(scope="module", autouse=True)
def tools() -> None:
    """Print the version of GDAL's tools once; skip without them."""
    if shutil.which("gdal_translate") is None:
        pytest.skip("there is no gdal_translate: 'make test-clients' installs it, or 'apt-get install gdal-bin'")
    print(subprocess.run(["gdal_translate", "--version"], capture_output=True, text=True, check=True).stdout.strip())


def run_gdal_translate(folder: Path, source: str, *options: str) -> np.ndarray:
    """Return what ``gdal_translate`` writes for a source, (rows, cols, bands)."""
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS_AGAINST_REMOTE_READS}
    path = folder / "translated.tif"
    process = subprocess.run(
        ["gdal_translate", "-q", *options, source, path],
        env={**environment, "GDAL_ENABLE_WMS_CACHE": "NO"}, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert process.returncode == 0 and not process.stderr, process.stderr
    with rasterio.open(path) as dataset:
        return np.moveaxis(dataset.read(), 0, -1)


def fetch_picture(client: Client, address: str, **query: str) -> np.ndarray:
    """Return the picture of a successful response to GET ``address`` as RGBA (rows, cols, 4)."""
    answer = client.get(address, params=query)
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


def test_gdal_translate_runs_the_line_of_the_page(service: Client, tmp_path):
    """The output, cut to the bounds of a tile, equals that tile bit for bit."""
    line = re.search(r'gdal_translate "(WMTS:[^"]+)"', unescape(service.get(f"/levels/{LEVEL}.html").text))
    assert line is not None
    served = service.get(f"/levels/{LEVEL}").json()
    west, south, east, north = served["bounds"]
    zoom = served["tile_matrix_sets"]["WebMercatorQuad"]["maxzoom"]
    tile = MATRIX_SET.tile((west + east) / 2, (south + north) / 2, zoom)
    box = MATRIX_SET.xy_bounds(tile)
    cut = ("-projwin", *map(repr, (box.left, box.top, box.right, box.bottom)))
    translated_picture = run_gdal_translate(tmp_path, f"{line[1]},tilematrixset=WebMercatorQuad", *cut)
    expected = fetch_picture(service, f"/levels/{LEVEL}/tiles/WebMercatorQuad/{zoom}/{tile.x}/{tile.y}.png")
    assert translated_picture.shape == (256, 256, 4) and np.array_equal(translated_picture, expected)
    later = run_gdal_translate(tmp_path, f"{line[1].replace('.xml', f'.xml?time={TIME}')},tilematrixset=WebMercatorQuad", *cut)
    expected = fetch_picture(service, f"/levels/{LEVEL}/tiles/WebMercatorQuad/{zoom}/{tile.x}/{tile.y}.png", time=TIME)
    assert np.array_equal(later, expected) and not np.array_equal(later, translated_picture)


def test_gdal_translate_reads_wms_with_a_time(service: Client, tmp_path):
    """The tool requests blocks of 1024 x 1024 pixels."""
    west, south, east, north = service.get(f"/levels/{LEVEL}").json()["bounds"]
    box = MATRIX_SET.xy_bounds(MATRIX_SET.tile((west + east) / 2, (south + north) / 2, 12))
    bbox = ",".join(map(repr, box))
    source = (
        f"WMS:{service.base_url}/levels/{LEVEL}/wms?SERVICE=WMS&VERSION=1.3.0&REQUEST=GetMap&LAYERS={LEVEL}:shadow"
        f"&CRS=EPSG:3857&BBOX={bbox}&FORMAT=image/png&TRANSPARENT=TRUE&TIME={TIME}"
    )
    translated_picture = run_gdal_translate(tmp_path, source, "-outsize", "1024", "1024")
    parameters = {"bbox": bbox, "crs": "EPSG:3857", "width": "1024", "height": "1024", "layer": "shadow", "time": TIME}
    expected = fetch_picture(service, f"/levels/{LEVEL}/map.png", **parameters)
    assert np.array_equal(translated_picture, expected) and 0.05 < (translated_picture[..., 3] > 0).mean() < 0.95
