"""The horizon that ground makes round a point: along each line of sight the ground that stands highest above the eye's level.

A line crosses the very triangles that cast (or, of ``surface: blocks``, the tops and walls of columns). Between two crossings of
their edges the ground is straight, so that its angle is highest at one of them. Whole tiles and pages are passed over where even
their highest ground, put at their near end, would stay below the horizon found so far; pages are read where this does not rule
them out, nearest first. So far ground costs little, and nothing is left out: the horizon is that of all quads.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from skugga.shadows.point.place import PointPlace
from skugga.shadows.point.relief_pages import TILE_QUADS, detail_ends, paged_relief, quad_height
from skugga.shadows.point.sight_lines import SightLines, sight_lines
from skugga.terrain.casters.reach import PATCH_QUADS, longest_shadow_m
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.scene import Scene

NO_GROUND = -1e30
"""Tangent of a horizon without any ground."""

NUDGE = 1e-7
"""Nodes by which a line is followed into the next quad."""

LEAST_NODES = 1e-4
"""Nearer than this to the eye's foot, in nodes, the ground is that under it."""


@dataclass(frozen=True, eq=False)
class ReliefHorizon:
    """The horizon by ground towards azimuths (n,).

    Attributes
    ----------
    azimuth_deg
        (n,) clockwise from true north.
    tangent
        (n,) of its elevation angle; ``NO_GROUND`` where there is no ground.
    distance_m, height_m
        (n,) of the ground that makes it; NaN where there is none.
    """

    azimuth_deg: np.ndarray
    tangent: np.ndarray
    distance_m: np.ndarray
    height_m: np.ndarray


class Pages(NamedTuple):
    """The ground at one detail as the loop takes it: see ``PagedLevel``. ``scale`` are nodes of the finest detail to one of it."""

    bound: np.ndarray
    first_row: int
    first_col: int
    number: np.ndarray
    height: np.ndarray
    high: np.ndarray
    scale: float
    blocks: bool


class Lines(NamedTuple):
    """Lines of sight as the loop takes them: see ``SightLines``; the eye's height, from where and how far, in nodes, they are
    followed, and whether they end at the first ground that stands above what was found.
    """

    distance: np.ndarray
    row: np.ndarray
    col: np.ndarray
    curvature: np.ndarray
    eye: float
    near: float
    far: float
    to_first: bool


class Walks(NamedTuple):
    """How far lines were followed, and what was found: piece and share (n,) of the line between two of its distances, whether it
    ended; the highest ground's tangent, distance and height.
    """

    piece: np.ndarray
    share: np.ndarray
    ended: np.ndarray
    tangent: np.ndarray
    distance: np.ndarray
    height: np.ndarray


def relief_horizon(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray) -> ReliefHorizon:
    """The horizon that a level's ground makes round a place, towards azimuths (n,)."""
    azimuth = np.asarray(azimuth_deg, np.float64)
    found = _walked(scene, place, azimuth, np.full(len(azimuth), NO_GROUND), to_first=False)
    return ReliefHorizon(azimuth, found.tangent, found.distance, found.height)


def ground_hides(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray, tangent: np.ndarray) -> np.ndarray:
    """Whether a level's ground stands in the way of rays from a place, of ``tangent`` (n,) above its level: bool (n,).

    Faster than the horizon: ground that stays below the ray need not be looked at.
    """
    found = _walked(scene, place, np.asarray(azimuth_deg, np.float64), np.array(tangent, np.float64), to_first=True)
    return np.isfinite(found.distance)


def _walked(scene: Scene, place: PointPlace, azimuth_deg: np.ndarray, tangent: np.ndarray, to_first: bool) -> Walks:
    """The highest, or the first, ground above tangents (n,); these are written over."""
    ground = paged_relief(scene)
    lines = sight_lines(ground, place, azimuth_deg, farthest_m(scene, place))
    count = len(azimuth_deg)
    nothing = np.full(count, np.nan)
    found = Walks(np.zeros(count, np.int64), np.zeros(count), np.zeros(count, np.bool_), tangent, nothing, nothing.copy())
    for level, (near, far) in enumerate(detail_ends(_farthest_nodes(lines))):
        found.piece[:], found.share[:], found.ended[:] = 0, 0.0, to_first & np.isfinite(found.distance)
        pages = ground.level(level)
        while not found.ended.all():
            wanted = np.zeros(pages.bound_m.shape, np.bool_)
            _walk(
                Pages(
                    pages.bound_m, pages.first_row, pages.first_col, pages.number, pages.height_m, pages.high_m,
                    2.0**level, ground.blocks,
                ),
                Lines(lines.distance_m, lines.row, lines.col, lines.curvature, place.eye_m, near, far, to_first),
                found, wanted,
            )  # fmt: skip
            ground.read(level, wanted)
    return found


