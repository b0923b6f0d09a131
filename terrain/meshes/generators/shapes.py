"""Closed shapes for the test scenes, in metres. Every triangle is counter-clockwise from outside."""

from __future__ import annotations

import numpy as np
import shapely
import trimesh

from skugga.terrain.meshes.body import Body, box, srgb_albedo

Vector = tuple[float, float, float]
Colour = tuple[float, float, float]


def solid(vertices_m: np.ndarray, triangles: np.ndarray, color: Colour) -> Body:
    """Return a body of one sRGB colour from vertices (n, 3) and triangles (m, 3)."""
    return Body(vertices_m, triangles, srgb_albedo(color))


def cuboid(low: Vector, high: Vector, color: Colour) -> Body:
    """Return a box between its lowest and its highest corner: 12 triangles."""
    return box(np.subtract(high, low), np.add(low, high) / 2, srgb_albedo(color))


def hull(points_m: list[Vector] | np.ndarray, color: Colour) -> Body:
    """Return the convex hull of n points that are all corners of it: 2 n - 4 triangles."""
    from scipy.spatial import ConvexHull

    points = np.asarray(points_m, np.float64)
    convex_hull = ConvexHull(points, qhull_options="Qt")
    triangles = convex_hull.simplices.copy()
    corner = points[triangles]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    inward = np.einsum("ij,ij->i", normal, convex_hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, ::-1]
    return solid(points, triangles, color)


def gable(low: tuple[float, float], high: tuple[float, float], eaves_height_m: float, ridge_height_m: float, color: Colour) -> Body:
    """Return a roof over a rectangle with its ridge along the longer side: a prism of 8 triangles."""
    (x0, y0), (x1, y1) = low, high
    corners = [(x, y, eaves_height_m) for x in (x0, x1) for y in (y0, y1)]
    x, y = (x0 + x1) / 2, (y0 + y1) / 2
    ends = (
        [(x, y0, ridge_height_m), (x, y1, ridge_height_m)]
        if y1 - y0 > x1 - x0
        else [(x0, y, ridge_height_m), (x1, y, ridge_height_m)]
    )
    return hull(corners + ends, color)


def tube(path_m: list[Vector] | np.ndarray, radius_m: float | list[float], sides: int, color: Colour) -> Body:
    """Return a round bar with flat ends along an open path of k points: 2 k ``sides`` triangles.

    ``radius_m`` is one value, or one for each point. Each cross-section is rotated as little as possible against the one before.
    """
    path = np.asarray(path_m, np.float64)
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    radius = np.broadcast_to(np.asarray(radius_m, np.float64), len(path))
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    normal = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    loops = []
    for point, tangent, r in zip(path, tangents, radius, strict=True):
        normal = normal - tangent * (normal @ tangent)
        normal /= np.linalg.norm(normal)
        binormal = np.cross(tangent, normal)
        loops.append(point + r * (np.cos(angle)[:, None] * normal + np.sin(angle)[:, None] * binormal))
    return solid(*_loft_mesh(np.array(loops), path[0], path[-1]), color)


def lathe(profile_m: list[tuple[float, float]] | np.ndarray, sides: int, color: Colour, centre: Vector = (0, 0, 0)) -> Body:
    """Return a solid of revolution about the up axis through ``centre``: 2 (k - 2) ``sides`` triangles for k points.

    The profile of k points (radius, height) starts and ends on the axis, with the outside on its right.
    """
    profile = np.asarray(profile_m, np.float64)
    ends = np.array([[0, 0, profile[0, 1]], [0, 0, profile[-1, 1]]])
    vertices, triangles = _loft_mesh(_revolve(profile[1:-1], sides), *ends)
    return solid(vertices + np.asarray(centre), triangles, color)


def ring(section_m: list[tuple[float, float]] | np.ndarray, sides: int, color: Colour) -> Body:
    """Return a ring about the up axis: 2 k ``sides`` triangles for k points.

    The section of k points (radius, height) is counter-clockwise and does not touch the axis.
    """
    loops = _revolve(np.asarray(section_m, np.float64), sides)
    k = len(loops)
    lower, upper = np.arange(k), np.roll(np.arange(k), -1)
    return solid(loops.reshape(-1, 3), _walls(lower, upper, sides), color)


def plate(outline: shapely.Polygon, bottom_m: float, top_m: float, color: Colour) -> Body:
    """Return a flat slab between two heights over an outline (east, north), which may have holes."""
    slab = trimesh.creation.extrude_polygon(outline, top_m - bottom_m, engine="earcut")
    return solid(slab.vertices + [0, 0, bottom_m], slab.faces, color)


def wall(face: shapely.Polygon, start: tuple[float, float], end: tuple[float, float], thickness_m: float, color: Colour) -> Body:
    """Return an upright slab to the left of the line from ``start`` to ``end``.

    ``face`` is its shape (metres from ``start``, metres up), which may have holes.
    """
    slab = plate(face, 0.0, thickness_m, color)
    direction = np.subtract(end, start) / np.linalg.norm(np.subtract(end, start))
    # axes along the wall, up, and outwards from its face: right-handed, so triangles stay counter-clockwise
    axes = np.array([[direction[0], direction[1], 0], [0, 0, 1], [direction[1], -direction[0], 0]])
    left = np.array([-direction[1], direction[0], 0]) * thickness_m
    return solid(slab.vertices_m @ axes + [start[0], start[1], 0] + left, slab.triangles, color)


