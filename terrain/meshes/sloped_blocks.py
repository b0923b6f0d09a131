"""Blocks under sloped roofs: walls, floor and roof as one closed mesh, with or without eaves.

- Roofs over nearly rectangular footprints have a level ridge (``skugga.terrain.meshes.roofs``). Others follow the straight skeleton
  (``skugga.terrain.meshes.skeleton_roofs``).
- Eaves continue the roof's planes beyond the walls, over gables too. The overhang is a slab of ``EAVES_THICKNESS_M``: its underside
  is parallel to the planes, and a fascia closes its edge. Walls end at the underside.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.level.parts import RoofForm
from skugga.terrain.meshes.block_triangles import block_triangles, next_corners, roof_triangles, sloped_block_triangles
from skugga.terrain.meshes.body import MIN_CREASE_DEG
from skugga.terrain.meshes.roofs import MAX_RISE_SHARE, ROOF_SLOPE, Roof, roof_over
from skugga.terrain.meshes.skeleton_roofs import RoofFaces, skeleton_faces

EAVES_THICKNESS_M = 0.15
"""Height of the fascia at the edge of eaves, which is the vertical thickness of the overhanging roof."""

MAX_EAVES_SHARE = 0.5
"""Maximum width of eaves, as a share of half the building's width; and maximum depth of their edge, as a share of the walls."""

MIN_EAVES_M = 0.01
"""Minimum width of eaves. Narrower ones are left out."""

MIN_MITRE_COSINE = -0.78
"""Minimum cosine between the normals of neighbouring sides with eaves. At sharper ones eaves would be over three times as long."""


class SlopedBlock(NamedTuple):
    """A block under a sloped roof, over a footprint of n corners.

    Vertices [0, n) are the tops of the walls at the corners, [n, 2 n) the floor. The points of the roof follow.

    Attributes
    ----------
    order
        int (n,): indices of the footprint's corners in the order of the vertices.
    wall_drop_m
        Depth of the tops of the walls below the ridge, metres.
    point_weights
        float64 (k, n): weights of the ordered corners in each point of the roof. Their sum is 1.
    point_drops_m
        Depth (k,) of the points below the ridge, metres.
    triangles
        int32 (m, 3): indices of the vertices, counter-clockwise from outside.
    is_roof
        Mask (m,) of the triangles on the roof. The others are parts of walls, gables, floor and the underside of eaves.
    crease_deg
        Largest angle (m,) to a face that is shaded with the triangle as one curved surface, degrees; ``None`` for the usual one.
    """

    order: np.ndarray
    wall_drop_m: float
    point_weights: np.ndarray
    point_drops_m: np.ndarray
    triangles: np.ndarray
    is_roof: np.ndarray
    crease_deg: np.ndarray | None = None


class SlopedBlockResult(NamedTuple):
    """The block under a sloped roof, or ``None`` for a flat roof; and whether it lacks a roof or eaves that were requested."""

    block: SlopedBlock | None
    lacks_roof: bool = False
    lacks_eaves: bool = False


def sloped_block(
    corners_earth_m: np.ndarray, up: np.ndarray, ring_ends: np.ndarray, height_m: float, form: RoofForm, eaves_m: float
) -> SlopedBlockResult:
    """Return the block over a footprint, with ``height_m`` from its floor to its ridge.

    ``corners_earth_m`` (n, 3) are level points at the corners, ``up`` (3,) is the unit vector upwards, ``ring_ends`` holds the end
    index of each ring. Rings have the building on their left. The roof is flat if ``form`` is ``flat`` or, for ``auto``, the
    building is not a house.
    """
    if form == "flat":
        return SlopedBlockResult(None)
    roof = roof_over(corners_earth_m, height_m, form) if len(ring_ends) == 1 else None
    if roof is None and form == "auto":
        return SlopedBlockResult(None)
    if roof is not None and eaves_m < MIN_EAVES_M:
        return SlopedBlockResult(_rectangular_block(roof))
    corners_m = _plane_coordinates(corners_earth_m, up)
    if roof is not None:
        order = (roof.first_corner + np.arange(len(corners_m))) % len(corners_m)
        has_gables = roof.roof_triangle_count < len(roof.triangles)
        faces: RoofFaces | None = _rectangle_faces(roof, corners_m[order], has_gables)
        rise_m = roof.rise_m
    else:
        order = np.arange(len(corners_m))
        faces = skeleton_faces(corners_m, ring_ends, has_gables=form == "pitched")
        if faces is None:
            return SlopedBlockResult(None, lacks_roof=True)
        rise_m = float(min(ROOF_SLOPE * faces.runs_m.max(), MAX_RISE_SHARE * height_m))
    assert faces is not None
    if eaves_m >= MIN_EAVES_M:
        block = _block_with_eaves(faces, order, rise_m, height_m, eaves_m)
        if block is not None:
            return SlopedBlockResult(block)
        if roof is not None:
            return SlopedBlockResult(_rectangular_block(roof), lacks_eaves=True)
    block = _block_without_eaves(faces, order, rise_m)
    return SlopedBlockResult(block, lacks_roof=block is None, lacks_eaves=block is not None and eaves_m >= MIN_EAVES_M)


