"""Effects: one file each, with the predicate that says whether a scene calls for it, and why (or why not), and its part.

``skugga.terrain.level.level.EffectName`` lists them, in the order in which those of one stage run; the file has the effect's name.
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
    "refraction": "the sun of a frame stands where it is seen, not where it is (shadows/visibility.py)",
    "cast_shadows": "algorithms fill the lights' visibility at all (selector/planner/planner.py)",
    "alpha_test": "forest is among the kinds of casters that algorithms are given (selector/planner/planner.py)",
    "soft_edges": "a filter that is left open takes three taps a side, not one (selector/planner/planner.py)",
    "outside_casters": "ground beyond a map's block is looked for and casts into it (shadows/passes.py)",
}
"""Effects without a part of their own: switches of the pipeline, each with what it switches, and where. They are planned, forced
and told like all others; what they do is done by the code that is named here.
"""
