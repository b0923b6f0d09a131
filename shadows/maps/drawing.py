"""Draw a depth map: all casters as a light sees them."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import nullcontext
from hashlib import sha256
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from skugga.shadows.maps.settings import Culling, LampMapSettings, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassRecord
from skugga.terrain.cache import IdentityKey
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import VerticesAndTriangles, caster_meshes, caster_sheets, closed_caster_mask
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.id_buffer import set_uniforms, shader_source
from skugga.terrain.gbuffer.tree_instances import QUAD_TRIANGLES, TreeInstances
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import Device, device
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, foliage

if TYPE_CHECKING:
    from moderngl import Framebuffer

MapSettings = ShadowMapSettings | LampMapSettings | PerspectiveMapSettings
"""Settings of any kind of depth map."""

AnyMap = TypeVar("AnyMap")
"""Type of the maps that ``draw_ahead`` yields."""

TEXTURE_SIZE_STEP = 512
"""Textures with a side above this number of texels have sides that are multiples of it."""

POLYGON_OFFSET = 1.1, 4.0
"""Factor of the slope and units of the smallest step by which ``polygon_offset`` shifts depths: the values of Cesium and QGIS."""


def draw_map(
    gl: Device,
    depth_map: DepthMap,
    buffer: GeometryBuffer,
    scene: Scene,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: MapSettings,
    record: PassRecord,
) -> Framebuffer:
    """Draw a map, or take it from the cache, and return its depth-only framebuffer.

    The content of a perspective view's map is cached, and lasts at least until the next map but one is drawn. The content of a
    block's map is not cached, and lasts until the next map is drawn.
    """
    meshes = caster_meshes(scene, buffer, kinds)
    trees = depth_map.trees
    if trees is not None and depth_map.relevant_trees is not None:
        trees = trees.select(depth_map.relevant_trees)
    # A block's sheets are made for every picture of it, so its pictures are cached instead.
    content = None if isinstance(buffer.view, MapView) else _map_cache_key(depth_map, settings, meshes, trees)
    cached_target = None if content is None else gl.depth_targets.get(content)
    if cached_target is not None:
        record.kept += 1
        record.bytes = max(record.bytes, depth_map.nbytes)
        return cached_target
    width, height = depth_map.face_size
    texture_width, texture_height = depth_map.texture_size
    target = gl.depth_target(_rounded_texture_side(texture_width), _rounded_texture_side(texture_height), depth_map.depth_bits)
    solid = gl.program(
        shader_source(depth_map.shader_parts[0], "shadows/maps/depth.vert"), shader_source("shadows/maps/depth.frag")
    )
    set_uniforms(solid, depth_map.uniforms)
    if trees is not None:
        vertex = shader_source(depth_map.shader_parts[0], "terrain/gbuffer/tree", "shadows/maps/depth_tree.vert")
        leaves = gl.program(vertex, shader_source("shadows/maps/depth_tree.frag"))
        set_uniforms(leaves, {**depth_map.uniforms, "foliage": 0, "threshold": ALPHA_THRESHOLD, "curvature": trees.curvature})
    largest_bytes = 0
    factor, units = (settings.bias_scale * part if settings.bias == "polygon_offset" else 0.0 for part in POLYGON_OFFSET)
    with gl.depth_pass(target, (factor, units)):
        for number, face in enumerate(depth_map.face_rotations):
            gl.ctx.viewport = (number % 3 * width, number // 3 * height, width, height)
            if len(depth_map.face_rotations) > 1:
                face_uniforms = _face_uniforms(depth_map.uniforms, face)
                set_uniforms(solid, face_uniforms)
                if trees is not None:
                    set_uniforms(leaves, face_uniforms)
            for sheet in caster_sheets(scene, buffer, casters, kinds):
                record.triangles += gl.draw_grid_mesh(solid, sheet.position_frame_m, sheet.triangles)
                largest_bytes = max(largest_bytes, sheet.position_frame_m.size * 4 + sheet.triangles.nbytes)
            for (vertices, triangles), culls_front in _meshes_with_culling(meshes, scene, kinds, settings.culling):
                with gl.cull_front_faces(_is_mirrored(depth_map)) if culls_front else nullcontext():
                    record.triangles += gl.draw_triangles(solid, vertices, triangles)
                largest_bytes = max(largest_bytes, len(vertices) * 12 + triangles.nbytes)
            if trees is not None:
                gl.srgb_texture_array(foliage().mip_levels).use(0)
                variant = np.concatenate([trees.yaw_cos_sin, trees.variant[:, None]], axis=1)
                instances = [("base", trees.base_frame_m), ("shape", trees.quad_sizes_m), ("look", variant)]
                record.triangles += gl.draw_instances(leaves, QUAD_TRIANGLES, instances)
                largest_bytes = max(largest_bytes, len(trees) * 40)
    record.map_texels += depth_map.texel_count
    record.bytes = max(record.bytes, depth_map.nbytes + largest_bytes)
    gl.check("depth map")
    if content is not None:
        gl.depth_targets.cache_content(target, content)
    return target


def draw_ahead(maps: Sequence[AnyMap], draw: Callable[[AnyMap], Framebuffer]) -> Iterator[tuple[AnyMap, Framebuffer]]:
    """Yield maps with the framebuffers that ``draw`` returns, drawing one map ahead.

    The next map is drawn before a map is yielded. An asynchronous device then works while the map is read and sampled.
    """
    targets = [draw(depth_map) for depth_map in maps[:1]]
    for number, depth_map in enumerate(maps):
        targets += [draw(next_map) for next_map in maps[number + 1 : number + 2]]
        yield depth_map, targets.pop(0)


def may_hold_casters(depth_map: DepthMap, buffer: GeometryBuffer, scene: Scene, kinds: tuple[CasterKind, ...]) -> bool:
    """Return whether anything may be drawn into a map of the sun for a map's block; always true for other maps.

    It is false only where all texels would stay empty: no ground is drawn, and neither trees nor meshes reach into the window.
    """
    if not isinstance(buffer.view, MapView) or depth_map.tree_bounds is None or "relief" in kinds:
        return True
    rotation, translation, low, high = depth_map.tree_bounds
    trees = depth_map.trees
    if trees is not None and depth_map.relevant_trees is not None:
        trees = trees.select(depth_map.relevant_trees)
    if trees is not None and len(trees.in_box(rotation, translation, np.array([low[0], low[1], -np.inf]), high)):
        return True
    for vertices, _ in caster_meshes(scene, buffer, kinds):
        right_up_m = vertices @ rotation[:2].T + translation[:2]
        if (right_up_m.max(axis=0) >= low[:2]).all() and (right_up_m.min(axis=0) <= high[:2]).all():
            return True
    return False


def read_depths(gl: Device, depth_map: DepthMap, target: Framebuffer) -> np.ndarray:
    """Return a map as drawn, (rows, cols) float32: 0 nearest to the light, 1 where nothing casts.

    Row 0 is the row farthest along the light's up axis.
    """
    texels = gl.read(target, -1, size=depth_map.texture_size)
    return texels if depth_map.uniforms["lamp"] else texels[::-1]


def _rounded_texture_side(side: int) -> int:
    """Return the side of a texture with room for a map's ``side``, in texels.

    A side above ``TEXTURE_SIZE_STEP`` is rounded up to a multiple of it. The sizes of maps that follow a camera or the sun differ a
    little. Rounding lets them share a texture.
    """
    return min(-(-side // TEXTURE_SIZE_STEP) * TEXTURE_SIZE_STEP, device().max_size) if side > TEXTURE_SIZE_STEP else side


def _meshes_with_culling(
    meshes: list[VerticesAndTriangles], scene: Scene, kinds: tuple[CasterKind, ...], culling: Culling
) -> list[tuple[VerticesAndTriangles, bool]]:
    """Return the meshes and ground to draw, each with whether its front faces are culled.

    If ``culling`` is ``front``, the front faces of closed bodies are culled, and no others.
    """
    if culling == "none" or "meshes" not in kinds or scene.objects.solids is None:
        return [(mesh, False) for mesh in meshes]
    *ground, (vertices, triangles) = meshes
    closed = closed_caster_mask(scene.objects)
    return [*((mesh, False) for mesh in ground), ((vertices, triangles[closed]), True), ((vertices, triangles[~closed]), False)]


def _is_mirrored(depth_map: DepthMap) -> bool:
    """Return whether the map mirrors triangles: counter-clockwise ones as seen from the light are clockwise in it."""
    return bool(np.linalg.det(np.array(depth_map.uniforms["light_from_frame"]).reshape(3, 3)) > 0.0)


def _map_cache_key(
    depth_map: DepthMap, settings: MapSettings, meshes: list[VerticesAndTriangles], trees: TreeInstances | None
) -> Hashable:
    """Return the cache key of a map: all that its drawing reads.

    Numbers are compared by value, and immutable arrays by identity.
    """
    all_trees = [] if depth_map.trees is None else [depth_map.trees]
    geometry = tuple(IdentityKey(part) for part in (*(array for mesh in meshes for array in mesh), *all_trees))
    tree_digest = None if trees is None or trees is depth_map.trees else sha256(trees.tree_number.tobytes()).digest()
    return settings, depth_map.face_size, len(depth_map.face_rotations), tuple(depth_map.uniforms.items()), geometry, tree_digest


def _face_uniforms(uniforms: dict[str, Any], face: np.ndarray) -> dict[str, Any]:
    """Return the uniforms of one cube face: a lamp's rotation and offset, rotated to the face."""
    rotation = face @ np.array(uniforms["light_from_frame"]).reshape(3, 3).T
    return {"light_from_frame": tuple(rotation.T.ravel()), "light_offset_m": tuple(face @ np.array(uniforms["light_offset_m"]))}
