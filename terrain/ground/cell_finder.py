"""Map earth-fixed points to cells of a raster without PROJ, also in compiled loops.

A point is projected to a plane (``CellFinder.plane``). A lattice of nodes on the plane holds the cells, bilinear between nodes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.compiled import internal
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, WGS84, World, is_longitude_latitude, transformer
from skugga.terrain.ground.elevation import Elevation

LATTICE_SIDE_NODES = 65
"""Nodes a side of the lattice that maps positions to cells of a projected raster.

Bilinear interpolation between them has an error below a hundredth of a node of the grid of horizon angles.
"""

MAX_LOCAL_SPAN_DEG = 20.0
"""Maximum span of a raster in longitude and latitude, and its minimum distance to the poles, for the plane ``STEREOGRAPHIC_PLANE``.

That plane is faster than ``DEGREES_PLANE``, which larger rasters in longitude and latitude use.
"""

FLAT_PLANE, DEGREES_PLANE, STEREOGRAPHIC_PLANE = 0, 1, 2
"""Planes on which a ``CellFinder`` maps positions to cells.

They are the plane of a flat world, longitude and latitude, and the stereographic projection round the anchor (the centre of the
level's bounds).
"""

EQUATOR_RADIUS_M, ECCENTRICITY_SQUARED = WGS84.a, WGS84.es


@dataclass(frozen=True, eq=False)
class CellFinder:
    """Maps earth-fixed points to cells of a raster without PROJ.

    A point is projected to a plane. A lattice of nodes on that plane holds the cells, and between nodes they are bilinear.

    Attributes
    ----------
    plane
        ``FLAT_PLANE``, ``DEGREES_PLANE`` or ``STEREOGRAPHIC_PLANE``.
    axes_earth
        (3, 3): unit vectors east, north and up at the anchor, earth-fixed, as rows.
    first_node_xy
        (2,): x and y in the plane of the lattice's first node.
    node_spacing_xy
        (2,): spacing of the nodes in x and y.
    node_cells
        float64 (n, m, 2): rows and columns in the raster at the nodes ``first_node_xy + (j, i) * step``.
    """

    plane: int
    axes_earth: np.ndarray
    first_node_xy: np.ndarray
    node_spacing_xy: np.ndarray
    node_cells: np.ndarray


def cell_finder_of(elevation: Elevation, world: World) -> CellFinder:
    """Return the cell finder of a raster."""
    axes = world.earth_from_anchor.T
    rim = np.linspace(-0.5, elevation.rows - 0.5, 33), np.linspace(-0.5, elevation.cols - 0.5, 33)
    x, y = elevation.xy(*np.meshgrid(*rim, indexing="ij"))
    if world.is_flat:
        plane, count = FLAT_PLANE, 2
        x, y = (x - world.anchor_x) * world.metres_per_unit, (y - world.anchor_y) * world.metres_per_unit
    elif is_longitude_latitude(elevation.crs) and not _is_local(elevation.bounds):
        plane, count = DEGREES_PLANE, 2
    else:
        plane, count = STEREOGRAPHIC_PLANE, LATTICE_SIDE_NODES
        _, up = world.points_at_zero_height(elevation.crs, x, y)
        east, north, upward = np.moveaxis(up @ axes.T, -1, 0)
        x, y = east / (1.0 + upward), north / (1.0 + upward)
    first = np.array([np.nanmin(x), np.nanmin(y)])
    step = (np.array([np.nanmax(x), np.nanmax(y)]) - first) / (count - 1)
    nodes = np.meshgrid(*(first[k] + np.arange(count) * step[k] for k in (0, 1)))
    return CellFinder(plane, axes, first, step, np.stack(_cells_at(elevation, world, plane, axes, *nodes), axis=-1))


def _is_local(bounds_deg: tuple[float, float, float, float]) -> bool:
    """Return whether a raster with these bounds (west, south, east, north) is small enough for ``STEREOGRAPHIC_PLANE``."""
    west, south, east, north = bounds_deg
    return max(east - west, north - south) <= MAX_LOCAL_SPAN_DEG and max(-south, north) <= 90.0 - MAX_LOCAL_SPAN_DEG


def _cells_at(
    elevation: Elevation, world: World, plane: int, axes_earth: np.ndarray, x: np.ndarray, y: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns in a raster of positions in a finder's plane."""
    if plane == FLAT_PLANE:
        return elevation.cell_of(x / world.metres_per_unit + world.anchor_x, y / world.metres_per_unit + world.anchor_y)
    if plane == DEGREES_PLANE:
        return elevation.cell_of(x, y)
    square = x * x + y * y
    up = np.stack([2.0 * x, 2.0 * y, 1.0 - square], axis=-1) / (1.0 + square)[..., None] @ axes_earth
    lon, lat = np.degrees(np.arctan2(up[..., 1], up[..., 0])), np.degrees(np.arcsin(np.clip(up[..., 2], -1.0, 1.0)))
    if not is_longitude_latitude(elevation.crs):
        lon, lat = transformer(LONGITUDE_LATITUDE, elevation.crs).transform(lon, lat)
    if elevation.crs.is_geographic:
        middle = float(elevation.xy(0, (elevation.cols - 1) / 2)[0])
        lon = lon + 360.0 * np.rint((middle - lon) / 360.0)
    return elevation.cell_of(lon, lat)


@internal
def project_to_plane(x, y, z, height, plane, axes_earth, first_node_xy, node_spacing_xy):
    """Return the position (x, y), in the plane of a ``CellFinder``, of the ground below an earth-fixed point with a height.

    ``plane``, ``axes_earth``, ``first_node_xy`` and ``node_spacing_xy`` are the attributes of the finder, as arrays or tuples.
    """
    if plane == FLAT_PLANE:
        return x, y
    z *= (EQUATOR_RADIUS_M + height) / (EQUATOR_RADIUS_M * (1.0 - ECCENTRICITY_SQUARED) + height)
    if plane == DEGREES_PLANE:
        longitude, latitude = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.sqrt(x * x + y * y)))
        return longitude - 360.0 * np.rint((longitude - first_node_xy[0] - 0.5 * node_spacing_xy[0]) / 360.0), latitude
    east = axes_earth[0][0] * x + axes_earth[0][1] * y + axes_earth[0][2] * z
    north = axes_earth[1][0] * x + axes_earth[1][1] * y + axes_earth[1][2] * z
    up = axes_earth[2][0] * x + axes_earth[2][1] * y + axes_earth[2][2] * z
    denominator = np.sqrt(x * x + y * y + z * z) + up
    return east / denominator, north / denominator


