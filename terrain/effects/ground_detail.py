"""Ground detail: procedural texture of the ground near the eye, from patches of a meadow down to tufts.

Gradient noise of several wavelengths varies the ground's albedo between lighter and darker, and between drier and greener. The
noise is a function of the position in metres from the level's anchor, so it stays fixed when the camera moves.

**Antialiasing.** The amplitude of a wave depends on the size of the pixels. It is full if the wavelength spans four pixels, and
zero if it spans two (the Nyquist limit). The size of a pixel is its width at the ground's distance, divided by the cosine between
the line of sight and the ground's normal. Distant ground therefore keeps its plain tint. Maps have no detail, since most are
coarser than all wavelengths.

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
from skugga.terrain.ground.noise import noise_along
from skugga.terrain.scene import Scene
from skugga.terrain.shading import WATER_HEIGHT_TOLERANCE_M, daylight_of, max_slope_sky_factor, night_sky_share
from skugga.terrain.shading_loops import tone_curve, twilight_sky_share
from skugga.terrain.srgb import srgb_of_linear

GROUND_WAVES = (
    (47.0, 0.10), (19.0, 0.09), (7.3, 0.09), (2.9, 0.11), (1.1, 0.15), (0.43, 0.19), (0.17, 0.22), (0.067, 0.22),
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

    It is not needed in maps, without natural ground, and if all ground is too far away or too dark for visible detail.
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
    pixel_width_m = view.pixel_tangent * distance_m * np.maximum(facing, MIN_VIEW_COSINE) / steeper**2
    share = max_albedo_change(float(pixel_width_m.min()))
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
    visible_amplitudes = [amplitude * _resolved_share(wave, pixel_m) for wave, amplitude in GROUND_WAVES]
    return float(
        MAX_GRADIENT_NOISE * (sum(visible_amplitudes) + max(map(abs, HUE_SHIFT_RGB)) * sum(visible_amplitudes[:HUE_WAVE_COUNT]))
    )


def apply_ground_detail(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the albedo (rows, cols, 3) of natural ground in a perspective view by the detail, in place."""
    buffer, scene, view = block.buffer, block.scene, block.view
    if isinstance(view, MapView) or not has_natural_ground(scene):
        return
    run_in_chunks(len(albedo), _apply_detail, albedo, _albedo_changes(buffer, scene, view), np.array(HUE_SHIFT_RGB))


def _cache_key(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    """Return the cache key of ``_albedo_changes``: the buffer's points, the level's ground and the width of a pixel."""
    return buffer.position_frame_m, scene.elevation, view.pixel_tangent


@cached("scene", 128 * MIB, key=_cache_key, max_entries=1)
def _albedo_changes(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> np.ndarray:
    """Return how much lighter and drier the ground is, as relative changes of its albedo, float64 (rows, cols, 2).

    They do not depend on the sun.
    """
    out = np.zeros((*buffer.valid.shape, 2))
    run_in_chunks(
        len(out), _compute_waves, buffer.shading_inputs, scene.world.anchor_from_frame(buffer.frame),
        scene.elevation.water_m + WATER_HEIGHT_TOLERANCE_M,
        view.in_frame(buffer.frame)[0], view.pixel_tangent, _WAVES, out,
    )  # fmt: skip
    return out


@compiled
def _apply_detail(first, last, albedo, detail, hue_shift):
    """Multiply the albedo (rows, cols, 3) of the rows from ``first`` to ``last`` (exclusive) by the detail, in place.

    ``detail`` (rows, cols, 2) is the result of ``_albedo_changes``, and ``hue_shift`` (3,) is ``HUE_SHIFT_RGB``.
    """
    for i in range(first, last):
        for j in range(albedo.shape[1]):
            lighter, drier = detail[i, j, 0], detail[i, j, 1]
            if lighter != 0.0 or drier != 0.0:
                for k in range(3):
                    albedo[i, j, k] *= 1.0 + lighter + hue_shift[k] * drier


@compiled
def _resolved_share(wavelength_m, pixel_m):
    """Return the share of a wave's amplitude that remains after antialiasing, for a wavelength and a width of pixels in metres."""
    return min(max(wavelength_m / (2.0 * max(pixel_m, 1e-9)) - 1.0, 0.0), 1.0)


@compiled
def _compute_waves(first, last, shading_inputs, anchor_from_frame, water_m, eye, pixel, waves, out):
    """Write the detail of the rows from ``first`` to ``last`` (exclusive) to ``out`` (rows, cols, 2), which must hold zeros.

    Up to ``MAX_BATCH_PIXELS`` pixels are computed together. Ground below ``water_m`` metres has no detail. ``anchor_from_frame`` is
    the rotation (3, 3) and the translation (3,) to the anchor's axes. ``eye`` (3,) is the eye in the frame, and ``pixel`` the side
    of a pixel as a tangent. ``waves`` (k, 2) is ``GROUND_WAVES``.
    """
    valid, kind, position, height, normal = shading_inputs
    rotation, origin = anchor_from_frame
    x, y, pixel_width_m = np.empty(MAX_BATCH_PIXELS), np.empty(MAX_BATCH_PIXELS), np.empty(MAX_BATCH_PIXELS)
    column = np.empty(MAX_BATCH_PIXELS, np.int64)
    cols = valid.shape[1]
    for i in range(first, last):
        count = 0
        for j in range(cols):
            if valid[i, j] and kind[i, j] == RELIEF and height[i, j] > water_m:
                p, n = position[i, j], normal[i, j]
                dx, dy, dz = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = abs(n[0] * dx + n[1] * dy + n[2] * dz) / max(distance, 1e-9)
                pixel_width_m[count] = pixel * distance / max(facing, MIN_VIEW_COSINE)
                if waves[0, 0] > 2.0 * pixel_width_m[count]:
                    x[count] = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
                    y[count] = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
                    column[count] = j
                    count += 1
            if count == MAX_BATCH_PIXELS or (count > 0 and j == cols - 1):
                _add_waves(x[:count], y[:count], pixel_width_m[:count], waves, column, out[i])
                count = 0


@internal
def _add_waves(x, y, pixel_width_m, waves, column, out):
    """Add the waves at positions (n,) to the elements ``column`` (n,) of a row ``out`` (cols, 2).

    ``x`` and ``y`` (n,) are metres east and north of the anchor, and are overwritten. ``pixel_width_m`` (n,) are the pixels' widths
    on the ground.
    """
    wave_x, wave_y, noise = np.empty(x.size), np.empty(x.size), np.empty(x.size)
    finest = pixel_width_m.min()
    for k in range(len(waves)):
        wave = waves[k, 0]
        if _resolved_share(wave, finest) <= 0.0:
            break
        for n in range(x.size):
            x[n], y[n] = (
                LATTICE_ROTATION[0] * x[n] - LATTICE_ROTATION[1] * y[n],
                LATTICE_ROTATION[1] * x[n] + LATTICE_ROTATION[0] * y[n],
            )
            wave_x[n], wave_y[n] = x[n] / wave, y[n] / wave
        noise_along(wave_x, wave_y, DETAIL_SEED + k, noise)
        for n in range(x.size):
            value = _resolved_share(wave, pixel_width_m[n]) * waves[k, 1] * noise[n]
            out[column[n], 0] += value
            if k < HUE_WAVE_COUNT:
                out[column[n], 1] += value


EFFECT = Effect("detail of the ground near the eye", judge, facts, "albedo", apply_ground_detail)
