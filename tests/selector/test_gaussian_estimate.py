"""Gaussian estimate: posterior of related candidates after an observation, with hand-derived values and general properties."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.gaussian_estimate import LOGISTIC_SD, GaussianEstimate, SharedVariance

SHARED_VARIANCE = SharedVariance(view=0.5, family=0.25)


def prior(shared: SharedVariance = SHARED_VARIANCE, scale: float = 1.0 / LOGISTIC_SD) -> GaussianEstimate:
    """Return three candidates of variance 1: two of a family, one of another."""
    return GaussianEstimate.prior([0.0, 0.0, 0.0], [scale] * 3, ["maps", "maps", "volumes"], shared)


def test_prior_covariance_is_the_shared_variance():
    assert prior().covariance == pytest.approx(np.array([[1.0, 0.75, 0.5], [0.75, 1.0, 0.5], [0.5, 0.5, 1.0]]))


def test_observation_moves_itself_then_family_then_view():
    posterior = prior().after_observation(0, 2.0, 0.0)
    assert posterior.mean == pytest.approx([2.0, 1.5, 1.0])
    assert np.diagonal(posterior.covariance) == pytest.approx([0.0, 1.0 - 0.75**2, 0.75])


def test_observation_with_noise_equal_to_the_prior_counts_half():
    posterior = prior().after_observation(0, 2.0, 1.0)
    assert posterior.mean == pytest.approx([1.0, 0.75, 0.5]) and posterior.covariance[0, 0] == pytest.approx(0.5)


def test_outlier_moves_others_by_three_deviations_at_most():
    outlier_posterior, limited_posterior = prior().after_observation(0, 100.0, 0.0), prior().after_observation(0, 3.0, 0.0)
    assert outlier_posterior.mean == pytest.approx([100.0, *limited_posterior.mean[1:]])


def test_observation_without_shared_variance_moves_only_itself():
    posterior = prior(SharedVariance(view=0.0, family=0.0)).after_observation(1, 3.0, 0.0)
    assert posterior.mean == pytest.approx([0.0, 3.0, 0.0])


def test_probability_over_follows_the_logistic_distribution():
    estimate = GaussianEstimate.prior([np.log(0.02)], [0.4], ["maps"], SHARED_VARIANCE)
    assert estimate.probability_over(0, np.log(0.02)) == pytest.approx(0.5)
    assert estimate.probability_over(0, np.log(0.02) + 0.4 * np.log(3.0)) == pytest.approx(0.25)
    posterior = estimate.after_observation(0, np.log(0.05), 0.0)
    assert (posterior.probability_over(0, np.log(0.04)), posterior.probability_over(0, np.log(0.06))) == (1.0, 0.0)


observation_lists = st.lists(st.tuples(st.integers(0, 2), st.floats(-5, 5), st.floats(0.01, 2)), max_size=6)


@given(observation_lists)
def test_variance_falls_with_observations_in_any_order(observations):
    forwards, backwards, variances = prior(), prior(), [np.diagonal(prior().covariance)]
    for index, value, noise in observations:
        forwards = forwards.after_observation(index, value, noise)
        variances.append(np.diagonal(forwards.covariance))
    for index, value, noise in reversed(observations):
        backwards = backwards.after_observation(index, value, noise)
    assert all((later <= earlier + 1e-9).all() for earlier, later in zip(variances, variances[1:], strict=False))
    assert forwards.covariance == pytest.approx(backwards.covariance, abs=1e-6)
