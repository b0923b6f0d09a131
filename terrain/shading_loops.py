"""Loops of shading: light on slopes, tints, and the tone curve of the display.

Loops that are compiled together are in this one file, since a change of a loop's file invalidates its stored machine code.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.style import TINT_HEIGHT_COUNT, TINT_HEIGHT_STEP_M, TINT_MIN_HEIGHT_M, UNLIMITED_SLOPE

TONE_CURVE_START, TONE_CURVE_RANGE = 0.6, 0.4
"""Linear colour at which the tone curve's shoulder begins, and the range from there to white."""

MIN_SLOPE_SKY_FACTOR = 0.3
"""Minimum factor of the sky's light on a slope that faces away from the sky's bright side."""

OBJECT_SUNWARD_SHARE = 0.4
"""Factor of the sunward share of sky light on buildings and trees.

Styles choose that share for relief inside shadow. On walls, which are vertical, it would leave no light on the far side.
"""

GROUND_REFLECTANCE = 0.2
"""Share of the light on level ground that reaches buildings and trees from below: the usual albedo of land."""

SUNLIT_GROUND_SHARE = 0.5
"""Share of the ground around buildings and trees that counts as sunlit. They shade a part of it themselves."""

MIN_SUN_ALTITUDE_COSINE = 0.15
"""Lower bound of the cosine of the sun's altitude, by which the loops divide.

Near the zenith the sun's azimuth is undefined.
"""

CROWN_OPTICAL_DEPTH = 2.5
"""Optical depth of a crown along its diameter: half the leaf area index, for leaves in all directions (J. Ross 1981).

Temperate broadleaf woods have an index of 5.1 (G. Asner, J. Scurlock and J. Hicke 2003, "Global synthesis of leaf area index").
"""

LEAF_GREENNESS = 0.25
"""Excess of green over red, relative to red, from which on a colour is that of leaves. The painted leaves have 0.45 and more, bark
has less than 0.
"""

MIN_LIT_COSINE = 1e-9
"""Minimum cosine to the sun that counts as lit."""

AIR_VEIL_COLOR = (0.66, 0.74, 0.84)
"""Linear colour by day of the veil of air over low ground."""

HIGH_SUN_ALTITUDE_DEG = 6.01
"""Altitude of the sun from which on direct light and sky light are constant (``shade_rows``, ``twilight_sky_share``).

It is a hundredth of a degree above the exact limit, since only some points of a map are checked.
"""

HIGH_SUN_ALTITUDE_SINE = float(np.sin(np.radians(HIGH_SUN_ALTITUDE_DEG)))


class DaylightInFrame(NamedTuple):
    """Daylight in the coordinates of a local frame. Colours are linear RGB.

    Attributes
    ----------
    has_sun
        Whether the scene has a sun.
    to_sun_frame
        (3,), the direction to the sun.
    sun_irradiance
        (3,), the sun's irradiance at normal incidence.
    sky_irradiance
        (3,), the irradiance from the whole sky.
    night_sky_share
        Sky light at night as a share of the day's.
    """

    has_sun: bool
    to_sun_frame: np.ndarray
    sun_irradiance: np.ndarray
    sky_irradiance: np.ndarray
    night_sky_share: float


class Tints(NamedTuple):
    """The ground's tints by latitude and height.

    Attributes
    ----------
    table
        (m, 4, n), linear colours and their luminance, at even steps of the latitude's sine from -1 to 1 and by height. With m = 1
        one row serves all latitudes.
    first_differing_height
        (m - 1,), index of the height from which on a row differs from the next one.
    """

    table: np.ndarray
    first_differing_height: np.ndarray


class ShadingParameters(NamedTuple):
    """Shading parameters of a style, for the compiled loops.

    Attributes
    ----------
    tints
        The ground's tints.
    north_frame
        (3,), the direction of the earth's axis in a local frame; 0 if tints do not depend on latitude.
    sky_light_desaturation
        Desaturation in the sky's light, 0 to 1.
    sunward_sky_light_share
        Share of the sky's light that comes from the sun's side, 0 to 1.
    terminator_light_share
        Share of level ground's direct light below which slopes fade into attached shadow.
    slope_exaggeration, max_shaded_slope
        Factor of slopes in shading, and the upper limit (a tangent) of exaggerated slopes.
    air_veil_by_height
        (n,), the share of the veil of air in the ground's colour, by height.
    foliage_albedo_factor
        Factor of foliage's albedo.
    """

    tints: Tints
    north_frame: np.ndarray
    sky_light_desaturation: float
    sunward_sky_light_share: float
    terminator_light_share: float
    slope_exaggeration: float
    max_shaded_slope: float
    air_veil_by_height: np.ndarray
    foliage_albedo_factor: float


