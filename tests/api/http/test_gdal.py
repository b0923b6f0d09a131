"""GDAL's WMS and WMTS drivers read a running service.

Each read runs in a process of its own, because other tests may have forbidden remote reads in this process.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from morecantile import tms
from PIL import Image

from skugga.api.http.state.served_levels import DEFAULT_MATRIX_SET
from skugga.terrain.level.gdal_guard import SETTINGS_AGAINST_REMOTE_READS
from tests.api.conftest import CORNER, ZOOM, Client

MATRIX_SET = tms.get(DEFAULT_MATRIX_SET)
TILES = f"/levels/timed/tiles/{DEFAULT_MATRIX_SET}"
BOUNDS = MATRIX_SET.xy_bounds(*CORNER, ZOOM)
TIME = "2024-12-21T13:00:00Z"
BLOCK_SIDE_PX = 1024
"""Block side of GDAL's WMS driver, pixels."""

READ_SCRIPT = """
import json, sys
import numpy, rasterio
from rasterio.windows import from_bounds
driver, source, bounds, side, path = json.loads(sys.argv[1])
with rasterio.Env() as environment:
    if driver not in environment.drivers():
        sys.exit(f"no driver {driver}")
    with rasterio.open(source) as dataset:
        window = bounds and from_bounds(*bounds, dataset.transform).round_offsets().round_lengths()
        if dataset.count:
            numpy.save(path, dataset.read(window=window, out_shape=side and (dataset.count, side, side)))
        print(json.dumps({
            "crs": dataset.crs and dataset.crs.to_epsg(), "bounds": dataset.bounds, "cell": dataset.res[0],
            "subdatasets": dataset.subdatasets,
        }))
"""


@dataclass(frozen=True)
class GdalDataset:
    """Data set as GDAL reads it: pixels (rows, cols, bands), CRS, bounds, cell size, subdatasets."""

    pixels: np.ndarray | None
    crs: int | None
    bounds: tuple[float, float, float, float]
    cell: float
    subdatasets: list[str]


def read_with_gdal(
    folder: Path, driver: str, source: str, bounds: tuple[float, ...] | None = None, side: int | None = None
) -> GdalDataset:
    """Read a data set, or its part within ``bounds`` in its CRS; where ``side`` is given, as ``side`` x ``side`` pixels."""
    path = folder / "read.npy"
    environment = {name: value for name, value in os.environ.items() if name not in SETTINGS_AGAINST_REMOTE_READS}
    process = subprocess.run(
        [sys.executable, "-c", READ_SCRIPT, json.dumps([driver, source, bounds, side, str(path)])],
        env={**environment, "GDAL_ENABLE_WMS_CACHE": "NO"}, capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    if process.stderr.strip() == f"no driver {driver}":
        pytest.skip(f"this GDAL has no {driver} driver")
    assert process.returncode == 0, process.stderr
    pixels = np.moveaxis(np.load(path), 0, -1) if path.exists() else None
    path.unlink(missing_ok=True)
    return GdalDataset(pixels, **json.loads(process.stdout))


def picture(client: Client, address: str, **query: str) -> np.ndarray:
    """Return the picture of a successful response to GET ``address`` as RGBA (rows, cols, 4)."""
    answer = client.get(address, params=query)
    assert answer.status_code == 200, answer.text
    return np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))


def wmts_source(client: Client, layer: str, query: str = "") -> str:
    """Return the name by which GDAL opens a WMTS layer of the service. ``query`` is added to the address of the capabilities."""
    address = f"{client.base_url}/levels/timed/WMTSCapabilities.xml{query}"
    return f"WMTS:{address},layer=timed:{layer},tilematrixset={DEFAULT_MATRIX_SET}"


@pytest.mark.parametrize("layer", ["color", "shadow", "terrarium"])
def test_wmts_driver_reads_served_tiles(client: Client, tmp_path, layer):
    """The data set has the level's extent and finest zoom; GDAL's pixels equal the served tile bit for bit."""
    zoom = client.get("/levels/timed").json()["tile_matrix_sets"][DEFAULT_MATRIX_SET]["maxzoom"]
    x, y = (index * 2 ** (zoom - ZOOM) for index in CORNER)
    dataset = read_with_gdal(tmp_path, "WMTS", wmts_source(client, layer), tuple(MATRIX_SET.xy_bounds(x, y, zoom)))
    assert dataset.crs == 3857 and dataset.cell == pytest.approx(MATRIX_SET.matrix(zoom).cellSize)
    west, south, east, north = dataset.bounds
    assert (east - west, north - south) == pytest.approx((12_000.0, 12_000.0), abs=2 * dataset.cell)
    assert np.array_equal(dataset.pixels, picture(client, f"{TILES}/{zoom}/{x}/{y}.png", layer=layer))


