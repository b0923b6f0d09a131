"""Crowns: leaves let light through, and a tree that is three crossed pictures does not show it.

The shadow that a tree's quads throw on each other is what algorithms rightly find; but a crown is no cross. Seen as it is found,
it draws a sharp line down each crown, and streaks when the sun is low. In a real crown light comes through and round the leaves
from everywhere: behind one layer of them there is still a good part of it (a leaf lets about a tenth of green light through and
scatters as much; what is left comes through the gaps). So on foliage, and there alone, the share ``THROUGH_LEAVES`` of the sun's
light gets past other foliage. Past ground and meshes none does: a ray from the point says what stands there. Its form a crown has
from its normals (``terrain.gbuffer.resolve``), its grain from the pictures.

Visibilities, masks and everything that is measured stay as they are: this is shading alone. In maps, where the level quad is
seen, there is no cross to hide.
"""

from __future__ import annotations

import numpy as np

from terrain.effects.cast_shadows import trees_seen
from terrain.effects.effect import Effect, ShadingBlock, Verdict
from terrain.effects.haze import trees_in_view
from terrain.facts.coarse_view import CoarseView
from terrain.facts.descriptor import Descriptor
from terrain.facts.fact_types import Fact
from terrain.facts.mesh_rays import first_mesh_hits
from terrain.facts.relief_rays import hidden_by_relief
from terrain.gbuffer.resolve import FOREST
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.scene import Scene
from terrain.shading import daylight_of

THROUGH_LEAVES = 0.65
"""Share of the sun's light that reaches leaves behind other leaves."""

CELL_M = 2.0
"""Leaves within such a cell are in the shadow of ground and meshes together: rays are looked for once in it ..."""

CELL_TANGENT = 0.004
"""... or in a larger one, of about this angle from the eye."""


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
    row, col = np.nonzero((buffer.kind == FOREST) & (sunlight < 1.0))
    if not len(row):
        return
    point = buffer.position_frame_m[row, col]
    key, cell_m = _cells(point, block.view.in_frame(buffer.frame)[0])
    _, first, cell = np.unique(key, return_index=True, return_inverse=True)
    # From the middle of a cell, so that it is the same from wherever a picture begins.
    wide = cell_m[first, None]
    start, to_sun = (np.floor(point[first] / wide) + 0.5) * wide, scene.sun.in_frame(buffer.frame)
    hidden = hidden_by_relief(scene.world, scene.elevation, buffer.frame, start, to_sun)
    if scene.objects.solids is not None:
        away_m, _ = first_mesh_hits(
            scene.objects, buffer.frame, start, np.broadcast_to(to_sun, start.shape), np.full(len(start), np.inf)
        )  # fmt: skip
        hidden |= np.isfinite(away_m)
    seen = sunlight[row, col]
    sunlight[row, col] = seen + (1.0 - seen) * np.where(hidden[cell.reshape(-1)], 0.0, THROUGH_LEAVES).astype(np.float32)


def _cells(point: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A number (n,) int64 for the cell that each point (n, 3) lies in, and how wide that is, metres."""
    away_m = np.linalg.norm(point - eye, axis=1)
    doubled = np.ceil(np.log2(np.maximum(away_m * CELL_TANGENT / CELL_M, 1.0))).astype(np.int64)
    cell_m = CELL_M * 2.0**doubled
    place = np.floor(point / cell_m[:, None]).astype(np.int64) & 0x3FFFF
    return ((doubled << 18 | place[:, 0]) << 18 | place[:, 1]) << 18 | place[:, 2], cell_m


EFFECT = Effect("light through foliage", called_for, facts, "sunlight", apply_crowns, needs=("cast_shadows",))
