"""Compute visibility by depth maps: draw each map, and look points up in it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.maps.drawing import MapSettings, draw_ahead, draw_map, may_hold_casters, read_depths
from skugga.shadows.maps.light_layers import keep_map_layers
from skugga.shadows.maps.lookup import look_up
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassLog
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from moderngl import Framebuffer


def visibility_by_maps(
    maps: Sequence[DepthMap],
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: MapSettings,
    passes: tuple[str, str],
    log: PassLog,
) -> np.ndarray:
    """Draw a light's depth maps, and return the visibility of a buffer's points by looking them up.

    Parameters
    ----------
    maps
        The maps to draw. Without any, all points are lit, and the look-up pass is recorded without work.
    buffer, scene, light, kinds, casters, settings, log
        As in ``Fill``.
    passes
        The names of the drawing pass and of the look-up pass.

    Returns
    -------
    numpy.ndarray
        Visibility (rows, cols) float32 in [0, 1].

    Raises
    ------
    GraphicsError
        OpenGL fails.
    """
    draw_pass, look_up_pass = passes
    visibility = np.ones(buffer.valid.shape, np.float32)
    if not log.requested_layers:
        with log.record_pass(draw_pass):
            casting_maps = [depth_map for depth_map in maps if may_hold_casters(depth_map, buffer, scene, kinds)]
        if len(casting_maps) < len(maps) and buffer.surface is not None:
            visibility[facing_normals(buffer, scene.light_position(light, buffer.frame)).is_blocked] = 0.0
        maps = casting_maps
    if not maps:
        with log.record_pass(look_up_pass):
            return visibility
    gl = device()

    def draw(depth_map: DepthMap) -> Framebuffer:
        with log.record_pass(draw_pass) as record:
            return draw_map(gl, depth_map, buffer, scene, kinds, casters, settings, record)

    for number, (depth_map, target) in enumerate(draw_ahead(maps, draw)):
        log.keep_layer("shadow-map", light, read_depths, gl, depth_map, target)
        keep_map_layers(log, gl, number, depth_map, target, buffer, scene, light, kinds, casters)
        with log.record_pass(look_up_pass) as record:
            look_up(gl, depth_map, target, buffer, scene.light_position(light, buffer.frame), settings, visibility, record)
    return visibility
