"""Gaussian estimate: posterior of related candidates after an observation, with hand-derived values and general properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.gaussian_estimate import LOGISTIC_SD, GaussianEstimate, SharedVariance

HALF = SharedVariance(view=0.5, family=0.25)


def prior(shared: SharedVariance = HALF, scale: float = 1.0 / LOGISTIC_SD) -> GaussianEstimate:
    """Return three candidates of variance 1: two of a family, one of another."""
    return GaussianEstimate.prior([0.0, 0.0, 0.0], [scale] * 3, ["maps", "maps", "volumes"], shared)


def test_prior_covariance_is_the_shared_variance():
    assert prior().covariance == pytest.approx(np.array([[1.0, 0.75, 0.5], [0.75, 1.0, 0.5], [0.5, 0.5, 1.0]]))


def test_observation_moves_itself_then_family_then_view():
    seen = prior().after_observation(0, 2.0, 0.0)
    assert seen.mean == pytest.approx([2.0, 1.5, 1.0])
    assert np.diagonal(seen.covariance) == pytest.approx([0.0, 1.0 - 0.75**2, 0.75])


def test_observation_with_noise_equal_to_the_prior_counts_half():
    seen = prior().after_observation(0, 2.0, 1.0)
    assert seen.mean == pytest.approx([1.0, 0.75, 0.5]) and seen.covariance[0, 0] == pytest.approx(0.5)


def test_outlier_moves_others_by_three_deviations_at_most():
    wild, three = prior().after_observation(0, 100.0, 0.0), prior().after_observation(0, 3.0, 0.0)
    assert wild.mean == pytest.approx([100.0, *three.mean[1:]])


def test_observation_without_shared_variance_moves_only_itself():
    seen = prior(SharedVariance(view=0.0, family=0.0)).after_observation(1, 3.0, 0.0)
    assert seen.mean == pytest.approx([0.0, 3.0, 0.0])


def test_probability_over_follows_the_logistic_distribution():
    belief = GaussianEstimate.prior([np.log(0.02)], [0.4], ["maps"], HALF)
    assert belief.probability_over(0, np.log(0.02)) == pytest.approx(0.5)
    assert belief.probability_over(0, np.log(0.02) + 0.4 * np.log(3.0)) == pytest.approx(0.25)
    known = belief.after_observation(0, np.log(0.05), 0.0)
    assert (known.probability_over(0, np.log(0.04)), known.probability_over(0, np.log(0.06))) == (1.0, 0.0)


values = st.lists(st.tuples(st.integers(0, 2), st.floats(-5, 5), st.floats(0.01, 2)), max_size=6)


@given(values)
def test_variance_falls_with_observations_in_any_order(seen):
    forwards, backwards, spread = prior(), prior(), [np.diagonal(prior().covariance)]
    for which, value, noise in seen:
        forwards = forwards.after_observation(which, value, noise)
        spread.append(np.diagonal(forwards.covariance))
    for which, value, noise in reversed(seen):
        backwards = backwards.after_observation(which, value, noise)
    assert all((later <= earlier + 1e-9).all() for earlier, later in zip(spread, spread[1:], strict=False))
    assert forwards.covariance == pytest.approx(backwards.covariance, abs=1e-6)
