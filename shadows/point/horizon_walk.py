"""The horizon of a point by ground: the largest elevation angle of the ground along each line of sight.

Elevation angles are measured from the horizontal plane through the eye. A line of sight crosses the triangles that cast shadows
(or, for ``surface: blocks``, the tops and walls of columns). Between two crossings of edges the ground is straight along the line,
so its elevation angle is largest at one of them.

The ground is stored in pages of 256 quads a side, and a page has tiles of 8 quads a side. A page or tile is skipped if it cannot
exceed the horizon found so far. For this test its highest ground is assumed to lie at its near end. All other pages are read, the
nearest first. So distant ground costs little time, but the horizon is that of all quads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import TILE_QUADS, detail_distance_ranges, paged_relief, quad_height
from skugga.shadows.point.sight_lines import SightLines, sight_lines
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.heightfield.walks import exit_share, shares_per_node
from skugga.terrain.scene import Scene

NO_GROUND_TANGENT = -1e30
"""Tangent of a horizon without any ground."""

ENTRY_STEP_NODES = 1e-7
"""Distance in nodes behind an edge at which a line is located, to find the quad that it enters."""

MIN_DISTANCE_NODES = 1e-4
"""Distance from the eye in nodes within which ground is ignored, since it is the ground below the eye."""

BATCH_LINES = 40_000
"""Number of lines of sight that are walked at a time. Their positions take some 30 MB."""


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
    max_height_m
        Upper bound of all heights, metres.
    """

    page_bound_m: np.ndarray
    first_row: int
    first_col: int
    page_index: np.ndarray
    height_m: np.ndarray
    tile_max_m: np.ndarray
    finest_nodes_per_node: float
    has_columns: bool
    max_height_m: float


class LineArrays(NamedTuple):
    """Lines of sight, for compiled loops: see ``SightLines``.

    Attributes
    ----------
    distance_m, distance_count, row, col, curvature
        As in ``SightLines``.
    eye_m
        (n,): height of the eye of each line, metres.
    near_nodes, far_nodes
        Range of distances to walk, in nodes.
    stops_at_first_occluder
        Whether a line ends at the first ground above its tangent.
    """

    distance_m: np.ndarray
    distance_count: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray
    eye_m: np.ndarray
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
    walks = _walk_to_ground(scene, [place], azimuth, np.full(len(azimuth), NO_GROUND_TANGENT), stops_at_first_occluder=False)
    return ReliefHorizon(azimuth, walks.tangent, walks.distance_m, walks.height_m)


