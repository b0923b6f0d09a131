"""Grid meshes: nodes in rows and columns, whose quads are cut into triangles.

A quad is cut along the diagonal whose ends have the higher sum of heights. This gives the upper hull of its four corners: at every
point the higher of the two possible surfaces. The rule prefers no side, unlike a fixed diagonal: rotated or mirrored ground is cut
into rotated or mirrored triangles. Ridges and walls one node wide stay whole in any direction. If both sums are equal, the quad is
planar and either cut gives the same surface.

Heights are compared as stored, in float64, before the earth's curvature bends them, so the cut does not depend on a frame. If a
quad misses one corner, the other three are a triangle. A quad that misses more corners has none.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from skugga.terrain.compiled import compiled


@dataclass(frozen=True, eq=False)
class Sheet:
    """A grid mesh: nodes, and the diagonals along which their quads are cut.

    Attributes
    ----------
    position_frame_m
        float64 (rows, cols, 3), metres; NaN where a node is missing.
    is_cut_nw_se
        bool (rows - 1, cols - 1): whether a quad is cut from its north-west to its south-east corner (rows run south, columns
        east); otherwise it is cut from its south-west to its north-east corner.
    """

    position_frame_m: np.ndarray
    is_cut_nw_se: np.ndarray

    @cached_property
    def triangles(self) -> np.ndarray:
        """Node indices (n, 3) int32, row by row, of the triangles without a missing corner; counter-clockwise from above."""
        triangles = sheet_triangles(self.is_cut_nw_se)
        is_valid = np.isfinite(self.position_frame_m[..., 2]).ravel()
        return triangles if is_valid.all() else _triangles_with_valid_corners(triangles, is_valid)

    @cached_property
    def normals_frame(self) -> np.ndarray:
        """Unit normals (rows - 1, cols - 1, 2, 3) float32 of each quad's triangles; NaN where a corner is missing."""
        return _normals(self.position_frame_m, self.is_cut_nw_se)


def sheet_of(position_frame_m: np.ndarray, height_m: np.ndarray | None = None) -> Sheet:
    """Return the mesh of nodes (rows, cols, 3), cut by heights (rows, cols), or else by the nodes' third coordinate."""
    return Sheet(position_frame_m, diagonal_cuts(position_frame_m[..., 2] if height_m is None else height_m))


@compiled
def diagonal_cuts(height):
    """Return which quads (rows - 1, cols - 1) of nodes with heights (rows, cols) are cut from north-west to south-east, bool.

    NaN is a missing corner: the cut then runs between its two neighbours.
    """
    rows, cols = max(height.shape[0] - 1, 0), max(height.shape[1] - 1, 0)
    out = np.empty((rows, cols), np.bool_)
    for r in range(rows):
        for c in range(cols):
            falling = np.float64(height[r, c]) + np.float64(height[r + 1, c + 1])
            rising = np.float64(height[r, c + 1]) + np.float64(height[r + 1, c])
            out[r, c] = falling > rising or np.isnan(rising)
    return out


@compiled
def sheet_triangles(is_cut_nw_se):
    """Return node indices (2 * quads, 3) int32 of a mesh's triangles: for each quad the one on its north side, then the other.

    The corners of a quad cut from south-west to north-east are NW, SW, NE and SE, NE, SW. Those of a quad cut the other way are
    NE, NW, SE and SW, SE, NW.
    """
    rows, cols = is_cut_nw_se.shape
    out = np.empty((2 * rows * cols, 3), np.int32)
    for r in range(rows):
        for c in range(cols):
            n = 2 * (r * cols + c)
            nw = r * (cols + 1) + c
            ne, sw, se = nw + 1, nw + cols + 1, nw + cols + 2
            if is_cut_nw_se[r, c]:
                out[n, 0], out[n, 1], out[n, 2] = ne, nw, se
                out[n + 1, 0], out[n + 1, 1], out[n + 1, 2] = sw, se, nw
            else:
                out[n, 0], out[n, 1], out[n, 2] = nw, sw, ne
                out[n + 1, 0], out[n + 1, 1], out[n + 1, 2] = se, ne, sw
    return out


@compiled
def _normals(position, is_cut_nw_se):
    """Return the unit normals (rows - 1, cols - 1, 2, 3) float32 of the quads' triangles: the one on the north side comes first.

    ``position`` (rows, cols, 3) are the nodes. Normals are NaN where a corner is missing.
    """
    rows, cols = is_cut_nw_se.shape
    out = np.empty((rows, cols, 2, 3), np.float32)
    for r in range(rows):
        for c in range(cols):
            nw, ne, sw, se = position[r, c], position[r, c + 1], position[r + 1, c], position[r + 1, c + 1]
            for half in range(2):
                if is_cut_nw_se[r, c]:
                    o, a, b = (ne, nw, se) if half == 0 else (sw, se, nw)
                else:
                    o, a, b = (nw, sw, ne) if half == 0 else (se, ne, sw)
                ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
                bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
                x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
                length = np.sqrt(x * x + y * y + z * z)
                out[r, c, half, 0], out[r, c, half, 1], out[r, c, half, 2] = x / length, y / length, z / length
    return out


@compiled
def _triangles_with_valid_corners(triangles, is_valid):
    """Return the triangles (n, 3) whose corners are all ``is_valid``, in order."""
    out = np.empty((triangles.shape[0], 3), np.int32)
    count = 0
    for i in range(triangles.shape[0]):
        if is_valid[triangles[i, 0]] and is_valid[triangles[i, 1]] and is_valid[triangles[i, 2]]:
            for k in range(3):
                out[count, k] = triangles[i, k]
            count += 1
    return out[:count]


def has_gaps(valid: np.ndarray) -> bool:
    """Return whether the valid nodes (rows, cols) of any row or column are interrupted by invalid ones."""
    if valid.all():
        return False
    return any(
        bool(
            (np.diff(np.pad(valid.T if transposed else valid, ((0, 0), (1, 0))).astype(np.int8), axis=1) > 0).sum(axis=1).max() > 1
        )
        for transposed in (False, True)
    )
