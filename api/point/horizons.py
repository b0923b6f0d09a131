"""The horizons of many points as one table: an array, a CSV or an ``.npz`` file."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from pyproj import CRS

from skugga.api.point.values import MAX_POINTS
from skugga.shadows.point.horizon import horizon_angles
from skugga.shadows.point.place import POINT_PARAMETER, places_at
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.scene import Scene

DEFAULT_AZIMUTHS, MAX_AZIMUTHS = 72, 3600
"""Default and limit of the number of azimuths: every 5 degrees, and every tenth of a degree."""

TABLE_SUFFIXES = (".csv", ".npz")
"""Suffixes of files with the horizons of many points."""


@dataclass(frozen=True, eq=False)
class PointHorizons:
    """The horizons of p points towards n azimuths.

    Attributes
    ----------
    coordinates
        (p, 2): the points as they were given, longitude and latitude in degrees without a CRS.
    height_m, ground_m
        (p,) metres: height of each eye above the ground, and height of the ground.
    azimuth_deg
        (n,): evenly spaced from north on, clockwise.
    horizon_deg
        (p, n): elevation angles above the horizontal plane through each eye; negative below it, -90 without anything.
    """

    coordinates: np.ndarray
    height_m: np.ndarray
    ground_m: np.ndarray
    azimuth_deg: np.ndarray
    horizon_deg: np.ndarray

    def csv_text(self) -> str:
        """Return a CSV with a row for each point: lon, lat, height_m, elevation_m, and an angle in each azimuth's column."""
        header = ["lon", "lat", "height_m", "elevation_m", *(f"{azimuth:.6g}" for azimuth in self.azimuth_deg)]
        row = "%.10g,%.10g,%g,%.2f" + ",%.4f" * len(self.azimuth_deg)
        values = np.column_stack([self.coordinates, self.height_m, self.ground_m, self.horizon_deg])
        return "\n".join([",".join(header), *(row % tuple(point) for point in values.tolist())]) + "\n"

    def npz_bytes(self) -> bytes:
        """Return a numpy archive with the arrays lon, lat, height_m, elevation_m, azimuth_deg and horizon_deg."""
        file = io.BytesIO()
        np.savez(
            file, lon=self.coordinates[:, 0], lat=self.coordinates[:, 1], height_m=self.height_m, elevation_m=self.ground_m,
            azimuth_deg=self.azimuth_deg, horizon_deg=self.horizon_deg,
        )  # fmt: skip
        return file.getvalue()


def check_azimuths(azimuths: int, name: str = "azimuths") -> None:
    """Raise ``InputError`` for a number of azimuths that is not allowed. ``name`` is the parameter in the message."""
    if not 1 <= azimuths <= MAX_AZIMUTHS:
        raise InputError(name, azimuths, f"1 to {MAX_AZIMUTHS} azimuths")


def horizons_at_points(
    scene: Scene,
    points: ArrayLike,
    azimuths: int = DEFAULT_AZIMUTHS,
    height_m: ArrayLike = 0.0,
    crs: CRS | None = None,
    name: str = "points",
) -> PointHorizons:
    """Return the horizons of many points, computed on all cores. They are those that each point has alone.

    Parameters
    ----------
    scene
        The scene.
    points
        (p, 2): longitudes and latitudes in degrees. In a flat world, metres east and north of its centre. With ``crs``, x and y in
        that CRS.
    azimuths
        Number of azimuths.
    height_m
        Heights of the eyes above the ground, metres, (p,) or one for all.
    crs
        The CRS of ``points``.
    name
        The parameter or the file in messages about the points.

    Raises
    ------
    InputError
        No point or more than ``MAX_POINTS``, a number of azimuths beyond ``MAX_AZIMUTHS``, or a point off the level's data.
    """
    check_azimuths(azimuths)
    coordinates, heights = _checked_points(points, height_m, name)
    try:
        places = places_at(scene, coordinates, crs, heights)
    except InputError as error:
        if error.name != POINT_PARAMETER:
            raise
        raise error.renamed(name) from None
    azimuth_deg = np.arange(azimuths) * (360.0 / azimuths)
    ground_m = np.array([place.ground_m for place in places])
    return PointHorizons(coordinates, heights, ground_m, azimuth_deg, horizon_angles(scene, places, azimuth_deg))


def _checked_points(points: ArrayLike, height_m: ArrayLike, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return points (p, 2) and heights (p,) as arrays. ``name`` names the points in the message of an ``InputError``."""
    try:
        coordinates = np.array(points, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, Problem("not an array of numbers"), "Give pairs of longitude and latitude, (n, 2)") from None
    if coordinates.size == 0 and coordinates.ndim > 0:
        raise InputError(name, Problem("no points"), "Give at least one")
    if coordinates.ndim != 2 or coordinates.shape[1] != 2:
        raise InputError(name, Problem(f"an array of shape {coordinates.shape}"), "Give pairs of longitude and latitude, (n, 2)")
    if len(coordinates) > MAX_POINTS:
        raise InputError.over_limit(name, f"{len(coordinates)} points", str(MAX_POINTS), "Use several calls")
    try:
        heights = np.broadcast_to(np.array(height_m, np.float64), (len(coordinates),))
    except (TypeError, ValueError, OverflowError):
        allowed = f"a number, or one for each of the {len(coordinates)} points"
        raise InputError("height", str(height_m)[:60], allowed) from None
    return coordinates, heights