class LeafOptics(NamedTuple):
    """Optical properties of foliage in a view.

    Attributes
    ----------
    isotropic_share
        Share of foliage's light that does not depend on its normal.
    transmittance_ratio
        (3,), a leaf's transmittance over its reflectance, in linear RGB; 0 in maps.
    eye_frame_m
        (3,), the eye in the frame, metres.
    """

    isotropic_share: float
    transmittance_ratio: np.ndarray
    eye_frame_m: np.ndarray


@compiled
def twilight_sky_share(sun_altitude_sine):
    """Return the share of the day's sky light for the sine of the sun's altitude.

    It is 1 from 6 degrees on, and 0 below -12 degrees (nautical dusk).
    """
    if sun_altitude_sine > HIGH_SUN_ALTITUDE_SINE:
        return 1.0
    altitude = np.degrees(np.arcsin(min(max(sun_altitude_sine, -1.0), 1.0)))
    return smoothstep_value((altitude + 12.0) / 18.0)


@compiled
def tone_curve(linear):
    """Return the display colour of linear light: a tone curve with a shoulder.

    The curve is the identity up to ``TONE_CURVE_START`` and flattens from there on. Slopes that face a low sun keep their tint.
    """
    return linear if linear <= TONE_CURVE_START else 1.0 - TONE_CURVE_RANGE**2 / (linear + TONE_CURVE_RANGE - TONE_CURVE_START)


@compiled
def luminance_of(red, green, blue):
    """Return the luminance of linear sRGB (ITU-R BT.709)."""
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


@compiled
def _exaggerated_cosines(cos_sun, cos_zenith, sun_altitude_sine, exaggeration, max_slope):
    """Return a slope's cosines to the sun and to the zenith, with the slope exaggerated and limited.

    The slope t becomes t' = a t / sqrt(1 + (a t / limit)**2). For a normal n, ``cos_sun`` is n.s and ``cos_zenith`` n.u, with s the
    sun's direction and u up; ``sun_altitude_sine`` is s.u.
    """
    if cos_zenith <= 0.0:
        return cos_sun, cos_zenith
    flat = np.sqrt(max(1.0 - cos_zenith * cos_zenith, 0.0))
    slope = exaggeration * flat / cos_zenith
    factor = exaggeration / np.sqrt(1.0 + slope * slope / (max_slope * max_slope))
    slope = factor * flat / cos_zenith
    cosine = 1.0 / np.sqrt(1.0 + slope * slope)
    return (cos_sun - sun_altitude_sine * cos_zenith) * factor * cosine / cos_zenith + sun_altitude_sine * cosine, cosine


@compiled
def _slope_sky_factor(cos_sun, cos_zenith, sun_altitude_sine, directional_share):
    """Return the factor of the sky's light on a slope; 1 on level ground.

    The share ``directional_share`` of the light comes from 45 degrees above the horizon at the sun's azimuth.
    """
    cos_sun_azimuth = (cos_sun - sun_altitude_sine * cos_zenith) / max(
        np.sqrt(max(1.0 - sun_altitude_sine * sun_altitude_sine, 0.0)), MIN_SUN_ALTITUDE_COSINE
    )
    return max(1.0 + directional_share * (cos_sun_azimuth + cos_zenith - 1.0), MIN_SLOPE_SKY_FACTOR)


@compiled
def _slope_direct_light(cos_sun, sun_altitude_sine, terminator_light_share):
    """Return the direct light on a slope: Lambert's cosine, reduced near the terminator.

    The reduction begins where the cosine is below the share ``terminator_light_share`` of level ground's. Without it, facets of a
    raster that face away would show as dark squares on slopes that the light grazes.
    """
    cosine = max(cos_sun, 0.0)
    share = min(cosine / max(terminator_light_share * sun_altitude_sine, MIN_LIT_COSINE), 1.0)
    return cosine * share * share * (3.0 - 2.0 * share)


@internal
def _direct_fade(sun_altitude_sine):
    """Return the factor of direct light, which fades in over the first degree of the sun's altitude at a place."""
    if sun_altitude_sine > HIGH_SUN_ALTITUDE_SINE:
        return 1.0
    return min(max(np.degrees(np.arcsin(min(max(sun_altitude_sine, -1.0), 1.0))), 0.0), 1.0)


