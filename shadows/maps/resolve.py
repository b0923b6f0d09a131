"""Resolve the settings of depth maps: texels, cascades, bits and taps, with the reasons.

A perspective map is a perspective shadow map (Stamminger and Drettakis 2002, "Perspective shadow maps").
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from skugga.shadows.algorithm_settings import NamedReason, ResolvedSettings, SettingsRequest
from skugga.shadows.maps.bias_settings import bias_and_culling, bias_fault_reasons, bias_scale_of
from skugga.shadows.maps.settings import (
    Cascade,
    LampMapSettings,
    MapFilter,
    PerspectiveMapSettings,
    ShadowMapSettings,
)
from skugga.shadows.maps.taps import sun_taps
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS
from skugga.shadows.penumbra import MAX_LIGHT_POINTS
from skugga.terrain.cache import MIB, cached
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, LampFacts
from skugga.terrain.level.level import SUN, Shadows

MAX_TEXEL_PX = 0.4
"""Upper bound of a texel's footprint on level ground, in pixels, for an automatic map size (512 to 4096 texels)."""

MAX_CASCADE_TEXEL_PX = 2.0
"""Upper bound of a texel's footprint in a perspective view, in pixels, where its cascade is nearest to the eye.

Of the numbers of cascades (up to 4) and automatic sizes that keep to it, the combination with the fewest texels is chosen.
"""

MAX_FOLIAGE_TEXEL_PX = 3.0
"""Upper bound of a texel's footprint in a perspective view, in pixels, where trees cast.

Their many layers of alpha-tested texels make the cost of a map proportional to its texels.
"""

MAX_DEPTH_SHIFT_PX = 0.25
"""Upper bound of a shadow's shift on level ground by one depth step, in pixels, for an automatic depth of 16 bits."""

MAX_AUTOMATIC_MAP_SIZE, MIN_AUTOMATIC_MAP_SIZE = 4096, 512
"""Bounds of automatic map sizes."""

TUNED_MAP_SIZES = (1024, 2048, 512, 4096)
"""Map sizes that policies try, in this order."""

CALIBRATED_MAP_SIZES = (512, 1024, 2048, 4096)
"""Map sizes that a calibration measures, in texels along a side."""

PERSPECTIVE_MAP_SIZE = 1024
"""Default number of texels along a side of a perspective map.

A perspective map concentrates its texels where the eye sees them, so few suffice.
"""

FIXED_PERSPECTIVE_SETTINGS = {
    "fit": ("tight", "a perspective map follows the camera: its fit is always tight"),
    "cascades": (1, "a perspective map is fine near the eye, and splits its distance range where it would be too coarse"),
    "bias": ("receiver_plane", "a perspective map is compared on the receiver's own triangle"),
    "culling": ("none", "a perspective map needs no bias, so no culling"),
}
"""Settings of a shadow map that a perspective map does not offer: the only value, and the reason."""

EXTENT_ROUNDING_FACTOR = 2.0**0.25
"""Extents of a perspective view are rounded up to powers of this, so that texels keep their size while a camera moves."""


@dataclass(frozen=True)
class CalibrationOverrides:
    """The overrides that a calibration tries for a light's maps.

    Attributes
    ----------
    sizes
        Overrides of the size.
    filters
        Overrides of the filter.
    """

    sizes: list[dict[str, Any]]
    filters: list[dict[str, Any]]


def calibration_overrides(descriptor: Descriptor, light: str, calibration_extent: str) -> CalibrationOverrides:
    """Return the overrides that a calibration of this extent tries (``skugga.shadows.algorithm.CostInputs``)."""
    sizes = {"few": (1024, 2048)}.get(calibration_extent, CALIBRATED_MAP_SIZES if light == SUN else CALIBRATED_MAP_SIZES[:3])
    taps: tuple[int | str, ...] = (1, 2, 5, *(("sun",) if light == SUN else ())) if calibration_extent == "full" else ()
    return CalibrationOverrides(
        [{"map_size": size} for size in sizes], [{"map_size": 1024, "filter": filter_value} for filter_value in taps]
    )


