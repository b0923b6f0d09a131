"""Products for tests: rasters under suns, hours of sun, and blocks of maps drawn by the fast path or by frames."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from skugga.api.compute import ProgressCallback, raster_array, write_rasters
from skugga.api.products.sun_hours import SunHoursOptions
from skugga.api.raster_view import RasterView
from skugga.api.request import ProductRequest
from skugga.shadows.draw import SHADING_NEEDS, draw
from skugga.shadows.ground_pictures import ground_picture
from skugga.shadows.passes import PassLog
from skugga.shadows.picture import Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import apply_refraction
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene


def write_shade(
    scene: Scene,
    raster: RasterView,
    product: str,
    suns: Sequence[SunSpec | None],
    paths: Sequence[Path],
    on_step: ProgressCallback | None = None,
) -> None:
    """Write a product under several suns, one file each."""
    write_rasters(scene, raster, [ProductRequest(product=product, sun=sun) for sun in suns], paths, {}, on_step)


def shade_array(scene: Scene, raster: RasterView, product: str, sun: SunSpec | None) -> np.ndarray:
    """Return a product under a sun as an array."""
    return raster_array(scene, raster, ProductRequest(product=product, sun=sun))


def sun_hours_of(**options: Any) -> ProductRequest:
    """Return the request for hours of sun with some options."""
    return ProductRequest(product="sunhours", options=SunHoursOptions(**options))


def draw_map(scene: Scene, view: MapView, plan: Plan) -> Picture:
    """Return the picture of a map, drawn by the fastest path."""
    return draw(scene, view, plan, SHADING_NEEDS)


def draw_by_heights(scene: Scene, view: MapView, plan: Plan) -> Picture | None:
    """Return the picture of a block with its passes, drawn by the loops over heights; ``None`` if these do not suffice."""
    log = PassLog()
    picture = ground_picture(apply_refraction(scene, plan, log), view, plan, SHADING_NEEDS, log)
    return None if picture is None else Picture(**{**vars(picture), "passes": tuple(log.records.values())})
