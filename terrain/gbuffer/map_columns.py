"""Geometry buffers of maps whose ground is upright columns (``skugga.terrain.ground.columns``).

Each raster cell is a column with a flat top. A pixel shows the middle of the top of its column.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import NO_SURFACE, RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.columns import find_columns
from skugga.terrain.ground.surface import Surface


def column_geometry(surface: Surface, view: MapView, frame: LocalFrame, pixel_mask: np.ndarray | None = None) -> GeometryBuffer:
    """Return the geometry buffer of the columns in a map view, such as a block.

    ``pixel_mask`` (rows, cols) selects pixels; the others show nothing. Raises ``UnsupportedError`` if the view spans too many
    cells.
    """
    row, col = view.row0 + np.arange(view.rows) * view.row_step, view.col0 + np.arange(view.cols) * view.col_step
    columns, tops = find_columns(surface, row, col, frame)
    valid = tops.valid if pixel_mask is None else tops.valid & pixel_mask
    kind = np.where(valid, np.uint8(RELIEF), np.uint8(NO_SURFACE))
    return GeometryBuffer(
        view, frame, valid, tops.position_frame_m, tops.height_m, tops.up_frame, tops.up_frame.copy(),
        np.zeros(valid.shape, np.float32), kind, columns=columns,
    )  # fmt: skip


def column_top_corners(buffer: GeometryBuffer) -> np.ndarray:
    """Return ``corners_frame_m`` of a buffer of columns, with the corners of the ground's triangles added.

    The result is float32 (rows, cols, 9). A pixel of the ground holds one of the two triangles of its column's top.
    """
    columns, corners = buffer.columns, buffer.corners_frame_m
    assert columns is not None
    corners = np.zeros((*buffer.valid.shape, 9), np.float32) if corners is None else corners.copy()
    ground = buffer.valid & (buffer.surface_kind == RELIEF)
    _write_corners(columns.window.sheet.position_frame_m, ground, columns.row, columns.col, corners)
    return corners


@compiled
def _write_corners(nodes, ground, row, col, corners):
    """Write the corners (9,) of the north-western triangle of a column's top to ``corners``, in each pixel that shows ground.

    ``nodes`` are the corners of all tops: rows 2 r and 2 r + 1, and columns 2 c and 2 c + 1, belong to the column at row r and
    column c. ``row`` and ``col`` (rows, cols) are the column in each pixel, and the mask ``ground`` selects pixels.
    """
    for i in range(row.shape[0]):
        for j in range(row.shape[1]):
            if ground[i, j]:
                top, left = 2 * row[i, j], 2 * col[i, j]
                for k in range(3):
                    corners[i, j, k] = nodes[top, left, k]
                    corners[i, j, 3 + k] = nodes[top + 1, left, k]
                    corners[i, j, 6 + k] = nodes[top, left + 1, k]
