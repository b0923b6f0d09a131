"""Smooth normals of a map's bare ground, for products that depend on its slope."""

from __future__ import annotations

import numpy as np

from skugga.terrain.gbuffer.bare_ground import bare_ground
from skugga.terrain.gbuffer.geometry import map_geometry
from skugga.terrain.gbuffer.map_columns import column_geometry
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.scene import Scene


def ground_normals(scene: Scene, view: MapView) -> tuple[np.ndarray, LocalFrame]:
    """Return the unit normals of the ground in a map's pixels, and their frame: smooth ones, or upward ones on flat tops of cells.

    Returns
    -------
    normal_frame
        float32 (rows, cols, 3), NaN without ground. Objects and water on the ground do not count. The flat tops of columns
        (``surface: blocks``) point up.
    frame
        The local frame near the view's centre.
    """
    has_columns = scene.elevation.surface == "blocks"
    ground = bare_ground(scene, view, None) if view.is_on_nodes and not has_columns else None
    if ground is None:
        frame = scene.world.frame_near(view.grid.crs, *view.centre)
        points = (column_geometry if has_columns else map_geometry)(scene.surface(view.grid), view, frame)
        return np.where(points.valid[..., None], points.shading_normal_frame, np.float32(np.nan)), frame
    normal_frame = np.full((view.rows, view.cols, 3), np.nan, np.float32)
    normal_frame[ground.window] = np.where(ground.valid[ground.window][..., None], ground.normal_frame, np.float32(np.nan))
    return normal_frame, ground.frame


def ground_normals_enu(scene: Scene, view: MapView) -> np.ndarray:
    """Return the unit normals of the ground in a map's pixels, in the axes east, true north and up at each pixel.

    They are smooth, or those of flat tops of cells.

    The result is float32 (rows, cols, 3), NaN without ground. It is correct in any CRS and for any shape of pixels. Up is normal to
    the ellipsoid.
    """
    normal_frame, frame = ground_normals(scene, view)
    return directions_enu(scene, view, frame, normal_frame)


def directions_enu(scene: Scene, view: MapView, frame: LocalFrame, direction_frame: np.ndarray) -> np.ndarray:
    """Return directions in a map's pixels, float32 (rows, cols, 3), in the axes east, true north and up at each pixel.

    ``direction_frame`` (rows, cols, 3) are their components in a local frame.
    """
    if scene.world.is_flat:
        return direction_frame
    rows, cols = np.mgrid[: view.rows, : view.cols]
    x = view.grid.x(view.col0 + cols * view.col_step)
    y = view.grid.y(view.row0 + rows * view.row_step)
    lon_deg, lat_deg = scene.world.lon_lat(view.grid.crs, x, y)
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    earth = frame.directions_to_earth(direction_frame.astype(np.float64))
    east = earth[..., 1] * np.cos(lon) - earth[..., 0] * np.sin(lon)
    outwards = earth[..., 0] * np.cos(lon) + earth[..., 1] * np.sin(lon)  # away from the earth's axis
    north = earth[..., 2] * np.cos(lat) - outwards * np.sin(lat)
    up = earth[..., 2] * np.sin(lat) + outwards * np.cos(lat)
    return np.stack([east, north, up], axis=-1).astype(np.float32)
