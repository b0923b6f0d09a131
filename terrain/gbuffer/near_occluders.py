"""The share of the light from all directions that meshes and trees near a point take from it (ambient occlusion).

The share is weighted by the cosine from the point's normal. Of a mesh it is the form factor of its triangles above the point's
horizon (J. H. Lambert 1760, "Photometria"; D. R. Baum, H. E. Rushmeier and J. M. Winget 1989, "Improving radiosity solutions
through the use of analytically determined form-factors"), exact beside one convex body. A body of many triangles that is about as
wide as it is high, such as a rock, is a sphere (J. M. Snyder 1996, "Area light sources for real-time graphics"); other bodies of
many triangles hide nothing. Crowns, and bodies that are far away for their size, are spheres by a formula that costs less. Bodies
hide their shares independently of each other.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE
from skugga.terrain.gbuffer.resolve import FOREST, MESHES
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.meshes.solids import Solids

MIN_HIDDEN_SHARE, MIN_SHARE_OF_CROWN = 0.02, 0.04
"""Share of the light that a body and a crown hide at the distance from which on they are ignored."""

FADING_SHARE = 0.5
"""Share of this distance from which on what a body hides fades to 0."""

MIN_FAR_EDGES, MIN_EDGES_OF_SMALL, SMALL_SHARE = 2.5, 1.0, 0.003
"""Distances, in longest edges, from which on a triangle counts as its middle: any, and one that hides at most this share."""

FAR_RADII = 1.5, 2.25
"""Distances, in radii of the sphere round a body, between which its triangles give way to a sphere."""

MAX_BODY_TRIANGLES = 48
"""Number of triangles up to which a body is taken as it is."""

ROUND_EXTENTS = 0.6, 1.7
"""Extents of a round body, as shares of those of the sphere with its volume."""

CROWN_OPACITY, CROWN_RADIUS_SHARE = 0.7, 0.9
"""Share of the light that foliage blocks, and the radius of a crown's sphere as a share of the crown's."""

REFLECTED_SHARE = 0.25
"""Share of the hidden light that comes back from what hides it."""

MIN_HEIGHT_M = 1e-3
"""Height above a point's plane, metres, below which nothing hides light: faces in the same plane differ by rounding."""

GRID_CELLS = 256
"""Largest number of cells along a side of the grid in which the bodies near a point are looked up."""

LATTICE_PX = 4
"""Distance of the pixels whose shares are always computed. Between them shares are interpolated on even surfaces."""

MAX_EVEN_DIFFERENCE, MIN_EVEN_COSINE, MIN_LEAF_COSINE = 0.06, 0.98, 0.8
"""Largest difference of shares, and smallest cosine between normals, of an even surface; and that cosine in foliage."""

MIN_CORNER_WEIGHT = 0.7
"""Smallest share of the weights of bilinear interpolation that corners on a pixel's own surface must have."""

MAX_STEP_SHARE = 0.02
"""Largest distance of a point from another one's plane, and of two leaves, as a share of the distance from the eye."""


class NearOccluders(NamedTuple):
    """The bodies and crowns of a view, in a frame.

    Attributes
    ----------
    corners
        float64 (t, 3, 3), the triangles' corners, metres, counter-clockwise from outside.
    middles
        float64 (t, 8), the middle of each triangle, metres, its outward normal, as long as its area in square metres, the
        square of its longest edge, and its area.
    first_triangle
        int64 (b + 1,), the triangles of body k are those from ``first_triangle[k]`` to before ``first_triangle[k + 1]``; a sphere
        has none.
    is_closed
        bool (b,), whether a body's surface is closed, so that faces that are turned away do not count.
    spheres
        float64 (b, 4), the middle of each body and the radius of a sphere round it, metres.
    far_radius_m
        float64 (b,), the radius of the sphere that hides as much light from far away.
    opacity
        float64 (b,), the share of the light that a body blocks.
    reach_m
        float64 (b,), the distance from the middle beyond which a body hides nothing.
    is_crown
        bool (b,), whether it is a crown.
    """

    corners: np.ndarray
    middles: np.ndarray
    first_triangle: np.ndarray
    is_closed: np.ndarray
    spheres: np.ndarray
    far_radius_m: np.ndarray
    opacity: np.ndarray
    reach_m: np.ndarray
    is_crown: np.ndarray


