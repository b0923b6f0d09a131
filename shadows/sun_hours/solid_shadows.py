"""Shadows of buildings and models at the cells of a block, for hours of sun: rays to the sun through the meshes' triangles."""

from __future__ import annotations

import numpy as np

from skugga.shadows.attached_shadow import faces_away
from skugga.terrain.compiled import CORES, map_on_cores
from skugga.terrain.facts.mesh_rays import caster_bvh, is_sun_blocked
from skugga.terrain.gbuffer.antialias import picture_buffer
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.supersampling import subdivision_level
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import Sun
from skugga.terrain.scene import Scene

RAYS_PER_CHUNK = 2**14
"""Rays that a thread traces at a time."""


def rays_find_all_shadows(scene: Scene, view: MapView) -> bool:
    """Return whether rays through meshes and the sweep of the ground find all shadows at a map's cells.

    The ground must be smooth and without trees, and cells must not be coarser than the raster's.
    """
    kinds = set(scene.objects.caster_kinds)
    return scene.elevation.surface == "smooth" and kinds == {"relief", "meshes"} and subdivision_level(scene, view) == 0


class SolidShadows:
    """The surface of a block with buildings and models, and the shadows that these cast on it.

    Attributes
    ----------
    valid
        bool (rows, cols), valid mask: the cell shows a surface, and there is ground below it.
    above_ground_m
        float32 (rows, cols), the surface's height above the ground, metres: 0 except on buildings and models.
    """

    def __init__(self, scene: Scene, nodes: BareNodes) -> None:
        buffer = picture_buffer(scene, nodes.view).pixel_buffer
        self._buffer = buffer
        self._tree = caster_bvh(scene.objects)  # once: a tree above the limit of the cache is built at each call
        self.valid = buffer.valid & ~np.isnan(nodes.height_m)
        self._is_solid = self.valid & (buffer.surface_kind == MESHES)
        self.above_ground_m = np.where(self._is_solid, buffer.height_m - nodes.height_m, np.float32(0.0))

    def is_shaded(self, sun: Sun, receiver_mask: np.ndarray) -> np.ndarray:
        """Return which cells of ``receiver_mask`` (rows, cols) see no sun because of buildings and models, bool (rows, cols).

        The cells of a roof that faces away from the sun are among them.
        """
        buffer, towards = self._buffer, sun.in_frame(self._buffer.frame)
        turned_away = self._is_solid & faces_away(buffer.normal_frame, np.zeros(self._is_solid.shape, np.bool_), towards)
        shaded = receiver_mask & turned_away
        rows, cols = np.nonzero(receiver_mask & self.valid & ~turned_away)

        def trace(rays: slice) -> None:
            row, col = rows[rays], cols[rays]
            start, normal = buffer.position_frame_m[row, col], buffer.normal_frame[row, col]
            shaded[row, col] = is_sun_blocked(self._tree, buffer.frame, start, normal, towards)

        map_on_cores(trace, (slice(first, first + RAYS_PER_CHUNK) for first in range(0, len(rows), RAYS_PER_CHUNK)), CORES)
        return shaded
