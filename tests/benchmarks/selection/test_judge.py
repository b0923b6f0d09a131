"""Losses, regret and closed gaps of views made by hand, then properties that hold for any views."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.selection.judge import (
    GOALS,
    PAR_FACTOR,
    WORST_COUNT,
    Goal,
    GoalInstance,
    equivalent_row,
    instances_of,
    marginal_values,
    score_choices,
    single_best,
)
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE

Figures = dict[str, Any]

THREE_PERCENT = Goal("3 %", 0.03)


def row(ms: float, error: float, interior: float = 0.0, algorithms: str = "shadow_map") -> Figures:
    """Return a measured plan. ``error`` and ``interior`` are shares in [0, 1]. ``algorithms`` are joined by "+"."""
    return {"ms": ms, "wrong_cast": error, "interior": interior, "algorithms": algorithms.split("+")}


def view_record(rows: Figures, choices: dict[str, str] | None = None, name: str = "view") -> Figures:
    """Return a view's record. Each row is the pick of the same name, unless ``choices`` maps names of picks to rows."""
    names = {row_name: row_name for row_name in rows} if choices is None else choices
    return {"name": name, "terrain": name, "error": "wrong_cast", "noise_floor": 0.0, "rows": rows, "picks": names}


def goal_instance(view: Figures, max_error: float, max_ms: float | None = None) -> GoalInstance:
    """Return a view with a goal: its largest error, and its limit of time in milliseconds."""
    return GoalInstance(view, Goal(f"{max_error:g}", max_error), max_ms)


VIEW_OF_MAP_SIZES = view_record(
    {"small": row(10.0, 0.05), "middle": row(20.0, 0.02), "large": row(40.0, 0.004), "leaky": row(5.0, 0.01, 0.004)}
)


@pytest.mark.parametrize(
    ("max_error", "max_ms", "losses"),
    [
        # "middle" and "large" meet the target in 20 and 40 ms. The others count as ten times 40 ms.
        (0.03, None, {"small": 20.0, "middle": 1.0, "large": 2.0, "leaky": 20.0}),
        # An error equal to the limit meets the target: 10, 20 and 40 ms.
        (0.05, None, {"small": 1.0, "middle": 2.0, "large": 4.0, "leaky": 40.0}),
        # Of the two in time, one is accurate enough. It is its own reference.
        (0.03, 20.0, {"small": 10.0, "middle": 1.0, "large": 10.0, "leaky": 10.0}),
        # None meets the target: errors are 50, 20, 4 and 10 times the limit. The interior error of "leaky" is 4 times its limit.
        (0.001, None, {"small": 12.5, "middle": 5.0, "large": 1.0, "leaky": 2.5}),
        # None meets the target in 15 ms: the error of "small" is 5/3 of the limit, the interior error of "leaky" 4 times. Late rows
        # count ten times the worst of these.
        (0.03, 15.0, {"small": 1.0, "middle": 24.0, "large": 24.0, "leaky": 2.4}),
        # None is in time for 2 ms: 5, 10 and 20 times the limit; "leaky" takes 2.5 times, but has 4 times the interior error.
        (0.03, 2.0, {"small": 1.25, "middle": 2.5, "large": 5.0, "leaky": 1.0}),
    ],
)
def test_losses_are_relative_times_or_penalties(max_error, max_ms, losses):
    assert goal_instance(VIEW_OF_MAP_SIZES, max_error, max_ms).losses() == pytest.approx(losses)


def test_errors_within_the_noise_of_truth_meet_any_target():
    noisy = VIEW_OF_MAP_SIZES | {"noise_floor": 0.007}  # three times the noise floor is an error of 2.1 %
    met = [name for name in VIEW_OF_MAP_SIZES["rows"] if goal_instance(noisy, 0.001).meets(name)]
    assert met == ["middle", "large"]
    assert not goal_instance(VIEW_OF_MAP_SIZES, 0.001).meets("large")
    assert goal_instance(noisy, 0.05).meets("small")  # a limit above the noise counts


