"""Crowns: leaves let light through, and a tree that is three crossed pictures does not show it.

The shadow that a tree's quads throw on each other is what algorithms rightly find; but a crown is no cross. Seen as it is found,
it draws a sharp line down each crown, and streaks when the sun is low. In a real crown light comes through and round the leaves
from everywhere: behind one layer of them there is still a good part of it (a leaf lets about a tenth of green light through and
scatters as much; what is left comes through the gaps). So on foliage, and there alone, the share ``THROUGH_LEAVES`` of the sun's
light gets past other foliage. Past ground and meshes none does: a ray from the point says what stands there. Its form a crown has
from its normals (``skugga.terrain.gbuffer.resolve``), its grain from the pictures.

Visibilities, masks and everything that is measured stay as they are: this is shading alone. In maps, where the level quad is
seen, there is no cross to hide.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, in_shares
from skugga.terrain.effects.cast_shadows import trees_seen
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.haze import trees_in_view
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.facts.mesh_rays import first_mesh_hits
from skugga.terrain.facts.relief_rays import hidden_by_relief
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of

THROUGH_LEAVES = 0.65
"""Share of the sun's light that reaches leaves behind other leaves."""

CELL_M = 2.0
"""Leaves within such a cell are in the shadow of ground and meshes together: rays are looked for once in it ..."""

CELL_TANGENT = 0.004
"""... or in a larger one, of about this angle from the eye."""

PLACE_BITS = 18
"""Bits of a cell's place along each axis: beyond so many cells another one has the same number."""


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out in maps, where no tree is in view, and where there is no direct sunlight."""
    facts = descriptor.facts["crowns"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows crowns from above")
    if not facts["trees"]:
        return Verdict(False, "no tree is in view")
    if not facts["sunlit"]:
        return Verdict(False, "there is no direct sunlight")
    return Verdict(True, f"sunlight comes through the crowns of {facts['trees']:.0f} trees")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """How many ``trees`` may be in a perspective view, and whether direct sunlight reaches the level."""
    if isinstance(view, MapView) or coarse_view is None:
        return {"trees": 0, "sunlit": scene.sun_is_up}
    stand, near = trees_in_view(scene, view, coarse_view.buffer.frame)
    sunlit = scene.sun_is_up and bool(daylight_of(scene).sun.any())
    seen = stand is not None and trees_seen(scene.objects, view, coarse_view)[1]
    return {"trees": len(near) if seen else 0, "sunlit": sunlit}


def apply_crowns(sunlight: np.ndarray, block: ShadingBlock) -> None:
    """Let light through to leaves that other leaves hide the sun from."""
    buffer, scene = block.buffer, block.scene
    if isinstance(block.view, MapView) or scene.sun is None or not scene.sun_is_up:
        return
    pixels = np.flatnonzero((buffer.kind == FOREST) & (sunlight < 1.0))
    if not len(pixels):
        return
    points, key = buffer.position_frame_m.reshape(-1, 3), np.empty(len(pixels), np.int64)
    in_shares(len(pixels), _cells, points, pixels, block.view.in_frame(buffer.frame)[0], key)
    keys, first, cell = np.unique(key, return_index=True, return_inverse=True)
    # From the middle of a cell, so that it is the same from wherever a picture begins.
    wide = CELL_M * 2.0 ** (keys >> 3 * PLACE_BITS)[:, None]
    start, to_sun = (np.floor(points[pixels[first]] / wide) + 0.5) * wide, scene.sun.in_frame(buffer.frame)
    hidden = hidden_by_relief(scene.world, scene.elevation, buffer.frame, start, to_sun)
    if scene.objects.solids is not None:
        away_m, _ = first_mesh_hits(
            scene.objects, buffer.frame, start, np.broadcast_to(to_sun, start.shape), np.full(len(start), np.inf)
        )  # fmt: skip
        hidden |= np.isfinite(away_m)
    in_shares(len(pixels), _let_through, sunlight, pixels, hidden, cell.reshape(-1), np.float32(THROUGH_LEAVES))


@compiled
def _cells(first, last, points, pixels, eye, key):
    """A number for the cell that each of some points lies in: how often its width is doubled, then its place along each axis."""
    for n in range(first, last):
        p = points[pixels[n]]
        x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
        away_m, doubled, wide = np.sqrt(x * x + y * y + z * z), 0, CELL_M
        while wide < away_m * CELL_TANGENT:
            doubled, wide = doubled + 1, 2.0 * wide
        number = doubled
        for k in range(3):
            number = number << PLACE_BITS | np.int64(np.floor(p[k] / wide)) & (1 << PLACE_BITS) - 1
        key[n] = number


@compiled
def _let_through(first, last, sunlight, pixels, hidden, cell, share):
    for n in range(first, last):
        if not hidden[cell[n]]:
            row, col = divmod(pixels[n], sunlight.shape[1])
            seen = sunlight[row, col]
            sunlight[row, col] = seen + (np.float32(1.0) - seen) * share


EFFECT = Effect("light through foliage", called_for, facts, "sunlight", apply_crowns, needs=("cast_shadows",))
