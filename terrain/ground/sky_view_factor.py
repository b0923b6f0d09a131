"""Compute the sky-view factor of a heightfield, as sky occlusion: the share of a node's sky light that the ground around it hides.

Sky light is uniform over the sky. A plane with the unit normal n and no other ground around receives the share ``0.5 + 0.5 n.up``
of it. Sky occlusion is the share of the plane's light that ground above the plane hides: 0 on a plane, 1 at the bottom of a well.

Source: Dozier and Frew 1990, *Rapid calculation of terrain parameters for radiation modeling from digital elevation data*, the
sky-view factor of a slope from its horizon angles.

Horizon angles are computed in 16 azimuths: towards a node's 8 nearest and 8 next neighbours. The grid is divided into parallel
lines in each of these azimuths, which pass through nodes, or half-way between two. A sweep along a line has a stack with the upper
convex hull of the ground that it has passed (Timonen and Westerholm 2010, *Scalable Height Field Self-Shadowing*). So the work is
linear in the number of nodes, however far away an occluder is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.cell_finder import CellFinder, cell_finder_of, cell_in_plane, project_to_plane
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.heightfield.slopes import node_slopes
from skugga.terrain.heightfield.walks import loop_curvature_drop_m
from skugga.terrain.interpolation_loops import lerp_corners

MAX_SIDE_NODES = 1024
"""Longest side, in nodes, of the grid on which a raster's horizon angles are computed."""

MIN_CELL_WIDTH_SHARE = 0.01
"""Minimum width of a cell as a share of its height: at a pole a cell has no width."""


@dataclass(frozen=True, eq=False)
class SkyView:
    """Sky occlusion (the share of sky light that ground hides) at the nodes of a coarse grid over a raster.

    A grid of ``MAX_SIDE_NODES`` nodes a side takes 4 MB, and 15 MB with its two pyramids. Computing it takes about 100 MB.

    Attributes
    ----------
    occlusion
        float32 (rows, cols) in [0, 1].
    lod
        Level of detail of the nodes: a node is the centre of a square of ``2**lod`` raster cells a side.
    node_spacing_m
        Spacing of the nodes, metres.
    cell_finder
        Maps earth-fixed points to cells of the raster.
    """

    occlusion: np.ndarray
    lod: int
    node_spacing_m: float
    cell_finder: CellFinder

    @cached_property
    def mean_pyramid(self) -> tuple[np.ndarray, np.ndarray]:
        """Mip pyramid of means over 2 x 2 nodes, as ``mip_pyramid`` returns it, for ground seen from far away."""
        return mip_pyramid(self.occlusion, np.mean)

    @cached_property
    def max_pyramid(self) -> tuple[np.ndarray, np.ndarray]:
        """Mip pyramid of maxima over 2 x 2 nodes, as ``mip_pyramid`` returns it."""
        return mip_pyramid(self.occlusion, np.max)


