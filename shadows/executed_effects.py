"""Which effects ran in a frame, told from its record alone: the passes, and the programs that were drawn with."""

from __future__ import annotations

from collections.abc import Iterable

from skugga.shadows.passes import PassRecord
from skugga.terrain.effects import EFFECTS
from skugga.terrain.level.level import SUN, EffectName

FOLIAGE_PARTS = frozenset({"shadows/maps/depth_tree.frag", "shadows/planar_tree.frag"})
"""Shader parts that draw foliage as a caster."""

DISC_PART = "shadows/maps/sun_disc.frag"
"""The shader part that draws the penumbra of the sun's disc."""


def executed_effects(passes: Iterable[PassRecord]) -> frozenset[EffectName]:
    """The effects whose code ran.

    A pass that all parts of the picture went without did not run. An effect with a pass of its own ran if that did. Shadows were
    cast if an algorithm's pass ran, foliage was tested if one took it on (also where none stood in the light's way) or a program
    that looks its texture up drew depths, and edges were soft if the sun's maps were looked up by more than one tap, or what is
    filled is the mean of many points of its disc. Algorithms that draw nothing (``sweep``, ``truth``) leave no trace of that.
    """
    ran: set[EffectName] = set()
    for record in passes:
        if record.did_nothing:
            continue
        if record.name in EFFECTS:
            ran.add(record.name)
        light, is_algorithm, work = record.name.partition("/")
        if not is_algorithm:
            continue
        ran.add("cast_shadows")
        words = {word for label in (*record.programs, *record.loops) for word in label.split()}
        if words & FOLIAGE_PARTS or "forest" in work.partition(":")[0].split("+"):
            ran.add("alpha_test")
        taps = {word for word in words if word.startswith("taps=")}
        if light == SUN and (taps - {"taps=1"} or DISC_PART in words or record.light_points > 1):
            ran.add("soft_edges")
    return frozenset(ran)
