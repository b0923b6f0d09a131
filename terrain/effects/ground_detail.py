"""Ground detail: what a tint by height leaves out and an eye near the ground sees, patches of a meadow down to tufts.

Gradient noise of several wavelengths makes the ground's albedo lighter and darker, and drier and greener. It goes by the place on
the ground in metres from the level's anchor, so that it stays where it is when the camera moves.

**No aliasing.** A wavelength is drawn as far as pixels can show it: all of it where it spans four of them, none where it spans
two (H. Nyquist's limit). How much ground a pixel covers is its width at that distance, drawn out by the angle under which the
ground is seen. So far ground keeps its tint, and so do maps, whose scales are mostly coarser than all of this: they go without.

**What shows.** A linear colour c that is multiplied by 1 + s moves by s c / (dc/dk) codes k; sRGB's slope makes that 2.4 s / 255
of a code at most, on white. Below ``SHOWS`` nothing moves by more than a step.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, in_shares, internal
from skugga.terrain.effects.effect import CHANNEL_STEP, Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, number
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.noise import noise_along
from skugga.terrain.scene import Scene
from skugga.terrain.shading import SHORE_M

GROUND_WAVES = (
    (47.0, 0.10), (19.0, 0.09), (7.3, 0.09), (2.9, 0.11), (1.1, 0.15), (0.43, 0.19), (0.17, 0.22), (0.067, 0.22),
)  # fmt: skip
"""Wavelengths in metres, and how much of the albedo each takes away or adds at most."""

HUE = (0.55, 0.0, -0.85)
"""How the two longest waves move red, green and blue besides, as a share of what they move all: dry where it is light."""

HUE_WAVES = 3
"""The waves that change the hue."""

PAVED = 0.45
"""Share of all that on level ground without tints, which is a floor or a square."""

DETAIL_SEED = 71

MOST_NOISE = 0.9
"""More than gradient noise ever is."""

TURN = (0.8, 0.6)
"""Cosine and sine by which each wave's lattice is turned against the one before: their rows never lie on each other."""

GRAZING_COSINE = 0.02
"""Cosine between the view and the ground's normal from which on it counts as this."""

SHOWS = CHANNEL_STEP / 0.45
"""Share of the albedo that changes no colour by more than one of 255."""

WAVE_RUN = 256
"""Pixels that are computed together."""

_WAVES = np.array(GROUND_WAVES)


