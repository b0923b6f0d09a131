"""The `rules` policy: what is known of the algorithms beforehand, as rules over the descriptor, each with its source."""

from __future__ import annotations

from selector.picks import Pick
from selector.serves import kinds_of_lights
from terrain.descriptor import Descriptor
from terrain.level import SUN


def advised(descriptor: Descriptor, max_error: float) -> dict[str, Pick]:
    """What the rules take for each light."""
    return {
        light: Pick(
            "shadow_map",
            dict.fromkeys(descriptor.casters, "shadow_map"),
            why={
                kind: f"the algorithm at hand for {kind} under {'the sun' if light == SUN else light}"
                for kind in descriptor.casters
            },
        )
        for light in kinds_of_lights(descriptor)
    }