def test_a_target_below_the_noise_of_truth_is_undecidable():
    noisy = VIEW_OF_MAP_SIZES | {"noise_floor": 0.007}
    assert [goal_instance(noisy, error).is_decidable for error in (0.02, 0.021, 0.022)] == [False, True, True]
    assert goal_instance(VIEW_OF_MAP_SIZES, 1e-9).is_decidable


def test_a_strict_miss_costs_ten_times_the_slowest_row():
    """The target is at most 3 % within 20 ms. Only "middle" meets it, in 20 ms. The slowest row takes 40 ms."""
    instance = goal_instance(VIEW_OF_MAP_SIZES, 0.03, 20.0)
    assert instance.losses(strict=True) == pytest.approx({"small": 20.0, "middle": 1.0, "large": 20.0, "leaky": 20.0})
    assert (
        goal_instance(VIEW_OF_MAP_SIZES, 0.001).losses(strict=True) == goal_instance(VIEW_OF_MAP_SIZES, 0.001).losses()
    )  # overshoots have no cutoff


def test_instances_need_two_rows_and_scale_their_time_limit():
    between = Goal("between", 1e-4, 0.25)
    spread = view_record({"quick": row(2.0, 0.1), "slow": row(512.0, 0.0)})  # 2 ** (1 + 0.25 * 8) = 8
    single_row_view = view_record({"quick": row(2.0, 0.1)})
    instances = instances_of([spread, single_row_view], [THREE_PERCENT, between])
    assert [(instance.view["name"], instance.goal, instance.max_ms) for instance in instances] == [
        ("view", THREE_PERCENT, None),
        ("view", between, 8.0),
    ]
    assert len(instances_of([spread])) == len(GOALS)


def test_selection_time_is_relative_to_the_best_accurate_row():
    assert goal_instance(VIEW_OF_MAP_SIZES, 0.03).share_of_best(5.0) == 0.25
    assert goal_instance(VIEW_OF_MAP_SIZES, 0.001).share_of_best(5.0) == 0.0


PICKS_OF_WOODED_VIEW = {
    "shadow_map 1024 x1": "one", "shadow_map 1024 x2": "two", "perspective_shadow_map 1024": "warped",
    "sweep+shadow_map 2048 x1": "swept", "shadow_volume 1024": "volumes",
}  # fmt: skip


@pytest.mark.parametrize(
    ("choice", "expected_row"),
    [
        ("shadow_map 1024 x2", "two"),
        ("shadow_map 1024", "one"),  # without cascades, as in a map view, there is one map
        ("shadow_map 1024 x4", "one"),  # more cascades than the depth range supports
        ("perspective_shadow_map 1024 x2", "warped"),
        ("sweep+perspective_shadow_map 1024", "warped"),  # no relief to sweep
        ("sweep+shadow_map 2048", "swept"),
        ("sweep+shadow_volume 1024", "volumes"),
        ("shadow_map+shadow_volume 1024", "volumes"),
        ("shadow_map+shadow_volume 4096", None),
        ("shadow_map 4096", None),
        ("planar", None),
    ],
)
def test_a_pick_resolves_to_the_equivalent_row_of_a_view(choice, expected_row):
    assert equivalent_row(choice, view_record({}, PICKS_OF_WOODED_VIEW)) == expected_row


def test_a_pick_resolves_to_a_row_without_settings():
    bare = view_record({}, {"shadow_volume": "volumes", "sweep+shadow_map": "swept"})
    assert equivalent_row("shadow_volume 2048", bare) == "volumes"
    assert equivalent_row("sweep+shadow_map 2048 x4", bare) == "swept"


