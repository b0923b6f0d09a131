"""Logarithmic axes with a separate position for zero, and their tick labels."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, log10

ZERO_WIDTH_PX = 46.0
"""Width reserved for zero at the start of a logarithmic axis."""


@dataclass(frozen=True)
class Scale:
    """A logarithmic scale from values to pixels.

    Attributes
    ----------
    low, high
        Values at ``start_px`` and ``end_px``.
    start_px, end_px
        Ends of the axis in pixels, in either order.
    zero_px
        Position of zero, before the start; ``None`` without zeros.
    """

    low: float
    high: float
    start_px: float
    end_px: float
    zero_px: float | None

    def __call__(self, value: float) -> float:
        """Return the position of a value in pixels. Positive values below ``low`` lie at the start."""
        if value <= 0.0 and self.zero_px is not None:
            return self.zero_px
        share = log10(max(value, self.low) / self.low) / log10(self.high / self.low)
        return self.start_px + share * (self.end_px - self.start_px)

    def ticks(self) -> list[float]:
        """Return the powers of ten on the axis. If they are fewer than three, include 2 and 5 times the powers."""
        powers = range(floor(log10(self.low)), ceil(log10(self.high)) + 1)
        for factors in ((1,), (1, 2, 5)):
            ticks = [f * 10.0**p for p in powers for f in factors if self.low * 0.999 <= f * 10.0**p <= self.high * 1.001]
            if len(ticks) >= 3:
                break
        return ticks


def log_scale_of(values: list[float], start_px: float, end_px: float, margin: float = 1.35) -> Scale:
    """Return a logarithmic scale for some values.

    ``margin`` is a ratio that extends the scale at both ends. The scale has a position for zero if a value is zero. It spans at
    least a decade. If all values are zero, it runs from 0.1 to 1.
    """
    positive = [value for value in values if value > 0.0] or [0.1 * margin, 1.0 / margin]
    low, high = min(positive) / margin, max(positive) * margin
    if high / low < 10.0:
        low, high = (low * high) ** 0.5 / 10.0**0.5, (low * high) ** 0.5 * 10.0**0.5
    if all(value > 0.0 for value in values):
        return Scale(low, high, start_px, end_px, None)
    step = ZERO_WIDTH_PX if end_px > start_px else -ZERO_WIDTH_PX
    return Scale(low, high, start_px + step, end_px, start_px + step / 2.0)


def time_label(ms: float) -> str:
    """Return the tick label of a time: ``0 ms``, ``0.5 ms``, ``20 ms``, ``2 s``."""
    return f"{ms / 1000.0:g} s" if ms >= 1000.0 else f"{ms:g} ms"
