"""Settings of shadow maps from rules: how many texels and cascades, how many bits, how many taps, and why."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from shadows.map_windows import BORDER_TEXELS
from shadows.plan import Cascade, LampMapSettings, Reasoned, ShadowMapSettings
from terrain.descriptor import Band, Descriptor, LampFacts, joined
from terrain.level import Shadows

TEXEL_PX = 0.4
"""A texel's footprint on level ground, in pixels, that an automatic map size keeps to (between 512 and 4096 texels)."""

CASCADE_PX = 2.0
"""What a texel of a perspective view may cover, in pixels, where its cascade is nearest to the eye: of the numbers of cascades
(up to 4) and the automatic sizes that keep to it, those with the fewest texels are taken.
"""

FOLIAGE_PX = 3.0
"""The same where trees cast: their many layers of alpha-tested texels make a map cost in proportion to its texels."""

DEPTH_PX = 0.25
"""How far a depth step may shift a shadow on level ground, in pixels, before an automatic depth takes more bits."""

LARGEST, SMALLEST = 4096, 512
"""Automatic map sizes."""

EXTENT_STEP = 2.0**0.25
"""Extents of a perspective view are rounded up to powers of this, so that texels keep their size while a camera moves."""


def sun_map_settings(descriptor: Descriptor, asked: Shadows) -> tuple[ShadowMapSettings, list[Reasoned]]:
    """Settings of the sun's map or cascades, and the reasons for what was left to choose."""
    assert descriptor.receivers_light_m is not None and descriptor.sun_altitude_deg is not None
    altitude = np.radians(max(descriptor.sun_altitude_deg, 0.5))
    reasons: list[Reasoned] = []
    runs = _cascades(descriptor, asked, altitude, reasons)
    footprints_px = [float(_footprint(extent, altitude).max()) / pixel_m for _, extent, pixel_m in runs]
    size, bits, taps = asked.map_size, asked.depth_bits, asked.filter
    if size == "auto":
        wished_px = _wished_px(descriptor) if descriptor.bands else TEXEL_PX
        size = _power(max(footprints_px) / wished_px, LARGEST)
        covers_px = max(footprints_px) / (size - 2 * BORDER_TEXELS)
        more = f", above the {wished_px} wished for: the largest automatic size" if covers_px > wished_px else ""
        reasons.append(Reasoned(name=f"map_size {size}", reason=f"a texel covers {covers_px:.2f} pixels of level ground{more}"))
    texels = [extent[:2] / (size - 2 * BORDER_TEXELS) for _, extent, _ in runs]
    ranges_m = [run[1][2] * 1.1 + 3 * BORDER_TEXELS * float(texel.max()) for run, texel in zip(runs, texels, strict=True)]
    shifts_px = [range_m / (2**16 - 1) * np.cos(altitude) / run[2] for range_m, run in zip(ranges_m, runs, strict=True)]
    if bits == "auto":
        worst = int(np.argmax(shifts_px))
        bits = 16 if shifts_px[worst] <= DEPTH_PX else 24
        verdict = "at most" if bits == 16 else "more than"
        reasons.append(Reasoned(
            name=f"depth_bits {bits}",
            reason=f"a 16-bit step of {ranges_m[worst] / (2**16 - 1):.3g} m shifts a shadow by {shifts_px[worst]:.2g} pixels, "
            f"{verdict} {DEPTH_PX}",
        ))  # fmt: skip
    if taps == "auto":
        taps = 3
        reasons.append(Reasoned(name="filter 3", reason="nine taps smooth the stairs of texels along shadow edges"))
    steps = 2**16 - 1 if bits == 16 else 2**24 - 1
    cascades = tuple(
        Cascade(far_m=far_m, texel_m=(float(texel[0]), float(texel[1])), depth_step_m=float(range_m / steps))
        for (far_m, _, _), texel, range_m in zip(runs, texels, ranges_m, strict=True)
    )
    return ShadowMapSettings(map_size=size, depth_bits=bits, filter=taps, cascades=cascades), reasons


