"""Ground materials: meadows, fields, the floor of woods, bare earth, rock and scree colour natural ground in perspective views.

A level's land cover (``skugga.terrain.ground.land_cover``) and woods say what the ground bears. All other ground is a meadow, as
pale or as green as the style's ramp has it at its height. Whatever bears plants turns into earth, scree and rock with the slope.

**Slopes.** A raster with wide cells has gentler slopes than the ground. The angles at which rock begins fall by
``COARSE_SLOPE_LOSS`` for each factor of ten of the cells' side. Noise of several wavelengths shifts these angles, so that outcrops
have no straight edges.

**Borders.** Borders of polygons blend over the pixel's width, but over ``BORDER_SOFTNESS_M`` at least, and wobble by noise.

**Predicate.** The effect changes the colour of ground at any distance. It is not needed in maps, where no natural ground is in
view, and where the ground is so dark that white ground would not differ from black by more than a step of 255.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.climate import snow_line_m
from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.ground_detail import has_natural_ground, max_code_steps, max_ground_color
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.land_cover import (
    EARTH,
    FOREST_FLOOR,
    ICE,
    PAVED,
    ROCK,
    SAND,
    SCREE,
    SCRUB,
    WATER,
    WETLAND,
    LandCoverIndex,
    covered_share,
)
from skugga.terrain.ground.materials import (
    COVER_ALBEDOS,
    Footprint,
    blended,
    cover_color,
    meadow_color,
    rock_color,
    scree_color,
)
from skugga.terrain.ground.noise import noise_at
from skugga.terrain.ground.patterns import filtered_noise, shown_share
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene
from skugga.terrain.shading import WATER_HEIGHT_TOLERANCE_M

ROCK_ANGLES_DEG, SCREE_ANGLES_DEG, EARTH_ANGLES_DEG = (38.0, 44.0), (28.0, 34.0), (31.0, 40.0)
"""Slopes between which rock, scree in high ground, and bare earth below it begin and are complete, on ground of 1 m cells."""

EARTH_SHARE = 0.55
"""Share of bare earth on steep ground that bears plants."""

COARSE_SLOPE_LOSS = 0.08
"""Share of these angles by which they fall for each factor of ten of the cells' side beyond a metre.

SRTM of 30 m has slopes some 12 % gentler, and of 90 m some 17 %, than lidar of the same mountains.
"""

TREE_LINE_BELOW_SNOW_LINE_M, MAX_TREE_LINE_M, TREE_LINE_HALF_RANGE_M = 1300.0, 1600.0, 400.0
"""Height of the tree line below the snow line, its limit, and half the range over which high ground begins."""

ANGLE_NOISE_DEG, ANGLE_WAVES_M, ANGLE_WAVE_GAIN = 8.0, (140.0, 43.0, 13.0, 3.7, 1.1), 0.68
"""Amplitude of the noise of angles, its wavelengths, and the amplitude of each relative to the one before."""

MAX_ANGLE_NOISE_DEG = 0.9 * sum(ANGLE_NOISE_DEG * ANGLE_WAVE_GAIN**k for k in range(len(ANGLE_WAVES_M)))
"""Upper bound of that noise: the sum of the waves' amplitudes, times that of gradient noise."""

BORDER_SOFTNESS_M, WILD_BORDER_SOFTNESS_M, WILD_COVERS = 0.5, 8.0, (FOREST_FLOOR, SCRUB, WETLAND, ROCK, SCREE, SAND, ICE)
"""Smallest width over which borders blend: those that a plough or a mower draws, and those of what grows or falls by itself."""

BORDER_WOBBLE_SHARE, BORDER_WAVE_M, WILD_BORDER_WAVE_M = 0.7, 3.1, 13.0
"""Amplitude of the noise of borders as a share of these widths, and its wavelengths."""

MIN_VIEW_COSINE = 0.02
"""Lower bound of the cosine between the view and the ground's normal."""

MAX_SUN_TANGENT = 1.6
"""Limit of the tangent of the angle between the sun and the ground's normal. In a lower sun stones and clods shade each other."""

