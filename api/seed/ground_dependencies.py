"""Find the chunks of ground that the tiles of a block depend on: the visible ground, and occluders that can shade it.

Blocks are groups of tiles that are drawn together. Chunks are squares of a raster's cells (``ground_chunks``). A chunk can shade a
block under three conditions, seen from the sun:

* It lies within the block's width.
* It is not wholly below the block's lowest ground.
* It is not behind the whole block.

This is the rule of ``skugga.terrain.casters.reach``, applied to chunks by their own highest ground. So a new mountain counts as
soon as it is high enough. Margins cover what an algorithm adds to the shadow of ground. These are the sun's disc, refraction and,
for shadow maps, the patches of casters to which the maps are fitted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from skugga.api.products.product import Product
from skugga.api.seed.ground_chunks import CHUNK_DIGEST_BYTES, GroundChunks
from skugga.api.workers.block_views import block_of_grid
from skugga.shadows.ground_pictures import SKY_VIEW_PASS, TEXTURE_PASS
from skugga.shadows.plan import Plan
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.visibility import with_apparent_sun
from skugga.terrain.casters.caster_types import PATCH_QUADS
from skugga.terrain.casters.reach import FULL_DETAIL_NODES
from skugga.terrain.effects.texture_shading import texture_margin_px
from skugga.terrain.gbuffer.landforms import landform_margin_px
from skugga.terrain.gbuffer.supersampling import is_terrain_only
from skugga.terrain.geo.grid import BLOCK_PX, Grid
from skugga.terrain.geo.light_space import LightSpace, light_space
from skugga.terrain.geo.world import transformer
from skugga.terrain.ground.elevation import MAX_FILL_CELLS
from skugga.terrain.ground.sky_view_factor import sky_view
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene

GLOBAL_EFFECTS = frozenset({"clouds", "lamps", "sky_light"})
"""Effects that make a picture depend on ground anywhere."""

LATTICE_INTERVALS = 4
"""Intervals per side of the lattice of points that bounds a block's ground."""

MARGIN_PX, MARGIN_CELLS = 8, 8
"""Margins that a block's normals and bilinear heights need: pixels around the block, and cells around these pixels.

Texture shading and large landforms need more pixels (``texture_margin_px``, ``landform_margin_px``).
"""

SHADOW_MARGIN_DEG = 0.3
"""Angular margin of shadows: the sun's angular radius, plus terrestrial refraction over 100 km."""


@dataclass(frozen=True, eq=False)
class _ChunkPoints:
    """Chunks of a raster as points.

    Attributes
    ----------
    top_earth_m : (n, 3)
        Points above the chunks' middles at the height of their highest ground, in earth-fixed coordinates, metres.
    half_diagonal_m : (n,)
        Half of the chunks' diagonals, metres.
    """

    top_earth_m: np.ndarray
    half_diagonal_m: np.ndarray


@dataclass(frozen=True, eq=False)
class _SunlitChunks:
    """The chunks' highest points in light space, a frame whose third axis runs along the sun's rays.

    Attributes
    ----------
    light : LightSpace
        The light space of the sun.
    top_points_light_m : (n, 3)
        The highest point of each chunk, raised by the height of the tallest object.
    object_height_m : float
        Height of the tallest object on the ground, metres.
    is_per_point : bool
        Whether shadows are computed for each point separately, without maps that are fitted to casters.
    """

    light: LightSpace
    top_points_light_m: np.ndarray
    object_height_m: float
    is_per_point: bool


