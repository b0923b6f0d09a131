"""Alpha-tested casters: trees whose leaves let light through between them, looked up texel by texel where depth is drawn.

Left out, no depth program holds a texture look-up at all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from terrain.effects import cast_shadows
from terrain.effects.effect import Effect, Verdict

if TYPE_CHECKING:
    from terrain.descriptor import Descriptor


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out without foliage, and where its shadows cannot fall on what is seen."""
    if "forest" not in descriptor.casters:
        return Verdict(False, "there is no foliage")
    if any(lamp.reaches for lamp in descriptor.lamps):
        return Verdict(True, "foliage stands in the light of lamps")
    return cast_shadows.kind_of_sun(descriptor, "forest")


EFFECT = Effect("foliage casts by its texture's holes", called_for, needs=("cast_shadows",))
