"""The ground that forms the horizons of a block of a level's map: the block and its surroundings, and coarser ground beyond.

Near the block the ground has the nodes of the block's grid, up to ``NEAR_NODES`` from the block. Rays are straight there in the
plane that touches the grid at the block's centre; blocks are so small that true north turns by less than ``MAX_CONVERGENCE_DEG`` in
them. Beyond it the ground is read on nodes twice as far apart, up to twice that distance, and so on, as for casters of shadows
(``skugga.terrain.casters.reach``). Its nodes lie in the azimuthal equidistant projection round the block's centre, in which
azimuths and distances from there are true. It ends with the raster, or where the curved level hides the level's highest ground.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.shadows.horizons.grid import FarGround, HorizonGrid
from skugga.terrain.casters.ground_extent import ground_extent
from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import World, transformer
from skugga.terrain.ground.surface import Surface
from skugga.terrain.scene import Scene

BLOCK_SIDE_NODES, MIN_BLOCK_SIDE_NODES = 2048, 128
"""Side of a block, and the smallest one where the meridians' convergence limits it."""

MAX_BLOCK_BYTES = 320 * 2**20
"""Maximum bytes of the horizons of a block that are in memory at the same time, as float32."""

NEAR_NODES = 512
"""Distance from a block up to which the ground has the nodes of the block's grid; as many coarser nodes follow each time."""

MAX_CONVERGENCE_DEG = 0.15
"""Maximum angle between the grid's axes against true north in a block's middle and in its corners."""

MAX_NEAR_M = 40e3
"""Distance from a block, metres, up to which the plane at its centre stands for the curved grid."""

SPARSE_NODES = 32
"""Distance of the nodes of far ground whose positions are transformed; those between them are interpolated."""

MAX_FAR_STEPS = 16
"""Maximum number of doublings of the distance between nodes."""


@dataclass(frozen=True, eq=False)
class BlockPlane:
    """The plane that touches the map's grid at a block's centre.

    Attributes
    ----------
    east_north_of_cell_m
        (2, 2), metres: east and north (rows) of a step to the next row and to the next column (columns), on the ground.
    center_earth_m, earth_from_enu
        The centre at height 0, earth-fixed (3,), and the rotation (3, 3) whose columns are east, north and up there.
    """

    east_north_of_cell_m: np.ndarray
    center_earth_m: np.ndarray
    earth_from_enu: np.ndarray


def block_plane(world: World, view: MapView, row: float, col: float) -> BlockPlane:
    """Return the plane at a (fractional) node of a view's grid."""
    rows, cols = np.array([row, row + 0.5, row - 0.5, row, row]), np.array([col, col, col, col + 0.5, col - 0.5])
    points, ups = world.points_at_zero_height(view.grid.crs, view.grid.x(cols), view.grid.y(rows))
    earth_from_enu = world.earth_from_enu(points[0], ups[0])
    steps = np.stack([points[1] - points[2], points[3] - points[4]]) @ earth_from_enu
    return BlockPlane(steps[:, :2].T, points[0], earth_from_enu)


def horizon_blocks(
    scene: Scene, view: MapView, kept_azimuths: int = 1, max_convergence_deg: float = MAX_CONVERGENCE_DEG
) -> list[tuple[MapView, int, int]]:
    """Return the blocks of a map for horizons, in the form that ``skugga.terrain.geo.grid.blocks_of`` returns.

    ``kept_azimuths`` is the number of azimuths whose horizons are in memory at the same time. In a block true north turns against
    the grid by at most ``max_convergence_deg``.
    """
    nodes = view.with_pixels_as_nodes()
    max_side = 2 ** int(np.log2(np.sqrt(MAX_BLOCK_BYTES / (4.0 * kept_azimuths))))
    side = min(_block_side(scene.world, nodes, max_convergence_deg), max_side)
    blocks = []
    for row in range(0, nodes.rows, side):
        for col in range(0, nodes.cols, side):
            blocks.append((nodes.part(row, col, min(side, nodes.rows - row), min(side, nodes.cols - col)), row, col))
    return blocks


