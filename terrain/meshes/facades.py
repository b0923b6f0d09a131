"""Façades: coordinates on the walls and sloped roofs of a level's buildings, as tables by the number of a triangle.

The tables follow from the footprints of the buildings (``skugga.terrain.meshes.body.Footprint``). They are the same under every sun
and in every view. Meshes from models have no façades.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.meshes.assemble import Placement
from skugga.terrain.meshes.body import Footprint
from skugga.terrain.meshes.facade_layout import (
    BAY_PITCH,
    LAYOUT_SIZE,
    STOREY_PITCH,
    BuildingSizes,
    WallPlaces,
    uniform,
    wall_layouts,
)
from skugga.terrain.meshes.solids import Solids

WALL, TILES, SEAMS, FLAT = 0, 1, 2, 3
"""Kinds of façades: walls, roofs of tiles or slates, roofs of sheet metal with standing seams, and flat roofs."""

MAX_WALL_SLOPE, MAX_FLAT_ROOF_COSINE = 0.2, 0.985
"""Maximum cosine between a wall's normal and the vertical, and maximum of a sloped roof's: ten degrees."""

MAX_ROOF_PERIOD_M = 2.3
"""Longest period of the pattern of roofs: ``skugga.terrain.effects.facade_pattern.WEATHER_WAVE_M``."""

MIN_FOUNDATION_M = 0.01
"""Minimum height of the ground floor above the lowest vertices of a building on the ground: more than rounding errors."""

EAVES_TOLERANCE_M = 0.002
"""Maximum height of a triangle's lowest corner above the eaves of its building at which the triangle begins at the eaves."""

TILE_RED_RATIO = 1.15
"""Minimum ratio of red and blue in the albedo of a roof of clay tiles. Half of the grey ones are slates."""


class Facades(NamedTuple):
    """The façades of a level's buildings.

    Attributes
    ----------
    row_of_triangle
        int32 (m,): for each triangle of the meshes the row of its façade in the other arrays; -1 for other triangles.
    kind
        uint8 (n,): WALL, TILES, SEAMS or FLAT.
    origin_earth_m
        float64 (n, 3): first corner of a wall at the ground floor; a point on the eaves of a roof.
    along_earth, up_earth
        float32 (n, 3): unit vectors along the wall or the eaves, and up the wall or the roof's slope.
    layout
        float32 (n, LAYOUT_SIZE): ``skugga.terrain.meshes.facade_layout``; zeros for roofs.
    seed
        int32 (n,): seed of the façade's random numbers.
    centre_earth_m, radius_m, max_period_m
        float64 (k, 3), (k,) and (k,): a sphere around each building, and the longest period of its pattern, metres.
    """

    row_of_triangle: np.ndarray
    kind: np.ndarray
    origin_earth_m: np.ndarray
    along_earth: np.ndarray
    up_earth: np.ndarray
    layout: np.ndarray
    seed: np.ndarray
    centre_earth_m: np.ndarray
    radius_m: np.ndarray
    max_period_m: np.ndarray


class _Triangles(NamedTuple):
    """The triangles of buildings.

    Attributes
    ----------
    number, building
        (m,), numbers of the triangles and of their buildings.
    vertices, corners
        (m, 3), indices of the vertices, and of the footprint's corners below or above them; -1 for points of a ridge.
    normal
        (m, 3), outward normals, twice as long as the areas.
    up_cosine
        (m,), cosines between the normals and the vertical.
    start, end
        (m,), corners of the footprint at which the triangle's wall starts and ends; -1 for triangles of roofs and floors.
    """

    number: np.ndarray
    building: np.ndarray
    vertices: np.ndarray
    corners: np.ndarray
    normal: np.ndarray
    up_cosine: np.ndarray
    start: np.ndarray
    end: np.ndarray