class GroundDependencies:
    """Compute digests of blocks. A block's digest changes with any ground that its tiles depend on."""

    def __init__(self, scene: Scene, chunks: GroundChunks) -> None:
        self._scene, self._chunks = scene, chunks
        self._points = _chunk_points(scene, chunks)
        self._cells: dict[tuple[Grid, int, int, int], tuple[float, float, float, float]] = {}

    def with_sun(self, scene: Scene) -> GroundDependencies:
        """Return a copy for the same ground under another sun. The positions of blocks on the ground are shared."""
        other = copy(self)
        other._scene = scene
        return other

    def digests(self, grid: Grid, blocks: Sequence[tuple[int, int]], plan: Plan | None, product: Product) -> list[bytes]:
        """Return a digest of the ground that each block's tiles depend on.

        Parameters
        ----------
        grid
            The tile matrix's grid.
        blocks
            Blocks (x, y) of the tile matrix.
        plan
            Plan that draws the blocks under the scene's sun; ``None`` for products of heights without light.
        product
            The tiles' product: shading of the ground depends on the sky above it, and some products on all ground.
        """
        sky = _SkyDigests(self._scene) if product.is_display and plan is not None and SKY_VIEW_PASS in plan.effect_names else None
        digests = []
        for (x, y), mask in zip(blocks, self.chunk_masks(grid, blocks, plan, product.sees_all_ground), strict=True):
            digest = hashlib.blake2b(digest_size=CHUNK_DIGEST_BYTES)
            digest.update(np.packbits(mask).tobytes())
            digest.update(self._chunks.digests[mask].tobytes())
            if sky is not None:
                digest.update(sky.digest_input(self._cells_of(grid, x, y)))
            digests.append(digest.digest())
        return digests

    def chunk_masks(
        self, grid: Grid, blocks: Sequence[tuple[int, int]], plan: Plan | None, sees_all_ground: bool
    ) -> list[np.ndarray]:
        """Return the chunks that each block depends on, as one bool mask (rows, cols) of chunks for each block.

        ``sees_all_ground`` is that of the product.
        """
        shape = self._chunks.low_m.shape
        if sees_all_ground or (plan is not None and plan.effect_names & GLOBAL_EFFECTS):
            return [np.ones(shape, np.bool_) for _ in blocks]
        sunlit = None if plan is None else self._sunlit_chunks(plan)
        has_texture = plan is not None and TEXTURE_PASS in plan.effect_names
        style = self._scene.style
        landforms_px = landform_margin_px() if plan is not None and (style.generalisation or style.local_light) else 0
        masks = []
        for x, y in blocks:
            texture_px = texture_margin_px(self._scene, block_of_grid(grid, x, y)) if has_texture else 0
            visible_chunks = self._visible_chunks(grid, x, y, MARGIN_PX + max(texture_px, landforms_px))
            masks.append(
                visible_chunks if sunlit is None else visible_chunks | self._shading_chunks(grid, x, y, visible_chunks, sunlit)
            )
        return masks

    def data_fractions(self, grid: Grid, blocks: Sequence[tuple[int, int]]) -> list[float]:
        """Return the approximate fraction of each block that lies on the raster, 0 to 1."""
        rows, cols = self._scene.elevation.shape
        shares = []
        for x, y in blocks:
            top, bottom, left, right = self._cells_of(grid, x, y)
            col_share = (min(right, cols) - max(left, 0)) / (right - left) if np.isfinite(right) else 1.0
            row_share = (min(bottom, rows) - max(top, 0)) / (bottom - top) if np.isfinite(bottom) else 1.0
            shares.append(float(np.clip(col_share, 0.0, 1.0) * np.clip(row_share, 0.0, 1.0)))
        return shares

    def _cells_of(self, grid: Grid, x: int, y: int, margin_px: int = MARGIN_PX) -> tuple[float, float, float, float]:
        """Return first and last row, and first and last column, of the raster below a block and its margin; infinite if unknown.

        ``x`` and ``y`` are the block's column and row in the tile matrix, counted in blocks.
        """
        key = grid, x, y, margin_px
        if key not in self._cells:
            self._cells[key] = self._compute_cells(*key)
        return self._cells[key]

    def _compute_cells(self, grid: Grid, x: int, y: int, margin_px: int) -> tuple[float, float, float, float]:
        """Return what ``_cells_of`` returns, without its cache.

        ``x`` and ``y`` are the block's column and row in the tile matrix, counted in blocks.
        """
        elevation = self._scene.elevation
        map_x, map_y = _lattice(grid, x, y, margin_px)
        if grid.crs != elevation.crs:
            map_x, map_y = transformer(grid.crs, elevation.crs).transform(map_x, map_y)
        row, col = elevation.cell_of(map_x, map_y)
        if not np.isfinite(row).all() or not np.isfinite(col).all():
            return -np.inf, np.inf, -np.inf, np.inf
        cells_per_node = max(2.0 ** self._scene.surface(grid).lod, 1.0)
        margin = cells_per_node * (MARGIN_CELLS + (MAX_FILL_CELLS if self._chunks.has_nodata else 0))
        margins = [0.01 * np.ptp(values) + margin for values in (row, col)]  # margin for curved sides of a block
        if elevation.crs.is_geographic and (np.ptp(col) > elevation.cols / 2 or col.min() < 0 or col.max() > elevation.cols):
            return row.min() - margins[0], row.max() + margins[0], -np.inf, np.inf  # it may lie across the antimeridian
        return row.min() - margins[0], row.max() + margins[0], col.min() - margins[1], col.max() + margins[1]

    def _visible_chunks(self, grid: Grid, x: int, y: int, margin_px: int) -> np.ndarray:
        """Return the chunks whose ground a block shows, with a margin, as a bool mask (rows, cols) of chunks."""
        top, bottom, left, right = self._cells_of(grid, x, y, margin_px)
        rows, cols = self._chunks.low_m.shape
        first_row, first_col = np.arange(rows) * self._chunks.side, np.arange(cols) * self._chunks.side
        in_rows = (first_row <= bottom + 0.5) & (first_row + self._chunks.side > top - 0.5)
        in_cols = (first_col <= right + 0.5) & (first_col + self._chunks.side > left - 0.5)
        return in_rows[:, None] & in_cols[None, :]

    def _sunlit_chunks(self, plan: Plan) -> _SunlitChunks | None:
        """Return the chunks' highest points in light space; ``None`` if the plan casts no shadow of the sun."""
        scene = with_apparent_sun(self._scene, plan.effect_names)
        if scene.sun is None or not scene.sun_is_up or not plan.casts_shadows:
            return None
        light, object_height_m = light_space(scene.world, scene.sun), scene.objects.tallest_object_m
        top_points_light_m = light.points_from_earth(
            self._points.top_earth_m + object_height_m * _unit_vectors(self._points.top_earth_m)
        )
        # Algorithms with OpenGL fit their maps to all casters; the others compute each point separately.
        uses_fitted_maps = any(ALGORITHMS[step.algorithm].needs_opengl for step in plan.steps)
        return _SunlitChunks(light, top_points_light_m, object_height_m, is_terrain_only(scene) and not uses_fitted_maps)

    def _shading_chunks(self, grid: Grid, x: int, y: int, visible_chunks: np.ndarray, sunlit: _SunlitChunks) -> np.ndarray:
        """Return the chunks that can cast a shadow on a block whose ground lies in ``visible_chunks``.

        Both are bool masks (rows, cols) of chunks. ``x`` and ``y`` are the block's column and row in the tile matrix, counted in
        blocks.
        """
        scene, with_heights = self._scene, visible_chunks & np.isfinite(self._chunks.low_m)
        if not with_heights.any():
            return np.zeros(visible_chunks.shape, np.bool_)
        low_m, high_m = (
            float(self._chunks.low_m[with_heights].min()),
            float(self._chunks.high_m[with_heights].max()) + sunlit.object_height_m,
        )
        map_x, map_y = _lattice(grid, x, y)
        point, up = (values.reshape(-1, 3) for values in scene.world.points_at_zero_height(grid.crs, map_x, map_y))
        valid = np.isfinite(point).all(axis=1)
        if not valid.any():
            return np.ones(visible_chunks.shape, np.bool_)
        receivers = sunlit.light.points_from_earth(
            np.concatenate([point[valid] + height * up[valid] for height in (low_m, high_m)])
        )
        lower, upper, top_points_light_m = receivers.min(axis=0), receivers.max(axis=0), sunlit.top_points_light_m
        distance_m = np.maximum(upper[2] - top_points_light_m[:, 2], 0.0)
        margin_m = self._points.half_diagonal_m + np.tan(np.radians(SHADOW_MARGIN_DEG)) * distance_m
        if not sunlit.is_per_point:
            step_m = map_pixel_m(scene.world, block_of_grid(grid, x, y))
            margin_m = margin_m + np.maximum(PATCH_QUADS * step_m, distance_m * 2.0 * PATCH_QUADS / FULL_DETAIL_NODES) * np.sqrt(
                2.0
            )
        can_shade = (
            (top_points_light_m[:, 0] >= lower[0] - margin_m) & (top_points_light_m[:, 0] <= upper[0] + margin_m)
            & (top_points_light_m[:, 1] >= lower[1] - margin_m) & (top_points_light_m[:, 2] <= upper[2] + margin_m)
        )  # fmt: skip
        return can_shade.reshape(visible_chunks.shape)


