"""Probes: sampled visible points of a view, with rays from them and from places beside them to a light.

A nearest-neighbour look-up in a shadow map gives a point the visibility of the centre of its texel, compared on the plane of the
visible triangle. The look-up is wrong if only one of the rays from the point and from the texel's centre reaches the light. The
share of such points is the error of a map with these texels.

The position of the texel grid is random, so a random place stands for the texel's centre. It is drawn from a texel-sized square
round the point, perpendicular to the light. The quasirandom sequence is the same in every process (R2: M. Roberts 2018, "The
unreasonable effectiveness of quasirandom sequences").
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX
from skugga.terrain.geo.world import LocalFrame

MAX_PROBES = 1000
"""Maximum number of probes that send rays to a light."""

MIN_CAST_SHADOW_SHARE = 0.5 / MAX_PROBES
"""Share of shadows to assume where no probe lies in shadow: half the share of one probe."""

MAX_PROBES_AMONG_TREES = 500
"""``MAX_PROBES`` in a scene with trees, whose leaves make rays expensive."""

MAX_PLANE_SLOPE = 8.0
"""Maximum offset along the light of a place beside a point, as a multiple of its offset perpendicular to the light.

The place lies on the plane of the surface unless that plane is steeper than this limit.
"""

_R2_INCREMENTS = np.array([0.7548776662466927, 0.5698402909980532])


@dataclass(frozen=True, eq=False)
class Probes:
    """Visible points of a view with equal weights.

    Attributes
    ----------
    frame
        Local frame of the coordinates.
    point_frame_m
        Points (n, 3), float64, metres.
    normal_frame
        Surface normals (n, 3), float64.
    pixel_m
        Side of a pixel at each point (n,), metres.
    distance_m
        Distance from the eye (n,), metres; 0 in a map.
    surface_kind
        Kind of surface (n,), as in ``skugga.terrain.gbuffer.resolve``.
    sequence_index
        Index of each probe in the quasirandom sequence (n,), int.
    """

    frame: LocalFrame
    point_frame_m: np.ndarray
    normal_frame: np.ndarray
    pixel_m: np.ndarray
    distance_m: np.ndarray
    surface_kind: np.ndarray
    sequence_index: np.ndarray

    def __len__(self) -> int:
        return len(self.sequence_index)

    def select(self, index: np.ndarray) -> Probes:
        """Return the probes at some indices or in a mask."""
        names = ("point_frame_m", "normal_frame", "pixel_m", "distance_m", "surface_kind", "sequence_index")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    @property
    def point_earth_m(self) -> np.ndarray:
        """The points (n, 3), earth-fixed, metres."""
        return self.frame.points_to_earth(self.point_frame_m)


@dataclass(frozen=True, eq=False)
class ProbeRays:
    """Rays to a light: row 0 starts at the n probes, rows 1 to k at places beside them in texels of k sizes.

    Attributes
    ----------
    start_frame_m
        Starts (1 + k, n, 3), metres.
    direction_frame
        Unit directions (1 + k, n, 3).
    length_m
        Lengths (1 + k, n), metres; infinite for the sun.
    """

    start_frame_m: np.ndarray
    direction_frame: np.ndarray
    length_m: np.ndarray

    @property
    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Starts, directions and lengths of the rays."""
        return self.start_frame_m, self.direction_frame, self.length_m

    def select(self, rows: slice, index: np.ndarray) -> ProbeRays:
        """Return the rays of some rows and of the probes at some indices."""
        return ProbeRays(*(array[rows][:, index] for array in self.arrays))


def stratified_indices(size: int, count: int) -> np.ndarray:
    """Return at most ``count`` indices below ``size``: one quasirandom index in each of ``count`` equal strata."""
    if size <= count:
        return np.arange(size)
    ends = np.arange(count + 1) * size // count
    return ends[:-1] + (quasirandom(np.arange(count))[:, 0] * np.diff(ends)).astype(np.int64)


def quasirandom(sequence_index: np.ndarray) -> np.ndarray:
    """Return points (n, 2) in [0, 1) of the R2 low-discrepancy sequence at indices (n,)."""
    return (0.5 + (np.asarray(sequence_index, np.float64)[:, None] + 1.0) * _R2_INCREMENTS) % 1.0


def rays_to_light(probes: Probes, direction_frame: np.ndarray, length_m: np.ndarray) -> ProbeRays:
    """Return the rays from probes, and from places beside them, to a light.

    ``direction_frame`` (n, 3) holds the unit directions from the probes to the light, ``length_m`` (n,) the distances.
    """
    right, up = _perpendicular_axes(direction_frame)
    offset = (quasirandom(probes.sequence_index) - 0.5) * probes.pixel_m[:, None]
    perpendicular = offset[:, :1] * right + offset[:, 1:] * up
    facing = np.einsum("ij,ij->i", probes.normal_frame, direction_frame)
    # Shift the places along the light onto the plane of the visible surface, where a shadow map compares.
    shift = -np.einsum("ij,ij->i", probes.normal_frame, perpendicular) / np.where(facing == 0.0, 1e-30, facing)
    max_shift = MAX_PLANE_SLOPE * np.linalg.norm(offset, axis=1)
    directions = perpendicular + np.clip(shift, -max_shift, max_shift)[:, None] * direction_frame
    sizes = np.array([0.0, *TEXEL_SIZES_PX])
    start = probes.point_frame_m + sizes[:, None, None] * directions
    if not np.isfinite(length_m).all():
        shape = (len(sizes), len(probes))
        return ProbeRays(start, np.broadcast_to(direction_frame, start.shape), np.broadcast_to(length_m, shape))
    to_light = probes.point_frame_m + length_m[:, None] * direction_frame - start
    length = np.linalg.norm(to_light, axis=-1)
    return ProbeRays(start, to_light / np.maximum(length, 1e-30)[..., None], length)


def _perpendicular_axes(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors right and up (n, 3), perpendicular to directions (n, 3). Right is horizontal."""
    flat = np.hypot(direction[:, 0], direction[:, 1])
    steep = flat < 1e-6
    scale = np.where(steep, 1.0, flat)
    right = np.stack([np.where(steep, 1.0, -direction[:, 1] / scale), np.where(steep, 0.0, direction[:, 0] / scale), 0.0 * flat], 1)
    return right, np.cross(direction, right)
