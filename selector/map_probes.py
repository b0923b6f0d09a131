"""Observed times and errors of choices of algorithms on a level's maps, by class of maps.

A class contains all maps of about the same scale under suns of about the same altitude. A probe draws some choices on one map, and
compares them with ground truth. Its observations are used for all maps and tiles of the class.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import atan, degrees, hypot, log2, radians, tan
from typing import NamedTuple

from pydantic import BaseModel, ConfigDict

from skugga.selector.observation import Observation

PROBE_SETTINGS = {"max_error", "max_ms", "algorithm"}
"""Shadow settings that a request may set and still use stored observations. Other settings change the picture."""

MIN_SUN_CLASS, MAX_SUN_CLASS = -5, 2
"""Lowest and highest ``MapClass.sun``, for suns of about 2 and 70 degrees. Lower and higher suns belong to these classes."""

BLOCK_ERROR_SD, BLOCK_TIME_SD = 0.6, 0.3
"""Standard deviations of the logarithms of errors and times between blocks of a level at one scale and sun.

Measured by ``benchmarks/selection/blocks.py`` for 24 combinations of level, scale and sun, in six levels. For errors it is the
limit below which two thirds of the blocks stay, since a few blocks differ much more. For times it is the root mean square without
the noise of the time measurement.
"""


class MapClass(NamedTuple):
    """A class of maps with about the same scale under suns of about the same altitude.

    Attributes
    ----------
    scale
        Pixels are about ``2 ** scale`` metres wide.
    sun
        The tangent of the sun's altitude is about ``2 ** sun``. Shadows on level ground are ``2 ** -sun`` times as long as their
        casters are high.
    """

    scale: int
    sun: int

    @property
    def sun_altitude_deg(self) -> float:
        """Altitude of the sun in the middle of the class, degrees."""
        return degrees(atan(2.0**self.sun))


def map_class(pixel_m: float, sun_altitude_deg: float | None) -> MapClass | None:
    """Return the class of a map with pixels of ``pixel_m`` metres; ``None`` for a sun that is down or unknown.

    ``sun_altitude_deg`` is the sun's altitude; ``None`` if it is unknown.
    """
    if sun_altitude_deg is None or sun_altitude_deg <= 0.0:
        return None
    steepness = log2(tan(radians(min(sun_altitude_deg, 89.0))))
    return MapClass(round(log2(pixel_m)), min(max(round(steepness), MIN_SUN_CLASS), MAX_SUN_CLASS))


class ProbedClass(BaseModel):
    """Observations in one class of maps. ``scale`` and ``sun`` are those of ``MapClass``; ``seen`` has observations by light."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    scale: int
    sun: int
    seen: Mapping[str, tuple[Observation, ...]]


class MapProbes(BaseModel):
    """Observations of choices of algorithms on a level's maps, by class of maps. It is immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    classes: tuple[ProbedClass, ...] = ()

    def observations_of_class(self, target: MapClass | None) -> Mapping[str, tuple[Observation, ...]] | None:
        """Return the observations in the class ``target`` by light; ``None`` if there are none.

        Their noises include the differences between blocks of a level, since a map may show another part of the level than the one
        that was observed.
        """
        for probed_class in self.classes:
            if (probed_class.scale, probed_class.sun) == target:
                return {light: tuple(map(_with_block_noise, observations)) for light, observations in probed_class.seen.items()}
        return None

    def merged_with(self, other: MapProbes) -> MapProbes:
        """Return the classes of both objects, sorted. For a class that both have, the observations of ``other`` are used."""
        by_class = {(probed_class.scale, probed_class.sun): probed_class for probed_class in (*self.classes, *other.classes)}
        return MapProbes(classes=tuple(by_class[key] for key in sorted(by_class)))


def _with_block_noise(observation: Observation) -> Observation:
    """Return an observation whose noises include the deviations between blocks of a level.

    These are ``BLOCK_ERROR_SD`` and ``BLOCK_TIME_SD``.
    """
    return observation.model_copy(
        update={
            "error_noise": hypot(observation.error_noise, BLOCK_ERROR_SD),
            "interior_noise": hypot(observation.interior_noise, BLOCK_ERROR_SD),
            "ms_noise": hypot(observation.ms_noise, BLOCK_TIME_SD),
        }
    )
