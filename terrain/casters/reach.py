"""Find the ground that can cast a shadow on a block of a map, and the reach: how far towards the sun such ground lies.

Receivers are the points of the block that can be shaded. All tests are in light space (axes right, up and away from the sun), where
points include the earth's curvature. Seen from the sun, ground can shade a block if three conditions hold: it is nearer than the
block's farthest receiver, it lies within the block's width, and it is not wholly below the lowest receiver.

* Candidates are cells of the raster's overview, a coarse copy with the highest ground of each cell. Where the block is small in
  comparison, finer cells replace them (``skugga.terrain.casters.fine_cells``).
* The casting ground is then read on the block's own grid, so that neighbouring blocks have identical casters. Up to
  ``FULL_DETAIL_NODES`` from the block it has full detail, beyond that half of it, and half again at each doubling of the distance.
  On a grid that is much finer than the raster full detail ends sooner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.terrain.casters.caster_types import NO_CASTERS, PATCH_QUADS, Casters, Patch, Reach, Receivers
from skugga.terrain.casters.fine_cells import fine_cells
from skugga.terrain.casters.overview_cells import CELL_MARGIN_WIDTHS, columns_per_turn, overview_light_space, overview_on_grid
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.light_space import LightSpace, light_bounds
from skugga.terrain.geo.sun import azimuth_and_altitude
from skugga.terrain.geo.world import EARTH_RADIUS_M, LONGITUDE_LATITUDE, is_longitude_latitude, transformer
from skugga.terrain.ground.columns import ColumnWindow
from skugga.terrain.ground.surface import NodeHeights
from skugga.terrain.scene import Scene

FULL_DETAIL_NODES = 4096
"""Maximum distance in nodes from a block at which casters are read on the block's own grid. Up to twice as far they have half its
detail, and so on.
"""

MAX_FULL_DETAIL_NODES_PER_CELL, MIN_FULL_DETAIL_NODES = 16, 2 * PATCH_QUADS
"""Number of grid nodes per side of a raster cell above which full detail ends sooner, and the minimum distance in nodes at which it
ends. The distance falls in proportion to the number of nodes per cell. Nodes that are denser than cells only repeat the raster's
bilinear surface. Without this rule maps with pixels of centimetres would read millions of patches.
"""

MAX_CELL_HALF_WIDTH_NODES = PATCH_QUADS / 4
"""Half the width of an overview cell, in nodes of the block's grid, above which finer cells replace the cell."""

UNKNOWN_RELIEF_M = 1500.0
"""Assumed maximum height, metres, of unknown ground beyond the raster above a block's lowest point.

Where the level's own ground rises higher above that point, its height is assumed instead.
"""


def longest_shadow_m(relief_m: float, altitude_deg: float, is_curved: bool = True, radius_m: float = EARTH_RADIUS_M) -> float:
    """Return the length, metres, of the longest shadow that ground of the height range ``relief_m`` can cast.

    It is the solution L of H = L tan(a) + L^2 / 2R. H is ``relief_m``, a the sun's altitude and R ``radius_m``, the earth's radius.
    Without ``is_curved`` the term with R is left out. Terrestrial refraction is neglected. The result is infinite for a sun at the
    horizon of flat ground.
    """
    if relief_m <= 0:
        return 0.0
    slope = np.tan(np.radians(max(altitude_deg, 0.0)))
    if not is_curved:
        return float(relief_m / slope) if slope > 0 else np.inf
    return float(radius_m * (np.sqrt(slope**2 + 2.0 * relief_m / radius_m) - slope))


SUNWARD_RAY_ORIGIN_COUNT = 64
"""Approximate number of points of a perspective view from which the raster's extent towards the sun is measured."""


