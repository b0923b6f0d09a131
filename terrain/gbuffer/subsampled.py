"""Subsample views: take every n-th pixel as it is in the full view, without filtering."""

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
    """Return the view of every n-th pixel along rows and columns, from the first one. Pixels keep their width."""
    rows, cols, share = -(-view.rows // every), -(-view.cols // every), view.pixel_share / every
    if isinstance(view, MapView):
        row_step, col_step = view.row_step * every, view.col_step * every
        return replace(view, row_step=row_step, col_step=col_step, rows=rows, cols=cols, pixel_share=share)
    return replace(view, step=view.step * every, rows=rows, cols=cols, pixel_share=share)


def subsampled_points(buffer: GeometryBuffer, every: int, first: tuple[int, int] = (0, 0)) -> GeometryBuffer:
    """Return a buffer with the points of every n-th pixel from ``first`` (row, column) on, unchanged, for shadow queries.

    Albedo and columns are left out.
    """
    row, col = first
    view = subsampled_view(buffer.view.part(row, col, buffer.view.rows - row, buffer.view.cols - col), every)
    arrays = {name: getattr(buffer, name) for name in _OF_PIXELS}
    some: dict[str, Any] = {
        name: None if array is None else np.ascontiguousarray(array[row::every, col::every]) for name, array in arrays.items()
    }
    return replace(buffer, view=view, columns=None, albedo=None, **some)
