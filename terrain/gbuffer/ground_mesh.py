"""The ground of a perspective view: one mesh without gaps between its triangles, decimated by the error that is visible.

* The mesh's nodes are the centres of the raster's cells if these are square and the view can use the raster's CRS. Otherwise they
  are the nodes of the level's map grid.
* A ground of up to ``MAX_UNDECIMATED_TRIANGLES`` triangles is drawn in full. A larger one is decimated. The decimation depends on
  the distance from the eye, and not on the direction of view, so that turning the camera changes no triangle.
* The same triangles cast the shadows, in front of the eye and behind it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.geo.camera import PERSPECTIVE_FRAME_SPACING_SHARE, PerspectiveView
from skugga.terrain.geo.grid import Grid, map_grid, step_at_anchor_m
from skugga.terrain.geo.world import LocalFrame, World, transformer
from skugga.terrain.ground.decimation import NodeErrors, decimate, node_errors
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.sheet import has_gaps, sheet_of
from skugga.terrain.ground.surface import Surface
from skugga.terrain.meshes.facets import NodeFaces, creases, face_normals, node_faces, smooth_normals
from skugga.terrain.scene import Scene

MAX_GROUND_TRIANGLES = 2_000_000
"""Maximum number of triangles of a perspective view's ground."""

MAX_UNDECIMATED_TRIANGLES = 250_000
"""Maximum number of triangles of a ground that is not decimated."""

MAX_NODES_PER_SIDE = 4096
"""Maximum number of nodes along a side before decimation. In larger levels each node is the mean of 2 x 2, 4 x 4, ... nodes."""

DECIMATION_TOLERANCE_PX = 0.25
"""Maximum height error, in pixels, of a decimated ground at the nodes that it omits. It is exceeded if the mesh would otherwise
have too many triangles.
"""


@dataclass(frozen=True, eq=False)
class GroundMesh:
    """Triangles of the ground in a frame.

    Attributes
    ----------
    position_frame_m
        float64 (n, 3), the nodes.
    height_m
        float32 (n,), their heights, metres.
    normal_frame
        float32 (n, 3), smooth unit normals.
    triangles
        int32 (m, 3), node indices, counter-clockwise from above.
    face_normal_frame
        float32 (m, 3), the triangles' unit normals.
    node_faces
        The triangles round each node (``skugga.terrain.meshes.facets``).
    x, y
        float64 (n,), map coordinates in the grid's CRS.
    grid
        The grid of the nodes.
    tolerance_px
        The maximum height error of the mesh, in pixels; 0 if it has all nodes.
    """

    position_frame_m: np.ndarray
    height_m: np.ndarray
    normal_frame: np.ndarray
    triangles: np.ndarray
    face_normal_frame: np.ndarray
    node_faces: NodeFaces
    x: np.ndarray
    y: np.ndarray
    grid: Grid
    tolerance_px: float


@dataclass(frozen=True, eq=False)
class GroundNodes:
    """All nodes of a level's ground.

    Attributes
    ----------
    grid
        The grid of the nodes.
    row0, col0
        The first row and column on the grid.
    height_m
        float32 (rows, cols), NaN without ground, metres.
    decimation_errors
        Decimation errors of the nodes; ``None`` if the ground is drawn in full.
    """

    grid: Grid
    row0: int
    col0: int
    height_m: np.ndarray
    decimation_errors: NodeErrors | None


def ground_mesh(scene: Scene, view: PerspectiveView, max_triangles: int = MAX_GROUND_TRIANGLES) -> GroundMesh:
    """Return the mesh of the ground for the eye of a view, in the view's frame.

    It is cached. Parts of a view, and views from the same eye in other directions, share one mesh.
    """
    world, elevation, crs = scene.world, scene.elevation, scene.map_crs
    if _nodes(world, elevation, crs, max_triangles).decimation_errors is None:  # one full mesh serves every eye of a frame
        return _undecimated_mesh(world, elevation, crs, view.frame(world), max_triangles)
    return _ground_mesh(world, elevation, crs, tuple(view.eye_earth_m), view.focal_px, max_triangles)


