"""Logarithmic axes that have a place for zero, and what is written at ticks."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, log10

ZERO_PX = 46.0
"""Width of the place for zero beside a logarithmic axis."""


@dataclass(frozen=True)
class Scale:
    """Values to pixels: ``low`` at ``start_px`` and ``high`` at ``end_px``, whichever of these is larger, in equal steps for equal
    ratios; zero lies at ``zero_px``, before the start.
    """

    low: float
    high: float
    start_px: float
    end_px: float
    zero_px: float | None

    def __call__(self, value: float) -> float:
        """Pixels of a value; what is less than ``low`` but not zero lies at its start."""
        if value <= 0.0 and self.zero_px is not None:
            return self.zero_px
        share = log10(max(value, self.low) / self.low) / log10(self.high / self.low)
        return self.start_px + share * (self.end_px - self.start_px)

    def ticks(self) -> list[float]:
        """Powers of ten within; where these are fewer than three, 2 and 5 times them too."""
        powers = range(floor(log10(self.low)), ceil(log10(self.high)) + 1)
        for factors in ((1,), (1, 2, 5)):
            ticks = [f * 10.0**p for p in powers for f in factors if self.low * 0.999 <= f * 10.0**p <= self.high * 1.001]
            if len(ticks) >= 3:
                break
        return ticks


def scale_of(values: list[float], start_px: float, end_px: float, margin: float = 1.35) -> Scale:
    """The scale that holds values, with a ratio of ``margin`` to spare; the place for zero is taken off where it is needed.

    With nothing but zeros it spans a decade up to 1.
    """
    positive = [value for value in values if value > 0.0] or [0.1 * margin, 1.0 / margin]
    low, high = min(positive) / margin, max(positive) * margin
    if high / low < 10.0:
        low, high = (low * high) ** 0.5 / 10.0**0.5, (low * high) ** 0.5 * 10.0**0.5
    if all(value > 0.0 for value in values):
        return Scale(low, high, start_px, end_px, None)
    step = ZERO_PX if end_px > start_px else -ZERO_PX
    return Scale(low, high, start_px + step, end_px, start_px + step / 2.0)


def round_time(ms: float) -> str:
    """A tick's time: ``0 ms``, ``0.5 ms``, ``20 ms``, ``2 s``."""
    return f"{ms / 1000.0:g} s" if ms >= 1000.0 else f"{ms:g} ms"
