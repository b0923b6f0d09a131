"""What was seen of choices for a level's maps, by their scale and the sun: one probe stands for all maps and tiles of its class."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan, degrees, hypot, log2, radians, tan
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict

from skugga.selector.seen import Seen

PROBED_FOR = {"max_error", "max_ms", "algorithm"}
"""What may be asked of the shadows of maps that a probe stands for: other settings change what algorithms draw."""

LEAST_SUN, MOST_SUN = -5, 2
"""Suns lower than 2 degrees and higher than 70 are as those there."""

BETWEEN_BLOCKS_ERROR, BETWEEN_BLOCKS_TIME = 0.6, 0.3
"""Standard deviations of the logarithms of errors and times between blocks of a level at one scale and sun
(``benchmarks/selection/blocks.py``, 24 situations of six levels): of errors what two in three keep to, since a few differ much
more; of times the root mean square less the noise of clocks.
"""


class MapClass(NamedTuple):
    """Maps that are alike: pixels of about ``2 ** scale`` metres, a sun whose altitude's tangent is about ``2 ** sun``, so that
    shadows on a plain are ``2 ** -sun`` times as long as what casts them is high.
    """

    scale: int
    sun: int

    @property
    def sun_altitude_deg(self) -> float:
        """The altitude in the middle of the class, degrees."""
        return degrees(atan(2.0**self.sun))


def map_class(pixel_m: float, sun_altitude_deg: float | None) -> MapClass | None:
    """The class of a map with pixels of ``pixel_m`` metres; ``None`` under a sun that does not shine."""
    if sun_altitude_deg is None or sun_altitude_deg <= 0.0:
        return None
    steepness = log2(tan(radians(min(sun_altitude_deg, 89.0))))
    return MapClass(round(log2(pixel_m)), min(max(round(steepness), LEAST_SUN), MOST_SUN))


class ProbedClass(BaseModel):
    """What was seen in a class of maps, by light."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scale: int
    sun: int
    seen: Mapping[str, tuple[Seen, ...]]


class MapProbes(BaseModel):
    """What was seen of choices for a level's maps. A value: ``with_`` gives another one."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: tuple[ProbedClass, ...] = ()

    def of(self, wanted: MapClass | None) -> Mapping[str, tuple[Seen, ...]] | None:
        """What was seen in a class, by light, as of a map of the class that may lie elsewhere; ``None`` where it was not probed."""
        for each in self.classes:
            if (each.scale, each.sun) == wanted:
                return {light: tuple(map(_elsewhere, seen)) for light, seen in each.seen.items()}
        return None

    def with_(self, other: MapProbes) -> MapProbes:
        """The same with what another one has; of classes that both have, that of the other. In the order of classes."""
        both = {(each.scale, each.sun): each for each in (*self.classes, *other.classes)}
        return MapProbes(classes=tuple(both[key] for key in sorted(both)))


def _elsewhere(seen: Seen) -> Seen:
    return seen.model_copy(
        update={
            "error_noise": hypot(seen.error_noise, BETWEEN_BLOCKS_ERROR),
            "interior_noise": hypot(seen.interior_noise, BETWEEN_BLOCKS_ERROR),
            "ms_noise": hypot(seen.ms_noise, BETWEEN_BLOCKS_TIME),
        }
    )
