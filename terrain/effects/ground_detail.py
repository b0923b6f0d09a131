"""Ground detail: procedural texture of the ground near the eye, from patches of a meadow down to tufts.

Gradient noise of several wavelengths varies the ground's albedo between lighter and darker, and between drier and greener. The
noise is a function of the position in metres from the level's anchor, so it stays fixed when the camera moves. Its slopes are those
of tufts and clods: the sides that face the sun are lighter, less so in cast shadow.

**Antialiasing.** The amplitude of a wave depends on the size of the pixels. It is full if the wavelength spans four pixels, and
zero if it spans two (the Nyquist limit). A pixel is long along the line of sight, by the cosine between it and the ground's normal.
Where that would hide waves that the pixel's width shows, ``TAP_COUNT`` samples along the pixel are averaged, as anisotropic filters
of textures do, and the third of its length counts. Distant ground therefore keeps its plain tint. Maps have no detail, since most
are coarser than all wavelengths.

**Visibility.** If a linear colour c is multiplied by 1 + s, its sRGB code k changes by s c / (dc/dk). The change is largest on
white. Below a relative change s of ``MAX_INVISIBLE_ALBEDO_CHANGE`` no code changes by more than a step. Darker ground changes
less: the brightest colour that the level's light gives to its ground bounds the number of steps (``max_code_steps``).

**Material.** The noise is that of meadows and soil. Ground that is no natural ground has none of it, also if the effect is forced
on: a floor (ground without relief, which is plain grey), imagery, and styles that draw ground as stone or as a neutral base.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.noise import noise_along, noise_slopes_along
from skugga.terrain.scene import Scene
from skugga.terrain.shading import WATER_HEIGHT_TOLERANCE_M, daylight_of, max_slope_sky_factor, night_sky_share
from skugga.terrain.shading_loops import tone_curve, twilight_sky_share
from skugga.terrain.srgb import srgb_of_linear

GROUND_WAVES = (
    (47.0, 0.10), (19.0, 0.09), (7.3, 0.09), (2.9, 0.11), (1.1, 0.13), (0.43, 0.15), (0.17, 0.16), (0.067, 0.16),
)  # fmt: skip
"""Wavelengths in metres, each with its amplitude as a share of the albedo."""

HUE_SHIFT_RGB = (0.55, 0.0, -0.85)
"""Additional change of red, green and blue by the waves that change the hue, relative to their amplitude. Lighter ground looks
drier.
"""

HUE_WAVE_COUNT = 3
"""Number of waves that change the hue, longest first."""

DETAIL_SEED = 71

MAX_GRADIENT_NOISE = 0.9
"""Upper bound of gradient noise."""

RELIEF_AMPLITUDES = (0.0, 0.0, 0.015, 0.035, 0.07, 0.09, 0.10, 0.10)
"""Change of the albedo by a slope of 1 of each wave, where the sun is 45 degrees above the ground."""

MAX_RELIEF_CHANGE, MAX_SUN_TANGENT, SHADED_RELIEF_SHARE = 0.6, 1.6, 0.3
"""Limits of that change in total and of the tangent of the angle between the sun and the ground's normal; its share in shadow."""

MAX_NOISE_SLOPE = 2.5
"""Upper bound of the slope of gradient noise: 2.32 in two million samples."""

TAP_COUNT, SINGLE_TAP_WAVE = 3, 6.0
"""Samples along a pixel, and the shortest wave, in lengths of a pixel, that needs only one: two more would change it by 2 %."""

LATTICE_ROTATION = (0.8, 0.6)
"""Cosine and sine of the rotation between the lattices of successive waves, so that their rows never coincide."""

MIN_VIEW_COSINE = 0.02
"""Lower bound of the cosine between the view and the ground's normal."""

MAX_INVISIBLE_ALBEDO_CHANGE = SRGB_CHANNEL_STEP / 0.45
"""Largest relative change of the albedo that changes no colour by more than one of 255."""

MAX_BATCH_PIXELS = 256
"""Maximum number of pixels of a row that are computed together."""

