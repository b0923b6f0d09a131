"""Find the effects that ran in a frame from its record alone: the passes, and the shader programs that drew in them."""

from __future__ import annotations

from collections.abc import Iterable

from skugga.shadows.passes import PassRecord
from skugga.terrain.effects import EFFECTS
from skugga.terrain.level.level import SUN, EffectName

FOLIAGE_SHADER_PARTS = frozenset({"shadows/maps/depth_tree.frag", "shadows/planar_tree.frag"})
"""Shader parts that draw foliage as a caster."""

SUN_DISC_SHADER_PART = "shadows/maps/sun_disc.frag"
"""The shader part that draws the penumbra of the sun's disc."""


def executed_effects(passes: Iterable[PassRecord]) -> frozenset[EffectName]:
    """Return the effects whose code ran.

    - A pass that all parts of the picture left out did not run.
    - An effect with a pass of its own ran if that pass ran.
    - ``cast_shadows`` ran if a pass of an algorithm ran.
    - ``alpha_test`` ran if a pass served foliage (also without foliage between receivers and light), or if a program that samples
      the foliage texture drew depths.
    - ``soft_edges`` ran if the sun's maps were sampled by more than one tap, or if the visibility is the mean over points of its
      disc.

    ``truth``, which draws nothing, leaves no trace of ``soft_edges`` in the record.
    """
    ran: set[EffectName] = set()
    for record in passes:
        if record.is_left_out:
            continue
        if record.name in EFFECTS:
            ran.add(record.name)
        light, separator, kinds_and_pass = record.name.partition("/")
        if not separator:
            continue
        ran.add("cast_shadows")
        words = {word for label in (*record.programs, *record.loops) for word in label.split()}
        if words & FOLIAGE_SHADER_PARTS or "forest" in kinds_and_pass.partition(":")[0].split("+"):
            ran.add("alpha_test")
        taps = {word for word in words if word.startswith("taps=")}
        if light == SUN and (taps - {"taps=1"} or SUN_DISC_SHADER_PART in words or record.light_points > 1):
            ran.add("soft_edges")
    return frozenset(ran)
