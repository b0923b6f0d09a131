"""Data tiles: heights encoded in colours, visibility as arrays, and GeoTIFFs."""

from __future__ import annotations

import io

import numpy as np
import pytest
from morecantile import tms
from PIL import Image
from rasterio.io import MemoryFile

from tests.api.conftest import CORNER, ZOOM, Client, hills
from tests.api.http.test_problems import check_problem
from tests.api.test_terrain_encodings import mapbox_height_m, terrarium_height_m

X, Y = CORNER
TILES = "/levels/hills/tiles/WebMercatorQuad"
LOWEST_HEIGHT_M = float(np.floor(hills().min()))


def heights(client: Client, layer: str, place: str = f"{ZOOM}/{X}/{Y}", suffix: str = "png") -> np.ndarray:
    """Return the heights (rows, cols) in metres of a tile. ``place`` is its zoom, column and row."""
    answer = client.get(f"{TILES}/{place}.{suffix}?layer={layer}")
    assert answer.status_code == 200, answer.text
    image = Image.open(io.BytesIO(answer.content))
    assert image.mode == "RGB", "alpha would change colours where a browser multiplies with it"
    return (mapbox_height_m if layer == "terrain-rgb" else terrarium_height_m)(np.asarray(image))


def test_height_tiles_equal_the_interpolated_raster(client: Client):
    """Cells are 30 m wide and pixels 9.55 m; the expected heights lie bilinearly between the centres of the cells."""
    decoded_heights = heights(client, "terrarium", f"{ZOOM + 2}/{4 * X}/{4 * Y}")
    bounds = tms.get("WebMercatorQuad").xy_bounds(4 * X, 4 * Y, ZOOM + 2)
    pixel = (bounds.right - bounds.left) / 256
    cell_positions = (np.arange(256) + 0.5) * pixel / 30.0 + 200 - 0.5  # the tile's corner is the raster's middle
    i = np.floor(cell_positions).astype(int)
    t = cell_positions - i
    cells = hills()
    rows = cells[i] * (1 - t[:, None]) + cells[i + 1] * t[:, None]
    expected = rows[:, i] * (1 - t) + rows[:, i + 1] * t
    assert np.abs(decoded_heights - expected).max() < 0.01
    assert np.abs(heights(client, "terrain-rgb", f"{ZOOM + 2}/{4 * X}/{4 * Y}") - expected).max() < 0.06


def test_heights_off_the_data_are_the_lowest_height(client: Client):
    far, near = heights(client, "terrain-rgb", f"{ZOOM}/{X + 50}/{Y}"), heights(client, "terrain-rgb")
    np.testing.assert_allclose(far, LOWEST_HEIGHT_M, atol=1e-6)
    assert np.isclose(near.min(), LOWEST_HEIGHT_M) and near.max() > LOWEST_HEIGHT_M + 300
    tilejson = client.get("/levels/hills/WebMercatorQuad/tilejson.json?layer=terrarium").json()
    assert (tilejson["encoding"], tilejson["skugga"]["nodata_height"], tilejson["skugga"]["sun"]) == (
        "terrarium",
        LOWEST_HEIGHT_M,
        None,
    )
    assert client.get("/levels/hills/WebMercatorQuad/tilejson.json?layer=terrain-rgb").json()["encoding"] == "mapbox"


def test_webp_and_2x_height_tiles_are_exact(client: Client):
    png = heights(client, "terrain-rgb")
    assert np.array_equal(png, heights(client, "terrain-rgb", suffix="webp"))
    double, four = (
        heights(client, "terrain-rgb", f"{ZOOM}/{X}/{Y}@2x"),
        heights(client, "terrain-rgb", f"{ZOOM + 1}/{2 * X}/{2 * Y}"),
    )
    assert double.shape == (512, 512) and np.array_equal(double[:256, :256], four)


def test_height_tiles_ignore_the_sun(client: Client):
    before = client.service.pool.counters.jobs_answered
    client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png?layer=terrain-rgb&azimuth=12.5&altitude=34")
    client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png?layer=terrain-rgb&azimuth=13.5&altitude=34")
    assert client.service.pool.counters.jobs_answered <= before + 1
    check_problem(client.get(f"{TILES}/{ZOOM}/{X}/{Y}.jpg?layer=terrain-rgb"), 422, "invalid_parameter", "format")


def test_mask_is_visibility_with_a_threshold(client: Client):
    mask = np.asarray(Image.open(io.BytesIO(client.get(f"{TILES}/{ZOOM}/{X}/{Y}.png?layer=mask").content)))
    answer = client.get(f"{TILES}/{ZOOM}/{X}/{Y}.npy?layer=visibility")
    assert answer.headers["content-type"] == "application/x-npy"
    visibility = np.load(io.BytesIO(answer.content))
    assert visibility.dtype == np.float32 and visibility.shape == (256, 256)
    assert np.array_equal(np.isnan(visibility), mask == 128)
    assert np.array_equal(visibility < 0.5, mask == 0)


