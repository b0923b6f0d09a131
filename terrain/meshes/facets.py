"""Normals of triangle meshes, and how far a mesh bends upwards around each of its triangles."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal, run_in_chunks


class NodeFaces(NamedTuple):
    """The faces around each of n nodes, in compressed form.

    Attributes
    ----------
    start
        int64 (n + 1,): the faces of node i are ``faces[start[i]:start[i + 1]]``.
    faces
        int32: numbers of faces, in increasing order for each node.
    """

    start: np.ndarray
    faces: np.ndarray


def node_faces(nodes: int, triangles: np.ndarray) -> NodeFaces:
    """Return the faces around each node of a mesh of triangles (m, 3). ``nodes`` is the number of nodes."""
    return NodeFaces(*_adjacent_faces(nodes, triangles))


def face_normals(position: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Return unit normals (m, 3) float32 of triangles (m, 3) of positions (n, 3); 0 for triangles without an area."""
    out = np.zeros((len(triangles), 3), np.float32)
    run_in_chunks(len(triangles), _face_normals, position, triangles, out)
    return out


@compiled
def _face_normals(first, last, position, triangles, out):
    """Write the unit normals of the triangles from ``first`` to ``last`` (exclusive) to ``out`` (m, 3), which must hold zeros."""
    for t in range(first, last):
        o, a, b = position[triangles[t, 0]], position[triangles[t, 1]], position[triangles[t, 2]]
        ax, ay, az = a[0] - o[0], a[1] - o[1], a[2] - o[2]
        bx, by, bz = b[0] - o[0], b[1] - o[1], b[2] - o[2]
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        if length > 0.0:
            out[t, 0], out[t, 1], out[t, 2] = x / length, y / length, z / length


def smooth_normals(normals: np.ndarray, adjacency: NodeFaces) -> np.ndarray:
    """Return unit normals (n, 3) float32 at nodes: the mean of the normals (m, 3) of the faces around each."""
    out = np.zeros((len(adjacency.start) - 1, 3), np.float32)
    run_in_chunks(len(out), _smooth_normals, normals, adjacency, out)
    return out


@compiled
def _smooth_normals(first, last, normals, adjacency, out):
    """Write the unit normals of the nodes from ``first`` to ``last`` (exclusive) to ``out`` (n, 3), which must hold zeros.

    ``normals`` (m, 3) are those of the faces, ``adjacency`` is a ``NodeFaces``.
    """
    for n in range(first, last):
        for i in range(adjacency.start[n], adjacency.start[n + 1]):
            for c in range(3):
                out[n, c] += normals[adjacency.faces[i], c]
        length = np.sqrt(out[n, 0] ** 2 + out[n, 1] ** 2 + out[n, 2] ** 2)
        if length > 0.0:
            for c in range(3):
                out[n, c] /= length


def creases(
    position: np.ndarray,
    normals: np.ndarray,
    triangles: np.ndarray,
    adjacency: NodeFaces,
    max_distance: float,
    selected: np.ndarray,
) -> np.ndarray:
    """Return how far a mesh bends upwards (m,) float32 around each face; 0 for faces outside the mask ``selected`` (m,).

    The bend is a distance between unit normals: the normal of the face, and that of a neighbour that shares a node with it and
    rises above its plane. The largest such distance below ``max_distance`` counts. A neighbour that bends downwards does not count,
    since it cannot occlude a face that the light shines on.
    """
    out = np.zeros(len(triangles), np.float32)
    run_in_chunks(len(triangles), _creases, position, normals, triangles, adjacency, max_distance, selected, out)
    return out


@compiled
def _adjacent_faces(nodes, triangles):
    """Return the fields ``start`` and ``faces`` of ``NodeFaces``. ``nodes`` is the number of nodes."""
    start = np.zeros(nodes + 1, np.int64)
    for t in range(len(triangles)):
        for k in range(3):
            start[triangles[t, k] + 1] += 1
    for n in range(nodes):
        start[n + 1] += start[n]
    face_list = np.empty(3 * len(triangles), np.int32)
    filled = start[:-1].copy()
    for t in range(len(triangles)):
        for k in range(3):
            n = triangles[t, k]
            face_list[filled[n]] = t
            filled[n] += 1
    return start, face_list


@compiled
def _creases(first, last, position, normals, triangles, adjacency, max_distance, selected, out):
    """Write the result of ``creases`` to ``out`` (m,) for the selected faces from ``first`` to ``last`` (exclusive).

    The other parameters are those of ``creases``.
    """
    for t in range(first, last):
        if not selected[t]:
            continue
        max_square = 0.0
        for k in range(3):
            n = triangles[t, k]
            for i in range(adjacency.start[n], adjacency.start[n + 1]):
                u = adjacency.faces[i]
                d = (
                    (normals[t, 0] - normals[u, 0]) ** 2
                    + (normals[t, 1] - normals[u, 1]) ** 2
                    + (normals[t, 2] - normals[u, 2]) ** 2
                )
                if (
                    d > max_square
                    and d < max_distance * max_distance
                    and _is_above_plane(position, triangles[u], position[triangles[t, 0]], normals[t])
                ):
                    max_square = d
        out[t] = np.sqrt(max_square)


@internal
def _is_above_plane(position, corners, point, normal):
    """Return whether a corner of a triangle lies above the plane through ``point`` with ``normal`` by more than rounding."""
    for k in range(3):
        x, y, z = (
            position[corners[k], 0] - point[0], position[corners[k], 1] - point[1], position[corners[k], 2] - point[2]
        )  # fmt: skip
        if normal[0] * x + normal[1] * y + normal[2] * z > 1e-6 * np.sqrt(x * x + y * y + z * z):
            return True
    return False
