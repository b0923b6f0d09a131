"""A bound of the horizon of a map's block: which ground provably throws no shadow of the sun on anything that is seen there.

Ground goes by patches of ``PATCH_QUADS`` quads, the block's own as well as those beside it. Of each is kept, whatever the sun, how
high and how low its nodes are, and how steep its facets. Two things prove that a patch cannot shade a block:

**It is too low.** Rays to the sun are straight, and light space has the earth's curvature in its points: a patch whose highest
ground stays below the lowest ground of each own patch that its rays could come from, as the sun sees them, meets none of them.

**All of its facets face the sun.** Along a ray from a receiver the ground begins not above it. Where it comes above, it has risen
more steeply than the ray: over a facet that does not face the sun. So the first ground that stops a ray is such a facet's, and
ground without one may be left out, wherever it lies and however high. This needs ground without gaps: a patch at whose nodes, or
beside them, no height is known is not left out for it, nor is ground of coarser detail, which does not meet its neighbour's edge.

Both are asked of the whole disc of the sun, with what rounding and the texels of shadow maps may add in hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrain.cache import MIB, cached
from terrain.casters.reach import PATCH_QUADS, Patch, Receivers
from terrain.geo.grid import Grid
from terrain.geo.sun import SUN_RADIUS_DEG
from terrain.geo.world import EARTH_RADIUS_M, World
from terrain.ground.elevation import Elevation
from terrain.ground.surface import Surface
from terrain.scene import Scene

DISC = float(np.sin(np.radians(SUN_RADIUS_DEG)))
"""Sine of the angle from the middle of the sun's disc to its rim."""

FACING = DISC + 1.1e-3
"""Sine of the angle by which a facet faces the sun at least: the disc, what float32 normals are off by, and what the lengths of a
quad's sides change by with its height.
"""

ROUNDED_M = 4e-3
"""How far the two ends of a quad's side may be off together, metres: positions are float32 within 20 km of a frame's origin."""

BESIDE_NODES = 32
"""So many nodes beside a ray, as the sun sees them, count as on it: texels of shadow maps and their filters reach so far."""

NODES_BEYOND = 1
"""Nodes beside a patch whose heights have to be known as well."""

DIRECTIONS = np.array([[1, 0], [-1, 0], [0, 1], [0, -1], [1, 1], [-1, -1], [1, -1], [-1, 1]], np.float64)
"""Directions of columns and rows in which it is known how far the slopes of a patch's facets reach."""


@dataclass(frozen=True, eq=False)
class PatchGround:
    """The ground of some patches (n,) of one grid: ``low_m`` and ``high_m`` of the nodes (inf and -inf without any), whether it is
    ``whole``, and how far rises per node reach in ``DIRECTIONS`` (n, 8), metres.
    """

    low_m: np.ndarray
    high_m: np.ndarray
    whole: np.ndarray
    rise_m: np.ndarray


def idle_patches(scene: Scene, receivers: Receivers, patches: tuple[Patch, ...]) -> frozenset[Patch]:
    """Those of the patches beside a map's block that throw no shadow of the sun on it. Columns' walls, and what shades a block in the
    light of lamps, are not looked into.
    """
    if not patches or receivers.surface is None or scene.lamps:
        return frozenset()
    grid, own = _grid_of(receivers), own_patches(receivers)
    own_ground = patch_ground(scene.world, scene.elevation, grid, own)
    lit = _InLight.of(scene, grid, own, own_ground, own_ground.low_m)
    idle: set[Patch] = set()
    for level in {patch.level for patch in patches}:
        here, coarser = tuple(patch for patch in patches if patch.level == level), grid.coarser(level)
        ground = patch_ground(scene.world, scene.elevation, coarser, here)
        out = _InLight.of(scene, coarser, here, ground, ground.high_m)
        casts = _may_hide(out, lit, BESIDE_NODES * scene.surface(grid).step_m)
        if level == 0:
            casts &= ~(ground.whole & all_facets_face_sun(scene, grid, here, ground))
        idle |= {patch for patch, each in zip(here, casts, strict=True) if not each}
    return frozenset(idle)


def own_ground_faces_sun(scene: Scene, receivers: Receivers) -> bool:
    """Whether all facets of a map's block of smooth ground, and of the patches that it lies on, face the whole sun: they shade
    nothing, and none is turned away.
    """
    if receivers.surface is None:
        return False
    grid, own = _grid_of(receivers), own_patches(receivers)
    ground = patch_ground(scene.world, scene.elevation, grid, own)
    return bool((ground.whole & all_facets_face_sun(scene, grid, own, ground)).all())


