"""Products that show intermediate pictures of an algorithm's passes, such as shadow maps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from skugga.api.light_drawing import draw_lines_over_frame, draw_post_perspective, tone_map_light_view
from skugga.api.products.product import NEEDS_FRAME, MapFormat, Product, ProductInput, ViewKind
from skugga.shadows.passes import PassLayer
from skugga.terrain.errors import InputError, Problem

VOLUME_COLOR = (255, 120, 30)
"""sRGB colour of shadow volumes in a picture, warmer than ground, snow and sky."""

FACE_OPACITY, MAX_OPACITY = 0.12, 0.8
"""Opacity of each face of a volume, and the largest opacity of all faces together: the picture stays visible behind 100 volumes."""


def _gray_of_depths(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return depths as gray, uint16: brightest nearest to the light, black where no caster is.

    ``array`` has the depths. The parameter ``color``, the frame's colours, is not used.
    """
    return np.rint(65535.0 * (1.0 - np.nan_to_num(array, nan=1.0))).astype(np.uint16)


def _stretch_to_gray(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return the values of ``array`` as gray, uint8, scaled so that the largest value is bright.

    The parameter ``color``, the frame's colours, is not used.
    """
    return array * np.uint8(255 // max(int(array.max()), 1))


def _blend_volumes(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return translucent shadow volumes over the frame's colours, uint8 (rows, cols, 3).

    ``color`` has the frame's colours. They are repeated if ``array`` holds the volumes of several algorithms side by side.
    """
    background = np.tile(color, (array.shape[0] // color.shape[0], array.shape[1] // color.shape[1], 1))
    opacity = (MAX_OPACITY * (1.0 - (1.0 - FACE_OPACITY) ** np.arange(256)))[array, None]
    return np.rint((1.0 - opacity) * background + opacity * np.array(VOLUME_COLOR)).astype(np.uint8)


def _pass_product(
    layer: PassLayer,
    description: str,
    formats: tuple[MapFormat, ...],
    to_picture: Callable[..., Any] | None = None,
    draw_over_frame: Callable[..., Any] | None = None,
    view_kinds: tuple[ViewKind, ...] = ("map", "perspective"),
) -> Product:
    """Return the product that shows a layer of an algorithm's render pass, such as a shadow map.

    ``to_picture`` returns a picture for PNG from the layer and the frame's colours, and ``draw_over_frame`` one from the layer and
    the frame; without either the layer itself is shown. ``view_kinds`` are the kinds of views that it exists for.
    """

    def compute(product_input: ProductInput) -> np.ndarray:
        """Return the pass layer of the frame's first light. Raises ``InputError`` if the light has none."""
        frame = product_input.frame
        by_light, light = frame.layers.get(layer, {}), next(iter(frame.visibilities))
        notes = [record.note for record in frame.passes if record.name.startswith(f"{light}/") and record.note]
        if light not in by_light and notes:
            raise InputError(
                "layer", Problem(f"{light} has no layer {layer} in this view: {notes[0]}"), "Use another view or layer"
            )
        if not by_light:
            raise InputError("layer", Problem(f"no light has a layer {layer} in this view"), "Use another view or layer")
        if light not in by_light:
            raise InputError("light", light, f"{', '.join(by_light)} for layer {layer}")
        return by_light[light]

    return Product(
        name=layer, description=description, formats=formats, compute=compute, needs=NEEDS_FRAME, pass_layer=layer,
        to_picture=to_picture, draw_over_frame=draw_over_frame, view_kinds=view_kinds,
    )  # fmt: skip


PRODUCTS = (
    _pass_product("shadow-map", "depths of shadow maps, nearest to the light brightest", ("npy", "png"), _gray_of_depths),
    _pass_product("stencil", "the stencil buffer of shadow volumes", ("npy", "png"), _stretch_to_gray),
    _pass_product(
        "silhouettes", "edges of casters seen from the light; for a hybrid, the pixels that its volumes decide", ("npy", "png")
    ),
    _pass_product("volumes", "shadow volumes over the picture", ("npy", "png"), _blend_volumes),
    _pass_product("shadow-height", "the height in metres above which the sun is visible", ("npy", "tif")),
    _pass_product(
        "light-frustum", "the space that each shadow map covers, as lines over the picture", ("npy", "png"),
        draw_over_frame=draw_lines_over_frame, view_kinds=("perspective",),
    ),
    _pass_product(
        "light-bounds", "the boxes of receivers and casters that shadow maps are fitted to", ("npy", "png"),
        draw_over_frame=draw_lines_over_frame, view_kinds=("perspective",),
    ),
    _pass_product("light-view", "what the light sees in its shadow maps, near parts bright", ("npy", "png"), tone_map_light_view),
    _pass_product(
        "post-perspective", "the scene in the space of a perspective shadow map", ("npy", "png"),
        draw_over_frame=draw_post_perspective, view_kinds=("perspective",),
    ),
)  # fmt: skip