_ALBEDOS = np.array(COVER_ALBEDOS)
_BARREN_COVERS = (ROCK, SCREE, SAND, PAVED, WATER, ICE)
_IS_BARREN, _IS_WILD = (
    np.array([cover in covers for cover in range(len(COVER_ALBEDOS))]) for covers in (_BARREN_COVERS, WILD_COVERS)
)


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view in which natural ground shows.

    Left out: maps; floors, draped imagery, and the styles ``urban``, ``grey`` and ``analysis``; no ground in view; ground so dark
    that white and black differ by at most a step of 255.
    """
    facts = descriptor.facts["ground_materials"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows the ground's tints only")
    if not facts["natural"]:
        return Verdict(False, "the level shows no natural ground: a floor, imagery, stone or a neutral base keeps its colour")
    nearest_m, steps = numeric_fact(facts["nearest_m"]), numeric_fact(facts["steps"])
    if nearest_m is None or steps is None:
        return Verdict(False, "no ground is in view")
    if steps <= 1.0:
        return Verdict(False, f"the ground is too dark: its materials change it by at most {steps:.1g} of 255 steps")
    return Verdict(True, f"ground from {nearest_m:.0f} m on shows meadows, earth or rock: up to {steps:.0f} of 255 steps")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of ground materials.

    - ``natural``: whether the level's ground is natural: neither a floor nor imagery, stone or a neutral base.
    - ``nearest_m``: distance of the nearest visible ground, metres; ``None`` if no ground is visible.
    - ``steps``: upper bound of the change of the picture, in steps of 255; ``None`` if no ground is visible.
    """
    nothing: dict[str, Fact] = {"natural": has_natural_ground(scene), "nearest_m": None, "steps": None}
    if coarse_view is None or isinstance(view, MapView):
        return nothing
    ground = coarse_view.buffer.surface_kind[coarse_view.buffer.valid] == RELIEF
    distance_m = coarse_view.distance_m[ground]
    if not len(distance_m):
        return nothing
    # Ground of any albedo up to 1 becomes ground of any other.
    return {**nothing, "nearest_m": float(distance_m.min()), "steps": max_code_steps(max_ground_color(scene), 1.0)}


def tree_line_m(scene: Scene) -> float:
    """Return the height of the tree line at a scene's anchor, metres."""
    if scene.world.is_flat:
        return MAX_TREE_LINE_M
    anchor = scene.world.anchor_earth_m
    latitude = np.degrees(np.arcsin(anchor[2] / np.linalg.norm(anchor)))
    return min(float(snow_line_m(np.array([latitude]))[0]) - TREE_LINE_BELOW_SNOW_LINE_M, MAX_TREE_LINE_M)


def angle_factor(scene: Scene) -> float:
    """Return the factor of the angles of rock, scree and earth for the cells of a scene's raster."""
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    return 1.0 - COARSE_SLOPE_LOSS * float(np.log10(max(cell_m, 1.0)))