def test_wmts_driver_reads_another_time(client: Client, tmp_path):
    """The driver reads a document's default time only, so the capabilities are requested with another default."""
    bounds = (BOUNDS.left, BOUNDS.bottom + 1000, BOUNDS.right - 4000, BOUNDS.top)
    source = f"{wmts_source(client, 'mask', f'?time={TIME}')},zoom_level={ZOOM}"
    dataset = read_with_gdal(tmp_path, "WMTS", source, bounds)
    rows, cols = dataset.pixels.shape[:2]
    expected = picture(client, f"{TILES}/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png", layer="mask", time=TIME)[:rows, :cols]
    valid = expected[..., 0] != 128
    assert valid.sum() > 10_000 and np.array_equal(dataset.pixels[valid], expected[valid])
    default_dataset = read_with_gdal(tmp_path, "WMTS", f"{wmts_source(client, 'mask')},zoom_level={ZOOM}", bounds)
    assert (default_dataset.pixels[valid] != dataset.pixels[valid]).any()


@pytest.mark.parametrize("layer", ["color", "shadow", "mask", "sunhours"])
def test_wms_driver_reads_served_maps(client: Client, tmp_path, layer):
    """A layer of the capabilities, read as PNG at a time, equals the map of the same extent and size bit for bit."""
    time = TIME[:10] if layer == "sunhours" else TIME
    listed = read_with_gdal(
        tmp_path, "WMS", f"WMS:{client.base_url}/levels/timed/wms?FORMAT=image/png&TRANSPARENT=TRUE"
    ).subdatasets
    assert [subdataset.partition("LAYERS=")[2].partition("&")[0] for subdataset in listed] == [
        f"timed%3A{layer}" for layer in ("color", "shadow", "mask", "irradiation", "sky_view", "sunhours")
    ]
    listed_source = next(subdataset for subdataset in listed if f"timed%3A{layer}&" in subdataset)
    source = listed_source.replace(
        f"BBOX={listed_source.partition('BBOX=')[2].partition('&')[0]}", f"BBOX={','.join(map(repr, BOUNDS))}"
    )
    dataset = read_with_gdal(tmp_path, "WMS", f"{source}&TIME={time}", side=BLOCK_SIDE_PX)
    assert dataset.crs == 3857 and dataset.bounds == pytest.approx(tuple(BOUNDS))
    moment = {"date": time} if layer == "sunhours" else {"time": time}
    query = {"bbox": ",".join(map(repr, BOUNDS)), "crs": "EPSG:3857", "width": str(BLOCK_SIDE_PX), "layer": layer, **moment}
    expected = picture(client, "/levels/timed/map.png", **query)
    valid = (expected[..., 3] == 255) if layer != "shadow" else np.ones(expected.shape[:2], bool)
    assert valid.sum() > 100_000 and np.array_equal(dataset.pixels[valid], expected[valid])


def test_wms_driver_reads_a_latitude_first_crs(client: Client, tmp_path):
    """EPSG:4326 has latitude first; the driver's BBoxOrder says so."""
    west, south, east, north = MATRIX_SET.bounds(*CORNER, ZOOM)
    description = (
        f'<GDAL_WMS><Service name="WMS"><Version>1.3.0</Version><ServerUrl>{client.base_url}/wms?</ServerUrl><CRS>EPSG:4326</CRS>'
        "<BBoxOrder>yxYX</BBoxOrder><ImageFormat>image/png</ImageFormat><Layers>timed:color</Layers><Transparent>TRUE</Transparent>"
        f"</Service><DataWindow><UpperLeftX>{west}</UpperLeftX><UpperLeftY>{north}</UpperLeftY><LowerRightX>{east}</LowerRightX>"
        f"<LowerRightY>{south}</LowerRightY><SizeX>128</SizeX><SizeY>128</SizeY></DataWindow><BandsCount>4</BandsCount>"
        "<BlockSizeX>128</BlockSizeX><BlockSizeY>128</BlockSizeY></GDAL_WMS>"
    )
    dataset = read_with_gdal(tmp_path, "WMS", description)
    query = {"bbox": f"{west},{south},{east},{north}", "crs": "EPSG:4326", "width": "128", "height": "128"}
    expected = picture(client, "/levels/timed/map.png", **query)
    valid = expected[..., 3] == 255
    difference = np.abs(dataset.pixels[valid].astype(int) - expected[valid]).max(axis=-1)
    # The driver rounds the bounds of its request, so that heights differ in their last bits.
    assert valid.sum() > 5_000 and difference.max() <= 1 and (difference > 0).mean() < 1e-3