def ground_creases(ground: GroundMesh, triangle_number: np.ndarray) -> np.ndarray:
    """Return the creases (m,) of the ground's visible triangles, and 0 for all others (``skugga.terrain.meshes.facets.creases``).

    Only visible triangles are computed, since most of the ground is out of sight. ``triangle_number`` (rows, cols) holds the number
    of the triangle in each pixel, from 1.
    """
    is_visible = np.zeros(len(ground.triangles), np.bool_)
    run_in_chunks(len(triangle_number), _mark_triangles, triangle_number, is_visible)
    return creases(ground.position_frame_m, ground.face_normal_frame, ground.triangles, ground.node_faces, 2.0, is_visible)


@compiled
def _mark_triangles(first, last, number, out):
    """Set ``out[n]`` for each triangle n, counted from 0, that is visible in the rows from ``first`` to ``last`` (exclusive).

    ``number`` (rows, cols) holds the triangle in each pixel, from 1. ``out`` (m,) bool has one element for each triangle of the
    ground.
    """
    for i in range(first, last):
        for j in range(number.shape[1]):
            n = np.int64(number[i, j]) - 1
            if 0 <= n < len(out):
                out[n] = True


def ground_nodes(scene: Scene) -> GroundNodes:
    """Return the nodes that a level's perspective views are made from."""
    return _nodes(scene.world, scene.elevation, scene.map_crs, MAX_GROUND_TRIANGLES)


@cached("scene", MIB)
def nodes_have_gaps(height_m: np.ndarray) -> bool:
    """Return whether ground with nodes of these heights (rows, cols) has gaps: NaN between other heights of a row or column."""
    return has_gaps(np.isfinite(height_m))


@cached("scene", 1024 * MIB)
def _ground_mesh(
    world: World, elevation: Elevation, crs: CRS, eye_earth_m: tuple[float, ...], focal_px: float, max_triangles: int
) -> GroundMesh:
    """Return the decimated mesh of the ground for an eye, in a local frame near the eye.

    ``crs`` is the CRS of the level's map, ``eye_earth_m`` the eye's earth-fixed position (3,), and ``focal_px`` the focal length in
    pixels.
    """
    nodes = _nodes(world, elevation, crs, max_triangles)
    grid = nodes.grid
    assert nodes.decimation_errors is not None
    x, y, height = world.map_position(grid.crs, np.array(eye_earth_m))
    eye_row_col_m = (
        float((grid.y0 - y) / grid.step) - nodes.row0,
        float((x - grid.x0) / grid.step) - nodes.col0,
        float(height),
    )
    decimated = decimate(nodes.decimation_errors, eye_row_col_m, DECIMATION_TOLERANCE_PX / focal_px, max_triangles)
    frame = world.frame_near_earth(np.array(eye_earth_m), PERSPECTIVE_FRAME_SPACING_SHARE)
    row, col = decimated.nodes[:, 0], decimated.nodes[:, 1]
    return _build_mesh(world, elevation, nodes, frame, row, col, decimated.triangles, decimated.tolerance_rad * focal_px)


@cached("scene", 256 * MIB)
def _undecimated_mesh(world: World, elevation: Elevation, crs: CRS, frame: LocalFrame, max_triangles: int) -> GroundMesh:
    """Return the mesh of all nodes of the ground in ``frame``. ``crs`` is the CRS of the level's map."""
    nodes = _nodes(world, elevation, crs, max_triangles)
    return _build_mesh(world, elevation, nodes, frame, *_full_triangulation(nodes.height_m), 0.0)


