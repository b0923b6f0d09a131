"""Subsample views: select every n-th pixel of a view, without filtering, as it is in the full view."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView

PIXEL_ARRAY_NAMES = (
    "valid", "position_frame_m", "height_m", "normal_frame", "shading_normal_frame", "crease", "surface_kind", "triangle",
    "corners_frame_m", "lift_m", "is_lifted",
)  # fmt: skip


def subsampled_view(view: MapView | PerspectiveView, stride: int) -> MapView | PerspectiveView:
    """Return the view of every ``stride``-th pixel along rows and columns, from the first pixel on. Pixels keep their width."""
    rows, cols, share = -(-view.rows // stride), -(-view.cols // stride), view.pixel_share / stride
    if isinstance(view, MapView):
        row_step, col_step = view.row_step * stride, view.col_step * stride
        return replace(view, row_step=row_step, col_step=col_step, rows=rows, cols=cols, pixel_share=share)
    return replace(view, step_px=view.step_px * stride, rows=rows, cols=cols, pixel_share=share)


def subsampled_points(buffer: GeometryBuffer, stride: int, first: tuple[int, int] = (0, 0)) -> GeometryBuffer:
    """Return a buffer with the points of every ``stride``-th pixel, counted from the pixel ``first`` (row, column) on.

    The points do not change. The buffer serves shadow queries only: its ``albedo``, ``columns`` and ``mesh_triangle`` are ``None``.
    """
    row, col = first
    view = subsampled_view(buffer.view.part(row, col, buffer.view.rows - row, buffer.view.cols - col), stride)
    arrays = {name: getattr(buffer, name) for name in PIXEL_ARRAY_NAMES}
    subsampled: dict[str, Any] = {
        name: None if array is None else np.ascontiguousarray(array[row::stride, col::stride]) for name, array in arrays.items()
    }
    return replace(buffer, view=view, columns=None, albedo=None, mesh_triangle=None, **subsampled)
