"""Probes: some of the points that a view shows, and rays from them and from beside them to a light.

A shadow map's nearest look-up answers for a point with the visibility of the middle of its texel, compared on the plane of the
triangle that is seen. So the share of points for which a ray through the point and one through another place in its texel differ
is what a map of such texels gets wrong. Where the texels lie is chance: the other place is drawn from a square round the point,
across the light, by a fixed sequence (R2: M. Roberts 2018, "The unreasonable effectiveness of quasirandom sequences"), the same
in every process.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.facts.fact_types import TEXEL_LADDER_PX
from skugga.terrain.geo.world import LocalFrame

PROBES = 1000
"""Probes from which rays go to a light, at most."""

HALF_A_HIT = 0.5 / PROBES
"""What no probe was hit by may be there all the same: half a probe's share."""

PROBES_AMONG_TREES = 500
"""As many where there are trees, whose leaves cost most to miss."""

MOST_PLANE = 8.0
"""A place beside a point is looked for on its plane no farther along the light than so many times as far as it lies beside."""

_R2 = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True, eq=False)
class Probes:
    """Points that are seen, each standing for as much of the view as any other.

    ``point_frame_m`` and ``normal_frame`` (n, 3) float64, ``pixel_m`` and ``away_m`` (n,) a pixel's side there and the distance
    from the eye (0 in a map), ``kind`` (n,) what is seen as in ``skugga.terrain.gbuffer.resolve``, ``number`` (n,) whole numbers by
    which chance is told apart.
    """

    frame: LocalFrame
    point_frame_m: np.ndarray
    normal_frame: np.ndarray
    pixel_m: np.ndarray
    away_m: np.ndarray
    kind: np.ndarray
    number: np.ndarray

    def __len__(self) -> int:
        return len(self.number)

    def some(self, which: np.ndarray) -> Probes:
        """The probes at some indices or where a mask says."""
        names = ("point_frame_m", "normal_frame", "pixel_m", "away_m", "kind", "number")
        return replace(self, **{name: getattr(self, name)[which] for name in names})

    @property
    def point_earth_m(self) -> np.ndarray:
        """The points (n, 3), earth-fixed."""
        return self.frame.points_to_earth(self.point_frame_m)


@dataclass(frozen=True, eq=False)
class ProbeRays:
    """Rays to a light: from each of n probes itself, then from places in texels of each size beside it.

    ``start_frame_m`` (1 + k, n, 3), ``direction_frame`` (1 + k, n, 3) unit vectors, ``length_m`` (1 + k, n), infinite to the sun.
    """

    start_frame_m: np.ndarray
    direction_frame: np.ndarray
    length_m: np.ndarray

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts, directions and lengths."""
        return self.start_frame_m, self.direction_frame, self.length_m

    def some(self, rows: slice, which: np.ndarray) -> ProbeRays:
        """The rays of some rows, of the probes at some indices."""
        return ProbeRays(*(array[rows][:, which] for array in self.arrays))


def stratified_indices(size: int, count: int) -> np.ndarray:
    """At most ``count`` of the numbers below ``size``, spread evenly but for chance within each part."""
    if size <= count:
        return np.arange(size)
    ends = np.arange(count + 1) * size // count
    return ends[:-1] + (quasirandom(np.arange(count))[:, 0] * np.diff(ends)).astype(np.int64)


def quasirandom(number: np.ndarray) -> np.ndarray:
    """Points (n, 2) in [0, 1) that spread evenly with their numbers (n,): the R2 sequence."""
    return (0.5 + (np.asarray(number, np.float64)[:, None] + 1.0) * _R2) % 1.0


def rays_to(probes: Probes, direction_frame: np.ndarray, length_m: np.ndarray) -> ProbeRays:
    """Rays of probes to a light: unit directions (n, 3) and lengths (n,) of the ways there from the probes themselves."""
    right, up = _across(direction_frame)
    offset = (quasirandom(probes.number) - 0.5) * probes.pixel_m[:, None]
    beside = offset[:, :1] * right + offset[:, 1:] * up
    facing = np.einsum("ij,ij->i", probes.normal_frame, direction_frame)
    # On the plane that is seen, as a map compares: along the light as far as the plane leans.
    along = -np.einsum("ij,ij->i", probes.normal_frame, beside) / np.where(facing == 0.0, 1e-30, facing)
    most = MOST_PLANE * np.linalg.norm(offset, axis=1)
    directions = beside + np.clip(along, -most, most)[:, None] * direction_frame
    sizes = np.array([0.0, *TEXEL_LADDER_PX])
    start = probes.point_frame_m + sizes[:, None, None] * directions
    if not np.isfinite(length_m).all():
        shape = (len(sizes), len(probes))
        return ProbeRays(start, np.broadcast_to(direction_frame, start.shape), np.broadcast_to(length_m, shape))
    to_light = probes.point_frame_m + length_m[:, None] * direction_frame - start
    length = np.linalg.norm(to_light, axis=-1)
    return ProbeRays(start, to_light / np.maximum(length, 1e-30)[..., None], length)


def _across(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (n, 3) right and up across directions (n, 3); upright but for directions along the vertical."""
    flat = np.hypot(direction[:, 0], direction[:, 1])
    steep = flat < 1e-6
    scale = np.where(steep, 1.0, flat)
    right = np.stack([np.where(steep, 1.0, -direction[:, 1] / scale), np.where(steep, 0.0, direction[:, 0] / scale), 0.0 * flat], 1)
    return right, np.cross(direction, right)
