"""The loops of shading: how light falls on slopes, what a tint makes of it, and what of that a screen shows.

All that is compiled together is in this one file, since what is kept of a compiled loop is made anew when its own file changes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.interpolation_loops import smoothstep_of
from skugga.terrain.style import NO_SLOPE_LIMIT, TINT_COUNT, TINT_LOW_M, TINT_STEP_M

SHOULDER, SHOULDER_LEFT = 0.6, 0.4
"""Linear colour from which on brighter light is shown darker than it is, and what is left from there to white."""

LEAST_SKY = 0.3
"""Least factor of the sky's light on a slope that is turned away from the sky's bright side."""

LEAST_ACROSS = 0.15
"""Least cosine of the sun's altitude by which its direction on the horizon is told: near the zenith it has none."""

LEAST_GRAZING = 1e-9
"""Cosine to the sun from which on light is told from none."""

AIR = (0.66, 0.74, 0.84)
"""Linear colour of the veil of air over low ground, by day."""

HIGH_SUN_DEG = 6.01
"""From here on the sun's altitude changes neither direct light nor the sky's (``shade_rows``, ``dusk_of``), and a hundredth of a
degree before: it is looked at in some places of a map alone.
"""

HIGH_SUN_SINE = float(np.sin(np.radians(HIGH_SUN_DEG)))


class LightHere(NamedTuple):
    """A day's light, the direction (3,) to its sun in a frame, and the night's share of the sky's."""

    has_sun: bool
    to_sun_frame: np.ndarray
    sun: np.ndarray
    sky: np.ndarray
    night: float


class Tints(NamedTuple):
    """The ground's linear colours and their luminances (m, 4, n), at even steps of the latitude's sine from -1 to 1 (m = 1: one for
    all latitudes), and by height; and from which height on (m - 1,) a row differs from the next one.
    """

    table: np.ndarray
    differs_from: np.ndarray


class Look(NamedTuple):
    """What a style makes of ground and light, as the loops take it: tints, the direction (3,) of the earth's axis in a frame,
    greying and direction of the sky's light, the slopes' factor and limit, the veil's share (n,) by height, and a factor of
    foliage's albedo.
    """

    tints: Tints
    north_frame: np.ndarray
    sky_greying: float
    sky_towards_sun: float
    terminator: float
    slope_exaggeration: float
    slope_limit: float
    veil: np.ndarray
    foliage: float


@compiled
def dusk_of(sine):
    """Share of the day's sky light for the sine of the sun's altitude: all from 6 degrees on, none below -12 (nautical dusk)."""
    if sine > HIGH_SUN_SINE:
        return 1.0
    altitude = np.degrees(np.arcsin(min(max(sine, -1.0), 1.0)))
    return smoothstep_of((altitude + 12.0) / 18.0)


@compiled
def shoulder(linear):
    """Display colour of linear light: itself up to ``SHOULDER``, from there on ever less, so that slopes that face a low sun keep
    their tint.
    """
    return linear if linear <= SHOULDER else 1.0 - SHOULDER_LEFT**2 / (linear + SHOULDER_LEFT - SHOULDER)


@compiled
def luminance_of(red, green, blue):
    """Luminance of linear sRGB (ITU-R BT.709)."""
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@compiled
def _on_slope(facing, upright, sine, exaggeration, limit):
    """A slope's cosines to the sun and to the zenith as shading takes them: its slope t made t' = a t / sqrt(1 + (a t / limit)**2).

    Of a normal n, ``facing`` is n.s and ``upright`` n.u, with s the sun's direction and u up; ``sine`` is s.u.
    """
    if upright <= 0.0:
        return facing, upright
    flat = np.sqrt(max(1.0 - upright * upright, 0.0))
    slope = exaggeration * flat / upright
    steeper = exaggeration / np.sqrt(1.0 + slope * slope / (limit * limit))
    slope = steeper * flat / upright
    drawn = 1.0 / np.sqrt(1.0 + slope * slope)
    return (facing - sine * upright) * steeper * drawn / upright + sine * drawn, drawn


@compiled
def _sky_on_slope(facing, upright, sine, towards):
    """Factor of the sky's light on a slope, if the share ``towards`` of it comes from 45 degrees over the sun's azimuth: 1 on level
    ground.
    """
    across = (facing - sine * upright) / max(np.sqrt(max(1.0 - sine * sine, 0.0)), LEAST_ACROSS)
    return max(1.0 + towards * (across + upright - 1.0), LEAST_SKY)


