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
from skugga.terrain.casters.caster_types import Casters, Receivers
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

NO_OUTSIDE_CASTERS_NOTE = "nothing outside of the block casts a shadow into it"
"""Note of the pass that searches casters beside a block, where it finds none."""

NO_CASTERS_NOTE = "no ground casts a shadow in the block"
"""Note of the passes of a step that a block leaves out, since no ground casts."""


def caster_search_pass(plan: Plan) -> str:
    """Return the name of the plan's pass in which casters beside a part of a map are searched."""
    return CASTERS_PASS if CASTERS_PASS in plan.effect_names else GEOMETRY_PASS


def find_outside_casters(
    scene: Scene, plan: Plan, receivers: Receivers, find_casters: Callable[[], Casters], log: PassLog
) -> Casters:
    """Return the ground beside a part of a map that may shade its ``receivers``, found by ``find_casters``, and record the pass.

    If no step needs casters without a shadow, patches of ground that provably shade no receiver are marked as culled.
    """
    name = caster_search_pass(plan)
    with log.record_pass(name) as record:
        casters = find_casters()
        if all(_allows_caster_culling(step) for step in plan.steps_of_light(SUN) if "relief" in step.kinds):
            casters = Casters(casters.patches, casters.reach, culled_patches(scene, receivers, casters.patches))
        if name == CASTERS_PASS and not casters.casting_patches:
            record.left_out, record.note = record.left_out + 1, NO_OUTSIDE_CASTERS_NOTE
    return casters


def needed_steps(scene: Scene, steps: Sequence[Step], receivers: Receivers, casters: Casters, log: PassLog) -> list[Step]:
    """Return the steps of a light that have to run for a map's block.

    The step for the ground's shadow under the sun is left out, and recorded as such, where provably no ground shades the block. It
    is never left out where intermediate pictures are requested. ``steps`` are all steps of the light, and ``receivers`` the block's
    points.
    """
    cullable = [step for step in steps if step.light == SUN and step.kinds == ("relief",) and _allows_caster_culling(step)]
    if (
        not cullable
        or log.requested_layers
        or casters.casting_patches
        or not scene.sun_is_up
        or not block_ground_casts_no_shadow(scene, receivers)
    ):
        return list(steps)
    for step in cullable:
        log.leave_out(log.pass_names(step.light, step.kinds, ALGORITHMS[step.algorithm].passes), NO_CASTERS_NOTE)
    return [step for step in steps if step not in cullable]


def _allows_caster_culling(step: Step) -> bool:
    """Return whether a step's algorithm gives the same result without ground that casts no shadow."""
    return ALGORITHMS[step.algorithm].allows_caster_culling(step.settings)
