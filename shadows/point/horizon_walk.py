"""The horizon of a point by ground: the largest elevation angle of the ground along each line of sight.

Elevation angles are measured from the horizontal plane through the eye. A line of sight crosses the triangles that cast shadows
(or, for ``surface: blocks``, the tops and walls of columns). Between two crossings of edges the ground is straight along the line,
so its elevation angle is largest at one of them.

The ground is stored in pages of 256 quads a side, and a page has tiles of 16 quads a side. A page or tile is skipped if it cannot
exceed the horizon found so far. For this test its highest ground is assumed to lie at its near end. All other pages are read, the
nearest first. So distant ground costs little time, but the horizon is that of all quads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import TILE_QUADS, detail_distance_ranges, paged_relief, quad_height
from skugga.shadows.point.sight_lines import SightLines, sight_lines
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.scene import Scene

NO_GROUND_TANGENT = -1e30
"""Tangent of a horizon without any ground."""

ENTRY_STEP_NODES = 1e-7
"""Distance in nodes behind an edge at which a line is located, to find the quad that it enters."""

MIN_DISTANCE_NODES = 1e-4
"""Distance from the eye in nodes within which ground is ignored, since it is the ground below the eye."""


@dataclass(frozen=True, eq=False)
class ReliefHorizon:
    """The horizon by ground towards azimuths (n,).

    Attributes
    ----------
    azimuth_deg
        (n,), clockwise from true north.
    tangent
        (n,): tangent of the elevation angle; ``NO_GROUND_TANGENT`` without ground.
    distance_m, height_m
        (n,): distance and height of the ground that forms the horizon; NaN without any.
    """

    azimuth_deg: np.ndarray
    tangent: np.ndarray
    distance_m: np.ndarray
    height_m: np.ndarray


class PageArrays(NamedTuple):
    """The ground at one level of detail, for compiled loops: see ``PagedLevel``.

    Attributes
    ----------
    page_bound_m
        ``PagedLevel.page_bound_m``.
    first_row, first_col
        Row and column of the page of ``page_bound_m[0, 0]``, counted in pages from the grid's origin.
    page_index
        ``PagedLevel.page_index``.
    height_m
        ``PagedLevel.height_m``.
    tile_max_m
        ``PagedLevel.tile_max_m``.
    finest_nodes_per_node
        Nodes of the finest level of detail per node of this one.
    has_columns
        Whether cells are columns with flat tops.
    """

    page_bound_m: np.ndarray
    first_row: int
    first_col: int
    page_index: np.ndarray
    height_m: np.ndarray
    tile_max_m: np.ndarray
    finest_nodes_per_node: float
    has_columns: bool


class LineArrays(NamedTuple):
    """Lines of sight, for compiled loops: see ``SightLines``.

    Attributes
    ----------
    distance_m, row, col, curvature
        As in ``SightLines``.
    eye_m
        Height of the eye, metres.
    near_nodes, far_nodes
        Range of distances to walk, in nodes.
    stops_at_first_occluder
        Whether a line ends at the first ground above its tangent.
    """

    distance_m: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray
    eye_m: float
    near_nodes: float
    far_nodes: float
    stops_at_first_occluder: bool


class WalkStates(NamedTuple):
    """The state and the results of walks along n lines of sight.

    A line consists of straight pieces between the distances of ``SightLines``.

    Attributes
    ----------
    piece_index, piece_share
        (n,): the position of each walk: the index of the piece, and the position on it in [0, 1].
    has_ended
        bool (n,): whether the walk is complete.
    tangent, distance_m, height_m
        (n,): the ground with the largest elevation angle so far: tangent of the angle, distance and height in metres.
    """

    piece_index: np.ndarray
    piece_share: np.ndarray
    has_ended: np.ndarray
    tangent: np.ndarray
    distance_m: np.ndarray
    height_m: np.ndarray


def relief_horizon(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray) -> ReliefHorizon:
    """Return the horizon that a level's ground forms around a place, towards azimuths (n,) in degrees."""
    azimuth = np.asarray(azimuth_deg, np.float64)
    walks = _walk_to_ground(scene, place, azimuth, np.full(len(azimuth), NO_GROUND_TANGENT), stops_at_first_occluder=False)
    return ReliefHorizon(azimuth, walks.tangent, walks.distance_m, walks.height_m)