class _SkyDigests:
    """Digest input for the share of the sky that the ground hides. The shading of the ground depends on it."""

    def __init__(self, scene: Scene) -> None:
        self._view = sky_view(scene.elevation, scene.world)

    def digest_input(self, cell_range: tuple[float, float, float, float]) -> bytes:
        """Return the occlusion values at the nodes below some cells (first and last row, first and last column), as bytes.

        A margin is included, because wide pixels average values around them.
        """
        side, (rows, cols) = 2**self._view.lod, self._view.occlusion.shape
        margin = max((cell_range[1] - cell_range[0]) / side / 32.0, 2.0)  # a pixel is about a thousandth of a block's side
        ends = []
        for low, high, count in ((cell_range[0], cell_range[1], rows), (cell_range[2], cell_range[3], cols)):
            ends.append(slice(int(np.clip(low / side - margin, 0, count)), int(np.clip(high / side + margin + 1.0, 0, count))))
        return self._view.occlusion[ends[0], ends[1]].tobytes()


def _chunk_points(scene: Scene, chunks: GroundChunks) -> _ChunkPoints:
    """Return the chunks of a raster as points on the earth, in rows from the first chunk on."""
    elevation, (rows, cols), side = scene.elevation, chunks.low_m.shape, chunks.side
    ends = [np.minimum(np.arange(count + 1) * side, size) - 0.5 for count, size in ((rows, elevation.rows), (cols, elevation.cols))]
    corner_col, corner_row = np.meshgrid(ends[1], ends[0])
    corners, _ = scene.world.points_at_zero_height(elevation.crs, *elevation.xy(corner_row, corner_col))
    middle_col, middle_row = np.meshgrid((ends[1][1:] + ends[1][:-1]) / 2, (ends[0][1:] + ends[0][:-1]) / 2)
    middles, up = scene.world.points_at_zero_height(elevation.crs, *elevation.xy(middle_row, middle_col))
    half_diagonal_m = np.max(
        [np.linalg.norm(corners[i : i + rows, j : j + cols] - middles, axis=-1) for i in (0, 1) for j in (0, 1)], axis=0
    )
    top = middles + chunks.high_m[..., None].astype(np.float64) * up  # NaN without ground: it shades nothing
    return _ChunkPoints(top.reshape(-1, 3), half_diagonal_m.ravel())


def _lattice(grid: Grid, x: int, y: int, margin_px: int = MARGIN_PX) -> tuple[np.ndarray, np.ndarray]:
    """Return map coordinates x and y of a regular lattice of points over a block and a small margin.

    ``x`` and ``y`` are the block's column and row in the tile matrix of ``grid``, counted in blocks.
    """
    steps = np.linspace(-margin_px, BLOCK_PX + margin_px, LATTICE_INTERVALS + 1)
    col, row = np.meshgrid(x * BLOCK_PX + steps, y * BLOCK_PX + steps)
    return grid.x(col), grid.y(row)


def _unit_vectors(point_earth_m: np.ndarray) -> np.ndarray:
    """Return unit vectors (n, 3) from the earth's centre to points (n, 3) in earth-fixed coordinates, metres.

    They approximate the vertical well enough to place the tops of tall objects.
    """
    return point_earth_m / np.linalg.norm(point_earth_m, axis=-1, keepdims=True)