def _build_mesh(
    world: World,
    elevation: Elevation,
    nodes: GroundNodes,
    frame: LocalFrame,
    row: np.ndarray,
    col: np.ndarray,
    triangles: np.ndarray,
    tolerance: float,
) -> GroundMesh:
    """Return the mesh of ``triangles`` between the ground's nodes at ``row`` and ``col`` (n,), in a frame.

    ``tolerance`` is the height error of the mesh, in pixels.
    """
    grid, height = nodes.grid, nodes.height_m[row, col]
    position = Surface(world, elevation, grid).node_positions(row + nodes.row0, col + nodes.col0, height, frame)
    faces, faces_at_nodes = face_normals(position, triangles), node_faces(len(position), triangles)
    return GroundMesh(
        position, height, smooth_normals(faces, faces_at_nodes), triangles, faces, faces_at_nodes,
        np.asarray(grid.x(col + nodes.col0)), np.asarray(grid.y(row + nodes.row0)), grid, tolerance,
    )  # fmt: skip


@cached("scene", 1024 * MIB)
def _nodes(world: World, elevation: Elevation, crs: CRS, max_triangles: int) -> GroundNodes:
    """Return the nodes of the ground. ``crs`` is the CRS of the level's map.

    Their decimation errors are computed only if the ground has more than ``max_triangles`` triangles. With the default
    ``MAX_GROUND_TRIANGLES`` the limit is ``MAX_UNDECIMATED_TRIANGLES``.
    """
    grid, row0, col0, rows, cols = _node_window(world, elevation, crs)
    surface = Surface(world, elevation, grid)
    height, valid = surface.heights(row0, col0, rows, cols)
    height = np.where(valid, height, np.float32(np.nan))
    is_complete = 2 * (rows - 1) * (cols - 1) <= (
        MAX_UNDECIMATED_TRIANGLES if max_triangles == MAX_GROUND_TRIANGLES else max_triangles
    )
    return GroundNodes(grid, row0, col0, height, None if is_complete else node_errors(height, surface.step_m, not world.is_flat))


def _node_window(world: World, elevation: Elevation, crs: CRS) -> tuple[Grid, int, int, int, int]:
    """Return the grid of the ground's nodes in a CRS, and the window of its nodes on the raster.

    The window is first row, first column, number of rows and number of columns.
    """
    cell = elevation.square_cell_size
    if elevation.crs == crs and cell is not None and elevation.resolution_m is None:
        left, top = (float(v) for v in elevation.xy(0, 0))
        grid = Grid(crs, left, top, cell)
        first, last = (0, 0), (elevation.rows - 1, elevation.cols - 1)
    else:
        west, south, east, north = elevation.bounds
        if elevation.crs != crs:
            west, south, east, north = transformer(elevation.crs, crs).transform_bounds(west, south, east, north, densify_pts=21)
        detail_m = max(elevation.cell_size_m(world.metres_per_unit), elevation.resolution_m or 0.0)
        probe = map_grid(world, crs, max(east - west, north - south) / 64)
        grid = map_grid(world, crs, 1.01 * probe.step * detail_m / step_at_anchor_m(world, probe))
        first = int(np.ceil((grid.y0 - north) / grid.step)), int(np.ceil((west - grid.x0) / grid.step))
        last = int(np.floor((grid.y0 - south) / grid.step)), int(np.floor((east - grid.x0) / grid.step))
    halvings = max(int(np.ceil(np.log2(max(last[0] - first[0], last[1] - first[1], 1) / MAX_NODES_PER_SIDE))), 0)
    (row0, col0), (row1, col1) = (-(-v // 2**halvings) for v in first), (v // 2**halvings for v in last)
    return grid.coarser(halvings), row0, col0, max(row1 - row0 + 1, 1), max(col1 - col0 + 1, 1)


def _full_triangulation(height: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows (n,) and columns (n,) of all nodes of a grid (rows, cols), and its triangles (m, 3) without missing corners."""
    rows, cols = height.shape
    row, col = (v.ravel() for v in np.mgrid[:rows, :cols])
    if min(rows, cols) < 2:
        return row, col, np.zeros((0, 3), np.int32)
    return row, col, sheet_of(np.repeat(height[..., None], 3, axis=2)).triangles