@compiled
def write_slope_sky_rows(first, last, valid, normal, position, up_origin, out):
    """Compute the share of the sky that each slope leaves visible without its surroundings, into ``out``.

    Rows run from ``first`` to before ``last``. ``up_origin`` is the point from which "up" points away (``World.up_origin``).
    """
    for i in range(first, last):
        for j in range(valid.shape[1]):
            if valid[i, j]:
                n, p = normal[i, j], position[i, j]
                x, y, z = p[0] - up_origin[0], p[1] - up_origin[1], p[2] - up_origin[2]
                out[i, j] = 0.5 + 0.5 * (n[0] * x + n[1] * y + n[2] * z) / np.sqrt(x * x + y * y + z * z)


@compiled
def encode_rows(first, last, linear, srgb_table, out):
    """Encode the linear display colours [``first``, ``last``) as sRGB. ``srgb_table`` (n,) uint8 has even steps from 0 to 1."""
    for n in range(first, last):
        out[n] = srgb_table[min(np.int32(linear[n] * srgb_table.size), srgb_table.size - 1)]


@compiled
def shade_rows(
    first, last, shading_inputs, parameters, daylight_in_frame, up_origin, leaves, albedo, sunlight, skylight, lamplight, gloss, out
):
    """Compute the linear display colour of the rows [``first``, ``last``) of a geometry buffer, into ``out``.

    ``up_origin`` is the point from which "up" points away (``World.up_origin``). ``leaves`` is a ``LeafOptics``. ``albedo``
    (rows, cols, 3) is NaN where the ground has its tint; ``None`` if that is everywhere. ``sunlight``, ``skylight``,
    ``lamplight`` and ``gloss`` are those of ``shade``.
    """
    # Arguments that are None are known at compile time: each variant contains only the code for its own arguments.
    valid, kind, position, height, normal = shading_inputs
    tints, north, greying, directional_share, terminator, exaggeration, limit, veils, foliage = parameters
    has_sun, to_sun, sun, sky, night = daylight_in_frame
    isotropic_share, transmittance_ratio, eye = leaves
    has_translucent_leaves = has_sun and transmittance_ratio[1] > 0.0
    has_true_slopes = exaggeration == 1.0 and limit >= UNLIMITED_SLOPE
    for i in range(first, last):
        for j in range(valid.shape[1]):
            if not valid[i, j]:
                continue
            n, p = normal[i, j], position[i, j]
            translucent_share = isotropic_share if kind[i, j] == FOREST else 0.0
            ux, uy, uz = p[0] - up_origin[0], p[1] - up_origin[1], p[2] - up_origin[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            sky_view = 0.5 + 0.5 * (n[0] * ux + n[1] * uy + n[2] * uz) / length if skylight is None else skylight[i, j]
            # Rounded as in ``shade_bare_ground``, so that both give the same picture.
            ux, uy, uz = _round_to_float32(ux / length), _round_to_float32(uy / length), _round_to_float32(uz / length)
            sine = to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz if has_sun else -1.0
            cos_zenith = n[0] * ux + n[1] * uy + n[2] * uz
            cos_sun = n[0] * to_sun[0] + n[1] * to_sun[1] + n[2] * to_sun[2]
            if has_sun:
                sunward_share = directional_share if kind[i, j] == RELIEF else OBJECT_SUNWARD_SHARE * directional_share
                if kind[i, j] == RELIEF and not has_true_slopes:
                    cos_sun, cos_zenith = _exaggerated_cosines(cos_sun, cos_zenith, sine, exaggeration, limit)
                sky_view = sky_view * _slope_sky_factor(cos_sun, cos_zenith, sine, sunward_share)
                if kind[i, j] == RELIEF:
                    cos_sun = _slope_direct_light(cos_sun, sine, terminator)
            sky_light_share = night + (1.0 - night) * twilight_sky_share(sine)
            visible_ground_share = 0.0 if kind[i, j] == RELIEF else 0.5 * (1.0 - cos_zenith)
            level_direct = SUNLIT_GROUND_SHARE * max(sine, 0.0) * _direct_fade(sine)
            direct = (translucent_share + (1.0 - translucent_share) * max(cos_sun, 0.0)) * (_direct_fade(sine) * sunlight[i, j])
            mirrored = 0.0
            if gloss is not None:
                mirrored = _direct_fade(sine) * sunlight[i, j]
                direct *= 1.0 - gloss[i, j, 3]
            tint_index, fraction = _tint_position(height[i, j])
            veil = veils[tint_index] + (veils[tint_index + 1] - veils[tint_index]) * fraction
            red, green, blue = _tinted(tints.table, north[0] * ux + north[1] * uy + north[2] * uz, tint_index, fraction)
            if albedo is not None:
                if np.isfinite(albedo[i, j, 0]):
                    red, green, blue = albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2]
            if kind[i, j] == FOREST:
                red, green, blue = min(foliage * red, 1.0), min(foliage * green, 1.0), min(foliage * blue, 1.0)
            surface_color = red, green, blue
            grey = luminance_of(red, green, blue)
            transmitted = 0.0
            if has_translucent_leaves and kind[i, j] == FOREST:
                vx, vy, vz = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                cos_scattering = (vx * to_sun[0] + vy * to_sun[1] + vz * to_sun[2]) / np.sqrt(vx * vx + vy * vy + vz * vz)
                transmitted = leaf_share(red, green) * transmitted_share(cos_scattering, cos_sun)
                transmitted *= _direct_fade(sine) * sunlight[i, j]
            for k in range(3):
                light = surface_color[k] * sun[k] * (direct + transmittance_ratio[k] * transmitted) + (
                    surface_color[k] + greying * (grey - surface_color[k])
                ) * sky[k] * (sky_light_share * sky_view)
                ground_light = GROUND_REFLECTANCE * (sun[k] * level_direct + sky[k] * sky_light_share)
                light += surface_color[k] * ground_light * visible_ground_share
                if gloss is not None:
                    light += sun[k] * gloss[i, j, k] * mirrored
                if lamplight is not None:
                    light += surface_color[k] * lamplight[i, j, k]
                light = tone_curve(light)
                out[i, j, k] = light + veil * (AIR_VEIL_COLOR[k] * sky_light_share - light)


