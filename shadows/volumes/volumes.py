"""Build shadow volumes as triangles, once for a light and its casters, and cache them while neither changes.

The volume of a set of casting triangles is bounded by these triangles, by a side for each edge of their silhouette, and by their
images infinitely far away from the light. ``skugga.shadows.volumes.silhouettes`` defines the casting triangles and the silhouette.
In homogeneous coordinates a point at infinity is a point like any other (C. Everitt and M. Kilgard, Practical and Robust Stenciled
Shadow Volumes for Hardware-Accelerated Rendering, 2002):

- The sun at L (a direction) projects every point to (-L, 0). A side is one triangle, and no far cap is needed.
- A lamp at P projects v to (v - P, 0). A side is a quad, and the far cap consists of the casting triangles' images.

**Casters.** Of a closed body with its faces outwards, the triangles that face the light cast. All visible points lie on or above
the ground. Of the ground, the triangles that face away cast, so its near caps lie in attached shadow. Of everything else, open or
not manifold, all triangles cast. The same holds for a body that contains a lamp, and for ground with gaps.

**Layers.** A stencil of n bits distinguishes 2^n - 1 layers. Casters are drawn in batches. No batch covers a point more
often (``skugga.shadows.volumes.layers``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.passes import PassRecord
from skugga.shadows.volumes.edges import Edges, closed_part_mask, connected_parts, find_edges
from skugga.shadows.volumes.layers import layer_batches
from skugga.shadows.volumes.silhouettes import (
    ALL_CODE,
    FACING_CODE,
    TURNED_AWAY_CODE,
    Silhouette,
    faces_light,
    orientations_of,
    sheet_silhouette,
    silhouette,
)
from skugga.terrain.cache import MIB, Cache, Missing, cached
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import VerticesAndTriangles, caster_sheets, caster_solids
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.ground_mesh import ground_nodes, nodes_have_gaps
from skugga.terrain.ground.sheet import Sheet, has_gaps
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

MAX_VOLUME_LAYERS = 127
"""Layers that a stencil with one bit for marks can count."""

CONTACT_TOLERANCE_M = 1e-3
"""Distance up to which a lamp counts as inside of a body's bounds, or as on a face's plane."""


@dataclass(frozen=True, eq=False)
class Volumes:
    """Shadow volumes of a batch of casting triangles under one light, in one local frame.

    Attributes
    ----------
    vertices
        float32 (n, 4): homogeneous, metres.
    faces
        int32 (m, 3): counter-clockwise from outside of the volumes.
    caster_of_face
        int32 (m,): the caster of each face, as its index in ``caster_low_m``.
    caster_low_m, caster_high_m
        float64 (casters, 3): bounds of the casters, metres.
    silhouette_edges
        int32 (e, 2): vertex numbers of the silhouette's edges.
    first_cap, cap_count
        Index of the first face that is a near cap (a casting triangle), and number of near caps.
    draws_all_faces
        Whether all faces are drawn everywhere. To cull faces of about a pixel takes longer than to draw them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    caster_of_face: np.ndarray
    caster_low_m: np.ndarray
    caster_high_m: np.ndarray
    silhouette_edges: np.ndarray
    first_cap: int
    cap_count: int
    draws_all_faces: bool = False

    @property
    def caps(self) -> np.ndarray:
        """The casting triangles, int32 (c, 3), counter-clockwise as seen from the light."""
        return self.faces[self.first_cap : self.first_cap + self.cap_count]

    @property
    def nbytes(self) -> int:
        """Size in bytes of the vertices and faces."""
        return self.vertices.nbytes + self.faces.nbytes


_volume_cache: Cache[list[Volumes]] = Cache("skugga.shadows.volumes.volumes", "light", 1024 * MIB)
"""Cache of the volumes of meshes, by mesh, light and rule."""