def _block_side(world: World, nodes: MapView, max_convergence_deg: float) -> int:
    """Return the side of blocks in nodes, in which the axes of the grid turn little against true north."""
    side = BLOCK_SIDE_NODES
    if world.is_flat:
        return side
    row, col = nodes.centre_node
    while side > MIN_BLOCK_SIDE_NODES:
        half_rows, half_cols = min(side, nodes.rows) / 2.0, min(side, nodes.cols) / 2.0
        angles = []
        for down, right in ((0, 0), (-1, -1), (-1, 1), (1, -1), (1, 1)):
            cell = block_plane(world, nodes, row + down * half_rows, col + right * half_cols).east_north_of_cell_m
            angles.append(np.degrees(np.arctan2(cell[1, 1], cell[0, 1])))
        turn = np.abs((np.array(angles[1:]) - angles[0] + 180.0) % 360.0 - 180.0)
        if np.isfinite(turn).all() and turn.max() <= max_convergence_deg:
            return side
        side //= 2
    return side


def block_grid(scene: Scene, block: MapView) -> HorizonGrid:
    """Return the ground that forms the horizons of a block's nodes, with eyes on the nodes that show ground."""
    world, elevation = scene.world, scene.elevation
    plane = block_plane(world, block, *block.centre_node)
    cell_m = float(np.sqrt(abs(np.linalg.det(plane.east_north_of_cell_m))))
    near = int(np.clip(MAX_NEAR_M / cell_m, 1, NEAR_NODES))
    row0, col0 = int(block.row0), int(block.col0)
    (top, bottom), (left, right) = _ground_rows_and_columns(scene, block)
    up, down = min(near, max(-top, 0)), min(near, max(bottom - (block.rows - 1), 0))
    before, after = min(near, max(-left, 0)), min(near, max(right - (block.cols - 1), 0))
    surface = Surface(world, elevation, block.grid)
    window = surface.height_window(row0 - up, col0 - before, block.rows + up + down, block.cols + before + after, includes_rim=True)
    eyes = slice(up, up + block.rows), slice(before, before + block.cols)
    is_all = up == max(-top, 0) and down == max(bottom - block.rows + 1, 0)
    is_all &= before == max(-left, 0) and after == max(right - block.cols + 1, 0)
    far = () if is_all else tuple(_far_ground(scene, block, plane, cell_m, near, (up, down, before, after)))
    return HorizonGrid(window.height_m, plane.east_north_of_cell_m, world.curvature, eyes, shows_ground=window.valid, far=far)


def _ground_rows_and_columns(scene: Scene, block: MapView) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first and last row, and the first and last column, that may have ground, counted from the block's first node."""
    limit = 2**30
    return tuple(  # type: ignore[return-value]
        (int(np.clip(np.floor(low), -limit, limit)), int(np.clip(np.ceil(high), -limit, limit)))
        for low, high in ground_extent(scene, block)
    )


