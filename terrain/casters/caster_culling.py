"""Cull shadow casters of a map's block: find ground that provably casts no shadow of the sun on the block.

A block is a square of a map, at most ``BLOCK_PX`` pixels a side, that is drawn at once. The ground under the block and beside it is
divided into patches of ``PATCH_QUADS`` x ``PATCH_QUADS`` quads of its grid. Each patch has ``PARTS_PER_PATCH_SIDE`` x
``PARTS_PER_PATCH_SIDE`` parts. Two quantities of each part are stored, since they do not depend on the sun: its range of heights,
and its steepest facets. Either of two conditions proves that a part cannot shade a block:

* **The part is too low.** Seen from the sun, the part's highest ground lies below the lowest ground of the block's parts that its
  shadow could reach. Then no ray from the block to the sun meets the part. The comparison is made in light space (axes right, up
  and away from the sun), where rays are straight and points include the earth's curvature.
* **All facets of the part face the sun.** A ray to the sun starts on the ground or above it. The ground along the ray can rise
  above it only over a facet that rises more steeply than the ray. Such a facet does not face the sun. So ground whose facets all
  face the sun never is the first ground that stops a ray. It can be left out, wherever it lies and however high it is.

  This condition needs ground without gaps. It is not applied to parts with unknown heights at their nodes or beside them. It is
  not applied to ground of coarser detail either, whose edge does not meet that of the finer ground beside it.

A ray may pass below the edge of the ground, where no wall stands. Such a ray counts as stopped there, as in the sweep algorithm
(``skugga.shadows.sweep``).

Both conditions must hold for the whole disc of the sun. Margins allow for rounding, and for the sweep's lines, which run between
the nodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch, Receivers
from skugga.terrain.casters.facet_rises import RISE_DIRECTIONS, count_missing, gather_rises, write_rise_support
from skugga.terrain.compiled import compiled
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.extremes import update_ranges
from skugga.terrain.ground.grid_key import grid_key
from skugga.terrain.ground.surface import RefinedWindow, Surface
from skugga.terrain.ground.surface_loops import refine_row
from skugga.terrain.heightfield.walks import curvature_drop_m
from skugga.terrain.scene import Scene

SUN_RADIUS_SINE = float(np.sin(np.radians(SUN_RADIUS_DEG)))
"""Sine of the sun's angular radius."""

MIN_SUN_FACING_SINE = SUN_RADIUS_SINE + 1.1e-3
"""Minimum sine of the angle between a facet and the sun's centre. It covers the disc, the error of float32 normals, and the
change of the lengths of a quad's sides with its height.
"""

MAX_ROUNDING_M = 4e-3
"""Maximum rounding error of the two ends of a quad's side together, metres: positions are float32 within 20 km of a frame's origin.
"""

RAY_MARGIN_NODES = 4
"""Distance in nodes within which ground beside a ray counts as crossed by the ray. The sweep algorithm's lines lie between nodes.
"""

ALTITUDE_SINE_MARGIN = 0.05
"""Maximum increase of the sine of the sun's altitude within a level, 300 km away from its anchor."""

HALO_NODES = 1
"""Width, in nodes, of the border round a part whose heights must be known, too."""

PATCH_SAMPLE_POSITIONS = ((0.0, 0.0, 0.5, 1.0, 1.0), (0.0, 1.0, 0.5, 0.0, 1.0))
"""Positions in a patch, its corners and its middle, at which the sides of its quads are computed: shares of its rows, and of its
columns.
"""

PARTS_PER_PATCH_SIDE = 4
"""Parts along the side of a patch."""

MAX_RUN_PATCHES = 16
"""Maximum number of consecutive patches in a row whose heights are read at once."""