def test_the_single_best_has_the_best_mean_and_is_no_rule():
    """In the two views, the losses are 2 and 2 for "steady", 1 and 10 * 20 / 10 = 20 for "first", 20 and 1 for "second". "rare" has
    a loss of 1.5 in the first view, and ten times 20 in the second, which lacks it.
    """
    first = {"steady": row(20.0, 0.0), "first": row(10.0, 0.0), "second": row(9.0, 0.5), "rare": row(15.0, 0.0)}
    second = {"steady": row(20.0, 0.0), "second": row(10.0, 0.0), "first": row(9.0, 0.5)}
    views = [view_record(rows, {name: name for name in rows} | {"rules 0.03": "first"}) for rows in (first, second)]
    assert single_best(instances_of(views, [THREE_PERCENT])) == "steady"
    assert single_best(instances_of(views[:1], [THREE_PERCENT])) == "first"
    assert single_best(instances_of(views[1:], [THREE_PERCENT])) == "second"
    view_with_rules = view_record(first, {"rules 0.03": "first", "steady": "steady"})
    assert single_best(instances_of([view_with_rules], [THREE_PERCENT])) == "steady"  # rules are no pick


def test_a_pick_that_a_view_lacks_counts_as_a_miss():
    """In the two views, the losses are 3 and 1 for "a". "rare" has 1 in the first view. In the second view, which lacks it, it has
    ten times 1.1, the loss of the worst row "b".
    """
    views = [
        view_record({"rare": row(10.0, 0.0), "a": row(30.0, 0.0), "b": row(40.0, 0.0)}),
        view_record({"a": row(10.0, 0.0), "b": row(11.0, 0.0)}),
    ]
    assert single_best(instances_of(views, [THREE_PERCENT])) == "a"
    assert (
        single_best(instances_of([*views[:1] * 9, views[1]], [THREE_PERCENT])) == "rare"
    )  # (9 * 1 + 11) / 10 against (9 * 3 + 1) / 10


QUICK_IS_RIGHT = view_record({"quick": row(10.0, 0.01), "slow": row(30.0, 0.001), "rough": row(5.0, 0.1)}, name="quick is right")
SLOW_IS_RIGHT = view_record({"quick": row(10.0, 0.1), "slow": row(20.0, 0.01), "rough": row(5.0, 0.2)}, name="slow is right")
NOTHING_IS_RIGHT = view_record({"quick": row(10.0, 0.4), "slow": row(20.0, 0.2), "rough": row(5.0, 0.8)}, name="nothing is right")


def choices_of(*names: str) -> dict[tuple[str, str], str]:
    """Return a policy's choices: the names of rows in the three views of this module, for the goal of 3 %."""
    return {
        (view["name"], THREE_PERCENT.name): name
        for view, name in zip((QUICK_IS_RIGHT, SLOW_IS_RIGHT, NOTHING_IS_RIGHT), names, strict=False)
    }


def test_scores_of_known_losses():
    """Losses of "quick", "slow" and "rough" are 1, 3 and 30 in the first view, and 10, 1 and 10 in the second. The single best,
    "slow", has a mean loss of 2. The choice of "rough" and then "slow" has a mean loss of 15.5.
    """
    instances = instances_of([QUICK_IS_RIGHT, SLOW_IS_RIGHT], [THREE_PERCENT])
    best = score_choices(instances, choices_of("quick", "slow"), choices_of("slow", "slow"))
    assert (best.instances, best.met, best.regret, best.single, best.single_met) == (2, 1.0, 0.0, 2.0, 1.0)
    assert best.gap_closed == pytest.approx(1.0)
    poor = score_choices(instances, choices_of("rough", "slow"), choices_of("slow", "slow"))
    assert (poor.met, poor.regret, poor.regret_median) == pytest.approx((0.5, 14.5, 14.5))
    assert poor.regret_p95 == pytest.approx(0.95 * 29.0)
    assert poor.regret_met == 0.0
    # The bootstrap draws twice from two terrains: the first twice, the second twice, or one of each.
    assert poor.regret_interval == pytest.approx((0.0, 29.0)) and poor.met_interval == (0.0, 1.0)
    assert best.regret_interval == (0.0, 0.0)
    assert poor.gap_closed == pytest.approx((2.0 - 15.5) / (2.0 - 1.0))
    assert poor.worst == [("quick is right", "3 %", "rough", 29.0), ("slow is right", "3 %", "slow", 0.0)]


