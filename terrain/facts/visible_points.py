"""Sample the visible points of a view as probes (ground, meshes and trees), and measure the share of pixels with an edge.

The probes and that share do not depend on the light.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.leaf_rays import first_leaf_hits
from skugga.terrain.facts.mesh_rays import first_mesh_hits
from skugga.terrain.facts.probes import Probes, quasirandom, stratified_indices
from skugga.terrain.gbuffer.antialias import NEIGHBOUR_OFFSETS, edge_mask_of_neighbours
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.interpolation import bilinear
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

MAP_STRATA_PER_SIDE = 48
"""Number of strata along each side of a level. A map has one probe in each stratum."""

MAX_LEAF_PROBES = 2048
"""Maximum number of samples of a coarse view whose rays are tested against leaves."""

MAX_LEAF_EDGE_PIXELS = 300
"""Maximum number of pixels that are tested for edges of leaves, with five rays each."""


def probes_in_map(scene: Scene, pixel_m: float, trees: TreeInstances | None) -> Probes:
    """Return the probes of a map, on the surface that is visible from above.

    There is one in each of ``MAP_STRATA_PER_SIDE`` squared strata of the raster.
    """
    probes = _visible_map_probes(scene.objects, trees)
    return replace(probes, pixel_m=np.full(len(probes), pixel_m))


def probes_in_view(coarse_view: CoarseView, view: PerspectiveView, trees: TreeInstances | None) -> Probes:
    """Return the probes of a perspective view: all points of its coarse view.

    In a scene with trees they are at most ``MAX_LEAF_PROBES`` of these points. A leaf in front of a point replaces it.
    """
    return (
        _coarse_view_probes(coarse_view, view.pixel_tangent)
        if trees is None
        else _probes_with_leaves(coarse_view, view.pixel_tangent, trees)
    )


@cached("scene", 64 * MIB)
def _coarse_view_probes(coarse_view: CoarseView, pixel: float) -> Probes:
    """Return all points of a coarse view as probes. ``pixel`` is the side of a pixel of the full view, as a tangent."""
    valid = coarse_view.buffer.valid
    return Probes(
        frame=coarse_view.buffer.frame, point_frame_m=coarse_view.points_frame_m,
        normal_frame=coarse_view.buffer.normal_frame[valid].astype(np.float64),
        pixel_m=coarse_view.distance_m * pixel, distance_m=coarse_view.distance_m,
        surface_kind=coarse_view.buffer.surface_kind[valid],
        sequence_index=np.arange(len(coarse_view.distance_m)),
    )  # fmt: skip


@cached("scene", 64 * MIB)
def _probes_with_leaves(coarse_view: CoarseView, pixel: float, trees: TreeInstances) -> Probes:
    """Return at most ``MAX_LEAF_PROBES`` points of a coarse view as probes. A leaf in front of a point replaces it.

    ``pixel`` is the side of a pixel of the full view, as a tangent.
    """
    surface_probes, coarse_camera, valid = (
        _coarse_view_probes(coarse_view, pixel),
        coarse_view.buffer.view,
        coarse_view.buffer.valid.ravel(),
    )
    assert isinstance(coarse_camera, PerspectiveView)
    chosen = stratified_indices(valid.size, MAX_LEAF_PROBES)
    count = len(chosen)
    row, col = np.divmod(chosen, coarse_camera.cols)
    tangents = (
        np.stack([coarse_camera.col0 + col * coarse_camera.step_px, coarse_camera.row0 + row * coarse_camera.step_px], axis=1)
        / coarse_camera.focal_px
    )
    _, camera_from_frame = coarse_camera.in_frame(coarse_view.buffer.frame)
    direction = np.column_stack([tangents, np.ones(count)]) @ camera_from_frame
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    point_index, length = (np.cumsum(valid) - 1)[chosen], np.full(count, np.inf)
    length[valid[chosen]] = surface_probes.distance_m[point_index[valid[chosen]]]
    hit_m, normal = first_leaf_hits(trees, np.tile(coarse_view.eye_frame_m, (count, 1)), direction, length)
    is_leaf = np.isfinite(hit_m)
    leaves = Probes(
        coarse_view.buffer.frame, coarse_view.eye_frame_m + hit_m[is_leaf, None] * direction[is_leaf], normal[is_leaf],
        hit_m[is_leaf] * pixel, hit_m[is_leaf],
        np.full(int(is_leaf.sum()), FOREST, np.uint8), chosen[is_leaf],
    )  # fmt: skip
    return _concatenate_probes(surface_probes.select(point_index[valid[chosen] & ~is_leaf]), leaves)


def edge_share(coarse_view: CoarseView, trees: TreeInstances | None) -> float:
    """Return the share of a view's pixels that contain an edge (``skugga.terrain.gbuffer.antialias``)."""
    return coarse_view.edge_share if trees is None else _edge_share_with_trees(coarse_view, trees)


