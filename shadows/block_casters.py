"""Find the casters that a block of a map needs: the ground beside it that may shade it, and whether any ground casts at all.

All blocks of a level, a zoom and a sun share one plan. A block leaves out the casters and steps that it provably does not need
(``skugga.terrain.casters.caster_culling``), and records that. The picture stays the same to the bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from skugga.shadows.passes import CASTERS_PASS, GEOMETRY_PASS, PassLog
from skugga.shadows.plan import Plan, Step
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.casters.caster_culling import block_ground_casts_no_shadow, culled_patches
from skugga.terrain.casters.reach import Casters, Receivers
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

NOTHING_OUTSIDE = "nothing outside of the block throws a shadow into it"
NOTHING_CASTS = "no ground throws a shadow in the block"


def caster_pass(plan: Plan) -> str:
    """Return the name of the plan's pass in which casters beside a part of a map are searched."""
    return CASTERS_PASS if CASTERS_PASS in plan.effect_names else GEOMETRY_PASS


def find_outside_casters(
    scene: Scene, plan: Plan, receivers: Receivers, find_casters: Callable[[], Casters], log: PassLog
) -> Casters:
    """Return the ground beside a part of a map that may shade its ``receivers``, found by ``find_casters``, and record the pass.

    If no step needs casters without a shadow, patches of ground that provably shade no receiver are marked as culled.
    """
    name = caster_pass(plan)
    with log.record_pass(name) as record:
        casters = find_casters()
        if all(_ignores_idle_casters(step) for step in plan.steps_under(SUN) if "relief" in step.kinds):
            casters = Casters(casters.patches, casters.reach, culled_patches(scene, receivers, casters.patches))
        if name == CASTERS_PASS and not casters.casting:
            record.left_out, record.note = record.left_out + 1, NOTHING_OUTSIDE
    return casters


def needed_steps(scene: Scene, steps: Sequence[Step], receivers: Receivers, casters: Casters, log: PassLog) -> list[Step]:
    """Return the steps of a light that have to run for a map's block.

    The step for the ground's shadow under the sun is left out, and recorded as such, where provably no ground shades the block. It
    is never left out where intermediate pictures are requested.
    """
    idle = [step for step in steps if step.light == SUN and step.kinds == ("relief",) and _ignores_idle_casters(step)]
    if (
        not idle
        or log.requested_layers
        or casters.casting
        or not scene.sun_is_up
        or not block_ground_casts_no_shadow(scene, receivers)
    ):
        return list(steps)
    for step in idle:
        log.leave_out(log.pass_names(step.light, step.kinds, ALGORITHMS[step.algorithm].passes), NOTHING_CASTS)
    return [step for step in steps if step not in idle]


def _ignores_idle_casters(step: Step) -> bool:
    return ALGORITHMS[step.algorithm].ignores_idle_casters(step.settings)
