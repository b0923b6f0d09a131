"""Roofs over footprints of any outline: planes of one slope, whose ridges, hips and valleys are the footprint's straight skeleton.

- A plane rises inwards from each side of the footprint. It covers what the side passes over while all sides move inwards at one
  speed: O. Aichholzer and others 1995, "A novel type of skeleton for polygons". Courtyards are holes.
- A *hipped* roof has these planes alone.
- A *pitched* roof ends its ridges at gables: the plane of a side is removed where it is one triangle between two sides that stand
  nearly at right angles to it. The ridge between those two sides is extended to the gable.
- The library ``py_straight_skeleton`` computes the skeleton (P. Felkel and S. Obdrzalek 1998, "Straight skeleton implementation",
  with changes). Its result is checked: the planes have to tile the footprint.
"""

from __future__ import annotations

from threading import Lock
from typing import Any, NamedTuple

import numpy as np

from skugga.terrain.meshes.block_triangles import next_corners
from skugga.terrain.meshes.roofs import MAX_CORNER_COSINE

MAX_SKELETON_WORK = 4_000_000
"""Upper bound of the sum, over a file's footprints, of the squared numbers of corners of those that need a skeleton.

The library takes some 20 to 40 microseconds for each: up to three minutes.
"""

MAX_SKELETON_CORNERS = 100
"""Maximum number of corners of a footprint under a sloped roof. Its skeleton takes 0.1 s, or a quarter with half of them."""

MAX_STEPS_PER_CORNER = 100
"""Maximum number of events per corner, so that the library ends. Footprints take at most four."""

JITTER_M = 0.0003
"""Maximum shift of corners for a second attempt. The library fails if wavefronts meet at one point in certain ways."""

MAX_RUN_ERROR_M = 0.02
"""Maximum difference between the run of a point and its distance from a side whose plane meets in it, metres."""

GABLE_FACES = 3
"""Number of planes that meet in the end of a ridge before a gable."""

_lock = Lock()  # the library numbers its vertices by counters of its classes, which each skeleton resets


class RoofFaces(NamedTuple):
    """The planes of a sloped roof over a footprint of n corners.

    Attributes
    ----------
    corners_m
        Corners (n, 2) of the footprint, metres. The building is on the left of each ring.
    ring_ends
        End index of each ring in the corners.
    points_m
        Points (k, 2) of ridges, hips and valleys above the footprint, metres.
    runs_m
        Distance (k,) of each point from the sides whose planes meet in it, along the ground, metres. Slope times run is the rise.
    faces
        Indices of the vertices around the plane of each side, counter-clockwise from the side's first corner: corners below n,
        points from n on.
    is_gable
        Mask (n,) of the sides with a gable, the upright triangle of their face.
    """

    corners_m: np.ndarray
    ring_ends: np.ndarray
    points_m: np.ndarray
    runs_m: np.ndarray
    faces: list[list[int]]
    is_gable: np.ndarray


def skeleton_faces(corners_m: np.ndarray, ring_ends: np.ndarray, has_gables: bool) -> RoofFaces | None:
    """Return the planes of a roof over a footprint; ``None`` if it has too many corners or its skeleton cannot be computed."""
    if len(corners_m) > MAX_SKELETON_CORNERS:
        return None
    skeleton = _skeleton(corners_m, corners_m, ring_ends)
    if skeleton is None:
        jitter = np.random.default_rng(len(corners_m)).uniform(-JITTER_M, JITTER_M, corners_m.shape)
        skeleton = _skeleton(corners_m, corners_m + jitter, ring_ends)
    if skeleton is None:
        return None
    points, runs, faces = skeleton
    roof = RoofFaces(corners_m, ring_ends, points, runs, faces, np.zeros(len(corners_m), np.bool_))
    return _with_gables(roof) if has_gables else roof