def volumes_of(
    buffer: GeometryBuffer,
    scene: Scene,
    light_in_frame: np.ndarray,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    record: PassRecord,
) -> list[Volumes]:
    """Return the volumes of all casters that may shade a buffer's points, for one light: one element for each batch of triangles.

    A batch holds casting triangles of one mesh or of one sheet of ground. Their volumes are in the arrays of one ``Volumes``, and
    the stencil can count them together. A point is in shadow if it lies in a volume of any element.

    ``light_in_frame`` (4,) is the light as a homogeneous point of the buffer's frame. ``kinds`` are the kinds of casters.
    ``casters`` is the ground beside a map's block. ``record`` takes the numbers of edges, bytes and cached volumes. A map's ground
    is never the same arrays twice, so the pictures of its blocks are cached instead.
    """
    volume_sets: list[Volumes] = []
    for sheet in caster_sheets(scene, buffer, casters, kinds):
        volume_sets += _sheet_volumes(sheet, light_in_frame)
    meshes: list[tuple[VerticesAndTriangles, int | None]] = []
    if buffer.ground is not None and "relief" in kinds:
        ground_rule = ALL_CODE if ground_has_gaps(buffer, scene) else TURNED_AWAY_CODE
        meshes.append(((buffer.ground.position_frame_m, buffer.ground.triangles), ground_rule))
    if "meshes" in kinds and scene.objects.solids is not None:
        meshes.append((caster_solids(scene.objects, buffer.frame), None))
    for mesh, rule in meshes:
        key = (*mesh, tuple(light_in_frame), rule)
        mesh_volumes = _volume_cache.get(*key)
        if isinstance(mesh_volumes, Missing):
            mesh_volumes = _mesh_volumes(*mesh, light_in_frame, rule)
            _volume_cache.put(*key, value=mesh_volumes)
        else:
            record.kept += len(mesh_volumes)
        volume_sets += mesh_volumes
    record.edges += sum(len(volume_set.silhouette_edges) for volume_set in volume_sets)
    record.bytes = max(record.bytes, sum(volume_set.nbytes for volume_set in volume_sets))
    return volume_sets


def ground_has_gaps(buffer: GeometryBuffer, scene: Scene) -> bool:
    """Return whether a ray may enter a gap of a buffer's ground, and come out of the ground from below."""
    if buffer.columns is not None:
        return has_gaps(np.isfinite(buffer.columns.window.height_m))
    if buffer.surface is not None:
        return has_gaps(np.isfinite(buffer.surface.with_rim.position_frame_m[..., 2]))
    return nodes_have_gaps(ground_nodes(scene).height_m)


@dataclass(frozen=True, eq=False)
class _MeshStructure:
    """The part of a mesh that does not depend on the light. Casters share no vertices.

    Attributes
    ----------
    edges
        The edges of the mesh.
    rule_of_triangle
        int8 (m,): the rule of each triangle.
    caster_of_vertex
        int32 (n,): the caster of each vertex.
    """

    edges: Edges
    rule_of_triangle: np.ndarray
    caster_of_vertex: np.ndarray


