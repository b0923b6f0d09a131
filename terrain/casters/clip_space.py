"""Compute matrices from a frame to the clip space of a view, float64.

In clip space x points right and y down the picture (row 0 is at y = -1). Depth is 1 near the eye and 0 at infinity.

A camera has a projection matrix. A map has no camera, and on a globe its pixels are a curved function of points. There a map is
drawn in parts of ``AFFINE_PART_PX`` pixels a side. Each part uses the affine camera (an orthographic one with sheared axes) that
fits it best. ``affine_camera_error_px`` is the largest error of this fit.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.overview_cells import overview_on_grid
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.scene import Scene

AFFINE_PART_PX = 256
"""Side, in pixels, of the parts of a map that have an affine camera of their own."""

MAX_AFFINE_ERROR_PX = 1e9
"""Value of ``affine_camera_error_px`` where no camera can see the map's area. It is finite because descriptors cannot hold
infinity."""

FIT_POINTS_PER_SIDE = 9
"""Points along each side of a part, at two heights each, that its affine camera is fitted to."""


def camera_clip(view: PerspectiveView, frame: LocalFrame, origin_frame_m: np.ndarray, near_m: float) -> np.ndarray:
    """Return the matrix (4, 4) from homogeneous frame points to the clip coordinates of a perspective view.

    The points are metres from the frame's point ``origin_frame_m`` (3,). Depth is ``near_m`` over the distance along the view's
    axis, as in ``terrain/gbuffer/shaders/visible.vert.glsl``.
    """
    eye, camera_from_frame = view.in_frame(frame)
    right, down, forward = np.column_stack([camera_from_frame, camera_from_frame @ (origin_frame_m - eye)])
    size = np.array([view.cols, view.rows])
    scale = 2.0 * view.focal_px / (view.step_px * size)
    shift = (1.0 - 2.0 * np.array([view.col0, view.row0]) / view.step_px) / size - 1.0
    return np.array([scale[0] * right + shift[0] * forward, scale[1] * down + shift[1] * forward, [0.0, 0.0, 0.0, near_m], forward])


def affine_parts(world: World, view: MapView | PerspectiveView) -> list[tuple[MapView | PerspectiveView, int, int]]:
    """Split a view into the parts that are drawn separately, each with its first row and column in the view.

    Only a map on a globe has several parts.
    """
    if world.is_flat or isinstance(view, PerspectiveView):
        return [(view, 0, 0)]
    corners = [(row, col) for row in range(0, view.rows, AFFINE_PART_PX) for col in range(0, view.cols, AFFINE_PART_PX)]
    return [
        (view.part(row, col, min(AFFINE_PART_PX, view.rows - row), min(AFFINE_PART_PX, view.cols - col)), row, col)
        for row, col in corners
    ]


def map_clip(
    world: World, frame: LocalFrame, view: MapView, origin_frame_m: np.ndarray, heights_frame_m: tuple[float, float]
) -> np.ndarray:
    """Return the matrix (4, 4) from homogeneous frame points to the clip coordinates of a map.

    The points are metres from the frame's point ``origin_frame_m`` (3,). The matrix is an affine camera, fitted to the map by least
    squares between the two heights ``heights_frame_m`` above the frame's plane. Depth is 0 at the lower height, 1 at the higher
    one.
    """
    low, high = heights_frame_m
    points, pixel = _map_samples(world, frame, view, low, high)
    size = np.array([view.cols, view.rows])
    affine, *_ = np.linalg.lstsq(np.column_stack([points - origin_frame_m, np.ones(len(points))]), pixel, rcond=None)
    clip = np.zeros((4, 4))
    clip[:2] = (affine * 2.0 / size).T
    clip[:2, 3] -= 1.0
    clip[2, 2:] = np.array([1.0, origin_frame_m[2] - low]) / (high - low)
    clip[3, 3] = 1.0
    return clip


@cached("scene", MIB)
def affine_camera_error_px(scene: Scene, grid: Grid, row_step: float, col_step: float) -> float:
    """Return the largest distance, in pixels, of the ground's points in a map from the same points in the map's affine cameras.

    It is measured in five parts of the map: in the middle and at the corners of the level. It depends on the level, the grid and
    the pixels' size only, so that neighbouring blocks are drawn alike. The result is ``MAX_AFFINE_ERROR_PX`` if a part reaches
    beyond the area of the CRS, and 0 in a flat world. ``row_step`` and ``col_step`` are the distances of neighbouring pixels in
    nodes.
    """
    if scene.world.is_flat:
        return 0.0
    row, col, _ = overview_on_grid(scene.world, scene.elevation, grid)
    valid = np.isfinite(row) & np.isfinite(col)
    worst = 0.0
    for share in ((0.5, 0.5), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)) if valid.any() else ():
        middle = [low + part * (high - low) for part, low, high in
                  ((part, v[valid].min(), v[valid].max()) for part, v in zip(share, (row, col), strict=True))]  # fmt: skip
        half = (AFFINE_PART_PX - 1) / 2.0
        view = MapView(
            grid, middle[0] - half * row_step, middle[1] - half * col_step, row_step, col_step, AFFINE_PART_PX, AFFINE_PART_PX
        )
        frame = scene.world.frame_near(grid.crs, *view.centre)
        low, high = scene.height_range_m
        points, pixel = _map_samples(scene.world, frame, view, low, high + scene.objects.tallest_object_m, is_above_sea_level=True)
        if not (np.isfinite(points).all() and np.isfinite(pixel).all()):  # the part reaches beyond the area of the CRS
            return MAX_AFFINE_ERROR_PX
        homogeneous = np.column_stack([points, np.ones(len(points))])
        affine, *_ = np.linalg.lstsq(homogeneous, pixel, rcond=None)
        worst = max(worst, float(np.linalg.norm(homogeneous @ affine - pixel, axis=1).max()))
    return worst


def _map_samples(
    world: World, frame: LocalFrame, view: MapView, low_m: float, high_m: float, is_above_sea_level: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return points of a map at the heights ``low_m`` and ``high_m``, to fit an affine camera to.

    The result holds frame points (n, 3) in metres, and their columns and rows (n, 2) in pixels from the corner of the first pixel.
    Heights are above the frame's plane, or with ``is_above_sea_level`` above sea level.
    """
    row, col = np.meshgrid(*(np.linspace(0.0, size, FIT_POINTS_PER_SIDE) for size in (view.rows, view.cols)), indexing="ij")
    x = view.grid.x(view.col0 + (col - 0.5) * view.col_step)
    y = view.grid.y(view.row0 + (row - 0.5) * view.row_step)
    ground, up = world.points_at_zero_height(view.grid.crs, x.ravel(), y.ravel())
    ground, up = frame.points_from_earth(ground), frame.directions_from_earth(up)
    points = []
    for height in (low_m, max(high_m, low_m + 1.0)):
        rise = height if is_above_sea_level else (height - ground[:, 2]) / up[:, 2]
        points.append(ground + np.reshape(rise, (-1, 1)) * up)
    pixel = np.column_stack([col.ravel(), row.ravel()])
    return np.concatenate(points), np.concatenate([pixel, pixel])
