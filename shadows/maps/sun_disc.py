"""The sun's disc for depth maps: its samples, and its width across a map.

Each texel in front of the receiver is a rectangle at its stored distance, which covers some of the disc's samples
(``docs/shadow-maps.md``).

**Search area.** With the disc's radius r, a caster s metres in front of the receiver matters up to s tan r beside it in the map.
Blocks of texels with a known minimum depth bound the search more tightly. Rectangles are widened to touch neighbours that also
occlude, so that no light leaks between the depths of one surface.

**Self-shadowing.** A plane with slope m in depth has s = m d at distance d beside the receiver. It covers a part of the disc only
if m tan r > 1, and then really hides it; the receiver's normal tells which samples. But a texel of side t reaches t/2 to either
side of its centre, so this holds only where s tan r >= t/2. Nearer casters are compared as in a look-up with three taps. Samples
are spread over a texel's radius, so that edges have no stairs. Where s tan r is between t/2 and t, both methods are used.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_meshes, caster_sheets
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

DISC_TANGENT = float(np.tan(np.radians(SUN_RADIUS_DEG)))
"""Half the disc's width at distance 1."""

DISC_SAMPLES = 128
"""Number of samples of the disc: one bit each of four words."""

DISC_EDGE_STEPS = 128
"""Steps along the disc's width to which the edges of occluders are rounded."""

BLOCK_TEXELS = 16
"""Side in texels of the blocks whose minimum depth is stored."""

MAX_HALF_DISC_TEXELS = 64
"""Upper bound of half the disc's width across a map, in texels. Penumbrae of farther casters do not get wider."""

MIN_DISC_TAPS = 3
"""Taps along a side of the filter where casters are so near that the disc is under two texels wide."""


@cached("process", MIB)
def disc_samples_before_edges() -> tuple[np.ndarray, np.ndarray]:
    """Return which samples of the disc lie before an edge, as bits, for edges at ``DISC_EDGE_STEPS + 1`` positions in [-1, 1].

    Both arrays are uint32 (``DISC_EDGE_STEPS + 1``, 4), with one bit for each sample. Positions run to the right in the first
    array, and upwards in the second. The samples are Vogel's spiral (1979), of equal areas.
    """
    number = np.arange(DISC_SAMPLES)
    angle, radius = number * np.pi * (3.0 - 5.0**0.5), np.sqrt((number + 0.5) / DISC_SAMPLES)
    edge = np.linspace(-1.0, 1.0, DISC_EDGE_STEPS + 1)[:, None]
    bits = [np.packbits(radius * component(angle) < edge, axis=1, bitorder="little").view("<u4") for component in (np.cos, np.sin)]
    return bits[0], bits[1]


def border_texels(depth_m: float, texel_m: np.ndarray) -> np.ndarray:
    """Return the border in texels (right, up) that the disc needs for casters up to ``depth_m`` in front of a point.

    ``texel_m`` (2,) are the sides of a texel, right and up.
    """
    return np.minimum(np.ceil(depth_m * DISC_TANGENT / texel_m).astype(np.int64) + 1, MAX_HALF_DISC_TEXELS)


def nearest_caster_m(
    scene: Scene, buffer: GeometryBuffer, kinds: tuple[CasterKind, ...], casters: Casters, trees: TreeInstances | None
) -> float:
    """Return the smallest light-space depth of the casters, metres; infinity without any."""
    assert scene.light_space is not None
    rotation, translation = scene.light_space.transform_from_frame(buffer.frame)
    points = [sheet.position_frame_m.reshape(-1, 3) for sheet in caster_sheets(scene, buffer, casters, kinds)]
    points += [vertices for vertices, _ in caster_meshes(scene, buffer, kinds)]
    if trees is not None:
        points.append(trees.corners().reshape(-1, 3))
    depths_m = [float(np.nanmin(point_set @ rotation[2], initial=np.inf)) for point_set in points]
    return min(depths_m, default=np.inf) + float(translation[2])
