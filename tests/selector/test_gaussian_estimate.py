"""What a trial of one candidate tells of others: known arithmetic, then what holds for all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.gaussian_estimate import LOGISTIC_SD, GaussianEstimate, SharedVariance

HALF = SharedVariance(view=0.5, family=0.25)


def prior(shared: SharedVariance = HALF, scale: float = 1.0 / LOGISTIC_SD) -> GaussianEstimate:
    """Three candidates of variance 1: two of a family, one of another."""
    return GaussianEstimate.prior([0.0, 0.0, 0.0], [scale] * 3, ["maps", "maps", "volumes"], shared)


def test_what_is_shared_is_the_covariance():
    assert prior().covariance == pytest.approx(np.array([[1.0, 0.75, 0.5], [0.75, 1.0, 0.5], [0.5, 0.5, 1.0]]))


def test_a_value_tells_most_of_its_own_then_of_the_family_then_of_the_view():
    seen = prior().after_observation(0, 2.0, 0.0)
    assert seen.mean == pytest.approx([2.0, 1.5, 1.0])
    assert np.diagonal(seen.covariance) == pytest.approx([0.0, 1.0 - 0.75**2, 0.75])


def test_a_value_with_as_much_noise_as_there_was_doubt_counts_half():
    seen = prior().after_observation(0, 2.0, 1.0)
    assert seen.mean == pytest.approx([1.0, 0.75, 0.5]) and seen.covariance[0, 0] == pytest.approx(0.5)


def test_what_is_off_beyond_all_measure_tells_others_no_more_than_three_deviations_do():
    wild, three = prior().after_observation(0, 100.0, 0.0), prior().after_observation(0, 3.0, 0.0)
    assert wild.mean == pytest.approx([100.0, *three.mean[1:]])


def test_where_nothing_is_shared_nothing_is_learnt_of_others():
    seen = prior(SharedVariance(view=0.0, family=0.0)).after_observation(1, 3.0, 0.0)
    assert seen.mean == pytest.approx([0.0, 3.0, 0.0])


def test_chances_are_those_of_a_logistic_distribution():
    belief = GaussianEstimate.prior([np.log(0.02)], [0.4], ["maps"], HALF)
    assert belief.probability_over(0, np.log(0.02)) == pytest.approx(0.5)
    assert belief.probability_over(0, np.log(0.02) + 0.4 * np.log(3.0)) == pytest.approx(0.25)
    known = belief.after_observation(0, np.log(0.05), 0.0)
    assert (known.probability_over(0, np.log(0.04)), known.probability_over(0, np.log(0.06))) == (1.0, 0.0)


values = st.lists(st.tuples(st.integers(0, 2), st.floats(-5, 5), st.floats(0.01, 2)), max_size=6)


@given(values)
def test_with_every_value_doubt_gets_less_whatever_the_order(seen):
    forwards, backwards, spread = prior(), prior(), [np.diagonal(prior().covariance)]
    for which, value, noise in seen:
        forwards = forwards.after_observation(which, value, noise)
        spread.append(np.diagonal(forwards.covariance))
    for which, value, noise in reversed(seen):
        backwards = backwards.after_observation(which, value, noise)
    assert all((later <= earlier + 1e-9).all() for earlier, later in zip(spread, spread[1:], strict=False))
    assert forwards.covariance == pytest.approx(backwards.covariance, abs=1e-6)