def test_unreachable_targets_are_no_misses_but_have_losses():
    """No row of the third view meets the target. Its least error is 20 %, so errors of 40 % and 80 % are losses of 2 and 4."""
    every = instances_of([QUICK_IS_RIGHT, SLOW_IS_RIGHT, NOTHING_IS_RIGHT], [THREE_PERCENT])
    score = score_choices(every, choices_of("quick", "quick", "rough"), choices_of("slow", "slow", "slow"))
    assert (score.met, score.single_met) == (0.5, 1.0)
    assert score.regret == pytest.approx((0.0 + 9.0 + 3.0) / 3.0)
    assert (score.regret_met, score.single) == pytest.approx((0.0, 5.0 / 3.0))


def test_the_time_of_the_selection_counts_as_regret():
    """5 ms are half of the best time of the first view, and a quarter of that of the second."""
    score = score_choices(
        instances_of([QUICK_IS_RIGHT, SLOW_IS_RIGHT], [THREE_PERCENT]), choices_of("quick", "slow"), choices_of("slow", "slow"),
        own_ms=lambda instance: 5.0
    )  # fmt: skip
    assert score.regret == pytest.approx(0.375) and score.gap_closed == pytest.approx(0.625) and score.single == 2.0


def test_interior_errors_count_if_a_clean_row_meets_the_target():
    leaky = row(1.0, 0.0, 2.0 * MAX_INTERIOR_SHARE)
    view_with_goal, view_without_goal = (
        view | {"rows": view["rows"] | {"leaky": leaky}} for view in (QUICK_IS_RIGHT, NOTHING_IS_RIGHT)
    )
    every = instances_of([view_with_goal, SLOW_IS_RIGHT, view_without_goal], [THREE_PERCENT])
    best = choices_of("quick", "slow", "slow")
    assert score_choices(every, choices_of("leaky", "slow", "slow"), best).needless_interior_error_share == pytest.approx(1.0 / 3.0)
    assert (
        score_choices(every, choices_of("quick", "slow", "leaky"), best).needless_interior_error_share == 0.0
    )  # no other row meets the target


@pytest.mark.parametrize(("slow_ms", "expected_gap"), [(11.8, None), (12.4, 1.0)])
def test_a_gap_below_a_tenth_is_not_reported(slow_ms, expected_gap):
    """The losses of the single best are 1.18 or 1.24 in one view and 1 in the other: in the mean 9 % or 12 % above the best."""
    near = QUICK_IS_RIGHT | {"rows": QUICK_IS_RIGHT["rows"] | {"slow": row(slow_ms, 0.001)}}
    score = score_choices(
        instances_of([near, SLOW_IS_RIGHT], [THREE_PERCENT]), choices_of("quick", "slow"), choices_of("slow", "slow")
    )
    assert score.gap_closed == (expected_gap if expected_gap is None else pytest.approx(expected_gap))


def test_the_list_of_the_worst_is_short_and_sorted():
    views = [QUICK_IS_RIGHT | {"name": f"view {k}"} for k in range(WORST_COUNT + 3)]
    rough = {("view 3", "3 %"), ("view 5", "3 %")}
    names = {(view["name"], "3 %"): "rough" if (view["name"], "3 %") in rough else "slow" for view in views}
    worst = score_choices(instances_of(views, [THREE_PERCENT]), names, names).worst
    assert len(worst) == WORST_COUNT
    assert {entry[:2] for entry in worst[:2]} == rough and [entry[2:] for entry in worst[2:]] == [("slow", 2.0)] * (WORST_COUNT - 2)


