"""Omission of effects, on both sides: an omitted effect would change nothing that shows, and one that runs changes what shows.

Each effect has a stated bound of what does not show. In every case the picture with the effect is compared with the picture without
it, both drawn by the plan's own algorithms. The change keeps to the bound if, and only if, the scene does not call for the effect.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import get_args

import pytest

from skugga.terrain.effects import EFFECTS
from skugga.terrain.effects.effect import Verdict
from skugga.terrain.effects.haze import MAX_CHANGED_PIXEL_SHARE, MAX_NEAR_STEPS
from skugga.terrain.level.level import EffectName
from tests.effects.edges import CASES, EffectChange, EffectComparison, tapped_edges


@dataclass(frozen=True)
class Bound:
    """What does not show of an effect: a change of pixels by at most one step of 255, and what else is stated.

    Attributes
    ----------
    max_steps
        Largest change of a pixel, in steps of 255.
    max_changed_share
        Largest share of pixels that change by more than one step.
    is_of_neighbourhood
        Whether a pixel is compared with the range of the other picture's pixel and its eight neighbours: an edge that moves by less
        than a pixel does not show.
    """

    max_steps: float = 1.0
    max_changed_share: float = 1.0
    is_of_neighbourhood: bool = False

    def allows(self, change: EffectChange, known_steps: float = 0.0, known_share: float = 0.0) -> bool:
        """Return whether a change does not show. ``known_steps`` and ``known_share`` are larger ones, known and explained."""
        steps = change.max_neighbourhood_excess if self.is_of_neighbourhood else change.max_difference
        has_few_steps = steps <= max(self.max_steps, known_steps)
        return has_few_steps and change.changed_share <= max(self.max_changed_share, known_share)


BOUNDS: dict[EffectName, Bound] = {
    **dict.fromkeys(get_args(EffectName), Bound()),
    "refraction": Bound(is_of_neighbourhood=True, max_changed_share=0.002),
    "soft_edges": Bound(is_of_neighbourhood=True),
    "haze": Bound(MAX_NEAR_STEPS, MAX_CHANGED_PIXEL_SHARE),
}
"""Effect -> the bound of what does not show of it."""

KNOWN_DIFFERENCES = {"hills perspective 08:30": 2.0}
"""Case -> a larger change where its effect is left out: the shadow of a single facet vanishes where light grazes a slope."""

KNOWN_SHARES = {"hills perspective 08:30": 0.0031}
"""Case -> a larger share where its effect is left out: smooth edges show that shadows move by a quarter of a pixel."""

UNNEEDED_RUNS: dict[EffectName, frozenset[str]] = {
    # Light on level ground changes less than on the steepest slope, and few edges move where a view is small or pixels are large.
    "refraction": frozenset({
        "clouds 07:30, 150.0 m", "clouds 09:30, 150.0 m",
        "post 06:15, 200.0 m", "post 06:15, 600.0 m", "post 07:00, 30.0 m", "post 07:00, 200.0 m",
        "post 07:00, 600.0 m",
    }),
    # The facet in shadow, the sun through thick clouds, or the end of a shadow is too faint or too small to show.
    "cast_shadows": frozenset({
        "slope turned away map 11.0", "clouds map 0.99", "post -20.0 m before",
    }),
    # The end of a tree's shadow lies just outside of the view.
    "alpha_test": frozenset({
        "looking 27.0 m north of a tree",
    }),
    # Penumbrae of 1 to 3 pixels stay within the range of a pixel's neighbours.
    "soft_edges": frozenset({
        "post 60.0 degrees, 3.0 m", "post 60.0 degrees, 4.0 m", "post 30.0 degrees, 12.0 m",
        "post 20.0 degrees, 12.0 m", "post 20.0 degrees, 20.0 m",
    }),
    # The steepest slope of the level casts a shadow that does not reach the window.
    "outside_casters": frozenset({
        "beside a hill 40.0",
    }),
    # The densest cloud that may be in view takes less light than the largest one of its size, or the sky in view has no cloud.
    "clouds": frozenset({
        "perspective 0.001", "window 200",
    }),
    # The sun shines on all ground, and the bound is that of ground in shadow.
    "sky_view": frozenset({
        "valley of 20 % map", "valley of 20 % perspective", "200.0 m of ground 640.0 m south",
        "50.0 m of ground 800.0 m south", "200.0 m of ground 800.0 m south", "200.0 m of ground 1000.0 m south",
    }),
    # A style asks for its sky by name. Ground in sunlight hardly shows it.
    "sky_light": frozenset({
        "clear sky on plain", "overcast sky on plain", "overcast sky on slope", "overcast sky on valley20",
    }),
    # The bound is that of a pit whose sides are as steep as the steepest slope, in shadow.
    "texture_shading": frozenset({
        "valley of 0.2 %, overcast", "valley of 0.4 %", "valley of 0.4 %, overcast", "valley of 0.7 %",
        "valley of 1 %", "valley of 2 %", "plain", "shallow valley, sun at -20.0",
    }),
    # The bound is that of white walls in the dark.
    "lamps": frozenset({
        "omni 0.001 at 30.0 m by night", "omni 0.01 at 30.0 m by day", "omni 0.1 at 100.0 m by day",
        "omni 1.0 at 100.0 m by day", "omni 1.0 at 250.0 m by day", "omni 1.0 at 250.0 m by night", "window 800.0",
    }),
    # The pond lies outside of the window, or is lost in the averages of pixels.
    "water": frozenset({
        "ponds at -60.0 of 8 pixels", "ponds at -60.0, 1150.0 m east",
    }),
    # The bound is that of white ground, and of samples between those of the coarse view that look down more steeply.
    "ground_detail": frozenset({"skyline 260.0", "skyline 270.0"}),
    # The bound is that of a black line on white ground, seen from above, and a road may lie just outside of the window.
    "roads": frozenset({
        "road of 1.1 m", "river of 1.1 m", "road of 1.2 m", "river of 1.2 m", "road of 1.5 m", "road of 3.0 m in perspective",
        "road of 0.9 m from above", "road of 1.1 m from above", "window 700.0 m south",
    }),
    # The bound is that of unfiltered texels in the brightest light.
    "textures": frozenset({
        "squares of a texel from 18.0 m", "grey by 1", "grey by 1 by night", "grey by 2 by night", "grey by 4 by night",
    }),
    # The bound is that of a white surface that the brightest light grazes.
    "normal_maps": frozenset({
        "stripes of 0.3 from 18.0 m", "tilt of 0.1, sun at -30.0", "tilt of 0.1, sun at 10.0", "tilt of 0.3, sun at -30.0",
    }),
    # The bound is that of a white window in a black wall that faces the eye, and a house may lie just outside of the view.
    "facades": frozenset({
        "auto roof, 120.0 m away", "auto roof, 145.0 m away", "auto roof, 170.0 m away", "flat roof, 145.0 m away",
        "flat roof, 170.0 m away", "looking 40.0 m beside",
    }),
    # The bounds are those of black and of white: natural ground and surfaces in the light of lamps may have any colour.
    "haze": frozenset({
        "lamp at 120.0 m", "lamp at 180.0 m",
        "hills 1.5e+06 m", "hills 2e+06 m", "hills 3e+06 m", "hills 5e+06 m", "hills 1e+07 m",
    }),
}  # fmt: skip
"""Effect -> cases in which it runs although its change does not show. Predicates are bounds: they never leave out what shows."""


@pytest.fixture(scope="module")
def effect_comparison(tmp_path_factory: pytest.TempPathFactory) -> EffectComparison:
    return EffectComparison(Path(tmp_path_factory.mktemp("effects")))


def find_errors(effect: EffectName, changes: list[EffectChange]) -> list[str]:
    """Return the cases in which the decision on an effect is wrong, as text: left out but visible, or run in vain."""
    unneeded = UNNEEDED_RUNS.get(effect, frozenset())
    errors = []
    for change in changes:
        is_invisible = BOUNDS[effect].allows(change, KNOWN_DIFFERENCES.get(change.case, 0.0), KNOWN_SHARES.get(change.case, 0.0))
        if not change.is_called_for and not is_invisible:
            errors.append(f"left out, but shows: {change}")
        if change.is_called_for and BOUNDS[effect].allows(change) and change.case not in unneeded:
            errors.append(f"runs, but does not show: {change}")
        if change.case in unneeded and not (change.is_called_for and BOUNDS[effect].allows(change)):
            errors.append(f"no unneeded run any more: {change}")
    return errors


def changes_of(effect: EffectName, comparison: EffectComparison, step: int = 1) -> list[EffectChange]:
    return [comparison.change_by(effect, case) for case in list(CASES[effect]())[::step]]


def test_every_effect_has_cases_and_a_bound():
    assert set(CASES) == set(BOUNDS) == set(get_args(EffectName))


@pytest.mark.parametrize("effect", CASES)
def test_effects_are_right_on_both_sides_of_the_edge(gl, effect_comparison: EffectComparison, effect: EffectName):
    """This test draws every fourth case. The long profile draws all cases."""
    errors = find_errors(effect, changes_of(effect, effect_comparison, 4))
    assert not errors, "\n".join(errors)


@pytest.mark.long
@pytest.mark.parametrize("effect", CASES)
def test_effects_run_where_they_show_and_only_there(gl, effect_comparison: EffectComparison, effect: EffectName):
    changes = changes_of(effect, effect_comparison)
    print("\n".join(map(str, changes)))
    errors = find_errors(effect, changes)
    assert not errors, "\n".join(errors)
    needed, left_out = ([change for change in changes if change.is_called_for is called_for] for called_for in (True, False))
    unneeded = UNNEEDED_RUNS.get(effect, frozenset())
    assert left_out and 2 * len(unneeded) <= len(needed), "too few cases lie on one side of the threshold"
    assert 2 * sum(change.ran_when_forced for change in left_out) >= len(left_out), "the forced effect does not run"


@pytest.mark.long
@pytest.mark.parametrize("always", [True, False], ids=["always", "never"])
@pytest.mark.parametrize("effect", CASES)
def test_proof_fails_for_a_constant_predicate(gl, effect_comparison: EffectComparison, effect: EffectName, always: bool):
    """A planted predicate that says yes, or no, to every scene is found out, for each effect."""
    changes = changes_of(effect, effect_comparison)
    planted = replace(EFFECTS[effect], judge=lambda descriptor: Verdict(always, "planted"), verdict_without_facts=None)
    planted_changes = [replace(change, is_called_for=planted.verdict(effect, change.descriptor).is_needed) for change in changes]
    errors = find_errors(effect, planted_changes)
    expected_text = "runs, but does not show" if always else "left out, but shows"
    assert any(error.startswith(expected_text) for error in errors)


@pytest.mark.long
def test_taps_on_narrow_penumbrae_soften_no_edge_by_a_pixel(gl, effect_comparison: EffectComparison):
    """A pixel on a hard edge has five samples, so its mean is off by up to a fifth, and by less where taps soften the edge."""
    changes = [effect_comparison.change_by("soft_edges", case) for case in tapped_edges()]
    assert not any(change.is_called_for for change in changes)
    assert [str(change) for change in changes if change.max_neighbourhood_excess > 8] == []
