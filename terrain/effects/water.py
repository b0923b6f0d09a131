"""Standing water: a plane with the waves of a light wind, which reflects the sky and the sun (glint).

**Waves.** The water consists of small facets. Their slopes have an isotropic Gaussian distribution with a mean square of 0.003 +
0.00512 times the wind in m/s (C. Cox, W. Munk, Measurement of the roughness of the sea surface from photographs of the sun's
glitter, 1954). Facets hide each other as in B. Smith (Geometrical shadowing of a random rough surface, 1967). For an eye at the
zenith angle t, facets with a slope z towards it have the visible area max(cos t + z sin t, 0). The mean over all slopes is ``A(t) =
cos t N(a) + s sin t n(a)`` with a = cot t / s. N is the normal distribution, n its density, and s the standard deviation of slopes
in one direction. The mean visible slope is ``s**2 sin t N(a) / A(t)`` (C. Stein's lemma). Near the horizon the eye sees the fronts
of waves, which reflect the sky well above the horizon.

- Sky: the colour of the sky in the direction that the mean visible facet reflects, times Schlick's Fresnel reflectance averaged
  over the waves (E. Bruneton, F. Neyret, N. Holzschuch, Real-time realistic ocean lighting, 2010).
- Sun: E is the irradiance, F Schlick's Fresnel reflectance of the facet that reflects the sun into the eye, b the tilt of this
  facet and m = 2 s**2 the mean square of the slopes. Water is as bright as a white diffuser under the irradiance
  ``E F exp(-tan(b)**2 / m) / (m cos(b)**4) cos(t_sun) / (4 A(t_eye) A(t_sun))``.

Reflections of the terrain and of lamps are not simulated. The water shows the sky instead.
"""

from __future__ import annotations

from math import erf

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.antialias import finer_view
from skugga.terrain.gbuffer.view_geometry import RasterisedView
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.visible_cells import CellRange, block_slices, visible_cells
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from skugga.terrain.shading import (
    WATER_HEIGHT_TOLERANCE_M,
    daylight_of,
    encode_srgb,
    exposure_of,
    night_sky_share,
    shading_parameters,
    sky_lit_albedo,
    water_mask,
)
from skugga.terrain.shading_loops import tone_curve, twilight_sky_share
from skugga.terrain.sky import sky_color, sky_of

WIND_SPEED_M_S = 3.0
"""A light breeze."""

MEAN_SQUARE_WAVE_SLOPE = 0.003 + 0.00512 * WIND_SPEED_M_S

NORMAL_INCIDENCE_REFLECTANCE = 0.02
"""Fresnel reflectance at normal incidence: ((n - 1) / (n + 1))**2 for n = 1.333."""

MAX_SEARCHED_PIXELS = 2_000_000
"""Maximum number of pixels that are drawn to search for water between the points of a coarse view. If more would be needed, water
is assumed to be visible.
"""

MAX_CELLS_READ = 2**18
"""Maximum number of a map's cells that are read in the search for water."""

MIN_SKY_VIEW_FACTOR = 0.5
"""Assumed sky-view factor of the most enclosed water."""

TESTED_COLOR_COUNT, TESTED_ANGLE_COUNT = 128, 32
"""Number of tested water colours and viewing angles.

The colours are densest near black, where entries of the encoding table are 0.8 of an 8-bit step apart. There they cover all colours
of a dark lake.
"""

MAX_INVISIBLE_GLINT = 0.5 / 255.0 / 12.92
"""Maximum linear light that is invisible even on black: half a step at the steepest part of sRGB."""

