"""Normals for the shading of a map's block: generalised ones, and ones that a local light turns. Buildings and trees keep theirs.

``skugga.terrain.gbuffer.landforms`` has both; here they apply to a geometry buffer with samples at its edges.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.gbuffer.landforms import generalised_normals, local_light_turn_deg, locally_lit_normals
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import map_pixel_m


def up_and_pixels(block: ShadingBlock) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray] | None]:
    """Return the unit vectors up (rows, cols, 3) float32 at a block's points, and the rows and columns of their pixels.

    The pixels are ``None`` without samples: each point then has a pixel of its own.
    """
    buffer = block.buffer
    up = buffer.position_frame_m - block.scene.world.up_origin(buffer.frame)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    pixels = None
    if len(buffer.valid) > block.view.rows:
        row, col = np.indices(buffer.valid.shape).reshape(2, -1)
        row, col = block.pixels_of_points(row, col)
        pixels = row.reshape(buffer.valid.shape), col.reshape(buffer.valid.shape)
    return up.astype(np.float32), pixels


def with_generalised_normals(block: ShadingBlock) -> ShadingBlock:
    """Return a map's block with the normals of its style's generalisation; the block itself if the style has none."""
    view, scene = block.view, block.scene
    if not isinstance(view, MapView) or scene.style.generalisation_at(map_pixel_m(scene.world, view)) == 0.0:
        return block
    up, pixels = up_and_pixels(block)
    buffer = block.buffer
    return _with_ground_normals(block, generalised_normals(scene, view, buffer.frame, buffer.shading_normal_frame, up, pixels))


def with_locally_lit_normals(block: ShadingBlock) -> ShadingBlock:
    """Return a map's block with normals turned against the style's local light; the block itself if nothing turns."""
    view, scene = block.view, block.scene
    if not isinstance(view, MapView) or local_light_turn_deg(scene) == 0.0:
        return block
    up, pixels = up_and_pixels(block)
    buffer = block.buffer
    return _with_ground_normals(block, locally_lit_normals(scene, view, buffer.frame, buffer.shading_normal_frame, up, pixels))


def _with_ground_normals(block: ShadingBlock, normal_frame: np.ndarray) -> ShadingBlock:
    """Return a block whose ground has other normals for shading (rows, cols, 3)."""
    is_ground = (block.buffer.surface_kind == RELIEF)[..., None]
    normal_frame = np.where(is_ground, normal_frame, block.buffer.shading_normal_frame)
    return replace(block, buffer=replace(block.buffer, shading_normal_frame=normal_frame))