@compiled
def transmitted_share(cos_scattering, cos_sun):
    """Return the sunlight that leaves transmit to the eye, as a multiple of the transmittance of a leaf times the irradiance.

    Leaves lie in all directions and scatter by Lambert's law on both sides. Then the light that they transmit has the phase
    function 8 / (3 pi) (sin b + (pi - b) cos b) at the scattering angle b (J. Shultis and R. Myneni 1988, "Radiative transfer in
    vegetation canopies with anisotropic scattering"). A quarter of it leaves a dense crown, so that all directions together get no
    more than the transmitted light: 2/3 against the sun, 0 with the sun behind the eye. On the way through the crown the sunlight
    is attenuated by Beer's law.

    ``cos_scattering`` is the cosine of b between the sun's rays and the direction to the eye, and ``cos_sun`` that between the
    crown's normal and the sun: where it is negative, its amount is the path through a spherical crown, in diameters.
    """
    cosine = min(max(cos_scattering, -1.0), 1.0)
    phase = np.sqrt(1.0 - cosine * cosine) + (np.pi - np.arccos(cosine)) * cosine
    return 2.0 / (3.0 * np.pi) * phase * np.exp(-CROWN_OPTICAL_DEPTH * max(-cos_sun, 0.0))


@compiled
def leaf_share(red, green):
    """Return the share of leaves in the colour of a tree: 1 for leaves, 0 for bark and snow, which are no greener than red."""
    return min(max((green - red) / max(LEAF_GREENNESS * red, 1e-9), 0.0), 1.0)


@internal
def _round_to_float32(value):
    """Return the float64 value of a number that is rounded to float32."""
    return np.float64(np.float32(value))


@internal
def _tint_position(height):
    """Return the index of the tabulated height at or below a height, and the fraction of the way to the next one."""
    share = min(max((height - TINT_MIN_HEIGHT_M) / TINT_HEIGHT_STEP_M, 0.0), TINT_HEIGHT_COUNT - 1.0)
    tint_index = np.int32(min(share, TINT_HEIGHT_COUNT - 2.0) if share > 0.0 else 0.0)  # NaN, without ground, gives any index
    return tint_index, share - tint_index


@internal
def _latitude_position(latitude_sine, table_rows):
    """Return the index of the tints' row at or below a latitude's sine, and the fraction of the way to the next one."""
    share = min(max(0.5 * (latitude_sine + 1.0) * (table_rows - 1), 0.0), table_rows - 1.0)
    tint_index = np.int32(min(share, table_rows - 2.0) if share > 0.0 else 0.0)  # NaN, without ground, gives any index
    return tint_index, share - tint_index


