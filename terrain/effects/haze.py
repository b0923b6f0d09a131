"""Distance haze: the air between the eye and a surface absorbs its light and adds light of the colour of the horizon.

**Model.** The meteorological visibility V is the distance at which a black object's contrast with the horizon falls to 2 %. The
extinction of the air is b = ln(50) / V = 3.912 / V (H. Koschmieder 1924, "Theorie der horizontalen Sichtweite"; WMO-No. 8, part I,
chapter 9). The share T = exp(-b d) of a colour c at distance d reaches the eye. The air in front of it adds the share 1 - T of the
horizon's colour h:

    T c + (1 - T) h

Distant surfaces therefore blend into the sky above the horizon without a visible edge. The sky itself does not change: h is the
colour of infinitely deep air in the direction of the surface, warm towards a low sun.

**Density.** A visibility that the level sets applies to air at all heights. The density of clear air falls with height, with a
scale height H of 8 km. Its mean between the lowest ground and the eye is used. For an eye at the height z above that ground, the
mean is (1 - exp(-z / H)) H / z of the density at the ground. Ground is therefore clearly visible from an orbit.

**Colour.** V refers to green light. The air itself scatters at most 13.6e-6 / m of green light, and this part of b is proportional
to the inverse fourth power of the wavelength (J. W. Strutt, Lord Rayleigh 1871). Scattering by dust and droplets hardly depends on
the wavelength. Distant ridges are therefore blue in clear air and grey in mist. A level that sets no visibility has clear air
(``CLEAR_AIR_VISIBILITY_M``).

**Visibility threshold.** The encoder to sRGB rounds linear colours to bins that are 1/4096 wide, 0.8 of a step of 1/255 at black.
Two linear colours x < y look alike if the sRGB codes of all bins that they can fall into differ by at most one of 255. The slope of
the codes decreases with the colour, but the product of x and this slope increases. Therefore

- haze, which moves c towards h by the share s = 1 - T, first becomes visible on black (0 against s h) or on white (1 - s (1 - h)
  against 1);
- the difference between sunlight and shadow is most visible on a white surface without other light. The colours to compare are
  (1 - T) h and (1 - T) h + T g, where g is white in direct sun. Further light only reduces the difference. If the surface fills
  only a part of a pixel and the rest is black, both colours are multiplied by that part.

Each channel is tested separately, with the horizon's minimum or maximum in that channel, whichever makes the difference more
visible.

**Near surfaces.** In sunlit air haze shows on black from 4.5 m on. Few surfaces are black: sky light alone makes most of them so
bright that haze in front of them shows from some hundred metres on. Where the farthest surface is so near that haze changes even
black and white by at most ``MAX_NEAR_STEPS``, as in a room, the predicate computes the change of each point of the coarse view: of
the colour that sky light alone gives it, and of white. Haze is not needed if at most ``MAX_CHANGED_SAMPLE_SHARE`` of the points
change by more than a step. Then it changes at most ``MAX_CHANGED_PIXEL_SHARE`` of all pixels by more than a step, and none by more
than ``MAX_NEAR_STEPS``.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.tree_instances import TreeInstances, tree_instances_in_perspective
from skugga.terrain.gbuffer.view_geometry import solid_vertices
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame, geodetic
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of, encode_srgb, shade
from skugga.terrain.shading_loops import tone_curve
from skugga.terrain.sky import (
    CLEAR_AIR_VISIBILITY_M,
    VISIBILITY_CONTRAST,
    horizon_colors,
    horizontal_sun_direction,
    sky_colors,
    sky_of,
    transmittances,
)
from skugga.terrain.srgb import srgb_of_linear

AIR_SCALE_HEIGHT_M = 8000.0
"""Height difference over which the density of air falls to 1/e."""

RAYLEIGH_SCATTERING_PER_M = (5.802e-6, 13.558e-6, 33.1e-6)
"""Scattering of red, green and blue light by air at sea level (E. Bruneton and F. Neyret 2008)."""

SRGB_ENCODER_BIN_WIDTH = 1.0 / 4096.0
"""Width of the bins of linear colour in ``skugga.terrain.shading.encode_srgb``."""

TESTED_LIGHT_SHARES = np.geomspace(1e-5, 1.0, 2048)
"""Shares of light that the tests of visibility try, each 0.6 % larger than the one before."""

SAMPLED_PIXEL_SHARES = (1.0, 4 / 5, 2 / 3, 3 / 5, 2 / 5, 1 / 3, 1 / 5)
"""Possible shares of a pixel that a surface fills, by the pixel's samples (``skugga.terrain.gbuffer.antialias``)."""


