"""How many taps a sun's map is looked up by: what comes nearer to the sun's disc.

One tap shows a penumbra of width P as a hard edge, which is P / 4 off in the mean, and a little more for where texels end. Three
taps show it as a ramp of two texels: that is nearer where texels are clearly narrower than P, and blurs what is sharp where they
are not. Leaves have no edge that is wider than the gaps between them: three taps blur these. Measured in ``docs/accuracy.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from skugga.shadows.maps.settings import Cascade
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import SUN

DISC_WIDTH = float(2.0 * np.tan(np.radians(SUN_RADIUS_DEG)))
"""The penumbra's width across the light as a share of the distance from what throws it."""

FINE = 0.75
"""A texel is fine where it is at most this share of a penumbra: there ``soft_error`` turns, in measured views."""

Taps = Literal[1, 3]


def sun_taps(descriptor: Descriptor, cascades: Sequence[Cascade]) -> tuple[Taps, str]:
    """Taps a side for the cascades of a sun's map, and why."""
    share = fine_share(descriptor, cascades)
    if share is None:
        return 3, "it is not known how wide penumbrae are: 3 x 3 taps smooth the texel stairs along shadow edges"
    words = f"texels are finer than penumbrae in {100.0 * share:.0f} % of the cast shadow"
    if share >= 0.5:
        return 3, f"by soft error: {words}, so 3 x 3 taps come nearer to the sun's disc than one"
    return 1, f"by soft error: {words}, so one tap comes nearer to the sun's disc than 3 x 3, which only blur"


def fine_share(descriptor: Descriptor, cascades: Sequence[Cascade]) -> float | None:
    """The share of the cast shadow that is seen where texels are finer than the penumbrae of what throws it (not of leaves);
    ``None`` where it is not known how far shadows are thrown.
    """
    facts, shadow, fine = descriptor.lights.get(SUN), 0.0, 0.0
    for kind, casting in facts.casts.items() if facts is not None else ():
        if casting.thrown_m is None:
            continue
        for band in casting.bands:
            cast = band.share * band.cast
            cascade = next((each for each in cascades if each.far_m is None or band.near_m < each.far_m), cascades[-1])
            shadow += cast
            if kind != "forest" and np.sqrt(np.prod(cascade.texel_m)) <= FINE * DISC_WIDTH * casting.thrown_m:
                fine += cast
    return fine / shadow if shadow > 0.0 else None