GLINT_DIRECTIONS_PER_SIDE = 33
"""Number of directions along each side of a perspective view that are tested for glint.

Glint falls to half its brightness 4 degrees off its centre. In a field of view of 60 degrees no direction is more than one degree
from a tested one.
"""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: ``water`` covers ground that is in view, and the mirrored sky changes its colour by more than a step.

    Left out: no water, none in view, a sky as dark as the water.
    """
    facts = descriptor.facts["water"]
    level_m, change = numeric_fact(facts["level_m"]), numeric_fact(facts["change_steps"])
    if level_m is None:
        return Verdict(False, "the level has no water")
    if not facts["covers"]:
        return Verdict(False, f"no ground lies below the water level, {level_m:.1f} m")
    if change is None:
        return Verdict(False, f"the water at {level_m:.1f} m is out of view")
    if change <= 1:
        return Verdict(False, f"reflections change the water's colour by at most {change:.0f} of 255 steps")
    mirrored = "the sky and the sun" if facts["glint"] else "the sky"
    return Verdict(True, f"water at {level_m:.1f} m reflects {mirrored}: up to {change:.0f} of 255 steps")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of water.

    - ``level_m``: height of the water, metres; ``None`` without water.
    - ``covers``: whether the water covers any ground.
    - ``change_steps``: maximum number of 8-bit steps by which the reflected sky changes a colour; ``None`` if no water is visible.
    - ``glint``: whether glint of the sun can be visible.

    In a map only the visible cells count, at the overview level that the map uses.
    """
    water_m = scene.elevation.water_m
    if scene.loaded.level.water is None:
        return {"level_m": None, "covers": False, "change_steps": None, "glint": False}
    change: int | None = None
    covers = scene.elevation.overview.lowest_ground_m <= water_m + WATER_HEIGHT_TOLERANCE_M
    if isinstance(view, MapView):
        covers = covers and _map_may_show_water(scene, view)
        change = _max_change_steps(scene, view, np.array([1.0])) if covers else None
    elif covers and coarse_view is not None:
        cosines = _eye_zenith_cosines(scene, view, coarse_view)
        change = _max_change_steps(scene, view, cosines) if len(cosines) else None
    return {"level_m": water_m, "covers": covers, "change_steps": change, "glint": change is not None and has_glint(scene, view)}


def _map_may_show_water(scene: Scene, view: MapView) -> bool:
    """Return whether a map may show water. It looks at the visible cells, at the overview level that the map uses."""
    cells = visible_cells(scene.elevation, view)
    return cells is not None and _cells_may_have_water(scene.elevation, scene.surface(view.grid).lod, cells)


