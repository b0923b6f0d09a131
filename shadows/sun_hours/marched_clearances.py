"""The clearance angles of a block's cells where sun and shade change, by marches towards the sun at a moment. Compiled loops.

The clearance of the line sweep is a length. In sunlight it is mostly the distance from the cell's own neighbour, in shadow that
from a ridge. The clearance here is the tangent of the sun's altitude less that of the horizon. It changes smoothly as the sun
passes the horizon, so a line through its values at two moments tells when it is 0. Only cells that change between sun and shade
before or after the moment need it. Marches (``skugga.shadows.horizons.march``) find their horizons, 64 cells side by side at once.

Within a march the direction to the sun is constant. It changes over a wide block, so the block is divided into tiles.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skugga.shadows.horizons.march import NO_EYE_M, NO_GROUND_M, RUN, Ground, Rays, march_run
from skugga.shadows.horizons.turned import MAX_CHORD_ERROR, rays_of, turned_ground
from skugga.shadows.sun_hours.quadratics import evaluate_quadratic
from skugga.shadows.sun_hours.sight_walks import EARTH_CURVATURE_PER_M, SunTrack, WalkedGround
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.terrain.compiled import compiled, map_on_cores
from skugga.terrain.gbuffer.bare_nodes import BareNodes

MARGIN_TANGENT = 0.03
"""Tangent by which a lower horizon is not searched, beside the sun's change of tangent until the moments before and after."""

MAX_DIRECTION_ERROR = 0.001
"""Maximum difference of the direction to the sun between the middle of a tile and its corners, as a share of its length."""

MAX_TILES_PER_SIDE = 16
"""Maximum number of tiles along a side of a block."""

BAND_ROWS = 128
"""Rows that a thread processes at a time."""


@dataclass(frozen=True, eq=False)
class MarchedGround:
    """The ground of a block in the order that marches need.

    Attributes
    ----------
    orientation
        The orientation of the sun-aligned grid. The columns of marches are mirrored to it: their rays run to the right.
    ground
        The ground that the rays cross, with heights above a common level.
    first_node
        The row and the column of the ground at which the block's first node, and so the last column's, lies after turning.
    """

    orientation: GridOrientation
    ground: Ground
    first_node: tuple[int, int]


def marched_ground(nodes: BareNodes, walked: WalkedGround, orientation: GridOrientation) -> MarchedGround:
    """Return the finest grid of the ground that casts shadows on a block's nodes, for marches in an orientation."""
    begin, _, first_row, first_col, rows, cols, _, _ = walked.grid_layouts[0].tolist()
    height_m = walked.height_m[begin : begin + rows * cols].reshape(rows, cols)
    known = np.isfinite(height_m)
    level_m = np.float32(np.mean(height_m[known], dtype=np.float64)) if known.any() else np.float32(0.0)
    mirrored = GridOrientation(orientation.axes_swapped, orientation.rows_reversed, not orientation.cols_reversed)
    top, left = int(nodes.view.row0) - first_row, int(nodes.view.col0) - first_col
    corners = np.array([top, top + nodes.view.rows - 1]), np.array([left, left + nodes.view.cols - 1])
    row, col = mirrored.to_sun_aligned(*corners, rows, cols)
    return MarchedGround(orientation, turned_ground(height_m, level_m, mirrored), (int(row.min()), int(col.min())))


def clearance_tangents(
    marched: MarchedGround,
    track: SunTrack,
    clearances: tuple[np.ndarray, np.ndarray, np.ndarray],
    eye_height_m: float,
    margin_tangent: float,
    cores: int,
) -> np.ndarray:
    """Return the tangent of the sun's altitude less that of the horizon at the cells where sun and shade change.

    Parameters
    ----------
    marched
        The ground.
    track
        The direction to the sun; that at its beginning counts.
    clearances
        Clearances (n, m) of the cells at the moment before, at this one and at the one after. Cells where the sign of the second
        one differs from that of another one are computed.
    eye_height_m
        Height of the eyes above the nodes of the ground, metres.
    margin_tangent
        Horizons that are lower than the sun by more than this tangent are not searched.
    cores
        Number of threads.

    Returns
    -------
    np.ndarray
        float32 (n, m): the clearance tangents, at most ``margin_tangent``; undefined at all other cells.
    """
    out = np.empty(clearances[1].shape, np.float32)
    sun_tangent = track.direction_coefficients[2, 0]

    def march_tile(tile: tuple[slice, slice, Rays]) -> None:
        rows, cols, rays = tile
        _write_tangents(
            marched.ground, rays, *marched.first_node, *clearances, rows.start, rows.stop, cols.start, cols.stop, sun_tangent,
            np.float32(eye_height_m), np.float32(margin_tangent), np.float32(MAX_CHORD_ERROR), out,
        )  # fmt: skip

    map_on_cores(march_tile, _tiles(marched, track, out.shape), cores)
    return out