def facades(placement: Placement, solids: Solids) -> Facades | None:
    """Return the façades of a level's buildings; ``None`` without buildings."""
    is_building = np.array([placed.footprint is not None for placed in placement.visible_bodies])
    footprints = [placed.footprint for placed in placement.visible_bodies if placed.footprint is not None]
    if not footprints:
        return None
    vertex_counts = np.array([len(placed.body.vertices_m) for placed in placement.visible_bodies])
    first_vertex = (np.cumsum(vertex_counts) - vertex_counts)[is_building]
    vertex_counts = vertex_counts[is_building]
    corner_counts = np.array([len(footprint.corner_ground_m) for footprint in footprints])
    up = _unit(solids.vertices_earth_m[first_vertex] - solids.vertices_earth_m[first_vertex + corner_counts])
    triangles = _triangles(solids, is_building, first_vertex, corner_counts, up)
    first_corner = np.cumsum(corner_counts) - corner_counts
    sizes = _building_sizes(footprints, solids, triangles, first_vertex, up)
    walls = _walls(footprints, solids, triangles, first_vertex, corner_counts, first_corner, up)
    wall_count = int(corner_counts.sum())
    roofs = np.flatnonzero(triangles.up_cosine > MAX_WALL_SLOPE)
    kinds, origins, alongs, slopes = _roofs(solids, triangles, roofs, first_vertex, up, sizes.hash_bits)
    places, wall_origin, wall_along = walls
    layout = np.zeros((wall_count + len(roofs), LAYOUT_SIZE), np.float32)
    layout[:wall_count] = wall_layouts(places, sizes)
    row = np.full(len(solids.triangles), -1, np.int32)
    is_wall = triangles.start >= 0
    row[triangles.number[is_wall]] = (first_corner[triangles.building] + triangles.start)[is_wall]
    row[triangles.number[roofs]] = wall_count + np.arange(len(roofs), dtype=np.int32)
    building = np.concatenate([places.building, triangles.building[roofs]])
    low, high = _bounds(solids.vertices_earth_m, first_vertex, vertex_counts)
    return Facades(
        row, np.concatenate([np.full(wall_count, WALL, np.uint8), kinds]), np.concatenate([wall_origin, origins]),
        np.concatenate([wall_along, alongs]).astype(np.float32),
        np.concatenate([up[places.building], slopes]).astype(np.float32), layout,
        sizes.hash_bits[building].astype(np.uint32).view(np.int32), 0.5 * (low + high),
        0.5 * np.linalg.norm(high - low, axis=1), _max_periods(layout[:wall_count], places.building, len(footprints)),
    )  # fmt: skip


def _triangles(
    solids: Solids, is_building: np.ndarray, first_vertex: np.ndarray, corner_counts: np.ndarray, up: np.ndarray
) -> _Triangles:
    """Return the triangles of buildings."""
    building_of_body = np.where(is_building, np.cumsum(is_building) - 1, -1)
    building = building_of_body[solids.body_index]
    number = np.flatnonzero(building >= 0)
    building, vertices = building[number], solids.triangles[number]
    local, count = vertices - first_vertex[building][:, None], corner_counts[building][:, None]
    corners = np.where(local < 2 * count, local % count, -1)
    a, b, c = np.moveaxis(solids.vertices_earth_m[vertices], 1, 0)
    normal = np.cross(b - a, c - a)
    up_cosine = np.einsum("ij,ij->i", _unit(normal), up[building])
    start, end = _wall_ends(solids, vertices, corners, normal, up[building])
    is_wall = (np.abs(up_cosine) <= MAX_WALL_SLOPE) & (start != end)
    start, end = (np.where(is_wall, corner, -1) for corner in (start, end))
    return _Triangles(number, building, vertices, corners, normal, up_cosine, start, end)


def _is_slope(triangles: _Triangles) -> np.ndarray:
    """Return the mask (m,) of triangles on sloped roofs."""
    return (triangles.up_cosine > MAX_WALL_SLOPE) & (triangles.up_cosine < MAX_FLAT_ROOF_COSINE)