@compiled
def _towards_sun(facing, sine, terminator):
    """How much direct light falls on a slope: Lambert's cosine, and less where that is below the share ``terminator`` of what
    level ground has. Facets of a raster that are turned away, beside others that are not, would be seen as dark squares on slopes
    that the light grazes.
    """
    cosine = max(facing, 0.0)
    share = min(cosine / max(terminator * sine, LEAST_GRAZING), 1.0)
    return cosine * share * share * (3.0 - 2.0 * share)


@internal
def _direct_at(sine):
    """Direct light fades in over the first degree of the sun's altitude at a place."""
    if sine > HIGH_SUN_SINE:
        return 1.0
    return min(max(np.degrees(np.arcsin(min(max(sine, -1.0), 1.0))), 0.0), 1.0)


@compiled
def slopes_sky(first, last, there, normal, position, centre, out):
    """Some rows of the share of the sky that slopes leave by themselves, by normals, places in a frame, and the Earth's centre."""
    for i in range(first, last):
        for j in range(there.shape[1]):
            if there[i, j]:
                n, p = normal[i, j], position[i, j]
                x, y, z = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
                out[i, j] = 0.5 + 0.5 * (n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)


@compiled
def encode_rows(first, last, linear, table, out):
    """A part of linear display colours as sRGB, looked up in a table of even steps from 0 to 1."""
    for n in range(first, last):
        out[n] = table[min(np.int32(linear[n] * table.size), table.size - 1)]


@compiled
def shade_rows(first, last, shown, look, light_here, centre, glow, albedo, sunlight, skylight, lamplight, out):
    """Some rows of linear display colour of what a buffer has ``shown``; ``glow`` is the leaves' share of light (``LEAF_GLOW``)."""
    # What is None is decided when this is compiled: each variant holds the code of what it is given alone.
    there, kind, position, height, normal = shown
    tints, north, greying, towards, terminator, exaggeration, limit, veils, foliage = look
    has_sun, to_sun, sun, sky, night = light_here
    as_it_is = exaggeration == 1.0 and limit >= NO_SLOPE_LIMIT
    for i in range(first, last):
        for j in range(there.shape[1]):
            if not there[i, j]:
                continue
            n, p = normal[i, j], position[i, j]
            leaf = glow if kind[i, j] == FOREST else 0.0
            ux, uy, uz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            seen = 0.5 + 0.5 * (n[0] * ux + n[1] * uy + n[2] * uz) / length if skylight is None else skylight[i, j]
            # Rounded as that of bare ground is, whose pictures are the same.
            ux, uy, uz = _rounded(ux / length), _rounded(uy / length), _rounded(uz / length)
            sine = to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz if has_sun else -1.0
            upright = n[0] * ux + n[1] * uy + n[2] * uz
            facing = n[0] * to_sun[0] + n[1] * to_sun[1] + n[2] * to_sun[2]
            if has_sun:
                if kind[i, j] == RELIEF and not as_it_is:
                    facing, upright = _on_slope(facing, upright, sine, exaggeration, limit)
                seen = seen * _sky_on_slope(facing, upright, sine, towards)
                if kind[i, j] == RELIEF:
                    facing = _towards_sun(facing, sine, terminator)
            sky_here = night + (1.0 - night) * dusk_of(sine)
            direct = (leaf + (1.0 - leaf) * max(facing, 0.0)) * (_direct_at(sine) * sunlight[i, j])
            at, beyond = _place_in_tint(height[i, j])
            veil = veils[at] + (veils[at + 1] - veils[at]) * beyond
            red, green, blue = _tinted(tints.table, north[0] * ux + north[1] * uy + north[2] * uz, at, beyond)
            if albedo is not None:
                if np.isfinite(albedo[i, j, 0]):
                    red, green, blue = albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2]
            if kind[i, j] == FOREST:
                red, green, blue = min(foliage * red, 1.0), min(foliage * green, 1.0), min(foliage * blue, 1.0)
            own = red, green, blue
            grey = luminance_of(red, green, blue)
            for k in range(3):
                light = own[k] * sun[k] * direct + (own[k] + greying * (grey - own[k])) * sky[k] * (sky_here * seen)
                if lamplight is not None:
                    light += own[k] * lamplight[i, j, k]
                light = shoulder(light)
                out[i, j, k] = light + veil * (AIR[k] * sky_here - light)


@internal
def _rounded(value):
    return np.float64(np.float32(value))


@internal
def _place_in_tint(height):
    """Which of the heights that a ramp is tabulated at lies below one, and by what share of the way to the next it is beyond."""
    share = min(max((height - TINT_LOW_M) / TINT_STEP_M, 0.0), TINT_COUNT - 1.0)
    at = np.int32(min(share, TINT_COUNT - 2.0) if share > 0.0 else 0.0)  # any where there is no ground
    return at, share - at


