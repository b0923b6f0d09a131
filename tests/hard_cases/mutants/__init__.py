"""Deliberate defects of the engine, and the hard cases that must detect them."""

from __future__ import annotations

from tests.hard_cases.mutants import films, ground, lights, maps, volumes, whole_engine
from tests.hard_cases.mutants.mutant import Mutant

MUTANTS: dict[str, Mutant] = {
    name: mutant for part in (whole_engine, maps, volumes, ground, lights, films) for name, mutant in part.MUTANTS.items()
}
"""Mutants by name. Each case runs in its quick way, with the bounds of the suite."""
