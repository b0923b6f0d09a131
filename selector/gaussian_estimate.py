"""Estimate errors or times of candidates from predictions and measurements: Gaussian process regression on logarithms.

A candidate is a choice of algorithms and settings for a view. The difference between the logarithms of its real and its predicted
value has three parts. One is common to all candidates of the view. One is common to a family, the candidates with the same
algorithms. One belongs to the candidate alone. So a measurement of one candidate also corrects the predictions of the others, most
of all those of its family. The prior is multivariate normal, and each observation updates it (C. Rasmussen and C. Williams,
Gaussian Processes for Machine Learning, 2006, equations 2.25 and 2.26).

Probabilities come from the logistic distribution with the same mean and standard deviation. Its tails are longer: large model
errors are more frequent than under a normal distribution.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, pi, sqrt

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

LOGISTIC_SD = pi / sqrt(3.0)
"""Standard deviation of a logistic distribution with scale 1."""

MAX_RESIDUAL_SD = 3.0
"""Maximum residual, in standard deviations, with which an observation updates other candidates.

A larger residual is clipped, because it points to an error in the model of the observed candidate alone.
"""

MAX_EXPONENT = 50.0
"""Limit of the argument of ``exp``. Beyond it a probability is 0 or 1."""


class SharedVariance(BaseModel):
    """Shares of the variance of a value that candidates have in common.

    ``view`` is common to all candidates of a view. ``family`` is in addition common to the candidates with the same algorithms.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    view: float = Field(ge=0, le=1)
    family: float = Field(ge=0, le=1)

    @property
    def individual(self) -> float:
        """The share of the variance that belongs to each candidate alone."""
        return max(1.0 - self.view - self.family, 0.0)


@dataclass(frozen=True, eq=False)
class GaussianEstimate:
    """Joint normal distribution of the logarithms of a value (an error or a time) of n candidates.

    Attributes
    ----------
    mean
        Means of the natural logarithms, (n,).
    covariance
        Their covariance matrix, (n, n).
    """

    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def prior(
        cls, expected_log: Sequence[float], scales: Sequence[float], families: Sequence[object], shared: SharedVariance
    ) -> GaussianEstimate:
        """Return the prior distribution, before any candidate was measured.

        ``expected_log`` holds the expected logarithms of the n candidates, and ``scales`` the scales of their logistic
        distributions. Candidates with equal ``families`` belong to one family. ``shared`` are the shares of the variance that
        candidates have in common.
        """
        count = len(families)
        same_family = np.array(
            [[row_family == column_family for column_family in families] for row_family in families], np.float64
        ).reshape(count, count)
        sd = LOGISTIC_SD * np.array(scales, np.float64)
        correlation = shared.view + shared.family * same_family + shared.individual * np.eye(len(families))
        return cls(np.array(expected_log, np.float64), correlation * np.outer(sd, sd))

    def after_observation(self, candidate_index: int, value_log: float, noise: float) -> GaussianEstimate:
        """Return the posterior after an observation of the candidate with index ``candidate_index``.

        ``value_log`` is the logarithm of the observed value, and ``noise`` its standard deviation.
        """
        column = self.covariance[:, candidate_index]
        total = column[candidate_index] + noise**2
        if total <= 0.0:
            return self
        gain, residual = column / total, value_log - self.mean[candidate_index]
        clipped_residual = float(np.clip(residual, -MAX_RESIDUAL_SD * np.sqrt(total), MAX_RESIDUAL_SD * np.sqrt(total)))
        mean = self.mean + gain * clipped_residual
        mean[candidate_index] = self.mean[candidate_index] + gain[candidate_index] * residual
        return GaussianEstimate(mean, self.covariance - np.outer(gain, column))

    def scale(self, candidate_index: int) -> float:
        """Return the scale of the logistic distribution of the logarithm of candidate ``candidate_index``."""
        return float(np.sqrt(max(self.covariance[candidate_index, candidate_index], 0.0))) / LOGISTIC_SD

    def probability_over(self, candidate_index: int, limit_log: float) -> float:
        """Return the probability, in [0, 1], that the logarithm of candidate ``candidate_index`` exceeds ``limit_log``."""
        return logistic_probability_over(float(self.mean[candidate_index]) - limit_log, self.scale(candidate_index))


def logistic_probability_over(excess: float, scale: float) -> float:
    """Return the probability, in [0, 1], that a logistic variable exceeds a limit.

    ``excess`` is its mean less the limit, and ``scale`` its scale. With a scale of 0 the result is 0 or 1.
    """
    if scale <= 0.0:
        return float(excess > 0.0)
    return 1.0 / (1.0 + exp(-max(min(excess / scale, MAX_EXPONENT), -MAX_EXPONENT)))
