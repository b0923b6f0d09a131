"""Views with fewer pixels: every n-th pixel of a view as it is in the full one, nothing in between."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView

_OF_PIXELS = (
    "there", "position_frame_m", "height_m", "normal_frame", "shading_normal_frame", "crease", "kind", "triangle",
    "corners_frame_m", "lift_m", "lifted",
)  # fmt: skip


def subsampled_view(view: MapView | PerspectiveView, every: int) -> MapView | PerspectiveView:
    """Every n-th pixel of a view along rows and columns, from the first one on: each as wide as it is in the view."""
    rows, cols, share = -(-view.rows // every), -(-view.cols // every), view.pixel_share / every
    if isinstance(view, MapView):
        row_step, col_step = view.row_step * every, view.col_step * every
        return replace(view, row_step=row_step, col_step=col_step, rows=rows, cols=cols, pixel_share=share)
    return replace(view, step=view.step * every, rows=rows, cols=cols, pixel_share=share)


def subsampled_points(buffer: GeometryBuffer, every: int, first: tuple[int, int] = (0, 0)) -> GeometryBuffer:
    """A buffer's points in every n-th pixel from the ``first`` one on, just as they are, to look from for a light. Colours and
    columns are left out.
    """
    row, col = first
    view = subsampled_view(buffer.view.part(row, col, buffer.view.rows - row, buffer.view.cols - col), every)
    arrays = {name: getattr(buffer, name) for name in _OF_PIXELS}
    some: dict[str, Any] = {
        name: None if array is None else np.ascontiguousarray(array[row::every, col::every]) for name, array in arrays.items()
    }
    return replace(buffer, view=view, columns=None, albedo=None, **some)