def find_casters(scene: Scene, buffer: GeometryBuffer) -> Casters:
    """Find the ground outside a map's block that can shade the block, from the sun or from lamps, and the reach.

    For a perspective view the result has no patches, because its buffer already holds all ground.
    """
    if not isinstance(buffer.view, MapView):
        return Casters((), find_reach(scene, buffer))
    towards_lamps = _lamp_patches(scene, buffer) if buffer.valid.any() else ()
    if not _needs_sun_casters(scene, buffer):
        return Casters(towards_lamps, NO_CASTERS.reach)
    patches, caster_m = _occluder_patches(scene, buffer)
    return Casters(tuple(dict.fromkeys((*patches, *towards_lamps))), _reach(scene, buffer, caster_m))


def find_reach(scene: Scene, buffer: GeometryBuffer) -> Reach:
    """Return the reach of the sun's casters for a buffer that already holds all ground, such as that of a perspective view."""
    if not _needs_sun_casters(scene, buffer):
        return NO_CASTERS.reach
    return _reach(scene, buffer, _sunward_extent_m(scene, buffer, _occluder_cell_mask(scene, buffer)))


def find_reach_of_nodes(scene: Scene, nodes: BareNodes) -> Reach:
    """Return the reach of the sun's casters for a map's nodes of bare ground (ground without objects)."""
    if not _needs_sun_casters(scene, nodes):
        return NO_CASTERS.reach
    return _reach(scene, nodes, _sunward_extent_m(scene, nodes, _find_occluder_cells(scene, nodes)[0]))


def find_sun_casters(scene: Scene, receivers: Receivers) -> tuple[Patch, ...]:
    """Return the patches of ground outside a map's block that can shade the block from the sun."""
    if not _needs_sun_casters(scene, receivers):
        return ()
    return _occluder_patches(scene, receivers)[0]


def _needs_sun_casters(scene: Scene, buffer: Receivers) -> bool:
    """Return whether the sun is up and a buffer has points that it can light."""
    return scene.light_space is not None and scene.sun_is_up and bool(buffer.valid.any())


def _occluder_cell_mask(scene: Scene, buffer: Receivers) -> np.ndarray:
    """Return the mask (rows, cols) of the overview's cells whose ground may lie between a buffer's points and the sun."""
    light, slack = overview_light_space(scene)
    return _is_towards_sun(scene, buffer, light, slack)


def _is_towards_sun(scene: Scene, buffer: Receivers, light_space_m: np.ndarray, slack_m: float) -> np.ndarray:
    """Return which points in light space (..., 3) may lie between a buffer's points and the sun, bool (...).

    The region between them is the bounding box of the buffer's points, extended without limit towards the sun and upwards. Points
    within ``slack_m`` of the region count, too.
    """
    assert scene.light_space is not None
    low, high = light_bounds(buffer.position_frame_m, buffer.valid, *scene.light_space.transform_from_frame(buffer.frame))
    is_towards_sun: np.ndarray = (
        (light_space_m[..., 0] >= low[0] - slack_m) & (light_space_m[..., 0] <= high[0] + slack_m)
        & (light_space_m[..., 1] >= low[1] - slack_m) & (light_space_m[..., 2] <= high[2] + slack_m)
    )  # fmt: skip
    return is_towards_sun


def _reach(scene: Scene, buffer: GeometryBuffer | BareNodes, caster_m: float) -> Reach:
    """Return the reach of the sun's casters. ``caster_m`` is the distance of the farthest known caster from the buffer's points."""
    is_generated = scene.loaded.level.terrain.source is None  # generated ground has no unknown ground beyond its edge
    limit_m, unknown_m = (caster_m, caster_m) if is_generated else _data_and_shadow_limits_m(scene, buffer)
    if limit_m >= unknown_m:
        return Reach(caster_m, caster_m, False)
    return Reach(limit_m, unknown_m, True)


def _grid_and_ground(buffer: Receivers) -> tuple[Grid, NodeHeights | ColumnWindow]:
    """Return the grid of the ground of a map's block, and the block's own ground on that grid.

    For ground of upright columns it is the grid of the raster's cells, else that of the map.
    """
    if buffer.columns is not None:
        return buffer.columns.window.columns.grid, buffer.columns.window
    assert isinstance(buffer.view, MapView) and buffer.surface is not None
    return buffer.view.grid, buffer.surface