@cached("scene", 1024 * MIB)
def _mesh_structure(vertices: np.ndarray, triangles: np.ndarray, ground_rule: int | None) -> _MeshStructure:
    """Return the structure of a mesh. ``ground_rule`` is the rule of all triangles of ground; ``None`` for bodies.

    ``triangles`` (m, 3) holds indices of ``vertices`` (n, 3).
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, count = find_edges(vertices, triangles), len(vertices)
    if ground_rule is not None:
        return _MeshStructure(edges, np.full(len(triangles), ground_rule, np.int8), np.zeros(count, np.int32))
    part, corners = connected_parts(edges), vertices[triangles] - vertices.mean(axis=0)
    volume_m3 = np.bincount(part, np.linalg.det(corners) / 6.0)
    rule = np.where(closed_part_mask(edges) & (volume_m3[part] > 0.0), FACING_CODE, ALL_CODE).astype(np.int8)
    first, has_edge = triangles[:, :1], edges.triangle_edges >= 0
    welded = np.where(has_edge[..., None], edges.ends[edges.triangle_edges], first[:, None])
    neighbours = np.concatenate([triangles[:, 1:], welded.reshape(-1, 6)], axis=1)
    pairs = np.broadcast_to(first, neighbours.shape).ravel(), neighbours.ravel()
    graph = coo_array((np.ones(neighbours.size, bool), pairs), (count, count))
    return _MeshStructure(edges, rule, connected_components(graph, directed=False)[1].astype(np.int32))


def _mesh_volumes(vertices: np.ndarray, triangles: np.ndarray, light: np.ndarray, ground_rule: int | None) -> list[Volumes]:
    """Return the volumes of a mesh under a light (4,), in batches whose layers the stencil can count.

    ``triangles`` (m, 3) holds indices of ``vertices`` (n, 3), metres. ``ground_rule`` is that of ``_mesh_structure``.
    """
    structure = _mesh_structure(vertices, triangles, ground_rule)
    edges, part, rule = structure.edges, structure.caster_of_vertex, structure.rule_of_triangle
    order = np.argsort(part, kind="stable")
    first = np.flatnonzero(np.diff(part[order], prepend=-1))
    # Invalid nodes of the ground are NaN, and belong to no triangle.
    low, high = (bound.reduceat(vertices[order], first) for bound in (np.fmin, np.fmax))
    if light[3] != 0.0 and ground_rule is None:  # a body around a lamp casts by its inside, except for faces that touch the lamp
        contains_lamp = np.all((low - CONTACT_TOLERANCE_M < light[:3]) & (light[:3] < high + CONTACT_TOLERANCE_M), axis=1)[
            part[triangles[:, 0]]
        ]
        rule = np.where(contains_lamp, np.int8(ALL_CODE), rule)
        rule[contains_lamp] = np.where(
            _lamp_distances_m(vertices, triangles[contains_lamp], light) < CONTACT_TOLERANCE_M, np.int8(0), rule[contains_lamp]
        )
    orientations = orientations_of(faces_light(vertices, triangles, light), rule)
    if not orientations.any():
        return []
    return [
        _build_volumes(vertices, silhouette(triangles, edges, batch), light, part, low, high)
        for batch in layer_batches(vertices, triangles, edges, orientations, light, MAX_VOLUME_LAYERS)
    ]


def _lamp_distances_m(vertices: np.ndarray, triangles: np.ndarray, lamp: np.ndarray) -> np.ndarray:
    """Return the distance of a lamp (4,) from the planes of triangles (m, 3), metres (m,); 0 for degenerate ones.

    ``triangles`` holds indices of ``vertices`` (n, 3), metres.
    """
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    return np.abs((normal * (lamp[:3] - a)).sum(axis=1)) / np.maximum(np.linalg.norm(normal, axis=1), 1e-30)


def _sheet_volumes(sheet: Sheet, light: np.ndarray) -> list[Volumes]:
    """Return the volumes of a sheet of ground under a light (4,): one set, or none."""
    position = sheet.position_frame_m
    valid = np.isfinite(position[..., 2])
    if not valid.any():
        return []
    valid_position = position[valid]
    outline = sheet_silhouette(sheet, light, "all" if has_gaps(valid) else "turned_away")
    if not len(outline.caps):
        return []
    vertices = np.nan_to_num(position.reshape(-1, 3))
    caster_of_vertex = np.zeros(len(vertices), np.int32)
    return [
        _build_volumes(
            vertices, outline, light, caster_of_vertex, valid_position.min(axis=0)[None], valid_position.max(axis=0)[None]
        )
    ]


def _build_volumes(
    vertices: np.ndarray, outline: Silhouette, light: np.ndarray, caster_of_vertex: np.ndarray, low: np.ndarray, high: np.ndarray
) -> Volumes:
    """Return the volumes of the near caps and along the edges of a silhouette.

    The side at an edge (a, b) has the corners b and a and their images at infinity. ``caster_of_vertex`` (n,) is the caster of each
    vertex; ``low`` and ``high`` are the casters' bounds. ``outline`` is the silhouette, whose ``vertices`` (n, 3) are in metres,
    and ``light`` (4,) is homogeneous.
    """
    used_vertices, number = np.unique(np.concatenate([outline.edges.ravel(), outline.caps.ravel()]), return_inverse=True)
    edges = number[: outline.edges.size].reshape(-1, 2)
    caps = number[outline.edges.size :].reshape(-1, 3)
    points = vertices[used_vertices]
    count = len(points)
    near = np.column_stack([points, np.ones(count)])
    a, b = np.repeat(edges, outline.multiplicity, axis=0).T
    if light[3] == 0.0:
        far = np.append(-light[:3], 0.0)[None]
        sides = np.column_stack([b, a, np.full(len(a), count)])
        faces = np.concatenate([sides, caps])
    else:
        far = np.column_stack([points - light[:3], np.zeros(count)])
        sides = np.concatenate([np.column_stack([b, a, a + count]), np.column_stack([b, a + count, b + count])])
        faces = np.concatenate([sides, caps, caps[:, ::-1] + count])
    caster_of_face = caster_of_vertex[used_vertices][faces[:, 0] % count] if count else np.zeros(0, np.int32)
    return Volumes(
        np.concatenate([near, far]).astype(np.float32),
        faces.astype(np.int32),
        caster_of_face,
        low,
        high,
        edges.astype(np.int32),
        len(sides),
        len(caps),
    )
