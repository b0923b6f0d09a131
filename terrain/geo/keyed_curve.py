"""Smooth curves through keyframes, for motion: cubic between keyframes, with one velocity at each (C1).

**Velocities at keyframes.** Let a be the mean velocity of the segment before a keyframe, and b that of the segment after it. The
velocity at the keyframe is

    m = H (a/|a| + b/|b|) / 2,    (w0 + w1) / H = w0 / |a| + w1 / |b|,    w0 = 2 t1 + t0,  w1 = t1 + 2 t0,

with t0 and t1 the durations of the two segments.

- In one coordinate this is PCHIP (Fritsch and Butland 1984, "A method for constructing local monotone piecewise cubic
  interpolants", SIAM J. Sci. Stat. Comput. 5(2):300-304): no value overshoots the neighbouring keyframes.
- In several coordinates the result does not depend on the axes. PCHIP of each coordinate does: it would stop at a corner of an
  upright square, but not at that of a square on its tip.
- For keyframes that are even in time and distance it is the Catmull-Rom spline.
- Where a segment has no length the velocity is 0, so that an object rests between two keyframes at one position. Catmull-Rom with
  uneven times (centripetal or not) would leave that position and return.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from scipy.interpolate import CubicHermiteSpline

SEGMENT_END_MARGIN_SHARE = 1e-6
"""Minimum distance in time from the ends of a segment at which directions are evaluated, as a share of its duration.

At the ends themselves the velocity may be 0.
"""


@dataclass(frozen=True, eq=False)
class KeyedCurve:
    """A curve through keyframes.

    A curve that does not loop rests before the first keyframe and after the last one, and starts and stops without a jerk. A loop
    repeats after the last keyframe, whose value equals the first one's, with the same velocity.

    Attributes
    ----------
    times_s
        (n,), ascending times in seconds; at least two.
    values
        (n, k), the keyframes' values.
    loop
        Whether the curve repeats.
    """

    times_s: np.ndarray
    values: np.ndarray
    loop: bool = False

    def at(self, seconds: float | np.ndarray) -> np.ndarray:
        """Return the values (..., k) at times (...) in seconds."""
        return np.asarray(self._spline(self._elapsed_s(seconds)))

    def direction_at(self, seconds: float) -> np.ndarray:
        """Return the direction of motion (k,), not normalised, at a time in seconds.

        At rest it is the last direction of motion, or before any motion the first one. It is 0 if the curve never moves.
        """
        since_s, is_moving = float(self._elapsed_s(seconds)), self._moving_segments
        if not is_moving.any():
            return np.zeros(self.values.shape[1])
        knots = self._knots_s
        segment = int(np.clip(np.searchsorted(knots, since_s, side="right") - 1, 0, len(is_moving) - 1))
        if not is_moving[segment]:
            earlier_segments = np.flatnonzero(is_moving[:segment])
            earlier = (
                int(earlier_segments[-1]) if len(earlier_segments) else int(np.flatnonzero(is_moving)[-1]) if self.loop else None
            )
            segment = int(np.flatnonzero(is_moving)[0]) if earlier is None else earlier
            since_s = float(knots[segment] if earlier is None else knots[segment + 1])
        margin_s = SEGMENT_END_MARGIN_SHARE * (knots[segment + 1] - knots[segment])
        return np.asarray(self._spline(np.clip(since_s, knots[segment] + margin_s, knots[segment + 1] - margin_s), 1))

    @property
    def _knots_s(self) -> np.ndarray:
        """Times since the first keyframe: small numbers, independent of the clock."""
        return self.times_s - self.times_s[0]

    @property
    def _moving_segments(self) -> np.ndarray:
        """Mask (n - 1,) of segments with motion."""
        return (np.diff(self.values, axis=0) != 0.0).any(axis=1)

    def _elapsed_s(self, seconds: float | np.ndarray) -> np.ndarray:
        """Return the times on the curve since the first keyframe: remainders if it loops, otherwise clamped to its duration."""
        since_s, last_s = np.asarray(seconds, np.float64) - self.times_s[0], self._knots_s[-1]
        return np.remainder(since_s, last_s) if self.loop else np.clip(since_s, 0.0, last_s)

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        """The cubic through the keyframes, by the time since the first one."""
        from scipy.interpolate import CubicHermiteSpline  # imported here: takes 0.1 s, and only moving objects need it

        return CubicHermiteSpline(self._knots_s, self.values, self._velocities(), axis=0)

    def _velocities(self) -> np.ndarray:
        """Return the velocities (n, k) at the keyframes."""
        durations_s, velocity = np.diff(self._knots_s), np.diff(self.values, axis=0) / np.diff(self._knots_s)[:, None]
        if self.loop:
            durations_s, velocity = (
                np.r_[durations_s[-1:], durations_s, durations_s[:1]],
                np.r_[velocity[-1:], velocity, velocity[:1]],
            )
        before_s, after_s, velocity_in, velocity_out = durations_s[:-1], durations_s[1:], velocity[:-1], velocity[1:]
        speed_in, speed_out = (np.linalg.norm(velocities, axis=1) for velocities in (velocity_in, velocity_out))
        is_moving = (speed_in > 0.0) & (speed_out > 0.0)
        weight_in, weight_out = 2.0 * after_s + before_s, after_s + 2.0 * before_s
        with np.errstate(divide="ignore", invalid="ignore"):
            speed = (weight_in + weight_out) / (weight_in / speed_in + weight_out / speed_out)
            direction = (velocity_in / speed_in[:, None] + velocity_out / speed_out[:, None]) / 2.0
        at_keys = np.where(is_moving[:, None], speed[:, None] * direction, 0.0)
        return at_keys if self.loop else np.pad(at_keys, ((1, 1), (0, 0)))
