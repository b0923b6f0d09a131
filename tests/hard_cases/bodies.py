"""Bodies, views and error figures that the hard cases share."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import binary_erosion

from skugga.shadows.planar import max_mesh_planes
from skugga.shadows.planar_receivers import find_receivers
from skugga.shadows.truth.metrics import ErrorMetrics, MetricCoverage, error_metrics, interior_region, metric_coverage
from skugga.shadows.truth.truth import Truth
from skugga.terrain.gbuffer.resolve import RELIEF
from tests.hard_cases.cases import RenderedView
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


def picture_size(thorough: bool) -> tuple[int, int]:
    """Return the columns and rows of a case's pictures."""
    return (288, 216) if thorough else (120, 90)


def _applicable_truth(rendered: RenderedView, truth: Truth | None) -> Truth:
    """Return the truth (by rays, unless another is given) where the algorithm makes a promise.

    Projected shadows fall on planes only, so truth is limited to the planes that receive them.
    """
    truth = truth or rendered.truth
    for step in rendered.plan.steps_of_light(rendered.light):
        if step.algorithm == "planar":
            receivers = find_receivers(rendered.buffer, rendered.scene, max_mesh_planes(step.settings))
            truth = replace(truth, decidable=truth.decidable & (receivers.plane_of_point > 0))
    return truth


def errors(rendered: RenderedView, truth: Truth | None = None) -> ErrorMetrics:
    """Return an algorithm's errors where it makes a promise."""
    return error_metrics(rendered.visibility, _applicable_truth(rendered, truth), 1.0, rendered.texels_px)


def interior_coverage(rendered: RenderedView, truth: Truth | None = None) -> MetricCoverage:
    """Return the coverage of the cast shadow by ``errors(...).interior``."""
    truth = _applicable_truth(rendered, truth)
    return metric_coverage(rendered.dark, truth, interior_region(truth, rendered.texels_px))


def decidable_coverage(rendered: RenderedView, truth: Truth | None = None) -> MetricCoverage:
    """Return the coverage of the cast shadow by all decidable pixels."""
    truth = _applicable_truth(rendered, truth)
    return metric_coverage(rendered.dark, truth, truth.decidable)


def truth_of_boxes(rendered: RenderedView, boxes: list[trimesh.Trimesh], to_sun: np.ndarray) -> Truth:
    """Return the closed form of the sun's shadow of axis-aligned boxes on level ground.

    Ground is decidable if all its neighbours have the same class. A ray is in a box while it is between the box's planes along each
    axis (T. Kay and J. Kajiya, Ray Tracing Complex Scenes, 1986).
    """
    points = rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m
    dark = np.zeros(points.shape[:2], bool)
    for mesh in boxes:
        ends = (mesh.bounds[:, None, None] - points) / to_sun
        entered, left = np.minimum(*ends).max(axis=-1), np.maximum(*ends).min(axis=-1)
        dark |= left > np.maximum(entered, 0.0)
    ground = rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF)
    uniform = [binary_erosion(ground & mask, structure=np.ones((3, 3))) for mask in (dark, ~dark)]
    return Truth(ground & ~dark, np.zeros_like(dark), uniform[0] | uniform[1], ground)


def invalid_pixel_count(rendered: RenderedView) -> int:
    """Return the number of surface pixels without a visibility in [0, 1]."""
    return int((~((rendered.visibility >= 0.0) & (rendered.visibility <= 1.0)) & rendered.buffer.valid).sum())


def differing_pixel_count(first: RenderedView, second: RenderedView) -> int:
    """Return the number of pixels that differ between two visibilities of one view."""
    return int((~np.isclose(first.visibility, second.visibility, rtol=0.0, atol=0.0, equal_nan=True)).sum())


def join_meshes(*meshes: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return one mesh with all triangles of several meshes."""
    return trimesh.util.concatenate(list(meshes))


def with_ground_pebble(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with a pebble on the ground beside it: the engine then leaves bodies that hover where they are."""
    return join_meshes(mesh, box((0.02, 0.02, 0.02), at_m=(14.0, 14.0)))


def triangle_soup(corners: Any) -> trimesh.Trimesh:
    """Return triangles without shared vertices, corner by corner."""
    points = np.array(corners, float)
    return trimesh.Trimesh(points.reshape(-1, 3), np.arange(3 * len(points)).reshape(-1, 3), process=False)


def without_triangles(mesh: trimesh.Trimesh, removed: np.ndarray | int) -> trimesh.Trimesh:
    """Return a mesh without some of its triangles."""
    return trimesh.Trimesh(mesh.vertices, np.delete(mesh.faces, removed, axis=0), process=False)


def flip_faces(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return a mesh whose triangles have the opposite winding."""
    return trimesh.Trimesh(mesh.vertices, mesh.faces[:, ::-1], process=False)


def half_sphere(lower: bool) -> trimesh.Trimesh:
    """Return the lower or upper half of a sphere as an open mesh."""
    ball = trimesh.creation.icosphere(3, 4.0)
    ball.apply_translation([0.0, 0.0, 5.0])
    is_upper = ball.triangles_center[:, 2] > 5.0
    return without_triangles(ball, np.flatnonzero(is_upper if lower else ~is_upper))


def sheet() -> trimesh.Trimesh:
    """Return an open mesh of two triangles."""
    return triangle_soup([[[-4, -3, 3], [4, -3, 2], [4, 3, 5]], [[-4, -3, 3], [4, 3, 5], [-4, 3, 4]]])


def three_walls() -> trimesh.Trimesh:
    """Return three walls that share an upright edge."""
    ends = [[5 * np.cos(angle), 5 * np.sin(angle)] for angle in (0.3, 2.4, 4.5)]
    return triangle_soup([t for x, y in ends for t in ([[0, 0, 0], [x, y, 0], [x, y, 6]], [[0, 0, 0], [x, y, 6], [0, 0, 6]])])


def stacked_plates(count: int, gap_m: float = 0.05) -> trimesh.Trimesh:
    """Return squares of 6 m above one another, the lowest one metre up."""
    square = [[[-3, -3], [3, -3], [3, 3]], [[-3, -3], [3, 3], [-3, 3]]]
    return with_ground_pebble(
        triangle_soup([[[x, y, 1 + gap_m * n] for x, y in corners] for n in range(count) for corners in square])
    )