def called_for(descriptor: Descriptor) -> Verdict:
    """Left out in maps, on draped imagery, and where all ground is too far away for any of it to show."""
    facts = descriptor.facts["ground_detail"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows the ground's tints alone")
    if facts["draped"]:
        return Verdict(False, "imagery is draped over the ground")
    nearest_m, share = number(facts["nearest_m"]), number(facts["share"])
    if nearest_m is None or share is None:
        return Verdict(False, "no ground is in view")
    if share <= SHOWS:
        return Verdict(False, f"the nearest ground is {nearest_m:.0f} m away, where pixels are as wide as its patches")
    return Verdict(True, f"ground {nearest_m:.1f} m away shows patches and tufts: up to {100.0 * share:.0f} % of its albedo")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Whether imagery is ``draped`` over the ground, how near the ``nearest_m`` of it is, and the ``share`` of its albedo that may
    change there.
    """
    draped = scene.loaded.level.terrain.imagery is not None
    if coarse_view is None or isinstance(view, MapView):
        return {"draped": draped, "nearest_m": None, "share": None}
    buffer = coarse_view.buffer
    ground = buffer.kind[buffer.there] == RELIEF
    away_m = coarse_view.away_m[ground]
    if not len(away_m):
        return {"draped": draped, "nearest_m": None, "share": None}
    to_eye = (coarse_view.eye_frame_m - coarse_view.points_frame_m[ground]) / np.maximum(away_m, 1e-9)[:, None]
    facing = np.abs(np.einsum("nk,nk->n", buffer.shading_normal_frame[buffer.there][ground], to_eye))
    # Up to the next point a plane lies nearer, and is seen more from above: at the distance h / c under the cosine c.
    steeper = np.clip(facing + coarse_view.spacing, GRAZING_COSINE, 1.0)
    wide_m = view.pixel * away_m * np.maximum(facing, GRAZING_COSINE) / steeper**2
    return {"draped": draped, "nearest_m": float(away_m.min()), "share": largest_share(float(wide_m.min()))}


def largest_share(pixel_m: float) -> float:
    """The largest share of its albedo that detail adds to ground, or takes away, where a pixel covers so much of it."""
    shown = [amplitude * _shown(wave, pixel_m) for wave, amplitude in GROUND_WAVES]
    return float(MOST_NOISE * (sum(shown) + max(map(abs, HUE)) * sum(shown[:HUE_WAVES])))


def apply_ground_detail(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Vary the albedo of bare ground."""
    buffer, scene, view = block.buffer, block.scene, block.view
    if isinstance(view, MapView) or scene.loaded.level.terrain.imagery is not None:
        return
    low, high = scene.height_range_m
    in_shares(len(albedo), _vary, albedo, _detail(buffer, scene, view), 1.0 if high > low else PAVED, np.array(HUE))


def _made_from(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> tuple[object, ...]:
    return buffer.position_frame_m, scene.elevation, view.pixel


@cached("scene", 128 * MIB, key=_made_from, most=1)
def _detail(buffer: GeometryBuffer, scene: Scene, view: PerspectiveView) -> np.ndarray:
    """How much lighter and drier (rows, cols, 2) float64 the ground is: the same under any sun."""
    out = np.zeros((*buffer.there.shape, 2))
    in_shares(
        len(out), _waves_on, buffer.shown, scene.world.anchor_from_frame(buffer.frame), scene.elevation.water_m + SHORE_M,
        view.in_frame(buffer.frame)[0], view.pixel, _WAVES, out,
    )  # fmt: skip
    return out


@compiled
def _vary(first, last, albedo, detail, share, hue):
    for i in range(first, last):
        for j in range(albedo.shape[1]):
            lighter, drier = detail[i, j, 0], detail[i, j, 1]
            if lighter != 0.0 or drier != 0.0:
                for k in range(3):
                    albedo[i, j, k] *= 1.0 + share * (lighter + hue[k] * drier)


@compiled
def _shown(wave_m, pixel_m):
    """Share of a wave that pixels of some width show."""
    return min(max(wave_m / (2.0 * max(pixel_m, 1e-9)) - 1.0, 0.0), 1.0)


@compiled
def _waves_on(first, last, shown, anchor_from_frame, water_m, eye, pixel, waves, out):
    """In runs of pixels, by ``noise_along``."""
    there, kind, position, height, normal = shown
    rotation, origin = anchor_from_frame
    x, y, wide_m = np.empty(WAVE_RUN), np.empty(WAVE_RUN), np.empty(WAVE_RUN)
    column = np.empty(WAVE_RUN, np.int64)
    cols = there.shape[1]
    for i in range(first, last):
        count = 0
        for j in range(cols):
            if there[i, j] and kind[i, j] == RELIEF and height[i, j] > water_m:
                p, n = position[i, j], normal[i, j]
                dx, dy, dz = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                away = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = abs(n[0] * dx + n[1] * dy + n[2] * dz) / max(away, 1e-9)
                wide_m[count] = pixel * away / max(facing, GRAZING_COSINE)
                if waves[0, 0] > 2.0 * wide_m[count]:
                    x[count] = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
                    y[count] = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
                    column[count] = j
                    count += 1
            if count == WAVE_RUN or (count > 0 and j == cols - 1):
                _add_waves(x[:count], y[:count], wide_m[:count], waves, column, out[i])
                count = 0


@internal
def _add_waves(x, y, wide_m, waves, column, out):
    """Add the waves at places (n,) of a row's columns; the places are changed."""
    along, across, noise = np.empty(x.size), np.empty(x.size), np.empty(x.size)
    finest = wide_m.min()
    for k in range(len(waves)):
        wave = waves[k, 0]
        if _shown(wave, finest) <= 0.0:
            break
        for n in range(x.size):
            x[n], y[n] = TURN[0] * x[n] - TURN[1] * y[n], TURN[1] * x[n] + TURN[0] * y[n]
            along[n], across[n] = x[n] / wave, y[n] / wave
        noise_along(along, across, DETAIL_SEED + k, noise)
        for n in range(x.size):
            value = _shown(wave, wide_m[n]) * waves[k, 1] * noise[n]
            out[column[n], 0] += value
            if k < HUE_WAVES:
                out[column[n], 1] += value


EFFECT = Effect("detail of the ground near the eye", called_for, facts, "albedo", apply_ground_detail)