class OccluderGrid(NamedTuple):
    """The bodies that reach each cell of a horizontal grid: those of cell k are ``bodies[first[k] : first[k + 1]]``.

    ``low_m`` (2,) is the corner of the grid in the frame, ``cell_m`` the side of a cell, ``shape`` the cells along x and y.
    """

    low_m: np.ndarray
    cell_m: float
    shape: tuple[int, int]
    first: np.ndarray
    bodies: np.ndarray


def near_occluders(solids: Solids | None, vertices_frame_m: np.ndarray | None, trees: TreeInstances | None) -> NearOccluders:
    """Return the meshes and trees of a view as occluders. ``vertices_frame_m`` (n, 3) are those of ``solids`` in the frame."""
    meshes = _bodies_of_meshes(solids, vertices_frame_m)
    if trees is None or not len(trees):
        return meshes
    sizes = trees.quad_sizes_m.astype(np.float64)
    spheres = np.column_stack([trees.base_frame_m, CROWN_RADIUS_SHARE * sizes[:, 0]])
    spheres[:, 2] += sizes[:, 3]
    count, end = len(spheres), meshes.first_triangle[-1]
    return NearOccluders(
        meshes.corners, meshes.middles, np.concatenate([meshes.first_triangle, np.full(count, end)]),
        np.concatenate([meshes.is_closed, np.ones(count, np.bool_)]), np.concatenate([meshes.spheres, spheres]),
        np.concatenate([meshes.far_radius_m, spheres[:, 3]]),
        np.concatenate([meshes.opacity, np.full(count, CROWN_OPACITY)]),
        np.concatenate([meshes.reach_m, spheres[:, 3] * np.sqrt(CROWN_OPACITY / MIN_SHARE_OF_CROWN)]),
        np.concatenate([meshes.is_crown, np.ones(count, np.bool_)]),
    )  # fmt: skip


def _bodies_of_meshes(solids: Solids | None, vertices: np.ndarray | None) -> NearOccluders:
    """Return the bodies of ``solids`` that hide light. ``vertices`` (n, 3) are those of ``solids`` in the frame."""
    if solids is None or vertices is None:
        none = np.zeros(0)
        return NearOccluders(
            np.zeros((0, 3, 3)), np.zeros((0, 8)), np.zeros(1, np.int64), none.astype(np.bool_), np.zeros((0, 4)), none, none, none,
            none.astype(np.bool_),
        )  # fmt: skip
    order = np.argsort(solids.body_index, kind="stable")
    bodies, starts, counts = np.unique(solids.body_index[order], return_index=True, return_counts=True)
    corners, is_closed = vertices[solids.triangles[order]], np.array(solids.is_closed, np.bool_)[bodies]
    low, high = np.minimum.reduceat(corners.min(axis=1), starts), np.maximum.reduceat(corners.max(axis=1), starts)
    middle, extents = 0.5 * (low + high), 0.5 * (high - low)
    edges = np.roll(corners, -1, axis=1) - corners
    normals = 0.5 * np.cross(edges[:, 0], -edges[:, 2])
    areas = np.linalg.norm(normals, axis=1)
    longest = np.square(edges).sum(axis=2).max(axis=1)
    # A closed body's volume is that of the pyramids from its middle to its faces.
    heights = np.einsum("ij,ij->i", corners[:, 0] - np.repeat(middle, counts, axis=0), normals)
    volume = np.abs(np.add.reduceat(heights, starts)) / 3.0
    round_radius = np.cbrt(0.75 * volume / np.pi)
    fits = (extents.min(axis=1) >= ROUND_EXTENTS[0] * round_radius) & (extents.max(axis=1) <= ROUND_EXTENTS[1] * round_radius)
    has_few, is_round = counts <= MAX_BODY_TRIANGLES, is_closed & fits
    kept = has_few | is_round
    # A convex body covers a quarter of its area on the mean over all directions (A. Cauchy 1832).
    far_radius = np.where(has_few, np.sqrt(np.add.reduceat(areas, starts) / (4.0 * np.pi)), round_radius)[kept]
    radius = np.where(has_few, np.linalg.norm(extents, axis=1), round_radius)
    chosen = np.repeat(has_few, counts)
    middles = np.column_stack([corners.mean(axis=1), normals, longest, areas])[chosen]
    first = np.concatenate([[0], np.cumsum(np.where(has_few, counts, 0)[kept])]).astype(np.int64)
    return NearOccluders(
        corners[chosen], middles, first, is_closed[kept], np.column_stack([middle, radius])[kept], far_radius,
        np.ones(len(far_radius)), far_radius / np.sqrt(MIN_HIDDEN_SHARE), np.zeros(len(far_radius), np.bool_),
    )  # fmt: skip


