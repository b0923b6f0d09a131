"""Blocks over level ground, whose sun shadows are polygons in closed form, and cameras at an angle to the sun."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import shapely
import trimesh

from skugga.shadows.maps.perspective_shadow_map import MAX_TEXEL_PX
from skugga.shadows.truth.metrics import (
    MetricCoverage,
    edge_distances,
    edge_metric_coverage,
    interior_region,
    metric_coverage,
    shadow_boundary_mask,
)
from skugga.shadows.truth.truth import Truth, jittered_views
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView, look_at
from tests.hard_cases.cases import RenderedView

UP = np.array([0.0, 0.0, 1.0])


def block(size_m: Sequence[float], at_m: Sequence[float], bottom_m: float = 0.0, turn_deg: float = 0.0) -> trimesh.Trimesh:
    """Return a closed block (east, north, up), turned counter-clockwise about its middle, which stands at (east, north)."""
    mesh = trimesh.creation.box(extents=size_m)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(turn_deg), UP))
    mesh.apply_translation([*at_m, bottom_m + size_m[2] / 2.0])
    return mesh


def unit_direction(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Return the unit direction (3,) of an azimuth, clockwise from north, and an altitude."""
    azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def shadow_polygons(blocks: Sequence[trimesh.Trimesh], sun: tuple[float, float]) -> list[shapely.Polygon]:
    """Return the shadows of convex blocks on the plane z = 0: the hulls of their corners, projected along the sun's rays."""
    to_sun = unit_direction(*sun)
    corners = [mesh.vertices[:, :2] - mesh.vertices[:, 2:] * to_sun[:2] / to_sun[2] for mesh in blocks]
    return [shapely.MultiPoint(points).convex_hull for points in corners]


def points_in_polygons(x_m: np.ndarray, y_m: np.ndarray, hulls: Sequence[shapely.Polygon]) -> np.ndarray:
    """Return whether points (n,) on the ground lie in any of the polygons, bool (n,)."""
    inside = np.zeros(len(x_m), bool)
    for hull in hulls:
        west, south, east, north = hull.bounds
        near = np.flatnonzero((x_m > west) & (x_m < east) & (y_m > south) & (y_m < north) & ~inside)
        shapely.prepare(hull)
        inside[near] = shapely.contains_xy(hull, x_m[near], y_m[near])
    return inside


def flat_terrain(size_m: float = 200.0, cells: int = 20) -> Mapping[str, object]:
    """Return a level's flat terrain."""
    return {"flat": {"size": [size_m, size_m], "cells": [cells, cells]}}


def camera(
    eye_m: Sequence[float], axis: np.ndarray, fov_deg: float = 60.0, px: int = 256, aspect_ratio: float = 1.0
) -> PerspectiveView:
    """Return a camera of a flat world that looks along an axis (3,); the picture is ``aspect_ratio`` times as wide as high."""
    eye = np.array(eye_m, float)
    return look_at(eye, eye + 10.0 * axis, UP, fov_deg, px, round(px * aspect_ratio))


def axis_at_angle(to_sun: np.ndarray, other_direction: np.ndarray, angle_deg: float) -> np.ndarray:
    """Return the axis (3,) at an angle to the sun's direction, turned towards another direction.

    The result is exact at small angles. Near 90 and 180 degrees the angle is measured from there, so that it is exact as well.
    """
    perpendicular = other_direction - (other_direction @ to_sun) * to_sun
    perpendicular /= np.linalg.norm(perpendicular)
    quarters = round(angle_deg / 90.0)
    c, s = np.cos(np.radians(angle_deg - 90.0 * quarters)), np.sin(np.radians(angle_deg - 90.0 * quarters))
    cos_angle, sin_angle = [(c, s), (-s, c), (-c, -s), (s, -c)][quarters % 4]
    return cos_angle * to_sun + sin_angle * perpendicular


