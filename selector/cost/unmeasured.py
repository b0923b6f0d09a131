"""Error and messages for algorithms without measured errors or rates, which cannot be predicted."""

from __future__ import annotations

from skugga.terrain.level.algorithm_names import AlgorithmName

NO_ERRORS_REASON = "its errors are not measured yet: benchmarks/selection fits them"
"""Reason why an algorithm cannot be predicted: its errors were never measured. They need not be small."""

NO_RATES_REASON = "this device has no rates for {part}: run skugga calibrate again"
"""Reason why an algorithm cannot be predicted: the calibration has no time rates for the part ``part`` of its work."""


class UnmeasuredError(Exception):
    """The time or the error of an algorithm cannot be predicted.

    The policy ``predict`` catches this, leaves the algorithm out, and reports the reason.
    """

    def __init__(self, algorithm: AlgorithmName, reason: str) -> None:
        super().__init__(f"{algorithm}: {reason}")
        self.algorithm, self.reason = algorithm, reason