_WAVES = np.array(GROUND_WAVES)


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view in which natural ground is so near that pixels show any of it.

    Left out: maps; floors (ground without relief), draped imagery, and the styles ``urban``, ``grey`` and ``analysis``, which show
    no natural ground; ground that is all too far away or too dark.
    """
    facts = descriptor.facts["ground_detail"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows the ground's tints only")
    if facts["draped"]:
        return Verdict(False, "imagery is draped over the ground")
    if not facts.get("natural", True):
        return Verdict(False, "the level shows no natural ground: a floor, stone or a neutral base has no patches and tufts")
    nearest_m, share = numeric_fact(facts["nearest_m"]), numeric_fact(facts["share"])
    if nearest_m is None or share is None:
        return Verdict(False, "no ground is in view")
    if share <= MAX_INVISIBLE_ALBEDO_CHANGE:
        return Verdict(False, f"the nearest ground is {nearest_m:.0f} m away, where pixels are as wide as its patches")
    steps = numeric_fact(facts.get("steps"))
    if steps is not None and steps <= 1.0:
        return Verdict(False, f"the ground is too dark: patches and tufts change it by at most {steps:.1g} of 255 steps")
    return Verdict(True, f"ground {nearest_m:.1f} m away shows patches and tufts: up to {100.0 * share:.0f} % of its albedo")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of ground detail.

    - ``draped``: whether imagery is draped over the ground.
    - ``nearest_m``: distance of the nearest visible ground, metres; ``None`` if no ground is visible.
    - ``natural``: whether the level's ground is natural: neither a floor nor imagery, stone or a neutral base.
    - ``share``: upper bound of the relative change of the ground's albedo by the effect; ``None`` if no ground is visible.
    - ``steps``: upper bound of the change of the picture, in steps of 255; ``None`` if no ground is visible.
    """
    draped = scene.loaded.level.terrain.imagery is not None
    nothing: dict[str, Fact] = {
        "draped": draped, "natural": has_natural_ground(scene), "nearest_m": None, "share": None, "steps": None,
    }  # fmt: skip
    if coarse_view is None or isinstance(view, MapView):
        return nothing
    buffer = coarse_view.buffer
    ground = buffer.surface_kind[buffer.valid] == RELIEF
    distance_m = coarse_view.distance_m[ground]
    if not len(distance_m):
        return nothing
    to_eye = (coarse_view.eye_frame_m - coarse_view.points_frame_m[ground]) / np.maximum(distance_m, 1e-9)[:, None]
    facing = np.abs(np.einsum("nk,nk->n", buffer.shading_normal_frame[buffer.valid][ground], to_eye))
    # Between two samples a plane may be nearer and seen at a steeper angle: at distance h / c for the cosine c.
    steeper = np.clip(facing + coarse_view.spacing_tangent, MIN_VIEW_COSINE, 1.0)
    across_m = view.pixel_tangent * distance_m * np.maximum(facing, MIN_VIEW_COSINE) / steeper
    share = max_albedo_change(float(np.maximum(across_m, across_m / (TAP_COUNT * steeper)).min()))
    steps = max_code_steps(max_ground_color(scene), share)
    return {**nothing, "nearest_m": float(distance_m.min()), "share": share, "steps": steps}


def has_natural_ground(scene: Scene) -> bool:
    """Return whether a level shows natural ground: ground with relief, in a style that shows land, and without imagery."""
    low, high = scene.height_range_m
    return high > low and scene.style.has_natural_ground and scene.loaded.level.terrain.imagery is None


def max_ground_color(scene: Scene) -> float:
    """Return an upper bound of the linear display colour of the ground, over all channels; 1 in the light of lamps."""
    if scene.lamps:
        return 1.0
    daylight = daylight_of(scene)
    sun = daylight.sun_irradiance if scene.sun_is_up else np.zeros(3)
    day = 0.0 if scene.highest_sun_deg is None else float(twilight_sky_share(np.sin(np.radians(scene.highest_sun_deg))))
    night = night_sky_share(scene)
    sky = daylight.sky_irradiance * (max_slope_sky_factor(scene) * (night + (1.0 - night) * day))
    return float(tone_curve(float((sun + sky).max())))


def max_code_steps(max_color: float, share: float) -> float:
    """Return the largest change of an sRGB code, in steps of 255, if linear colours up to ``max_color`` change by a share."""
    codes = 255.0 * srgb_of_linear(np.clip(max_color * np.array([1.0 - share, 1.0, 1.0 + share]), 0.0, 1.0))
    return float(np.abs(np.diff(codes)).max())


def max_albedo_change(pixel_m: float) -> float:
    """Return an upper bound of the relative change of the albedo where pixels are ``pixel_m`` metres wide."""
    shares = [_resolved_share(wave, pixel_m) for wave, _ in GROUND_WAVES]
    amplitudes = [share * amplitude for share, (_, amplitude) in zip(shares, GROUND_WAVES, strict=True)]
    relief = MAX_NOISE_SLOPE * MAX_SUN_TANGENT * sum(np.multiply(shares, RELIEF_AMPLITUDES))
    color = MAX_GRADIENT_NOISE * (sum(amplitudes) + max(map(abs, HUE_SHIFT_RGB)) * sum(amplitudes[:HUE_WAVE_COUNT]))
    return float((1.0 + color) * (1.0 + min(relief, MAX_RELIEF_CHANGE)) - 1.0)


