"""Convert between GDAL's coordinates of a CRS and Skugga's coordinates: x to the east and y to the north.

GDAL and ``pyproj`` (``always_xy``) put easting before northing and longitude before latitude. They do not change axes that run
south or west, such as Krovak's, nor angles in grads. Skugga computes in degrees, and with axes that run east and north, so that no
map is mirrored. Axes along meridians (polar maps) and axes of rotated poles stay unchanged, since no map in them is mirrored.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from affine import Affine
from pyproj import CRS

from skugga.terrain.cache import MIB, IdentityKey, cached
from skugga.terrain.errors import InputError, Problem

_AXIS_DIRECTIONS = {"east": (True, 1.0), "west": (True, -1.0), "north": (False, 1.0), "south": (False, -1.0)}
"""For each direction of an axis: whether the axis is x (runs along parallels), and the sign of its coordinates."""

Bounds = tuple[float, float, float, float]


@dataclass(frozen=True)
class Axes:
    """The mapping of GDAL's first and second coordinate to x and y.

    Attributes
    ----------
    is_swapped
        Whether GDAL's first coordinate is y.
    x_scale, y_scale
        Degrees per unit of an angle, or 1 for lengths; negative where the axis runs west or south.
    """

    is_swapped: bool = False
    x_scale: float = 1.0
    y_scale: float = 1.0

    @property
    def are_standard(self) -> bool:
        """Whether GDAL's coordinates are x and y themselves."""
        return self == Axes()

    @property
    def affine(self) -> Affine:
        """The affine transformation from GDAL's coordinates to x and y."""
        return Affine(0, self.x_scale, 0, self.y_scale, 0, 0) if self.is_swapped else Affine.scale(self.x_scale, self.y_scale)

    def xy(self, first: float | np.ndarray, second: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return x (east) and y (north) of GDAL's first and second coordinates."""
        x, y = (second, first) if self.is_swapped else (first, second)
        return np.asarray(x) * self.x_scale, np.asarray(y) * self.y_scale

    def gdal_coordinates(self, x: float | np.ndarray, y: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return GDAL's first and second coordinates of x (east) and y (north)."""
        x, y = np.asarray(x) / self.x_scale, np.asarray(y) / self.y_scale
        return (y, x) if self.is_swapped else (x, y)

    def bounds_xy(self, bounds: Bounds) -> Bounds:
        """Return (west, south, east, north) of bounds in GDAL's coordinates: both minima, then both maxima."""
        return _ordered_bounds(*self.xy(np.array(bounds[::2]), np.array(bounds[1::2])))

    def gdal_bounds(self, bounds: Bounds) -> Bounds:
        """Return bounds in GDAL's coordinates, both minima, then both maxima, of (west, south, east, north)."""
        return _ordered_bounds(*self.gdal_coordinates(np.array(bounds[::2]), np.array(bounds[1::2])))


def _ordered_bounds(first: np.ndarray, second: np.ndarray) -> Bounds:
    """Return the bounds of two corners: the minima of the first and of the second coordinates, and then the maxima."""
    return float(first.min()), float(second.min()), float(first.max()), float(second.max())


@cached("process", MIB, key=lambda crs: (IdentityKey(crs),), size_of=lambda _: 256)
def axes_of(crs: CRS) -> Axes:
    """Return the mapping of a CRS's coordinates to x and y, from the directions and units of its axes.

    Axes along meridians and axes without a compass direction give ``Axes()``, which changes no coordinates.
    """
    axes = crs.axis_info[:2]
    directions = [(axis.direction or "").lower() for axis in axes]
    if len(axes) != 2 or not all(direction in _AXIS_DIRECTIONS for direction in directions):
        return Axes()
    if directions == ["north", "east"]:  # GDAL puts the second one first
        axes, directions = axes[::-1], directions[::-1]
    (first_is_x, first), (second_is_x, second) = (_AXIS_DIRECTIONS[direction] for direction in directions)
    if first_is_x == second_is_x:  # along meridians
        return Axes()
    if crs.is_geographic:
        units = [float(np.degrees(axis.unit_conversion_factor)) for axis in axes]
        units = [1.0 if abs(unit - 1.0) < 1e-9 else unit for unit in units]  # a degree's factor is rounded
        first, second = first * units[0], second * units[1]
    return Axes(False, first, second) if first_is_x else Axes(True, second, first)


def check_axes(name: str, crs: CRS) -> None:
    """Raise ``InputError`` for a CRS that cannot be the CRS of a map.

    Its coordinates must be x to the east and y to the north, in degrees or in a unit of length.
    """
    if axes_of(crs).are_standard:
        return
    first, second = crs.axis_info[:2]
    problem = f"the axes of '{crs.name}' run {first.direction} and {second.direction}, in the unit {first.unit_name}"
    raise InputError(name, Problem(problem), "Use a CRS whose axes run east and north, in degrees or a unit of length")