def lamp_map_settings(descriptor: Descriptor, lamp: LampFacts, asked: Shadows) -> tuple[LampMapSettings, list[Reasoned]]:
    """Settings of a lamp's map: a texel at the distance that the lamp is meant for keeps to ``TEXEL_PX``."""
    across_m = 2.0 * lamp.reference_m * np.tan(np.radians(45.0 if lamp.kind == "omni" else lamp.cutoff_deg))
    size, reasons = asked.map_size, []
    if size == "auto":
        size = _power(across_m / descriptor.pixel_m / TEXEL_PX, LARGEST // 2 if lamp.kind == "omni" else LARGEST)
        texel_px = across_m / (size - 2 * BORDER_TEXELS) / descriptor.pixel_m
        why = f"a texel covers {texel_px:.2g} pixels where it is aimed"
        reasons.append(Reasoned(name=f"{lamp.name}: map_size {size}", reason=why))
    bits = 32 if asked.depth_bits == "auto" else asked.depth_bits
    if asked.depth_bits == "auto":
        why = "a perspective map's steps grow with the square of the distance: even ones need float"
        reasons.append(Reasoned(name=f"{lamp.name}: depth_bits 32", reason=why))
    taps = 3 if asked.filter == "auto" else asked.filter
    return LampMapSettings(map_size=size, depth_bits=bits, filter=taps), reasons


def _cascades(
    descriptor: Descriptor, asked: Shadows, altitude: float, reasons: list[Reasoned]
) -> list[tuple[float | None, np.ndarray, float]]:
    """For each cascade how far from the eye it goes, its receivers' extent in light space (3,), and a pixel's side, metres."""
    if not descriptor.bands or descriptor.pixel is None:
        return [(None, np.array(descriptor.receivers_light_m), descriptor.pixel_m)]

    def extent(band: Band) -> np.ndarray:
        span = np.subtract(band.high_light_m, band.low_light_m)
        return EXTENT_STEP ** np.ceil(np.log(span) / np.log(EXTENT_STEP))

    def worst_px(bands: list[Band]) -> float:
        return max(float(_footprint(extent(band), altitude).max()) / (band.near_m * descriptor.pixel) for band in bands)

    ways, wished_px = [], _wished_px(descriptor)
    for count in range(1, 5) if asked.cascades == "auto" else [asked.cascades]:
        best = min(_splits(descriptor.bands, count), key=worst_px)
        size = _power(worst_px(best) / wished_px, LARGEST) if asked.map_size == "auto" else asked.map_size
        covers_px = worst_px(best) / (size - 2 * BORDER_TEXELS)
        ways.append((max(covers_px, wished_px), len(best) * size**2, covers_px, best))
    _, _, covers_px, best = min(ways, key=lambda way: way[:2])
    if asked.cascades == "auto":
        why = f"a texel covers at most {covers_px:.2g} pixels, {wished_px:g} wished for, with the fewest texels"
        reasons.append(Reasoned(name=f"cascades {len(best)}", reason=why))
    far = [band.far_m for band in best[:-1]]
    return [(far_m, extent(band), band.near_m * descriptor.pixel) for far_m, band in zip([*far, None], best, strict=True)]


def _wished_px(descriptor: Descriptor) -> float:
    return FOLIAGE_PX if "forest" in descriptor.casters else CASCADE_PX


def _power(texels: float, most: int) -> int:
    """The automatic map size that holds so many texels and the border."""
    return int(np.clip(2 ** np.ceil(np.log2(texels + 2 * BORDER_TEXELS)), SMALLEST, most))


def _splits(bands: tuple[Band, ...], count: int) -> list[list[Band]]:
    """All ways to join neighbouring bands to ``count`` runs (as many as there are bands, if those are fewer)."""
    count = min(count, len(bands))
    ways = []
    for cuts in combinations(range(1, len(bands)), count - 1):
        ends = [0, *cuts, len(bands)]
        ways.append([joined(bands[first:last]) for first, last in zip(ends, ends[1:], strict=False)])
    return ways


def _footprint(extent_m: np.ndarray, altitude: float) -> np.ndarray:
    """The extent's sides right and up (2,) on level ground."""
    return extent_m[:2] / np.array([1.0, np.sin(altitude)])