@cached("scene", MIB)
def _edge_share_with_trees(coarse_view: CoarseView, trees: TreeInstances) -> float:
    """Return the share of pixels with an edge in a view with trees.

    It is the share without trees, from many pixels, plus the difference that trees make in some of them.
    """
    edge_samples = coarse_view.edge_samples
    chosen = stratified_indices(len(edge_samples.triangle_number), MAX_LEAF_EDGE_PIXELS)
    number, depth_m = edge_samples.triangle_number[chosen], edge_samples.distance_m[chosen]
    edges_without_trees = edge_mask_of_neighbours(number, depth_m, edge_samples.ground_triangle_count, edge_samples.face_normals)
    row, col = (
        index[chosen, None] + np.array(NEIGHBOUR_OFFSETS)[:, k] for k, index in enumerate((edge_samples.row, edge_samples.col))
    )
    x, y = (
        (first + index * edge_samples.view.step_px) / edge_samples.view.focal_px
        for first, index in ((edge_samples.view.col0, col), (edge_samples.view.row0, row))
    )
    _, camera_from_frame = edge_samples.view.in_frame(coarse_view.buffer.frame)
    direction = np.stack([x, y, np.ones(x.shape)], axis=-1) @ camera_from_frame
    per_depth = np.linalg.norm(direction, axis=-1)
    direction /= per_depth[..., None]
    start = np.tile(coarse_view.eye_frame_m, (number.size, 1))
    hit_m, _ = first_leaf_hits(trees, start, direction.reshape(-1, 3), (depth_m * per_depth).ravel())
    is_leaf = np.isfinite(hit_m).reshape(number.shape)
    # Every leaf gets a unique number, so that only distance decides whether an edge lies between neighbouring leaves.
    numbers = edge_samples.ground_triangle_count + len(edge_samples.face_normals) + 1 + np.arange(number.size).reshape(number.shape)
    number = np.where(is_leaf, numbers.astype(np.uint32), number)
    depth_m = np.where(is_leaf, hit_m.reshape(number.shape) / per_depth, depth_m)
    edges_with_trees = edge_mask_of_neighbours(number, depth_m, edge_samples.ground_triangle_count, edge_samples.face_normals)
    return float(np.clip(coarse_view.edge_share + edges_with_trees.mean() - edges_without_trees.mean(), 0.0, 1.0))


def _concatenate_probes(surface_probes: Probes, leaf_probes: Probes) -> Probes:
    """Concatenate two sets of probes and renumber them."""
    names = ("point_frame_m", "normal_frame", "pixel_m", "distance_m", "surface_kind")
    merged_fields: dict[str, Any] = {
        name: np.concatenate([getattr(surface_probes, name), getattr(leaf_probes, name)]) for name in names
    }
    return replace(surface_probes, **merged_fields, sequence_index=np.arange(len(surface_probes) + len(leaf_probes)))


