"""The sun's disc behind a depth map: its samples, and how far across the map it is seen."""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.casting import caster_meshes, caster_sheets
from skugga.terrain.casters.reach import Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

DISC_TANGENT = float(np.tan(np.radians(SUN_RADIUS_DEG)))
"""Half the disc's width at distance 1."""

DISC_SAMPLES = 128
"""Samples of the disc: one bit each of four words."""

EDGES = 128
"""Steps along the disc's width that the edges of what covers it are rounded to."""

BLOCK_TEXELS = 16
"""Side of the blocks of texels whose least depth is known."""

WIDEST_TEXELS = 64
"""The widest that half the disc is taken for across the map; the penumbra of what lies farther stays as narrow."""

DISC_TAPS = 3
"""Taps a side that what is near is compared by: the disc is never taken for narrower than two texels."""


@cached("process", MIB)
def samples_before_edges() -> tuple[np.ndarray, np.ndarray]:
    """For each of ``EDGES + 1`` places in [-1, 1] the bits (4 words, uint32) of the samples right of the first and up that lie
    before it. The samples are Vogel's spiral (1979), equal areas each.
    """
    number = np.arange(DISC_SAMPLES)
    angle, away = number * np.pi * (3.0 - 5.0**0.5), np.sqrt((number + 0.5) / DISC_SAMPLES)
    edge = np.linspace(-1.0, 1.0, EDGES + 1)[:, None]
    before = [np.packbits(away * across(angle) < edge, axis=1, bitorder="little").view("<u4") for across in (np.cos, np.sin)]
    return before[0], before[1]


def border_texels(depth_m: float, texel_m: np.ndarray) -> np.ndarray:
    """Texels (right, up) that the disc reaches to beside a point whose casters lie up to ``depth_m`` before it."""
    return np.minimum(np.ceil(depth_m * DISC_TANGENT / texel_m).astype(np.int64) + 1, WIDEST_TEXELS)


def nearest_caster_m(
    scene: Scene, buffer: GeometryBuffer, kinds: tuple[CasterKind, ...], casters: Casters, trees: TreeInstances | None
) -> float:
    """The smallest light-space depth of what casts, metres; infinite where nothing does."""
    assert scene.light is not None
    rotation, translation = scene.light.from_frame(buffer.frame)
    points = [sheet.position_frame_m.reshape(-1, 3) for sheet in caster_sheets(scene, buffer, casters, kinds)]
    points += [vertices for vertices, _ in caster_meshes(scene, buffer, kinds)]
    if trees is not None:
        points.append(trees.corners().reshape(-1, 3))
    depths_m = [float(np.nanmin(point_set @ rotation[2], initial=np.inf)) for point_set in points]
    return min(depths_m, default=np.inf) + float(translation[2])
