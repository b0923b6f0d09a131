"""The product ``horizon``: horizon angles of the ground towards evenly spaced azimuths, a band for each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from skugga.api.products.product import Product, ProductInput, ProductOptions, RasterProfile
from skugga.api.products.sky_view import RADIUS_REMEDY
from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, MAX_AZIMUTHS, MIN_AZIMUTHS, evenly_spaced_azimuths_deg

if TYPE_CHECKING:
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "horizon"

STORED_STEP_DEG = 0.01
"""Unit of angles that are stored as whole numbers, degrees."""

STORED_NODATA = 65535

HorizonType = Literal["uint16", "float32"]


class HorizonOptions(ProductOptions):
    """Options of horizons: the number of azimuths, and how angles are stored."""

    REMEDIES: ClassVar[Mapping[str, str]] = {"radius": RADIUS_REMEDY}

    azimuths: int = Field(default=DEFAULT_AZIMUTHS, ge=MIN_AZIMUTHS, le=MAX_AZIMUTHS, description="Number of azimuths.")
    dtype: HorizonType = Field(
        default="uint16",
        description="Type of numbers: uint16, hundredths of a degree, below the level 0; or float32, degrees.",
    )

    @property
    def azimuth_deg(self) -> np.ndarray:
        """The azimuths in degrees (azimuths,)."""
        return evenly_spaced_azimuths_deg(self.azimuths)


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return horizon angles (rows, cols, azimuths) as the options store them."""
    from skugga.shadows.horizons.level_horizons import horizons_of_block

    options = product_input.options
    angle_deg = horizons_of_block(product_input.scene, product_input.map_view, options.azimuths)
    if options.dtype == "float32":
        return angle_deg
    stored = np.empty(angle_deg.shape, np.uint16)
    for row, row_deg in enumerate(angle_deg):  # row by row: a copy of a block of many azimuths does not fit everywhere
        numbers = np.rint(np.maximum(row_deg, 0.0) / STORED_STEP_DEG)
        stored[row] = np.where(np.isnan(numbers), STORED_NODATA, numbers)
    return stored


def _profile(options: HorizonOptions) -> RasterProfile:
    """Return the form of rasters: a band for each azimuth."""
    names = tuple(f"horizon angle towards {azimuth:g} degrees" for azimuth in options.azimuth_deg)
    if options.dtype == "float32":
        return RasterProfile("float32", options.azimuths, band_names=names)
    return RasterProfile("uint16", options.azimuths, STORED_NODATA, STORED_STEP_DEG, names)


def _blocks(scene: Scene, view: MapView, options: HorizonOptions) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map, in the form of ``skugga.terrain.geo.grid.blocks_of``; all azimuths are in memory."""
    from skugga.shadows.horizons.level_horizons import horizon_blocks

    return horizon_blocks(scene, view, options.azimuths)


def _tags(options: HorizonOptions, scene: Scene) -> dict[str, str]:
    """Return the metadata tags of a raster: how the azimuths of its bands count, and what its numbers are."""
    return {
        "azimuths": str(options.azimuths), "azimuth_first_deg": "0", "azimuth_step_deg": f"{360.0 / options.azimuths:.12g}",
        "azimuth_origin": "true north", "azimuth_sense": "clockwise", "unit": "degrees",
        "scale": f"{_profile(options).scale:g}",
        "below_level": "0" if options.dtype == "uint16" else "negative; -90 where no ground lies",
    }  # fmt: skip


PRODUCT = Product(
    name=PRODUCT_NAME, description="horizon angles towards evenly spaced azimuths from true north, clockwise",
    formats=("tif", "npy"), compute=_compute, view_kinds=("map",), when="none", options=HorizonOptions, profile=_profile,
    unit="degrees", sees_all_ground=True, blocks=_blocks, tags=_tags, is_served=False,
)  # fmt: skip