def own_patches(receivers: Receivers) -> tuple[Patch, ...]:
    """The patches that a map's block lies on."""
    own = receivers.surface
    assert own is not None
    rows, cols = (
        range(first // PATCH_QUADS, (first + max(count - 2, 0)) // PATCH_QUADS + 1)
        for first, count in zip((own.row0, own.col0), own.shape, strict=True)
    )
    return tuple(Patch(0, row, col) for row in rows for col in cols)


def patch_ground(world: World, elevation: Elevation, grid: Grid, patches: tuple[Patch, ...]) -> PatchGround:
    """The ground of patches of one grid; it is read once, and serves every sun."""
    known = np.array([_ground_of(world, elevation, grid, patch.row, patch.col) for patch in patches])
    return PatchGround(known[:, 0], known[:, 1], known[:, 2] > 0.0, known[:, 3:])


def all_facets_face_sun(scene: Scene, grid: Grid, patches: tuple[Patch, ...], ground: PatchGround) -> np.ndarray:
    """Whether every facet of patches (n,) of one grid faces all of the sun's disc, bool.

    A facet that rises by a from column to column and by b from row to row spans e + a u and f + b u, of a quad's sides e and f and
    the way up u. Its normal times the sun's direction s is s (f x e) + a s (f x u) + b s (u x e): linear in a and b, of which
    ``rise_m`` bounds the sums. It is asked for at the corners and in the middle of a patch, in each with the local sides.
    """
    assert scene.light is not None
    to_sun = -scene.light.light_from_earth[2]
    row, col = _places(patches, np.array([0.0, 0.0, 0.5, 1.0, 1.0]), np.array([0.0, 1.0, 0.5, 0.0, 1.0]))
    point, up = scene.world.ground(grid.crs, grid.x(col), grid.y(row))
    right, down = (
        scene.world.ground(grid.crs, grid.x(c), grid.y(r))[0] - scene.world.ground(grid.crs, grid.x(d), grid.y(q))[0]
        for r, c, q, d in ((row, col + 0.5, row, col - 0.5), (row + 0.5, col, row - 0.5, col))
    )
    with np.errstate(invalid="ignore"):
        level, per_right, per_down = (
            np.cross(one, other) @ to_sun for one, other in ((down, right), (down, up), (up, right))
        )
        least = level - _farthest(ground.rise_m[:, None], -per_right, -per_down)
        sides = np.linalg.norm(right, axis=-1), np.linalg.norm(down, axis=-1)
        steepest = [ground.rise_m[:, k : k + 2].max(axis=1)[:, None] + ROUNDED_M for k in (0, 2)]
        normal = sides[0] * sides[1] + steepest[0] * sides[1] + steepest[1] * sides[0]
        rounded = ROUNDED_M * (sides[0] + sides[1])
        return np.asarray((least - rounded > FACING * normal).all(axis=1))


def _farthest(rise_m: np.ndarray, per_right: np.ndarray, per_down: np.ndarray) -> np.ndarray:
    """The largest ``per_right`` a + ``per_down`` b over rises (a, b) that reach so far: by the two directions beside that one."""
    across, along = np.abs(per_right), np.abs(per_down)
    axis = np.where(across >= along, np.where(per_right >= 0.0, 0, 1), np.where(per_down >= 0.0, 2, 3))
    same = (per_right >= 0.0) == (per_down >= 0.0)
    diagonal = np.where(same, np.where(per_right >= 0.0, 4, 5), np.where(per_right >= 0.0, 6, 7))
    rise_m = np.broadcast_to(rise_m, (*per_right.shape, len(DIRECTIONS)))
    on_axis, on_diagonal = (np.take_along_axis(rise_m, which[..., None], axis=-1)[..., 0] for which in (axis, diagonal))
    return np.abs(across - along) * on_axis + np.minimum(across, along) * on_diagonal


@dataclass(frozen=True, eq=False)
class _InLight:
    """Patches (n,) as the sun sees them: the least and largest coordinate to the right and away from it, and the least and largest
    one up, of their ground at one height.
    """

    low: np.ndarray
    high: np.ndarray

    @staticmethod
    def of(scene: Scene, grid: Grid, patches: tuple[Patch, ...], ground: PatchGround, height_m: np.ndarray) -> _InLight:
        assert scene.light is not None
        row, col = _places(patches, np.array([0.0, 0.0, 1.0, 1.0]), np.array([0.0, 1.0, 0.0, 1.0]))
        point, up = scene.world.ground(grid.crs, grid.x(col), grid.y(row))
        ends = np.stack([point + each[:, None, None] * up for each in (ground.low_m, ground.high_m, height_m)])
        in_light = scene.light.from_earth(ends)
        in_light[:2, ..., 1] = in_light[2, ..., 1]  # up is that of the one height, the others of all that there are
        flat = 0.0 if scene.world.flat else np.linalg.norm(point - point[:, ::-1], axis=-1).max(axis=1) ** 2 / (4.0 * EARTH_RADIUS_M)
        bulge = np.broadcast_to(flat, len(patches))[:, None]  # the earth bends by half of that between the corners at most
        return _InLight(in_light.min(axis=(0, 2)) - bulge, in_light.max(axis=(0, 2)) + bulge)


def _may_hide(out: _InLight, lit: _InLight, beside_m: float) -> np.ndarray:
    """Which patches (n,) may stand, as any point of the sun's disc sees them, before some of the others (m,): before it, and not
    wholly below. What is not known may.
    """
    with np.errstate(invalid="ignore"):
        away_m = lit.high[:, 2] - out.low[:, None, 2]
        slack_m = beside_m + 1.1 * DISC * np.maximum(away_m, 0.0)
        clear = (
            (out.low[:, None, 0] - slack_m > lit.high[:, 0]) | (out.high[:, None, 0] + slack_m < lit.low[:, 0])
            | (out.high[:, None, 1] + slack_m < lit.low[:, 1]) | (away_m + beside_m < 0.0)
        )  # fmt: skip
    nothing = ~np.isfinite(lit.low).all(axis=1)
    return np.asarray(~(clear | nothing).all(axis=1))


def _grid_of(receivers: Receivers) -> Grid:
    grid: Grid = receivers.view.grid  # type: ignore[union-attr]
    return grid


def _places(patches: tuple[Patch, ...], down: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns (n, k) of places within patches, as shares of their sides."""
    corner = np.array([(patch.row, patch.col) for patch in patches], np.float64)
    return (corner[:, :1] + down) * PATCH_QUADS, (corner[:, 1:] + right) * PATCH_QUADS


@cached("scene", 16 * MIB, size_of=lambda _: 1024)
def _ground_of(world: World, elevation: Elevation, grid: Grid, row: int, col: int) -> np.ndarray:
    """``low_m``, ``high_m``, ``whole`` and ``rise_m`` (11,) of a patch."""
    side, more = PATCH_QUADS + 1, NODES_BEYOND
    window = Surface(world, elevation, grid).height_window(
        row * PATCH_QUADS - more, col * PATCH_QUADS - more, side + 2 * more, side + 2 * more
    )
    around = window.height_m
    height = around[more:-more, more:-more]
    known = np.isfinite(height)
    if not known.any():
        return np.array([np.inf, -np.inf, 0.0, *np.full(len(DIRECTIONS), np.inf)])
    ends = float(height[known].min()), float(height[known].max())
    if not np.isfinite(around).all():
        return np.array([*ends, 0.0, *np.full(len(DIRECTIONS), np.inf)])
    return np.array([*ends, 1.0, *rises(height)])


def rises(height_m: np.ndarray) -> np.ndarray:
    """How far the rises (a, b) from column to column and from row to row of the facets of a sheet (rows, cols) reach in
    ``DIRECTIONS`` (8,), however its quads are cut.

    A facet has one side of its quad along a row, and one along a column; each of the four pairs of them may be one's.
    """
    across, along = np.diff(height_m, axis=1), np.diff(height_m, axis=0)
    top, bottom, left, right = across[:-1], across[1:], along[:, :-1], along[:, 1:]
    pairs = [(one, other) for one in (top, bottom) for other in (left, right)]
    ends = [(across.max(), -across.min()), (along.max(), -along.min())]
    for sign in (1.0, -1.0):
        sums = [one + np.float32(sign) * other for one, other in pairs]
        ends.append((max(each.max() for each in sums), -min(each.min() for each in sums)))
    return np.array(ends, np.float64).ravel()