def _wall_ends(
    solids: Solids, vertices: np.ndarray, corners: np.ndarray, normal: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first and the last corner (m,) of the walls of triangles. A wall has the building on its left.

    Both are equal for triangles with one corner of the footprint, and mean nothing for those of roofs and floors. ``up`` (m, 3) are
    unit vectors. The other parameters are those of ``_Triangles``.
    """
    last = corners.max(axis=1)
    first = np.where(corners < 0, last[:, None], corners).min(axis=1)
    rows = np.arange(len(corners))
    first_vertex = vertices[rows, (corners == first[:, None]).argmax(axis=1)]
    last_vertex = vertices[rows, (corners == last[:, None]).argmax(axis=1)]
    along = solids.vertices_earth_m[last_vertex] - solids.vertices_earth_m[first_vertex]
    is_turned = np.einsum("ij,ij->i", np.cross(along, up), normal) < 0.0
    return np.where(is_turned, last, first), np.where(is_turned, first, last)


def _walls(
    footprints: list[Footprint], solids: Solids, triangles: _Triangles, first_vertex: np.ndarray, corner_counts: np.ndarray,
    first_corner: np.ndarray, up: np.ndarray,
) -> tuple[WallPlaces, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the wall that starts at each corner (n,), its origin (n, 3) and its unit vector (n, 3); length 0 without a wall."""
    building = np.repeat(np.arange(len(footprints)), corner_counts)
    start, is_wall = triangles.start, triangles.start >= 0
    next_corner = np.arange(len(building)) - first_corner[building]
    next_corner[(first_corner[triangles.building] + start)[is_wall]] = triangles.end[is_wall]
    own = np.arange(len(building)) - first_corner[building]
    floor = first_vertex[building] + corner_counts[building]
    first, last = solids.vertices_earth_m[floor + own], solids.vertices_earth_m[floor + next_corner]
    along = last - first
    along -= np.einsum("ij,ij->i", along, up[building])[:, None] * up[building]
    gable = np.zeros(len(building))
    is_gable = is_wall & (triangles.corners < 0).any(axis=1)
    ridge = solids.vertices_earth_m[triangles.vertices[is_gable, (triangles.corners[is_gable] < 0).argmax(axis=1)]]
    at = triangles.building[is_gable]
    eaves = solids.vertices_earth_m[first_vertex[at] + start[is_gable]]
    gable[first_corner[at] + start[is_gable]] = np.einsum("ij,ij->i", ridge - eaves, up[at])
    ground = np.concatenate([footprint.corner_ground_m for footprint in footprints]).astype(np.float64)
    floors_m = np.array([footprint.ground_floor_m for footprint in footprints])
    places = WallPlaces(
        np.linalg.norm(along, axis=1), gable, ground, ground[first_corner[building] + next_corner], building,
    )  # fmt: skip
    return places, first + floors_m[building][:, None] * up[building], _unit(along)


def _roofs(
    solids: Solids, triangles: _Triangles, roofs: np.ndarray, first_vertex: np.ndarray, up: np.ndarray, hash_bits: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the kinds (n,), origins, unit vectors along the eaves and up the slope (n, 3) of the triangles ``roofs`` (n,)."""
    at, normal = triangles.building[roofs], _unit(triangles.normal[roofs])
    is_flat = triangles.up_cosine[roofs] >= MAX_FLAT_ROOF_COSINE
    first_edge = solids.vertices_earth_m[first_vertex + 1] - solids.vertices_earth_m[first_vertex]
    along = _unit(np.cross(up[at], np.where(is_flat[:, None], np.cross(first_edge[at], up[at]), normal)))
    slope = np.cross(normal, along)
    corners = solids.vertices_earth_m[triangles.vertices[roofs]]
    lowest = corners[np.arange(len(roofs)), np.einsum("ijk,ik->ij", corners, up[at]).argmin(axis=1)]
    corner = solids.vertices_earth_m[first_vertex[at]]
    lowest[is_flat] = corner[is_flat]
    # Slopes of several triangles have courses of tiles that continue, since all are counted from the height of the eaves.
    height = np.einsum("ij,ij->i", lowest - corner, up[at])
    eaves = np.full(len(first_vertex), np.inf)
    np.minimum.at(eaves, at[~is_flat], height[~is_flat])
    is_higher = ~is_flat & (height > eaves[at] + EAVES_TOLERANCE_M)
    drop = (height - eaves[at])[is_higher] / np.einsum("ij,ij->i", slope, up[at])[is_higher]
    lowest[is_higher] -= drop[:, None] * slope[is_higher]
    shift = np.einsum("ij,ij->i", lowest - corner, along)
    albedo = solids.albedo[triangles.number[roofs]]
    is_clay = albedo[:, 0] >= TILE_RED_RATIO * albedo[:, 2]
    kinds = np.where(is_flat, FLAT, np.where(is_clay | (uniform(hash_bits[at], 11) < 0.5), TILES, SEAMS)).astype(np.uint8)
    return kinds, lowest - shift[:, None] * along, along, slope


def _building_sizes(
    footprints: list[Footprint], solids: Solids, triangles: _Triangles, first_vertex: np.ndarray, up: np.ndarray
) -> BuildingSizes:
    """Return the sizes of buildings."""
    count, at = len(footprints), triangles.building
    is_floor = (triangles.up_cosine < -MAX_WALL_SLOPE) & (triangles.corners >= 0).all(axis=1)  # not the underside of eaves
    is_slope = _is_slope(triangles)
    area = np.bincount(at, weights=0.5 * np.linalg.norm(triangles.normal, axis=1) * is_floor, minlength=count)
    above_eaves = solids.vertices_earth_m[triangles.vertices] - solids.vertices_earth_m[first_vertex[at]][:, None]
    rise = np.zeros(count)
    np.maximum.at(rise, at, np.einsum("ijk,ik->ij", above_eaves, up[at]).max(axis=1) * is_slope)
    eaves = np.array([footprint.eaves_m for footprint in footprints])
    return BuildingSizes(
        np.array([footprint.hash_bits for footprint in footprints], np.uint64), area, eaves, eaves + rise,
        np.bincount(at, weights=is_slope, minlength=count) > 0,
        np.array([footprint.ground_floor_m > MIN_FOUNDATION_M for footprint in footprints]),
    )  # fmt: skip


def _max_periods(layout: np.ndarray, building: np.ndarray, count: int) -> np.ndarray:
    """Return the longest period (k,) of the patterns of ``count`` buildings, metres, from the layouts of their walls."""
    longest = np.full(count, MAX_ROOF_PERIOD_M)
    np.maximum.at(longest, building, np.maximum(layout[:, BAY_PITCH], layout[:, STOREY_PITCH]))
    return longest


def _bounds(points: np.ndarray, first: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and the highest coordinates (k, 3) of consecutive points of buildings."""
    ends = np.column_stack([first, first + counts])
    padded = np.concatenate([points, points[-1:]])
    return (
        np.minimum.reduceat(padded, ends.ravel(), axis=0)[::2],
        np.maximum.reduceat(padded, ends.ravel(), axis=0)[::2],
    )  # fmt: skip


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) scaled to unit length; zero vectors do not change."""
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1), 1e-300)[:, None]
