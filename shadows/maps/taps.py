"""Choose the number of taps for a sun's map that comes nearest to the sun's disc.

One tap shows a penumbra of width P as a hard edge. Its mean error is P / 4, and a little more for the texels' edges. Three taps
along a side show it as a ramp of two texels. The ramp is more accurate where texels are clearly narrower than P; elsewhere it blurs
sharp edges. Leaves have no edges wider than the gaps between them, so three taps blur them. ``docs/reports/accuracy.md`` has the
measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from skugga.shadows.maps.settings import Cascade
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import SUN

PENUMBRA_WIDTH_SHARE = float(2.0 * np.tan(np.radians(SUN_RADIUS_DEG)))
"""Width of a penumbra across the light, as a share of the distance from its caster."""

MAX_FINE_TEXEL_SHARE = 0.75
"""Largest texel that counts as fine, as a share of a penumbra.

The sign of the gain in ``soft_error`` changes there, in measured views.
"""

Taps = Literal[1, 3]
"""Taps along a side of the filter that an automatic choice allows."""


def sun_taps(descriptor: Descriptor, cascades: Sequence[Cascade]) -> tuple[Taps, str]:
    """Return the taps along a side for the cascades of a sun's map, and the reason."""
    share = fine_texel_share(descriptor, cascades)
    if share is None:
        return 3, "the width of penumbrae is unknown: 3 x 3 taps smooth the steps of texels along shadow edges"
    words = f"texels are finer than penumbrae in {100.0 * share:.0f} % of the cast shadow"
    if share >= 0.5:
        return 3, f"for the least soft error: {words}, so 3 x 3 taps come nearer to the sun's disc than one"
    return 1, f"for the least soft error: {words}, so one tap comes nearer to the sun's disc than 3 x 3, which only blur"


def fine_texel_share(descriptor: Descriptor, cascades: Sequence[Cascade]) -> float | None:
    """Return the share of the visible cast shadow where texels are finer than penumbrae; leaves never count as fine.

    It is ``None`` where the distances from casters are unknown. ``cascades`` are those of the sun's map.
    """
    facts, cast_sum, fine_sum = descriptor.lights.get(SUN), 0.0, 0.0
    for kind, casting in facts.casts.items() if facts is not None else ():
        if casting.thrown_m is None:
            continue
        for band in casting.bands:
            cast = band.share * band.cast
            cascade = next(
                (candidate for candidate in cascades if candidate.far_m is None or band.near_m < candidate.far_m), cascades[-1]
            )
            cast_sum += cast
            if (
                kind != "forest"
                and np.sqrt(np.prod(cascade.texel_m)) <= MAX_FINE_TEXEL_SHARE * PENUMBRA_WIDTH_SHARE * casting.thrown_m
            ):
                fine_sum += cast
    return fine_sum / cast_sum if cast_sum > 0.0 else None
