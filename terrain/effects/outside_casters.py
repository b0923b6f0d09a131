"""Casters outside the view: ground beyond a map's block, towards the sun, that can cast shadows into the block.

All trees and meshes of a level are always loaded, wherever they stand. The ground of a perspective view is always complete, too.
The effect therefore concerns only maps, and only ground.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.effects import cast_shadows
from skugga.terrain.effects.effect import Effect, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, blocks_of
from skugga.terrain.ground.visible_cells import is_block
from skugga.terrain.scene import Scene


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a map, and ground outside of it that can cast.

    Left out: perspective views, which hold all ground; a picture that shows all the ground there is, in one block.
    """
    if descriptor.view_kind == "perspective":
        return Verdict(False, "not needed: a perspective view already includes all ground, even behind the camera")
    if not descriptor.facts.get("outside_casters", {}).get("outside", True):
        return Verdict(False, "one block shows all of the ground")
    relief = cast_shadows.sun_caster_verdict(descriptor, "relief")
    if relief.is_needed and cast_shadows.sun_verdict(descriptor).is_needed:
        return Verdict(True, f"{relief.reason}, also outside the view")
    if any(lamp.reaches for lamp in descriptor.lamps) and descriptor.relief_m > 0.0:
        return Verdict(True, "ground between the view and a lamp can cast shadows into the view")
    return Verdict(False, relief.reason if not relief.is_needed else cast_shadows.sun_verdict(descriptor).reason)


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the fact ``outside``: whether a map does not show all of the level's ground in one block. Empty in perspective.

    For tiles it is whether the ground spans several blocks.
    """
    if isinstance(view, PerspectiveView):
        return {}
    (first_row, last_row), (first_col, last_col) = extent_on_grid(scene.world, scene.elevation, view.grid)
    if is_block(view):
        ends = (first_row, last_row), (first_col, last_col)
        return {"outside": any(first // BLOCK_PX != last // BLOCK_PX for first, last in ends)}
    rows, cols = view.row0 + view.row_step * np.array([0, view.rows - 1]), view.col0 + view.col_step * np.array([0, view.cols - 1])
    is_one_block = len(blocks_of(view)) == 1  # with several blocks, ground of one is outside of the others
    inside = is_one_block and rows[0] <= first_row and last_row <= rows[1] and cols[0] <= first_col and last_col <= cols[1]
    return {"outside": not inside}


EFFECT = Effect(
    "shadows of ground beyond a map's block", judge, facts, required_effects=("cast_shadows",), verdict_without_facts=None
)
