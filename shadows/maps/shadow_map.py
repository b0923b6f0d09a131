"""`shadow_map`: depth maps from the light. The sun's is orthographic and follows the view; a spot has one perspective map, an omni
light six.

``docs/shadow-maps.md`` derives it all in order: the window of a map (``windows``), comparison and bias, the filter (``lookup``),
and the sun's disc (``sun_disc``).
"""

from __future__ import annotations

import numpy as np
from moderngl import Framebuffer

from shadows.maps.drawing import draw_map
from shadows.maps.lookup import look_up
from shadows.maps.sun_disc import nearest_caster_m
from shadows.maps.windows import DepthMap, lamp_map, sun_maps
from shadows.passes import PassLog
from shadows.plan import LampMapSettings, ShadowMapSettings
from terrain.casters.casting import anything_casts, caster_trees
from terrain.casters.reach import Casters
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gl.device import Device, device
from terrain.level.level import CasterKind
from terrain.scene import Scene

PASSES = ("depth map", "visibility")


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: ShadowMapSettings | LampMapSettings,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32 in [0, 1], for a buffer's points past some kinds of casters.

    Where there is no surface, or one that is turned away from the light, the value means nothing. Raises ``GraphicsError``.
    """
    depth_pass, visibility_pass = log.named(light, kinds, PASSES)
    trees = caster_trees(buffer, kinds)
    maps: list[DepthMap] = []
    with log.run(depth_pass):  # fitting a map is part of making it
        if not anything_casts(scene, buffer, kinds):
            pass
        elif isinstance(settings, ShadowMapSettings):
            nearest_m = nearest_caster_m(scene, buffer, kinds, casters, trees) if settings.filter == "sun" else np.inf
            maps = sun_maps(buffer, scene, settings, trees, nearest_m)
        elif (lit := lamp_map(buffer, scene.lamps[light], settings, trees)) is not None:
            maps = [lit]
    if not maps:  # no casters, or no receivers
        with log.run(visibility_pass):
            return np.ones(buffer.there.shape, np.float32)
    gl = device()
    visibility = np.ones(buffer.there.shape, np.float32)
    for drawn in maps:
        with log.run(depth_pass) as record:
            target = draw_map(gl, drawn, buffer, scene, kinds, casters, settings, record)
        log.keep("shadow-map", light, depths, gl, drawn, target)
        with log.run(visibility_pass) as record:
            look_up(gl, drawn, target, buffer, settings, visibility, record)
    return visibility


def depths(gl: Device, drawn: DepthMap, target: Framebuffer) -> np.ndarray:
    """A map as drawn, (rows, cols) float32: 0 nearest to the light, 1 where nothing casts; the light's up is at the top."""
    texels = gl.read(target, -1)
    return texels if drawn.uniforms["lamp"] else texels[::-1]