def apply_ground_materials(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Replace the albedo (rows, cols, 3) of natural ground in a perspective view by that of its materials, in place."""
    buffer, scene, view = block.buffer, block.scene, block.view
    if isinstance(view, MapView) or not has_natural_ground(scene):
        return
    anchor_from_frame = scene.world.anchor_from_frame(buffer.frame)
    to_sun = scene.sun.in_frame(buffer.frame) if scene.sun is not None and scene.sun_is_up else np.zeros(3)
    cover = scene.objects.land_cover
    index = _NO_LAND_COVER if cover is None else cover.index
    angles = np.array([*ROCK_ANGLES_DEG, *SCREE_ANGLES_DEG, *EARTH_ANGLES_DEG]) * angle_factor(scene)
    run_in_chunks(
        len(albedo), _write_materials, albedo, buffer.shading_inputs, anchor_from_frame, scene.world.up_origin(buffer.frame),
        scene.elevation.water_m + WATER_HEIGHT_TOLERANCE_M, view.in_frame(buffer.frame)[0], view.pixel_tangent, to_sun, angles,
        tree_line_m(scene), _ALBEDOS, _IS_BARREN, _IS_WILD, index,
    )  # fmt: skip


_NO_LAND_COVER = LandCoverIndex(
    0.0, 0.0, 1.0, np.zeros(2, np.int64), np.zeros(1, np.int64), np.zeros(0, np.int32), np.zeros(0, np.bool_),
    np.zeros(1, np.int64), np.zeros((0, 4)), np.zeros(0, np.uint8), np.zeros((0, 2)),
)  # fmt: skip


@compiled
def _write_materials(
    first, last, albedo, shading_inputs, anchor_from_frame, up_origin, water_m, eye, pixel, to_sun, angles, tree_line, albedos,
    is_barren, is_wild, index,
):  # fmt: skip
    """Replace the albedo (rows, cols, 3) of ground in the rows from ``first`` to ``last`` (exclusive), in place.

    ``anchor_from_frame`` is the rotation (3, 3) and the translation (3,) to the anchor's axes. ``up_origin`` (3,) is the point from
    which "up" points away. Ground below ``water_m`` metres does not change. ``eye`` (3,) is the eye in the frame, ``to_sun`` (3,)
    the direction to the sun or 0, and ``pixel`` the side of a pixel as a tangent. ``angles`` (6,) are the slopes of rock, scree and
    earth in degrees. ``albedos`` (n, 3) is ``COVER_ALBEDOS``, ``is_barren`` (n,) whether a class bears no plants on any slope, and
    ``is_wild`` (n,) whether its borders are soft.
    """
    valid, kind, position, height, normal = shading_inputs
    rotation, origin = anchor_from_frame
    west, south, cell_m, counts, first_candidate, polygon, has_centre, first_edge, edges, cover, row_direction = index
    rows, cols = counts[0], counts[1]
    level_cosine = np.cos(np.radians(max(min(angles[0], angles[2], angles[4]) - MAX_ANGLE_NOISE_DEG, 0.0)))
    r00, r01, r02, r10, r11, r12 = rotation[0, 0], rotation[0, 1], rotation[0, 2], rotation[1, 0], rotation[1, 1], rotation[1, 2]
    for i in range(first, last):
        for j in range(valid.shape[1]):
            if not valid[i, j] or kind[i, j] != RELIEF or height[i, j] <= water_m:
                continue
            px, py, pz = position[i, j, 0], position[i, j, 1], position[i, j, 2]
            nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
            ux, uy, uz = px - up_origin[0], py - up_origin[1], pz - up_origin[2]
            up = np.sqrt(ux * ux + uy * uy + uz * uz)
            cos_slope = min(max((nx * ux + ny * uy + nz * uz) / up, 0.0), 1.0)
            is_steep = cos_slope < level_cosine
            point_x, point_y = r00 * px + r01 * py + r02 * pz + origin[0], r10 * px + r11 * py + r12 * pz + origin[1]
            col, row = int(np.floor((point_x - west) / cell_m)), int(np.floor((point_y - south) / cell_m))
            start, end = 0, 0
            if 0 <= col < cols and 0 <= row < rows:
                start, end = first_candidate[row * cols + col], first_candidate[row * cols + col + 1]
            meadow = meadow_color(np.float64(albedo[i, j, 0]), np.float64(albedo[i, j, 1]), np.float64(albedo[i, j, 2]))
            color, plant_share = meadow, 1.0
            if is_steep or end > start:
                dx, dy, dz = px - eye[0], py - eye[1], pz - eye[2]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                cosine = (nx * dx + ny * dy + nz * dz) / max(distance, 1e-9)
                across = pixel * distance
                along = across / max(abs(cosine), MIN_VIEW_COSINE)
                vertical = along
                if is_steep:
                    # Heights within the pixel: along the line of sight on the ground, and across it.
                    tx, ty, tz = dx / distance - cosine * nx, dy / distance - cosine * ny, dz / distance - cosine * nz
                    rise = (tx * ux + ty * uy + tz * uz) / up
                    square = rise * rise / max(1.0 - cosine * cosine, 1e-9)
                    vertical = np.sqrt(along * along * square + across * across * max(1.0 - cos_slope * cos_slope - square, 0.0))
                lit = nx * to_sun[0] + ny * to_sun[1] + nz * to_sun[2]
                scale = 1.0 / max(lit, np.sqrt(max(1.0 - lit * lit, 0.0)) / MAX_SUN_TANGENT) if lit > 0.0 else 0.0
                sx, sy, sz = scale * (to_sun[0] - lit * nx), scale * (to_sun[1] - lit * ny), scale * (to_sun[2] - lit * nz)
                east, north = r00 * dx + r01 * dy + r02 * dz, r10 * dx + r11 * dy + r12 * dz
                horizontal = 1.0 / max(np.sqrt(east * east + north * north), 1e-9)
                at = Footprint(
                    point_x, point_y, np.float64(height[i, j]), across, along, vertical, east * horizontal, north * horizontal,
                    r00 * sx + r01 * sy + r02 * sz, r10 * sx + r11 * sy + r12 * sz,
                )  # fmt: skip
                if end > start:
                    remaining, plant_share = 1.0, 0.0
                    red, green, blue = 0.0, 0.0, 0.0
                    for k in range(start, end):
                        n = polygon[k]
                        if first_edge[k] == first_edge[k + 1]:
                            share = remaining if has_centre[k] else 0.0
                        else:
                            softness, wave = (
                                (WILD_BORDER_SOFTNESS_M, WILD_BORDER_WAVE_M)
                                if is_wild[cover[n]]
                                else (BORDER_SOFTNESS_M, BORDER_WAVE_M)
                            )
                            x, y, wobble = at.x, at.y, BORDER_WOBBLE_SHARE * softness * shown_share(wave, along)
                            if wobble > 0.0:
                                u, v = at.x / wave, at.y / wave
                                x, y = x + wobble * noise_at(u, v, 91), y + wobble * noise_at(u, v, 92)
                            share = min(remaining, covered_share(
                                x, y, k, west + (col + 0.5) * cell_m, south + (row + 0.5) * cell_m, has_centre, first_edge, edges,
                                across, along, at.view_x, at.view_y, softness,
                            ))  # fmt: skip
                        if share > 0.0:
                            variation = ((n * 7919) % 101) / 50.0 - 1.0
                            part = cover_color(cover[n], albedos, meadow, at, row_direction[n, 0], row_direction[n, 1], variation)
                            red, green, blue = red + share * part[0], green + share * part[1], blue + share * part[2]
                            if not is_barren[cover[n]]:
                                plant_share += share
                            remaining -= share
                        if remaining <= 0.0:
                            break
                    color = red + remaining * meadow[0], green + remaining * meadow[1], blue + remaining * meadow[2]
                    plant_share += remaining
                if is_steep and plant_share > 0.0:
                    color = _steep_color(color, plant_share, np.degrees(np.arccos(cos_slope)), at, angles, tree_line, albedos)
            albedo[i, j, 0], albedo[i, j, 1], albedo[i, j, 2] = color[0], color[1], color[2]


@internal
def _steep_color(color, plant_share, slope_deg, at, angles, tree_line, albedos):
    """Return the albedo of ground with a slope. A share of it would bear plants on level ground, where its albedo is ``color``."""
    noise, amplitude = 0.0, ANGLE_NOISE_DEG
    for wavelength in ANGLE_WAVES_M:
        noise += amplitude * filtered_noise(at.x, at.y, wavelength, at.along, 95)
        amplitude *= ANGLE_WAVE_GAIN
    angle = slope_deg + noise
    high = smoothstep_value(0.5 + 0.5 * (at.height + 12.0 * noise - tree_line) / TREE_LINE_HALF_RANGE_M)
    rock = smoothstep_value((angle - angles[0]) / (angles[1] - angles[0])) * plant_share
    scree = high * smoothstep_value((angle - angles[2]) / (angles[3] - angles[2])) * plant_share
    earth = EARTH_SHARE * (1.0 - high) * smoothstep_value((angle - angles[4]) / (angles[5] - angles[4])) * plant_share
    if earth > 0.0:
        color = blended(color, (albedos[EARTH, 0], albedos[EARTH, 1], albedos[EARTH, 2]), earth)
    if scree > 0.0 and rock < plant_share:
        color = blended(color, scree_color((albedos[SCREE, 0], albedos[SCREE, 1], albedos[SCREE, 2]), at), scree)
    if rock > 0.0:
        color = blended(color, rock_color((albedos[ROCK, 0], albedos[ROCK, 1], albedos[ROCK, 2]), at), rock)
    return color


EFFECT = Effect(
    "meadows, fields, woods, earth, rock and scree, by slope, height and ``land_cover``",
    judge,
    facts,
    "albedo",
    apply_ground_materials,
)
