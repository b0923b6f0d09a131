"""Cache what blocks of maps show of levels with meshes or trees: it is the same under every sun.

A moving sun needs the block's points again, and those of the samples at the edges of its shadows. The nodes of both are computed
once. Few pixels show meshes or trees, so that their triangles and albedos are stored for these pixels alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.gbuffer.geometry import GeometryBuffer, MapNodes, map_nodes
from skugga.terrain.gbuffer.resolve import FOREST, MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, ground_imagery, view_frame
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene

EDGE_SAMPLES_PER_SIDE = 2
"""Number of samples along each side of a pixel on an edge. The pixel's own point is one more sample."""


@dataclass(frozen=True, eq=False)
class MapBlock:
    """The surface that a map's block shows, without what the sun changes.

    Attributes
    ----------
    nodes
        The nodes that the block's pixels and their samples are interpolated from.
    bare_buffer
        The block's buffer without the arrays below, and without its ``surface``, which the nodes contain.
    object_pixel
        int32 (n,), flat indices of the pixels that show meshes or trees.
    corners_frame_m, albedo
        float32 (n, 9) and (n, 3), the arrays of the buffer in these pixels.
    """

    nodes: MapNodes
    bare_buffer: GeometryBuffer
    object_pixel: np.ndarray
    corners_frame_m: np.ndarray
    albedo: np.ndarray

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays. The trees and vertices of the whole level belong to other caches."""
        buffer, window = self.bare_buffer, self.nodes.window
        optional = (buffer.lift_m, buffer.triangle, buffer.albedo)
        arrays = (
            window.height_m, window.valid, window.position_frame_m, self.nodes.smooth_normals, self.object_pixel,
            self.corners_frame_m, self.albedo, buffer.valid, buffer.position_frame_m, buffer.height_m, buffer.normal_frame,
            buffer.shading_normal_frame, buffer.crease, buffer.surface_kind, *(array for array in optional if array is not None),
        )  # fmt: skip
        return sum(array.nbytes for array in arrays)

    def buffer(self, scene: Scene) -> GeometryBuffer:
        """Return the geometry buffer of the block, equal to that of ``geometry_buffer``."""
        bare = self.bare_buffer
        assert isinstance(bare.view, MapView)
        surface = self.nodes.around(scene.surface(bare.view.grid), bare.view).window
        shape = bare.valid.shape
        corners = np.zeros((bare.valid.size, 9), np.float32)
        corners[self.object_pixel] = self.corners_frame_m
        albedo = bare.albedo
        if albedo is None:
            albedo = np.full((*shape, 3), np.nan, np.float32)
            albedo.reshape(-1, 3)[self.object_pixel] = self.albedo
        return replace(bare, surface=surface, corners_frame_m=corners.reshape(*shape, 9), albedo=albedo)


def has_map_block(scene: Scene) -> bool:
    """Return whether blocks of a level's maps are cached: those with meshes or trees on smooth ground."""
    return scene.elevation.surface == "smooth" and len(scene.objects.caster_kinds) > 1


def _cache_key(scene: Scene, view: MapView) -> tuple[object, ...]:
    """Return the cache key of ``map_block``. It leaves out the sun and the lamps, which do not change the block."""
    return scene.world, scene.elevation, scene.objects, ground_imagery(scene), view


@cached("scene", 512 * MIB, key=_cache_key)
def map_block(scene: Scene, view: MapView) -> MapBlock:
    """Return the surface that a map's block shows. The level must have meshes or trees (``has_map_block``)."""
    frame, surface = view_frame(scene, view), scene.surface(view.grid)
    nodes = map_nodes(surface, [view, view.finer(EDGE_SAMPLES_PER_SIDE)], frame)
    buffer = geometry_buffer(scene, view, frame, nodes=nodes.around(surface, view))
    corners, albedo, kind = buffer.corners_frame_m, buffer.albedo, buffer.surface_kind
    assert corners is not None and albedo is not None
    pixel = np.flatnonzero((kind == MESHES) | (kind == FOREST)).astype(np.int32)
    bare_buffer = replace(buffer, surface=None, corners_frame_m=None, albedo=None if ground_imagery(scene) is None else albedo)
    return MapBlock(nodes, bare_buffer, pixel, corners.reshape(-1, 9)[pixel], albedo.reshape(-1, 3)[pixel])


def trim_map_block_cache(max_entries: int) -> None:
    """Remove all but the ``max_entries`` last used blocks from the cache, for a raster that is processed once from end to end."""
    map_block.cache.trim(max_entries)


def nodes_of_samples(scene: Scene, block: MapView, part: MapView) -> MapNodes | None:
    """Return the nodes of the samples in a part of a block; ``None`` where the block is not cached.

    ``part`` is the view of the samples: a part of ``block`` with ``EDGE_SAMPLES_PER_SIDE`` samples along a pixel's side.
    """
    return map_block(scene, block).nodes.around(scene.surface(block.grid), part) if has_map_block(scene) else None
