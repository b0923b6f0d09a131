"""Line of sight over the relief: whether the ground of a raster's overview blocks a ray.

The ground is bilinear between the overview's cells. A ray is straight, so over a distance d it rises by d^2 / 2R above the curved
earth. The ray is traced from one row or column of cells to the next, where the bilinear ground has its edges. It skips whole blocks
of cells whose maximum height lies below it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.facts.probes import ProbeRays, Probes
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.heightfield.walks import exit_share, shares_per_node, write_tile_max
from skugga.terrain.interpolation_loops import blend_corners, cell_interval

SKIP_BLOCK_CELLS = 16
"""Side of the blocks of cells that a ray can skip at once."""

ENTRY_STEP_CELLS = 1e-6
"""Distance in cells behind an edge at which a ray is located, to find the square that it enters."""

MIN_OCCLUDER_CELLS = 1.0
"""Minimum distance of an occluder from the start of a ray, in cells of its main axis. Nearer ground is that on which it starts."""


@dataclass(frozen=True, eq=False)
class OverviewProbes:
    """Positions of probes on the overview of a raster.

    Attributes
    ----------
    row, col
        Fractional cell positions (n,).
    height_m
        Heights of the probes (n,), metres.
    up_frame
        Up directions in the probes' frame (n, 3).
    row_gradient_frame, col_gradient_frame
        Gradients of the row and the column (n, 3): cells per metre along each axis of the probes' frame.
    """

    row: np.ndarray
    col: np.ndarray
    height_m: np.ndarray
    up_frame: np.ndarray
    row_gradient_frame: np.ndarray
    col_gradient_frame: np.ndarray


@cached("scene", 64 * MIB)
def overview_probes(world: World, elevation: Elevation, probes: Probes) -> OverviewProbes:
    """Return the positions of probes on the overview of a raster. Recent results are cached.

    Rows and columns are not finite outside of the area of the CRS.
    """
    return _locate_on_overview(world, elevation, probes.frame, probes.point_earth_m)


def is_hidden_by_relief(
    world: World, elevation: Elevation, frame: LocalFrame, point_frame_m: np.ndarray, to_light: np.ndarray
) -> np.ndarray:
    """Return whether the overview's ground hides an infinitely distant light, in a direction (3,), from points (n, 3)."""
    probes = _locate_on_overview(world, elevation, frame, frame.points_to_earth(point_frame_m))
    rays = ProbeRays(
        point_frame_m[None], np.broadcast_to(to_light, (1, *point_frame_m.shape)), np.full((1, len(point_frame_m)), np.inf)
    )
    return _is_occluded(world, elevation, probes, np.zeros((1, *point_frame_m.shape)), rays)[0]


def _locate_on_overview(world: World, elevation: Elevation, frame: LocalFrame, point_earth_m: np.ndarray) -> OverviewProbes:
    """Return the positions of earth-fixed points (n, 3) on the overview of a raster.

    ``frame`` is the local frame of the result's gradients and directions. The gradients are differences over one cell of the
    overview. Rows and columns are not finite outside of the area of the CRS.
    """
    x, y, height = world.map_position(elevation.crs, point_earth_m)
    if elevation.crs.is_geographic:  # the longitude nearest to the middle of the raster
        x = x + 360.0 * np.rint(((elevation.bounds[0] + elevation.bounds[2]) / 2 - x) / 360.0)
    factor = 2**elevation.overview.lod
    row, col = elevation.cell_of(x, y)
    half = 0.5 * factor * np.array([[[0.0], [1.0], [0.0]], [[0.0], [0.0], [1.0]]])
    point, up = world.points_at_zero_height(elevation.crs, *elevation.xy(row + half[0], col + half[1]))
    row, col = ((v + 0.5) / factor - 0.5 for v in (row, col))
    to_frame = frame.directions_from_earth
    south, east = to_frame(2.0 * (point[1] - point[0])), to_frame(2.0 * (point[2] - point[0]))
    return OverviewProbes(row, col, height, to_frame(up[0]), *_dual_basis(south, east))


