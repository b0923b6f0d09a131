"""Rendering effects, such as haze, snow and clouds.

Each effect is a module with its name. It has a predicate that decides whether a scene needs the effect, and a function that renders
it. ``skugga.terrain.level.level.EffectName`` lists the effects in the order in which they run within a stage (the array that they
change).
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
"""Effects without a rendering function of their own: each switches a behaviour of other code, named here with its source file.

A plan lists them, and a level or a request can turn them on or off, like all other effects.
"""
