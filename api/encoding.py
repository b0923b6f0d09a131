"""Encoding of product arrays as PNG, WebP, JPEG, GeoTIFF and ``.npy``."""

from __future__ import annotations

import io
import warnings
from typing import TYPE_CHECKING

import numpy as np

from skugga.api.png import encode_png
from skugga.api.products.product import PICTURE_FORMATS, Product, ProductOptions
from skugga.api.raster_profile import RasterProfile
from skugga.terrain.errors import InputError

if TYPE_CHECKING:
    from skugga.shadows.picture import Picture
    from skugga.terrain.geo.world import World

LOSSY_QUALITY = 90
"""Quality of JPEG, and of WebP for display products."""

ARRAY_FORMATS = ("tif", "npy")
"""Formats that hold the numbers themselves. A TIFF is georeferenced."""


def check_format(product: Product, format: str) -> None:
    """Raise ``InputError`` if tiles and maps of a product are not served in a format, such as ``png``."""
    if format not in product.map_formats:
        raise InputError("format", format, f"{', '.join(product.map_formats)} for layer {product.name}")


def apply_color_scale(array: np.ndarray, product: Product, options: ProductOptions, world: World, format: str) -> np.ndarray:
    """Return a product's array in the form that a format stores: numbers, or colours of its colour scale for picture formats."""
    if format in ARRAY_FORMATS or product.color_scale is None:
        return array
    return product.color_scale(options, world).to_rgba(array)


def as_picture(array: np.ndarray, product: Product, picture: Picture | None) -> np.ndarray:
    """Return a view's array as a picture for PNG. Arrays that are no pictures are drawn over the view's colours."""
    if product.to_picture is None and product.draw_over_frame is None:
        return array
    assert picture is not None and picture.frame is not None
    if product.draw_over_frame is not None:
        return product.draw_over_frame(array, picture.frame)
    assert product.to_picture is not None
    return product.to_picture(array, picture.frame.color)


def encode(array: np.ndarray, product: Product, options: ProductOptions, format: str, view: object = None) -> bytes:
    """Return an array of a product as a file. The array is the result of ``apply_color_scale`` for the format.

    Only display products (shaded pictures) are compressed lossily. They have no alpha channel if all pixels are opaque. JPEG shows
    pixels without a surface as white. A GeoTIFF keeps all channels and is georeferenced by ``view``, if it is a map view.
    """
    if product.is_display and format not in ARRAY_FORMATS and array.shape[2] == 4 and (array[..., 3] == 255).all():
        array = array[..., :3]
    if product.is_display and format == "webp":
        from PIL import Image

        out = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(array)).save(out, "WEBP", quality=LOSSY_QUALITY, method=2)
        return out.getvalue()
    if format == "jpg" and array.ndim == 3 and array.shape[2] == 4:
        array = composite_over(array, (255, 255, 255))[..., :3]
    return encode_exactly(array, product, options, format, view)


def encode_exactly(array: np.ndarray, product: Product, options: ProductOptions, format: str, view: object = None) -> bytes:
    """Return an array as a file with all channels, after ``apply_color_scale``. Only JPEG loses information.

    A GeoTIFF is georeferenced by ``view``, if it is a map view.
    """
    if format == "tif":
        return encode_geotiff(array, view, product.profile(options))
    if format == "npy":
        return encode_npy(array)
    return encode_picture(array, format)


def encode_picture(array: np.ndarray, format: str) -> bytes:
    """Return a picture (RGB, RGBA or gray) as PNG, lossless WebP, or JPEG without alpha. Raises ``InputError`` otherwise."""
    if format == "png":
        return encode_png(array)
    from PIL import Image

    out = io.BytesIO()
    image = Image.fromarray(array)
    if format == "webp":
        image.save(out, "WEBP", lossless=True, method=1, exact=True)
    elif format in ("jpg", "jpeg"):
        image.convert("RGB").save(out, "JPEG", quality=LOSSY_QUALITY)
    else:
        raise InputError("format", format, ", ".join(PICTURE_FORMATS))
    return out.getvalue()


def composite_over(picture: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Composite an RGBA picture, uint8 (rows, cols, 4), over an opaque sRGB colour (0 to 255 each), and return opaque RGBA."""
    alpha = picture[..., 3:].astype(np.float32) / 255.0
    blended = np.rint(picture[..., :3] * alpha + np.array(color, np.float32) * (1.0 - alpha)).astype(np.uint8)
    return np.concatenate([blended, np.full_like(picture[..., 3:], 255)], axis=-1)


def encode_geotiff(array: np.ndarray, view: object, profile: RasterProfile) -> bytes:
    """Return an array (rows, cols) or (rows, cols, bands) as a GeoTIFF, georeferenced if ``view`` is a map view.

    ``profile`` has the nodata value and the scale of the array's numbers.
    """
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile
    from rasterio.transform import from_bounds

    from skugga.terrain.geo.grid import MapView

    bands = array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)
    georeference = {}
    if isinstance(view, MapView):
        georeference = {"crs": view.grid.crs.to_wkt(), "transform": from_bounds(*view.bounds, view.cols, view.rows)}
    with warnings.catch_warnings(), MemoryFile() as file:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # a perspective view has no georeference
        with file.open(
            driver="GTiff", width=bands.shape[2], height=bands.shape[1], count=bands.shape[0], dtype=bands.dtype,
            **georeference, compress="deflate", nodata=profile.nodata,
        ) as dataset:  # fmt: skip
            dataset.write(bands)
            if profile.scale != 1.0:
                dataset.scales = [profile.scale] * dataset.count
        return bytes(file.read())


def encode_npy(array: np.ndarray) -> bytes:
    """Return an array as a ``.npy`` file."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()