def _dual_basis(south: np.ndarray, east: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the dual basis (n, 3) of two vectors: dot products with it give the components of a vector along the two."""
    ss, ee, se = (np.einsum("ij,ij->i", a, b)[:, None] for a, b in ((south, south), (east, east), (south, east)))
    area = ss * ee - se * se
    return (ee * south - se * east) / area, (ss * east - se * south) / area


def is_blocked_by_relief(
    world: World, elevation: Elevation, probe_positions: OverviewProbes, probes: Probes, rays: ProbeRays
) -> np.ndarray:
    """Return whether the ground blocks each ray (1 + k, n), bool.

    ``probe_positions`` are the positions of the probes on the raster's overview.
    """
    return _is_occluded(world, elevation, probe_positions, rays.start_frame_m - probes.point_frame_m, rays)


def _is_occluded(
    world: World, elevation: Elevation, probe_positions: OverviewProbes, start_offset_frame_m: np.ndarray, rays: ProbeRays
) -> np.ndarray:
    """Return whether the ground blocks each ray (k, n).

    ``start_offset_frame_m`` (k, n, 3) are the offsets of the starts from the probes.
    """
    direction = rays.direction_frame

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.einsum("kij,ij->ki", a, b)

    rise = dot(direction, probe_positions.up_frame)
    bend = world.curvature / 2.0
    return _trace_blocked(
        *_heights_and_block_maxima(elevation),
        probe_positions.row + dot(start_offset_frame_m, probe_positions.row_gradient_frame),
        probe_positions.col + dot(start_offset_frame_m, probe_positions.col_gradient_frame),
        probe_positions.height_m + dot(start_offset_frame_m, probe_positions.up_frame),
        dot(direction, probe_positions.row_gradient_frame), dot(direction, probe_positions.col_gradient_frame), rise,
        bend * (1.0 - rise**2), np.ascontiguousarray(rays.length_m),
    )  # fmt: skip


@cached("scene", 256 * MIB)
def _heights_and_block_maxima(elevation: Elevation) -> tuple[np.ndarray, np.ndarray]:
    """Return the overview's heights, with -1e9 for nodata, and the maximum of each block of cells.

    A block's maximum includes the cells after its last row and column, since the ground is bilinear up to them.
    """
    heights = np.nan_to_num(elevation.overview.mean_heights_m, nan=-1e9)
    block_max = np.empty([-(-size // SKIP_BLOCK_CELLS) for size in heights.shape], np.float32)
    write_tile_max(heights, block_max, SKIP_BLOCK_CELLS)
    return heights, block_max


@compiled
def _trace_blocked(heights, block_max, row, col, height, d_row, d_col, rise, bend, length):
    """Return whether the ground blocks each ray, bool (k, n).

    Parameters with the shape (k, n) describe the rays. Distances along them are metres, rows and columns those of the overview.

    Parameters
    ----------
    heights, block_max
        Heights (rows, cols) of the overview's cells and maximum height of each block of cells, metres.
    row, col, height
        Fractional cell positions and heights of the starts, metres.
    d_row, d_col
        Change of row and column per metre.
    rise, bend
        The height at distance t from the start is ``height + t * (rise + bend * t)``. ``bend`` allows for the earth's curvature.
    length
        Lengths, metres; infinite for the sun.
    """
    (rows, cols), side, highest = heights.shape, SKIP_BLOCK_CELLS, block_max.max()
    max_row, max_col = rows - 1 + ENTRY_STEP_CELLS, cols - 1 + ENTRY_STEP_CELLS
    out = np.empty(row.shape, np.bool_)
    for i in range(row.shape[0]):
        for n in range(row.shape[1]):
            out[i, n] = False
            r0, c0, dr, dc, up = row[i, n], col[i, n], d_row[i, n], d_col[i, n], rise[i, n]
            max_rate = max(abs(dr), abs(dc))
            if not (max_rate > 1e-12):  # vertical, or NaN outside of the CRS
                continue
            per_row, per_col = shares_per_node(dr, dc)
            t, epsilon = MIN_OCCLUDER_CELLS / max_rate, ENTRY_STEP_CELLS / max_rate
            while t < length[i, n]:
                r, c, h = r0 + t * dr, c0 + t * dc, height[i, n] + t * (up + bend[i, n] * t)
                is_inside = -ENTRY_STEP_CELLS <= r <= max_row and -ENTRY_STEP_CELLS <= c <= max_col
                if not is_inside or (h > highest and up >= 0.0):
                    break
                block_row, block_col = int(r) // side, int(c) // side
                if up >= 0.0 and h > block_max[block_row, block_col]:
                    # The first blocks include the margin before the raster. A ray along it would leave them anew at every step.
                    top = block_row * side if block_row else -ENTRY_STEP_CELLS
                    left = block_col * side if block_col else -ENTRY_STEP_CELLS
                    t = exit_share(r0, per_row, c0, per_col, top, left, float(side), t) + epsilon
                    continue
                row_before, row_after, row_fraction = cell_interval(r, rows)
                col_before, col_after, col_fraction = cell_interval(c, cols)
                north_west, north_east = heights[row_before, col_before], heights[row_before, col_after]
                south_west, south_east = heights[row_after, col_before], heights[row_after, col_after]
                if blend_corners(north_west, north_east, south_west, south_east, row_fraction, col_fraction) > h:
                    out[i, n] = True
                    break
                # Go to the next row or column of cells, where bilinear ground has its edges.
                top, left = np.floor(r + epsilon * dr), np.floor(c + epsilon * dc)
                t = exit_share(r0, per_row, c0, per_col, top, left, 1.0, t + epsilon)
    return out