def relief_tangents(scene: Scene, places: Sequence[PointPlace], azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the tangents (p, n) of the horizon that a level's ground forms around places (p,), towards azimuths (n,) in degrees.

    They are those of ``relief_horizon``. The places are divided among all cores.
    """
    azimuth = np.asarray(azimuth_deg, np.float64)
    tangent = np.full((len(places), len(azimuth)), NO_GROUND_TANGENT)
    # Neighbours need the same pages, and those of far places may be dropped.
    order = np.lexsort(([place.col for place in places], [place.row // PATCH_QUADS for place in places]))
    for batch in np.array_split(order, max(-(-tangent.size // BATCH_LINES), 1)):
        if len(batch):
            batch_tangent = np.full(len(batch) * len(azimuth), NO_GROUND_TANGENT)
            walks = _walk_to_ground(scene, [places[n] for n in batch], azimuth, batch_tangent, stops_at_first_occluder=False)
            tangent[batch] = walks.tangent.reshape(len(batch), -1)
    return tangent


def is_ground_occluded(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Return whether a level's ground blocks rays from a place: bool (n,).

    A ray has an azimuth in degrees and the tangent of its elevation angle, (n,) each. This is faster than ``relief_horizon``, since
    ground below a ray is skipped.
    """
    walks = _walk_to_ground(
        scene, [place], np.asarray(azimuth_deg, np.float64), np.array(tangent, np.float64), stops_at_first_occluder=True
    )
    return np.isfinite(walks.distance_m)


def _walk_to_ground(
    scene: Scene, places: Sequence[PointPlace], azimuth_deg: np.ndarray, tangent: np.ndarray, stops_at_first_occluder: bool
) -> WalkStates:
    """Walk along lines of sight from places (p,) towards azimuths (n,), and return the ground that exceeds an elevation angle.

    It is the ground with the largest elevation angle, or, if ``stops_at_first_occluder``, the first ground found. ``tangent``
    (p * n,) holds the tangents of the angles to exceed, and is overwritten.
    """
    ground = paged_relief(scene)
    lines = sight_lines(ground, places, azimuth_deg, farthest_m(scene, places))
    eye_m = np.repeat([place.eye_elevation_m for place in places], len(azimuth_deg))
    count = len(tangent)
    missing = np.full(count, np.nan)
    walks = WalkStates(np.zeros(count, np.int64), np.zeros(count), np.zeros(count, np.bool_), tangent, missing, missing.copy())
    for level, (near, far) in enumerate(detail_distance_ranges(_farthest_nodes(lines))):
        walks.piece_index[:], walks.piece_share[:], walks.has_ended[:] = (
            0,
            0.0,
            stops_at_first_occluder & np.isfinite(walks.distance_m),
        )
        pages = ground.level(level)
        max_height_m = float(pages.page_bound_m.max(initial=-np.inf))
        while not walks.has_ended.all():
            needed_pages = np.zeros(pages.page_bound_m.shape, np.bool_)
            page_arrays = PageArrays(
                pages.page_bound_m, pages.first_row, pages.first_col, pages.page_index, pages.height_m, pages.tile_max_m,
                2.0**level, ground.has_columns, max_height_m,
            )  # fmt: skip
            line_arrays = LineArrays(
                lines.distance_m, lines.distance_count, lines.row, lines.col, lines.curvature, eye_m, near, far,
                stops_at_first_occluder,
            )  # fmt: skip
            if len(places) == 1:  # so short that threads do not pay
                _walk_lines(0, count, page_arrays, line_arrays, walks, needed_pages)
            else:
                run_in_chunks(count, _walk_lines, page_arrays, line_arrays, walks, needed_pages)
            ground.read_pages(level, needed_pages)
    return walks


def farthest_m(scene: Scene, places: Sequence[PointPlace]) -> np.ndarray:
    """Return upper bounds (p,) in metres for the distance of ground that can be visible from places (p,).

    It is the distance to the raster's corners with a margin, or less if the earth's curvature hides ground so far away.
    """
    bounds = scene.elevation.bounds
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(bounds[0], bounds[2], 5), np.linspace(bounds[1], bounds[3], 5)))
    corners, _ = scene.world.points_at_zero_height(scene.elevation.crs, x, y)
    eyes = np.array([place.eye_earth_m for place in places])
    corner_distance_m = np.linalg.norm(corners - eyes[:, None], axis=-1)
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    margin = 1.1 * np.nanmax(corner_distance_m, axis=1, initial=0.0) + 4.0 * cell_m
    if scene.world.is_flat:
        return margin
    low, high = scene.height_range_m
    radius_m = scene.world.radius_m
    farthest_hidden_m = longest_shadow_m(high - low, 0.0, radius_m=radius_m)
    visible_m = np.array([longest_shadow_m(place.eye_elevation_m - low, 0.0, radius_m=radius_m) for place in places])
    return np.minimum(margin, 1.05 * (visible_m + farthest_hidden_m) + 1000.0)


def _farthest_nodes(lines: SightLines) -> float:
    """Return the distance of the farthest position of any line from the eye, in nodes: the larger of rows and columns."""
    farthest_nodes = np.ones(len(lines.row))
    run_in_chunks(len(lines.row), _write_farthest_nodes, lines.row, lines.col, lines.distance_count, farthest_nodes)
    return float(farthest_nodes.max(initial=1.0))


@compiled
def _write_farthest_nodes(first, last, row, col, distance_count, farthest_nodes):
    """Raise ``farthest_nodes`` (n,) to the distance of the farthest position of each line from ``first`` to ``last``."""
    for n in range(first, last):
        for k in range(distance_count[n]):
            distance_nodes = max(abs(row[n, k] - row[n, 0]), abs(col[n, k] - col[n, 0]))
            farthest_nodes[n] = max(farthest_nodes[n], distance_nodes)


