"""Façades: windows, doors, plinths and shutters on the walls of a level's buildings, and tiles or seams on their sloped roofs.

**Rendering.** The albedo of walls and roofs of buildings (extruded footprints) follows ``skugga.terrain.effects.facade_pattern``.
Models have no façades. Glass mirrors a part of the sky. Shapes and shadows do not change. The styles ``grey`` and ``analysis``,
which show no materials, have none.

**Antialiasing.** A pixel is as wide on a wall as at its distance, and longer along the line of sight by the cosine between the
view and the wall's normal. Its extent along both axes of the wall filters the pattern.

**Predicate.** The contrast of a pattern is 0 where its period, at most ``MAX_PERIOD_M``, spans two pixels or less. Pixels on a
building are at least as wide as they are at the nearest point of a sphere around it. The effect is not needed if the remaining
contrast changes no colour by more than a step of 255, even from the brightest colour in the level's light to black.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, Effect, ShadingBlock, Verdict
from skugga.terrain.effects.facade_pattern import (
    MAX_GAIN,
    MAX_PERIOD_M,
    MIN_GAIN,
    REFLECTION_TINT,
    SEAM_CONTRAST,
    SEAM_PITCH_M,
    SEAM_SHARE,
    SHEET_CONTRAST,
    SHEET_PITCH_M,
    SHEET_SHARE,
    glass_variation,
    mirrored_light,
    resolved_share,
    seam_factor,
    tile_factor,
    weather_factor,
    write_wall_color,
)
from skugga.terrain.effects.ground_detail import max_ground_color
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.meshes.facade_layout import (
    BAY_PITCH,
    DOOR_COLORS,
    FRAME_COLORS,
    SHUTTER_COLORS,
    STOREY_PITCH,
)
from skugga.terrain.scene import Scene
from skugga.terrain.srgb import linear_of_srgb, srgb_of_linear

WALL, TILES, SEAMS = 0, 1, 2
"""Kinds of façades, as in ``skugga.terrain.meshes.facades``. All others are flat roofs."""

STYLES_WITHOUT_MATERIALS = ("grey", "analysis")

MIN_VIEW_COSINE = 0.02
"""Lower bound of the cosine between the view and the wall's normal."""

MAX_INVISIBLE_SHARE = SRGB_CHANNEL_STEP / 12.92
"""Contrast that changes no colour by more than a step of 255: 12.92 is the largest slope of sRGB."""

_COLORS = tuple(linear_of_srgb(np.array(colors)) for colors in (FRAME_COLORS, SHUTTER_COLORS, DOOR_COLORS))


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a perspective view with a building so near that pixels show a part of its windows' contrast, and a colour can change by
    more than a step of 255.

    Left out: maps; levels without footprints of buildings (models have no façades); buildings that are all too far away or too
    dark; the styles ``grey`` and ``analysis``.
    """
    facts = descriptor.facts["facades"]
    if descriptor.view_kind == "map":
        return Verdict(False, "a map shows buildings from above, in plain colours")
    if not facts["buildings"]:
        return Verdict(False, "the level has no buildings")
    if not facts["styled"]:
        return Verdict(False, "the style shows no materials")
    nearest_m, share = numeric_fact(facts["nearest_m"]), numeric_fact(facts["share"])
    if nearest_m is None or share is None:
        return Verdict(False, "no building is in view")
    if share <= MAX_INVISIBLE_SHARE:
        return Verdict(False, f"the nearest building is {nearest_m:.0f} m away, where pixels are too wide for its windows")
    steps = numeric_fact(facts.get("steps"))
    if steps is not None and steps <= 1.0:
        return Verdict(False, f"buildings are too dark: windows change them by at most {steps:.1g} of 255 steps")
    return Verdict(True, f"a building {nearest_m:.0f} m away shows {100.0 * share:.0f} % of the contrast of its windows")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of façades.

    - ``buildings``: whether the level has any; not known in maps.
    - ``styled``: whether the style shows materials.
    - ``nearest_m``: lower bound of the distance of buildings in view, metres; ``None`` if none is in view.
    - ``share``: upper bound of the share of a pattern's contrast that pixels show; ``None`` if no building is in view.
    - ``steps``: upper bound of the change of the picture, in steps of 255; ``None`` if no building is in view.
    """
    styled = scene.style.name not in STYLES_WITHOUT_MATERIALS
    nothing: dict[str, Fact] = {"buildings": False, "styled": styled, "nearest_m": None, "share": None, "steps": None}
    facades = None if isinstance(view, MapView) else scene.objects.facades
    if facades is None or isinstance(view, MapView):
        return nothing
    frame = view.frame(scene.world)
    eye, camera_from_frame = view.in_frame(frame)
    centre = (frame.points_from_earth(facades.centre_earth_m) - eye) @ camera_from_frame.T
    tangent_x = max(abs(view.col0), abs(view.col0 + view.cols * view.step_px)) / view.focal_px
    tangent_y = max(abs(view.row0), abs(view.row0 + view.rows * view.step_px)) / view.focal_px
    in_view = centre[:, 2] > -facades.radius_m
    for axis, tangent in ((0, tangent_x), (1, tangent_y)):
        in_view &= np.abs(centre[:, axis]) <= tangent * centre[:, 2] + facades.radius_m * np.hypot(1.0, tangent)
    if not in_view.any():
        return {**nothing, "buildings": True}
    distance_m = np.maximum((np.linalg.norm(centre, axis=1) - facades.radius_m)[in_view], 0.0)
    nearest_m = float(distance_m.min())
    share = float(max_contrast(facades.max_period_m[in_view], view.pixel_tangent * distance_m).max())
    steps = 255.0 * float(srgb_of_linear(np.array(share * max_ground_color(scene))))
    return {**nothing, "buildings": True, "nearest_m": nearest_m, "share": share, "steps": steps}