def _lamp_patches(scene: Scene, buffer: Receivers) -> tuple[Patch, ...]:
    """Return the patches between a block and each lamp of the level, at full detail, without those within the block.

    Patches farther than ``FULL_DETAIL_NODES`` from the block are left out.
    """
    grid, block_ground = _grid_and_ground(buffer)
    rows, cols = block_ground.shape
    patches: dict[Patch, None] = {}
    for lamp in scene.lamps.values():
        x, y, _ = scene.world.map_position(grid.crs, lamp.position_earth_m)
        row, col = grid.row(float(y)), grid.col(float(x))
        if not np.isfinite(row + col):
            continue
        ends = []
        for index, first, count in ((row, block_ground.row0, rows), (col, block_ground.col0, cols)):
            low = max(min(index, first), first - FULL_DETAIL_NODES)
            high = min(max(index, first + count - 1), first + count + FULL_DETAIL_NODES)
            ends.append(range(int(np.floor(low / PATCH_QUADS)), int(np.floor(high / PATCH_QUADS)) + 1))
        for r in ends[0]:
            for c in ends[1]:
                if not _is_inside_window(
                    r * PATCH_QUADS, c * PATCH_QUADS, PATCH_QUADS, block_ground.row0, block_ground.col0, rows, cols
                ):
                    patches[Patch(0, r, c)] = None
    return tuple(patches)


def _sunward_extent_m(scene: Scene, buffer: Receivers, occluder_mask: np.ndarray) -> float:
    """Return how far the overview's cells that the mask ``occluder_mask`` selects extend towards the sun, metres, 0 or more.

    The distance is horizontal, and counts from the receiver of the buffer that is nearest to the sun.
    """
    assert scene.light_space is not None
    if not occluder_mask.any():
        return 0.0
    towards = scene.light_space.horizontal_sunward_m(overview_light_space(scene)[0][occluder_mask])
    return max(float(towards.max()) - _sunward_edge_m(scene.light_space, buffer), 0.0)


@dataclass(frozen=True, eq=False)
class _OccluderCells:
    """Overview cells that can shade a block.

    Attributes
    ----------
    row, col
        float64 (n,), rows and columns of the cells' centres on the block's grid, in nodes.
    half_extent_nodes
        float64 (n,), half the cells' widths with a margin, in nodes.
    distance_nodes
        float64 (n,), distances of the cells' centres from the block, in nodes; 0 on it.
    """

    row: np.ndarray
    col: np.ndarray
    half_extent_nodes: np.ndarray
    distance_nodes: np.ndarray


def _find_occluder_cells(scene: Scene, buffer: Receivers) -> tuple[np.ndarray, _OccluderCells]:
    """Find the overview's cells whose ground can shade a block.

    The first result is the mask (rows, cols) of these cells, without those under the block. The second one also includes cells
    under the block. It has finer cells where the overview's cells are larger than ``MAX_CELL_HALF_WIDTH_NODES``.
    """
    occluder_mask = _occluder_cell_mask(scene, buffer)
    grid, block_ground = _grid_and_ground(buffer)
    row, col, half_extent_nodes = overview_on_grid(scene.world, scene.elevation, grid)
    occluder_mask = occluder_mask & np.isfinite(row) & np.isfinite(col) & np.isfinite(half_extent_nodes)
    row, col, half_extent_nodes = row[occluder_mask], col[occluder_mask], half_extent_nodes[occluder_mask]
    rows, cols = block_ground.shape
    period = columns_per_turn(grid)
    if period is not None and len(col):
        col = col + period * np.rint((block_ground.col0 + cols / 2 - np.median(col)) / period)
    outside = occluder_mask.copy()
    outside[occluder_mask] = _node_distances(block_ground, row, col) > 0
    if len(half_extent_nodes) and float(np.median(half_extent_nodes)) > MAX_CELL_HALF_WIDTH_NODES:
        assert scene.light_space is not None
        finer_cells = fine_cells(scene, scene.light_space, grid, occluder_mask, (col, half_extent_nodes), period)
        if finer_cells is not None:
            selected = (
                _is_towards_sun(scene, buffer, finer_cells.light_space_m, finer_cells.width_m * CELL_MARGIN_WIDTHS)
                & np.isfinite(finer_cells.row)
                & np.isfinite(finer_cells.col)
            )
            row, col, half_extent_nodes = (
                finer_cells.row[selected],
                finer_cells.col[selected],
                finer_cells.half_extent_nodes[selected],
            )
    return outside, _OccluderCells(row, col, half_extent_nodes, _node_distances(block_ground, row, col))