@internal
def _place_in_latitudes(sine, rows):
    """Which of the tints' rows lies below a latitude's sine, and by what share of the way to the next it is beyond."""
    share = min(max(0.5 * (sine + 1.0) * (rows - 1), 0.0), rows - 1.0)
    at = np.int32(min(share, rows - 2.0) if share > 0.0 else 0.0)  # any where there is no ground
    return at, share - at


@internal
def _tinted(table, sine, at, beyond):
    """The ground's colour at a latitude's sine, there."""
    if table.shape[0] == 1:
        return _tint_at(table, 0, 0, at, beyond), _tint_at(table, 0, 1, at, beyond), _tint_at(table, 0, 2, at, beyond)
    row, further = _place_in_latitudes(sine, table.shape[0])
    return (
        _tint_between(table, row, further, 0, at, beyond), _tint_between(table, row, further, 1, at, beyond),
        _tint_between(table, row, further, 2, at, beyond),
    )  # fmt: skip


@internal
def _tint_at(table, row, k, at, beyond):
    here = table[row, k, at]
    return here + (table[row, k, at + 1] - here) * beyond


@internal
def _tint_between(table, row, further, k, at, beyond):
    here = _tint_at(table, row, k, at, beyond)
    return here + (_tint_at(table, row + 1, k, at, beyond) - here) * further


@compiled
def shade_bare_ground(there, height, normal, up, sky_share, sunlight, look, light_here, table, out):
    """``shade_rows`` of bare ground and ``srgb_encoded`` of that, row by row: in loops that compile to vector instructions, and
    what is looked up in tables between them.
    """
    tints, north, greying, towards, terminator, exaggeration, limit, veils, _ = look
    _, to_sun, sun, sky, night = light_here
    cols = there.shape[1]
    direct, sky_here, sines, veil = np.empty(cols), np.empty(cols), np.empty(cols), np.empty(cols)
    facing, high, seen = np.empty(cols), np.empty(cols), np.empty(cols)
    as_it_is = exaggeration == 1.0 and limit >= NO_SLOPE_LIMIT
    beyond, at = np.empty(cols), np.empty(cols, np.int32)
    own, grey, step = np.empty(cols), np.empty(cols), np.empty(cols, np.int32)
    latitude, further, rows = np.empty(cols), np.empty(cols), np.zeros(cols, np.int32)
    for i in range(there.shape[0]):
        _face(up[i], (to_sun[0], to_sun[1], to_sun[2]), sines)
        high_everywhere = True  # a hole has no sine
        for j in range(cols):
            high_everywhere = high_everywhere and not sines[j] <= HIGH_SUN_SINE
        for j in range(cols):
            direct[j], sky_here[j] = sunlight[i, j], 1.0
        if not high_everywhere:
            for j in range(cols):
                direct[j] *= _direct_at(sines[j])
                sky_here[j] = night + (1.0 - night) * dusk_of(sines[j])
        _face(normal[i], (to_sun[0], to_sun[1], to_sun[2]), facing)
        _stand(normal[i], up[i], high)
        if not as_it_is:
            _steepen(facing, high, sines, exaggeration, limit)
        _sky_on_row(facing, high, sines, towards, sky_share[i], sky_here, seen)
        _sun_on_row(facing, sines, terminator, direct)
        _place_row(height[i], beyond, at)
        _look_up_tint(veils, at, beyond, veil)
        is_one, row = tints.table.shape[0] == 1, 0
        if not is_one:
            _face(up[i], (north[0], north[1], north[2]), latitude)
            _place_row_in_latitudes(latitude, tints.table.shape[0], further, rows)
            is_one, row = _is_one_climate(tints.differs_from, there[i], rows, at)
        _look_up_colors(tints.table, is_one, row, 3, rows, further, at, beyond, grey)
        for k in range(3):
            _look_up_colors(tints.table, is_one, row, k, rows, further, at, beyond, own)
            _srgb_steps_of(own, grey, greying, sun[k], sky[k], direct, seen, veil, sky_here, AIR[k], table.size, step)
            _look_up_srgb(there[i], step, table, out[i, :, k])


@internal
def _face(normal, to_sun, out):
    """Cosines of normals (n, 3) to the sun."""
    for j in range(out.size):
        out[j] = normal[j, 0] * to_sun[0] + normal[j, 1] * to_sun[1] + normal[j, 2] * to_sun[2]