@dataclass(frozen=True, eq=False)
class PatchBounds:
    """Bounds of the ground of patches (n,) of one grid, for each of their m parts.

    Attributes
    ----------
    min_height_m, max_height_m
        (n, m), the heights of the lowest and of the highest node, metres; NaN without ground.
    rise_support_m
        (n, m, 8), the support of the facets' rises in ``RISE_DIRECTIONS``, metres.
    is_complete
        bool (n, m), whether all heights of the part, and those of ``HALO_NODES`` nodes round it, are known.
    """

    min_height_m: np.ndarray
    max_height_m: np.ndarray
    rise_support_m: np.ndarray
    is_complete: np.ndarray

    def restricted_to(self, part_mask: np.ndarray) -> PatchBounds:
        """Return a copy that has ground only in the parts that ``part_mask`` (n, m) selects."""
        return replace(
            self,
            min_height_m=np.where(part_mask, self.min_height_m, np.nan),
            max_height_m=np.where(part_mask, self.max_height_m, np.nan),
        )


def culled_patches(scene: Scene, receivers: Receivers, patches: tuple[Patch, ...]) -> frozenset[Patch]:
    """Return the patches of ``patches``, ground beside a map's block, that provably cast no shadow of the sun on the block.

    The result is empty for ground as upright columns, whose walls face away from the sun. It is also empty for levels with lamps.
    """
    if not patches or receivers.surface is None or scene.lamps:
        return frozenset()
    grid, patches_of_block = _ground_grid_of(receivers), block_patches(receivers)
    block_ground = patch_bounds(scene.world, scene.elevation, grid, patches_of_block).restricted_to(block_part_mask(receivers))
    block_bounds, block_part_bounds = (
        _light_space_bounds(scene, grid, patches_of_block, block_ground, parts, "lowest") for parts in (1, PARTS_PER_PATCH_SIDE)
    )
    margin_m = RAY_MARGIN_NODES * scene.surface(grid).step_m
    assert scene.light_space is not None
    max_altitude_sine = min(float(np.sin(np.radians(max(scene.light_space.altitude_deg, 0.0)))) + ALTITUDE_SINE_MARGIN, 1.0)
    slack = margin_m, margin_m * max_altitude_sine
    culled: set[Patch] = set()
    for lod in {patch.lod for patch in patches}:
        level_patches = [patch for patch in patches if patch.lod == lod]
        coarser = grid.coarser(lod)
        ground = patch_bounds(scene.world, scene.elevation, coarser, level_patches)
        casts = np.isfinite(ground.min_height_m)
        if lod == 0:
            casts &= ~(sun_facing_parts(scene, grid, level_patches, ground) & ground.is_complete)
        may_shade = casts.any(axis=1)
        may_shade[may_shade] = _may_occlude(
            _light_space_bounds(scene, coarser, level_patches, ground, 1, "highest")[may_shade], block_bounds, *slack
        )
        parts = _light_space_bounds(scene, coarser, level_patches, ground, PARTS_PER_PATCH_SIDE, "highest").reshape(
            *casts.shape, -1
        )
        casts &= may_shade[:, None]
        casts[casts] = _may_occlude(parts[casts], block_part_bounds, *slack)
        culled |= {patch for patch, may_cast in zip(level_patches, casts.any(axis=1), strict=True) if not may_cast}
    return frozenset(culled)


def block_ground_casts_no_shadow(scene: Scene, receivers: Receivers) -> bool:
    """Return whether the ground of a map's block casts no shadow on itself.

    All of it must face the whole sun, and no height may be missing.
    """
    if not block_ground_faces_sun(scene, receivers):
        return False
    ground = patch_bounds(scene.world, scene.elevation, _ground_grid_of(receivers), block_patches(receivers))
    return bool(ground.is_complete[block_part_mask(receivers)].all())


def block_ground_faces_sun(scene: Scene, receivers: Receivers) -> bool:
    """Return whether all facets of a block of smooth ground face the whole sun.

    The facets are those of all parts that the block lies on.
    """
    if receivers.surface is None:
        return False
    grid, patches_of_block = _ground_grid_of(receivers), block_patches(receivers)
    facing = sun_facing_parts(scene, grid, patches_of_block, patch_bounds(scene.world, scene.elevation, grid, patches_of_block))
    return bool(facing[block_part_mask(receivers)].all())


