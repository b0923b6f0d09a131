"""New random situations for case X1; the tests use the same situations every time.

``python -m tests.hard_cases.hunt [ALGORITHM ...] [--examples N] [--seed S]`` prints each situation that exceeds its bounds, and the
figures that do, as a line for ``COUNTEREXAMPLES`` of ``tests.hard_cases.test_properties``. It exits with 1 if it finds any.
"""

from __future__ import annotations

import argparse
import secrets
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.hard_cases.cases import Trial
from tests.hard_cases.test_properties import ALGORITHMS, SITUATIONS, Situation, outcome, within_bounds


def hunt(algorithm: str, examples: int, seed_value: int) -> int:
    """Print and count the situations of a seed that exceed an algorithm's bounds."""
    failure_count = 0
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
            nonlocal failure_count
            try:
                figures: object = outcome(trial, situation)
                sound = within_bounds(figures)
            except Exception as error:  # any exception is a find
                figures, sound = repr(error), False
            if not sound:
                failure_count += 1
                print(f'    "": {situation},  # {algorithm}: {figures}', flush=True)

        look()
    return failure_count


def main() -> int:
    parser = argparse.ArgumentParser(prog="hunt", description="draw new situations, and print those over their bounds")
    parser.add_argument("algorithms", nargs="*", choices=[*ALGORITHMS, []], help="all of them unless named")
    parser.add_argument("--examples", type=int, default=300, help="for each algorithm (300)")
    parser.add_argument("--seed", type=int, default=secrets.randbelow(2**32), help="drawn unless given")
    args = parser.parse_args()
    print(f"seed {args.seed}", flush=True)
    return int(any([hunt(algorithm, args.examples, args.seed) for algorithm in args.algorithms or ALGORITHMS]))


if __name__ == "__main__":
    sys.exit(main())