@internal
def _stand(normal, up, out):
    """Cosines of normals (n, 3) to the zenith, of which ``up`` (n, 3) are the directions."""
    for j in range(out.size):
        x, y, z = np.float64(up[j, 0]), np.float64(up[j, 1]), np.float64(up[j, 2])
        out[j] = normal[j, 0] * x + normal[j, 1] * y + normal[j, 2] * z


@internal
def _steepen(facing, upright, sines, exaggeration, limit):
    """``_on_slope`` of a row."""
    for j in range(facing.size):
        facing[j], upright[j] = _on_slope(facing[j], upright[j], sines[j], exaggeration, limit)


@internal
def _sky_on_row(facing, upright, sines, towards, sky_share, sky_here, out):
    """How much of the sky's light falls on a row's slopes."""
    for j in range(out.size):
        out[j] = sky_share[j] * _sky_on_slope(facing[j], upright[j], sines[j], towards) * sky_here[j]


@internal
def _sun_on_row(facing, sines, terminator, direct):
    """Take a row's direct light to what falls on its slopes."""
    for j in range(direct.size):
        direct[j] *= _towards_sun(facing[j], sines[j], terminator)


@internal
def _place_row(heights, beyond, at):
    """``_place_in_tint`` of a row."""
    for j in range(heights.size):
        at[j], beyond[j] = _place_in_tint(heights[j])


@internal
def _place_row_in_latitudes(sines, count, further, rows):
    """``_place_in_latitudes`` of a row."""
    for j in range(sines.size):
        rows[j], further[j] = _place_in_latitudes(sines[j], count)


@internal
def _is_one_climate(differs_from, there, rows, at):
    """Whether one of the tints' rows serves all ground of a row of pixels, and which."""
    first, last, highest = np.int32(differs_from.size), np.int32(-1), np.int32(0)
    for j in range(at.size):
        if there[j]:
            first, last, highest = min(first, rows[j]), max(last, rows[j]), max(highest, at[j])
    for n in range(first, last + 1):
        if highest + 1 >= differs_from[n]:
            return False, 0
    return True, first if last >= 0 else 0


@internal
def _look_up_colors(table, is_one, row, k, rows, further, at, beyond, out):
    """A channel of the tints of a row of pixels: of one row of the table, or between two for each pixel."""
    if is_one:
        _look_up_tint(table[row, k], at, beyond, out)
    else:
        for j in range(at.size):
            out[j] = _tint_between(table, rows[j], further[j], k, at[j], beyond[j])


@internal
def _look_up_tint(tints, at, beyond, out):
    for j in range(at.size):
        here = tints[at[j]]
        out[j] = here + (tints[at[j] + 1] - here) * beyond[j]


@internal
def _srgb_steps_of(own, grey, greying, sun, sky, direct, seen, veil, sky_here, air, steps, out):
    """Which of the table's ``steps`` the colour is that ground shows of light, with a shoulder and the veil of air."""
    many = np.float32(steps)
    for j in range(out.size):
        shown = own[j] * (sun * direct[j]) + (own[j] + greying * (grey[j] - own[j])) * (sky * seen[j])
        shown = shown if shown <= SHOULDER else 1.0 - SHOULDER_LEFT**2 / (shown + SHOULDER_LEFT - SHOULDER)
        linear = np.float32(shown + veil[j] * (air * sky_here[j] - shown))
        step = linear * many
        out[j] = min(np.int32(step if step > 0.0 else 0.0), np.int32(steps - 1))


@internal
def _look_up_srgb(there, step, table, out):
    for j in range(step.size):
        if there[j]:
            out[j] = table[step[j]]


@compiled
def albedo_rows(first, last, shown, centre, albedo, look, out):
    """Some rows of linear albedo of what a buffer has ``shown``: the tints of places, but where there is an albedo."""
    there, _, position, height, _ = shown
    tints, north = look.tints, look.north_frame
    for i in range(first, last):
        for j in range(there.shape[1]):
            if not there[i, j]:
                continue
            p = position[i, j]
            ux, uy, uz = p[0] - centre[0], p[1] - centre[1], p[2] - centre[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = _rounded(ux / length), _rounded(uy / length), _rounded(uz / length)
            at, beyond = _place_in_tint(height[i, j])
            sine = north[0] * ux + north[1] * uy + north[2] * uz
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = _tinted(tints.table, sine, at, beyond)
            if albedo is not None:
                if np.isfinite(albedo[i, j, 0]):
                    for k in range(3):
                        out[i, j, k] = albedo[i, j, k]
