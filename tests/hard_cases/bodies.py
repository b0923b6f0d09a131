"""Bodies, views and error figures that the hard cases share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import binary_erosion

from skugga.shadows.truth.metrics import ErrorMetrics, MetricCoverage, error_metrics, interior_region, metric_coverage
from skugga.shadows.truth.truth import Truth
from skugga.terrain.gbuffer.resolve import RELIEF
from tests.hard_cases.cases import Seen
from tests.shadows.boxes import box

FLOOR = {"flat": {"size": [100, 100], "cells": [10, 10]}}
"""Level ground, 100 m a side."""

SPOT: dict[str, Any] = {"kind": "spot", "position": [-14, -18, 24], "target": [2, 2, 0], "cutoff": 50}
"""A lamp in the south-west that shines on the middle of the floor."""


def eye(at: Any, target: Any, fov: float = 60.0) -> dict[str, Any]:
    """Return a view of a level: metres east, north and up."""
    return {"kind": "perspective", "eye": list(at), "target": list(target), "fov": fov}


EYES = {
    "in the shadow": eye((2, 5, 1), (6, 20, 0)),
    "before a wall that the light does not reach": eye((0, 3.05, 2), (0.5, 8, 1.2), fov=90),
    "in the plane of the lit cap": eye((20, 20, 5), (0, 2, 4)),
    "in the body": eye((0.3, 0.2, 2), (1, 5, 1), fov=100),
    "in the shadow, towards the house": eye((2, 8, 1), (0, 0, 3)),
    "in the shadow, towards the light": eye((2, 6, 0.5), (-2, -6, 8)),
    "looking along the lit cap": eye((20, 20, 5), (0, 2, 5)),
}
"""Eyes round a house of 8 by 6 by 5 m at the middle of the floor."""


def size_of(thorough: bool) -> tuple[int, int]:
    """Return the columns and rows of a case's pictures."""
    return (288, 216) if thorough else (120, 90)


def _held(seen: Seen, truth: Truth | None) -> Truth:
    """Return the truth (by rays, unless another is given) where the algorithm makes a promise.

    Projected shadows fall on the ground only, so truth is limited to the ground for them.
    """
    truth = truth or seen.truth
    if any(step.algorithm == "planar" for step in seen.plan.steps_under(seen.light)):
        truth = replace(truth, decidable=truth.decidable & (seen.buffer.kind == RELIEF))
    return truth


def errors(seen: Seen, truth: Truth | None = None) -> ErrorMetrics:
    """Return an algorithm's errors where it makes a promise."""
    return error_metrics(seen.visibility, _held(seen, truth), 1.0, seen.texels_px)


def interior_sight(seen: Seen, truth: Truth | None = None) -> MetricCoverage:
    """Return the coverage of the cast shadow by the interior of these errors."""
    truth = _held(seen, truth)
    return metric_coverage(seen.dark, truth, interior_region(truth, seen.texels_px))


def whole_sight(seen: Seen, truth: Truth | None = None) -> MetricCoverage:
    """Return the coverage of a figure that counts every decidable pixel."""
    truth = _held(seen, truth)
    return metric_coverage(seen.dark, truth, truth.decidable)


def truth_of_boxes(seen: Seen, boxes: list[trimesh.Trimesh], to_sun: np.ndarray) -> Truth:
    """Return the closed form of the sun's shadow of axis-aligned boxes on level ground.

    Ground is decidable if all its neighbours have the same class. A ray is in a box while it is between the box's planes along each
    axis (T. Kay and J. Kajiya, Ray Tracing Complex Scenes, 1986).
    """
    points = seen.buffer.position_frame_m + seen.buffer.frame.origin_earth_m
    dark = np.zeros(points.shape[:2], bool)
    for each in boxes:
        ends = (each.bounds[:, None, None] - points) / to_sun
        entered, left = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
        dark |= left > np.maximum(entered, 0.0)
    ground = seen.buffer.valid & (seen.buffer.kind == RELIEF)
    alike = [binary_erosion(ground & one, structure=np.ones((3, 3))) for one in (dark, ~dark)]
    return Truth(ground & ~dark, np.zeros_like(dark), alike[0] | alike[1], ground)


def not_a_number(seen: Seen) -> int:
    """Return the number of surface pixels without a visibility in [0, 1]."""
    return int((~((seen.visibility >= 0.0) & (seen.visibility <= 1.0)) & seen.buffer.valid).sum())


def differing(one: Seen, other: Seen) -> int:
    """Return the number of pixels that differ between two visibilities of one view."""
    return int((~np.isclose(one.visibility, other.visibility, rtol=0.0, atol=0.0, equal_nan=True)).sum())


def joined(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.util.concatenate(list(meshes))


def grounded(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with a pebble on the ground beside it: the engine then leaves bodies that hover where they are."""
    return joined(mesh, box((0.02, 0.02, 0.02), at_m=(14.0, 14.0)))


def soup(corners: Any) -> trimesh.Trimesh:
    """Return triangles without shared vertices, corner by corner."""
    points = np.array(corners, float)
    return trimesh.Trimesh(points.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3), process=False)


def without(mesh: trimesh.Trimesh, gone: np.ndarray | int) -> trimesh.Trimesh:
    """Return a mesh without some of its triangles."""
    return trimesh.Trimesh(mesh.vertices, np.delete(mesh.faces, gone, axis=0), process=False)


def inside_out(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def half_sphere(lower: bool) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(3, 4.0)
    ball.apply_translation([0.0, 0.0, 5.0])
    over = ball.triangles_center[:, 2] > 5.0
    return without(ball, np.flatnonzero(over if lower else ~over))


def sheet() -> trimesh.Trimesh:
    return soup([[[-4, -3, 3], [4, -3, 2], [4, 3, 5]], [[-4, -3, 3], [4, 3, 5], [-4, 3, 4]]])


def three_walls() -> trimesh.Trimesh:
    """Return three walls that share an upright edge."""
    ends = [[5 * np.cos(turn), 5 * np.sin(turn)] for turn in (0.3, 2.4, 4.5)]
    return soup([t for x, y in ends for t in ([[0, 0, 0], [x, y, 0], [x, y, 6]], [[0, 0, 0], [x, y, 6], [0, 0, 6]])])


def plates(count: int, gap_m: float = 0.05) -> trimesh.Trimesh:
    """Return squares of 6 m above one another, the lowest one metre up."""
    square = [[[-3, -3], [3, -3], [3, 3]], [[-3, -3], [3, 3], [-3, 3]]]
    return grounded(soup([[[x, y, 1 + gap_m * n] for x, y in corners] for n in range(count) for corners in square]))