def ground_intersections(view: PerspectiveView, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where the rays of a camera's masked pixels meet the plane z = 0: east and north (n,), metres."""
    row, col = np.nonzero(mask)
    image_x, image_y = (view.col0 + col * view.step_px) / view.focal_px, (view.row0 + row * view.step_px) / view.focal_px
    ray = np.stack([image_x, image_y, np.ones(len(row))], axis=-1) @ view.earth_from_camera.T
    with np.errstate(divide="ignore", invalid="ignore"):
        east_north = view.eye_earth_m[:2] - ray[:, :2] * (view.eye_earth_m[2] / ray[:, 2:])
    return east_north[:, 0], east_north[:, 1]


def closed_form_truth(rendered: RenderedView, hulls: Sequence[shapely.Polygon]) -> Truth:
    """Return truth on the visible level ground z = 0, computed from the polygons of its shadow; it excludes everything else.

    As in ``skugga.shadows.truth.truth``, a pixel is decidable if four rays through it, traced to the ground, have the same answer.
    """
    view = rendered.view
    assert isinstance(view, PerspectiveView)
    valid = rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF)
    dark, decidable = np.zeros(valid.shape, bool), valid.copy()
    dark[valid] = points_in_polygons(*ground_intersections(view, valid), hulls)
    for jittered in jittered_views(view, 4):
        decidable[valid] &= points_in_polygons(*ground_intersections(jittered, valid), hulls) == dark[valid]  # type: ignore[arg-type]
    return Truth(valid & ~dark, np.zeros(valid.shape, bool), decidable, valid)


@dataclass(frozen=True)
class GroundErrorMetrics:
    """Error metrics (``skugga.shadows.truth.metrics``) on level ground, and their coverage of its shadow.

    ``displaced`` is the number of wrong pixels, as a share of the pixels over which a map's texels displace the shadow's edges. The
    mean displacement is a quarter of a texel's side; the share's denominator is that times the edges' length. Texels larger than
    ``MAX_TEXEL_PX`` count as ``MAX_TEXEL_PX``.
    """

    interior: float
    edge_p95_px: float
    displaced: float
    interior_coverage: MetricCoverage
    edge_metric_coverage: MetricCoverage


def ground_error_metrics(rendered: RenderedView, truth: Truth, hulls: Sequence[shapely.Polygon]) -> GroundErrorMetrics:
    """Return the errors against the polygons of the shadow, and ``closed_form_truth`` of these.

    A caster in front may hide the outline. Pixels within two texels of the outline on the ground are therefore not interior either.
    """
    view, texels_px = rendered.view, rendered.texels_px
    assert isinstance(view, PerspectiveView)
    dark, true_dark = rendered.dark & truth.valid, truth.valid & ~truth.lit
    wrong = truth.decidable & (dark != true_dark)
    interior = interior_region(truth, texels_px) & truth.decidable & (wrong | true_dark)
    points = np.stack([*ground_intersections(view, interior), np.zeros(np.count_nonzero(interior))], axis=-1)
    texel_m = texels_px[interior] * np.linalg.norm(points - view.eye_earth_m, axis=-1) * view.pixel_tangent
    outline = shapely.union_all(hulls).boundary
    interior[interior] = shapely.distance(outline, shapely.points(points[:, :2])) > 2.0 * texel_m
    edges_px = edge_distances(dark, true_dark, truth.valid)
    displaced_px = 0.25 * np.minimum(texels_px, MAX_TEXEL_PX)[shadow_boundary_mask(true_dark, truth.valid)].sum()
    return GroundErrorMetrics(
        interior=np.count_nonzero(wrong & interior) / max(np.count_nonzero(truth.decidable), 1),
        edge_p95_px=float(np.quantile(edges_px, 0.95)) if edges_px.size else 0.0,
        displaced=np.count_nonzero(wrong) / max(displaced_px, 1.0),
        interior_coverage=metric_coverage(dark, truth, interior),
        edge_metric_coverage=edge_metric_coverage(dark, truth),
    )
