"""What is believed of candidates' errors or times before and after some were tried: distributions of logarithms. Arithmetic.

How far a real value is off the expected one has three parts: one that all candidates of a view share, one that those of a family
of algorithms share, and one of a candidate's own. So a trial of one candidate tells of the others too: much of those of its
family, and something of all. That is a normal prior, updated by one observation after the other (C. Rasmussen and C. Williams,
Gaussian Processes for Machine Learning, 2006, equations 2.25 and 2.26). Chances are taken from the logistic distribution of the
same mean and standard deviation, whose tails are longer: models are more often far off than normal ones would be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, pi, sqrt

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

LOGISTIC_SD = pi / sqrt(3.0)
"""The standard deviation of a logistic distribution of scale 1."""

MOST_SURPRISE = 3.0
"""A value that is off by more standard deviations than this tells no more of others: something is wrong with its own model."""

MOST_EXPONENT = 50.0
"""Beyond it a chance is 0 or 1."""


class SharedVariance(BaseModel):
    """Which shares of the variance are common to all candidates of a view, and to those of a family besides."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    view: float = Field(ge=0, le=1)
    family: float = Field(ge=0, le=1)

    @property
    def own(self) -> float:
        """The share of each candidate alone."""
        return max(1.0 - self.view - self.family, 0.0)


@dataclass(frozen=True, eq=False)
class Belief:
    """Means (n,) and covariances (n, n) of the natural logarithms of a value of n candidates."""

    mean: np.ndarray
    covariance: np.ndarray

    @classmethod
    def prior(
        cls, expected_log: Sequence[float], scales: Sequence[float], families: Sequence[object], shared: SharedVariance
    ) -> Belief:
        """Before anything was tried, of candidates of some families; ``scales`` are those of their logistic distributions."""
        count = len(families)
        same = np.array([[one == other for other in families] for one in families], np.float64).reshape(count, count)
        sd = LOGISTIC_SD * np.array(scales, np.float64)
        correlation = shared.view + shared.family * same + shared.own * np.eye(len(families))
        return cls(np.array(expected_log, np.float64), correlation * np.outer(sd, sd))

    def observed(self, which: int, value_log: float, noise: float) -> Belief:
        """After a candidate's value was seen; ``noise`` is the standard deviation of what was seen."""
        column = self.covariance[:, which]
        total = column[which] + noise**2
        if total <= 0.0:
            return self
        gain, off = column / total, value_log - self.mean[which]
        told = float(np.clip(off, -MOST_SURPRISE * np.sqrt(total), MOST_SURPRISE * np.sqrt(total)))
        mean = self.mean + gain * told
        mean[which] = self.mean[which] + gain[which] * off
        return Belief(mean, self.covariance - np.outer(gain, column))

    def scale(self, which: int) -> float:
        """That of a candidate's logistic distribution."""
        return float(np.sqrt(max(self.covariance[which, which], 0.0))) / LOGISTIC_SD

    def chance_over(self, which: int, limit_log: float) -> float:
        """How likely a candidate's logarithm lies over a limit, in [0, 1]."""
        return logistic_chance_over(float(self.mean[which]) - limit_log, self.scale(which))


def logistic_chance_over(off: float, scale: float) -> float:
    """How likely it is that a logistic distribution, ``off`` above a limit in the mean, lies over it, in [0, 1]."""
    if scale <= 0.0:
        return float(off > 0.0)
    return 1.0 / (1.0 + exp(-max(min(off / scale, MOST_EXPONENT), -MOST_EXPONENT)))
