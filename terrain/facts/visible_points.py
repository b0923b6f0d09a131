"""Sample the visible points of a view as probes (ground, meshes and trees), and measure the share of pixels with an edge.

Neither depends on the light.
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
from skugga.terrain.gbuffer.antialias import CROSS_OFFSETS, edge_mask_of_crosses
from skugga.terrain.gbuffer.resolve import FOREST, MESHES, RELIEF
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.world import World
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.interpolation import bilinear
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

MAP_SIDE = 48
"""Number of strata along each side of a level. A map has one probe in each stratum."""

MAX_LEAF_PROBES = 2048
"""Maximum number of samples of a coarse view whose rays are tested against leaves."""

MAX_LEAF_EDGE_PIXELS = 300
"""Maximum number of pixels that are tested for edges of leaves, with five rays each."""


def probes_in_map(scene: Scene, pixel_m: float, trees: TreeInstances | None) -> Probes:
    """Return the probes of a map: one in each of ``MAP_SIDE`` squared strata of the raster, on the surface visible from above."""
    probes = _points_in_map(scene.objects, trees)
    return replace(probes, pixel_m=np.full(len(probes), pixel_m))


def probes_in_view(coarse_view: CoarseView, view: PerspectiveView, trees: TreeInstances | None) -> Probes:
    """Return the probes of a perspective view: all points of its coarse view.

    In a scene with trees at most ``MAX_LEAF_PROBES`` points are used, and leaves in front of them replace them.
    """
    return _coarse_view_probes(coarse_view, view.pixel) if trees is None else _probes_with_leaves(coarse_view, view.pixel, trees)


@cached("scene", 64 * MIB)
def _coarse_view_probes(coarse_view: CoarseView, pixel: float) -> Probes:
    valid = coarse_view.buffer.valid
    return Probes(
        frame=coarse_view.buffer.frame, point_frame_m=coarse_view.points_frame_m,
        normal_frame=coarse_view.buffer.normal_frame[valid].astype(np.float64),
        pixel_m=coarse_view.distance_m * pixel, distance_m=coarse_view.distance_m, kind=coarse_view.buffer.kind[valid],
        number=np.arange(len(coarse_view.distance_m)),
    )  # fmt: skip


@cached("scene", 64 * MIB)
def _probes_with_leaves(coarse_view: CoarseView, pixel: float, trees: TreeInstances) -> Probes:
    surface_probes, coarse, valid = (
        _coarse_view_probes(coarse_view, pixel),
        coarse_view.buffer.view,
        coarse_view.buffer.valid.ravel(),
    )
    assert isinstance(coarse, PerspectiveView)
    chosen = stratified_indices(valid.size, MAX_LEAF_PROBES)
    count = len(chosen)
    row, col = np.divmod(chosen, coarse.cols)
    tangents = np.stack([coarse.col0 + col * coarse.step, coarse.row0 + row * coarse.step], axis=1) / coarse.focal_px
    _, camera_from_frame = coarse.in_frame(coarse_view.buffer.frame)
    direction = np.column_stack([tangents, np.ones(count)]) @ camera_from_frame
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    point, length = (np.cumsum(valid) - 1)[chosen], np.full(count, np.inf)
    length[valid[chosen]] = surface_probes.distance_m[point[valid[chosen]]]
    met, normal = first_leaf_hits(trees, np.tile(coarse_view.eye_frame_m, (count, 1)), direction, length)
    leaf = np.isfinite(met)
    leaves = Probes(
        coarse_view.buffer.frame, coarse_view.eye_frame_m + met[leaf, None] * direction[leaf], normal[leaf], met[leaf] * pixel,
        met[leaf],
        np.full(int(leaf.sum()), FOREST, np.uint8), chosen[leaf],
    )  # fmt: skip
    return _joined(surface_probes.select(point[valid[chosen] & ~leaf]), leaves)


def edge_share(coarse_view: CoarseView, trees: TreeInstances | None) -> float:
    """Return the share of a view's pixels that contain an edge (``skugga.terrain.gbuffer.antialias``)."""
    return coarse_view.edge_share if trees is None else _edge_share_with_trees(coarse_view, trees)


