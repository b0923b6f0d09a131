"""Effects: one module each, with the predicate that decides whether a scene needs the effect, and the function that renders it.

``skugga.terrain.level.level.EffectName`` lists the effects in the order in which those of one stage run. Each module is named after
its effect.
"""

from __future__ import annotations

from importlib import import_module
from typing import get_args

from skugga.terrain.effects.effect import Effect
from skugga.terrain.level.level import EffectName

EFFECTS: dict[EffectName, Effect] = {
    name: import_module(f"skugga.terrain.effects.{name}").EFFECT for name in get_args(EffectName)
}  # fmt: skip
"""All effects by name."""

SWITCHES: dict[EffectName, str] = {
    "refraction": "the sun of a frame is at its apparent position, not at its true position (shadows/visibility.py)",
    "cast_shadows": "algorithms compute the visibility of the lights (selector/planner/planner.py)",
    "alpha_test": "forest is one of the kinds of casters that algorithms draw (selector/planner/planner.py)",
    "soft_edges": "an unset filter takes three taps per side instead of one (selector/planner/planner.py)",
    "outside_casters": "ground beyond a map's block casts shadows into it (shadows/passes.py)",
}
"""Switches of the pipeline: effects without a rendering function, with the behaviour that each switches and its source file.

They are planned, forced and reported like all other effects.
"""
