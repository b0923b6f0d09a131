"""What a map's block needs of casters: ground beside it that may throw a shadow on it, and whether anything at all does.

A plan is one for a level, a zoom and a sun. What it lists and a block provably does not need
(``skugga.terrain.casters.horizon_bound``) is left out for that block, and put on record there; the picture is the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from skugga.shadows.passes import CASTERS_PASS, GEOMETRY_PASS, PassLog
from skugga.shadows.plan import Plan, Step
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.casters.horizon_bound import idle_patches, own_ground_is_clear
from skugga.terrain.casters.reach import Casters, Receivers
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

NOTHING_OUTSIDE = "nothing outside of the block throws a shadow into it"
NOTHING_CASTS = "no ground throws a shadow in the block"


def caster_pass(plan: Plan) -> str:
    """The pass in which ground beside a part of a map is looked for: one that the plan has."""
    return CASTERS_PASS if CASTERS_PASS in plan.runs else GEOMETRY_PASS


def casters_beside(scene: Scene, plan: Plan, receivers: Receivers, found: Callable[[], Casters], log: PassLog) -> Casters:
    """The ground beside a part of a map that is ``found`` to be in the sun's way, with what of it is idle."""
    name = caster_pass(plan)
    with log.run(name) as record:
        casters = found()
        if all(_goes_without_idle(step) for step in plan.steps_under(SUN) if "relief" in step.kinds):
            casters = Casters(casters.patches, casters.reach, idle_patches(scene, receivers, casters.patches))
        if name == CASTERS_PASS and not casters.casting:
            record.left_out, record.note = record.left_out + 1, NOTHING_OUTSIDE
    return casters


def needed_steps(scene: Scene, steps: Sequence[Step], receivers: Receivers, casters: Casters, log: PassLog) -> list[Step]:
    """Those of a light's steps that have to be run for a map's block. Left out, and put on record as such, is the ground's shadow
    under the sun where all ground is clear; but not where intermediate pictures are asked for.
    """
    idle = [step for step in steps if step.light == SUN and step.kinds == ("relief",) and _goes_without_idle(step)]
    if not idle or log.wanted or casters.casting or not scene.sun_is_up or not own_ground_is_clear(scene, receivers):
        return list(steps)
    for step in idle:
        log.leave_out(log.named(step.light, step.kinds, ALGORITHMS[step.algorithm].passes), NOTHING_CASTS)
    return [step for step in steps if step not in idle]


def _goes_without_idle(step: Step) -> bool:
    return ALGORITHMS[step.algorithm].idle_casters(step.settings)
