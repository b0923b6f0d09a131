"""New random situations for case X1; the tests use the same situations every time.

``python -m tests.hard_cases.hunt [ALGORITHM ...] [--examples N] [--seed S]`` prints each situation that exceeds its bounds, and the
figures that do, as a line for ``COUNTEREXAMPLES`` of ``tests.hard_cases.test_properties``. It exits with 1 if it finds any.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.hard_cases import test_properties
from tests.hard_cases.cases import Trial
from tests.hard_cases.test_properties import ALGORITHMS, SITUATIONS, Situation, within_bounds

BATCH_EXAMPLES = 5
"""Number of situations that ``hunt_for`` draws for an algorithm before the next one's turn."""


def hunt(algorithm: str, examples: int, seed_value: int) -> list[str]:
    """Return the situations of a seed that exceed an algorithm's bounds, each as a line for ``COUNTEREXAMPLES``."""
    finds: list[str] = []
    with TemporaryDirectory() as folder:
        trial = Trial(algorithm, False, Path(folder))

        # Only the generate phase: the search neither shrinks an example nor stops at one.
        @seed(seed_value)
        @settings(
            max_examples=examples, database=None, deadline=None, derandomize=False, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(SITUATIONS)
        def look(situation: Situation) -> None:
            try:
                figures: object = test_properties.outcome(trial, situation)
                sound = within_bounds(figures)
            except Exception as error:  # any exception is a find
                figures, sound = repr(error), False
            if not sound:
                finds.append(f'    "": {situation},  # {algorithm}: {figures}')

        look()
    return finds


def hunt_for(time_limit_s: float, seed_value: int) -> tuple[dict[str, int], list[str]]:
    """Draw new situations for all algorithms in turn until the time is over.

    Each algorithm draws at least one batch. Returns the number of batches of each algorithm, and the finds.
    """
    end_s = time.monotonic() + time_limit_s
    batches, finds = dict.fromkeys(ALGORITHMS, 0), []
    for number in count():
        for algorithm in ALGORITHMS:
            if number and time.monotonic() > end_s:
                return batches, finds
            finds += hunt(algorithm, BATCH_EXAMPLES, seed_value * 1000 + number)
            batches[algorithm] += 1
    raise AssertionError("the loop has no end")


def main() -> int:
    """Draw random situations for the algorithms of the command line. Return 1 if one exceeds its bounds, else 0."""
    parser = argparse.ArgumentParser(prog="hunt", description="draw new situations, and print those over their bounds")
    parser.add_argument("algorithms", nargs="*", choices=[*ALGORITHMS, []], help="all of them unless named")
    parser.add_argument("--examples", type=int, default=300, help="for each algorithm (300)")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(2**32), help="drawn unless given")
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    found = False
    for algorithm in args.algorithms or ALGORITHMS:
        for line in hunt(algorithm, args.examples, args.seed):
            found = True
            print(line, flush=True)
    return int(found)


if __name__ == "__main__":
    sys.exit(main())