@compiled
def _walk_lines(first, last, pages, lines, walks, needed_pages):
    """Follow the lines from ``first`` to ``last`` until their ends, or until they need a page that is not read yet.

    ``pages`` are ``PageArrays``, ``lines`` are ``LineArrays``. Such pages are marked in ``needed_pages``, bool (m, n) as
    ``PageArrays.page_index``. Results and positions go to ``walks`` (``WalkStates``).
    """
    for n in range(first, last):
        if not walks.has_ended[n]:
            _follow_line(pages, lines, walks, needed_pages, n)


@internal
def _follow_line(pages, lines, walks, needed_pages, n):
    """Follow the line with index ``n`` until its end, or until it needs a page that is not read yet.

    The other parameters are those of ``_walk_lines``.
    """
    # Each use of an array of a named tuple counts a reference, which takes as long as a step. So each is used once for a line.
    page_bound_m, page_index, height_m, tile_max_m = pages.page_bound_m, pages.page_index, pages.height_m, pages.tile_max_m
    distance_m, row, col = lines.distance_m, lines.row, lines.col
    has_columns, first_row, first_col, max_height_m = pages.has_columns, pages.first_row, pages.first_col, pages.max_height_m
    near_nodes, far_nodes, stops_at_first_occluder = lines.near_nodes, lines.far_nodes, lines.stops_at_first_occluder
    scale, kappa, eye = pages.finest_nodes_per_node, lines.curvature[n], lines.eye_m[n]
    highest = walks.tangent[n], walks.distance_m[n], walks.height_m[n]
    shift = 0.5 if has_columns else 0.0
    row0, col0 = row[n, 0], col[n, 0]
    rows, cols = page_bound_m.shape
    piece, last_piece, t = walks.piece_index[n], lines.distance_count[n] - 1, walks.piece_share[n]
    last_m = distance_m[last_piece]
    has_ended = needs_page = False
    while piece < last_piece and not (has_ended or needs_page):
        s0, ds = distance_m[piece], distance_m[piece + 1] - distance_m[piece]
        if not _can_exceed(max_height_m, eye, highest[0], kappa, s0 + t * ds, last_m):
            break
        # The whole part of a position is the index of a column's cell, or of a quad.
        r0, c0 = (row[n, piece] + shift) / scale, (col[n, piece] + shift) / scale
        dr, dc = (row[n, piece + 1] - row[n, piece]) / scale, (col[n, piece + 1] - col[n, piece]) / scale
        start_row, start_col = row[n, piece] - row0, col[n, piece] - col0
        per_row, per_col = shares_per_node(dr, dc)
        per_fall, per_rise = 1.0 / (dr - dc) if dr != dc else 0.0, 1.0 / (dr + dc) if dr != -dc else 0.0
        step = ENTRY_STEP_NODES / max(abs(dr), abs(dc), ENTRY_STEP_NODES)
        min_m = ds * step * (MIN_DISTANCE_NODES / ENTRY_STEP_NODES)
        while t < 1.0:
            distance_nodes = max(abs(start_row + t * dr * scale), abs(start_col + t * dc * scale))
            if distance_nodes >= far_nodes:
                has_ended = True
                break
            i, j = int(np.floor(r0 + (t + step) * dr)), int(np.floor(c0 + (t + step) * dc))
            page_row, page_col = i // PATCH_QUADS, j // PATCH_QUADS
            a, b = page_row - first_row, page_col - first_col
            page_top, page_left = page_row * PATCH_QUADS, page_col * PATCH_QUADS
            t_out = exit_share(r0, per_row, c0, per_col, page_top, page_left, float(PATCH_QUADS), t + step)
            has_page = a >= 0 and b >= 0 and a < rows and b < cols
            if not has_page or not _can_exceed(page_bound_m[a, b], eye, highest[0], kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds):
                t = t_out
                continue
            if distance_nodes < near_nodes and scale * PATCH_QUADS < near_nodes - distance_nodes:
                t = t_out
                continue
            number = page_index[a, b]
            if number < 0:
                needed_pages[a, b] = needs_page = True
                break
            tile_row, tile_col = (i - page_top) // TILE_QUADS, (j - page_left) // TILE_QUADS
            tile_top, tile_left = page_top + tile_row * TILE_QUADS, page_left + tile_col * TILE_QUADS
            t_out = exit_share(r0, per_row, c0, per_col, tile_top, tile_left, float(TILE_QUADS), t + step)
            tile_m = tile_max_m[number, tile_row, tile_col]
            if not _can_exceed(tile_m, eye, highest[0], kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds):
                t = t_out
                continue
            while True:  # each quad of the tile
                t_out = exit_share(r0, per_row, c0, per_col, i, j, 1.0, t + step)
                if distance_nodes >= near_nodes:
                    y, x = i - page_top, j - page_left
                    end = min(t_out, 1.0)
                    end_m = s0 + end * ds
                    if has_columns:
                        h = np.float64(height_m[number, y, x])
                        highest = _higher_ground(highest, h, eye, kappa, s0 + t * ds, end_m, min_m)
                        highest = _higher_ground(highest, h, eye, kappa, end_m, end_m, min_m)
                    else:
                        nw, ne = np.float64(height_m[number, y, x]), np.float64(height_m[number, y, x + 1])
                        sw, se = np.float64(height_m[number, y + 1, x]), np.float64(height_m[number, y + 1, x + 1])
                        rising = ne + sw
                        is_cut_nw_se = nw + se > rising or np.isnan(rising)
                        diagonal_offset = (r0 - i) - (c0 - j) if is_cut_nw_se else (r0 - i) + (c0 - j) - 1.0
                        cut = -diagonal_offset * (per_fall if is_cut_nw_se else per_rise)
                        if t < cut < end:
                            share, cut_m = c0 + cut * dc - j, s0 + cut * ds
                            h = nw + share * (se - nw) if is_cut_nw_se else sw + share * (ne - sw)
                            highest = _higher_ground(highest, h, eye, kappa, cut_m, cut_m, min_m)
                        fr, fc = r0 + end * dr - i, c0 + end * dc - j
                        h = quad_height(nw, ne, sw, se, min(max(fr, 0.0), 1.0), min(max(fc, 0.0), 1.0))
                        highest = _higher_ground(highest, h, eye, kappa, end_m, end_m, min_m)
                    if stops_at_first_occluder and not np.isnan(highest[1]):
                        has_ended = True
                        break
                t = t_out
                i, j = int(np.floor(r0 + (t + step) * dr)), int(np.floor(c0 + (t + step) * dc))
                distance_nodes = max(abs(start_row + t * dr * scale), abs(start_col + t * dc * scale))
                is_in_tile = tile_top <= i < tile_top + TILE_QUADS and tile_left <= j < tile_left + TILE_QUADS
                if not is_in_tile or t >= 1.0 or distance_nodes >= far_nodes:
                    break
            if has_ended:
                break
        if not (has_ended or needs_page):
            piece, t = piece + 1, 0.0
    walks.piece_index[n], walks.piece_share[n], walks.has_ended[n] = piece, t, not needs_page
    walks.tangent[n], walks.distance_m[n], walks.height_m[n] = highest


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
def _higher_ground(highest, height_m, eye_m, curvature, distance_m, stored_distance_m, min_distance_m):
    """Return the higher of two pieces of ground, each as the tangent of its elevation angle, its distance and its height.

    One is ``highest``, the other has the height ``height_m`` at the distance ``distance_m``, for which the result has the distance
    ``stored_distance_m``. Heights and distances are in metres, ``curvature`` is the earth's in 1 / metres, ``eye_m`` the height of
    the eye. Ground at no more than ``min_distance_m`` is ignored.
    """
    if not distance_m > min_distance_m:
        return highest
    theta = curvature * distance_m
    square = theta * theta
    drop = 0.5 * distance_m * theta * (1.0 - square / 12.0 * (1.0 - square / 30.0))  # R (1 - cos)
    horizontal = distance_m * (1.0 - square / 6.0 * (1.0 - square / 20.0)) * (1.0 + curvature * height_m)  # (R + h) sin
    vertical = height_m * (1.0 - curvature * drop) - drop - eye_m
    if vertical > highest[0] * horizontal:
        return vertical / horizontal, stored_distance_m, height_m
    return highest
