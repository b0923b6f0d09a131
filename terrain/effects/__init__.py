"""Effects: one file each, with the predicate that says whether a scene calls for it, and why (or why not), and its part.

``terrain.level.level.EffectName`` lists them, in the order in which those of one stage run; the file has the effect's name.

May import: casters, facts, gbuffer, geo, ground, level, lights, population, scene, shading.
"""

from __future__ import annotations

from importlib import import_module
from typing import get_args

from terrain.effects.effect import Effect
from terrain.level.level import EffectName

EFFECTS: dict[EffectName, Effect] = {
    name: import_module(f"terrain.effects.{name}").EFFECT for name in get_args(EffectName)
}  # fmt: skip
"""All effects by name."""