@pytest.mark.parametrize(("scale", "place"), [(1, f"{ZOOM}/{X}/{Y}"), (2, f"{ZOOM}/{X}/{Y}@2x"), (1, f"{ZOOM}/{X + 50}/{Y}")])
def test_geotiff_bounds_equal_the_tile_bounds(client: Client, scale: int, place: str):
    x = int(place.split("/")[1])
    bounds = tms.get("WebMercatorQuad").xy_bounds(x, Y, ZOOM)
    with MemoryFile(client.get(f"{TILES}/{place}.tif?layer=visibility").content) as file, file.open() as dataset:
        assert (dataset.width, dataset.height, dataset.dtypes) == (256 * scale, 256 * scale, ("float32",))
        assert dataset.crs.to_epsg() == 3857 and np.isnan(dataset.nodata)
        np.testing.assert_allclose(dataset.bounds, bounds, atol=1e-3)
        assert np.isnan(dataset.read(1)).all() == (x != X)
    with MemoryFile(client.get(f"{TILES}/{place}.tif").content) as file, file.open() as dataset:
        assert dataset.count == 4 and (dataset.read(4) == 0).all() == (x != X)


FORMATS = {
    "color": {"png", "webp", "jpg", "tif"},
    "shadow": {"png", "webp", "tif"},
    "mask": {"png", "webp", "tif", "npy"},
    "visibility": {"tif", "npy"},
    "height": {"tif", "npy"},
    "terrain-rgb": {"png", "webp"},
    "terrarium": {"png", "webp"},
}
BANDS = {"color": 4, "shadow": 4, "mask": 1, "visibility": 1, "height": 1, "terrain-rgb": 3, "terrarium": 3}


def pixels(content: bytes, suffix: str) -> np.ndarray:
    """Return the pixels of a file, (rows, cols) or (rows, cols, bands)."""
    if suffix == "npy":
        return np.load(io.BytesIO(content))
    if suffix == "tif":
        with MemoryFile(content) as file, file.open() as dataset:
            return np.moveaxis(dataset.read(), 0, -1).squeeze()
    return np.asarray(Image.open(io.BytesIO(content)))


@pytest.mark.parametrize("suffix", ["png", "webp", "jpg", "tif", "npy"])
@pytest.mark.parametrize("layer", FORMATS)
def test_layers_have_exactly_their_formats(client: Client, layer: str, suffix: str):
    """Supported formats work at both sizes and off the data; any other format is refused with a list of the supported ones."""
    for place, side in ((f"{ZOOM}/{X}/{Y}", 256), (f"{ZOOM}/{X}/{Y}@2x", 512), (f"{ZOOM}/{X + 50}/{Y}", 256)):
        answer = client.get(f"{TILES}/{place}.{suffix}?layer={layer}")
        if suffix not in FORMATS[layer]:
            detail = check_problem(answer, 422, "invalid_parameter", "format")["detail"]
            assert (
                detail.endswith(f"for layer {layer}.")
                and set(detail.split("Allowed: ")[1].split(" for ")[0].split(", ")) == FORMATS[layer]
            )
            continue
        pixel_values = pixels(answer.content, suffix)
        assert pixel_values.shape[:2] == (side, side)
        assert pixel_values.dtype == (np.float32 if layer in ("visibility", "height") else np.uint8)
        bands = 1 if pixel_values.ndim == 2 else pixel_values.shape[2]
        as_color = layer == "color" or suffix == "webp"  # opaque colour has no alpha, and WebP no gray
        assert bands == BANDS[layer] or (as_color and bands == 3)


def test_arrays_equal_masks_and_heights(client: Client):
    def array(layer: str, place: str, suffix: str = "npy") -> np.ndarray:
        return pixels(client.get(f"{TILES}/{place}.{suffix}?layer={layer}").content, suffix)

    data_tile, empty_tile = f"{ZOOM}/{X}/{Y}", f"{ZOOM}/{X + 50}/{Y}"
    assert np.array_equal(array("mask", data_tile), array("mask", data_tile, "png")) and (array("mask", empty_tile) == 128).all()
    height, valid = array("height", data_tile), ~np.isnan(array("height", data_tile))
    assert np.isnan(array("height", empty_tile)).all() and np.isnan(array("height", empty_tile, "tif")).all()
    assert np.array_equal(height, array("height", data_tile, "tif"), equal_nan=True)
    assert valid.any() and not valid.all()
    assert np.abs(height - heights(client, "terrarium"))[valid].max() <= 0.5 / 256 + 1e-4
    assert "encoding" not in client.get("/levels/hills/WebMercatorQuad/tilejson.json?layer=height").json()