def resolve_shadow_map(request: SettingsRequest) -> ResolvedSettings:
    """Return the settings of a light's shadow map, and the reasons for automatic values.

    Raises ``UnsupportedError`` for the penumbra of a lamp without a radius.
    """
    settings, reasons = resolve_uniform_map(replace(request, shadows=request.effective_shadows))
    return settings, [*request.hard_edges_reasons, *reasons]


def resolve_uniform_map(request: SettingsRequest) -> tuple[ShadowMapSettings | LampMapSettings, list[NamedReason]]:
    """Return the settings of a map with uniform texels, and the reasons for automatic values.

    The reasons for hard edges are not among them.
    """
    if request.light == SUN:
        return sun_map_settings(request.descriptor, request.shadows)
    lamp = next(lamp for lamp in request.descriptor.lamps if lamp.name == request.light)
    taps, taps_reasons = _resolve_taps(request)
    return lamp_map_settings(request.descriptor, lamp, request.shadows, taps, taps_reasons, request.light_point_count)


def sun_map_settings(descriptor: Descriptor, shadows: Shadows) -> tuple[ShadowMapSettings, list[NamedReason]]:
    """Return the settings of the sun's map or cascades, and the reasons for automatic values."""
    assert descriptor.receivers_light_m is not None and descriptor.sun_altitude_deg is not None
    altitude = np.radians(max(descriptor.sun_altitude_deg, 0.5))
    reasons: list[NamedReason] = []
    cascade_extents = _cascade_extents(descriptor, shadows, altitude, reasons)
    footprints_px = [float(_footprint_on_ground_m(extent, altitude).max()) / pixel_m for _, extent, pixel_m in cascade_extents]
    size, bits, taps = shadows.map_size, shadows.depth_bits, shadows.filter
    if size == "auto":
        target_px = _target_texel_px(descriptor) if descriptor.bands else MAX_TEXEL_PX
        size = _automatic_map_size(max(footprints_px) / target_px, MAX_AUTOMATIC_MAP_SIZE)
        covers_px = max(footprints_px) / (size - 2 * MAP_BORDER_TEXELS)
        remark = f", above the target of {target_px}: this is the largest automatic size" if covers_px > target_px else ""
        reasons.append(
            NamedReason(name=f"map_size {size}", reason=f"a texel covers {covers_px:.2f} pixels of level ground{remark}")
        )
    texels = [extent[:2] / (size - 2 * MAP_BORDER_TEXELS) for _, extent, _ in cascade_extents]
    ranges_m = [
        extent[2] * 1.1 + 3 * MAP_BORDER_TEXELS * float(texel.max())
        for (_, extent, _), texel in zip(cascade_extents, texels, strict=True)
    ]
    shifts_px = [
        range_m / (2**16 - 1) * np.cos(altitude) / pixel_m
        for range_m, (_, _, pixel_m) in zip(ranges_m, cascade_extents, strict=True)
    ]
    if bits == "auto" and taps == "sun":
        bits = 24
        reason = "the penumbra's width follows the distance to the caster, so depths must be fine everywhere"
        reasons.append(NamedReason(name="depth_bits 24", reason=reason))
    elif bits == "auto":
        worst = int(np.argmax(shifts_px))
        bits = 16 if shifts_px[worst] <= MAX_DEPTH_SHIFT_PX else 24
        verdict = "within the" if bits == 16 else "more than the"
        reasons.append(NamedReason(
            name=f"depth_bits {bits}",
            reason=f"a 16-bit step of {ranges_m[worst] / (2**16 - 1):.3g} m shifts a shadow by {shifts_px[worst]:.2g} pixels, "
            f"{verdict} {MAX_DEPTH_SHIFT_PX} allowed",
        ))  # fmt: skip
    steps = 2**16 - 1 if bits == 16 else 2**24 - 1
    cascades = tuple(
        Cascade(far_m=far_m, texel_m=(float(texel[0]), float(texel[1])), depth_step_m=float(range_m / steps))
        for (far_m, _, _), texel, range_m in zip(cascade_extents, texels, ranges_m, strict=True)
    )
    if taps == "auto":
        taps, reason = sun_taps(descriptor, cascades)
        reasons.append(NamedReason(name=f"filter {taps}", reason=reason))
    fixed_settings = bias_and_culling(shadows) | {"fit": "stable" if shadows.fit == "auto" else shadows.fit}
    if shadows.fit == "auto":
        reason = "texels stay fixed to the ground when the view moves"
        reason += ", and neighbouring blocks match" if descriptor.view_kind == "map" else ""
        reasons.append(NamedReason(name="fit stable", reason=reason))
    if shadows.bias == "auto":
        reason = "depths are compared on the receiver's own triangle, so nothing has to be shifted at any slope"
        reasons.append(NamedReason(name="bias receiver_plane", reason=reason))
    if shadows.culling == "auto" and "meshes" in descriptor.casters:
        reason = "depths are not shifted, so front-face culling gains nothing"
        reasons.append(NamedReason(name="culling none", reason=reason))
    reasons += bias_fault_reasons(shadows)
    return ShadowMapSettings(map_size=size, depth_bits=bits, filter=taps, cascades=cascades, **fixed_settings), reasons