@cached("scene", MIB)
def _edge_share_with_trees(coarse_view: CoarseView, trees: TreeInstances) -> float:
    """Return the edge share with trees: the share without trees from many pixels, plus the difference measured in some of them."""
    edge_samples = coarse_view.edge_samples
    chosen = stratified_indices(len(edge_samples.number), MAX_LEAF_EDGE_PIXELS)
    number, depth_m = edge_samples.number[chosen], edge_samples.distance_m[chosen]
    bare = edge_mask_of_crosses(number, depth_m, edge_samples.ground, edge_samples.normals)
    row, col = (index[chosen, None] + np.array(CROSS_OFFSETS)[:, k] for k, index in enumerate((edge_samples.row, edge_samples.col)))
    x, y = (
        (first + index * edge_samples.view.step) / edge_samples.view.focal_px
        for first, index in ((edge_samples.view.col0, col), (edge_samples.view.row0, row))
    )
    _, camera_from_frame = edge_samples.view.in_frame(coarse_view.buffer.frame)
    direction = np.stack([x, y, np.ones(x.shape)], axis=-1) @ camera_from_frame
    per_depth = np.linalg.norm(direction, axis=-1)
    direction /= per_depth[..., None]
    start = np.tile(coarse_view.eye_frame_m, (number.size, 1))
    met, _ = first_leaf_hits(trees, start, direction.reshape(-1, 3), (depth_m * per_depth).ravel())
    leaf = np.isfinite(met).reshape(number.shape)
    # Every leaf gets a unique number, so that only distance decides whether an edge lies between neighbouring leaves.
    numbers = edge_samples.ground + len(edge_samples.normals) + 1 + np.arange(number.size).reshape(number.shape)
    number = np.where(leaf, numbers.astype(np.uint32), number)
    depth_m = np.where(leaf, met.reshape(number.shape) / per_depth, depth_m)
    among = edge_mask_of_crosses(number, depth_m, edge_samples.ground, edge_samples.normals)
    return float(np.clip(coarse_view.edge_share + among.mean() - bare.mean(), 0.0, 1.0))


def _joined(bare: Probes, leaves: Probes) -> Probes:
    """Concatenate two sets of probes and renumber them."""
    names = ("point_frame_m", "normal_frame", "pixel_m", "distance_m", "kind")
    both: dict[str, Any] = {name: np.concatenate([getattr(bare, name), getattr(leaves, name)]) for name in names}
    return replace(bare, **both, number=np.arange(len(bare) + len(leaves)))


@cached("scene", 64 * MIB)
def _points_in_map(objects: SceneObjects, trees: TreeInstances | None) -> Probes:
    ground_probes, tallest_m = ground_points(objects.world, objects.elevation), objects.tallest_m
    away = objects.world.curvature * ground_probes.point_frame_m[:, :2]
    up = np.column_stack([away, np.ones(len(ground_probes))]) / np.sqrt(1.0 + (away**2).sum(axis=1))[:, None]
    start, length = ground_probes.point_frame_m + tallest_m * up, np.full(len(ground_probes), tallest_m)
    if objects.solids is not None:
        start, length = start + tallest_m * up, 2.0 * length  # above objects that stand on a slope nearby
        ground_probes, length = _move_to_roofs(objects, ground_probes, start, -up, length)
    if trees is None:
        return ground_probes
    met, normal = first_leaf_hits(trees, start, -up, length)
    leaf = np.isfinite(met)
    leaf_probes = ground_probes.select(leaf)
    above = replace(
        leaf_probes, point_frame_m=start[leaf] - met[leaf, None] * up[leaf], normal_frame=normal[leaf],
        kind=np.full(len(leaf_probes), FOREST, np.uint8),
    )  # fmt: skip
    return _joined(ground_probes.select(~leaf), above)


def _move_to_roofs(
    objects: SceneObjects, bare: Probes, start: np.ndarray, down: np.ndarray, length: np.ndarray
) -> tuple[Probes, np.ndarray]:
    """Move the probes below meshes onto the meshes. Return them and their depths (n,) below the starts (n, 3), metres."""
    met, normal = first_mesh_hits(objects, bare.frame, start, down, length)
    roof = np.isfinite(met)
    length = np.where(roof, met, length)
    return replace(
        bare, point_frame_m=np.where(roof[:, None], start + length[:, None] * down, bare.point_frame_m),
        normal_frame=np.where(roof[:, None], normal, bare.normal_frame), kind=np.where(roof, np.uint8(MESHES), bare.kind),
    ), length  # fmt: skip


@cached("scene", 64 * MIB)
def ground_points(world: World, elevation: Elevation) -> Probes:
    """Return stratified points of a level's bare ground, bilinear between the cells of its overview."""
    heights, factor = elevation.overview.heights_m, 2**elevation.overview.level
    chance = quasirandom(np.arange(MAP_SIDE**2)).reshape(MAP_SIDE, MAP_SIDE, 2)
    part = np.stack(tuple(np.mgrid[:MAP_SIDE, :MAP_SIDE]), axis=-1)
    row, col = np.moveaxis((part + chance) / MAP_SIDE * np.array(heights.shape) - 0.5, -1, 0).reshape(2, -1)
    row, col = (np.clip(v, 0.0, max(size - 1, 0)) for v, size in zip((row, col), heights.shape, strict=True))
    frame = world.frame_near_earth(world.anchor_earth_m)

    def point_at(row: np.ndarray, col: np.ndarray) -> np.ndarray:
        point, up = world.ground(elevation.crs, *elevation.xy((row + 0.5) * factor - 0.5, (col + 0.5) * factor - 0.5))
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
    none = np.zeros(int(is_finite.sum()))
    return Probes(
        frame, point[is_finite], normal[is_finite], none, none, np.full(len(none), RELIEF, np.uint8), np.arange(len(none))
    )