def max_contrast(period_m: np.ndarray, pixel_m: np.ndarray) -> np.ndarray:
    """Return upper bounds (n,) of the share of a pattern's contrast that remains, for its period and the width of pixels."""
    return np.clip(np.minimum(period_m, MAX_PERIOD_M) / (2.0 * np.maximum(pixel_m, 1e-9)) - 1.0, 0.0, 1.0)


def apply_facades(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Draw windows, doors and tiles on the albedo (rows, cols, 3) of buildings in a perspective view, in place."""
    buffer, scene, view = block.buffer, block.scene, block.view
    facades = None if isinstance(view, MapView) else scene.objects.facades
    if facades is None or buffer.mesh_triangle is None or scene.style.name in STYLES_WITHOUT_MATERIALS:
        return
    assert isinstance(view, PerspectiveView)
    frame = buffer.frame
    run_in_chunks(
        len(albedo), _draw_facades, albedo, buffer.mesh_triangle, buffer.position_frame_m, view.in_frame(frame)[0],
        view.pixel_tangent,
        np.ascontiguousarray(frame.frame_from_earth.T), frame.origin_earth_m,
        (facades.row_of_triangle, facades.kind, facades.origin_earth_m, facades.along_earth, facades.up_earth, facades.layout,
         facades.seed), _COLORS,
    )  # fmt: skip


@compiled
def _draw_facades(first, last, albedo, mesh_triangle, position, eye, tangent, earth_from_frame, frame_origin, facades, colors):
    """Draw façades on the albedo (rows, cols, 3) of the rows from ``first`` to ``last`` (exclusive), in place.

    ``facades`` are the arrays of ``Facades``, from ``row_of_triangle`` to ``seed``. ``eye`` (3,) is the eye in the frame, and
    ``tangent`` the side of a pixel as a tangent.
    """
    row_of_triangle, kinds, origins, alongs, ups, layout, seeds = facades
    color, mean, wall = np.empty(3), np.empty(3), np.empty(3)
    mean_row = -1
    for i in range(first, last):
        for j in range(mesh_triangle.shape[1]):
            if mesh_triangle[i, j] < 0:
                continue
            r = row_of_triangle[mesh_triangle[i, j]]
            if r < 0:
                continue
            u, v, sight_u, sight_v = 0.0, 0.0, 0.0, 0.0
            squared_distance = 0.0
            for k in range(3):
                point, sight = frame_origin[k] - origins[r, k], 0.0
                for m in range(3):
                    point += earth_from_frame[k, m] * position[i, j, m]
                    sight += earth_from_frame[k, m] * (position[i, j, m] - eye[m])
                u, v = u + point * alongs[r, k], v + point * ups[r, k]
                sight_u, sight_v = sight_u + sight * alongs[r, k], sight_v + sight * ups[r, k]
                squared_distance += sight * sight
            distance = np.sqrt(squared_distance)
            width = tangent * distance
            if 2.0 * width >= MAX_PERIOD_M or distance == 0.0:
                continue
            in_plane = sight_u * sight_u + sight_v * sight_v
            facing = max(np.sqrt(max(squared_distance - in_plane, 0.0)) / distance, MIN_VIEW_COSINE)
            extent_u, extent_v = width, width
            if in_plane > 0.0:
                # The pixel's ellipse on the plane: its long axis lies along the line of sight.
                stretch = 1.0 / (facing * facing) - 1.0
                extent_u = width * np.sqrt(1.0 + stretch * sight_u * sight_u / in_plane)
                extent_v = width * np.sqrt(1.0 + stretch * sight_v * sight_v / in_plane)
            if kinds[r] != WALL:
                factor = weather_factor(u, v, extent_u, extent_v, seeds[r])
                if kinds[r] == TILES:
                    factor *= tile_factor(u, v, extent_u, extent_v, seeds[r])
                elif kinds[r] == SEAMS:
                    factor *= seam_factor(u, extent_u, SEAM_PITCH_M, SEAM_SHARE, SEAM_CONTRAST)
                else:
                    factor *= seam_factor(u, extent_u, SHEET_PITCH_M, SHEET_SHARE, SHEET_CONTRAST)
                for k in range(3):
                    albedo[i, j, k] = min(albedo[i, j, k] * factor, 1.0)
                continue
            fade_u = resolved_share(layout[r, BAY_PITCH], extent_u)
            fade_v = resolved_share(layout[r, STOREY_PITCH], extent_v)
            if fade_u <= 0.0 and fade_v <= 0.0:
                continue
            for k in range(3):
                wall[k] = albedo[i, j, k]
            if mean_row != r:
                mean_row = r
                write_wall_color(mean, wall, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, layout, r, colors)
            glass = write_wall_color(color, wall, u, v, 0.5 * extent_u, 0.5 * extent_v, fade_u, fade_v, layout, r, colors)
            mirrored, curtain = 0.0, 0.0
            if glass > 0.0:
                contrast = glass * fade_u * fade_v
                mirrored = contrast * mirrored_light(facing, sight_v / distance)
                curtain = contrast * glass_variation(u, v, layout, r, seeds[r])
            for k in range(3):
                gain = min(max(wall[k] / max(mean[k], 1e-6), MIN_GAIN), MAX_GAIN)
                value = gain * color[k] + wall[k] - gain * mean[k] + curtain + mirrored * REFLECTION_TINT[k]
                albedo[i, j, k] = min(max(value, 0.0), 1.0)


EFFECT = Effect("windows, doors and roof tiles of buildings", judge, facts, stage="albedo", apply=apply_facades)