@internal
def cell_in_plane(x, y, first_node_xy, node_spacing_xy, lattice):
    """Return the row and column in the raster of a position in the plane of a ``CellFinder``; NaN where it has none.

    ``lattice`` is the finder's ``node_cells``.
    """
    lattice_x, lattice_y, j, i = lattice_square(x, y, first_node_xy, node_spacing_xy, lattice.shape[0], lattice.shape[1])
    return cell_in_square(square_corners(lattice, i, j), lattice_x - j, lattice_y - i)


@internal
def lattice_square(x, y, first_node_xy, node_spacing_xy, rows, cols):
    """Return a position's (fractional) column and row in the lattice of a ``CellFinder``, and those of its square.

    ``x`` and ``y`` are the position in the finder's plane; the lattice has ``rows`` x ``cols`` nodes. A square lies between four
    nodes of the lattice. The fractional column and row are NaN for a position that is not finite. A position off the lattice has
    the nearest square.
    """
    lattice_x, lattice_y = (x - first_node_xy[0]) / node_spacing_xy[0], (y - first_node_xy[1]) / node_spacing_xy[1]
    is_finite = np.isfinite(lattice_x) & np.isfinite(lattice_y)
    j = np.int32(min(max(lattice_x if is_finite else 0.0, 0.0), cols - 2.0))
    i = np.int32(min(max(lattice_y if is_finite else 0.0, 0.0), rows - 2.0))
    return lattice_x if is_finite else np.nan, lattice_y if is_finite else np.nan, j, i


@internal
def square_corners(lattice, i, j):
    """Return the raster rows, then the raster columns, at the four corners of square (``i``, ``j``) of a ``CellFinder``'s lattice.

    The corners are in the order (i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1).
    """
    return (
        lattice[i, j, 0], lattice[i, j + 1, 0], lattice[i + 1, j, 0], lattice[i + 1, j + 1, 0],
        lattice[i, j, 1], lattice[i, j + 1, 1], lattice[i + 1, j, 1], lattice[i + 1, j + 1, 1],
    )  # fmt: skip


@internal
def cell_in_square(corners, u, v):
    """Return the row and column in the raster at the fractions ``u`` across and ``v`` down a square, bilinear.

    ``corners`` are those of ``square_corners``.
    """
    r0, r1, r2, r3, c0, c1, c2, c3 = corners
    upper, lower = r0 + u * (r1 - r0), r2 + u * (r3 - r2)
    row = upper + v * (lower - upper)
    upper, lower = c0 + u * (c1 - c0), c2 + u * (c3 - c2)
    return row, upper + v * (lower - upper)