def block_patches(receivers: Receivers) -> list[Patch]:
    """Return the patches that a map's block lies on."""
    window = receivers.surface
    assert window is not None
    rows, cols = (
        range(first // PATCH_QUADS, (first + max(count - 2, 0)) // PATCH_QUADS + 1)
        for first, count in zip((window.row0, window.col0), window.shape, strict=True)
    )
    return [Patch(0, row, col) for row in rows for col in cols]


def block_part_mask(receivers: Receivers) -> np.ndarray:
    """Return which parts of the patches under a map's block contain quads of the block, bool (n, m).

    Rows follow ``block_patches``. Columns are the ``PARTS_PER_PATCH_SIDE`` x ``PARTS_PER_PATCH_SIDE`` parts of a patch, row by row.
    """
    window, quads = receivers.surface, PATCH_QUADS // PARTS_PER_PATCH_SIDE
    assert window is not None
    first = np.array([(patch.row, patch.col) for patch in block_patches(receivers)])[:, None, :] * PATCH_QUADS
    part_offset = (
        np.stack(
            np.unravel_index(np.arange(PARTS_PER_PATCH_SIDE * PARTS_PER_PATCH_SIDE), (PARTS_PER_PATCH_SIDE, PARTS_PER_PATCH_SIDE)),
            axis=-1,
        )
        * quads
    )
    part_start, block_start = first + part_offset, np.array([window.row0, window.col0])
    return np.asarray(((part_start < block_start + np.array(window.shape) - 1) & (part_start + quads > block_start)).all(axis=-1))


def patch_bounds(world: World, elevation: Elevation, grid: Grid, patches: Sequence[Patch]) -> PatchBounds:
    """Return the bounds of the ground of patches of one grid. They are cached, since they are the same under every sun."""
    owner = grid_key(world, elevation, grid)
    patch_parts = {(patch.row, patch.col): _patch_cache.get(owner, patch.row, patch.col) for patch in patches}
    missing: dict[int, list[int]] = {}
    for (row, col), parts in patch_parts.items():
        if isinstance(parts, Missing):
            missing.setdefault(row, []).append(col)
    surface = Surface(world, elevation, grid)
    for row, cols in missing.items():
        for run in _consecutive_ranges(sorted(cols)):
            for col, parts in zip(run, _read_patches(surface, row, run), strict=True):
                patch_parts[row, col] = parts
                _patch_cache.put(owner, row, col, value=parts)
    parts_of_patches = np.array([patch_parts[patch.row, patch.col] for patch in patches])
    return PatchBounds(
        parts_of_patches[..., 0], parts_of_patches[..., 1], parts_of_patches[..., 3:], parts_of_patches[..., 2] > 0.0
    )


def _consecutive_ranges(numbers: list[int]) -> list[range]:
    """Group sorted, distinct integers into ranges of consecutive ones, each of at most ``MAX_RUN_PATCHES`` integers."""
    runs: list[range] = []
    for number in numbers:
        if runs and runs[-1].stop == number and len(runs[-1]) < MAX_RUN_PATCHES:
            runs[-1] = range(runs[-1].start, number + 1)
        else:
            runs.append(range(number, number + 1))
    return runs


def sun_facing_parts(scene: Scene, grid: Grid, patches: Sequence[Patch], ground: PatchBounds) -> np.ndarray:
    """Return the mask (n, m) of the parts of patches of one grid in which every facet faces all of the sun's disc.

    A facet that rises by a from column to column and by b from row to row spans the vectors e + a u and f + b u. Here e and f are
    the horizontal sides of its quad, to the next column and to the next row. u is the unit vector up and s the direction to the
    sun. The facet's normal times s is s (f x e) + a s (f x u) + b s (u x e). This is linear in a and b, and ``rise_support_m``
    bounds such weighted sums of a and b. e, f and u vary over a patch, so the condition is tested at its corners and in its middle.
    """
    assert scene.light_space is not None
    to_sun = -scene.light_space.light_from_earth[2]
    corner = np.array([(patch.row, patch.col) for patch in patches], np.float64)
    row, col = (corner[:, k, None] * PATCH_QUADS + np.array(at) * PATCH_QUADS for k, at in enumerate(PATCH_SAMPLE_POSITIONS))
    _, up = scene.world.points_at_zero_height(grid.crs, grid.x(col), grid.y(row))
    ends = [(row, col + 0.5), (row, col - 0.5), (row + 0.5, col), (row - 0.5, col)]
    points = [scene.world.points_at_zero_height(grid.crs, grid.x(c), grid.y(r))[0] for r, c in ends]
    right, down = points[0] - points[1], points[2] - points[3]
    constant_term, right_weight, down_weight = (
        (np.cross(first_side, second_side) @ to_sun)[:, None]
        for first_side, second_side in ((down, right), (down, up), (up, right))
    )  # fmt: skip
    right_length, down_length = (np.linalg.norm(side, axis=-1)[:, None] for side in (right, down))
    rise_support_m = ground.rise_support_m[:, :, None]
    steep_right, steep_down = (rise_support_m[..., k : k + 2].max(axis=-1) + MAX_ROUNDING_M for k in (0, 2))
    min_facing = (
        constant_term - _support_bound(rise_support_m, -right_weight, -down_weight) - MAX_ROUNDING_M * (right_length + down_length)
    )
    max_normal_length = right_length * down_length + steep_right * down_length + steep_down * right_length
    return np.asarray((min_facing > MIN_SUN_FACING_SINE * max_normal_length).all(axis=2))


def _support_bound(rise_support_m: np.ndarray, right_weight: np.ndarray, down_weight: np.ndarray) -> np.ndarray:
    """Return an upper bound (...) of ``right_weight`` a + ``down_weight`` b over all rises (a, b) with the support
    ``rise_support_m`` (..., 8).

    The bound combines the supports in the two ``RISE_DIRECTIONS`` nearest to (``right_weight``, ``down_weight``).
    """
    abs_right, abs_down = np.abs(right_weight), np.abs(down_weight)
    axis = np.where(abs_right >= abs_down, np.where(right_weight >= 0.0, 0, 1), np.where(down_weight >= 0.0, 2, 3))
    same_sign = (right_weight >= 0.0) == (down_weight >= 0.0)
    diagonal = np.where(same_sign, np.where(right_weight >= 0.0, 4, 5), np.where(right_weight >= 0.0, 6, 7))
    shape = np.broadcast_shapes(rise_support_m.shape[:-1], right_weight.shape)
    supports = np.broadcast_to(rise_support_m, (*shape, len(RISE_DIRECTIONS)))
    on_axis, on_diagonal = (
        np.take_along_axis(supports, np.broadcast_to(direction, shape)[..., None], axis=-1)[..., 0]
        for direction in (axis, diagonal)
    )
    return np.asarray(np.abs(abs_right - abs_down) * on_axis + np.minimum(abs_right, abs_down) * on_diagonal)


def _light_space_bounds(
    scene: Scene,
    grid: Grid,
    patches: Sequence[Patch],
    ground: PatchBounds,
    parts_per_side: int,
    reference_height: Literal["lowest", "highest"],
) -> np.ndarray:
    """Return the light-space bounds, metres, of the ``parts_per_side`` x ``parts_per_side`` parts of each of n patches.

    The result is float64 (n parts_per_side², 8), NaN without ground. The first four columns are the minima of four coordinates, the
    last four the maxima. The coordinates run right, up, away from the sun, and horizontally towards the sun. The last one increases
    along every ray to the sun, and does not depend on the height. ``reference_height`` is the height at which the bounds of the
    coordinate up are computed: the part's lowest or highest one.
    """
    assert scene.light_space is not None
    low_m, high_m = ground.min_height_m, ground.max_height_m
    if parts_per_side == 1:
        low_m, high_m = np.fmin.reduce(low_m, axis=1, keepdims=True), np.fmax.reduce(high_m, axis=1, keepdims=True)
    corner = np.array([(patch.row, patch.col) for patch in patches], np.float64) * PATCH_QUADS
    offset = np.arange(parts_per_side + 1) * (PATCH_QUADS / parts_per_side)
    row, col = np.broadcast_arrays(corner[:, :1, None] + offset[:, None], corner[:, 1:, None] + offset)
    point, up = (
        _part_corners(values, parts_per_side) for values in scene.world.points_at_zero_height(grid.crs, grid.x(col), grid.y(row))
    )
    ends = np.stack([point + height_m[..., None, None] * up for height_m in (low_m, high_m)])
    in_light = scene.light_space.points_from_earth(ends)
    in_light = np.concatenate([in_light, scene.light_space.horizontal_sunward_m(in_light)[..., None]], axis=-1)
    in_light[..., 1] = in_light[0 if reference_height == "lowest" else 1, ..., 1]
    diagonal_m = np.linalg.norm(point - point[..., ::-1, :], axis=-1).max(axis=-1, keepdims=True)
    # Twice the maximum rise of the earth above the plane of four corners.
    bulge = 2.0 * curvature_drop_m(0.5 * diagonal_m, scene.world.curvature)
    low, high = in_light.min(axis=(0, 3)) - bulge, in_light.max(axis=(0, 3)) + bulge
    return np.concatenate([low, high], axis=-1).reshape(-1, 8)


def _part_corners(corners: np.ndarray, parts_per_side: int) -> np.ndarray:
    """Return the four corners (n, m, 4, 3) of each part of a patch, from the corners (n, k, k, 3) of all parts; k is
    ``parts_per_side`` + 1.
    """
    four = [corners[:, i : i + parts_per_side, j : j + parts_per_side] for i in (0, 1) for j in (0, 1)]
    return np.stack(four, axis=3).reshape(len(corners), parts_per_side * parts_per_side, 4, 3)


@compiled
def _may_occlude(bounds, receiver_bounds, margin_m, up_margin_m):
    """Return which of n parts may occlude any of m receiver parts from any point of the sun's disc, bool (n,).

    ``bounds`` (n, 8) and ``receiver_bounds`` (m, 8) are those of ``_light_space_bounds``. A part may occlude a receiver part if it
    lies between that part and the sun, and not wholly below it as the sun sees them. ``up_margin_m`` is the margin of the
    comparison of heights, ``margin_m`` the margin in the other coordinates, metres.
    """
    may_occlude = np.empty(len(bounds), np.bool_)
    for n in range(len(bounds)):
        may_occlude[n] = False
        for m in range(len(receiver_bounds)):
            if np.isnan(receiver_bounds[m, 0]):
                continue
            distance_m = receiver_bounds[m, 6] - bounds[n, 2]
            if distance_m + margin_m < 0.0:
                continue
            disc_m = 1.1 * SUN_RADIUS_SINE * max(distance_m, 0.0)
            slack_m = margin_m + disc_m
            if (
                bounds[n, 4] + slack_m >= receiver_bounds[m, 0] and bounds[n, 0] - slack_m <= receiver_bounds[m, 4]
                and bounds[n, 5] + up_margin_m + disc_m >= receiver_bounds[m, 1] and bounds[n, 7] + slack_m >= receiver_bounds[m, 3]
            ):  # fmt: skip
                may_occlude[n] = True
                break
    return may_occlude


def _ground_grid_of(receivers: Receivers) -> Grid:
    """Return the map grid of a block's receivers."""
    assert isinstance(receivers.view, MapView)
    return receivers.view.grid


_patch_cache: Cache[np.ndarray] = Cache(
    "skugga.terrain.casters.caster_culling", "scene", 32 * MIB, lambda patch_part_bounds: patch_part_bounds.nbytes + 512
)


def _read_patches(surface: Surface, row: int, cols: range) -> np.ndarray:
    """Read the heights of consecutive patches and return the bounds of their m parts, float64 (n, m, 11).

    The last axis holds ``low_m``, ``high_m``, ``is_complete`` and the eight values ``rise_support_m`` of ``PatchBounds``. The
    patches lie in the row ``row`` of patches, in the columns ``cols``.
    """
    halo = HALO_NODES
    window = surface.height_window(
        row * PATCH_QUADS - halo,
        cols.start * PATCH_QUADS - halo,
        PATCH_QUADS + 1 + 2 * halo,
        len(cols) * PATCH_QUADS + 1 + 2 * halo,
        includes_rim=True,
    )
    out = np.empty((len(cols), PARTS_PER_PATCH_SIDE * PARTS_PER_PATCH_SIDE, 3 + len(RISE_DIRECTIONS)))
    refined = isinstance(window, RefinedWindow)
    height_m = window.coarser_window.height_m if isinstance(window, RefinedWindow) else window.height_m
    if not np.isfinite(height_m).any():  # beside the raster
        out[...] = 0.0
        out[..., :2] = np.nan
        return out
    _write_part_bounds(height_m, refined, window.row0 % 2, window.col0 % 2, halo, PATCH_QUADS // PARTS_PER_PATCH_SIDE, out)
    return out


@compiled
def _write_part_bounds(height_m, refined, row_parity, col_parity, halo, quads, out):
    """Write the result of ``_read_patches`` to ``out`` (n, m, 11). A part is ``quads`` quads wide.

    ``height_m`` holds the heights of the patches' nodes, with ``halo`` more nodes on each side. If ``refined``, it holds the nodes
    of a grid with half as many nodes per side, from which ``refine_row`` interpolates. ``row_parity`` and ``col_parity`` are then 1
    where the first row or column of the patches' nodes lies between two of the coarser grid, else 0.
    """
    cols = len(out) * PARTS_PER_PATCH_SIDE * quads + 1
    rise_extremes, bounds = np.empty((len(RISE_DIRECTIONS), cols), np.float32), np.empty((2, cols), np.float32)
    missing = np.empty(cols + 2 * halo, np.int32)
    band = np.empty((quads + 1 + 2 * halo, cols + 2 * halo), np.float32)
    for down in range(PARTS_PER_PATCH_SIDE):
        missing[:] = 0
        for i in range(len(band)):
            row = down * quads + i
            if refined:
                refine_row(height_m, row_parity + row, col_parity, band[i])
            else:
                for j in range(band.shape[1]):
                    band[i, j] = height_m[row, j]
            count_missing(band[i], missing)
        nodes = band[halo : halo + quads + 1]
        bounds[0], bounds[1] = np.inf, -np.inf
        for i in range(quads + 1):
            update_ranges(nodes[i, halo : halo + cols], bounds[0], bounds[1])
        gather_rises(nodes, halo, rise_extremes)
        for number in range(cols // quads):
            left = number * quads
            part = out[number // PARTS_PER_PATCH_SIDE, down * PARTS_PER_PATCH_SIDE + number % PARTS_PER_PATCH_SIDE]
            low, high = bounds[0, left], bounds[1, left]
            for j in range(left + 1, left + quads + 1):
                low = bounds[0, j] if bounds[0, j] < low else low
                high = bounds[1, j] if bounds[1, j] > high else high
            part[0], part[1] = (low, high) if low <= high else (np.nan, np.nan)
            is_complete = True
            for j in range(left, left + quads + 1 + 2 * halo):
                is_complete = is_complete and missing[j] == 0
            part[2] = is_complete
            write_rise_support(rise_extremes[:, left : left + quads + 1], part[3:])
