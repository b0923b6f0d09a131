"""Smooth curves through keys with times, for what moves: cubic between keys, with one velocity at each (C1).

**Velocities at keys.** Between a way in with the mean velocity a and a way out with b, a key has the velocity

    m = H (a/|a| + b/|b|) / 2,    (w0 + w1) / H = w0 / |a| + w1 / |b|,    w0 = 2 t1 + t0,  w1 = t1 + 2 t0,

with t0 and t1 the times of the two ways. Of one coordinate that is PCHIP (Fritsch and Butland 1984, "A method for constructing
local monotone piecewise cubic interpolants", SIAM J. Sci. Stat. Comput. 5(2):300-304): no value goes beyond those of the keys
round it. Of several it is the same along whichever axes they are counted (PCHIP for each would stop at a corner of a square that
stands upright, and not if it stood on its tip), and for keys that are even in time and way it is the Catmull-Rom spline. Where a
way has no length the velocity is 0: what has two keys in one place rests between them. Catmull-Rom's with uneven times
(centripetal or not) would leave that place and come back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

INSIDE = 1e-6
"""How far from the ends of a part, as a share of its time, directions are taken: at an end what moves may rest."""


@dataclass(frozen=True, eq=False)
class KeyedCurve:
    """A curve through values (n, k) at times (n,), rising, in seconds; at least two.

    A ``loop`` begins again after the last key, whose value is the first one's, with the velocity with which it ends. Else the curve
    rests before the first key and after the last one, and starts and stops without a jerk.
    """

    times_s: np.ndarray
    values: np.ndarray
    loop: bool = False

    def at(self, seconds: float | np.ndarray) -> np.ndarray:
        """Values (..., k) at times (...)."""
        return np.asarray(self._spline(self._since_first_s(seconds)))

    def direction_at(self, seconds: float) -> np.ndarray:
        """The way (k,) that it goes, of any length: at rest the way it came, at the very beginning the way it will go; 0 if it
        never moves.
        """
        since_s, moves = float(self._since_first_s(seconds)), self._moves
        if not moves.any():
            return np.zeros(self.values.shape[1])
        knots = self._knots_s
        part = int(np.clip(np.searchsorted(knots, since_s, side="right") - 1, 0, len(moves) - 1))
        if not moves[part]:
            before = np.flatnonzero(moves[:part])
            earlier = int(before[-1]) if len(before) else int(np.flatnonzero(moves)[-1]) if self.loop else None
            part = int(np.flatnonzero(moves)[0]) if earlier is None else earlier
            since_s = float(knots[part] if earlier is None else knots[part + 1])
        margin_s = INSIDE * (knots[part + 1] - knots[part])
        return np.asarray(self._spline(np.clip(since_s, knots[part] + margin_s, knots[part + 1] - margin_s), 1))

    @property
    def _knots_s(self) -> np.ndarray:
        """Times from the first key on: small numbers, whatever the clock says."""
        return self.times_s - self.times_s[0]

    @property
    def _moves(self) -> np.ndarray:
        """Which of the parts between keys move (n - 1,), bool."""
        return (np.diff(self.values, axis=0) != 0.0).any(axis=1)

    def _since_first_s(self, seconds: float | np.ndarray) -> np.ndarray:
        since_s, last_s = np.asarray(seconds, np.float64) - self.times_s[0], self._knots_s[-1]
        return np.remainder(since_s, last_s) if self.loop else np.clip(since_s, 0.0, last_s)

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        from scipy.interpolate import CubicHermiteSpline  # takes a tenth of a second, which levels where nothing moves need not pay

        return CubicHermiteSpline(self._knots_s, self.values, self._velocities(), axis=0)

    def _velocities(self) -> np.ndarray:
        """Velocities (n, k) at the keys."""
        lasts_s, velocity = np.diff(self._knots_s), np.diff(self.values, axis=0) / np.diff(self._knots_s)[:, None]
        if self.loop:
            lasts_s, velocity = np.r_[lasts_s[-1:], lasts_s, lasts_s[:1]], np.r_[velocity[-1:], velocity, velocity[:1]]
        before_s, after_s, into, out = lasts_s[:-1], lasts_s[1:], velocity[:-1], velocity[1:]
        speed_in, speed_out = (np.linalg.norm(way, axis=1) for way in (into, out))
        goes_on = (speed_in > 0.0) & (speed_out > 0.0)
        weight_in, weight_out = 2.0 * after_s + before_s, after_s + 2.0 * before_s
        with np.errstate(divide="ignore", invalid="ignore"):
            speed = (weight_in + weight_out) / (weight_in / speed_in + weight_out / speed_out)
            direction = (into / speed_in[:, None] + out / speed_out[:, None]) / 2.0
        at_keys = np.where(goes_on[:, None], speed[:, None] * direction, 0.0)
        return at_keys if self.loop else np.pad(at_keys, ((1, 1), (0, 0)))