def farthest_m(scene: Scene, place: PointPlace) -> float:
    """How far ground can stand above the horizon of a place: to the raster's corners, and no farther than the earth lets see."""
    bounds = scene.elevation.bounds
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(bounds[0], bounds[2], 5), np.linspace(bounds[1], bounds[3], 5)))
    corners, _ = scene.world.ground(scene.elevation.crs, x, y)
    away = np.linalg.norm(corners - place.eye_earth_m, axis=-1)
    margin = 1.1 * float(np.nanmax(away, initial=0.0)) + 4.0 * scene.elevation.cell_size_m(scene.world.metres_per_unit)
    if scene.world.flat:
        return margin
    low, high = scene.height_range_m
    radius_m = scene.world.radius_m
    seen_m = sum(longest_shadow_m(rise, 0.0, radius_m=radius_m) for rise in (place.eye_m - low, high - low))
    return min(margin, 1.05 * seen_m + 1000.0)


def _farthest_nodes(lines: SightLines) -> float:
    away = np.maximum(np.abs(lines.row - lines.row[:, :1]), np.abs(lines.col - lines.col[:, :1]))
    return float(away.max(initial=1.0))


@compiled
def _walk(pages, lines, found, wanted):
    """Follow each line until it ends or needs a page that was not read, which is then ``wanted``."""
    for n in range(len(lines.row)):
        if not found.ended[n]:
            _follow(pages, lines, found, wanted, n)


