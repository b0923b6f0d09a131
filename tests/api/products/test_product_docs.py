"""The page on products lists all products, and its example works."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from skugga.api.compute import compute
from skugga.api.products import PRODUCTS, product_table
from skugga.api.products.product import Product
from skugga.api.request import ProductRequest
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

PAGE_TEXT = (Path(__file__).parents[3] / "docs" / "products.md").read_text(encoding="utf-8")


def test_all_products_have_a_description():
    assert all(product.description for product in PRODUCTS.values())


def test_the_table_has_all_products_of_maps():
    rows = re.findall(r"^\| `([\w-]+)` \|", product_table(), re.MULTILINE)
    assert rows == [product.name for product in PRODUCTS.values() if product.map_formats or product.is_raster]


@pytest.fixture
def slope(monkeypatch) -> Product:
    """Return the product of the page's example."""
    namespace: dict[str, object] = {"__name__": "slope"}
    (code,) = re.findall(r"```python\n(.*?)```", PAGE_TEXT, re.DOTALL)
    exec(compile(code, "docs/products.md", "exec"), namespace)  # noqa: S102  # our own page
    product = namespace["PRODUCT"]
    assert isinstance(product, Product)
    monkeypatch.setitem(PRODUCTS, "slope", product)
    return product


def compute_product(scene: Scene, product: Product, cols: int, **options: object) -> np.ndarray:
    """Return the product on 40 rows of the level's own cells."""
    map_view = scene.view("map")
    view = MapView(map_view.grid, float(np.floor(map_view.row0)), float(np.floor(map_view.col0)), 1.0, 1.0, 40, cols)
    return compute(scene, view, ProductRequest(product="slope", options=product.options_of(options)), None).array


def test_the_pages_example_computes_slopes(write_raster, make_scene, slope):
    """A plane that rises 3 m in 4 m has 36.87 degrees, in one block and across two. With twice the heights it has 56.31."""
    col = np.mgrid[:40, :1200][1].astype(np.float32)
    heights = 7.5 * col
    heights[10:14, 200:210] = np.nan
    scene = make_scene(write_raster(heights, "EPSG:32633", 500e3, 5_200e3, 10.0, nodata=np.nan), 200.0, 30.0)
    for exaggeration, expected in ((1.0, 36.87), (2.0, 56.31)):
        slopes_deg = compute_product(scene, slope, 1200, exaggeration=exaggeration)
        inside = slopes_deg[22:-5, 5:-5]
        assert np.isfinite(inside).all(), "no seam between blocks"
        np.testing.assert_allclose(inside, expected, atol=0.1)
        assert np.isnan(slopes_deg).sum() >= 20, "a hole has no slope"


@pytest.mark.parametrize("uphill", ["east", "north"])
def test_the_pages_example_handles_pixels_that_are_not_square(write_raster, make_scene, slope, uphill):
    """The plane has ten degrees, at 60 degrees north in longitude and latitude, where a cell is half as wide as it is high."""
    cell_deg, semi_major_m, flattening = 1.0 / 3600.0, 6_378_137.0, 1.0 / 298.257223563
    row, col = np.mgrid[:80, :120]
    lat, eccentricity_squared = np.radians(60.0 - (row + 0.5) * cell_deg), flattening * (2.0 - flattening)
    across_m = np.radians(cell_deg) * semi_major_m * np.cos(lat) / np.sqrt(1.0 - eccentricity_squared * np.sin(lat) ** 2)
    along_m = (
        np.radians(cell_deg) * semi_major_m * (1.0 - eccentricity_squared) / (1.0 - eccentricity_squared * np.sin(lat) ** 2) ** 1.5
    )
    rise_m = np.tan(np.radians(10.0)) * (across_m * col if uphill == "east" else np.cumsum(along_m, axis=0)[::-1])
    scene = make_scene(write_raster(rise_m.astype(np.float32), "EPSG:4326", 10.0, 60.0, cell_deg), 200.0, 30.0)
    map_view = scene.view("map", crs="EPSG:4326")
    view = MapView(
        map_view.grid, float(np.floor(map_view.row0)), float(np.floor(map_view.col0)), 1.0, 1.0, map_view.rows, map_view.cols
    )
    slopes_deg = compute(scene, view, ProductRequest(product="slope", options=slope.options()), None).array
    inside = slopes_deg[np.isfinite(slopes_deg)]
    assert inside.size > 1000
    np.testing.assert_allclose(np.median(inside), 10.0, atol=0.05)
    assert (np.abs(inside - 10.0) < 0.1).mean() > 0.9


def test_the_pages_example_has_colours_for_its_numbers(slope, make_scene, write_raster):
    assert slope.color_scale is not None
    scale = slope.color_scale(slope.options(), None)  # type: ignore[arg-type]
    colors = scale.to_rgba(np.array([[0.0, 30.0, 60.0, np.nan]]))[0]
    assert colors[:, 3].tolist() == [255, 255, 255, 0] and len({tuple(color) for color in colors}) == 4


@pytest.mark.parametrize("name", PRODUCTS)
def test_product_records_are_consistent(name: str):
    """No field of a record contradicts another."""
    product = PRODUCTS[name]
    options = product.options.model_construct()  # defaults, without those that have none
    profile = product.profile(options)
    assert product.description or not product.map_formats, "products with formats of maps need a description"
    assert not product.is_picture or profile.dtype == "uint8"
    assert product.options.UNSERVED.keys() <= product.options.model_fields.keys()
    empty = product.empty_array(options, 3, 5)
    assert empty.shape == ((3, 5) if profile.bands == 1 else (3, 5, profile.bands))
    assert empty.dtype == profile.dtype or product.pass_layer is not None
    assert product.is_view_only or len(product.band_names(options)) == profile.bands
    assert product.empty_picture(options, 3, 5).dtype == np.uint8 or not set(product.map_formats) & {"png", "webp", "jpg"}
