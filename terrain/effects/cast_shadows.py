"""Cast shadows: called for while direct sun reaches the level and there is ground that can rise into it."""

from __future__ import annotations

from terrain.descriptor import Descriptor
from terrain.effects.verdict import Verdict


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out at night, without a sun and on ground without any relief."""
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    if descriptor.highest_sun_deg <= 0.0:
        return Verdict(False, f"night: the sun is nowhere higher than {descriptor.highest_sun_deg:.1f} degrees over the level")
    if descriptor.relief_m <= 0.0:
        return Verdict(False, "all ground is at one height: nothing can cast")
    return Verdict(
        True,
        f"sun at {descriptor.sun_altitude_deg:.1f} degrees over {descriptor.relief_m:.0f} m of relief can be blocked by ground",
    )
