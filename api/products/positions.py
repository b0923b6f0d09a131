"""The products ``depth`` and ``position``: the depth and the coordinates of the pixels of a frame."""

from __future__ import annotations

import numpy as np

from skugga.api.products.product import NEEDS_FRAME, Product, ProductInput
from skugga.api.raster_profile import RasterProfile


def _depth(product_input: ProductInput) -> np.ndarray:
    """Return depths in metres, float32 (rows, cols).

    In a map they are measured down from the level's highest ground. In a perspective view they are measured from the eye along the
    view axis.
    """
    from skugga.terrain.geo.grid import MapView

    view, frame = product_input.view, product_input.frame
    if isinstance(view, MapView):
        return np.where(frame.valid, product_input.scene.height_range_m[1] - frame.height_m, np.nan).astype(np.float32)
    return ((frame.position_earth_m - view.eye_earth_m) @ view.earth_from_camera[:, 2]).astype(np.float32)


def _position(product_input: ProductInput) -> np.ndarray:
    """Return coordinates x, y and height, float64 (rows, cols, 3).

    x and y are in the CRS of a map view. For a perspective view they are in the CRS of the level's maps. Pixels without a surface
    are NaN.
    """
    from skugga.terrain.geo.grid import MapView

    view, frame = product_input.view, product_input.frame
    out = np.full((view.rows, view.cols, 3), np.nan)
    row, col = np.nonzero(frame.valid)
    if isinstance(view, MapView):
        out[row, col, 0] = view.grid.x(view.col0 + col * view.col_step)
        out[row, col, 1] = view.grid.y(view.row0 + row * view.row_step)
        out[row, col, 2] = frame.height_m[row, col]
    elif frame.position_earth_m is not None:
        out[row, col] = np.stack(
            product_input.scene.world.map_position(product_input.scene.map_crs, frame.position_earth_m[row, col]), axis=-1
        )
    return out


PRODUCTS = (
    Product(
        name="depth",
        description="depth in metres: below the level's highest ground in a map, along the view axis in perspective",
        formats=("npy", "tif"),
        compute=_depth,
        needs=NEEDS_FRAME,
        unit="m",
        is_served=False,
        is_view_only=True,
    ),
    Product(
        name="position",
        description="coordinates x, y and height in the CRS of the level's maps",
        formats=("npy",),
        compute=_position,
        needs=NEEDS_FRAME,
        profile=lambda _: RasterProfile("float64", 3),
        is_served=False,
    ),
)