@cached("scene", 256 * MIB)
def sky_view(elevation: Elevation, world: World) -> SkyView:
    """Return the sky occlusion of a raster's ground. Results are cached.

    Holes near data are filled, as for casting shadows. Where heights are missing, nothing hides the sky. Raises ``SourceError`` if
    the raster cannot be read.
    """
    detail = np.log2(max(elevation.resolution_m or 0.0, 1e-9) / elevation.cell_size_m(world.metres_per_unit))
    longest = np.log2(max(elevation.shape))
    lod = max(int(np.ceil(longest - np.log2(MAX_SIDE_NODES))), int(np.rint(min(detail, longest))), 0)
    side = 2**lod
    row, col = ((np.arange(max(count // side, 1)) + 0.5) * side - 0.5 for count in elevation.shape)
    height_m, _ = elevation.heights_at(lod, *np.meshgrid(row, col, indexing="ij"))
    half, middle = side / 2, (elevation.cols - 1) / 2
    row_spacing_m = _distances_m(elevation, world, (row - half, middle), (row + half, middle))
    col_spacing_m = np.maximum(
        _distances_m(elevation, world, (row, middle - half), (row, middle + half)), MIN_CELL_WIDTH_SHARE * row_spacing_m
    )
    node_m = float(np.sqrt(col_spacing_m[len(row) // 2] * row_spacing_m[len(row) // 2]))
    return SkyView(
        sky_occlusion(height_m, col_spacing_m, row_spacing_m, world.curvature), lod, node_m, cell_finder_of(elevation, world)
    )


RowsAndCols = tuple[float | np.ndarray, float | np.ndarray]
"""Rows and columns of cells."""


def _distances_m(elevation: Elevation, world: World, start_cell: RowsAndCols, end_cell: RowsAndCols) -> np.ndarray:
    """Return the distances (rows,) on the earth between pairs of cells, metres.

    Where the CRS gives a cell no position, the result is the median of the other distances.
    """
    points = [world.points_at_zero_height(elevation.crs, *elevation.xy(*cell))[0] for cell in (start_cell, end_cell)]
    distance_m = np.linalg.norm(points[1] - points[0], axis=-1)
    return np.where(np.isfinite(distance_m), distance_m, np.nanmedian(distance_m))


def sky_occlusion(height_m: np.ndarray, col_spacing_m: np.ndarray, row_spacing_m: np.ndarray, curvature: float = 0.0) -> np.ndarray:
    """Return the share of sky light that ground hides from each node of a heightfield: (rows, cols) float32 in [0, 1], 0 in holes.

    ``height_m`` is (rows, cols), NaN in holes. ``col_spacing_m`` and ``row_spacing_m`` (rows,) float64 are the distances of
    neighbouring nodes along a row and from row to row. ``curvature`` is 1 over the earth's radius, per metre.
    """
    height_m = np.ascontiguousarray(height_m, np.float64)
    slope = node_slopes(height_m, col_spacing_m, row_spacing_m)
    occlusion, transposed_occlusion = np.zeros(height_m.shape), np.zeros(height_m.T.shape)
    rows_and_cols = (
        (height_m, slope, col_spacing_m, row_spacing_m, True, occlusion, (-2, -1, 0, 1, 2)),
        (
            np.ascontiguousarray(height_m.T), np.ascontiguousarray(slope.transpose(1, 0, 2)[..., ::-1]), row_spacing_m,
            col_spacing_m, False, transposed_occlusion, (-1, 0, 1),
        ),
    )  # fmt: skip
    for direction in (1, -1):
        for heights, slopes, forward_m, sideways_m, has_spacings_by_row, out, steps in rows_and_cols:
            for half_rows_per_col in steps:
                width = _sector_width(half_rows_per_col, sideways_m / forward_m)
                _sweep_lines(
                    heights, slopes, forward_m, sideways_m, has_spacings_by_row, width, half_rows_per_col, direction, curvature, out
                )
    return np.clip(occlusion + transposed_occlusion.T, 0.0, 1.0).astype(np.float32)


def _sector_width(half_rows_per_col: int, spacing_ratio: np.ndarray) -> np.ndarray:
    """Return the width (rows,), in radians, of the sector of azimuths that one of the 16 azimuths represents.

    A sector reaches half-way to the neighbouring azimuths. A line in this azimuth goes ``half_rows_per_col`` half nodes sideways
    for each node ahead. ``spacing_ratio`` (rows,) is the sideways spacing of nodes over the spacing ahead.
    """
    angles = {0: np.arctan(spacing_ratio / 2), 1: np.arctan(spacing_ratio) / 2}
    if abs(half_rows_per_col) < 2:
        return angles[abs(half_rows_per_col)]
    return (np.arctan(spacing_ratio * 2) - np.arctan(spacing_ratio / 2)) / 2


@internal
def _sector_light(tangent, rise):
    """Return the light of one azimuth of the sky, above a horizon, on a plane that rises by ``rise`` per metre towards it.

    ``tangent`` is the tangent of the horizon's altitude. The result is Dozier and Frew's integrand over the cosine of the plane's
    slope, ``sin^2 H - rise (H - sin H cos H)``, with the horizon's angle H counted from the zenith.
    """
    flat = 1.0 / (1.0 + tangent * tangent)
    return flat - rise * (0.5 * np.pi - np.arctan(tangent) - tangent * flat)


@compiled
def _sweep_lines(
    height,
    slope,
    forward_spacing_m,
    sideways_spacing_m,
    has_spacings_by_row,
    sector_width,
    half_rows_per_col,
    direction,
    curvature,
    out,
):
    """Add the sky occlusion from one azimuth to ``out`` (rows, cols), by sweeps along all lines in this azimuth.

    A line goes ``half_rows_per_col`` half rows for each column. ``direction`` is 1 if the sweep visits columns in increasing order,
    else -1. At each node, ground that the sweep has passed hides light. ``slope`` (rows, cols, 2) holds the slopes towards higher
    columns and towards higher rows. ``forward_spacing_m`` and ``sideways_spacing_m`` are the distances of neighbouring columns and
    rows. They and ``sector_width`` (``_sector_width``) are per row of the raster. ``has_spacings_by_row`` is whether these are the
    rows of ``height`` or, for a transposed array, its columns. ``curvature`` is 1 over the earth's radius, per metre.
    """
    rows, cols = height.shape
    low, high = min(0, -half_rows_per_col * (cols - 1)), 2 * (rows - 1) + max(0, -half_rows_per_col * (cols - 1))
    hull_distance_m, hull_height = np.empty(cols), np.empty(cols)
    for line in range(
        low, high + 1, 1 if half_rows_per_col % 2 else 2
    ):  # with even ``half_rows_per_col`` every other line has no node
        hull_size, distance_m = 0, 0.0
        for n in range(cols):
            c = n if direction > 0 else cols - 1 - n
            half = line + half_rows_per_col * c
            if half < 0 or half > 2 * (rows - 1):
                continue
            r, on_node = half // 2, half % 2 == 0
            spacing_index = r if has_spacings_by_row else c
            forward_m, sideways_m = forward_spacing_m[spacing_index], 0.5 * half_rows_per_col * sideways_spacing_m[spacing_index]
            length = np.sqrt(forward_m * forward_m + sideways_m * sideways_m)
            distance_m += length
            node_height = height[r, c] if on_node else 0.5 * (height[r, c] + height[r + 1, c])
            if not np.isfinite(node_height):
                continue
            node_height -= loop_curvature_drop_m(distance_m, curvature)
            while hull_size >= 2:
                last, before = hull_size - 1, hull_size - 2
                if (hull_height[before] - node_height) / (distance_m - hull_distance_m[before]) < (
                    hull_height[last] - node_height
                ) / (distance_m - hull_distance_m[last]):
                    break
                hull_size -= 1
            if on_node and hull_size > 0:
                # Curvature tilts the ground by the distance from the line's start; subtract that tilt.
                tangent = (hull_height[hull_size - 1] - node_height) / (
                    distance_m - hull_distance_m[hull_size - 1]
                ) - curvature * distance_m
                east, south = slope[r, c, 0], slope[r, c, 1]
                rise = -direction * (east * forward_m + south * sideways_m) / length
                plane_tangent = max(rise, 0.0)
                if tangent > plane_tangent:
                    cosine = 1.0 / np.sqrt(1.0 + east * east + south * south)
                    hidden_light = _sector_light(plane_tangent, rise) - _sector_light(tangent, rise)
                    out[r, c] += sector_width[spacing_index] * hidden_light * cosine / (np.pi * (1.0 + cosine))
            hull_distance_m[hull_size], hull_height[hull_size] = distance_m, node_height
            hull_size += 1
    return out


def mip_pyramid(values: np.ndarray, reduce_four: Callable[..., np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return all mip levels of a grid in one array (k,) float32, and a table (mip levels, 3) int64 of offset, rows and columns.

    ``reduce_four`` (a mean or a maximum) combines 2 x 2 nodes of a mip level to a node of the next one, down to one node. An odd
    last row or column is repeated first.
    """
    mips = [values]
    while mips[-1].size > 1:
        last = np.pad(mips[-1], [(0, n % 2) for n in mips[-1].shape], mode="edge")
        mips.append(reduce_four(last.reshape(last.shape[0] // 2, 2, last.shape[1] // 2, 2), axis=(1, 3)))
    begins = np.cumsum([0, *(mip.size for mip in mips[:-1])])
    table = np.array([(begin, *mip.shape) for begin, mip in zip(begins, mips, strict=True)], np.int64)
    return np.concatenate([mip.ravel() for mip in mips]).astype(np.float32), table


def sky_view_nodes(view: SkyView, frame: LocalFrame, position_frame_m: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Return (fractional) rows and columns (..., 2) float64 in ``SkyView.occlusion`` of the ground below frame points (..., 3).

    ``height_m`` (...) are the points' heights, metres.
    """
    finder = view.cell_finder
    cells = np.empty((height_m.size, 2))
    run_in_chunks(
        len(cells), _find_nodes, position_frame_m.reshape(-1, 3), height_m.reshape(-1), frame.frame_from_earth,
        frame.origin_earth_m, finder.plane, finder.axes_earth, finder.first_node_xy, finder.node_spacing_xy, finder.node_cells,
        2.0**view.lod, cells,
    )  # fmt: skip
    return cells.reshape(*height_m.shape, 2)


@compiled
def _find_nodes(
    begin,
    end,
    position,
    height,
    frame_from_earth,
    origin,
    plane,
    axes_earth,
    first_node_xy,
    node_spacing_xy,
    lattice,
    node_side_cells,
    out,
):
    """Write rows and columns of the points [begin, end) into ``out`` (n, 2), in cells of ``node_side_cells`` raster cells a side.

    ``position`` (n, 3) and ``height`` (n,) are frame points and their heights. ``frame_from_earth`` and ``origin`` are those of the
    frame. ``plane``, ``axes_earth``, ``first_node_xy``, ``node_spacing_xy`` and ``lattice`` (``node_cells``) are those of a
    ``CellFinder``.

    The latitude follows EPSG Guidance Note 7-2, section 4.1.1. In the term with the height, the equator's radius replaces the
    radius of curvature in the prime vertical.
    """
    m = frame_from_earth
    for n in range(begin, end):
        px, py, pz = position[n, 0], position[n, 1], position[n, 2]
        x = m[0, 0] * px + m[1, 0] * py + m[2, 0] * pz + origin[0]
        y = m[0, 1] * px + m[1, 1] * py + m[2, 1] * pz + origin[1]
        z = m[0, 2] * px + m[1, 2] * py + m[2, 2] * pz + origin[2]
        x, y = project_to_plane(x, y, z, height[n], plane, axes_earth, first_node_xy, node_spacing_xy)
        row, col = cell_in_plane(x, y, first_node_xy, node_spacing_xy, lattice)
        out[n, 0], out[n, 1] = (row + 0.5) / node_side_cells - 0.5, (col + 0.5) / node_side_cells - 0.5


class MipPair(NamedTuple):
    """Two adjacent mip levels and the weight between them (trilinear filtering).

    Attributes
    ----------
    begin, rows, cols
        Offset, rows and columns of the finer mip level in ``mip_pyramid``'s array.
    scale
        Nodes of the finer mip level per node of the finest one of all, at most 1.
    next_begin, next_rows, next_cols, next_scale
        Offset, rows, columns and scale of the coarser mip level.
    coarser_weight
        Weight of the coarser mip level, in [0, 1].
    """

    begin: int
    rows: int
    cols: int
    scale: float
    next_begin: int
    next_rows: int
    next_cols: int
    next_scale: float
    coarser_weight: float


@compiled
def mip_pair(level_table, width_nodes):
    """Return the mip levels of a pyramid for a footprint that is ``width_nodes`` nodes of the finest mip level wide.

    ``level_table`` is that of ``mip_pyramid``.
    """
    number, coarser_weight = 0, 0.0
    if width_nodes > 1.0 and len(level_table) > 1:
        lod = min(np.log2(width_nodes), len(level_table) - 1.0)
        number = min(int(lod), len(level_table) - 2)
        coarser_weight = lod - number
    next_number = min(number + 1, len(level_table) - 1)
    return MipPair(
        level_table[number, 0], level_table[number, 1], level_table[number, 2], 1.0 / (1 << number),
        level_table[next_number, 0], level_table[next_number, 1], level_table[next_number, 2], 1.0 / (1 << next_number),
        coarser_weight,
    )  # fmt: skip


@internal
def sky_occlusion_at(values, mips, row, col):
    """Return the sky occlusion at a (fractional) row and column of ``SkyView.occlusion``, averaged over a footprint.

    ``values`` is the array of ``mip_pyramid``, ``mips`` the ``MipPair`` for the footprint.
    """
    occlusion = _bilinear(values, mips.begin, mips.rows, mips.cols, row, col, mips.scale)
    if mips.coarser_weight > 0.0:
        coarser_occlusion = _bilinear(values, mips.next_begin, mips.next_rows, mips.next_cols, row, col, mips.next_scale)
        occlusion += mips.coarser_weight * (coarser_occlusion - occlusion)
    return occlusion


@internal
def sky_occlusion_row(values, mips, row, col, out):
    """Fill ``out`` with ``sky_occlusion_at`` at many rows and columns (n,)."""
    _bilinear_row(values, mips.begin, mips.rows, mips.cols, row, col, mips.scale, out)
    if mips.coarser_weight > 0.0:
        coarser_occlusion = np.empty(out.size)
        _bilinear_row(values, mips.next_begin, mips.next_rows, mips.next_cols, row, col, mips.next_scale, coarser_occlusion)
        for n in range(out.size):
            out[n] += mips.coarser_weight * (coarser_occlusion[n] - out[n])


@internal
def _bilinear(values, begin, rows, cols, row, col, scale):
    """Return a mip level's bilinear value at a position in nodes of the finest mip level, clamped to its outermost nodes.

    ``values`` is the array of ``mip_pyramid``. The mip level begins at ``begin`` and has ``rows`` x ``cols`` nodes; ``scale`` is
    that of ``MipPair``.
    """
    r0, c0, row_fraction, col_fraction = _corner(rows, cols, row, col, scale)
    right, below = min(c0 + 1, cols - 1) - c0, (min(r0 + 1, rows - 1) - r0) * cols
    at = begin + r0 * cols + c0
    return lerp_corners(values[at], values[at + right], values[at + below], values[at + below + right], row_fraction, col_fraction)


@internal
def _bilinear_row(values, begin, rows, cols, row, col, scale, out):
    """Fill ``out`` (n,) with ``_bilinear`` at the positions ``row`` and ``col`` (n,).

    Only the loop of lookups does not compile to vector instructions, so it is separate from the others.
    """
    r0, c0 = np.empty(out.size, np.int32), np.empty(out.size, np.int32)
    row_fraction, col_fraction = np.empty(out.size), np.empty(out.size)
    for n in range(out.size):
        r0[n], c0[n], row_fraction[n], col_fraction[n] = _corner(rows, cols, row[n], col[n], scale)
    upper, lower = np.empty((2, out.size), np.float32), np.empty((2, out.size), np.float32)
    for n in range(out.size):
        right, below = min(c0[n] + 1, cols - 1) - c0[n], (min(r0[n] + 1, rows - 1) - r0[n]) * cols
        at = begin + r0[n] * cols + c0[n]
        upper[0, n], upper[1, n], lower[0, n], lower[1, n] = (
            values[at],
            values[at + right],
            values[at + below],
            values[at + below + right],
        )
    west, east, south_west, south_east = upper[0], upper[1], lower[0], lower[1]
    for n in range(out.size):
        out[n] = lerp_corners(west[n], east[n], south_west[n], south_east[n], row_fraction[n], col_fraction[n])


@internal
def _corner(rows, cols, row, col, scale):
    """Return the row and column of a mip level's node before a position, and the position's fractions of the way to the next.

    All are 0 for a position that is NaN. The parameters are those of ``_bilinear``.
    """
    r, c = min(max((row + 0.5) * scale - 0.5, 0.0), rows - 1.0), min(max((col + 0.5) * scale - 0.5, 0.0), cols - 1.0)
    r0, c0 = np.int32(r if r > 0.0 else 0.0), np.int32(c if c > 0.0 else 0.0)
    return r0, c0, r - r0, c - c0
