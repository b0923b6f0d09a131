"""What a map's block needs of casters: ground beside it that may throw a shadow on it, and whether anything at all does.

A plan is one for a level, a zoom and a sun. What it lists and a block provably does not need (``terrain.casters.horizon_bound``) is
left out for that block, and put on record there; the picture is the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from shadows.passes import CASTERS_PASS, GEOMETRY_PASS, PassLog
from shadows.plan import Plan, Step
from shadows.registry import ALGORITHMS
from terrain.casters.casting import caster_trees
from terrain.casters.horizon_bound import idle_patches, own_ground_is_clear
from terrain.casters.reach import Casters, Receivers
from terrain.effects.cast_shadows import boxes_of_meshes
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.geo.light_space import light_bounds
from terrain.geo.sun import SUN_RADIUS_DEG
from terrain.level.level import SUN
from terrain.scene import Scene

NOTHING_OUTSIDE = "nothing outside of the block throws a shadow into it"
NOTHING_CASTS = "nothing throws a shadow in the block"

BESIDE_PX = 32
"""So many pixels beside what is seen, as the sun sees it, count as seen: texels of shadow maps and their filters reach so far."""


def caster_pass(plan: Plan) -> str:
    """The pass in which ground beside a part of a map is looked for: one that the plan has."""
    return CASTERS_PASS if CASTERS_PASS in plan.runs else GEOMETRY_PASS


def casters_beside(scene: Scene, plan: Plan, receivers: Receivers, found: Callable[[], Casters], log: PassLog) -> Casters:
    """The ground beside a part of a map that is ``found`` to be in the sun's way, with what of it is idle."""
    name = caster_pass(plan)
    with log.run(name) as record:
        casters = found()
        if _may_go_without(plan.steps_under(SUN)):
            casters = Casters(casters.patches, casters.reach, idle_patches(scene, receivers, casters.patches))
        if name == CASTERS_PASS and not casters.casting:
            record.left_out, record.note = record.left_out + 1, NOTHING_OUTSIDE
    return casters


def left_out(scene: Scene, steps: Sequence[Step], receivers: Receivers, casters: Casters, log: PassLog) -> bool:
    """Whether no shadow of the sun falls on anything in a map's block, so that none of the steps needs to be run; that is put on
    record then. Nothing is left out where intermediate pictures are asked for.
    """
    if not steps or steps[0].light != SUN or log.wanted or casters.casting or not scene.sun_is_up or not _may_go_without(steps):
        return False
    if not own_ground_is_clear(scene, receivers) or _anything_stands_before(scene, receivers):
        return False
    for step in steps:
        log.leave_out(log.named(step.light, step.kinds, ALGORITHMS[step.algorithm].passes), NOTHING_CASTS)
    return True


def _may_go_without(steps: Sequence[Step]) -> bool:
    return all(ALGORITHMS[step.algorithm].idle_casters(step.settings) for step in steps)


def _anything_stands_before(scene: Scene, receivers: Receivers) -> bool:
    """Whether meshes or trees reach into the bounds of what is seen, or lie before them, towards the sun."""
    trees = caster_trees(receivers, ("forest",)) if isinstance(receivers, GeometryBuffer) else None
    meshes = scene.objects.solids is not None
    if trees is None and not meshes:
        return False
    assert scene.light is not None
    rotation, translation = scene.light.from_frame(receivers.frame)
    low, high = light_bounds(receivers.position_frame_m, receivers.there, rotation, translation)
    if not np.isfinite(low).all():
        return False
    first, last = boxes_of_meshes(scene.objects, scene.light) if meshes else (np.zeros((0, 3)), np.zeros((0, 3)))
    deepest = float(high[2] - min(first[:, 2].min(initial=high[2]), low[2])) if meshes else float(high[2] - low[2])
    slack = BESIDE_PX * scene.surface(receivers.view.grid).step_m + np.radians(SUN_RADIUS_DEG) * 1.1 * deepest  # type: ignore[union-attr]
    if trees is not None and len(trees.reaching(rotation, translation, np.array([*(low[:2] - slack), -np.inf]), high + slack)):
        return True
    before = (last[:, :2] >= low[:2] - slack).all(axis=1) & (first <= high + slack).all(axis=1)
    return bool(before.any())