MAX_NEAR_STEPS = 5.0
"""Largest invisible change of single pixels, in steps of 255: in clear air by day that of black at some 23 m."""

MAX_CHANGED_SAMPLE_SHARE, MAX_CHANGED_PIXEL_SHARE = 0.0075, 0.01
"""Largest invisible shares of points of the coarse view, and of pixels, that change by more than one step of 255."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view, and something in view is far enough away for the air to show.

    Left out: maps, which have no viewing distance; all visible surfaces are near, as in a room: at most 1 % of the pixels change by
    more than a step of 255, and none by more than 5; data (masks, visibilities), which do not depend on the air.
    """
    if descriptor.view_kind == "map":
        return Verdict(False, "a map view has no viewing distance, so no haze")
    facts = descriptor.facts["haze"]
    visibility_m, farthest_m, shows_from_m = (facts.get(key) for key in ("visibility_m", "farthest_m", "shows_from_m"))
    if visibility_m is None:
        return Verdict(False, "the descriptor has no visibility")
    assert isinstance(visibility_m, float) and isinstance(farthest_m, float) and isinstance(shows_from_m, float)
    if farthest_m <= shows_from_m:
        reason = f"no visible surface is farther than {_length_text(farthest_m)}; at {_length_text(visibility_m)} of visibility"
        return Verdict(False, f"{reason} haze shows from {_length_text(shows_from_m)} on")
    changed_share, max_steps = numeric_fact(facts.get("changed_share")), numeric_fact(facts.get("max_steps"))
    if changed_share is not None and changed_share <= MAX_CHANGED_SAMPLE_SHARE and (max_steps or 0.0) <= MAX_NEAR_STEPS:
        text = f"no visible surface is farther than {_length_text(farthest_m)}: haze changes {100.0 * changed_share:.2g} % of the "
        return Verdict(False, f"{text}pixels by more than one step of 255, and none by more than {max_steps:.1f}")
    share = 100.0 * -np.expm1(-farthest_m * green_extinction_per_m(visibility_m))
    return Verdict(
        True,
        f"at {_length_text(visibility_m)} of visibility, haze makes up {share:.2f} % of what lies {_length_text(farthest_m)} away",
    )


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of haze, all in metres. Maps have the first one only.

    - ``visibility_m``: meteorological visibility.
    - ``shows_from_m``: distance beyond which haze can be visible.
    - ``farthest_m``: distance of the farthest point of the coarse view. If haze is not visible there, it is an upper bound of the
      distance of all visible surfaces, including those that the coarse view may have missed.
    - ``max_steps``: upper bound of the change of any pixel, in steps of 255; ``None`` beyond ``MAX_NEAR_STEPS``.
    - ``changed_share``: share of the points of the coarse view that haze changes by more than a step; ``None`` like ``max_steps``.
    """
    if coarse_view is None:
        return {"visibility_m": scene.loaded.level.weather.visibility}
    visibility_m = visibility_m_of(scene, view)
    shows_from_m = _visible_haze_distance_m(scene, visibility_m)
    farthest_m = float(coarse_view.distance_m.max(initial=0.0))
    if farthest_m <= shows_from_m and isinstance(view, PerspectiveView):
        farthest_m = max(farthest_m, max_visible_distance_m(scene, view, coarse_view))
    result: dict[str, Fact] = {"visibility_m": visibility_m, "farthest_m": farthest_m, "shows_from_m": shows_from_m}
    if farthest_m <= shows_from_m or not isinstance(view, PerspectiveView):
        return result
    if _max_steps(scene, visibility_m, farthest_m) <= MAX_NEAR_STEPS:
        farthest_m = max(farthest_m, max_visible_distance_m(scene, view, coarse_view))
        max_steps = _max_steps(scene, visibility_m, farthest_m)
        if max_steps <= MAX_NEAR_STEPS:
            changed_share = _changed_share(scene, coarse_view, visibility_m)
            result |= {"farthest_m": farthest_m, "max_steps": max_steps, "changed_share": changed_share}
    return result


def _max_steps(scene: Scene, visibility_m: float, distance_m: float) -> float:
    """Return an upper bound of the change of any colour by haze at a distance, in steps of 255: that of black or of white."""
    share, horizon = -np.expm1(-distance_m * rgb_extinctions_per_m(visibility_m)), horizon_colors(scene)
    on_black = _max_code_steps(np.zeros(3), share * horizon.max(axis=0))
    on_white = _max_code_steps(1.0 - share * (1.0 - horizon.min(axis=0)), np.ones(3))
    return float(max(on_black.max(), on_white.max()))


def _changed_share(scene: Scene, coarse_view: CoarseView, visibility_m: float) -> float:
    """Return the share of the points of a coarse view that haze may change by more than one step of 255.

    A point's colour lies between that in sky light alone and white. The change is largest at one of these ends, since haze moves
    all colours towards that of the horizon. With relief, which may hide the sky, with trees, which the coarse view does not show,
    and with imagery, the darker end is black.
    """
    buffer, horizon = coarse_view.buffer, horizon_colors(scene)
    if not buffer.valid.any():
        return 0.0
    color = shade(buffer, scene, np.zeros(buffer.valid.shape, np.float32))[buffer.valid].astype(np.float64)
    low, high = scene.height_range_m
    if high > low or "forest" in scene.objects.caster_kinds or scene.loaded.level.terrain.imagery is not None:
        color[:] = 0.0
    share = -np.expm1(-coarse_view.distance_m[:, None] * rgb_extinctions_per_m(visibility_m))
    codes = encode_srgb(color).astype(np.int32)
    changes = [np.abs(encode_srgb(color + share * (end - color)) - codes) for end in (horizon.min(axis=0), horizon.max(axis=0))]
    white_steps = _max_code_steps(1.0 - share * (1.0 - horizon.min(axis=0)), np.ones_like(share))
    is_changed = (np.maximum(*changes) > 1).any(axis=1) | (white_steps >= 1.0).any(axis=1)
    return float(is_changed.sum() / buffer.valid.size)


def visibility_m_of(scene: Scene, view: MapView | PerspectiveView) -> float:
    """Return the meteorological visibility in a view, metres. Precipitation reduces it."""
    falling = scene.loaded.level.weather.precipitation_extinction_per_m
    visibility_m = _air_visibility_m(scene, view)
    return visibility_m if falling == 0.0 else 1.0 / (1.0 / visibility_m - falling / float(np.log(VISIBILITY_CONTRAST)))


def _air_visibility_m(scene: Scene, view: MapView | PerspectiveView) -> float:
    """Return the meteorological visibility of the air alone in a view, metres."""
    visibility_m = scene.loaded.level.weather.visibility
    if visibility_m is not None:
        return visibility_m
    if isinstance(view, MapView):
        return CLEAR_AIR_VISIBILITY_M
    height_m = float(view.eye_earth_m[2] if scene.world.is_flat else geodetic(view.eye_earth_m, scene.world.ellipsoid)[2])
    up = max(height_m - scene.height_range_m[0], 1e-3) / AIR_SCALE_HEIGHT_M
    return CLEAR_AIR_VISIBILITY_M * up / -float(np.expm1(-up))


def green_extinction_per_m(visibility_m: float) -> float:
    """Return the extinction coefficient of green light, per metre, by Koschmieder's formula."""
    return float(-np.log(VISIBILITY_CONTRAST) / visibility_m)


