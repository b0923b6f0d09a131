"""`shadow_volume`: the volumes of shadow behind casters, counted in the stencil. Exact to the pixel, whatever the resolution.

``shadows.volumes.volumes`` says what volumes are made of, ``shadows.volumes.drawing`` how they are counted.
"""

from __future__ import annotations

import numpy as np

from shadows.attached import attached
from shadows.passes import PassLog
from shadows.plan import VolumeSettings
from shadows.volumes.drawing import count, faces_before, silhouettes_seen
from shadows.volumes.volumes import light_in_frame, volumes_of
from terrain.casters.reach import Casters
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.level.level import CasterKind
from terrain.scene import Scene

PASSES = ("silhouettes", "stencil")


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: VolumeSettings,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32, 0 or 1, for a buffer's points past some kinds of casters.

    Where there is no surface, or one that is turned away from the light, the value means nothing. Raises ``GraphicsError``.
    """
    silhouettes_pass, stencil_pass = log.named(light, kinds, PASSES)
    at = light_in_frame(buffer, scene, light)
    with log.run(silhouettes_pass) as record:
        volumes = volumes_of(buffer, scene, at, kinds, casters, record)
    log.keep("silhouettes", light, silhouettes_seen, buffer, scene, volumes)
    log.keep("volumes", light, faces_before, buffer, scene, volumes)
    with log.run(stencil_pass) as record:
        wanted = buffer.there & ~attached(buffer, scene, light)
        counts = count(buffer, scene, at, volumes, settings, wanted, False, record)
    log.keep("stencil", light, counts.copy)
    return np.where(counts > 0, np.float32(0.0), np.float32(1.0))