def occluder_grid(occluders: NearOccluders) -> OccluderGrid:
    """Return the grid of some bodies, of which there are some."""
    middle, reach = occluders.spheres[:, :2], occluders.reach_m[:, None]
    low, high = (middle - reach).min(axis=0), (middle + reach).max(axis=0)
    cell_m = max(float((high - low).max()) / GRID_CELLS, 0.5 * float(np.median(occluders.reach_m)))
    shape = tuple(int(side) for side in (high - low) // cell_m + 1)
    counts = np.zeros(shape[0] * shape[1] + 1, np.int64)
    _count_reached_cells(middle, occluders.reach_m, low, cell_m, shape, counts)
    first = np.cumsum(counts)
    bodies = np.empty(first[-1], np.int32)
    _list_reached_cells(middle, occluders.reach_m, low, cell_m, shape, first[:-1].copy(), bodies)
    return OccluderGrid(low, cell_m, (shape[0], shape[1]), first, bodies)


@compiled
def _count_reached_cells(middle, reach, low, cell, shape, counts):
    """Add to ``counts`` (cells + 1,), one place behind, the number of bodies that reach each cell of an ``OccluderGrid``."""
    for body in range(len(middle)):
        x0, x1, y0, y1 = _reached_cells(middle, reach, low, cell, shape, body)
        for x in range(x0, x1):
            for y in range(y0, y1):
                counts[x * shape[1] + y + 1] += 1


@compiled
def _list_reached_cells(middle, reach, low, cell, shape, next_entry, bodies):
    """Write the bodies that reach each cell to ``bodies``, from the cell's ``next_entry`` (cells,) on, which is moved."""
    for body in range(len(middle)):
        x0, x1, y0, y1 = _reached_cells(middle, reach, low, cell, shape, body)
        for x in range(x0, x1):
            for y in range(y0, y1):
                bodies[next_entry[x * shape[1] + y]] = body
                next_entry[x * shape[1] + y] += 1


@internal
def _reached_cells(middle, reach, low, cell, shape, body):
    """Return the first and the last cell, exclusive, along x and along y, that a body reaches."""
    x, y, r = middle[body, 0] - low[0], middle[body, 1] - low[1], reach[body]
    return (
        max(int((x - r) / cell), 0), min(int((x + r) / cell) + 1, shape[0]),
        max(int((y - r) / cell), 0), min(int((y + r) / cell) + 1, shape[1]),
    )  # fmt: skip


def _cache_key(buffer: GeometryBuffer, solids: Solids | None) -> tuple[object, ...]:
    """Return the cache key of ``open_share``: the buffer's points, and the meshes."""
    return buffer.position_frame_m, buffer.tree_instances, solids


@cached("scene", 64 * MIB, key=_cache_key, max_entries=1)
def open_share(buffer: GeometryBuffer, solids: Solids | None) -> np.ndarray:
    """Return the share of the light from all directions, float32 (rows, cols), that reaches a perspective view's points.

    Light is reflected by what hides it. Points off the surface get 1. The share does not depend on the sun.
    """
    view = buffer.view
    assert isinstance(view, PerspectiveView)
    out = np.ones(buffer.valid.shape, np.float32)
    trees = buffer.tree_instances
    occluders = near_occluders(solids, buffer.solids_frame_m, trees)
    if not len(occluders.spheres):
        return out
    grid = occluder_grid(occluders)
    rows = buffer.valid.shape[0] if buffer.first_sample_row is None else buffer.first_sample_row
    normal = np.where((buffer.surface_kind == MESHES)[..., None], buffer.normal_frame, buffer.shading_normal_frame)
    points = buffer.position_frame_m, normal, buffer.surface_kind, buffer.valid
    # Parts of a picture share the lattice.
    first_row, first_col = (-int(np.floor(start / view.step_px)) % LATTICE_PX for start in (view.row0, view.col0))
    eye, _ = view.in_frame(buffer.frame)
    starts = np.arange(first_row - LATTICE_PX, rows, LATTICE_PX)
    shares = np.full(buffer.valid.shape, np.nan, np.float32)
    run_in_chunks(len(starts), _write_lattice_shares, starts, first_col, rows, *points, occluders, grid, shares)
    run_in_chunks(len(starts), _write_shares_between, starts, first_col, rows, eye, *points, occluders, grid, shares, out)
    if buffer.sample_pixels is not None:
        pixels = [(index // EDGE_SAMPLES_PER_SIDE).reshape(-1, view.cols) for index in buffer.sample_pixels]
        run_in_chunks(len(out) - rows, _write_shares_of_samples, rows, *pixels, eye, *points, occluders, grid, out)
    return out


@compiled
def _write_lattice_shares(first, last, starts, first_col, rows, position, normal, kind, valid, occluders, grid, out):
    """Write the shares of the lattice's points to ``out`` (rows, cols) for the rows ``starts[first:last]``."""
    polygon = np.empty((5, 3))
    for k in range(first, last):
        i = starts[k]
        if 0 <= i < rows:
            for j in range(first_col, valid.shape[1], LATTICE_PX):
                if valid[i, j]:
                    out[i, j] = _open_share_at(position, normal, kind, i, j, occluders, grid, polygon)


@compiled
def _write_shares_between(first, last, starts, first_col, rows, eye, position, normal, kind, valid, occluders, grid, lattice, out):
    """Write the shares of the pixels in squares of the lattice to ``out``, for the squares in rows from ``starts[first:last]`` on.

    A pixel gets the mean of those corners of its square, by ``lattice`` (rows, cols), that lie on its own surface, weighted as in
    bilinear interpolation (J. Kopf, M. F. Cohen, D. Lischinski and M. Uyttendaele 2007, "Joint bilateral upsampling"). Its own
    share is computed if they differ much, and where they weigh little, as at the foot of a wall.
    """
    cols, side = valid.shape[1], LATTICE_PX
    polygon = np.empty((5, 3))
    for k in range(first, last):
        i0 = starts[k]
        for j0 in range(first_col - side, cols, side):
            for i in range(max(i0, 0), min(i0 + side, rows)):
                for j in range(max(j0, 0), min(j0 + side, cols)):
                    if not valid[i, j]:
                        continue
                    low, high, total, weights = 2.0, -1.0, 0.0, 0.0
                    for corner in range(4):
                        r, c = i0 + side * (corner // 2), j0 + side * (corner % 2)
                        if r < 0 or c < 0 or r >= rows or c >= cols or not valid[r, c]:
                            continue
                        if _is_even(position, normal, kind, eye, i, j, r, c):
                            weight = (side - abs(i - r)) * (side - abs(j - c))
                            share = lattice[r, c]
                            low, high = min(low, share), max(high, share)
                            total += weight * share
                            weights += weight
                    if weights >= MIN_CORNER_WEIGHT * side * side and high - low < MAX_EVEN_DIFFERENCE:
                        out[i, j] = total / weights
                    else:
                        out[i, j] = _open_share_at(position, normal, kind, i, j, occluders, grid, polygon)


@compiled
def _write_shares_of_samples(first, last, rows, pixel_row, pixel_col, eye, position, normal, kind, valid, occluders, grid, out):
    """Write the shares of the samples in the rows [``first``, ``last``) below the first ``rows`` to ``out`` (all rows, cols).

    A sample of the pixel ``pixel_row`` and ``pixel_col`` (sample rows, cols) takes the share of this or of a neighbouring pixel on
    the same surface, if there is one.
    """
    polygon = np.empty((5, 3))
    cols = valid.shape[1]
    for s in range(first, last):
        i = rows + s
        for j in range(cols):
            if not valid[i, j]:
                continue
            r, c, nearest, k, m = pixel_row[s, j], pixel_col[s, j], np.inf, -1, -1
            for row in range(max(r - 1, 0), min(r + 2, rows)):
                for col in range(max(c - 1, 0), min(c + 2, cols)):
                    if valid[row, col] and _is_even(position, normal, kind, eye, i, j, row, col):
                        x, y = position[i, j, 0] - position[row, col, 0], position[i, j, 1] - position[row, col, 1]
                        z = position[i, j, 2] - position[row, col, 2]
                        if x * x + y * y + z * z < nearest:
                            nearest, k, m = x * x + y * y + z * z, row, col
            out[i, j] = out[k, m] if k >= 0 else _open_share_at(position, normal, kind, i, j, occluders, grid, polygon)


@internal
def _is_even(position, normal, kind, eye, i, j, k, m):
    """Return whether the points of two pixels may lie on one even surface, or in the foliage of one tree."""
    if kind[i, j] != kind[k, m]:
        return False
    cosine = normal[i, j, 0] * normal[k, m, 0] + normal[i, j, 1] * normal[k, m, 1] + normal[i, j, 2] * normal[k, m, 2]
    x, y, z = position[k, m, 0], position[k, m, 1], position[k, m, 2]
    dx, dy, dz = position[i, j, 0] - x, position[i, j, 1] - y, position[i, j, 2] - z
    x, y, z = x - eye[0], y - eye[1], z - eye[2]
    limit = MAX_STEP_SHARE * np.sqrt(x * x + y * y + z * z)
    if kind[i, j] == FOREST:
        return cosine > MIN_LEAF_COSINE and dx * dx + dy * dy + dz * dz < limit * limit
    height = dx * normal[k, m, 0] + dy * normal[k, m, 1] + dz * normal[k, m, 2]
    return cosine > MIN_EVEN_COSINE and abs(height) < limit


@internal
def _open_share_at(position, normal, kind, i, j, occluders, grid, polygon):
    """Return the share of the light that reaches the point of a pixel. ``polygon`` (5, 3) is working memory.

    Arrays are read number by number: numba takes a reference to each slice, which would cost more than the work.
    """
    corners, middles, first_triangle, is_closed, spheres, far_radius_m, opacity, reach_m, is_crown = occluders
    low_m, cell_m, shape, first, bodies = grid
    px, py, pz = position[i, j, 0], position[i, j, 1], position[i, j, 2]
    x, y = int((px - low_m[0]) // cell_m), int((py - low_m[1]) // cell_m)
    share = 1.0
    if x < 0 or y < 0 or x >= shape[0] or y >= shape[1]:
        return np.float32(share)
    cell = x * shape[1] + y
    nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
    for entry in range(first[cell], first[cell + 1]):
        body = bodies[entry]
        radius = spheres[body, 3]
        dx, dy, dz = spheres[body, 0] - px, spheres[body, 1] - py, spheres[body, 2] - pz
        distance, reach = np.sqrt(dx * dx + dy * dy + dz * dz), reach_m[body]
        height = dx * nx + dy * ny + dz * nz
        if distance >= reach or height <= -radius:
            continue
        begin, end = first_triangle[body], first_triangle[body + 1]
        far_share = min(max((distance / radius - FAR_RADII[0]) / (FAR_RADII[1] - FAR_RADII[0]), 0.0), 1.0)
        hidden = 0.0
        if is_crown[body] or far_share > 0.0:
            far_share = 1.0 if is_crown[body] else far_share
            hidden = far_share * _share_behind_far_sphere(height, distance, far_radius_m[body], kind[i, j] == FOREST)
        if far_share < 1.0 and begin == end:
            hidden += (1.0 - far_share) * _share_behind_sphere(height, distance, radius)
        elif far_share < 1.0:
            near = 0.0
            for triangle in range(begin, end):
                vx, vy, vz = middles[triangle, 0] - px, middles[triangle, 1] - py, middles[triangle, 2] - pz
                square = vx * vx + vy * vy + vz * vz
                small_square = SMALL_SHARE * np.pi * square
                if square > MIN_FAR_EDGES**2 * middles[triangle, 6] or (
                    square > MIN_EDGES_OF_SMALL**2 * middles[triangle, 6] and middles[triangle, 7] < small_square
                ):
                    facing = -(middles[triangle, 3] * vx + middles[triangle, 4] * vy + middles[triangle, 5] * vz)
                    facing = max(facing, 0.0) if is_closed[body] else abs(facing)
                    near += max(vx * nx + vy * ny + vz * nz, 0.0) * facing / (np.pi * square * square)
                else:
                    near += _share_behind_triangle(
                        corners, triangle, px, py, pz, nx, ny, nz, is_closed[body], polygon
                    )  # fmt: skip
            hidden += (1.0 - far_share) * near
        fade = min((1.0 - distance / reach) / FADING_SHARE, 1.0)
        share *= 1.0 - min(hidden, 1.0) * fade * opacity[body] * (1.0 - REFLECTED_SHARE)
    return np.float32(share)


@internal
def _share_behind_far_sphere(height, distance, radius, is_leaf):
    """Return the share of the light that a sphere hides, by a formula without angles.

    It is exact straight above, and nearly so where the sphere touches the horizon (0.111 for 0.125 of half its distance as radius)
    and where the horizon halves it (0.0278 for 0.0288). ``height`` is that of the middle above the point's plane, metres. A leaf
    inside of a sphere or near to it belongs to the crown.
    """
    ratio = radius / max(distance, 1e-9)
    fade = 1.0
    if ratio >= 1.0:
        if is_leaf:
            return 0.0
        ratio = 1.0
    elif is_leaf:
        fade = min(2.0 * (1.0 / ratio - 1.0), 1.0)
    above = max(height / max(distance, 1e-9) + ratio, 0.0) / (1.0 + ratio)
    return min(ratio * above, 1.0) ** 2 * fade


@internal
def _share_behind_sphere(height, distance, radius):
    """Return the share of the light that a sphere hides, weighted by the cosine, with the part below the horizon left out.

    ``height`` is that of the middle above the point's plane, metres.
    """
    ratio = max(distance / radius, 1.0 + 1e-6)
    cosine = min(max(height / max(distance, 1e-9), -1.0), 1.0)
    square = ratio * ratio
    cut = 1.0 - square * cosine * cosine
    if cut <= 1e-6:
        return max(cosine, 0.0) / square
    edge = min(max(-cosine * np.sqrt((square - 1.0) / max(1.0 - cosine * cosine, 1e-12)), -1.0), 1.0)
    hidden = (cosine * np.arccos(edge) - np.sqrt(cut * (square - 1.0))) / square + np.arctan(np.sqrt(cut / (square - 1.0)))
    return hidden / np.pi


@internal
def _share_behind_triangle(corners, t, px, py, pz, nx, ny, nz, is_closed, polygon):
    """Return the form factor of triangle ``t`` of ``corners`` (n, 3, 3) from a point, without the part below the point's plane."""
    ax, ay, az = corners[t, 0, 0] - px, corners[t, 0, 1] - py, corners[t, 0, 2] - pz
    bx, by, bz = corners[t, 1, 0] - px, corners[t, 1, 1] - py, corners[t, 1, 2] - pz
    cx, cy, cz = corners[t, 2, 0] - px, corners[t, 2, 1] - py, corners[t, 2, 2] - pz
    # The volume of the tetrahedron is positive where the point is inside of the triangle's plane.
    if is_closed and ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx) >= 0.0:
        return 0.0
    ha, hb, hc = ax * nx + ay * ny + az * nz, bx * nx + by * ny + bz * nz, cx * nx + cy * ny + cz * nz
    if ha <= MIN_HEIGHT_M and hb <= MIN_HEIGHT_M and hc <= MIN_HEIGHT_M:
        return 0.0
    count = _add_clipped_edge(polygon, 0, ax, ay, az, ha, bx, by, bz, hb)
    count = _add_clipped_edge(polygon, count, bx, by, bz, hb, cx, cy, cz, hc)
    count = _add_clipped_edge(polygon, count, cx, cy, cz, hc, ax, ay, az, ha)
    total = 0.0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        ux, uy, uz = polygon[k, 0], polygon[k, 1], polygon[k, 2]
        vx, vy, vz = polygon[m, 0], polygon[m, 1], polygon[m, 2]
        along_normal = (uy * vz - uz * vy) * nx + (uz * vx - ux * vz) * ny + (ux * vy - uy * vx) * nz
        total += along_normal * _angle_by_sine(ux * vx + uy * vy + uz * vz)
    return abs(total)


@internal
def _angle_by_sine(cosine):
    """Return an angle, divided by its sine and by 2 pi, from its cosine, with an error below 0.0002.

    The rational fit is that of S. Hill and E. Heitz 2016, "Real-time area lighting: a journey from research to production".
    """
    x = abs(cosine)
    acute = (0.8543985 + (0.4965155 + 0.0145206 * x) * x) / (3.4175940 + (4.1616724 + x) * x)
    return acute if cosine > 0.0 else 0.5 / np.sqrt(max(1.0 - cosine * cosine, 1e-7)) - acute


@internal
def _add_clipped_edge(polygon, count, ax, ay, az, ha, bx, by, bz, hb):
    """Add the directions of the corner a, if it lies above the plane, and of the point where the edge to b crosses it.

    Returns the new ``count`` of directions. ``ha`` and ``hb`` are the corners' heights above the plane, metres.
    """
    if ha > MIN_HEIGHT_M:
        scale = 1.0 / np.sqrt(ax * ax + ay * ay + az * az)
        polygon[count, 0], polygon[count, 1], polygon[count, 2] = scale * ax, scale * ay, scale * az
        count += 1
    if (ha > MIN_HEIGHT_M) != (hb > MIN_HEIGHT_M):
        t = (MIN_HEIGHT_M - ha) / (hb - ha)
        x, y, z = ax + t * (bx - ax), ay + t * (by - ay), az + t * (bz - az)
        scale = 1.0 / np.sqrt(x * x + y * y + z * z)
        polygon[count, 0], polygon[count, 1], polygon[count, 2] = scale * x, scale * y, scale * z
        count += 1
    return count