def _resolve_taps(request: SettingsRequest) -> tuple[MapFilter, list[NamedReason]]:
    """Return the taps of a lamp's map or of a perspective map, and the reasons for them.

    Raises ``UnsupportedError`` for the penumbra of a point light.
    """
    light, descriptor, taps = request.light, request.descriptor, request.effective_shadows.filter
    prefix = "" if light == SUN else f"{light}: "
    if request.is_area_light:
        light_shape = "the sun's disc" if light == SUN else "the lamp's ball"
        return "sun", [
            NamedReason(
                name=f"{prefix}filter sun", reason=f"the mean of maps from {request.light_point_count} points of {light_shape}"
            )
        ]
    if taps == "sun" and descriptor.highest_sun_deg is None:
        reason = f"the lamp '{light}' has no radius, so it is a point without a penumbra: it takes 1, 2, 3 or 5 taps a side"
        raise UnsupportedError("filter", "sun", reason)
    if taps == "sun":
        return 3, [NamedReason(name=f"{prefix}filter 3", reason=f"{light} has no radius: it is a point without a penumbra")]
    lamp = next((lamp for lamp in descriptor.lamps if lamp.name == light), None)
    if taps == "auto" and lamp is not None and lamp.radius_m > 0.0:
        return 3, [
            NamedReason(name=f"{prefix}filter 3", reason=f"{light}'s penumbrae are narrower than a pixel: a point casts the same")
        ]
    if taps == "auto":
        filter_reason = "for the least wrong share of the cast shadow: 3 x 3 taps smooth the steps of texels along shadow edges"
        return 3, [NamedReason(name=f"{prefix}filter 3", reason=filter_reason)]
    return taps, []


def lamp_map_settings(
    descriptor: Descriptor,
    lamp: LampFacts,
    shadows: Shadows,
    taps: MapFilter,
    taps_reasons: list[NamedReason],
    light_point_count: int = MAX_LIGHT_POINTS,
) -> tuple[LampMapSettings, list[NamedReason]]:
    """Return the settings of a lamp's map, and the reasons for automatic values.

    If the size is automatic, a texel at the lamp's reference distance keeps to ``MAX_TEXEL_PX`` where the largest size allows it.
    ``light_point_count`` is the number of points of the lamp for the filter ``sun``. ``taps_reasons`` are the reasons for ``taps``,
    the filter.
    """
    width_m = 2.0 * lamp.reference_m * np.tan(np.radians(45.0 if lamp.kind == "omni" else lamp.cutoff_deg))
    size, reasons = shadows.map_size, []
    if size == "auto":
        size = _automatic_map_size(
            width_m / descriptor.pixel_m / MAX_TEXEL_PX,
            MAX_AUTOMATIC_MAP_SIZE // 2 if lamp.kind == "omni" else MAX_AUTOMATIC_MAP_SIZE,
        )
        texel_px = width_m / (size - 2 * MAP_BORDER_TEXELS) / descriptor.pixel_m
        reason = f"a texel covers {texel_px:.2g} pixels at the target"
        reasons.append(NamedReason(name=f"{lamp.name}: map_size {size}", reason=reason))
    bits = 32 if shadows.depth_bits == "auto" else shadows.depth_bits
    if shadows.depth_bits == "auto":
        reason = "depth steps of a perspective map grow with the square of the distance: float keeps them small"
        reasons.append(NamedReason(name=f"{lamp.name}: depth_bits 32", reason=reason))
    reasons += [*taps_reasons, *bias_fault_reasons(shadows, f"{lamp.name}: ")]
    return LampMapSettings(
        map_size=size, depth_bits=bits, filter=taps, light_points=light_point_count, **bias_and_culling(shadows)
    ), reasons


