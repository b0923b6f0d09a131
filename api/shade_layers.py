"""Layers of rasters of shade. A layer is a record in ``SHADE_LAYERS``, and no more.

What makes them is imported when they are made: their names are an option of a command.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from skugga.api.layers import MASK_LIT, MASK_NO_SURFACE, MASK_SHADOW

if TYPE_CHECKING:
    from skugga.shadows.plan import Plan
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.scene import Scene


@dataclass(frozen=True, kw_only=True)
class ShadeLayer:
    """What a raster of shade may hold: ``about`` it, and how it lies in a file."""

    about: str
    make: Callable[[Scene, MapView, Plan], np.ndarray]
    dtype: str = "float32"
    bands: int = 1
    nodata: float | None = float("nan")
    smooth: bool = True

    @property
    def band_names(self) -> tuple[str, ...]:
        """What each band is."""
        return (self.about,) if self.bands == 1 else ("red", "green", "blue", "alpha")


def _visibility(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    from skugga.shadows.render import render_frame
    from skugga.shadows.sunlit_ground import sunlit_ground

    found = sunlit_ground(scene, view, plan)
    if found is None:
        return render_frame(scene, view, plan).visibility
    return np.where(found.there, found.lit.astype(np.float32), np.float32(np.nan))


def _mask(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    visibility = _visibility(scene, view, plan)
    classes = np.where(visibility < 0.5, MASK_SHADOW, MASK_LIT)
    return np.where(np.isnan(visibility), MASK_NO_SURFACE, classes).astype(np.uint8)


def _color(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    from skugga.shadows.ground_pictures import shown_map

    shown = shown_map(scene, view, plan)
    return np.dstack([shown.color, np.where(shown.there, np.uint8(255), np.uint8(0))])


def _shadow(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    from skugga.shadows.ground_pictures import shown_map

    out = np.zeros((view.rows, view.cols, 4), np.uint8)
    out[..., 3] = shown_map(scene, view, plan).opacity
    return out


def _cosi(scene: Scene, view: MapView, plan: Plan) -> np.ndarray:
    from skugga.shadows.sunlit_ground import cosine_of_incidence

    return cosine_of_incidence(scene, view)


SHADE_LAYERS: dict[str, ShadeLayer] = {
    "mask": ShadeLayer(
        about=f"{MASK_SHADOW} shadow, {MASK_LIT} lit, {MASK_NO_SURFACE} no surface", make=_mask, dtype="uint8",
        nodata=MASK_NO_SURFACE, smooth=False,
    ),
    "visibility": ShadeLayer(about="share of the sun that is seen, NaN where there is no surface", make=_visibility),
    "cosi": ShadeLayer(about="cosine of the sun's angle of incidence on the ground", make=_cosi),
    "color": ShadeLayer(about="shaded relief with cast shadows", make=_color, dtype="uint8", bands=4, nodata=None),
    "shadow": ShadeLayer(about="black with the shadow as opacity", make=_shadow, dtype="uint8", bands=4, nodata=None),
}  # fmt: skip
"""Layers of rasters, by name."""
