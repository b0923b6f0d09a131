"""Bounds of the ground of patches: their heights and their steepest facets. They are the same under every sun, and are cached.

``skugga.terrain.casters.caster_culling`` proves from them which ground casts no shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.cache import MIB, Cache, Missing
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch
from skugga.terrain.casters.facet_rises import RISE_DIRECTIONS, count_missing, gather_rises, write_rise_support
from skugga.terrain.compiled import compiled
from skugga.terrain.geo.grid import Grid
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.extremes import update_ranges
from skugga.terrain.ground.grid_key import grid_key
from skugga.terrain.ground.surface import RefinedWindow, Surface
from skugga.terrain.ground.surface_loops import refine_row

HALO_NODES = 1
"""Width, in nodes, of the border round a part whose heights must be known, too."""

PATCH_SAMPLE_POSITIONS = ((0.0, 0.0, 0.5, 1.0, 1.0), (0.0, 1.0, 0.5, 0.0, 1.0))
"""Positions in a patch, its corners and its middle, at which the sides of its quads are computed: shares of its rows, and of its
columns.
"""

PARTS_PER_PATCH_SIDE = 4
"""Parts along the side of a patch."""

PARTS_PER_PATCH, CORNERS_PER_PATCH = PARTS_PER_PATCH_SIDE**2, (PARTS_PER_PATCH_SIDE + 1) ** 2
"""Parts of a patch, and corners of these parts."""

SAMPLES_PER_PATCH = len(PATCH_SAMPLE_POSITIONS[0])
"""Positions at which the sides of a patch's quads are computed."""

BOUNDS_PER_PART = 3 + len(RISE_DIRECTIONS)
"""Numbers that bound the ground of a part: its heights, whether it is complete, and the support of its rises."""

MAX_RUN_PATCHES = 16
"""Maximum number of consecutive patches in a row whose heights are read at once."""


@dataclass(frozen=True, eq=False)
class PatchBounds:
    """Bounds of the ground of patches (n,) of one grid, for each of their m parts, and the patches' places, under any sun.

    Attributes
    ----------
    min_height_m, max_height_m
        (n, m), the heights of the lowest and of the highest node, metres; NaN without ground.
    rise_support_m
        (n, m, 8), the support of the facets' rises in ``RISE_DIRECTIONS``, metres.
    is_complete
        bool (n, m), whether all heights of the part, and those of ``HALO_NODES`` nodes round it, are known.
    corner_earth_m, corner_up
        (n, 25, 3), the corners of the parts at height 0, earth-fixed, metres, row by row, and the vectors up there.
    facing_terms_m
        (n, k, 3, 3), at the k ``PATCH_SAMPLE_POSITIONS``: with e and f the sides of a quad, to the next column and to the next row,
        and u the vector up, these are f x e, f x u and u x e.
    side_length_m
        (n, k, 2), the lengths of e and f there, metres.
    """

    min_height_m: np.ndarray
    max_height_m: np.ndarray
    rise_support_m: np.ndarray
    is_complete: np.ndarray
    corner_earth_m: np.ndarray
    corner_up: np.ndarray
    facing_terms_m: np.ndarray
    side_length_m: np.ndarray

    def restricted_to(self, part_mask: np.ndarray) -> PatchBounds:
        """Return a copy that has ground only in the parts that ``part_mask`` (n, m) selects."""
        return replace(
            self,
            min_height_m=np.where(part_mask, self.min_height_m, np.nan),
            max_height_m=np.where(part_mask, self.max_height_m, np.nan),
        )


