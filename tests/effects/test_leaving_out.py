"""Omission of effects: an omitted effect would change nothing if forced on, and one that runs changes the picture."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from skugga.terrain.level.level import EffectName
from tests.effects.edges import CASES, MOVES_EDGES, Found, Lab

TIMID = 0.1
"""Maximum share of an effect's runs without any change."""

FALLS_SHORT = {
    "hills map 08:30": 2, "hills perspective 08:30": 4, "post 80.0 degrees, 10.0 m": 8, "post 70.0 degrees, 10.0 m": 8,
    "post 60.0 degrees, 10.0 m": 8, "post 50.0 degrees, 10.0 m": 7, "post 40.0 degrees, 10.0 m": 7,
}  # fmt: skip
"""Measured difference in steps of 255 where an effect is left out. Refraction: where light grazes a slope, facets and nodes cast
shadows of their own size, and one that appears or vanishes changes more than a moved edge. Soft edges: a pixel on a hard edge
has five samples, so its mean is off by up to a fifth, and by less where a penumbra narrower than the pixel softens the edge.
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(Path(tmp_path_factory.mktemp("effects")))


def test_every_effect_has_cases():
    assert set(CASES) == set(get_args(EffectName))


@pytest.mark.long
@pytest.mark.parametrize("effect", CASES)
def test_omitted_effects_would_not_be_visible(gl, lab: Lab, effect: str):
    found = [lab.found(effect, case) for case in CASES[effect]()]
    print("\n".join(map(str, found)))
    _check(effect, found)


@pytest.mark.parametrize("effect", CASES)
def test_effects_are_right_on_both_sides_of_the_edge(gl, lab: Lab, effect: str):
    """The test takes every fourth case. The long profile has them all."""
    some = list(CASES[effect]())[::4]
    found = [lab.found(effect, case) for case in some]
    assert not [str(one) for one in found if not one.runs and _difference(effect, one) > FALLS_SHORT.get(one.case, 1)]


def _difference(effect: str, found: Found) -> int:
    return found.steps_beside if effect in MOVES_EDGES else found.steps


def _check(effect: str, found: list[Found]) -> None:
    runs, left_out = ([one for one in found if one.runs is which] for which in (True, False))
    assert runs and left_out, "cases on both sides of the edge"
    assert 2 * sum(one.ran for one in left_out) >= len(left_out), "forced on, it runs"
    missed = [str(one) for one in left_out if _difference(effect, one) > FALLS_SHORT.get(one.case, 1)]
    assert not missed, "left out, and missed"
    idle = [str(one) for one in runs if one.steps == 0]
    assert len(idle) <= TIMID * len(runs), "run for nothing"
