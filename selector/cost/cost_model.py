"""Predict the time of a plan's steps on a device: counts of operations, multiplied by the device's rates.

A step is one call of an algorithm. The model assumes empty caches, so a frame includes all of its work. ``frames_at_rest_ms``
predicts the time of a frame in which nothing has moved, whose maps and volumes are cached.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping

from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.unmeasured import NO_RATES_REASON, UnmeasuredError
from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.hybrid.settings import HybridSettings
from skugga.shadows.maps.settings import LampMapSettings, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.work import depth_map_sizes
from skugga.shadows.plan import Step
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.work import RESULTS_AT_REST, CachedResult, Counts, Work, Workload
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gl.depth_targets import MAX_TARGET_BYTES, MAX_TARGETS
from skugga.terrain.level.algorithm_names import AlgorithmName
from skugga.terrain.level.level import CasterKind

MapSettings = ShadowMapSettings | LampMapSettings | PerspectiveMapSettings
"""Settings of any kind of depth map."""

MS_PER_NS = 1e-6
"""Milliseconds per nanosecond."""


def step_work(
    descriptor: Descriptor,
    light: str,
    kinds: Collection[CasterKind],
    algorithm: AlgorithmName,
    settings: AlgorithmSettings | None,
    cached: frozenset[CachedResult] = frozenset(),
) -> Work:
    """Return the counts of operations of a step (one call of an algorithm) by part of its work.

    They are empty for the algorithm ``none``. ``cached`` are the results that caches hold, whose work is not counted.
    """
    return ALGORITHMS[algorithm].work(Workload(descriptor, light, kinds, cached), settings)


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
    return _work_ms(profile, algorithm, step_work(descriptor, light, kinds, algorithm, settings))


def frames_at_rest_ms(profile: DeviceProfile, descriptor: Descriptor, steps: Iterable[Step]) -> dict[str, float]:
    """Return the expected milliseconds by light of a frame's steps, if nothing has moved since the frame before.

    They are those of a frame made anew where the descriptor says that casters, lamps, clouds or the camera move. Depth maps are
    cached only if those of all ``steps`` fit into the device's pool together: otherwise each evicts another. Raises the errors of
    ``predicted_parts_ms``.
    """
    steps = list(steps)
    cached: frozenset[CachedResult] = frozenset() if descriptor.moves or descriptor.camera_moves else RESULTS_AT_REST
    sizes = [
        depth_map_sizes(step_work(descriptor, step.light, step.kinds, step.algorithm, step.settings), settings.depth_bits)
        for step in steps
        if (settings := _map_settings(step.settings)) is not None
    ]
    if sum(count for count, _ in sizes) > MAX_TARGETS or sum(size for _, size in sizes) > MAX_TARGET_BYTES:
        cached -= {"depth maps"}
    result: dict[str, float] = {}
    for step in steps:
        work = step_work(descriptor, step.light, step.kinds, step.algorithm, step.settings, cached)
        result[step.light] = result.get(step.light, 0.0) + sum(_work_ms(profile, step.algorithm, work).values())
    return result


def _map_settings(settings: AlgorithmSettings | None) -> MapSettings | None:
    """Return the settings of a step's depth maps; ``None`` without any. Only hybrids with the mask ``original`` have them."""
    if isinstance(settings, HybridSettings):
        return settings.map if settings.mask == "original" else None
    return settings if isinstance(settings, ShadowMapSettings | LampMapSettings | PerspectiveMapSettings) else None


def _work_ms(profile: DeviceProfile, algorithm: AlgorithmName, work: Work) -> dict[str, float]:
    """Return the expected milliseconds by part of a step's work. Raises ``UnmeasuredError`` if the profile lacks a part's rates."""
    for part in work:
        if part not in profile.rates_ns:
            raise UnmeasuredError(algorithm, NO_RATES_REASON.format(part=part))
    return {part: counts_to_ms(profile.rates_ns[part], counts) for part, counts in work.items()}


def counts_to_ms(rates_ns: Mapping[str, float], counts: Counts) -> float:
    """Return the milliseconds of counted operations at rates in nanoseconds each. Counts without a rate take no time."""
    return MS_PER_NS * sum(count * rates_ns.get(name, 0.0) for name, count in counts.items())
