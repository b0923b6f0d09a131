"""Return the geometry that casts shadows on a buffer's points, by kind: the same for shadow maps and for rays."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.reach import PATCH_QUADS, Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3) float64 in a frame, and triangles (m, 3) int32."""


def caster_sheets(scene: Scene, buffer: GeometryBuffer, casters: Casters, kinds: tuple[CasterKind, ...]) -> Iterator[Sheet]:
    """Yield the sheets of ground that cast shadows on a map's block, in its frame. The block's own ground comes first. In maps
    they include the rim beyond the raster.
    """
    if "relief" not in kinds:
        return
    side = PATCH_QUADS + 1
    if buffer.columns is not None:
        column_window = buffer.columns.window
        yield column_window.sheet
        for patch in casters.casting:
            columns = column_window.columns.coarser(patch.lod)
            yield columns.window(patch.row * PATCH_QUADS, patch.col * PATCH_QUADS, side, side, buffer.frame).sheet
    if buffer.surface is None:
        return
    assert isinstance(buffer.view, MapView)
    yield buffer.surface.casting.sheet
    for patch in casters.casting:
        surface = scene.surface(buffer.view.grid.coarser(patch.lod))
        yield surface.window(patch.row * PATCH_QUADS, patch.col * PATCH_QUADS, side, side, buffer.frame).casting.sheet


def caster_meshes(scene: Scene, buffer: GeometryBuffer, kinds: tuple[CasterKind, ...]) -> list[Mesh]:
    """Return the meshes that cast shadows: a perspective view's ground, and the casting meshes."""
    meshes: list[Mesh] = []
    if buffer.ground is not None and "relief" in kinds:
        meshes.append((buffer.ground.position_frame_m, buffer.ground.triangles))
    if "meshes" in kinds and scene.objects.solids is not None:
        meshes.append(caster_solids(scene.objects, buffer.frame))
    return meshes


def has_casters(scene: Scene, buffer: GeometryBuffer, kinds: tuple[CasterKind, ...]) -> bool:
    """Return whether something of the given kinds can cast a shadow on a buffer's points."""
    ground = "relief" in kinds and any(part is not None for part in (buffer.surface, buffer.columns, buffer.ground))
    return ground or ("meshes" in kinds and scene.objects.solids is not None) or caster_trees(buffer, kinds) is not None


def caster_trees(buffer: GeometryBuffer, kinds: tuple[CasterKind, ...]) -> TreeInstances | None:
    """Return the trees that cast shadows, or ``None``."""
    return buffer.tree_instances if "forest" in kinds else None


def occluding_trees(
    instances: TreeInstances, rotation: np.ndarray, translation: np.ndarray, low: np.ndarray, high: np.ndarray
) -> TreeInstances:
    """Return the trees that intersect light-space bounds (3,) or lie between these and the sun."""
    min_bound = np.array([low[0], low[1], -np.inf])
    return instances.select(instances.in_box(rotation, translation, min_bound, high))


@cached("scene", 64 * MIB)
def closed_casters(objects: SceneObjects) -> np.ndarray:
    """Return which triangles (m,) of the casting meshes bound a closed body with its faces outwards, bool."""
    placement = objects.placement
    casting = () if placement is None else placement.casting
    bodies = {id(placed.body): placed.body for placed in casting}  # one body may stand in many places
    closed = {key: body.closed and body.volume_m3 > 0.0 for key, body in bodies.items()}
    counts = [len(placed.body.triangles) for placed in casting]
    return np.repeat(np.array([closed[id(placed.body)] for placed in casting], bool), counts)


@cached("scene", 512 * MIB)
def caster_solids(objects: SceneObjects, frame: LocalFrame) -> Mesh:
    """Return the casting meshes in a frame."""
    solids = objects.solids
    assert solids is not None
    return frame.points_from_earth(solids.caster_vertices_earth_m), solids.caster_triangles
