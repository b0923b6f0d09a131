"""Views with fewer pixels: every n-th pixel of a view as it is in the full one, nothing in between."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from terrain.gbuffer.geometry import GeometryBuffer
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView

_OF_PIXELS = (
    "there", "position_frame_m", "height_m", "normal_frame", "shading_normal_frame", "crease", "kind", "triangle",
    "corners_frame_m", "lift_m", "lifted",
)  # fmt: skip


def subsampled_view(view: MapView | PerspectiveView, every: int) -> MapView | PerspectiveView:
    """Every n-th pixel of a view along rows and columns, from the first one on."""
    rows, cols = -(-view.rows // every), -(-view.cols // every)
    if isinstance(view, MapView):
        return replace(view, row_step=view.row_step * every, col_step=view.col_step * every, rows=rows, cols=cols)
    return replace(view, step=view.step * every, rows=rows, cols=cols)


def subsampled_points(buffer: GeometryBuffer, every: int) -> GeometryBuffer:
    """A buffer's points in every n-th pixel, just as they are, to look from for a light. Colours and columns are left out."""
    arrays = {name: getattr(buffer, name) for name in _OF_PIXELS}
    fewer: dict[str, Any] = {
        name: None if array is None else np.ascontiguousarray(array[::every, ::every]) for name, array in arrays.items()
    }
    return replace(buffer, view=subsampled_view(buffer.view, every), columns=None, albedo=None, **fewer)