def resolve_perspective_map(request: SettingsRequest, has_slide_back: bool = True) -> ResolvedSettings:
    """Return the settings of a light's perspective map, and the reasons for automatic values.

    ``has_slide_back`` tells whether the algorithm has a virtual camera that can slide back. Raises ``UnsupportedError`` for the
    penumbra of a lamp without a radius.
    """
    light, shadows = request.light, request.effective_shadows
    prefix = "" if light == SUN else f"{light}: "
    reasons = [
        *request.hard_edges_reasons,
        *(
            NamedReason(name=f"{prefix}{key} {getattr(shadows, key)}", reason=f"no effect: {reason}")
            for key, (only_value, reason) in FIXED_PERSPECTIVE_SETTINGS.items()
            if getattr(shadows, key) not in ("auto", only_value)
        ),
    ]
    size, bits = shadows.map_size, shadows.depth_bits
    taps, taps_reasons = _resolve_taps(request)
    if size == "auto":
        size = PERSPECTIVE_MAP_SIZE
        reasons.append(NamedReason(name=f"{prefix}map_size {size}", reason="texels are small near the eye: few are enough"))
    if bits == "auto":
        bits = 24 if light == SUN else 32
        reason = (
            "steps grow with the distance from the eye" if light == SUN else "steps grow with the square of the lamp's distance"
        )
        reasons.append(NamedReason(name=f"{prefix}depth_bits {bits}", reason=f"{reason}: 16 bits are too coarse far away"))
    if shadows.slide_back == "off" and has_slide_back:
        reason = "the virtual camera stays at the real one: larger texels, or a refusal where the map's horizon meets the view"
        reasons.append(NamedReason(name=f"{prefix}slide_back off", reason=reason))
    scale_shadows = shadows.model_copy(update={"bias": "auto"})
    return PerspectiveMapSettings(
        map_size=size,
        depth_bits=bits,
        filter=taps,
        light_points=request.light_point_count,
        bias_scale=bias_scale_of(shadows),
        slide_back=shadows.slide_back if has_slide_back else "auto",
    ), [*reasons, *taps_reasons, *bias_fault_reasons(scale_shadows, prefix)]


def _cascade_extents(
    descriptor: Descriptor, shadows: Shadows, altitude_rad: float, reasons: list[NamedReason]
) -> list[tuple[float | None, np.ndarray, float]]:
    """Return the far distance, the receivers' extent and a pixel's side of each cascade, all in metres.

    The far distance is ``None`` for the last cascade. The extent (3,) is in light space. The number of cascades and the automatic
    size follow from the largest footprint of a texel (``_target_texel_px``). Of the splits into cascades that keep to it, the one
    with the smallest mean footprint over the visible ground is chosen. A requested size does not bound the footprint.
    ``altitude_rad`` is the sun's altitude. Reasons for automatic values are appended to ``reasons``.
    """
    if not descriptor.bands or descriptor.pixel is None:
        return [(None, np.array(descriptor.receivers_light_m), descriptor.pixel_m)]

    bands, pixel, target_px = descriptor.bands, descriptor.pixel, _target_texel_px(descriptor)
    extent_m, near_m, nearness = _measure_band_ranges(bands)
    texels_a_pixel = (extent_m[..., :2] / np.array([1.0, np.sin(altitude_rad)])).max(axis=-1) / pixel  # at distance 1
    options = []
    for count in range(1, 5) if shadows.cascades == "auto" else [shadows.cascades]:
        first, last = _splits_into_ranges(len(bands), count)
        worst_px = (texels_a_pixel[first, last] / near_m[first]).max(axis=1)
        worst = float(worst_px.min())
        size = _automatic_map_size(worst / target_px, MAX_AUTOMATIC_MAP_SIZE) if shadows.map_size == "auto" else shadows.map_size
        inner = size - 2 * MAP_BORDER_TEXELS
        max_px = np.inf if shadows.map_size != "auto" else max(worst, target_px * inner)
        mean_px = np.where(worst_px <= max_px, (texels_a_pixel[first, last] * nearness[first, last]).sum(axis=1), np.inf)
        best = int(np.argmin(mean_px))
        options.append(
            (max(worst / inner, target_px), first.shape[1] * size**2, inner, float(worst_px[best]), first[best], last[best])
        )
    _, _, inner, worst, first, last = min(options, key=lambda option: option[:2])
    if shadows.cascades == "auto":
        reason = (
            f"a texel covers at most {worst / inner:.2g} pixels (target: {target_px:g}), with as few texels in total as possible"
        )
        reasons.append(NamedReason(name=f"cascades {len(first)}", reason=reason))
    far_m = [*(bands[j].far_m for j in last[:-1]), None]
    return [(far, extent_m[i, j], bands[i].near_m * pixel) for far, i, j in zip(far_m, first, last, strict=True)]


