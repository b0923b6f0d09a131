"""Predict the time of a plan's steps on a device: counts of operations, multiplied by the device's rates.

A step is one call of an algorithm. The model assumes empty caches, so a frame includes all of its work.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.unmeasured import NO_RATES_REASON, UnmeasuredError
from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.work import Counts, Work, Workload
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind

MS_PER_NS = 1e-6
"""Milliseconds per nanosecond."""


def step_work(
    descriptor: Descriptor, light: str, kinds: Collection[CasterKind], algorithm: AlgorithmName, settings: AlgorithmSettings | None
) -> Work:
    """Return the counts of operations of a step (one call of an algorithm) by part of its work.

    They are empty for the algorithm ``none``.
    """
    return ALGORITHMS[algorithm].work(Workload(descriptor, light, kinds), settings)


def predicted_ms(
    profile: DeviceProfile,
    descriptor: Descriptor,
    light: str,
    kinds: Collection[CasterKind],
    algorithm: AlgorithmName,
    settings: AlgorithmSettings | None,
) -> float:
    """Return the expected milliseconds of wall-clock time of a step, with empty caches.

    In a map view this is the time of one block. It is 0 for the algorithm ``none``. Raises the errors of ``predicted_parts_ms``.
    """
    return sum(predicted_parts_ms(profile, descriptor, light, kinds, algorithm, settings).values())


def predicted_parts_ms(
    profile: DeviceProfile,
    descriptor: Descriptor,
    light: str,
    kinds: Collection[CasterKind],
    algorithm: AlgorithmName,
    settings: AlgorithmSettings | None,
) -> dict[str, float]:
    """Return the expected milliseconds by part of the work (``skugga.shadows.work``).

    Raises ``UnmeasuredError`` if the profile has no rates for a part.
    """
    work = step_work(descriptor, light, kinds, algorithm, settings)
    for part in work:
        if part not in profile.rates_ns:
            raise UnmeasuredError(algorithm, NO_RATES_REASON.format(part=part))
    return {part: counts_to_ms(profile.rates_ns[part], counts) for part, counts in work.items()}


def counts_to_ms(rates_ns: Mapping[str, float], counts: Counts) -> float:
    """Return the milliseconds of counted operations at rates in nanoseconds each. Counts without a rate take no time."""
    return MS_PER_NS * sum(count * rates_ns.get(name, 0.0) for name, count in counts.items())
