"""Clip space of a view, for what is rasterised in it: x to the right, y down the picture (row 0 is at y = -1), depth from 1 near
the eye to 0 infinitely far away. Float64.

A camera's is a projection. A map has no camera: its pixels are a curved function of points. On a globe it is drawn in parts of
``AFFINE_PART_PX`` pixels, each by the affine camera that is nearest to it; ``bend_px`` says by how much they differ.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.reach import overview_on_grid
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import Grid, MapView
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.scene import Scene

AFFINE_PART_PX = 256
"""Side of the parts, in pixels."""

MAX_BEND_PX = 1e9
"""What ``bend_px`` is where no camera sees what the map shows: a descriptor has no infinity there."""

FIT_POINTS = 9
"""So many points along a part's sides, at two heights each, that its affine camera is fitted to."""


def camera_clip(view: PerspectiveView, frame: LocalFrame, origin_frame_m: np.ndarray, near_m: float) -> np.ndarray:
    """Clip coordinates (4, 4) of homogeneous frame points, metres from an origin; depth is ``near_m`` over the distance along the
    view's axis. They are those of ``terrain/shaders/visible.vert.glsl``.
    """
    eye, camera_from_frame = view.in_frame(frame)
    right, down, forward = np.column_stack([camera_from_frame, camera_from_frame @ (origin_frame_m - eye)])
    size = np.array([view.cols, view.rows])
    scale = 2.0 * view.focal_px / (view.step * size)
    shift = (1.0 - 2.0 * np.array([view.col0, view.row0]) / view.step) / size - 1.0
    return np.array([scale[0] * right + shift[0] * forward, scale[1] * down + shift[1] * forward, [0.0, 0.0, 0.0, near_m], forward])


def affine_parts(world: World, view: MapView | PerspectiveView) -> list[tuple[MapView | PerspectiveView, int, int]]:
    """What a view is drawn in: itself, or the parts of a globe's map; each with its first row and column."""
    if world.flat or isinstance(view, PerspectiveView):
        return [(view, 0, 0)]
    corners = [(row, col) for row in range(0, view.rows, AFFINE_PART_PX) for col in range(0, view.cols, AFFINE_PART_PX)]
    return [
        (view.part(row, col, min(AFFINE_PART_PX, view.rows - row), min(AFFINE_PART_PX, view.cols - col)), row, col)
        for row, col in corners
    ]


def map_clip(
    world: World, frame: LocalFrame, view: MapView, origin_frame_m: np.ndarray, heights_frame_m: tuple[float, float]
) -> np.ndarray:
    """Clip coordinates (4, 4) of homogeneous frame points, metres from an origin: those of the affine camera that is nearest to
    the map between two heights above the frame's plane; depth is 0 at the lower one, 1 at the higher one.
    """
    low, high = heights_frame_m
    points, pixel = _samples(world, frame, view, low, high)
    size = np.array([view.cols, view.rows])
    affine, *_ = np.linalg.lstsq(np.column_stack([points - origin_frame_m, np.ones(len(points))]), pixel, rcond=None)
    clip = np.zeros((4, 4))
    clip[:2] = (affine * 2.0 / size).T
    clip[:2, 3] -= 1.0
    clip[2, 2:] = np.array([1.0, origin_frame_m[2] - low]) / (high - low)
    clip[3, 3] = 1.0
    return clip


@cached("scene", MIB)
def bend_px(scene: Scene, grid: Grid, row_step: float, col_step: float) -> float:
    """How far, in pixels, the affine camera of a part lies off the map at worst: over parts at the level's corners and middle.

    A function of the level and the grid alone, so that neighbouring blocks are drawn alike. ``MAX_BEND_PX`` where a part reaches
    beyond the area of the CRS.
    """
    if scene.world.flat:
        return 0.0
    row, col, _ = overview_on_grid(scene.world, scene.elevation, grid)
    known = np.isfinite(row) & np.isfinite(col)
    worst = 0.0
    for share in ((0.5, 0.5), (0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)) if known.any() else ():
        middle = [low + part * (high - low) for part, low, high in
                  ((part, v[known].min(), v[known].max()) for part, v in zip(share, (row, col), strict=True))]  # fmt: skip
        half = (AFFINE_PART_PX - 1) / 2.0
        view = MapView(
            grid, middle[0] - half * row_step, middle[1] - half * col_step, row_step, col_step, AFFINE_PART_PX, AFFINE_PART_PX
        )
        frame = scene.world.frame_near(grid.crs, *view.centre)
        low, high = scene.height_range_m
        points, pixel = _samples(scene.world, frame, view, low, high + scene.objects.tallest_m, curved=True)
        if not (np.isfinite(points).all() and np.isfinite(pixel).all()):  # it reaches to where the CRS has no places
            return MAX_BEND_PX
        across = np.column_stack([points, np.ones(len(points))])
        affine, *_ = np.linalg.lstsq(across, pixel, rcond=None)
        worst = max(worst, float(np.linalg.norm(across @ affine - pixel, axis=1).max()))
    return worst


def _samples(
    world: World, frame: LocalFrame, view: MapView, low: float, high: float, curved: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Frame points (n, 3) of a map's pixels at two heights above the frame's plane, and their columns and rows (n, 2) from the
    corner of the first one. With ``curved`` heights are those above sea level.
    """
    row, col = np.meshgrid(*(np.linspace(0.0, size, FIT_POINTS) for size in (view.rows, view.cols)), indexing="ij")
    x = view.grid.x(view.col0 + (col - 0.5) * view.col_step)
    y = view.grid.y(view.row0 + (row - 0.5) * view.row_step)
    ground, up = world.ground(view.grid.crs, x.ravel(), y.ravel())
    ground, up = frame.points_from_earth(ground), frame.directions_from_earth(up)
    points = []
    for height in (low, max(high, low + 1.0)):
        rise = height if curved else (height - ground[:, 2]) / up[:, 2]
        points.append(ground + np.reshape(rise, (-1, 1)) * up)
    pixel = np.column_stack([col.ravel(), row.ravel()])
    return np.concatenate(points), np.concatenate([pixel, pixel])