def _target_texel_px(descriptor: Descriptor) -> float:
    """Return the upper bound, in pixels, of a texel's footprint for automatic cascades."""
    return MAX_FOLIAGE_TEXEL_PX if "forest" in descriptor.casters else MAX_CASCADE_TEXEL_PX


def _automatic_map_size(texel_count: float, max_size: int) -> int:
    """Return the automatic map size that holds ``texel_count`` and the border.

    The result, texels along a side, is a power of two from ``MIN_AUTOMATIC_MAP_SIZE`` to ``max_size``. ``texel_count`` is the
    number of texels along a side that receivers need.
    """
    return int(np.clip(2 ** np.ceil(np.log2(texel_count + 2 * MAP_BORDER_TEXELS)), MIN_AUTOMATIC_MAP_SIZE, max_size))


@cached("process", 16 * MIB)
def _measure_band_ranges(bands: tuple[Band, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the extents, near distances and sums of shares of all ranges of consecutive bands.

    A band is an interval of distances from the eye. Range (i, j) consists of the bands i to j, of n bands in all.

    - Extents (n, n, 3): sides of the range's bounds in light space, metres, rounded up to powers of ``EXTENT_ROUNDING_FACTOR``;
      NaN where j < i.
    - Near distances (n,): where each band starts, metres from the eye.
    - Sums (n, n): over the range's bands, each band's share of the visible surfaces divided by its near distance.
    """
    near_m = np.array([band.near_m for band in bands])
    cumulative = np.concatenate([[0.0], np.cumsum([band.share for band in bands] / near_m)])
    low, high = (np.array([getattr(band, name) for band in bands]) for name in ("low_light_m", "high_light_m"))
    span = np.full((len(bands), len(bands), 3), np.nan)
    for i in range(len(bands)):
        span[i, i:] = np.maximum.accumulate(high[i:]) - np.minimum.accumulate(low[i:])
    return (
        EXTENT_ROUNDING_FACTOR ** np.ceil(np.log(span) / np.log(EXTENT_ROUNDING_FACTOR)),
        near_m,
        cumulative[None, 1:] - cumulative[:-1, None],
    )


@cached("process", 16 * MIB)
def _splits_into_ranges(band_count: int, range_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return all ways to split ``band_count`` bands into ``range_count`` ranges of consecutive bands.

    There is at most one range for each band. The result is the numbers of the first and of the last band of each range, int64
    (ways, ranges) each.
    """
    range_count = min(range_count, band_count)
    cuts_by_split = list(combinations(range(1, band_count), range_count - 1))
    cuts = np.array(cuts_by_split, np.int64).reshape(len(cuts_by_split), range_count - 1)
    ends = np.full((len(cuts_by_split), 1), band_count)
    return np.hstack([0 * ends, cuts]), np.hstack([cuts, ends]) - 1


def _footprint_on_ground_m(extent_m: np.ndarray, altitude_rad: float) -> np.ndarray:
    """Return the sides (2,) that an extent's right and up sides cover on level ground, metres.

    ``extent_m`` (2 or more,) holds the sides right and up in light space, and ``altitude_rad`` is the sun's altitude.
    """
    return extent_m[:2] / np.array([1.0, np.sin(altitude_rad)])
