"""The answer of an effect's predicate."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Verdict:
    """Whether an effect is called for, and the reason either way."""

    called_for: bool
    reason: str