@internal
def _tinted(table, latitude_sine, tint_index, fraction):
    """Return the ground's linear colour at the sine of a latitude.

    ``tint_index`` and ``fraction`` are the place of a height in the table (``_tint_position``).
    """
    if table.shape[0] == 1:
        return (
            _tint_at(table, 0, 0, tint_index, fraction),
            _tint_at(table, 0, 1, tint_index, fraction),
            _tint_at(table, 0, 2, tint_index, fraction),
        )
    row, row_fraction = _latitude_position(latitude_sine, table.shape[0])
    return (
        _tint_between(table, row, row_fraction, 0, tint_index, fraction),
        _tint_between(table, row, row_fraction, 1, tint_index, fraction),
        _tint_between(table, row, row_fraction, 2, tint_index, fraction),
    )  # fmt: skip


@internal
def _tint_at(table, row, channel, tint_index, fraction):
    """Return a channel of the tints at the latitude of the table's row ``row``.

    Channels 0 to 2 are the linear colour, and 3 is its luminance. ``tint_index`` and ``fraction`` are the place of a height in the
    table (``_tint_position``).
    """
    value = table[row, channel, tint_index]
    return value + (table[row, channel, tint_index + 1] - value) * fraction


@internal
def _tint_between(table, row, row_fraction, channel, tint_index, fraction):
    """Return a channel of the tints at a latitude between the table's rows ``row`` and ``row + 1``.

    ``row_fraction`` is the fraction of the way from the first row to the second one. The other parameters are those of
    ``_tint_at``.
    """
    value = _tint_at(table, row, channel, tint_index, fraction)
    return value + (_tint_at(table, row + 1, channel, tint_index, fraction) - value) * row_fraction


@compiled
def shade_bare_ground(valid, height, normal, up, sky_share, sunlight, parameters, daylight_in_frame, srgb_table, out):
    """Write the sRGB colour of bare ground under the sun to ``out`` (rows, cols, 3) uint8: ``encode_srgb`` of ``shade_rows``.

    Inner loops compile to vector instructions; table look-ups run between them. Pixels without ground do not change.

    Parameters
    ----------
    valid, height, normal, up, sky_share
        Mask of the pixels with ground, heights in metres, smooth unit normals, unit vectors up, and visible shares of the sky. They
        are the arrays of a ``BareGround``.
    sunlight
        (rows, cols), the share of the sun's direct light that reaches each pixel, in [0, 1]: 0 in shadow. It is not an irradiance;
        the angle of incidence is applied here.
    parameters, daylight_in_frame
        A ``ShadingParameters`` and a ``DaylightInFrame``.
    srgb_table
        uint8 (n,), the sRGB codes of linear colours at even steps from 0 to 1.
    """
    tints, north, greying, directional_share, terminator, exaggeration, limit, veils, _ = parameters
    _, to_sun, sun, sky, night = daylight_in_frame
    cols = valid.shape[1]
    direct, sky_light_share, sines, veil = np.empty(cols), np.empty(cols), np.empty(cols), np.empty(cols)
    cos_sun, cos_zenith, sky_light = np.empty(cols), np.empty(cols), np.empty(cols)
    has_true_slopes = exaggeration == 1.0 and limit >= UNLIMITED_SLOPE
    fraction, tint_index = np.empty(cols), np.empty(cols, np.int32)
    red, green, blue, grey = np.empty(cols), np.empty(cols), np.empty(cols), np.empty(cols)
    red_index, green_index, blue_index = np.empty(cols, np.int32), np.empty(cols, np.int32), np.empty(cols, np.int32)
    latitude, row_fraction, rows = np.empty(cols), np.empty(cols), np.zeros(cols, np.int32)
    packed_tints, next_packed_tints, packed_row = np.empty((veils.size, 5)), np.empty((veils.size, 5)), -1
    for i in range(valid.shape[0]):
        _cosines_to_direction(up[i], (to_sun[0], to_sun[1], to_sun[2]), sines)
        is_high_everywhere = True  # pixels without ground have a NaN sine, which the comparison ignores
        for j in range(cols):
            is_high_everywhere = is_high_everywhere and not sines[j] <= HIGH_SUN_ALTITUDE_SINE
        for j in range(cols):
            direct[j], sky_light_share[j] = sunlight[i, j], 1.0
        if not is_high_everywhere:
            for j in range(cols):
                direct[j] *= _direct_fade(sines[j])
                sky_light_share[j] = night + (1.0 - night) * twilight_sky_share(sines[j])
        _cosines_to_direction(normal[i], (to_sun[0], to_sun[1], to_sun[2]), cos_sun)
        _cosines_to_zenith(normal[i], up[i], cos_zenith)
        if not has_true_slopes:
            _exaggerate_row(cos_sun, cos_zenith, sines, exaggeration, limit)
        _sky_light_of_row(cos_sun, cos_zenith, sines, directional_share, sky_share[i], sky_light_share, sky_light)
        _direct_light_of_row(cos_sun, sines, terminator, direct)
        _tint_positions(height[i], fraction, tint_index)
        has_one_row, row = tints.table.shape[0] == 1, 0
        if not has_one_row:
            _cosines_to_direction(up[i], (north[0], north[1], north[2]), latitude)
            _latitude_positions(latitude, tints.table.shape[0], row_fraction, rows)
            has_one_row, row = _shared_tint_row(tints.first_differing_height, valid[i], rows, tint_index)
        if row >= 0 and row != packed_row:
            _pack_tints(tints.table[row], veils, packed_tints)
            _pack_tints(tints.table[min(row + 1, tints.table.shape[0] - 1)], veils, next_packed_tints)
            packed_row = row
        if has_one_row:
            _look_up_packed_tints(packed_tints, tint_index, fraction, red, green, blue, grey, veil)
        elif row >= 0:
            _look_up_between_packed_tints(
                packed_tints, next_packed_tints, row_fraction, tint_index, fraction, red, green, blue, grey, veil
            )
        else:
            _look_up_tint(veils, tint_index, fraction, veil)
            _look_up_tints_between(tints.table, rows, row_fraction, tint_index, fraction, (red, green, blue, grey))
        for channel_tint, k, srgb_index in ((red, 0, red_index), (green, 1, green_index), (blue, 2, blue_index)):
            _srgb_indices(
                channel_tint, grey, greying, sun[k], sky[k], direct, sky_light, veil, sky_light_share, AIR_VEIL_COLOR[k],
                srgb_table.size, srgb_index,
            )  # fmt: skip
        _look_up_srgb(valid[i], red_index, green_index, blue_index, srgb_table, out[i])