@cached("scene", MIB)
def _cells_may_have_water(elevation: Elevation, overview_level: int, cells: CellRange) -> bool:
    """Return whether any of a raster's cells ``cells`` may lie under water, from heights of cells of ``2**overview_level`` a side.

    If these are more than ``MAX_CELLS_READ``, they are not read. Then the result may be true although there is no water.
    """
    side = 2**overview_level
    slices = block_slices(cells, side, tuple(-(-count // side) for count in elevation.shape), 1)
    if np.prod([rows.stop - rows.start for rows in slices]) > MAX_CELLS_READ:
        overview = elevation.overview
        means = overview.mean_heights_m[block_slices(cells, 2**overview.lod, overview.mean_heights_m.shape, 2)]
        return overview_level < overview.lod or bool(
            np.nanmin(means, initial=np.inf) <= elevation.water_m + WATER_HEIGHT_TOLERANCE_M
        )
    row, col = ((np.arange(rows.start, rows.stop) + 0.5) * side - 0.5 for rows in slices)
    height_m, valid = elevation.heights_at(overview_level, *np.meshgrid(row, col, indexing="ij"))
    return bool((valid & (height_m <= elevation.water_m + WATER_HEIGHT_TOLERANCE_M)).any())


def _eye_zenith_cosines(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> np.ndarray:
    """Return the cosines (n,) of the zenith angles of the eye, as seen from visible water. Empty if no water is visible.

    The cosines are reduced by the spacing of the coarse view. If no point of the coarse view shows water, water between the points
    is searched for (``_submerged_nodes_between``).
    """
    buffer, eye = coarse_view.buffer, coarse_view.eye_frame_m
    points = buffer.position_frame_m[water_mask(buffer, scene)]
    if not len(points):
        points = _submerged_nodes_between(scene, view, coarse_view)
    up = points - scene.world.up_origin(buffer.frame)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    to_eye = eye - points
    cosine = np.einsum("nk,nk->n", to_eye, up) / np.maximum(np.linalg.norm(to_eye, axis=-1), 1e-9)
    return np.clip(cosine - coarse_view.spacing_tangent, 0.0, 1.0)


def _submerged_nodes_between(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> np.ndarray:
    """Return possibly visible nodes of the ground under water, (n, 3) in the frame, in a view whose coarse view shows no water.

    A node is possibly visible if it is not farther than the coarse view's points beside it. The pixels round these nodes are drawn
    to check that. The result is empty if none of the pixels shows water.
    """
    from scipy.ndimage import maximum_filter

    buffer, ground = coarse_view.buffer, coarse_view.buffer.ground
    assert ground is not None and isinstance(buffer.view, PerspectiveView)
    sample_view, is_water = buffer.view, np.abs(ground.height_m - scene.elevation.water_m) <= WATER_HEIGHT_TOLERANCE_M
    points = ground.position_frame_m[is_water]
    eye, camera_from_frame = sample_view.in_frame(buffer.frame)
    in_camera = (points - eye) @ camera_from_frame.T
    points, in_camera = points[in_camera[:, 2] > 0.0], in_camera[in_camera[:, 2] > 0.0]
    first = sample_view.col0, sample_view.row0
    col, row = (
        np.rint((in_camera[:, k] / in_camera[:, 2] * sample_view.focal_px - first[k]) / sample_view.step_px) for k in (0, 1)
    )
    inside = (row >= -1) & (row <= sample_view.rows) & (col >= -1) & (col <= sample_view.cols)
    points, in_camera, row, col = points[inside], in_camera[inside], row[inside].astype(int), col[inside].astype(int)
    far_m = np.full(buffer.valid.shape, np.inf)
    far_m[buffer.valid] = coarse_view.distance_m
    far_m = maximum_filter(far_m, size=3, mode="nearest")[
        np.clip(row, 0, sample_view.rows - 1), np.clip(col, 0, sample_view.cols - 1)
    ]
    is_visible = np.linalg.norm(in_camera, axis=-1) <= far_m * (1.0 + coarse_view.spacing_tangent)
    if not is_visible.any():
        return points[:0]
    pixels_per_sample = round(sample_view.step_px / view.step_px)
    top, left = (max((int(v[is_visible].min()) - 1) * pixels_per_sample, 0) for v in (row, col))
    bottom, right = (min((int(v[is_visible].max()) + 2) * pixels_per_sample, n) for v, n in ((row, view.rows), (col, view.cols)))
    box = view.part(top, left, max(bottom - top, 1), max(right - left, 1))
    if box.rows * box.cols > MAX_SEARCHED_PIXELS:
        return points[is_visible]
    submerged = is_water[ground.triangles].all(axis=1)
    for box_view in (box, finer_view(box)):
        number = RasterisedView(scene, box_view, buffer.frame, caster_kinds=("relief", "meshes")).id_buffer.triangle_number
        triangle_index = number[(number > 0) & (number <= len(submerged))].astype(np.int64) - 1
        if submerged[triangle_index].any():
            return points[is_visible]
    return points[:0]


def _max_change_steps(scene: Scene, view: MapView | PerspectiveView, cosines: np.ndarray) -> int:
    """Return the maximum number of 8-bit steps by which the reflected sky changes the colour of water.

    ``cosines`` (n,) are those of the eye's zenith angles, as seen from the water. The tested colours range from the darkest
    possible water (in shadow, half of the sky hidden) to the brightest (in the light of the sun and all lamps). The test uses the
    same loop as rendering.
    """
    light, night = daylight_of(scene), night_sky_share(scene)
    sine = -1.0 if scene.sun is None else np.sin(np.radians(scene.sun.altitude_deg))
    sky = light.sky_irradiance * (night + (1.0 - night) * twilight_sky_share(sine))
    draped = scene.loaded.level.terrain.imagery is not None
    water_albedo = np.array(scene.style.water_albedo)
    darkest, brightest = (
        (0.0, 1.0)
        if draped
        else (sky_lit_albedo(water_albedo, shading_parameters(scene, view).sky_light_desaturation), water_albedo)
    )
    dark, bright = (
        MIN_SKY_VIEW_FACTOR * sky * darkest,
        (sky + light.sun_irradiance * max(sine, 0.0) + _max_lamp_irradiance(scene)) * brightest,
    )
    bright = np.array([tone_curve(channel) for channel in bright])
    cosine = np.quantile(cosines, np.linspace(0.0, 1.0, TESTED_ANGLE_COUNT))
    tested_colors = (dark + (bright - dark) * np.linspace(0.0, 1.0, TESTED_COLOR_COUNT)[:, None, None] ** 2).astype(np.float32)
    tested_colors = np.ascontiguousarray(np.broadcast_to(tested_colors, (TESTED_COLOR_COUNT, TESTED_ANGLE_COUNT, 3)))
    # Points on a sphere around the eye, above a horizontal plane.
    eye = np.stack([np.sqrt(1.0 - cosine**2), np.zeros_like(cosine), cosine], axis=-1)
    points = np.ascontiguousarray(np.broadcast_to(-eye, tested_colors.shape))
    valid, below, max_steps = np.ones(tested_colors.shape[:2], bool), np.array([0.0, 0.0, -1e12]), 0
    # The sky's colour is monotonic from below the sun to the opposite side, so both ends suffice.
    for to_sun in (np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0])):
        color = tested_colors.copy()
        _add_reflections(color, valid, points, np.zeros(3), below, sky_of(scene), MEAN_SQUARE_WAVE_SLOPE, to_sun, None, None)
        max_steps = max(max_steps, int(np.abs(encode_srgb(color).astype(int) - encode_srgb(tested_colors)).max()))
    return max_steps


def _max_lamp_irradiance(scene: Scene) -> np.ndarray:
    """Return an upper bound of the irradiance (3,) of all lamps on water.

    It is the sum over the lamps of the irradiance directly below each lamp.
    """
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    total = np.zeros(3)
    for lamp in scene.lamps.values():
        height_m = float(scene.world.map_position(scene.elevation.crs, lamp.position_earth_m)[2]) - scene.elevation.water_m
        total += np.array(lamp.color) * lamp.intensity * (lamp.reference_distance_m / max(height_m, 1e-3)) ** 2 * exposure
    return total


def has_glint(scene: Scene, view: MapView | PerspectiveView) -> bool:
    """Return whether glint of the sun can be visible in any direction of a view."""
    if not scene.sun_is_up or scene.sun is None:
        return False
    if isinstance(view, MapView):
        assert scene.highest_sun_deg is not None
        altitude = np.radians(scene.highest_sun_deg)
        to_sun, to_eye = np.array([0.0, np.cos(altitude), np.sin(altitude)]), np.array([[0.0, 0.0, 1.0]])
        up = np.array([0.0, 0.0, 1.0])
    else:
        cols, rows = (
            (first + np.linspace(0, count - 1, GLINT_DIRECTIONS_PER_SIDE) * view.step_px) / view.focal_px
            for first, count in ((view.col0, view.cols), (view.row0, view.rows))
        )
        x, y = (v.ravel() for v in np.meshgrid(cols, rows))
        to_eye = -np.stack([x, y, np.ones_like(x)], axis=-1) @ view.earth_from_camera.T
        to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
        to_sun = scene.sun.to_sun_earth
        up = np.array([0.0, 0.0, 1.0]) if scene.world.is_flat else view.eye_earth_m / np.linalg.norm(view.eye_earth_m)
    brightest = float(daylight_of(scene).sun_irradiance.max())
    return bool(brightest * _largest_glint(to_eye, up, to_sun, MEAN_SQUARE_WAVE_SLOPE) > MAX_INVISIBLE_GLINT)


def apply_water(color: np.ndarray, block: ShadingBlock) -> None:
    """Blend the colour (rows, cols, 3) of water with the reflected sky, and add the sun's glint if it can be visible, in place."""
    buffer, scene, view = block.buffer, block.scene, block.view
    eye = None if isinstance(view, MapView) else view.in_frame(buffer.frame)[0]
    to_sun = np.zeros(3) if scene.sun is None else scene.sun.in_frame(buffer.frame)
    sun = visibility = None
    if has_glint(scene, view) and SUN in block.visibilities:
        sun, visibility = daylight_of(scene).sun_irradiance, block.visibilities[SUN]
    _add_reflections(
        color, water_mask(buffer, scene), buffer.position_frame_m, eye, scene.world.up_origin(buffer.frame), sky_of(scene),
        MEAN_SQUARE_WAVE_SLOPE, to_sun, sun, visibility,
    )  # fmt: skip


@compiled
def _visible_facet_area_and_slope(cosine, mean_square_slope):
    """Return the visible area of the waves' facets, per area of the plane, and the facets' mean slope towards the eye.

    They are ``A(t)`` and the mean visible slope of the module's docstring. ``cosine`` is that of the eye's zenith angle t.
    """
    sine, deviation = np.sqrt(max(1.0 - cosine * cosine, 1e-12)), np.sqrt(0.5 * mean_square_slope)
    a = cosine / (deviation * sine)
    share = 0.5 * (1.0 + erf(a * np.sqrt(0.5)))
    area = cosine * share + deviation * sine * np.exp(-0.5 * a * a) / np.sqrt(2.0 * np.pi)
    return area, deviation * deviation * sine * share / area


@internal
def _sky_reflection(cosine, mean_square_slope):
    """Return mean Fresnel reflectance, sine of the altitude of the reflected sky, and visible area of facets for an eye.

    ``cosine`` is that of the eye's zenith angle.
    """
    area, slope = _visible_facet_area_and_slope(cosine, mean_square_slope)
    deviation = np.sqrt(0.5 * mean_square_slope)
    grazing = (1.0 - cosine) ** (5.0 * np.exp(-2.69 * deviation)) / (1.0 + 22.7 * deviation**1.5)
    eye_dot_normal = slope * np.sqrt(1.0 - cosine * cosine) + cosine
    return (
        NORMAL_INCIDENCE_REFLECTANCE + (1.0 - NORMAL_INCIDENCE_REFLECTANCE) * grazing,
        2.0 * eye_dot_normal / (1.0 + slope * slope) - cosine,
        area,
    )


@compiled
def _glint_share(eye_up_cosine, sun_up_cosine, eye_sun_cosine, visible_area, mean_square_slope):
    """Return the glint divided by the sun's irradiance at normal incidence.

    ``eye_up_cosine``, ``sun_up_cosine`` and ``eye_sun_cosine`` are the cosines of the angles between the directions to the eye, to
    the sun and up. ``visible_area`` is the visible area of the facets (``_visible_facet_area_and_slope``). Glint fades in over the
    first degree of the sun's altitude, like direct light.
    """
    if sun_up_cosine <= 0.0:
        return 0.0
    bisector_length = np.sqrt(
        max(2.0 + 2.0 * eye_sun_cosine, 1e-12)
    )  # the length of eye + sun, whose direction is the facet's normal
    tilt = min((eye_up_cosine + sun_up_cosine) / bisector_length, 1.0)
    if (1.0 / (tilt * tilt) - 1.0) > 25.0 * mean_square_slope:  # only 1e-11 of the waves are so steep
        return 0.0
    fresnel = NORMAL_INCIDENCE_REFLECTANCE + (1.0 - NORMAL_INCIDENCE_REFLECTANCE) * (1.0 - min(0.5 * bisector_length, 1.0)) ** 5
    slopes = np.exp((1.0 - 1.0 / (tilt * tilt)) / mean_square_slope) / (mean_square_slope * tilt**4)
    lit_area, _ = _visible_facet_area_and_slope(sun_up_cosine, mean_square_slope)
    return fresnel * slopes * sun_up_cosine / (4.0 * visible_area * lit_area) * min(np.degrees(sun_up_cosine), 1.0)


@compiled
def _largest_glint(to_eye, up, to_sun, mean_square_slope):
    """Return the largest ``_glint_share`` over directions to the eye.

    ``to_eye`` (n, 3), ``up`` (3,) and ``to_sun`` (3,) are unit vectors.
    """
    largest = 0.0
    sun_up_cosine = up[0] * to_sun[0] + up[1] * to_sun[1] + up[2] * to_sun[2]
    for n in range(to_eye.shape[0]):
        v = to_eye[n]
        eye_up_cosine = max(v[0] * up[0] + v[1] * up[1] + v[2] * up[2], 0.0)
        area, _ = _visible_facet_area_and_slope(eye_up_cosine, mean_square_slope)
        eye_sun_cosine = v[0] * to_sun[0] + v[1] * to_sun[1] + v[2] * to_sun[2]
        largest = max(largest, _glint_share(eye_up_cosine, sun_up_cosine, eye_sun_cosine, area, mean_square_slope))
    return largest


@compiled
def _add_reflections(color, is_water, position, eye, up_origin, sky, mean_square_slope, to_sun, sun_irradiance, sun_visibility):
    """Blend the colour (rows, cols, 3) of pixels in the mask ``is_water`` with the reflected sky, and add glint, in place.

    ``eye`` (3,) is the eye in the local frame; ``None`` in a map. ``sky`` is the result of ``sky_of``. ``sun_irradiance`` (3,) is
    ``None`` without glint. ``sun_visibility`` (rows, cols) is the visible share of the sun.
    """
    # The tests for None are resolved at compile time. No eye means a view from infinitely far above, no sun means no glint. The
    # reflected sky has no glow around the sun, since the glint replaces it.
    below_sun, opposite, zenith, glow, _, fade, sun_altitude = sky
    sky_without_aureole = (below_sun, opposite, zenith, glow, 0.0, fade, sun_altitude)
    fresnel, sine, area = _sky_reflection(1.0, mean_square_slope)
    mirrored_color, azimuth_cosine = np.empty(3), 0.0
    sky_color(sky_without_aureole, sine, azimuth_cosine, mirrored_color)
    for i in range(is_water.shape[0]):
        for j in range(is_water.shape[1]):
            if not is_water[i, j]:
                continue
            p = position[i, j]
            ux, uy, uz = p[0] - up_origin[0], p[1] - up_origin[1], p[2] - up_origin[2]
            length = np.sqrt(ux * ux + uy * uy + uz * uz)
            ux, uy, uz = ux / length, uy / length, uz / length
            if eye is None:
                vx, vy, vz, cosine = ux, uy, uz, 1.0
            else:
                vx, vy, vz = eye[0] - p[0], eye[1] - p[1], eye[2] - p[2]
                length = np.sqrt(vx * vx + vy * vy + vz * vz)
                vx, vy, vz = vx / length, vy / length, vz / length
                cosine = min(max(vx * ux + vy * uy + vz * uz, 0.0), 1.0)
                fresnel, sine, area = _sky_reflection(cosine, mean_square_slope)
                sun_up_cosine = to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz
                eye_sun_cosine = to_sun[0] * vx + to_sun[1] * vy + to_sun[2] * vz
                horizontal_product = np.sqrt(max((1.0 - sun_up_cosine * sun_up_cosine) * (1.0 - cosine * cosine), 1e-12))
                azimuth_cosine = min(max((sun_up_cosine * cosine - eye_sun_cosine) / horizontal_product, -1.0), 1.0)
                sky_color(sky_without_aureole, sine, azimuth_cosine, mirrored_color)
            glint = 0.0
            if sun_irradiance is not None:
                if sun_visibility[i, j] > 0.0:
                    sun_up_cosine = to_sun[0] * ux + to_sun[1] * uy + to_sun[2] * uz
                    eye_sun_cosine = to_sun[0] * vx + to_sun[1] * vy + to_sun[2] * vz
                    glint = sun_visibility[i, j] * _glint_share(cosine, sun_up_cosine, eye_sun_cosine, area, mean_square_slope)
            for k in range(3):
                value = (1.0 - fresnel) * color[i, j, k] + fresnel * mirrored_color[k]
                if sun_irradiance is not None:
                    if glint > 0.0:
                        white = max(sun_irradiance[k] / max(sun_irradiance[0], sun_irradiance[1], sun_irradiance[2]), value)
                        # Weak glint is added linearly. Glint fifty times brighter than the land is compressed and keeps its shape.
                        value += (white - value) * (1.0 - 1.0 / np.sqrt(1.0 + 2.0 * glint * sun_irradiance[k]))
                color[i, j, k] = value


EFFECT = Effect("the sky in standing water, and the sun's glint", judge, facts, "color", apply_water)