def _node_distances(block_ground: NodeHeights | ColumnWindow, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return the distances (n,) of rows and columns (n,) of a grid from a block's own ground, in nodes; 0 on the ground."""
    rows, cols = block_ground.shape
    side_distances = [
        block_ground.row0 - row,
        row - (block_ground.row0 + rows - 1),
        block_ground.col0 - col,
        col - (block_ground.col0 + cols - 1),
        np.zeros_like(row),
    ]
    distance: np.ndarray = np.maximum.reduce(side_distances)
    return distance


def _occluder_patches(scene: Scene, buffer: Receivers) -> tuple[tuple[Patch, ...], float]:
    """Return the patches that contain ground which can shade the block, and the distance of the farthest such ground.

    The patches are those that the overview's shading cells overlap. The distance is measured towards the sun, in metres. A cell may
    be larger than a patch. So it gives patches of several levels of detail, each within the range of distances of that level.
    """
    outside, cells = _find_occluder_cells(scene, buffer)
    (grid, block_ground), row, col, half_extent_nodes, distance = (
        _grid_and_ground(buffer),
        cells.row,
        cells.col,
        cells.half_extent_nodes,
        cells.distance_nodes,
    )
    rows, cols = block_ground.shape
    assert scene.light_space is not None
    caster_m = _sunward_extent_m(scene, buffer, outside)
    relief_m, altitude_deg = np.ptp(scene.height_range_m), scene.light_space.altitude_deg
    longest_m = longest_shadow_m(relief_m, altitude_deg, not scene.world.is_flat, scene.world.radius_m)
    farthest = min(float(distance.max(initial=0.0)), 1.5 * longest_m / scene.surface(grid).step_m) + half_extent_nodes.max(
        initial=0.0
    )
    patches: list[Patch] = []
    full_detail_nodes = _full_detail_nodes(scene, grid)
    lod, near = 0, 0
    while near < farthest or lod == 0:
        far, quads = full_detail_nodes * 2**lod, PATCH_QUADS * 2**lod
        limits = (
            (block_ground.row0 - far, block_ground.row0 + rows + far),
            (block_ground.col0 - far, block_ground.col0 + cols + far),
        )
        low, high = (
            np.stack([np.clip(v + side * half_extent_nodes, *limit) for v, limit in zip((row, col), limits, strict=True)], axis=1)
            for side in (-1, 1)
        )
        is_in_range = (low < high).all(axis=1)
        spans = np.concatenate([np.floor(low[is_in_range] / quads), np.floor(high[is_in_range] / quads)], axis=1).astype(np.int64)
        level_patches = {
            Patch(lod, r, c)
            for top, left, bottom, right in _unique_rows(spans)
            for r in range(top, bottom + 1)
            for c in range(left, right + 1)
            if not _is_inside_window(
                r * quads, c * quads, quads, block_ground.row0 - near, block_ground.col0 - near, rows + 2 * near, cols + 2 * near
            )
        }
        patches += _patches_that_may_shade(scene, buffer, sorted(level_patches, key=lambda patch: (patch.row, patch.col)))
        lod, near = lod + 1, far
    return tuple(patches), caster_m


def _full_detail_nodes(scene: Scene, grid: Grid) -> int:
    """Return the distance from a block, in nodes, within which casters are read on the block's own grid."""
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    share = MAX_FULL_DETAIL_NODES_PER_CELL * scene.surface(grid).step_m / cell_m
    return int(np.clip(FULL_DETAIL_NODES * share, MIN_FULL_DETAIL_NODES, FULL_DETAIL_NODES))


def _patches_that_may_shade(scene: Scene, buffer: Receivers, patches: list[Patch]) -> list[Patch]:
    """Select the patches that could shade the block if they were as high as the level's highest ground.

    All patches must have the same level of detail.
    """
    if not patches:
        return []
    assert scene.light_space is not None
    (grid, _), quads = _grid_and_ground(buffer), PATCH_QUADS * 2 ** patches[0].lod
    middle = np.array([(patch.row, patch.col) for patch in patches]) * quads + quads / 2
    point, up = scene.world.points_at_zero_height(grid.crs, grid.x(middle[:, 1]), grid.y(middle[:, 0]))
    low, high = light_bounds(buffer.position_frame_m, buffer.valid, *scene.light_space.transform_from_frame(buffer.frame))
    in_light = scene.light_space.points_from_earth(point + scene.height_range_m[1] * up)
    slack = quads * scene.surface(grid).step_m * 1.5  # twice half a diagonal: map scale varies over a level
    in_window = (in_light[:, 0] >= low[0] - slack) & (in_light[:, 0] <= high[0] + slack) & (in_light[:, 1] >= low[1] - slack)
    keep = in_window & (in_light[:, 2] <= high[2] + slack + np.ptp(scene.height_range_m)) | ~np.isfinite(in_light).all(axis=1)
    return [patch for patch, is_kept in zip(patches, keep, strict=True) if is_kept]


def _unique_rows(rows: np.ndarray) -> list[list[int]]:
    """Return the distinct rows of an integer array (n, k).

    Each row is encoded as one integer first, since ``np.unique`` over rows is 20 times slower.
    """
    if not len(rows):
        return []
    first = rows.min(axis=0)
    sizes = np.ptp(rows, axis=0) + 1
    keys = np.unique(np.ravel_multi_index(tuple((rows - first).T), tuple(sizes)))
    return (np.stack(np.unravel_index(keys, tuple(sizes)), axis=1) + first).tolist()


def _is_inside_window(row: int, col: int, quads: int, row0: int, col0: int, rows: int, cols: int) -> bool:
    """Return whether a patch lies wholly within a window of nodes, such as the block's own ground.

    The patch starts at (``row``, ``col``) and has ``quads`` quads per side. The window has ``rows`` x ``cols`` nodes from
    (``row0``, ``col0``) on.
    """
    return row >= row0 and col >= col0 and row + quads <= row0 + rows - 1 and col + quads <= col0 + cols - 1


def _sunward_edge_m(light: LightSpace, buffer: Receivers) -> float:
    """Return the maximum of ``LightSpace.horizontal_sunward_m`` over a buffer's receivers, metres: the edge nearest to the sun."""
    rotation, translation = light.transform_from_frame(buffer.frame)
    row, offset = light.horizontal_sunward_m(rotation.T), light.horizontal_sunward_m(translation)
    _, high = light_bounds(buffer.position_frame_m, buffer.valid, np.tile(row, (3, 1)), np.full(3, offset))
    return float(high[0])


def _outline_pixels(valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns (n,), (n,) of pixels on the outline of a valid mask.

    They are the first and last valid pixels of nine evenly spaced rows and of nine columns.
    """
    ends = []
    for axis, mask in enumerate((valid, valid.T)):
        lines = np.flatnonzero(mask.any(axis=1))
        for line in lines[np.unique(np.linspace(0, lines.size - 1, 9).astype(int))]:
            valid_indices = np.flatnonzero(mask[line])
            ends += [(line, end) if axis == 0 else (end, line) for end in (valid_indices[0], valid_indices[-1])]
    i, j = np.array(ends).T
    return i, j


def _ray_origins(scene: Scene, buffer: GeometryBuffer | BareNodes) -> tuple[CRS, np.ndarray, np.ndarray, tuple[float, float]]:
    """Return positions of some of a buffer's receivers, from which the raster's extent towards the sun is measured.

    The result holds the CRS, x (n,) and y (n,) of the positions in that CRS, and x and y of the view's middle.
    """
    view = buffer.view
    if isinstance(view, MapView):
        i, j = _outline_pixels(buffer.shows_ground if isinstance(buffer, BareNodes) else buffer.valid)
        x, y = view.grid.x(view.col0 + j * view.col_step), view.grid.y(view.row0 + i * view.row_step)
        return view.grid.crs, np.asarray(x), np.asarray(y), view.centre
    valid = np.flatnonzero(buffer.valid)
    start_points = buffer.position_frame_m.reshape(-1, 3)[valid[:: max(len(valid) // SUNWARD_RAY_ORIGIN_COUNT, 1)]]
    points = buffer.frame.points_to_earth(start_points)
    x, y, _ = scene.world.map_position(scene.map_crs, points)
    return scene.map_crs, x, y, (float(np.median(x)), float(np.median(y)))


def _data_and_shadow_limits_m(scene: Scene, buffer: GeometryBuffer | BareNodes) -> tuple[float, float]:
    """Return the distance to the raster's end towards the sun, and the distance up to which ground could shade receivers, metres.

    The first distance is the minimum over the positions of ``_ray_origins``. The second one is the longest shadow of ground that
    rises ``UNKNOWN_RELIEF_M``, or as high as the level's ground, above the lowest receiver.
    """
    assert scene.sun is not None and scene.light_space is not None
    lowest = float(np.nanmin(buffer.height_m))
    relief = max(scene.height_range_m[1] - lowest, UNKNOWN_RELIEF_M)
    crs, x, y, middle = _ray_origins(scene, buffer)
    if scene.world.is_flat:
        azimuth, altitude = scene.sun.azimuth_deg, scene.sun.altitude_deg
    else:
        point, up = scene.world.points_at_zero_height(crs, *middle)
        azimuth, altitude = azimuth_and_altitude(scene.sun.to_sun_earth, scene.world.earth_from_enu(point, up))
    needed_m = min(longest_shadow_m(relief, altitude, not scene.world.is_flat, scene.world.radius_m), 1e6)
    along_m = np.linspace(0.0, needed_m, 65)
    if scene.world.is_flat:
        unit = scene.world.metres_per_unit
        x = x[:, None] + along_m * np.sin(np.radians(azimuth)) / unit
        y = y[:, None] + along_m * np.cos(np.radians(azimuth)) / unit
    else:
        lon, lat = scene.world.lon_lat(crs, x, y)
        shape = (lon.size, along_m.size)
        lon, lat = (np.broadcast_to(v[:, None], shape).ravel() for v in (lon, lat))
        lon, lat, _ = scene.world.ellipsoid.fwd(lon, lat, np.full(lon.size, azimuth), np.broadcast_to(along_m, shape).ravel())
        x, y = np.reshape(lon, shape), np.reshape(lat, shape)
        if not is_longitude_latitude(scene.elevation.crs):
            x, y = transformer(LONGITUDE_LATITUDE, scene.elevation.crs).transform(x, y)
    on_data = scene.elevation.covers(x, y)
    ends = ~on_data
    ends[:, 0] = False  # the receiver itself is on the data
    first = np.where(ends.any(axis=1), ends.argmax(axis=1), along_m.size)
    data_extent_m = np.where(first < along_m.size, along_m[np.minimum(first, along_m.size - 1) - 1], needed_m)
    return float(data_extent_m.min()), needed_m