@internal
def _cosines_to_direction(normal, direction, out):
    """Compute the cosines between normals (n, 3) and one direction (3,), such as that to the sun."""
    for j in range(out.size):
        out[j] = normal[j, 0] * direction[0] + normal[j, 1] * direction[1] + normal[j, 2] * direction[2]


@internal
def _cosines_to_zenith(normal, up, out):
    """Compute the cosines between normals (n, 3) and the directions ``up`` (n, 3) to the zenith."""
    for j in range(out.size):
        x, y, z = np.float64(up[j, 0]), np.float64(up[j, 1]), np.float64(up[j, 2])
        out[j] = normal[j, 0] * x + normal[j, 1] * y + normal[j, 2] * z


@internal
def _exaggerate_row(cos_sun, cos_zenith, sun_altitude_sines, exaggeration, max_slope):
    """Apply ``_exaggerated_cosines`` to the cosines ``cos_sun`` and ``cos_zenith`` (n,) of a row of pixels, in place."""
    for j in range(cos_sun.size):
        cos_sun[j], cos_zenith[j] = _exaggerated_cosines(cos_sun[j], cos_zenith[j], sun_altitude_sines[j], exaggeration, max_slope)


@internal
def _sky_light_of_row(cos_sun, cos_zenith, sun_altitude_sines, directional_share, sky_share, sky_light_share, out):
    """Compute the sky's light on the slopes of a row of pixels, as a share of the day's sky light on level ground.

    ``sky_share`` (n,) is the visible share of the sky, ``sky_light_share`` (n,) the sky's light as a share of the day's. The other
    parameters are those of ``_slope_sky_factor``, for n pixels.
    """
    for j in range(out.size):
        out[j] = (
            sky_share[j]
            * _slope_sky_factor(cos_sun[j], cos_zenith[j], sun_altitude_sines[j], directional_share)
            * sky_light_share[j]
        )


@internal
def _direct_light_of_row(cos_sun, sun_altitude_sines, terminator_light_share, direct):
    """Multiply the direct light ``direct`` (n,) of a row of pixels by ``_slope_direct_light``, in place."""
    for j in range(direct.size):
        direct[j] *= _slope_direct_light(cos_sun[j], sun_altitude_sines[j], terminator_light_share)


