"""What is not known of an algorithm yet, so that nothing can be predicted of it."""

from __future__ import annotations

from skugga.terrain.level.algorithm_names import AlgorithmName

NO_ERRORS = "its errors are not measured yet: benchmarks/selection fits them"
NO_RATES = "this device has no rates for {part}: run skugga calibrate again"


class UnmeasuredError(Exception):
    """Of an algorithm, why nothing can be predicted. It ends at the policy that predicts, which falls back and says so."""

    def __init__(self, algorithm: AlgorithmName, why: str) -> None:
        super().__init__(f"{algorithm}: {why}")
        self.algorithm, self.why = algorithm, why
