"""Textured models in a view: which pixels show them, and bounds of what they can show. Three effects use them."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, ShadingBlock, pixel_size
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.texture_types import VisibleTriangles
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of
from skugga.terrain.srgb import srgb_of_linear

if TYPE_CHECKING:  # the module imports Pillow, which maps do not need
    from skugga.terrain.meshes.surface import SurfaceBounds

MAX_LIGHT_FACTOR = 1.5
"""Upper bound of a surface's light over the sum of the sun's and the sky's irradiances.

It includes the sky's bright side and the light that the ground reflects.
"""

MAX_STEPS = 255.0
"""Steps that stand for any visible change."""


class SurfaceInView(NamedTuple):
    """A material of a body in view, with a lower bound of the pixels' width on it, metres."""

    bounds: SurfaceBounds
    pixel_m: float


def surfaces_in_view(scene: Scene, view: MapView | PerspectiveView) -> list[SurfaceInView]:
    """Return the materials of models whose bounding spheres a perspective view may show. Maps show one colour for each triangle."""
    placement = scene.objects.placement
    if isinstance(view, MapView) or placement is None or placement.surface is None:
        return []
    from skugga.terrain.meshes.assemble import spheres_with_surfaces

    frame = view.frame(scene.world)
    eye, camera_from_frame = view.in_frame(frame)
    tangent_x = max(abs(view.col0), abs(view.col0 + view.cols * view.step_px)) / view.focal_px
    tangent_y = max(abs(view.row0), abs(view.row0 + view.rows * view.step_px)) / view.focal_px
    found = []
    for body, centre_earth, radius in spheres_with_surfaces(placement, scene.objects.clock_seconds):
        centre = camera_from_frame @ (frame.points_from_earth(centre_earth) - eye)
        is_in_view = centre[2] > -radius
        for axis, tangent in ((0, tangent_x), (1, tangent_y)):
            is_in_view &= bool(np.abs(centre[axis]) <= tangent * centre[2] + radius * np.hypot(1.0, tangent))
        if is_in_view:
            pixel_m = view.pixel_tangent * max(float(np.linalg.norm(centre)) - radius, 0.0)
            found += [SurfaceInView(bounds, pixel_m) for bounds in body.surface_bounds]
    return found


def visible_steps(scene: Scene, darker: np.ndarray, brighter: np.ndarray) -> float:
    """Return an upper bound of the steps of 255 by which a picture changes between two albedos (or cosines), for each of n values.

    The step of the sRGB curve between two albedos grows with the light, so the brightest one is the bound. Lamps may be arbitrarily
    bright: any change counts then.
    """
    if scene.lamps:
        return MAX_STEPS if (brighter > darker).any() else 0.0
    light = daylight_of(scene)
    brightest = MAX_LIGHT_FACTOR * float((light.sun_irradiance + light.sky_irradiance).max())
    steps = srgb_of_linear(brightest * np.maximum(brighter, 0.0)) - srgb_of_linear(brightest * np.maximum(darker, 0.0))
    return float(np.clip(steps.max() / SRGB_CHANNEL_STEP, 0.0, MAX_STEPS))


def visible_triangles(block: ShadingBlock) -> VisibleTriangles | None:
    """Return the triangles of models in a block for compiled loops; ``None`` where it shows none with a ``Surface``."""
    buffer, objects = block.buffer, block.scene.objects
    surface, solids = objects.surface, objects.solids
    if buffer.mesh_triangle is None or surface is None or solids is None or buffer.solids_frame_m is None:
        return None
    size = pixel_size(block)
    return VisibleTriangles(
        buffer.mesh_triangle, buffer.position_frame_m, buffer.solids_frame_m, solids.triangles, surface.uv, surface.color,
        surface.material, size.eye_frame_m, size.pixel_tangent,
    )  # fmt: skip
