"""The product ``sky_view``: how much of the sky the ground sees, in five definitions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from skugga.api.color_scale import ColorScale
from skugga.api.products.product import Product, ProductInput, ProductOptions
from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, MAX_AZIMUTHS, MIN_AZIMUTHS, SkyViewKind

if TYPE_CHECKING:
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PRODUCT_NAME = "sky_view"

TILE_AZIMUTHS = 32
"""Azimuths of a tile. In mountains 99 % of the cells are within 0.004 of those of 360 azimuths: a step of 256 colours."""

RADIUS_REMEDY = "Leave it out: rays go to the end of the data, at no cost"
"""What to do instead of the search radius that other tools need."""

KINDS: dict[SkyViewKind, tuple[str, str]] = {
    "solid_angle": ("sky view factor, visible share of the sky's solid angle", "1"),
    "cosine": ("sky view factor, share of a uniform sky's light on a level plane", "1"),
    "tilted": ("sky view factor, share of a uniform sky's light on the ground's own plane", "1"),
    "openness": ("openness, mean zenith angle of the horizon", "degrees"),
    "negative_openness": ("negative openness, mean zenith angle of the horizon of the ground turned upside down", "degrees"),
}
"""Description and unit by kind."""


class SkyViewOptions(ProductOptions):
    """Options of sky view factors: the definition, the number of azimuths, and the light that trees let through."""

    UNSERVED: ClassVar[Mapping[str, Any]] = {"azimuths": TILE_AZIMUTHS}
    REMEDIES: ClassVar[Mapping[str, str]] = {"radius": RADIUS_REMEDY}

    kind: SkyViewKind = Field(default="solid_angle", description="Definition of the factor.", examples=["cosine"])
    azimuths: int = Field(default=DEFAULT_AZIMUTHS, ge=MIN_AZIMUTHS, le=MAX_AZIMUTHS, description="Number of azimuths.")
    transmissivity: float = Field(
        default=0.0, ge=0.0, le=1.0, description="Share of the light that comes through crowns of trees.", examples=[0.1]
    )


def _compute(product_input: ProductInput) -> np.ndarray:
    """Return sky view factors, float32 (rows, cols), in the unit of ``KINDS``; NaN without ground."""
    from skugga.shadows.horizons.level_horizons import sky_view_of_block

    options = product_input.options
    return sky_view_of_block(
        product_input.scene, product_input.map_view, options.kind, options.azimuths, transmissivity=options.transmissivity
    )


def _color_scale(options: SkyViewOptions, world: World) -> ColorScale:
    """Return the colour scale: shares from 0 to 1, angles around the 90 degrees of level ground."""
    title = KINDS[options.kind][0].partition(",")[0].capitalize()
    if KINDS[options.kind][1] == "degrees":
        return ColorScale(
            f"{title}, degrees", "gray", 60.0, 120.0, ((60.0, "60"), (75.0, "75"), (90.0, "90"), (105.0, "105"), (120.0, "120"))
        )
    return ColorScale(
        f"{title} ({options.kind.replace('_', ' ')})",
        "gray",
        0.0,
        1.0,
        ((0.0, "0"), (0.25, "0.25"), (0.5, "0.5"), (0.75, "0.75"), (1.0, "1")),
    )


def _blocks(scene: Scene, view: MapView, options: SkyViewOptions) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map, in the form of ``skugga.terrain.geo.grid.blocks_of``; one azimuth at a time is in memory."""
    from skugga.shadows.horizons.level_horizons import horizon_blocks

    return horizon_blocks(scene, view)


PRODUCT = Product(
    name=PRODUCT_NAME, description="how much of the sky the ground sees, 0 to 1, or its openness in degrees, by `kind`",
    formats=("png", "webp", "tif", "npy"), compute=_compute, view_kinds=("map",), when="none", options=SkyViewOptions, unit="1",
    color_scale=_color_scale, describe=lambda options: KINDS[options.kind], sees_all_ground=True, blocks=_blocks,
)  # fmt: skip
