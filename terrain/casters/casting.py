"""Collect the geometry that casts shadows on the points of a geometry buffer, by kind of caster.

The kinds are ``relief`` (the ground), ``meshes`` and ``forest`` (trees). Shadow maps and rays use the same geometry.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import PATCH_QUADS, Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.sheet import Sheet
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene
from skugga.terrain.scene_objects import SceneObjects

VerticesAndTriangles = tuple[np.ndarray, np.ndarray]
"""Vertices (n, 3) float64 in a local frame, metres, and the vertex indices (m, 3) int32 of the triangles."""


def caster_sheets(scene: Scene, buffer: GeometryBuffer, casters: Casters, caster_kinds: tuple[CasterKind, ...]) -> Iterator[Sheet]:
    """Yield the grid meshes of the ground that casts shadows on a map's block, in the buffer's frame.

    The block's own ground comes first, then the casting patches of ``casters``. Smooth ground includes its rim, which continues it
    for one node beyond the raster. The result is empty if ``caster_kinds`` lacks ``relief``, and in perspective.
    """
    if "relief" not in caster_kinds:
        return
    side = PATCH_QUADS + 1
    if buffer.columns is not None:
        column_window = buffer.columns.window
        yield column_window.sheet
        for patch in casters.casting_patches:
            columns = column_window.columns.coarser(patch.lod)
            yield columns.window(patch.row * PATCH_QUADS, patch.col * PATCH_QUADS, side, side, buffer.frame).sheet
    if buffer.surface is None:
        return
    assert isinstance(buffer.view, MapView)
    yield buffer.surface.with_rim.sheet
    for patch in casters.casting_patches:
        surface = scene.surface(buffer.view.grid.coarser(patch.lod))
        yield surface.window(patch.row * PATCH_QUADS, patch.col * PATCH_QUADS, side, side, buffer.frame).with_rim.sheet


def caster_meshes(scene: Scene, buffer: GeometryBuffer, kinds: tuple[CasterKind, ...]) -> list[VerticesAndTriangles]:
    """Return the casters that are triangle meshes: the ground of a perspective view, and the level's meshes.

    Meshes of kinds outside of ``kinds`` are left out. The vertices are in the buffer's frame.
    """
    meshes: list[VerticesAndTriangles] = []
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
    """Return the trees that cast shadows; ``None`` if the buffer has none or ``kinds`` lacks ``forest``."""
    return buffer.tree_instances if "forest" in kinds else None


def occluding_trees(
    instances: TreeInstances, rotation: np.ndarray, translation: np.ndarray, low: np.ndarray, high: np.ndarray
) -> TreeInstances:
    """Return the trees that can occlude points of a light-space box from the sun: those in the box, and between it and the sun.

    ``low`` and ``high`` (3,) bound the box. ``rotation`` (3, 3) and ``translation`` (3,) map the trees' frame to light space.
    """
    min_bound = np.array([low[0], low[1], -np.inf])
    return instances.select(instances.in_box(rotation, translation, min_bound, high))


@cached("scene", 64 * MIB)
def closed_caster_mask(objects: SceneObjects) -> np.ndarray:
    """Return the mask (m,) of the casting meshes' triangles that belong to a closed body whose faces point outwards."""
    placement = objects.placement
    casting = () if placement is None else placement.casting_bodies
    bodies = {id(placed.body): placed.body for placed in casting}  # one body may stand in many places
    closed = {key: body.is_closed and body.volume_m3 > 0.0 for key, body in bodies.items()}
    counts = [len(placed.body.triangles) for placed in casting]
    return np.repeat(np.array([closed[id(placed.body)] for placed in casting], bool), counts)


@cached("scene", 512 * MIB)
def caster_solids(objects: SceneObjects, frame: LocalFrame) -> VerticesAndTriangles:
    """Return the vertices and triangles of the casting meshes in a frame. The scene must have meshes."""
    solids = objects.solids
    assert solids is not None
    return frame.points_from_earth(solids.caster_vertices_earth_m), solids.caster_triangles