def _rectangular_block(roof: Roof) -> SlopedBlock:
    """Return the block of four corners under a roof without eaves."""
    triangles, is_roof = sloped_block_triangles(roof)
    order = (roof.first_corner + np.arange(4)) % 4
    return SlopedBlock(order, roof.rise_m, roof.ridge_weights, np.zeros(len(roof.ridge_weights)), triangles, is_roof)


def _plane_coordinates(corners_earth_m: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return coordinates (n, 2) of points (n, 3) in the level plane through the first one, along and left of the first side."""
    offset = corners_earth_m - corners_earth_m[0]
    along = offset[1] - (offset[1] @ up) * up
    along /= np.linalg.norm(along)
    return np.column_stack([offset @ along, offset @ np.cross(up, along)])


def _rectangle_faces(roof: Roof, corners_m: np.ndarray, has_gables: bool) -> RoofFaces:
    """Return the faces of a roof over four corners, of which the first two are ends of a long side."""
    if len(roof.ridge_weights) == 1:
        faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    else:
        faces = [[0, 1, 5, 4], [1, 2, 5], [2, 3, 4, 5], [3, 0, 4]]
    length = np.linalg.norm(np.roll(corners_m, -1, axis=0) - corners_m, axis=1)
    runs = np.full(len(roof.ridge_weights), (length[1] + length[3]) / 4.0)
    is_gable = np.array([False, True, False, True]) & has_gables
    return RoofFaces(corners_m, np.array([4]), roof.ridge_weights @ corners_m, runs, faces, is_gable)


def _block_without_eaves(roof: RoofFaces, order: np.ndarray, rise_m: float) -> SlopedBlock | None:
    """Return the block under a roof that ends at the walls, or ``None`` if its faces do not tile the footprint."""
    count = len(roof.corners_m)
    slopes = _face_triangles(roof, roof.corners_m, roof.points_m)
    floor = roof_triangles(roof.corners_m, roof.ring_ends)
    walls_and_floor = block_triangles(floor, roof.ring_ends)[0][len(floor) :]
    if slopes is None:
        return None
    gables = np.array([roof.faces[number] for number in np.flatnonzero(roof.is_gable)], np.int32).reshape(-1, 3)
    upper = np.concatenate([slopes, gables])
    triangles = np.concatenate([np.where(upper >= count, upper + count, upper), walls_and_floor]).astype(np.int32)
    if not _is_closed(triangles):
        return None
    drops = rise_m - rise_m / roof.runs_m.max() * roof.runs_m
    weights = _affine_weights(roof.points_m, roof.corners_m)
    is_roof = np.arange(len(triangles)) < len(slopes)
    return SlopedBlock(order, rise_m, weights, drops, triangles, is_roof, _creases(is_roof, rise_m / roof.runs_m.max()))


def _block_with_eaves(roof: RoofFaces, order: np.ndarray, rise_m: float, height_m: float, eaves_m: float) -> SlopedBlock | None:
    """Return the block under a roof with eaves, or ``None`` if they do not fit between the building's own walls."""
    count, point_count, slope = len(roof.corners_m), len(roof.points_m), rise_m / roof.runs_m.max()
    wall_m = height_m - rise_m
    width_m = min(eaves_m, MAX_EAVES_SHARE * roof.runs_m.max(), (MAX_EAVES_SHARE * wall_m - EAVES_THICKNESS_M) / slope)
    edge = None if width_m < MIN_EAVES_M else _outset(roof.corners_m, roof.ring_ends, width_m)
    if edge is None:
        return None
    following = next_corners(roof.ring_ends)
    gables = np.flatnonzero(roof.is_gable)
    apexes = np.array([roof.faces[number][2] - count for number in gables], np.int64)
    points, edge_runs = roof.points_m.copy(), roof.runs_m.copy()
    points[apexes], edge_runs[apexes] = _ridge_ends(roof, gables, apexes, edge)
    slopes = _face_triangles(roof, edge, points)
    if slopes is None:
        return None
    # Vertices: tops of walls, floor, points, upper edge of the eaves, their lower edge, lower ends of ridges, tops of gables.
    first_point, upper, lower = 2 * count, 2 * count + point_count, 3 * count + point_count
    apex_lower = 4 * count + point_count + np.arange(len(gables))
    apex_wall = apex_lower + len(gables)
    i = np.flatnonzero(~roof.is_gable)
    j, a, b = following[i], gables, following[gables]
    ridge = first_point + apexes
    fascia = [
        *_quads(lower + i, lower + j, upper + j, upper + i),
        *_quads(lower + a, apex_lower, ridge, upper + a),
        *_quads(apex_lower, lower + b, upper + b, ridge),
    ]
    underside = [
        *_quads(i, j, lower + j, lower + i),
        *_quads(a, apex_wall, apex_lower, lower + a),
        *_quads(apex_wall, b, lower + b, apex_lower),
    ]
    floor = roof_triangles(roof.corners_m, roof.ring_ends)
    roof_top = np.concatenate([np.where(slopes >= count, slopes + count, slopes + upper), *fascia])
    walls = [np.column_stack([a, b, apex_wall]), block_triangles(floor, roof.ring_ends)[0][len(floor) :]]
    triangles = np.concatenate([roof_top, *underside, *walls]).astype(np.int32)
    if not _is_closed(triangles):
        return None
    drops, edge_drop = rise_m - slope * edge_runs, rise_m + slope * width_m
    all_points = np.concatenate([points, edge, edge, points[apexes], roof.points_m[apexes]])
    all_drops = np.concatenate([
        drops, np.full(count, edge_drop), np.full(count, edge_drop + EAVES_THICKNESS_M), drops[apexes] + EAVES_THICKNESS_M,
        rise_m - slope * roof.runs_m[apexes] + EAVES_THICKNESS_M,
    ])  # fmt: skip
    weights = _affine_weights(all_points, roof.corners_m)
    is_roof = np.arange(len(triangles)) < len(roof_top)
    return SlopedBlock(order, rise_m + EAVES_THICKNESS_M, weights, all_drops, triangles, is_roof, _creases(is_roof, slope))


def _creases(is_roof: np.ndarray, slope: float) -> np.ndarray:
    """Return the largest angles (m,) between faces that are shaded as one curved surface, degrees.

    Planes of a roof are smooth over the corners of the outline at which walls are: those that turn by less than ``MIN_CREASE_DEG``.
    The angle between the planes is smaller than that between the walls.
    """
    turn_cosine = np.cos(np.radians(MIN_CREASE_DEG))
    roof_crease_deg = np.degrees(np.arccos((1.0 + slope * slope * turn_cosine) / (1.0 + slope * slope)))
    return np.where(is_roof, roof_crease_deg, MIN_CREASE_DEG)


def _outset(corners_m: np.ndarray, ring_ends: np.ndarray, width_m: float) -> np.ndarray | None:
    """Return the corners (n, 2) of the outline at a distance of ``width_m`` outside of a footprint's sides.

    Returns ``None`` if that outline crosses itself, as in courtyards and niches narrower than two eaves, or has sharp corners.
    """
    import shapely

    following = next_corners(ring_ends)
    side = corners_m[following] - corners_m
    outward = np.column_stack([side[:, 1], -side[:, 0]]) / np.linalg.norm(side, axis=1)[:, None]
    before = np.empty_like(outward)
    before[following] = outward
    cosine = np.einsum("ij,ij->i", before, outward)
    if cosine.min() < MIN_MITRE_COSINE:
        return None
    edge: np.ndarray = corners_m + width_m * (before + outward) / (1.0 + cosine)[:, None]
    if (np.einsum("ij,ij->i", edge[following] - edge, side) <= MIN_EAVES_M * np.linalg.norm(side, axis=1)).any():
        return None  # a side without a length, or turned around
    rings = np.split(edge, ring_ends[:-1])
    return edge if shapely.Polygon(rings[0], rings[1:]).is_valid else None


def _ridge_ends(roof: RoofFaces, gables: np.ndarray, apexes: np.ndarray, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (g, 2) at which the ridges meet the outer edge of the eaves at the gables of g sides, and their runs (g,).

    ``gables`` (g,) are the sides, ``apexes`` (g,) the points of the roof at their gables.
    """
    following = next_corners(roof.ring_ends)
    start, end = roof.corners_m[gables], roof.corners_m[following[gables]]
    # The ridge has the same distance from both neighbouring sides, so it divides the outer edge in the ratio of the gable.
    share = np.linalg.norm(roof.points_m[apexes] - start, axis=1) / np.linalg.norm(end - start, axis=1)
    outer_start, outer_end = edge[gables], edge[following[gables]]
    out: np.ndarray = outer_start + share[:, None] * (outer_end - outer_start)
    next_side = roof.corners_m[following[following[gables]]] - end
    next_side /= np.linalg.norm(next_side, axis=1)[:, None]
    return out, roof.runs_m[apexes] + _cross(next_side, out - roof.points_m[apexes])


def _quads(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the triangles (k, 3) of both halves of quadrangles."""
    return np.column_stack([a, b, c]), np.column_stack([a, c, d])


def _face_triangles(roof: RoofFaces, corners_m: np.ndarray, points_m: np.ndarray) -> np.ndarray | None:
    """Return the triangles (m, 3) of all faces but gables, seen from above; ``None`` if these do not tile the outline."""
    xy = np.concatenate([corners_m, points_m])
    triangles: list[np.ndarray] = []
    for face, is_gable in zip(roof.faces, roof.is_gable, strict=True):
        if is_gable:
            continue
        loop = np.array(face)
        if _is_convex(xy[loop]):
            triangles.append(np.column_stack([np.full(len(loop) - 2, loop[0]), loop[1:-1], loop[2:]]))
            continue
        clipped = roof_triangles(xy[loop] - xy[loop[0]], np.array([len(loop)]))
        if len(clipped) != len(loop) - 2:
            return None
        triangles.append(loop[clipped])
    out = np.concatenate(triangles).astype(np.int32)
    a, b, c = np.moveaxis(xy[out], 1, 0)
    covered = float(np.abs(_cross(b - a, c - a)).sum())
    ends = corners_m[next_corners(roof.ring_ends)]
    outline = float(_cross(corners_m, ends).sum())
    return out if abs(covered - outline) <= 1e-6 * outline else None


def _is_convex(polygon: np.ndarray) -> bool:
    """Return whether a counter-clockwise polygon (k, 2) turns left at each of its corners."""
    side = np.roll(polygon, -1, axis=0) - polygon
    before = np.roll(side, 1, axis=0)
    lengths = np.linalg.norm(side, axis=1) * np.linalg.norm(before, axis=1)
    return bool((_cross(before, side) > 1e-6 * lengths).all())


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross products (n,) of vectors (n, 2)."""
    out: np.ndarray = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def _is_closed(triangles: np.ndarray) -> bool:
    """Return whether each edge of the triangles (m, 3) belongs to one other triangle, in the opposite direction."""
    start, end = triangles.astype(np.int64).ravel(), np.roll(triangles, -1, axis=1).astype(np.int64).ravel()
    span = int(triangles.max()) + 1
    forward, reverse = np.sort(start * span + end), np.sort(end * span + start)
    return bool((forward == reverse).all() and (np.diff(forward) > 0).all())


def _affine_weights(points_m: np.ndarray, corners_m: np.ndarray) -> np.ndarray:
    """Return weights (k, n) of corners (n, 2) whose weighted sums are the points (k, 2). Weights of a point have the sum 1."""
    centre = corners_m.mean(axis=0)
    homogeneous = np.column_stack([corners_m - centre, np.ones(len(corners_m))])
    out: np.ndarray = np.column_stack([points_m - centre, np.ones(len(points_m))]) @ np.linalg.pinv(homogeneous)
    return out
