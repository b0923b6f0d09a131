"""Omission of effects: an omitted effect would change nothing if forced on, and one that runs changes the picture."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from skugga.terrain.level.level import EffectName
from tests.effects.edges import CASES, EDGE_MOVING_EFFECTS, EffectChange, EffectComparison

MAX_UNCHANGED_SHARE = 0.1
"""Maximum share of an effect's runs without any change."""

KNOWN_DIFFERENCES = {
    "hills map 08:30": 2, "hills perspective 08:30": 4, "post 80.0 degrees, 10.0 m": 8, "post 70.0 degrees, 10.0 m": 8,
    "post 60.0 degrees, 10.0 m": 8, "post 50.0 degrees, 10.0 m": 7, "post 40.0 degrees, 10.0 m": 7,
}  # fmt: skip
"""Measured difference in steps of 255 where an effect is left out. Refraction: where light grazes a slope, facets and nodes cast
shadows of their own size, and one that appears or vanishes changes more than a moved edge. Soft edges: a pixel on a hard edge
has five samples, so its mean is off by up to a fifth, and by less where a penumbra narrower than the pixel softens the edge.
"""


@pytest.fixture(scope="module")
def effect_comparison(tmp_path_factory: pytest.TempPathFactory) -> EffectComparison:
    """The comparison of pictures with and without effects."""
    return EffectComparison(Path(tmp_path_factory.mktemp("effects")))


def test_every_effect_has_cases():
    assert set(CASES) == set(get_args(EffectName))


@pytest.mark.long
@pytest.mark.parametrize("effect", CASES)
def test_omitted_effects_would_not_be_visible(gl, effect_comparison: EffectComparison, effect: str):
    changes = [effect_comparison.change_by(effect, case) for case in CASES[effect]()]
    print("\n".join(map(str, changes)))
    _check_changes(effect, changes)


@pytest.mark.parametrize("effect", CASES)
def test_effects_are_right_on_both_sides_of_the_edge(gl, effect_comparison: EffectComparison, effect: str):
    """This test draws every fourth case. The long profile draws all cases."""
    sampled_cases = list(CASES[effect]())[::4]
    changes = [effect_comparison.change_by(effect, case) for case in sampled_cases]
    assert not [
        str(change)
        for change in changes
        if not change.is_planned and _difference(effect, change) > KNOWN_DIFFERENCES.get(change.case, 1)
    ]


def _difference(effect: str, change: EffectChange) -> int:
    """Return how much an effect changes a picture, of 255. Effects that move edges may change pixels to a neighbour's value."""
    return change.max_neighbourhood_excess if effect in EDGE_MOVING_EFFECTS else change.max_difference


def _check_changes(effect: str, changes: list[EffectChange]) -> None:
    """Check that an effect is omitted only if it changes no picture, and runs seldom in vain."""
    runs, left_out = ([change for change in changes if change.is_planned is runs_effect] for runs_effect in (True, False))
    assert runs and left_out, "all cases lie on one side of the threshold"
    assert 2 * sum(change.ran_when_forced for change in left_out) >= len(left_out), "the forced effect does not run"
    visible_changes = [str(change) for change in left_out if _difference(effect, change) > KNOWN_DIFFERENCES.get(change.case, 1)]
    assert not visible_changes, "the effect is omitted although it changes the picture"
    idle_changes = [str(change) for change in runs if change.max_difference == 0]
    assert len(idle_changes) <= MAX_UNCHANGED_SHARE * len(runs), "the effect runs too often without a change"