def _far_ground(
    scene: Scene, block: MapView, plane: BlockPlane, cell_m: float, near: int, margins: tuple[int, int, int, int]
) -> list[FarGround]:
    """Return the ground beyond the near ground, from fine to coarse, without that which finer nodes show.

    ``margins`` are the nodes of near ground above, below, left and right of the block.
    """
    low_m, high_m = scene.height_range_m
    farthest_m = longest_shadow_m(max(high_m - low_m, 1.0), 0.0, not scene.world.is_flat, scene.world.radius_m)
    up, down, before, after = margins
    inner = -up, block.rows - 1 + down, -before, block.cols - 1 + after  # rows and columns of finer ground, from the first eye
    out: list[FarGround] = []
    for step in range(0 if near < NEAR_NODES else 1, MAX_FAR_STEPS):
        factor = 2**step
        reach = int(min(NEAR_NODES * factor, np.ceil(farthest_m / cell_m)))
        reach = -(-reach // factor) * factor
        rows = np.arange(-(reach // factor), (block.rows - 1 + reach) // factor + 1)
        cols = np.arange(-(reach // factor), (block.cols - 1 + reach) // factor + 1)
        height_m = _heights_in_plane(scene, block, plane, rows * factor, cols * factor, factor)
        is_inner_row = (rows * factor > inner[0]) & (rows * factor < inner[1])
        is_inner_col = (cols * factor > inner[2]) & (cols * factor < inner[3])
        height_m[np.ix_(is_inner_row, is_inner_col)] = np.nan
        if np.isfinite(height_m).any():
            out.append(_cropped(FarGround(height_m, factor, (int(rows[0]), int(cols[0]))), block))
        inner = int(rows[0]) * factor, int(rows[-1]) * factor, int(cols[0]) * factor, int(cols[-1]) * factor
        ground_rows, ground_cols = _ground_rows_and_columns(scene, block)
        is_all = (
            inner[0] <= ground_rows[0] and inner[1] >= ground_rows[1] and inner[2] <= ground_cols[0] and inner[3] >= ground_cols[1]
        )
        if is_all or reach * cell_m >= farthest_m:
            break
    return out


def _cropped(far: FarGround, block: MapView) -> FarGround:
    """Return far ground without its outer rows and columns that have neither ground nor eyes of the block."""
    known = np.isfinite(far.height_m)
    starts, ends = [], []
    for axis, nodes in enumerate((block.rows, block.cols)):
        has_ground = np.flatnonzero(known.any(axis=1 - axis))
        first_eye, last_eye = -far.first_node[axis], -far.first_node[axis] - (-(nodes - 1) // far.factor)
        starts.append(min(int(has_ground[0]), first_eye))
        ends.append(max(int(has_ground[-1]), last_eye) + 1)
    height_m = np.ascontiguousarray(far.height_m[starts[0] : ends[0], starts[1] : ends[1]])
    return FarGround(height_m, far.factor, (far.first_node[0] + starts[0], far.first_node[1] + starts[1]))


def _heights_in_plane(
    scene: Scene, block: MapView, plane: BlockPlane, rows: np.ndarray, cols: np.ndarray, factor: int
) -> np.ndarray:
    """Return heights, float32 (rows, cols), metres, at nodes in the plane of a block, counted from its first one.

    East and north in the plane are those of the azimuthal equidistant projection round the block's centre.
    """
    sparse_row, sparse_col = (np.unique(np.append(np.arange(0, len(axis), SPARSE_NODES), len(axis) - 1)) for axis in (rows, cols))
    down, right = rows[sparse_row] - (block.rows - 1) / 2.0, cols[sparse_col] - (block.cols - 1) / 2.0
    east_m, north_m = np.einsum("ij,jrc->irc", plane.east_north_of_cell_m, np.stack(np.meshgrid(down, right, indexing="ij")))
    row, col = _cells_of_plane(scene, plane, east_m, north_m)
    dense = [_interpolated(axis, sparse_row, sparse_col, len(rows), len(cols)) for axis in (row, col)]
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    node_m = float(np.sqrt(abs(np.linalg.det(plane.east_north_of_cell_m)))) * factor
    lod = max(int(np.floor(np.log2(max(node_m / cell_m, 1.0)) + 1e-6)), 0)
    height_m, _ = scene.elevation.heights_at(lod, *dense)
    return np.array(height_m, np.float32)


def _cells_of_plane(scene: Scene, plane: BlockPlane, east_m: np.ndarray, north_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (fractional) rows and columns of the raster at positions in a block's plane; NaN outside of its CRS's area."""
    world, elevation = scene.world, scene.elevation
    if world.is_flat:
        points = plane.center_earth_m + np.stack([east_m, north_m, np.zeros_like(east_m)], axis=-1)
        x, y, _ = world.map_position(elevation.crs, points)
        return elevation.cell_of(x, y)
    lon, lat, _ = world.map_position(elevation.crs.geodetic_crs or elevation.crs, plane.center_earth_m[None])
    ellipsoid = world.ellipsoid
    around = CRS.from_dict({"proj": "aeqd", "lat_0": float(lat[0]), "lon_0": float(lon[0]), "a": ellipsoid.a, "b": ellipsoid.b})
    x, y = (np.asarray(axis, np.float64) for axis in transformer(around, elevation.crs).transform(east_m, north_m))
    if elevation.crs.is_geographic:  # without a jump at the antimeridian
        center_x = transformer(around, elevation.crs).transform(0.0, 0.0)[0]
        x = center_x + (x - center_x + 180.0) % 360.0 - 180.0
    row, col = elevation.cell_of(x, y)
    outside = ~(np.isfinite(row) & np.isfinite(col))
    return np.where(outside, np.nan, row), np.where(outside, np.nan, col)


def _interpolated(values: np.ndarray, sparse_row: np.ndarray, sparse_col: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Return values (rows, cols), bilinear between those at some rows and columns."""
    by_col = np.stack([np.interp(np.arange(cols), sparse_col, line) for line in values])
    upper = np.clip(np.searchsorted(sparse_row, np.arange(rows), side="right") - 1, 0, max(len(sparse_row) - 2, 0))
    lower = np.minimum(upper + 1, len(sparse_row) - 1)
    share = (np.arange(rows) - sparse_row[upper]) / np.maximum(sparse_row[lower] - sparse_row[upper], 1)
    out: np.ndarray = by_col[upper] + share[:, None] * (by_col[lower] - by_col[upper])
    return out