def rgb_extinctions_per_m(visibility_m: float) -> np.ndarray:
    """Return the extinction coefficients of red, green and blue light (3,), per metre."""
    green, air = green_extinction_per_m(visibility_m), np.array(RAYLEIGH_SCATTERING_PER_M)
    return green + min(green, air[1]) * (air / air[1] - 1.0)


def max_visible_distance_m(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> float:
    """Return an upper bound of the distance of all visible surfaces, metres; 0 if the view shows only sky.

    It is the distance of the farthest ground, mesh or tree that intersects the view frustum, hidden or not.
    """
    frame, ground = coarse_view.buffer.frame, coarse_view.buffer.ground
    eye, _, _, inward = _frustum(view, frame)
    farthest = [farthest_mesh_m(scene, view, frame)]
    if ground is not None:
        farthest.append(_max_clipped_distance(ground.position_frame_m, ground.triangles, eye, inward))
    trees, in_view = trees_in_view(scene, view, frame)
    if trees is not None:
        size = np.hypot(np.sqrt(2.0) * trees.quad_sizes_m[in_view, :2].max(axis=1), trees.quad_sizes_m[in_view, 2])
        farthest.append(np.max(np.linalg.norm(trees.base_frame_m[in_view] - eye, axis=1) + size, initial=0.0))
    return float(max(farthest, default=0.0))


def trees_in_view(scene: Scene, view: PerspectiveView, frame: LocalFrame) -> tuple[TreeInstances | None, np.ndarray]:
    """Return the trees in all directions from the eye, and the indices (n,) of the trees that may intersect the view frustum.

    The trees are ``None`` in a level without trees.
    """
    trees = tree_instances_in_perspective(scene.objects, frame, tuple(view.eye_earth_m), view.focal_px)
    if trees is None:
        return None, np.zeros(0, np.int64)
    eye, camera_from_frame, tangents, _ = _frustum(view, frame)
    return trees, trees.in_frustum(eye, camera_from_frame, tangents)


def farthest_mesh_m(scene: Scene, view: PerspectiveView, frame: LocalFrame) -> float:
    """Return the distance of the farthest mesh in the view frustum, metres; 0 if there is none."""
    solids, vertices = scene.objects.solids, solid_vertices(scene.objects, frame)
    if solids is None or vertices is None:
        return 0.0
    eye, _, _, inward = _frustum(view, frame)
    return float(_max_clipped_distance(vertices, solids.triangles, eye, inward))


def _frustum(view: PerspectiveView, frame: LocalFrame) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the view frustum in a frame.

    The result holds the eye (3,), the rotation (3, 3) to the camera's axes, tangents (2, 2) and planes (5, 3). The tangents are the
    minimum and maximum of x / z and of y / z in camera axes. The planes are given by their inward normals; all contain the eye. The
    frustum is one pixel wider on each side than the view, since rasterisers round corners.
    """
    eye, camera_from_frame = view.in_frame(frame)
    first, count = np.array([view.col0, view.row0]), np.array([view.cols, view.rows])
    tangents = np.stack([first - view.step_px, first + count * view.step_px], axis=1) / view.focal_px
    (left, right), (top, bottom) = tangents
    inward = np.array([[0, 0, 1], [1, 0, -left], [-1, 0, right], [0, 1, -top], [0, -1, bottom]]) @ camera_from_frame
    return eye, camera_from_frame, tangents, inward


def shadow_hiding_distance_m(scene: Scene, view: PerspectiveView) -> float:
    """Return the distance beyond which haze hides the difference between sunlight and shadow, metres.

    Beyond it no channel of a pixel in shadow differs from the same pixel in sunlight by more than one of 255. The distance is 0 if
    the sun is down in the whole level.
    """
    if not scene.sun_is_up:
        return 0.0
    darkest = horizon_colors(scene).min(axis=0)
    shares = [_max_hiding_transmittance((dark,), (white,)) for dark, white in zip(darkest, _sunlit_white(scene), strict=True)]
    return float((-np.log(shares) / rgb_extinctions_per_m(visibility_m_of(scene, view))).max())


def _sunlit_white(scene: Scene) -> np.ndarray:
    """Return an upper bound of the linear display colour (3,) of direct sunlight: a white surface, or 1 for glints on water."""
    if scene.loaded.level.water is not None:
        return np.ones(3)
    sunlight = daylight_of(scene).sun_irradiance
    return np.array([tone_curve(channel) for channel in sunlight])


def _visible_haze_distance_m(scene: Scene, visibility_m: float) -> float:
    """Return the distance up to which haze changes no pixel of any colour by more than one of 255, metres."""
    horizon = horizon_colors(scene)
    shares = [
        _max_invisible_share((dark,), (bright,)) for dark, bright in zip(horizon.min(axis=0), horizon.max(axis=0), strict=True)
    ]
    return float((-np.log1p(-np.array(shares)) / rgb_extinctions_per_m(visibility_m)).min())


@cached("process", MIB)
def _max_hiding_transmittance(horizon: tuple[float, ...], white: tuple[float, ...]) -> float:
    """Return the maximum transmittance of the air through which sunlight and shadow still look alike.

    ``horizon`` and ``white`` are the linear colours of the horizon and of a white surface in sunlight.
    """
    air = (1.0 - TESTED_LIGHT_SHARES)[:, None] * np.array(horizon)
    lit = air + TESTED_LIGHT_SHARES[:, None] * np.array(white)
    is_indistinguishable = np.logical_and.reduce(
        [_are_indistinguishable(covered_share * air, covered_share * lit) for covered_share in SAMPLED_PIXEL_SHARES]
    )
    return float(TESTED_LIGHT_SHARES[is_indistinguishable].max(initial=TESTED_LIGHT_SHARES[0]))


@cached("process", MIB)
def _max_invisible_share(darkest: tuple[float, ...], brightest: tuple[float, ...]) -> float:
    """Return the maximum share of the horizon's light that haze can add to any colour without a visible change.

    Black and white are tested. The test on black uses the brightest colour of the horizon, the test on white the darkest.
    """
    black = np.zeros((1, len(darkest)))
    is_indistinguishable = _are_indistinguishable(black, TESTED_LIGHT_SHARES[:, None] * brightest)
    is_indistinguishable &= _are_indistinguishable(1.0 - TESTED_LIGHT_SHARES[:, None] * (1.0 - np.array(darkest)), black + 1.0)
    return float(TESTED_LIGHT_SHARES[is_indistinguishable].max(initial=TESTED_LIGHT_SHARES[0]))


def _are_indistinguishable(dark: np.ndarray, bright: np.ndarray) -> np.ndarray:
    """Return whether pairs of linear colours (n, k) differ by at most one sRGB code, wherever the encoder's bins lie, bool (n,)."""
    return np.all(_max_code_steps(dark, bright) < 1.0, axis=1)


def _max_code_steps(dark: np.ndarray, bright: np.ndarray) -> np.ndarray:
    """Return the difference in sRGB between linear colours ``dark`` <= ``bright``, in steps of 255, wherever the bins lie."""
    lowest = np.maximum(dark - 0.5 * SRGB_ENCODER_BIN_WIDTH, 0.5 * SRGB_ENCODER_BIN_WIDTH)
    bins = np.ceil((bright - dark) / SRGB_ENCODER_BIN_WIDTH)
    return 255.0 * (srgb_of_linear(lowest + bins * SRGB_ENCODER_BIN_WIDTH) - srgb_of_linear(lowest))


def _length_text(length_m: float) -> str:
    """Return a length as text with one decimal, in kilometres from 1000 m on."""
    return f"{length_m / 1000.0:.1f} km" if length_m >= 1000.0 else f"{length_m:.1f} m"


def apply_haze(color: np.ndarray, block: ShadingBlock) -> None:
    """Blend the visible surfaces with the colour of the horizon. A map has no viewing distance and does not change."""
    scene, view, frame = block.scene, block.view, block.buffer.frame
    if isinstance(view, MapView):
        return
    eye, _ = view.in_frame(frame)
    up = eye - scene.world.up_origin(frame)
    up /= np.linalg.norm(up)
    to_sun_horizontal = np.zeros(3) if scene.sun is None else horizontal_sun_direction(scene.sun.in_frame(frame), up)
    buffer, air = block.buffer, rgb_extinctions_per_m(visibility_m_of(scene, view))
    run_in_chunks(
        len(color), _apply_haze_rows, color, buffer.valid, buffer.position_frame_m, eye, air, up, to_sun_horizontal, sky_of(scene)
    )


@compiled
def _apply_haze_rows(first, last, color, valid, position, eye, rgb_extinction_per_m, up, to_sun_horizontal, sky):
    """Apply haze to the colours (rows, cols, 3) of the rows from ``first`` to ``last`` (exclusive), in place.

    ``rgb_extinction_per_m`` holds the coefficients (3,) of the channels. The inner loops compile to vector instructions. ``eye``,
    ``up`` and ``to_sun_horizontal`` (3,) are the eye, and unit vectors up and towards the sun's azimuth, in the frame. ``sky`` is a
    ``Sky``.
    """
    cols = valid.shape[1]
    distance, azimuth_cosine, transmittance = np.empty(cols), np.empty(cols), np.empty(cols)
    at_horizon, horizon_color = np.zeros(cols), np.empty((3, cols))
    for i in range(first, last):
        p = position[i]
        for j in range(cols):
            x, y, z = p[j, 0] - eye[0], p[j, 1] - eye[1], p[j, 2] - eye[2]
            square, rise = x * x + y * y + z * z, x * up[0] + y * up[1] + z * up[2]
            horizontal_distance = np.sqrt(max(square - rise * rise, 1e-12))
            azimuth_cosine[j] = min(
                max((x * to_sun_horizontal[0] + y * to_sun_horizontal[1] + z * to_sun_horizontal[2]) / horizontal_distance, -1.0),
                1.0,
            )
            distance[j] = np.sqrt(square)
        sky_colors(sky, at_horizon, azimuth_cosine, horizon_color)
        for k in range(3):
            transmittances(rgb_extinction_per_m[k], distance, transmittance)
            horizon, channel = horizon_color[k], color[i, :, k]
            for j in range(cols):
                value = horizon[j] + (channel[j] - horizon[j]) * transmittance[j]
                channel[j] = value if valid[i, j] else channel[j]


@compiled
def _max_clipped_distance(position, triangles, eye, inward):
    """Return the maximum distance from the eye of triangles clipped by planes through the eye with normals ``inward`` (m, 3)."""
    squared_distance, outside = np.zeros(len(position)), np.zeros(len(position), np.uint8)
    for n in range(len(position)):
        x, y, z = position[n, 0] - eye[0], position[n, 1] - eye[1], position[n, 2] - eye[2]
        squared_distance[n] = x * x + y * y + z * z
        for k in range(len(inward)):
            if inward[k, 0] * x + inward[k, 1] * y + inward[k, 2] * z < 0.0:
                outside[n] |= 1 << k
    farthest, polygon = 0.0, np.empty((2, 3 + len(inward), 3))
    for n in range(len(triangles)):
        a, b, c = triangles[n, 0], triangles[n, 1], triangles[n, 2]
        if outside[a] & outside[b] & outside[c] or max(squared_distance[a], squared_distance[b], squared_distance[c]) <= farthest:
            continue
        if not outside[a] | outside[b] | outside[c]:
            farthest = max(squared_distance[a], squared_distance[b], squared_distance[c])
            continue
        for k in range(3):
            for m in range(3):
                polygon[0, k, m] = position[triangles[n, k], m] - eye[m]
        farthest = max(farthest, _farthest_corner(polygon, inward))
    return np.sqrt(farthest)


@internal
def _farthest_corner(polygon, inward):
    """Return the maximum squared distance of a triangle clipped by planes (I. Sutherland and G. Hodgman 1974).

    ``polygon`` is a work array for two polygons. The first one contains the triangle.
    """
    count = 3
    for k in range(len(inward)):
        source, clipped, clipped_count = polygon[k % 2], polygon[(k + 1) % 2], 0
        for n in range(count):
            p, q = source[n], source[(n + 1) % count]
            at_p = inward[k, 0] * p[0] + inward[k, 1] * p[1] + inward[k, 2] * p[2]
            at_q = inward[k, 0] * q[0] + inward[k, 1] * q[1] + inward[k, 2] * q[2]
            if at_p >= 0.0:
                clipped[clipped_count] = p
                clipped_count += 1
            if (at_p >= 0.0) != (at_q >= 0.0):
                share = at_p / (at_p - at_q)
                for m in range(3):
                    clipped[clipped_count, m] = p[m] + share * (q[m] - p[m])
                clipped_count += 1
        count = clipped_count
    farthest = 0.0
    for n in range(count):
        p = polygon[len(inward) % 2, n]
        farthest = max(farthest, p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    return farthest


EFFECT = Effect("air in front of distant surfaces", judge, facts, stage="color", apply=apply_haze)
