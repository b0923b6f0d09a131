"""Size of a shadow map's texels at the visible points. Metrics use it to tell failures of an algorithm from aliasing."""

from __future__ import annotations

import numpy as np

from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.cache import MIB, cached
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene


def texel_footprint_px(scene: Scene, step: Step | None, buffer: GeometryBuffer, pixel_m: float) -> np.ndarray:
    """Return the larger side of a shadow-map texel on level ground at each point of a buffer, in pixels (rows, cols).

    ``step`` is the call of an algorithm with its settings, and ``pixel_m`` the side of a map's pixel, metres. The result is 0 for
    algorithms without texels, and in pixels without a surface.
    """
    texel_of = None if step is None else ALGORITHMS[step.algorithm].accuracy.texel_m
    if step is None or texel_of is None:
        return np.zeros(buffer.valid.shape)
    texel_m = texel_of(scene, step.light, step.kinds, step.settings, buffer)
    size_m = _pixel_at_points_m(buffer) if isinstance(buffer.view, PerspectiveView) else pixel_m
    return np.broadcast_to(np.nan_to_num(texel_m / size_m), buffer.valid.shape)


@cached("scene", 512 * MIB)
def _pixel_at_points_m(buffer: GeometryBuffer) -> np.ndarray:
    """Return the side of a perspective view's pixel at the depth of each visible point: metres (rows, cols)."""
    view = buffer.view
    assert isinstance(view, PerspectiveView)
    eye, camera_from_frame = view.in_frame(buffer.frame)
    return (buffer.position_frame_m - eye) @ camera_from_frame[2] * view.pixel_tangent