def _skeleton(
    corners_m: np.ndarray, outline_m: np.ndarray, ring_ends: np.ndarray
) -> tuple[np.ndarray, np.ndarray, list[list[int]]] | None:
    """Return the points, runs and faces of a footprint's straight skeleton, or ``None`` on failure.

    ``outline_m`` (n, 2) are the corners that the library gets: those of the footprint, or nearly.
    """
    rings = [[(float(x), float(y)) for x, y in ring] for ring in np.split(outline_m, ring_ends[:-1])]
    numbers = {position: number for number, position in enumerate(position for ring in rings for position in ring)}
    count = len(corners_m)
    if len(numbers) < count:  # a corner of two rings
        return None
    try:
        with _lock:
            skeleton = _compute_skeleton(rings)
            nodes = [(float(node.position.x), float(node.position.y), float(node.time)) for node in skeleton.nodes]
            loops = [list(face[:-1]) for face in skeleton.get_faces()]
    except Exception:  # the library raises errors of many types where it does not find its way
        return None
    corner_of_node = [numbers.get(node[:2], -1) if node[2] == 0.0 else -1 for node in nodes]
    points = np.array([node for node, corner in zip(nodes, corner_of_node, strict=True) if corner < 0]).reshape(-1, 3)
    if len(loops) != count or len(nodes) - len(points) != count or not np.isfinite(points).all():
        return None
    point = iter(range(count, count + len(points)))
    vertex = [corner if corner >= 0 else next(point) for corner in corner_of_node]
    faces: list[list[int]] = [[]] * count
    for loop in loops:
        faces[vertex[loop[0]]] = [vertex[node] for node in loop]
    if not all(faces) or not _has_one_slope(corners_m, ring_ends, points, faces):
        return None
    return points[:, :2], points[:, 2], faces


def _compute_skeleton(rings: list[list[tuple[float, float]]]) -> Any:
    """Return the library's skeleton of a polygon with holes. Raises ``RuntimeError`` if it takes too many steps."""
    from py_straight_skeleton import algorithm

    tracer = algorithm.NoopAlgorithmTracer()
    tracer.on_step_begin = _check_steps
    algorithm.set_global_algorithm_tracer(tracer)
    return algorithm.StraightSkeletonAlgorithm().compute_skeleton(rings[0], rings[1:])


def _check_steps(step: int, time: float, algorithm: Any) -> None:
    """Raise ``RuntimeError`` if an algorithm of the library takes too many steps."""
    if step > MAX_STEPS_PER_CORNER * len(algorithm.original_edges):
        raise RuntimeError(f"skeleton: more than {MAX_STEPS_PER_CORNER} steps per corner")


def _has_one_slope(corners_m: np.ndarray, ring_ends: np.ndarray, points: np.ndarray, faces: list[list[int]]) -> bool:
    """Return whether the runs of the points (k, 3) are their distances from the sides of all faces that they belong to."""
    side = corners_m[next_corners(ring_ends)] - corners_m
    inward = np.column_stack([-side[:, 1], side[:, 0]]) / np.maximum(np.linalg.norm(side, axis=1), 1e-12)[:, None]
    count = len(corners_m)
    face = np.array([number for number, loop in enumerate(faces) for vertex in loop if vertex >= count], np.int64)
    point = np.array([vertex - count for loop in faces for vertex in loop if vertex >= count], np.int64)
    distance = np.einsum("ij,ij->i", points[point, :2] - corners_m[face], inward[face])
    return bool((np.abs(distance - points[point, 2]) <= MAX_RUN_ERROR_M).all() and (points[:, 2] > 0.0).all())


def _with_gables(roof: RoofFaces) -> RoofFaces:
    """Return the roof with gables in place of the hips that end its ridges.

    A gable is as wide as its side, and its apex lies where the planes of the neighbouring sides intersect above that side.
    """
    count = len(roof.corners_m)
    following = next_corners(roof.ring_ends)
    side = roof.corners_m[following] - roof.corners_m
    length = np.linalg.norm(side, axis=1)
    direction = side / np.maximum(length, 1e-12)[:, None]
    previous = np.empty(count, np.int64)
    previous[following] = np.arange(count)
    turn_cosine = np.einsum("ij,ij->i", direction[previous], direction)
    turn_sine = direction[previous, 0] * direction[:, 1] - direction[previous, 1] * direction[:, 0]
    is_square = (np.abs(turn_cosine) <= MAX_CORNER_COSINE) & (turn_sine > 0.0)
    face_counts = np.bincount([vertex for face in roof.faces for vertex in face], minlength=count + len(roof.points_m))
    points, runs, is_gable = roof.points_m.copy(), roof.runs_m.copy(), roof.is_gable.copy()
    for number, face in enumerate(roof.faces):
        end = following[number]
        if len(face) != 3 or face_counts[face[2]] != GABLE_FACES or not (is_square[number] and is_square[end]):
            continue
        share = turn_sine[end] / (turn_sine[number] + turn_sine[end])
        points[face[2] - count] = roof.corners_m[number] + share * side[number]
        runs[face[2] - count] = share * length[number] * turn_sine[number]
        is_gable[number] = True
    return roof._replace(points_m=points, runs_m=runs, is_gable=is_gable)