@internal
def _follow(pages, lines, found, wanted, n):
    shift = 0.5 if pages.blocks else 0.0
    scale, kappa, eye = pages.scale, lines.curvature[n], lines.eye
    row0, col0 = lines.row[n, 0], lines.col[n, 0]
    best = found.tangent[n]
    rows, cols = pages.bound.shape
    t = found.share[n]
    for piece in range(found.piece[n], len(lines.distance) - 1):
        # Of columns the cell's number is the whole part of where a line is; of nodes the quad's.
        r0, c0 = (lines.row[n, piece] + shift) / scale, (lines.col[n, piece] + shift) / scale
        dr, dc = (lines.row[n, piece + 1] - lines.row[n, piece]) / scale, (lines.col[n, piece + 1] - lines.col[n, piece]) / scale
        s0, ds = lines.distance[piece], lines.distance[piece + 1] - lines.distance[piece]
        step = NUDGE / max(abs(dr), abs(dc), NUDGE)
        while t < 1.0:
            r, c = r0 + (t + step) * dr, c0 + (t + step) * dc
            away = max(abs(lines.row[n, piece] + t * dr * scale - row0), abs(lines.col[n, piece] + t * dc * scale - col0))
            if away >= lines.far:
                found.ended[n], found.tangent[n] = True, best
                return
            i, j = int(np.floor(r)), int(np.floor(c))
            page_row, page_col = i // PATCH_QUADS, j // PATCH_QUADS
            a, b = page_row - pages.first_row, page_col - pages.first_col
            t_out = _leaving(r0, dr, c0, dc, page_row * PATCH_QUADS, page_col * PATCH_QUADS, float(PATCH_QUADS), t + step)
            known = a >= 0 and b >= 0 and a < rows and b < cols
            if not known or not _may_rise(pages.bound[a, b], eye, best, kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds):
                t = t_out
                continue
            if away < lines.near and scale * PATCH_QUADS < lines.near - away:
                t = t_out
                continue
            number = pages.number[a, b]
            if number < 0:
                wanted[a, b] = True
                found.piece[n], found.share[n], found.tangent[n] = piece, t, best
                return
            i, j = i - page_row * PATCH_QUADS, j - page_col * PATCH_QUADS
            tile_row, tile_col = i // TILE_QUADS, j // TILE_QUADS
            t_out = _leaving(
                r0, dr, c0, dc, page_row * PATCH_QUADS + tile_row * TILE_QUADS, page_col * PATCH_QUADS + tile_col * TILE_QUADS,
                float(TILE_QUADS), t + step,
            )  # fmt: skip
            if not _may_rise(pages.high[number, tile_row, tile_col], eye, best, kappa, s0 + t * ds, s0 + min(t_out, 1.0) * ds):
                t = t_out
                continue
            top, left = page_row * PATCH_QUADS + i, page_col * PATCH_QUADS + j
            t_out = _leaving(r0, dr, c0, dc, top, left, 1.0, t + step)
            if away >= lines.near:
                height = pages.height[number]
                end = min(t_out, 1.0)
                if pages.blocks:
                    h = np.float64(height[i, j])
                    best = _higher(found, n, best, h, eye, kappa, s0 + t * ds, s0 + end * ds, ds * step)
                    best = _higher(found, n, best, h, eye, kappa, s0 + end * ds, s0 + end * ds, ds * step)
                else:
                    nw, ne = np.float64(height[i, j]), np.float64(height[i, j + 1])
                    sw, se = np.float64(height[i + 1, j]), np.float64(height[i + 1, j + 1])
                    rising = ne + sw
                    falls = nw + se > rising or np.isnan(rising)
                    across = (r0 - top) - (c0 - left) if falls else (r0 - top) + (c0 - left) - 1.0
                    slope = dr - dc if falls else dr + dc
                    if slope != 0.0:
                        cut = -across / slope
                        if t < cut < end:
                            share = c0 + cut * dc - left
                            h = nw + share * (se - nw) if falls else sw + share * (ne - sw)
                            best = _higher(found, n, best, h, eye, kappa, s0 + cut * ds, s0 + cut * ds, ds * step)
                    fr, fc = r0 + end * dr - top, c0 + end * dc - left
                    h = quad_height(nw, ne, sw, se, min(max(fr, 0.0), 1.0), min(max(fc, 0.0), 1.0))
                    best = _higher(found, n, best, h, eye, kappa, s0 + end * ds, s0 + end * ds, ds * step)
                if lines.to_first and not np.isnan(found.distance[n]):
                    found.ended[n], found.tangent[n] = True, best
                    return
            t = t_out
        t = 0.0
    found.ended[n], found.tangent[n] = True, best


@internal
def _leaving(r0, dr, c0, dc, top, left, side, after):
    """The share of a piece at which it leaves a square of the grid; always beyond ``after``."""
    out = np.inf
    if dr > 0.0:
        out = (top + side - r0) / dr
    elif dr < 0.0:
        out = (top - r0) / dr
    if dc > 0.0:
        out = min(out, (left + side - c0) / dc)
    elif dc < 0.0:
        out = min(out, (left - c0) / dc)
    return max(out, after)


@internal
def _may_rise(high, eye, best, kappa, near, far):
    """Whether ground up to a height, between two distances, may stand above a tangent."""
    if high == -np.inf:
        return False
    theta = kappa * near
    rise = high - eye - 0.5 * near * theta * (1.0 - theta * theta / 12.0) + 1e-5 * abs(high)
    widest = 1.0 + kappa * max(high, 0.0)
    return rise > best * (near * (0.999 - 0.2 * (kappa * far) ** 2) if best > 0.0 else far * widest)


@internal
def _higher(found, n, best, h, eye, kappa, s, at, least):
    """The tangent of ground of a height at a distance, where it is more than the best one; that it stands there is noted."""
    if not s > least * LEAST_NODES / NUDGE:
        return best
    theta = kappa * s
    square = theta * theta
    drop = 0.5 * s * theta * (1.0 - square / 12.0 * (1.0 - square / 30.0))  # R (1 - cos)
    along = s * (1.0 - square / 6.0 * (1.0 - square / 20.0)) * (1.0 + kappa * h)  # (R + h) sin
    up = h * (1.0 - kappa * drop) - drop - eye
    if up > best * along:
        best = up / along
        found.distance[n], found.height[n] = at, h
    return best