def _tiles(marched: MarchedGround, track: SunTrack, shape: tuple[int, ...]) -> Iterator[tuple[slice, slice, Rays]]:
    """Yield the rows and columns of tiles of the sun-aligned grid, and the rays towards the sun of each."""
    n, m = shape
    orientation = marched.orientation
    rows_per_metre, cols_per_metre = track.direction_coefficients[0, 0], track.direction_coefficients[1, 0]
    main_axis, cross_axis = (cols_per_metre, rows_per_metre) if orientation.axes_swapped else (rows_per_metre, cols_per_metre)
    axes = np.stack([main_axis, cross_axis])
    axes[0] *= 1.0 if orientation.rows_reversed else -1.0  # towards row 0
    axes[1] *= 1.0 if orientation.cols_reversed else -1.0  # to the right, in the order of marches

    def direction(y: float, x: float) -> np.ndarray:
        return np.asarray(axes @ np.array([1.0, y, x, y * y, y * x, x * x]))

    middle = direction(0.5, 0.5)
    corners = [direction(y, x) for y in (0.0, 1.0) for x in (0.0, 1.0)]
    difference = max(float(np.linalg.norm(corner - middle)) for corner in corners) / float(np.linalg.norm(middle))
    count = int(np.clip(np.ceil(difference / MAX_DIRECTION_ERROR), 1, MAX_TILES_PER_SIDE))
    row_ends, col_ends = (np.linspace(0, side, count + 1).astype(int) for side in (n, m))
    for top, bottom in zip(row_ends[:-1].tolist(), row_ends[1:].tolist(), strict=True):
        for left, right in zip(col_ends[:-1].tolist(), col_ends[1:].tolist(), strict=True):
            if top == bottom or left == right:
                continue
            main, cross = direction(0.5 * (top + bottom) / n, 0.5 * (left + right) / m)
            slope = float(np.clip(cross / main, 0.0, 1.0))
            rays = rays_of(marched.first_node[0] + bottom, slope, 1.0 / float(main), EARTH_CURVATURE_PER_M)
            for first in range(top, bottom, BAND_ROWS):
                yield slice(first, min(first + BAND_ROWS, bottom)), slice(left, right), rays


@compiled
def _write_tangents(
    ground, rays, first_row, first_col, before, here, after, top, bottom, left, right, sun_tangent, eye_height_m, margin,
    max_chord_error, out,
):  # fmt: skip
    """Write the clearance tangents of a tile, rows [``top``, ``bottom``) and columns [``left``, ``right``) of the sun-aligned grid.

    ``ground`` and ``rays`` are those of ``march_run``. The block's nodes begin at row ``first_row`` and column ``first_col`` of the
    ground, whose columns are mirrored. ``before``, ``here`` and ``after`` (n, m) are the clearances at three moments.
    ``sun_tangent`` (6,) is the quadratic of the tangent of the sun's altitude over the block.
    """
    n, m = out.shape
    state = np.empty(2 * RUN, np.float32)
    sun = np.empty(RUN, np.float32)
    for begin in range(left, right, RUN):
        count = min(RUN, right - begin)
        col = first_col + m - begin - count  # of the ground, at the last column of the run
        for i in range(top, bottom):
            is_active = False
            for c in range(count):
                j = begin + c
                lit = here[i, j] >= 0.0
                is_active |= lit != (before[i, j] >= 0.0) or lit != (after[i, j] >= 0.0)
            if not is_active:
                continue
            y, last_col = i / max(n - 1, 1), max(m - 1, 1)
            last_sun = np.float32(evaluate_quadratic(sun_tangent, y, (begin + count - 1) / last_col))
            sun_per_lane = (np.float32(evaluate_quadratic(sun_tangent, y, begin / last_col)) - last_sun) / np.float32(
                max(count - 1, 1)
            )
            for c in range(RUN):
                state[c], state[RUN + c] = NO_GROUND_M, NO_EYE_M
            for c in range(count):
                j, lane = begin + c, count - 1 - c
                lit = here[i, j] >= 0.0
                sun[lane] = last_sun + lane * sun_per_lane  # the quadratic is a line over so few columns
                state[lane] = sun[lane] - margin
                node_m = ground.height_m[first_row + i, col + lane]
                if (lit != (before[i, j] >= 0.0) or lit != (after[i, j] >= 0.0)) and node_m > NO_GROUND_M:
                    state[RUN + lane] = node_m + eye_height_m
            march_run(ground, rays, first_row + i, col, max_chord_error, state)
            for c in range(count):
                lane = count - 1 - c
                out[i, begin + c] = sun[lane] - state[lane]
