"""Zooming out: a coarse map has as much shadow as the data's native zoom."""

from __future__ import annotations

import numpy as np

from skugga.selector.planner.planner import make_plan
from skugga.shadows import render
from skugga.shadows.passes import PassLog
from skugga.terrain.describe import describe
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import SHADOW_ALGORITHMS, Trial, hard_case

PIXEL_M = 64.0
"""About a cell of the bundled mountains, and a power of two: pixels of squares round the anchor then lie on nodes, as a tile's do.
"""


def share_of_shadow(trial: Trial, scene: Scene, side_px: int, zooms_below: int) -> float:
    """Return the mean shadow of a square round the level's anchor, ``side_px`` pixels of ``PIXEL_M`` a side.

    The square is drawn in pixels that are 2**zooms_below times as large.
    """
    x, y = (float(value) for value in scene.world.map_position(scene.map_crs, scene.world.anchor_earth_m)[:2])
    half, pixels = side_px * PIXEL_M / 2, side_px // 2**zooms_below
    view = scene.view(bounds=(x - half, y - half, x + half, y + half), size=(pixels, pixels))
    assert isinstance(view, MapView) and view.is_on_nodes
    plan = make_plan(describe(scene, view), scene.loaded.level, {"algorithm": trial.algorithm})
    # A block of the view's own size, without the rest of the blocks that tiles are cut from.
    block = render.render_block(scene, view, plan, PassLog(), "means")
    return 1.0 - float(np.nanmean(block.visibility))


@hard_case(
    "Y4",
    "Zooming out does not change how much lies in shadow",
    "the bundled mountains under a sun 10 degrees high, in pixels as large as the data's cells, 4 and 16 times as large",
    {"share two zooms below": 0.015, "share four zooms below": 0.04},
    algorithms=(*SHADOW_ALGORITHMS, "truth"),
)
def test_share_of_shadow(trial: Trial) -> dict[str, float]:
    scene = trial.scene("jacksboro", (113.0, 10.0))
    side_px = 256 if trial.thorough else 96
    native_share, two_below_share, four_below_share = (share_of_shadow(trial, scene, side_px, zooms) for zooms in (0, 2, 4))
    assert 0.2 < native_share < 0.8
    return {
        "share two zooms below": abs(two_below_share - native_share),
        "share four zooms below": abs(four_below_share - native_share),
    }