def test_marginal_value_is_the_loss_without_an_algorithm():
    """Without sweeps the best of the first view takes twice as long. Without maps the best of the second takes half as long
    again.
    """
    swept = view_record({"a": row(10.0, 0.0, algorithms="sweep"), "b": row(20.0, 0.0, algorithms="shadow_map")})
    mapped = view_record({"b": row(10.0, 0.0, algorithms="shadow_map"), "c": row(15.0, 0.0, algorithms="shadow_volume")})
    values = marginal_values(instances_of([swept, mapped], [THREE_PERCENT]), ["sweep", "shadow_map", "shadow_volume", "planar"])
    assert values["sweep"] == pytest.approx((0.5, 0.5))
    assert values["shadow_map"] == pytest.approx((0.25, 0.5))
    assert values["shadow_volume"] == values["planar"] == (0.0, 0.0)
    # If every row needs the algorithm, its target is missed: ten times the worst row, which takes twice the time of the best.
    two_sweeps = view_record({"a": row(10.0, 0.0, algorithms="sweep+hybrid"), "b": row(20.0, 0.0, algorithms="sweep")})
    assert marginal_values(instances_of([two_sweeps], [THREE_PERCENT]), ["sweep", "hybrid"]) == {
        "sweep": (19.0, 1.0),
        "hybrid": (1.0, 1.0),
    }


measured_rows = st.builds(row, st.floats(0.1, 1e4), st.floats(0.0, 1.0), st.just(0.0) | st.floats(0.0, 0.01))
views = st.lists(measured_rows, min_size=2, max_size=6).map(
    lambda rows: view_record({f"row {k}": its for k, its in enumerate(rows)})
)
goals = st.sampled_from(GOALS)


def best_of(instance: GoalInstance) -> str:
    """Return the name of the row with the least loss."""
    losses = instance.losses()
    return min(losses, key=losses.__getitem__)


@given(views, goals)
def test_the_virtual_best_has_a_loss_of_one(view, goal):
    (instance,) = instances_of([view], [goal])
    losses = instance.losses()
    assert min(losses.values()) == 1.0
    met = [name for name in view["rows"] if instance.meets(name)]
    assert not met or best_of(instance) in met
    # Every miss costs far more than every row that meets the target.
    assert all(
        losses[name] >= PAR_FACTOR * max(losses[row_name] for row_name in met) * (1 - 1e-9)
        for name in losses
        if met and name not in met
    )


@given(st.lists(views, min_size=1, max_size=4), goals, st.data())
def test_the_virtual_best_closes_the_gap_and_the_single_none(several, goal, data):
    several = [view | {"name": f"view {k}"} for k, view in enumerate(several)]
    instances = instances_of(several, [goal])
    able = [instance for instance in instances if any(map(instance.meets, instance.rows))]
    single = {(instance.view["name"], goal.name): data.draw(st.sampled_from(sorted(instance.rows))) for instance in instances}
    assume(able and any(instance.meets(single[instance.view["name"], goal.name]) for instance in able))
    best = {(instance.view["name"], goal.name): best_of(instance) for instance in instances}
    score = score_choices(instances, best, single)
    assert (score.met, score.regret, score.regret_met) == (1.0, 0.0, 0.0)
    if score.single > 1.1001:
        assert score.gap_closed == pytest.approx(1.0)
        assert score_choices(instances, single, single).gap_closed == pytest.approx(0.0)
    elif score.single < 1.0999:
        assert score.gap_closed is None


@given(views, measured_rows, goals, st.none() | st.floats(0.1, 1e4))
def test_another_row_never_makes_the_best_slower(view, more, goal, max_ms):
    before = GoalInstance(view, goal, max_ms)
    assume(any(map(before.meets, before.rows)))
    after = GoalInstance(view | {"rows": view["rows"] | {"more": more}}, goal, max_ms)
    assert after.meets(best_of(after))
    assert after.rows[best_of(after)]["ms"] <= before.rows[best_of(before)]["ms"]
