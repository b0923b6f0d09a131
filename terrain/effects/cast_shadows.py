"""Cast shadows: called for while a light reaches the level and there is something that can rise into it."""

from __future__ import annotations

from terrain.descriptor import Descriptor
from terrain.effects.verdict import Verdict


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out without a light, at night without lamps, and where nothing rises above level ground."""
    sun = of_sun(descriptor)
    if sun.called_for or not descriptor.lamps:
        return sun
    if not can_cast(descriptor):
        return Verdict(False, "bare ground at one height: nothing can cast")
    return Verdict(True, f"{', '.join(lamp.name for lamp in descriptor.lamps)} shine on what can block them")


def of_sun(descriptor: Descriptor) -> Verdict:
    """Whether the sun casts shadows here."""
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    if descriptor.highest_sun_deg <= 0.0:
        return Verdict(False, f"night: the sun is nowhere higher than {descriptor.highest_sun_deg:.1f} degrees over the level")
    if not can_cast(descriptor):
        return Verdict(False, "bare ground at one height: nothing can cast")
    what = [f"{descriptor.relief_m:.0f} m of relief"] if descriptor.relief_m > 0.0 else []
    what += [kind for kind in descriptor.casters if kind != "relief"]
    return Verdict(True, f"sun at {descriptor.sun_altitude_deg:.1f} degrees over {', '.join(what)} can be blocked")


def can_cast(descriptor: Descriptor) -> bool:
    """Whether anything stands on the ground or the ground has any relief."""
    return descriptor.relief_m > 0.0 or len(descriptor.casters) > 1