def is_ground_occluded(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return whether a level's ground blocks rays from a place: bool (n,).

    A ray has an azimuth in degrees and the tangent of its elevation angle, (n,) each. This is faster than ``relief_horizon``, since
    ground below a ray is skipped.
    """
    walks = _walk_to_ground(
        scene, place, np.asarray(azimuth_deg, np.float64), np.array(tangent, np.float64), stops_at_first_occluder=True
    )
    return np.isfinite(walks.distance_m)


def _walk_to_ground(
    scene: Scene, place: PointPlace, azimuth_deg: np.ndarray, tangent: np.ndarray, stops_at_first_occluder: bool
) -> WalkStates:
    """Walk along lines of sight, and return the ground that exceeds an elevation angle.

    It is the ground with the largest elevation angle, or, if ``stops_at_first_occluder``, the first ground found. ``tangent`` (n,)
    holds the tangents of the angles to exceed, and is overwritten.
    """
    ground = paged_relief(scene)
    lines = sight_lines(ground, place, azimuth_deg, farthest_m(scene, place))
    count = len(azimuth_deg)
    missing = np.full(count, np.nan)
    walks = WalkStates(np.zeros(count, np.int64), np.zeros(count), np.zeros(count, np.bool_), tangent, missing, missing.copy())
    for level, (near, far) in enumerate(detail_distance_ranges(_farthest_nodes(lines))):
        walks.piece_index[:], walks.piece_share[:], walks.has_ended[:] = (
            0,
            0.0,
            stops_at_first_occluder & np.isfinite(walks.distance_m),
        )
        pages = ground.level(level)
        while not walks.has_ended.all():
            needed_pages = np.zeros(pages.page_bound_m.shape, np.bool_)
            _walk_lines(
                PageArrays(
                    pages.page_bound_m, pages.first_row, pages.first_col, pages.page_index, pages.height_m, pages.tile_max_m,
                    2.0**level, ground.has_columns,
                ),
                LineArrays(
                    lines.distance_m, lines.row, lines.col, lines.curvature, place.eye_elevation_m, near, far,
                    stops_at_first_occluder,
                ),
                walks, needed_pages,
            )  # fmt: skip
            ground.read_pages(level, needed_pages)
    return walks


def farthest_m(scene: Scene, place: PointPlace) -> float:
    """Return an upper bound in metres for the distance of ground that can be visible from a place.

    It is the distance to the raster's corners with a margin, or less if the earth's curvature hides ground so far away.
    """
    bounds = scene.elevation.bounds
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(bounds[0], bounds[2], 5), np.linspace(bounds[1], bounds[3], 5)))
    corners, _ = scene.world.points_at_zero_height(scene.elevation.crs, x, y)
    corner_distance_m = np.linalg.norm(corners - place.eye_earth_m, axis=-1)
    margin = 1.1 * float(np.nanmax(corner_distance_m, initial=0.0)) + 4.0 * scene.elevation.cell_size_m(scene.world.metres_per_unit)
    if scene.world.is_flat:
        return margin
    low, high = scene.height_range_m
    radius_m = scene.world.radius_m
    visible_m = sum(longest_shadow_m(rise, 0.0, radius_m=radius_m) for rise in (place.eye_elevation_m - low, high - low))
    return min(margin, 1.05 * visible_m + 1000.0)


def _farthest_nodes(lines: SightLines) -> float:
    """Return the distance of the farthest position of any line from the eye, in nodes: the larger of rows and columns."""
    distance_nodes = np.maximum(np.abs(lines.row - lines.row[:, :1]), np.abs(lines.col - lines.col[:, :1]))
    return float(distance_nodes.max(initial=1.0))


@compiled
def _walk_lines(pages, lines, walks, needed_pages):
    """Follow each line until its end, or until it needs a page that is not read yet.

    ``pages`` are ``PageArrays``, ``lines`` are ``LineArrays``. Such pages are marked in ``needed_pages``, bool (m, n) as
    ``PageArrays.page_index``. Results and positions go to ``walks`` (``WalkStates``).
    """
    for n in range(len(lines.row)):
        if not walks.has_ended[n]:
            _follow_line(pages, lines, walks, needed_pages, n)


@internal
def _follow_line(pages, lines, walks, needed_pages, n):
    """Follow the line with index ``n`` until its end, or until it needs a page that is not read yet.

    The other parameters are those of ``_walk_lines``.
    """
    shift = 0.5 if pages.has_columns else 0.0
    scale, kappa, eye = pages.finest_nodes_per_node, lines.curvature[n], lines.eye_m
    row0, col0 = lines.row[n, 0], lines.col[n, 0]
    best = walks.tangent[n]
    rows, cols = pages.page_bound_m.shape
    t = walks.piece_share[n]
    for piece in range(walks.piece_index[n], len(lines.distance_m) - 1):
        # The whole part of a position is the index of a column's cell, or of a quad.
        r0, c0 = (lines.row[n, piece] + shift) / scale, (lines.col[n, piece] + shift) / scale
        dr, dc = (lines.row[n, piece + 1] - lines.row[n, piece]) / scale, (lines.col[n, piece + 1] - lines.col[n, piece]) / scale
        s0, ds = lines.distance_m[piece], lines.distance_m[piece + 1] - lines.distance_m[piece]
        step = ENTRY_STEP_NODES / max(abs(dr), abs(dc), ENTRY_STEP_NODES)
        while t < 1.0:
            r, c = r0 + (t + step) * dr, c0 + (t + step) * dc
            distance_nodes = max(abs(lines.row[n, piece] + t * dr * scale - row0), abs(lines.col[n, piece] + t * dc * scale - col0))
            if distance_nodes >= lines.far_nodes:
                walks.has_ended[n], walks.tangent[n] = True, best
                return
            i, j = int(np.floor(r)), int(np.floor(c))
            page_row, page_col = i // PATCH_QUADS, j // PATCH_QUADS
            a, b = page_row - pages.first_row, page_col - pages.first_col
            t_out = _exit_share(r0, dr, c0, dc, page_row * PATCH_QUADS, page_col * PATCH_QUADS, float(PATCH_QUADS), t + step)
            has_page = a >= 0 and b >= 0 and a < rows and b < cols
            if not has_page or not _can_exceed(pages.page_bound_m[a, b], eye, best, kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds):
                t = t_out
                continue
            if distance_nodes < lines.near_nodes and scale * PATCH_QUADS < lines.near_nodes - distance_nodes:
                t = t_out
                continue
            number = pages.page_index[a, b]
            if number < 0:
                needed_pages[a, b] = True
                walks.piece_index[n], walks.piece_share[n], walks.tangent[n] = piece, t, best
                return
            i, j = i - page_row * PATCH_QUADS, j - page_col * PATCH_QUADS
            tile_row, tile_col = i // TILE_QUADS, j // TILE_QUADS
            t_out = _exit_share(
                r0, dr, c0, dc, page_row * PATCH_QUADS + tile_row * TILE_QUADS, page_col * PATCH_QUADS + tile_col * TILE_QUADS,
                float(TILE_QUADS), t + step,
            )  # fmt: skip
            if not _can_exceed(
                pages.tile_max_m[number, tile_row, tile_col], eye, best, kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds
            ):
                t = t_out
                continue
            top, left = page_row * PATCH_QUADS + i, page_col * PATCH_QUADS + j
            t_out = _exit_share(r0, dr, c0, dc, top, left, 1.0, t + step)
            if distance_nodes >= lines.near_nodes:
                height = pages.height_m[number]
                end = min(t_out, 1.0)
                if pages.has_columns:
                    h = np.float64(height[i, j])
                    best = _raise_horizon(walks, n, best, h, eye, kappa, s0 + t * ds, s0 + end * ds, ds * step)
                    best = _raise_horizon(walks, n, best, h, eye, kappa, s0 + end * ds, s0 + end * ds, ds * step)
                else:
                    nw, ne = np.float64(height[i, j]), np.float64(height[i, j + 1])
                    sw, se = np.float64(height[i + 1, j]), np.float64(height[i + 1, j + 1])
                    rising = ne + sw
                    is_cut_nw_se = nw + se > rising or np.isnan(rising)
                    diagonal_offset = (r0 - top) - (c0 - left) if is_cut_nw_se else (r0 - top) + (c0 - left) - 1.0
                    slope = dr - dc if is_cut_nw_se else dr + dc
                    if slope != 0.0:
                        cut = -diagonal_offset / slope
                        if t < cut < end:
                            share = c0 + cut * dc - left
                            h = nw + share * (se - nw) if is_cut_nw_se else sw + share * (ne - sw)
                            best = _raise_horizon(walks, n, best, h, eye, kappa, s0 + cut * ds, s0 + cut * ds, ds * step)
                    fr, fc = r0 + end * dr - top, c0 + end * dc - left
                    h = quad_height(nw, ne, sw, se, min(max(fr, 0.0), 1.0), min(max(fc, 0.0), 1.0))
                    best = _raise_horizon(walks, n, best, h, eye, kappa, s0 + end * ds, s0 + end * ds, ds * step)
                if lines.stops_at_first_occluder and not np.isnan(walks.distance_m[n]):
                    walks.has_ended[n], walks.tangent[n] = True, best
                    return
            t = t_out
        t = 0.0
    walks.has_ended[n], walks.tangent[n] = True, best


@internal
def _exit_share(r0, dr, c0, dc, top, left, side_quads, min_share):
    """Return the position on a piece of a line, as a share of its length, at which it leaves a square of the grid.

    The piece starts at row ``r0`` and column ``c0`` and leads ``dr`` rows and ``dc`` columns on. The square has its first corner at
    ``top`` and ``left``, and a side of ``side_quads`` quads. The result is at least ``min_share``.
    """
    share = np.inf
    if dr > 0.0:
        share = (top + side_quads - r0) / dr
    elif dr < 0.0:
        share = (top - r0) / dr
    if dc > 0.0:
        share = min(share, (left + side_quads - c0) / dc)
    elif dc < 0.0:
        share = min(share, (left - c0) / dc)
    return max(share, min_share)


@internal
def _can_exceed(max_height_m, eye_m, best_tangent, curvature, near_m, far_m):
    """Return whether ground may exceed the tangent ``best_tangent`` of an elevation angle.

    The ground is at most ``max_height_m`` metres high, and lies between the distances ``near_m`` and ``far_m`` in metres. ``eye_m``
    is the height of the eye, and ``curvature`` the earth's curvature, 1 / metres.
    """
    if max_height_m == -np.inf:
        return False
    theta = curvature * near_m
    rise = max_height_m - eye_m - 0.5 * near_m * theta * (1.0 - theta * theta / 12.0) + 1e-5 * abs(max_height_m)
    widest = 1.0 + curvature * max(max_height_m, 0.0)
    return rise > best_tangent * (near_m * (0.999 - 0.2 * (curvature * far_m) ** 2) if best_tangent > 0.0 else far_m * widest)


@internal
def _raise_horizon(walks, n, best_tangent, height_m, eye_m, curvature, distance_m, stored_distance_m, entry_step_m):
    """Return the larger of ``best_tangent`` and the tangent up to ground of height ``height_m`` at distance ``distance_m``.

    Heights and distances are in metres, ``curvature`` is the earth's in 1 / metres, ``eye_m`` the height of the eye. If the ground
    exceeds ``best_tangent``, ``stored_distance_m`` and ``height_m`` become the result of line ``n`` in ``walks``. ``entry_step_m``
    is the length of ``ENTRY_STEP_NODES`` nodes in metres; from it follows the distance below which ground is ignored.
    """
    if not distance_m > entry_step_m * MIN_DISTANCE_NODES / ENTRY_STEP_NODES:
        return best_tangent
    theta = curvature * distance_m
    square = theta * theta
    drop = 0.5 * distance_m * theta * (1.0 - square / 12.0 * (1.0 - square / 30.0))  # R (1 - cos)
    horizontal = distance_m * (1.0 - square / 6.0 * (1.0 - square / 20.0)) * (1.0 + curvature * height_m)  # (R + h) sin
    vertical = height_m * (1.0 - curvature * drop) - drop - eye_m
    if vertical > best_tangent * horizontal:
        best_tangent = vertical / horizontal
        walks.distance_m[n], walks.height_m[n] = stored_distance_m, height_m
    return best_tangent