def patch_bounds(world: World, elevation: Elevation, grid: Grid, patches: Sequence[Patch]) -> PatchBounds:
    """Return the bounds of the ground of patches of one grid. They are cached, since they are the same under every sun."""
    owner = grid_key(world, elevation, grid)
    places = [(patch.row, patch.col) for patch in patches]
    values = dict(zip(places, _patch_cache.get_several((owner,), places), strict=True))
    missing: dict[int, list[int]] = {}
    for (row, col), value in values.items():
        if isinstance(value, Missing):
            missing.setdefault(row, []).append(col)
    surface = Surface(world, elevation, grid)
    for row, cols in missing.items():
        for run in _consecutive_ranges(sorted(cols)):
            bounds, geometry = _read_patches(surface, row, run), _geometry_of_patches(surface, row, run)
            for col, value in zip(run, np.concatenate([bounds.reshape(len(run), -1), geometry], axis=1), strict=True):
                values[row, col] = value
                _patch_cache.put(owner, row, col, value=value)
    of_patches = np.array([values[place] for place in places])
    ends = np.cumsum([PARTS_PER_PATCH * BOUNDS_PER_PART, 3 * CORNERS_PER_PATCH, 3 * CORNERS_PER_PATCH, 9 * SAMPLES_PER_PATCH])
    bounds, corner, up, terms, lengths = np.split(of_patches, ends, axis=1)
    count = len(patches)
    bounds = bounds.reshape(count, PARTS_PER_PATCH, BOUNDS_PER_PART)
    corner, up = (np.ascontiguousarray(values).reshape(count, CORNERS_PER_PATCH, 3) for values in (corner, up))
    return PatchBounds(
        bounds[..., 0], bounds[..., 1], bounds[..., 3:], bounds[..., 2] > 0.0, corner, up,
        terms.reshape(count, SAMPLES_PER_PATCH, 3, 3), lengths.reshape(count, SAMPLES_PER_PATCH, 2),
    )  # fmt: skip


def _geometry_of_patches(surface: Surface, row: int, cols: range) -> np.ndarray:
    """Return the last four fields of ``PatchBounds`` of consecutive patches in a row of patches, float64 (n, k)."""
    world, grid, count = surface.world, surface.grid, len(cols)
    first = np.array([(row, col) for col in cols], np.float64) * PATCH_QUADS
    offset = np.arange(PARTS_PER_PATCH_SIDE + 1) * (PATCH_QUADS / PARTS_PER_PATCH_SIDE)
    corner_row, corner_col = np.broadcast_arrays(first[:, :1, None] + offset[:, None], first[:, 1:, None] + offset)
    corner, corner_up = world.points_at_zero_height(grid.crs, grid.x(corner_col), grid.y(corner_row))
    sample_row, sample_col = (first[:, k, None] + np.array(at) * PATCH_QUADS for k, at in enumerate(PATCH_SAMPLE_POSITIONS))
    _, up = world.points_at_zero_height(grid.crs, grid.x(sample_col), grid.y(sample_row))
    ends = [(0.0, 0.5), (0.0, -0.5), (0.5, 0.0), (-0.5, 0.0)]
    points = [world.points_at_zero_height(grid.crs, grid.x(sample_col + c), grid.y(sample_row + r))[0] for r, c in ends]
    right, down = points[0] - points[1], points[2] - points[3]
    terms = np.stack([np.cross(down, right), np.cross(down, up), np.cross(up, right)], axis=2)
    lengths = np.stack([np.linalg.norm(side, axis=-1) for side in (right, down)], axis=-1)
    return np.concatenate([values.reshape(count, -1) for values in (corner, corner_up, terms, lengths)], axis=1)


def _consecutive_ranges(numbers: list[int]) -> list[range]:
    """Group sorted, distinct integers into ranges of consecutive ones, each of at most ``MAX_RUN_PATCHES`` integers."""
    runs: list[range] = []
    for number in numbers:
        if runs and runs[-1].stop == number and len(runs[-1]) < MAX_RUN_PATCHES:
            runs[-1] = range(runs[-1].start, number + 1)
        else:
            runs.append(range(number, number + 1))
    return runs


_patch_cache: Cache[np.ndarray] = Cache(
    "skugga.terrain.casters.patch_bounds", "scene", 32 * MIB, lambda values: values.nbytes + 512
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
    out = np.empty((len(cols), PARTS_PER_PATCH, BOUNDS_PER_PART))
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
