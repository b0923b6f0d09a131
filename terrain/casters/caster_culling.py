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

from typing import Literal

import numpy as np

from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch, Receivers
from skugga.terrain.casters.facet_rises import RISE_DIRECTIONS
from skugga.terrain.casters.patch_bounds import PARTS_PER_PATCH_SIDE, PatchBounds, patch_bounds
from skugga.terrain.compiled import compiled
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.heightfield.walks import loop_curvature_drop_m
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


def culled_patches(scene: Scene, receivers: Receivers, patches: tuple[Patch, ...]) -> frozenset[Patch]:
    """Return the patches of ``patches``, ground beside a map's block, that provably cast no shadow of the sun on the block.

    The result is empty for ground as upright columns, whose walls face away from the sun. It is also empty for levels with lamps.
    """
    if not patches or receivers.surface is None or scene.lamps:
        return frozenset()
    grid, patches_of_block = _ground_grid_of(receivers), block_patches(receivers)
    block_ground = patch_bounds(scene.world, scene.elevation, grid, patches_of_block).restricted_to(block_part_mask(receivers))
    block_bounds, block_part_bounds = (
        _light_space_bounds(scene, block_ground, parts, "lowest") for parts in (1, PARTS_PER_PATCH_SIDE)
    )
    margin_m = RAY_MARGIN_NODES * scene.surface(grid).step_m
    assert scene.light_space is not None
    max_altitude_sine = min(float(np.sin(np.radians(max(scene.light_space.altitude_deg, 0.0)))) + ALTITUDE_SINE_MARGIN, 1.0)
    slack = margin_m, margin_m * max_altitude_sine
    culled: set[Patch] = set()
    for lod in {patch.lod for patch in patches}:
        level_patches = [patch for patch in patches if patch.lod == lod]
        ground = patch_bounds(scene.world, scene.elevation, grid.coarser(lod), level_patches)
        casts = np.isfinite(ground.min_height_m)
        if lod == 0:
            casts &= ~(sun_facing_parts(scene, ground) & ground.is_complete)
        may_shade = casts.any(axis=1)
        may_shade[may_shade] = _may_occlude(_light_space_bounds(scene, ground, 1, "highest")[may_shade], block_bounds, *slack)
        parts = _light_space_bounds(scene, ground, PARTS_PER_PATCH_SIDE, "highest").reshape(*casts.shape, -1)
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
    ground = patch_bounds(scene.world, scene.elevation, _ground_grid_of(receivers), block_patches(receivers))
    return bool(sun_facing_parts(scene, ground)[block_part_mask(receivers)].all())


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


def sun_facing_parts(scene: Scene, ground: PatchBounds) -> np.ndarray:
    """Return the mask (n, m) of the parts of patches of one grid in which every facet faces all of the sun's disc.

    A facet that rises by a from column to column and by b from row to row spans the vectors e + a u and f + b u. Here e and f are
    the horizontal sides of its quad, to the next column and to the next row. u is the unit vector up and s the direction to the
    sun. The facet's normal times s is s (f x e) + a s (f x u) + b s (u x e). This is linear in a and b, and ``rise_support_m``
    bounds such weighted sums of a and b. e, f and u vary over a patch, so the condition is tested at its corners and in its middle.
    """
    assert scene.light_space is not None
    to_sun = -scene.light_space.light_from_earth[2]
    facing_m = ground.facing_terms_m @ to_sun
    constant_term, right_weight, down_weight = (facing_m[:, None, :, k] for k in range(3))
    right_length, down_length = (ground.side_length_m[:, None, :, k] for k in range(2))
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
    scene: Scene, ground: PatchBounds, parts_per_side: int, reference_height: Literal["lowest", "highest"]
) -> np.ndarray:
    """Return the light-space bounds, metres, of the ``parts_per_side`` x ``parts_per_side`` parts of each of n patches.

    The result is float64 (n parts_per_side², 8), NaN without ground. The first four columns are the minima of four coordinates, the
    last four the maxima. The coordinates run right, up, away from the sun, and horizontally towards the sun. The last one increases
    along every ray to the sun, and does not depend on the height. ``reference_height`` is the height at which the bounds of the
    coordinate up are computed: the part's lowest or highest one.
    """
    light = scene.light_space
    assert light is not None
    low_m, high_m = ground.min_height_m, ground.max_height_m
    if parts_per_side == 1:
        low_m, high_m = np.fmin.reduce(low_m, axis=1, keepdims=True), np.fmax.reduce(high_m, axis=1, keepdims=True)
    rows = np.vstack([light.light_from_earth, light.horizontal_sunward_m(light.light_from_earth.T)])
    out = np.empty((low_m.size, 8))
    low_m, high_m = np.ascontiguousarray(low_m), np.ascontiguousarray(high_m)
    _write_light_space_bounds(
        ground.corner_earth_m, ground.corner_up, low_m, high_m, rows, light.origin_earth_m, parts_per_side,
        reference_height == "highest", scene.world.curvature, out,
    )  # fmt: skip
    return out


@compiled
def _write_light_space_bounds(corner, up, low_m, high_m, axes, origin, parts_per_side, at_highest, curvature, out):
    """Write the result of ``_light_space_bounds`` to ``out`` (n m, 8).

    ``corner`` and ``up`` (n, 25, 3) are fields of ``PatchBounds``. ``low_m`` and ``high_m`` (n, m) are the heights of the m parts,
    metres. ``axes`` (4, 3) are the earth-fixed directions of the four coordinates, which are 0 at ``origin`` (3,). ``at_highest``
    tells whether the coordinate up is that of the highest ground. ``curvature`` is 1 over the earth's radius, per metre.
    """
    stride = PARTS_PER_PATCH_SIDE // parts_per_side
    side = PARTS_PER_PATCH_SIDE + 1
    for n in range(low_m.shape[0]):
        for part in range(low_m.shape[1]):
            first = part // parts_per_side * stride * side + part % parts_per_side * stride
            corners = first, first + stride, first + stride * side, first + stride * side + stride
            bounds = out[n * low_m.shape[1] + part]
            bounds[:4], bounds[4:] = np.inf, -np.inf
            if np.isnan(low_m[n, part]):
                bounds[:] = np.nan
                continue
            diagonal2, is_finite = 0.0, True
            for k in range(2):
                length2 = 0.0
                for axis in range(3):
                    length2 += (corner[n, corners[k], axis] - corner[n, corners[3 - k], axis]) ** 2
                diagonal2 = max(diagonal2, length2)
            for k in range(4):
                p, u = corner[n, corners[k]], up[n, corners[k]]
                for axis in range(4):
                    a, b, c = axes[axis, 0], axes[axis, 1], axes[axis, 2]
                    foot = a * (p[0] - origin[0]) + b * (p[1] - origin[1]) + c * (p[2] - origin[2])
                    slope = a * u[0] + b * u[1] + c * u[2]
                    is_finite = is_finite and np.isfinite(foot)
                    low, high = foot + slope * low_m[n, part], foot + slope * high_m[n, part]
                    if axis == 1:
                        low = high = high if at_highest else low
                    bounds[axis] = min(bounds[axis], min(low, high))
                    bounds[axis + 4] = max(bounds[axis + 4], max(low, high))
            # Twice the maximum rise of the earth above the plane of four corners.
            bulge = 2.0 * loop_curvature_drop_m(0.5 * np.sqrt(diagonal2), curvature)
            for axis in range(4):
                bounds[axis] = bounds[axis] - bulge if is_finite else np.nan
                bounds[axis + 4] = bounds[axis + 4] + bulge if is_finite else np.nan


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
