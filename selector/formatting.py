"""Format percentages, durations and lists for messages."""

from __future__ import annotations

from collections.abc import Sequence
from math import floor, log10


def format_percent(share: float) -> str:
    """Format a share in [0, 1] as ``12 %``, ``0.12 %`` or ``under 0.001 %``, with two significant digits."""
    if 0.0 < share < 1e-5:
        return "under 0.001 %"
    return f"{format_two_digits(100.0 * share)} %"


def format_duration(ms: float) -> str:
    """Format milliseconds as ``0.42 ms``, ``435 ms`` or ``2.1 s``."""
    return f"{format_two_digits(ms / 1000.0)} s" if ms >= 999.5 else f"{format_two_digits(ms)} ms"


def format_list(names: Sequence[str], max_items: int = 4) -> str:
    """Join names as ``a``, ``a and b`` or ``a, b and c``. A list of more than ``max_items`` names ends with ``and 5 others``."""
    items = list(names) if len(names) <= max_items else [*names[: max_items - 1], f"{len(names) - max_items + 1} others"]
    return items[0] if len(items) == 1 else f"{', '.join(items[:-1])} and {items[-1]}"


def format_two_digits(value: float) -> str:
    """Format a number with at least two significant digits and no exponent: 0, 0.042, 4.2, 42, 420."""
    if value == 0.0:
        return "0"
    return f"{value:.{max(0, 1 - floor(log10(abs(float(f'{value:.1e}')))))}f}"


def format_wrong_share(share: float, is_coverage: bool) -> str:
    """Return an error, a share in [0, 1], as text.

    It is the wrong share of the cast shadow, or in dense woods (``is_coverage``) the error of coverage, the share of shadow in
    blocks of pixels.
    """
    return f"coverage off by {format_percent(share)}" if is_coverage else f"{format_percent(share)} of the cast shadow wrong"
