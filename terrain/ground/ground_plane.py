"""Recognise ground that lies in one plane: a raster with a constant slope in a flat world.

The heights of a raster are float32. A plane that was stored in them lies within half a unit in the last place of the highest one.
A least-squares fit to all cells is nearer to the plane than single cells are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.geo.world import LocalFrame, World
from skugga.terrain.ground.elevation import Elevation

MAX_HEIGHT_ERROR = 2.0 * float(np.finfo(np.float32).eps)
"""Upper bound of a cell's distance from the plane, as a share of the largest height: four roundings of a float32."""


@dataclass(frozen=True, eq=False)
class GroundPlane:
    """Ground that lies in one plane.

    Attributes
    ----------
    corners_earth_m
        The centres (4, 3) of the raster's corner cells in the plane, earth-fixed, metres: in order round the raster.
    """

    corners_earth_m: np.ndarray

    def normal_in_frame(self, frame: LocalFrame) -> np.ndarray:
        """Return the upward unit normal (3,) in a frame."""
        first, second, third, fourth = frame.points_from_earth(self.corners_earth_m)
        normal = np.cross(third - first, fourth - second)
        return normal * np.sign(normal[2]) / np.linalg.norm(normal)


@cached("scene", MIB)
def ground_plane(world: World, elevation: Elevation) -> GroundPlane | None:
    """Return the plane in which a level's ground lies.

    ``None`` for ground that is not known to lie in one: on a round body, as blocks, with holes, of fewer than 2 x 2 cells, or with
    an overview coarser than its cells, which does not show every cell.
    """
    heights = elevation.overview.mean_heights_m.astype(np.float64)
    if not world.is_flat or elevation.surface == "blocks" or elevation.overview.lod != 0 or min(heights.shape) < 2:
        return None
    if not np.isfinite(heights).all():
        return None
    row, col = (np.arange(size) - (size - 1) / 2.0 for size in heights.shape)
    per_row = (row @ heights).sum() / (len(col) * (row @ row))  # least squares over a grid: the axes are independent
    per_col = (heights @ col).sum() / (len(row) * (col @ col))
    plane_m = heights.mean() + per_row * row[:, None] + per_col * col
    if np.abs(heights - plane_m).max() > MAX_HEIGHT_ERROR * np.abs(heights).max():
        return None
    corner_row, corner_col = np.array([0, 0, -1, -1]), np.array([0, -1, -1, 0])
    x, y = elevation.xy(*(np.arange(size)[index] for size, index in zip(heights.shape, (corner_row, corner_col), strict=True)))
    point, up = world.points_at_zero_height(elevation.crs, x, y)
    return GroundPlane(point + plane_m[corner_row, corner_col][:, None] * up)