@internal
def _tint_positions(heights, fraction, tint_index):
    """Write the results of ``_tint_position`` for the heights (n,) of a row of pixels to ``tint_index`` and ``fraction`` (n,)."""
    for j in range(heights.size):
        tint_index[j], fraction[j] = _tint_position(heights[j])


@internal
def _latitude_positions(latitude_sines, count, row_fraction, rows):
    """Write the results of ``_latitude_position`` for the latitudes of a row of pixels to ``rows`` and ``row_fraction`` (n,).

    ``latitude_sines`` (n,) are the sines of the latitudes, and ``count`` is the number of rows of the table of tints.
    """
    for j in range(latitude_sines.size):
        rows[j], row_fraction[j] = _latitude_position(latitude_sines[j], count)


@internal
def _shared_tint_row(first_difference, valid, rows, tint_index):
    """Return whether all valid pixels of a row share their tints, and the row of the table at their latitudes; -1 for several ones.

    They share their tints if the table's rows at their latitudes are equal up to their highest tint. Any of these rows then serves.
    ``first_difference`` is ``Tints.first_differing_height``. ``rows`` (n,) and ``tint_index`` (n,) are the row and the height's
    index of each pixel in the table.
    """
    first, last, highest = np.int32(first_difference.size), np.int32(-1), np.int32(0)
    for j in range(tint_index.size):
        if valid[j]:
            first, last, highest = min(first, rows[j]), max(last, rows[j]), max(highest, tint_index[j])
    row, has_one_row = first if last >= 0 else 0, True
    for n in range(first, last + 1):
        has_one_row = has_one_row and highest + 1 < first_difference[n]
    return has_one_row, row if has_one_row or first == last else -1


@internal
def _pack_tints(table, veils, out):
    """Write the tints ``table`` (4, n) of one latitude and the veil of air ``veils`` (n,) to ``out`` (n, 5), height by height."""
    for n in range(veils.size):
        for k in range(4):
            out[n, k] = table[k, n]
        out[n, 4] = veils[n]


@internal
def _look_up_packed_tints(packed_tints, tint_index, fraction, red, green, blue, grey, veil):
    """Write the tints and the veil of air of a row of pixels to the last five parameters (n,), interpolated as in ``_tint_at``.

    ``packed_tints`` are those of ``_pack_tints``: all values of a height lie together, and one index leads to them.
    """
    for j in range(tint_index.size):
        k = np.uintp(tint_index[j])
        above, share = k + np.uintp(1), fraction[j]
        r, g, b, y, v = packed_tints[k, 0], packed_tints[k, 1], packed_tints[k, 2], packed_tints[k, 3], packed_tints[k, 4]
        r1, g1, b1, y1 = packed_tints[above, 0], packed_tints[above, 1], packed_tints[above, 2], packed_tints[above, 3]
        v1 = packed_tints[above, 4]
        red[j], green[j], blue[j] = r + (r1 - r) * share, g + (g1 - g) * share, b + (b1 - b) * share
        grey[j], veil[j] = y + (y1 - y) * share, v + (v1 - v) * share


@internal
def _look_up_between_packed_tints(
    packed_tints, next_packed_tints, row_fraction, tint_index, fraction, red, green, blue, grey, veil
):
    """Write tints and veils as ``_look_up_packed_tints`` does, for pixels between the latitudes of two rows of the table.

    ``packed_tints`` and ``next_packed_tints`` are the tints of both rows, and ``row_fraction`` (n,) tells where between them each
    pixel lies. The sums follow the order of ``_tint_between``.
    """
    for j in range(tint_index.size):
        k = np.uintp(tint_index[j])
        above, share, south_share = k + np.uintp(1), fraction[j], row_fraction[j]
        r, g, b, y, v = packed_tints[k, 0], packed_tints[k, 1], packed_tints[k, 2], packed_tints[k, 3], packed_tints[k, 4]
        r1, g1, b1, y1 = packed_tints[above, 0], packed_tints[above, 1], packed_tints[above, 2], packed_tints[above, 3]
        v1 = packed_tints[above, 4]
        r, g, b, y = r + (r1 - r) * share, g + (g1 - g) * share, b + (b1 - b) * share, y + (y1 - y) * share
        r2, g2, b2, y2 = next_packed_tints[k, 0], next_packed_tints[k, 1], next_packed_tints[k, 2], next_packed_tints[k, 3]
        r3, g3 = next_packed_tints[above, 0], next_packed_tints[above, 1]
        b3, y3 = next_packed_tints[above, 2], next_packed_tints[above, 3]
        r2, g2, b2, y2 = r2 + (r3 - r2) * share, g2 + (g3 - g2) * share, b2 + (b3 - b2) * share, y2 + (y3 - y2) * share
        red[j], green[j] = r + (r2 - r) * south_share, g + (g2 - g) * south_share
        blue[j], grey[j] = b + (b2 - b) * south_share, y + (y2 - y) * south_share
        veil[j] = v + (v1 - v) * share


