"""Attached shadow: surfaces that face away from a light. It is computed once, outside of the algorithms, for all of them."""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.light_facing import MIN_LIGHT_SINE, facing_normals
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


def attached_shadow_mask(buffer: GeometryBuffer, scene: Scene, light: str = SUN) -> np.ndarray:
    """Return where a surface faces away from a light or lies outside its cone, bool (rows, cols); True off the surface, too.

    A surface is in attached shadow in these cases:

    - Its normal does not face the light (``facing_normals``): n.l is not above ``MIN_LIGHT_SINE``. Leaves are lit from either side.
    - It lies outside of the cone of a spot.
    - The scene has no sun, or the sun is below the horizon everywhere.
    """
    leaves = buffer.surface_kind == FOREST
    if light == SUN:
        if not scene.sun_is_up or scene.sun is None:
            return np.ones(buffer.valid.shape, bool)
    source = scene.light_position(light, buffer.frame)
    normal = facing_normals(buffer, source).normal_frame
    if light == SUN:
        return faces_away(normal, leaves, np.array(source[:3]))
    lamp = scene.lamps[light]
    position, axis, _ = lamp.in_frame(buffer.frame)
    cosine, out = float(np.cos(np.radians(lamp.cutoff_deg))), np.ones(buffer.valid.shape, np.bool_)
    run_in_chunks(len(out), _write_lamp_shadow_mask, buffer.position_frame_m, normal, leaves, position, axis, cosine, out)
    return out


def faces_away(normal: np.ndarray, leaf_mask: np.ndarray, to_light: np.ndarray) -> np.ndarray:
    """Return where unit normals (rows, cols, 3) do not face a direction, bool (rows, cols); True where a normal is NaN.

    ``to_light`` (3,) is the direction. Where ``leaf_mask`` (rows, cols) is true, either side of a surface may face it.
    """
    out = np.empty(leaf_mask.shape, np.bool_)
    run_in_chunks(len(out), _write_facing_away_mask, normal, leaf_mask, to_light, out)
    return out


@compiled
def _write_facing_away_mask(first, last, normal, leaf_mask, to_light, out):
    """Write to ``out`` (rows, cols) where normals (rows, cols, 3) do not face the unit direction ``to_light`` (3,).

    The rows are those in [``first``, ``last``). Where ``leaf_mask`` (rows, cols) is true, either side of a surface may face it.
    """
    for i in range(first, last):
        for j in range(normal.shape[1]):
            n = normal[i, j]
            facing = n[0] * to_light[0] + n[1] * to_light[1] + n[2] * to_light[2]
            out[i, j] = not (abs(facing) if leaf_mask[i, j] else facing) > MIN_LIGHT_SINE


@compiled
def _write_lamp_shadow_mask(first, last, point, normal, leaf_mask, lamp_position, lamp_axis, cutoff_cosine, out):
    """Write to ``out`` (rows, cols) where points (rows, cols, 3) face away from a lamp, or lie outside of its cone.

    ``point`` are positions in metres, and ``normal`` (rows, cols, 3) the unit normals there. The rows are those in [``first``,
    ``last``). Where ``leaf_mask`` (rows, cols) is true, either side of a surface may face the lamp. The lamp is at
    ``lamp_position`` (3,). ``lamp_axis`` (3,) is its cone's unit axis, and ``cutoff_cosine`` the cosine of half the cone's angle.
    """
    for i in range(first, last):
        for j in range(normal.shape[1]):
            x, y, z = lamp_position[0] - point[i, j, 0], lamp_position[1] - point[i, j, 1], lamp_position[2] - point[i, j, 2]
            facing = normal[i, j, 0] * x + normal[i, j, 1] * y + normal[i, j, 2] * z
            along_axis = -(lamp_axis[0] * x + lamp_axis[1] * y + lamp_axis[2] * z)
            length = np.sqrt(x * x + y * y + z * z)
            inside = along_axis >= cutoff_cosine * length
            out[i, j] = not ((abs(facing) if leaf_mask[i, j] else facing) > MIN_LIGHT_SINE * length and inside)