@cached("scene", 64 * MIB)
def _visible_map_probes(objects: SceneObjects, trees: TreeInstances | None) -> Probes:
    """Return one probe in each stratum of the raster, on the uppermost surface there: ground, mesh or leaf."""
    ground_probes, tallest_m = ground_points(objects.world, objects.elevation), objects.tallest_object_m
    horizontal_slope = objects.world.curvature * ground_probes.point_frame_m[:, :2]
    up = (
        np.column_stack([horizontal_slope, np.ones(len(ground_probes))]) / np.sqrt(1.0 + (horizontal_slope**2).sum(axis=1))[:, None]
    )
    start, length = ground_probes.point_frame_m + tallest_m * up, np.full(len(ground_probes), tallest_m)
    if objects.solids is not None:
        start, length = start + tallest_m * up, 2.0 * length  # above objects that stand on a slope nearby
        ground_probes, length = _move_to_roofs(objects, ground_probes, start, -up, length)
    if trees is None:
        return ground_probes
    hit_m, normal = first_leaf_hits(trees, start, -up, length)
    is_leaf = np.isfinite(hit_m)
    leaf_probes = ground_probes.select(is_leaf)
    leaf_points = replace(
        leaf_probes, point_frame_m=start[is_leaf] - hit_m[is_leaf, None] * up[is_leaf], normal_frame=normal[is_leaf],
        surface_kind=np.full(len(leaf_probes), FOREST, np.uint8),
    )  # fmt: skip
    return _concatenate_probes(ground_probes.select(~is_leaf), leaf_points)


def _move_to_roofs(
    objects: SceneObjects, ground_probes: Probes, start: np.ndarray, down: np.ndarray, length: np.ndarray
) -> tuple[Probes, np.ndarray]:
    """Move the probes below meshes onto the meshes.

    Returns the probes, and their depths (n,) below the starts (n, 3) of the vertical rays, in metres.
    """
    hit_m, normal = first_mesh_hits(objects, ground_probes.frame, start, down, length)
    is_roof = np.isfinite(hit_m)
    length = np.where(is_roof, hit_m, length)
    return replace(
        ground_probes, point_frame_m=np.where(is_roof[:, None], start + length[:, None] * down, ground_probes.point_frame_m),
        normal_frame=np.where(is_roof[:, None], normal, ground_probes.normal_frame),
        surface_kind=np.where(is_roof, np.uint8(MESHES), ground_probes.surface_kind),
    ), length  # fmt: skip


@cached("scene", 64 * MIB)
def ground_points(world: World, elevation: Elevation) -> Probes:
    """Return points of a level's bare ground: one at a quasirandom place in each stratum of the raster.

    Heights are bilinear between the cells of the overview. There are ``MAP_STRATA_PER_SIDE`` squared strata.
    """
    heights, factor = elevation.overview.mean_heights_m, 2**elevation.overview.lod
    jitter = quasirandom(np.arange(MAP_STRATA_PER_SIDE**2)).reshape(MAP_STRATA_PER_SIDE, MAP_STRATA_PER_SIDE, 2)
    stratum = np.stack(tuple(np.mgrid[:MAP_STRATA_PER_SIDE, :MAP_STRATA_PER_SIDE]), axis=-1)
    row, col = np.moveaxis((stratum + jitter) / MAP_STRATA_PER_SIDE * np.array(heights.shape) - 0.5, -1, 0).reshape(2, -1)
    row, col = (np.clip(v, 0.0, max(size - 1, 0)) for v, size in zip((row, col), heights.shape, strict=True))
    frame = world.frame_near_earth(world.anchor_earth_m)

    def point_at(row: np.ndarray, col: np.ndarray) -> np.ndarray:
        point, up = world.points_at_zero_height(
            elevation.crs, *elevation.xy((row + 0.5) * factor - 0.5, (col + 0.5) * factor - 0.5)
        )
        return frame.points_from_earth(point + bilinear(heights, row, col)[:, None] * up)

    # The slope is the difference over a hundredth of a cell, always inside the same cell.
    step_row, step_col = (np.where(v - np.floor(v) > 0.5, -0.01, 0.01) for v in (row, col))
    point = point_at(row, col)
    south, east = (
        (point_at(row + step_row, col) - point) / step_row[:, None],
        (point_at(row, col + step_col) - point) / step_col[:, None],
    )
    normal = np.cross(east, -south)
    normal *= np.where(normal[:, 2:] < 0.0, -1.0, 1.0) / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    is_finite = np.isfinite(normal).all(axis=1) & np.isfinite(point).all(axis=1)
    zeros = np.zeros(int(is_finite.sum()))
    return Probes(
        frame, point[is_finite], normal[is_finite], zeros, zeros, np.full(len(zeros), RELIEF, np.uint8), np.arange(len(zeros))
    )