@internal
def _look_up_tints_between(table, rows, row_fraction, tint_index, fraction, channels):
    """Write the tints of a row of pixels to the four arrays ``channels`` (n,), interpolated as in ``_tint_between``.

    ``rows``, ``row_fraction``, ``tint_index`` and ``fraction`` (n,) have one element for each pixel.
    """
    for k in range(4):
        out = channels[k]
        for j in range(tint_index.size):
            out[j] = _tint_between(table, rows[j], row_fraction[j], k, tint_index[j], fraction[j])


@internal
def _look_up_tint(tints, tint_index, fraction, out):
    """Write the values of a table ``tints`` by height for a row of pixels to ``out`` (n,), interpolated as in ``_tint_at``."""
    for j in range(tint_index.size):
        value = tints[tint_index[j]]
        out[j] = value + (tints[tint_index[j] + 1] - value) * fraction[j]


@internal
def _srgb_indices(
    tint, grey, desaturation, sun_irradiance, sky_irradiance, direct, sky_light, veil, sky_light_share, air_color, table_size, out
):
    """Compute the places in an sRGB table of one colour channel of lit ground, for a row of pixels.

    The table has ``table_size`` entries. The colour includes the tone curve and the veil of air.

    Parameters
    ----------
    tint, grey
        (n,), linear tints in this channel, and their luminances.
    desaturation
        Desaturation in the sky's light, 0 to 1.
    sun_irradiance, sky_irradiance, air_color
        Irradiances of sun and sky, and linear colour of the veil of air, in this channel.
    direct, sky_light
        (n,), shares of the sun's irradiance and of the day's sky light that the ground receives.
    veil
        (n,), share of the veil of air in the colour.
    sky_light_share
        (n,), the sky's light as a share of the day's, which lights the veil of air.
    """
    count = np.float32(table_size)
    for j in range(out.size):
        light = tint[j] * (sun_irradiance * direct[j]) + (tint[j] + desaturation * (grey[j] - tint[j])) * (
            sky_irradiance * sky_light[j]
        )
        light = light if light <= TONE_CURVE_START else 1.0 - TONE_CURVE_RANGE**2 / (light + TONE_CURVE_RANGE - TONE_CURVE_START)
        linear = np.float32(light + veil[j] * (air_color * sky_light_share[j] - light))
        index = linear * count
        out[j] = min(np.int32(index if index > 0.0 else 0.0), np.int32(table_size - 1))


@internal
def _look_up_srgb(valid, red_index, green_index, blue_index, srgb_table, out):
    """Write the sRGB codes at the places (n,) of three channels in the table to ``out`` (n, 3) in valid pixels."""
    for j in range(valid.size):
        if valid[j]:
            out[j, 0] = srgb_table[np.uintp(red_index[j])]
            out[j, 1] = srgb_table[np.uintp(green_index[j])]
            out[j, 2] = srgb_table[np.uintp(blue_index[j])]


@compiled
def write_albedo_rows(first, last, shading_inputs, up_origin, albedo, parameters, out):
    """Compute the linear albedo of the rows [``first``, ``last``) of a geometry buffer, into ``out``.

    It is ``albedo`` where that has a value, else the ground's tint.
    """
    valid, _, position, height, _ = shading_inputs
    tints, north = parameters.tints, parameters.north_frame
    for i in range(first, last):
        for j in range(valid.shape[1]):
            if not valid[i, j]:
                continue
            p = position[i, j]
            ux, uy, uz = p[0] - up_origin[0], p[1] - up_origin[1], p[2] - up_origin[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = _round_to_float32(ux / length), _round_to_float32(uy / length), _round_to_float32(uz / length)
            tint_index, fraction = _tint_position(height[i, j])
            sine = north[0] * ux + north[1] * uy + north[2] * uz
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = _tinted(tints.table, sine, tint_index, fraction)
            if albedo is not None:
                if np.isfinite(albedo[i, j, 0]):
                    for k in range(3):
                        out[i, j, k] = albedo[i, j, k]