def apply_ground_detail(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the albedo (rows, cols, 3) of natural ground in a perspective view by the detail, in place."""
    buffer, scene, view = block.buffer, block.scene, block.view
    if isinstance(view, MapView) or not has_natural_ground(scene):
        return
    to_sun = scene.sun.in_frame(buffer.frame) if scene.sun is not None and scene.sun_is_up else np.zeros(3)
    run_in_chunks(
        len(albedo), _apply_detail, albedo, _albedo_changes(buffer, scene, view), np.array(HUE_SHIFT_RGB),
        buffer.shading_normal_frame, scene.world.anchor_from_frame(buffer.frame)[0], to_sun, block.visibilities.get("sun"),
    )  # fmt: skip


def _cache_key(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    """Return the cache key of ``_albedo_changes``: the buffer's points, the level's ground and the width of a pixel."""
    return buffer.position_frame_m, scene.elevation, view.pixel_tangent


@cached("scene", 128 * MIB, key=_cache_key, max_entries=1)
def _albedo_changes(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> np.ndarray:
    """Return how much lighter and drier the ground is, as relative changes of its albedo, and the slopes of its tufts.

    They are float32 (rows, cols, 4) and do not depend on the sun. Slopes are along the anchor's axes east and north.
    """
    out = np.zeros((*buffer.valid.shape, 4), np.float32)
    run_in_chunks(
        len(out), _compute_waves, buffer.shading_inputs, scene.world.anchor_from_frame(buffer.frame),
        scene.elevation.water_m + WATER_HEIGHT_TOLERANCE_M,
        view.in_frame(buffer.frame)[0], view.pixel_tangent, _WAVES, out,
    )  # fmt: skip
    return out


@compiled
def _apply_detail(first, last, albedo, detail, hue_shift, normal, rotation, to_sun, sunlight):
    """Multiply the albedo (rows, cols, 3) of the rows from ``first`` to ``last`` (exclusive) by the detail, in place.

    ``detail`` (rows, cols, 4) is the result of ``_albedo_changes``, and ``hue_shift`` (3,) is ``HUE_SHIFT_RGB``. ``normal`` (rows,
    cols, 3) and ``to_sun`` (3,), the direction to the sun or 0, are in the frame. ``rotation`` (3, 3) leads to the anchor's axes.
    ``sunlight`` (rows, cols) is the visible share of the sun; ``None`` counts as 1.
    """
    has_sun = to_sun[0] != 0.0 or to_sun[1] != 0.0 or to_sun[2] != 0.0
    for i in range(first, last):
        for j in range(albedo.shape[1]):
            lighter, drier = detail[i, j, 0], detail[i, j, 1]
            if lighter == 0.0 and drier == 0.0:
                continue
            relief = 0.0
            if has_sun:
                # The brightness of a bump changes by minus the product of its slope with the sun's direction along the ground.
                lit = normal[i, j, 0] * to_sun[0] + normal[i, j, 1] * to_sun[1] + normal[i, j, 2] * to_sun[2]
                if lit > 0.0:
                    x = to_sun[0] - lit * normal[i, j, 0]
                    y = to_sun[1] - lit * normal[i, j, 1]
                    z = to_sun[2] - lit * normal[i, j, 2]
                    scale = 1.0 / max(lit, np.sqrt(x * x + y * y + z * z) / MAX_SUN_TANGENT)
                    east = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z
                    north = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z
                    relief = -scale * (detail[i, j, 2] * east + detail[i, j, 3] * north)
                    if sunlight is not None:
                        relief *= SHADED_RELIEF_SHARE + (1.0 - SHADED_RELIEF_SHARE) * sunlight[i, j]
                    relief = min(max(relief, -MAX_RELIEF_CHANGE), MAX_RELIEF_CHANGE)
            for k in range(3):
                albedo[i, j, k] *= (1.0 + lighter + hue_shift[k] * drier) * (1.0 + relief)


@compiled
def _resolved_share(wavelength_m, pixel_m):
    """Return the share of a wave's amplitude that remains after antialiasing, for a wavelength and a width of pixels in metres."""
    return min(max(wavelength_m / (2.0 * max(pixel_m, 1e-9)) - 1.0, 0.0), 1.0)


@compiled
def _compute_waves(first, last, shading_inputs, anchor_from_frame, water_m, eye, pixel, waves, out):
    """Write the detail of the rows from ``first`` to ``last`` (exclusive) to ``out`` (rows, cols, 4), which must hold zeros.

    Up to ``MAX_BATCH_PIXELS`` pixels are computed together. Ground below ``water_m`` metres has no detail. ``anchor_from_frame`` is
    the rotation (3, 3) and the translation (3,) to the anchor's axes. ``eye`` (3,) is the eye in the frame, and ``pixel`` the side
    of a pixel as a tangent. ``waves`` (k, 2) is ``GROUND_WAVES``.
    """
    valid, kind, position, height, normal = shading_inputs
    rotation, origin = anchor_from_frame
    points = np.empty((6, MAX_BATCH_PIXELS))
    column = np.empty(MAX_BATCH_PIXELS, np.int64)
    cols = valid.shape[1]
    for i in range(first, last):
        count = 0
        for j in range(cols):
            if valid[i, j] and kind[i, j] == RELIEF and height[i, j] > water_m:
                px, py, pz = position[i, j, 0], position[i, j, 1], position[i, j, 2]
                dx, dy, dz = px - eye[0], py - eye[1], pz - eye[2]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = abs(normal[i, j, 0] * dx + normal[i, j, 1] * dy + normal[i, j, 2] * dz) / max(distance, 1e-9)
                across = pixel * distance
                along = across / max(facing, MIN_VIEW_COSINE)
                width = max(across, along / TAP_COUNT)
                if waves[0, 0] > 2.0 * width:
                    east = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
                    north = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
                    step = along / (TAP_COUNT * max(np.sqrt(east * east + north * north), 1e-9))
                    points[0, count] = rotation[0, 0] * px + rotation[0, 1] * py + rotation[0, 2] * pz + origin[0]
                    points[1, count] = rotation[1, 0] * px + rotation[1, 1] * py + rotation[1, 2] * pz + origin[1]
                    points[2, count], points[3, count] = step * east, step * north
                    points[4, count], points[5, count] = width, along
                    column[count] = j
                    count += 1
            if count == MAX_BATCH_PIXELS or (count > 0 and j == cols - 1):
                _add_waves(
                    points[0, :count], points[1, :count], points[2, :count], points[3, :count], points[4, :count],
                    points[5, :count], waves, column, out[i],
                )  # fmt: skip
                count = 0


@internal
def _add_waves(x, y, step_x, step_y, width_m, length_m, waves, column, out):
    """Add the waves at positions (n,) to the elements ``column`` (n,) of a row ``out`` (cols, 4).

    ``x`` and ``y`` (n,) are metres east and north of the anchor, and (``step_x``, ``step_y``) the steps between samples along a
    pixel. All four are overwritten. ``width_m`` (n,) is the width of pixels that counts, and ``length_m`` their length.
    """
    count = x.size
    wave_x, wave_y, noise, slope_x, slope_y = (np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count))
    finest, longest, cosine, sine = width_m.min(), length_m.max(), 1.0, 0.0
    for k in range(len(waves)):
        wave = waves[k, 0]
        if _resolved_share(wave, finest) <= 0.0:
            break
        for n in range(count):
            x[n], y[n] = (
                LATTICE_ROTATION[0] * x[n] - LATTICE_ROTATION[1] * y[n],
                LATTICE_ROTATION[1] * x[n] + LATTICE_ROTATION[0] * y[n],
            )
            step_x[n], step_y[n] = (
                LATTICE_ROTATION[0] * step_x[n] - LATTICE_ROTATION[1] * step_y[n],
                LATTICE_ROTATION[1] * step_x[n] + LATTICE_ROTATION[0] * step_y[n],
            )
        cosine, sine = (
            LATTICE_ROTATION[0] * cosine - LATTICE_ROTATION[1] * sine, LATTICE_ROTATION[1] * cosine + LATTICE_ROTATION[0] * sine,
        )  # fmt: skip
        relief = RELIEF_AMPLITUDES[k]
        taps = 1 if wave >= SINGLE_TAP_WAVE * longest else TAP_COUNT
        for tap in range(taps):
            offset = tap - 0.5 * (taps - 1)
            for n in range(count):
                wave_x[n], wave_y[n] = (x[n] + offset * step_x[n]) / wave, (y[n] + offset * step_y[n]) / wave
            if relief > 0.0:
                noise_slopes_along(wave_x, wave_y, DETAIL_SEED + k, noise, slope_x, slope_y)
            else:
                noise_along(wave_x, wave_y, DETAIL_SEED + k, noise)
            for n in range(count):
                share = _resolved_share(wave, width_m[n]) / taps
                value = share * waves[k, 1] * noise[n]
                out[column[n], 0] += value
                if k < HUE_WAVE_COUNT:
                    out[column[n], 1] += value
                if relief > 0.0:
                    out[column[n], 2] += share * relief * (cosine * slope_x[n] + sine * slope_y[n])
                    out[column[n], 3] += share * relief * (cosine * slope_y[n] - sine * slope_x[n])


EFFECT = Effect("patches, tufts and grain of near ground", judge, facts, "albedo", apply_ground_detail)