def block(size_m: Vector, cells: tuple[int, int, int], color: Colour, exponent: float = 8.0) -> Body:
    """Return a rounded box centred on the origin: 4 (a b + b c + c a) triangles for a x b x c ``cells``.

    It is a superellipsoid; a higher ``exponent`` makes sharper edges.
    """
    points, triangles = cell_box(cells)
    return solid(superellipsoid(points, exponent) * np.asarray(size_m) / 2, triangles, color)


def superellipsoid(points: np.ndarray, exponent: float) -> np.ndarray:
    """Project points (n, 3) of cubes centred on the origin onto superellipsoids of an exponent, towards the centre."""
    longest = np.abs(points).max(axis=1, keepdims=True)
    length = (np.abs(points) ** exponent).sum(axis=1, keepdims=True) ** (1 / exponent)
    return points * longest / np.maximum(length, 1e-12)


def cell_box(cells: tuple[int, int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface of the cube [-1, 1]^3 divided into cells: unique vertices (n, 3) and triangles (m, 3)."""
    steps = np.asarray(cells)
    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        i, j = (grid.ravel() for grid in np.meshgrid(np.arange(steps[u]), np.arange(steps[v]), indexing="ij"))
        for side in (0, steps[axis]):
            square = np.empty((len(i), 4, 3), int)
            square[..., axis] = side
            square[..., u] = np.stack([i, i + 1, i + 1, i], axis=1)
            square[..., v] = np.stack([j, j, j + 1, j + 1], axis=1)
            quads.append(square if side else square[:, ::-1])
    square = np.concatenate(quads)
    nodes, index = np.unique(square.reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    return 2.0 * nodes / steps - 1.0, np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])


def loft(loops_m: np.ndarray, color: Colour) -> Body:
    """Return a skin over closed loops (k, sides, 3), closed at both ends: 2 k ``sides`` triangles.

    Each loop is counter-clockwise seen from the next one.
    """
    loops = np.asarray(loops_m, np.float64)
    return solid(*_loft_mesh(loops, loops[0].mean(axis=0), loops[-1].mean(axis=0)), color)


def arc(centre: Vector, radius_m: float, first_deg: float, last_deg: float, point_count: int) -> np.ndarray:
    """Return points (n, 3) on a horizontal circle, counter-clockwise from east."""
    angle = np.radians(np.linspace(first_deg, last_deg, point_count))
    return np.asarray(centre) + radius_m * np.stack([np.cos(angle), np.sin(angle), np.zeros(point_count)], axis=1)


def circle(centre: tuple[float, float], radius_m: float, point_count: int) -> list[tuple[float, float]]:
    """Return a circular, counter-clockwise section (radius, height) for ``ring``."""
    angles = 2 * np.pi * np.arange(point_count) / point_count
    return [(centre[0] + radius_m * np.cos(angle), centre[1] + radius_m * np.sin(angle)) for angle in angles]


def _revolve(profile: np.ndarray, sides: int) -> np.ndarray:
    """Return loops (k, sides, 3): profile points (k, 2) rotated about the up axis."""
    angle = 2 * np.pi * np.arange(sides) / sides
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    horizontal = profile[:, None, :1] * directions
    return np.concatenate([horizontal, np.broadcast_to(profile[:, None, 1:], (*horizontal.shape[:2], 1))], axis=2)


def _loft_mesh(loops: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and triangles of a skin over loops (k, sides, 3).

    Triangle fans round the points ``first`` and ``last`` (3,) close its ends.
    """
    k, sides = loops.shape[:2]
    j = np.arange(sides)
    next_side = (j + 1) % sides
    bottom, top = k * sides, k * sides + 1
    fans = [
        np.stack([np.full(sides, bottom), next_side, j], axis=1),
        np.stack([np.full(sides, top), bottom - sides + j, bottom - sides + next_side], axis=1),
    ]
    walls = _walls(np.arange(k - 1), np.arange(1, k), sides)
    return np.concatenate([loops.reshape(-1, 3), [first, last]]), np.concatenate([walls, *fans])


def _walls(lower: np.ndarray, upper: np.ndarray, sides: int) -> np.ndarray:
    """Return the triangles between the loops with numbers ``lower`` and those with numbers ``upper``, two per side."""
    j = np.arange(sides)
    next_side = (j + 1) % sides
    a, b = lower[:, None] * sides + j, lower[:, None] * sides + next_side
    c, d = upper[:, None] * sides + next_side, upper[:, None] * sides + j
    return np.concatenate([np.stack([a, b, c], axis=-1).reshape(-1, 3), np.stack([a, c, d], axis=-1).reshape(-1, 3)])
