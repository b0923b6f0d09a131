"""The planes on which irradiation is measured: the ground's own slope, level planes, and planes of a given tilt and azimuth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

MAX_TILT_DEG = 180.0
"""Tilt of a plane that faces down."""


@dataclass(frozen=True)
class TiltedPlane:
    """A plane on every cell.

    Attributes
    ----------
    tilt_deg
        Angle between the plane and a level one: 0 faces up, 90 is a wall, 180 faces down.
    azimuth_deg
        Azimuth that the plane faces, clockwise from true north.
    """

    tilt_deg: float
    azimuth_deg: float = 180.0


Plane = Literal["ground", "level"] | TiltedPlane
"""The ground's own slope, level planes on it, or planes of a tilt and an azimuth."""


@dataclass(frozen=True, eq=False)
class PlaneNormals:
    """Unit normals of the planes of a block's cells: their components to the east, to the north and up, float32 (rows, cols)."""

    east: np.ndarray
    north: np.ndarray
    up: np.ndarray

    @property
    def components(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The components to the east, to the north and up."""
        return self.east, self.north, self.up


def normals_of_slopes(east: np.ndarray, north: np.ndarray) -> PlaneNormals:
    """Return the normals of ground that rises by ``east`` and ``north`` per metre to the east and to the north, (rows, cols)."""
    up = np.float32(1.0) / np.sqrt(np.float32(1.0) + east**2 + north**2)
    return PlaneNormals(-east * up, -north * up, up)


def normals_of_plane(plane: TiltedPlane, shape: tuple[int, int]) -> PlaneNormals:
    """Return the normals of the same plane on all cells of a block (rows, cols)."""
    tilt, azimuth = np.radians(plane.tilt_deg), np.radians(plane.azimuth_deg)
    components = np.sin(tilt) * np.sin(azimuth), np.sin(tilt) * np.cos(azimuth), np.cos(tilt)
    east, north, up = (np.full(shape, component, np.float32) for component in components)
    return PlaneNormals(east, north, up)


def normals_in_block_plane(normals: PlaneNormals, east_north_of_cell_m: np.ndarray, curvature_per_m: float) -> PlaneNormals:
    """Return the components of normals along east, north and up at a block's centre instead of those at their own cells.

    Verticals lean away from the centre with the distance, since the level falls by ``curvature_per_m``.
    """
    if curvature_per_m == 0.0:
        return normals
    rows, cols = normals.up.shape
    down, right = np.arange(rows) - (rows - 1) / 2.0, np.arange(cols) - (cols - 1) / 2.0
    lean_east, lean_north = (
        ((per_row * down)[:, None] + (per_col * right)[None, :]).astype(np.float32) * np.float32(curvature_per_m)
        for per_row, per_col in east_north_of_cell_m
    )
    return PlaneNormals(
        normals.east + normals.up * lean_east,
        normals.north + normals.up * lean_north,
        normals.up - normals.east * lean_east - normals.north * lean_north,
    )
