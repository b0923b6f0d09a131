"""Roads and rivers: the lines of a level colour its ground (``skugga.terrain.ground.draped_lines``).

**Rendering.** The albedo of ground is blended with that of water, asphalt or gravel by the share of the pixel that a line covers.
In a perspective view a pixel is longer along the line of sight, by the cosine between the view and the ground's normal. Roads cross
over rivers. Standing water (``water:``) lies over both. The style ``analysis`` shows no lines.

**Predicate.** No line of a map covers more of a pixel than the widest one in view does at its centre. In a perspective view the
pixels on a segment are at least as wide as they are at the distance of the nearest point of a sphere around it. The effect is not
needed if this share changes no colour by more than a step of 255, even from white to black.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, Effect, ShadingBlock, Verdict, pixel_size
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.draped_lines import REACH_WIDTHS, DrapedLines, covered_shares, find_cell, pixel_share
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene
from skugga.terrain.shading import WATER_HEIGHT_TOLERANCE_M

LINE_ALBEDOS = ((0.155, 0.155, 0.165), (0.42, 0.37, 0.29), (0.055, 0.105, 0.135))
"""Linear albedos of asphalt, gravel and rivers."""

MAP_LINE_ALBEDOS = {"swiss": ((0.93, 0.92, 0.89), (0.80, 0.75, 0.64), (0.16, 0.33, 0.50))}
"""Linear albedos in maps of a style, as cartographers draw them."""

GREY_LINE_ALBEDOS = ((0.30,) * 3, (0.50,) * 3, (0.20,) * 3)
"""Linear albedos in the neutral style ``grey``."""

MAX_INVISIBLE_SHARE = SRGB_CHANNEL_STEP / 12.92
"""Share of a pixel that changes no colour by more than a step of 255: 12.92 is the largest slope of sRGB."""

MIN_VIEW_COSINE = 0.02
"""Lower bound of the cosine between the view and the ground's normal."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a line in view covers so much of a pixel that a colour can change by more than a step of 255.

    Left out: no lines in the level or in view; pixels 16 times as wide as the widest line in view; the style ``analysis``.
    """
    facts = descriptor.facts["roads"]
    share = numeric_fact(facts["share"])
    if not facts["lines"]:
        return Verdict(False, "the level has no roads and no rivers")
    if not facts["styled"]:
        return Verdict(False, "the style shows no roads and no rivers")
    if share is None:
        return Verdict(False, "no road and no river lies in view")
    if share <= MAX_INVISIBLE_SHARE:
        return Verdict(False, "pixels are too wide for the roads and rivers in view")
    return Verdict(True, f"roads or rivers cover up to {100.0 * share:.2g} % of a pixel")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of roads and rivers.

    - ``lines``: whether the level has any.
    - ``styled``: whether the style shows them.
    - ``share``: upper bound of the share of a pixel that a line covers; ``None`` if no line lies in view.
    """
    lines, styled = scene.objects.lines, scene.style.name != "analysis"
    if lines is None or not styled:
        return {"lines": lines is not None, "styled": styled, "share": None}
    if isinstance(view, MapView):
        pixel_m = map_pixel_m(scene.world, view)
        width_m = lines.index.width_m[_segments_in_map(scene, view, lines, pixel_m)]
        pixels_m = np.full(len(width_m), pixel_m)
    else:
        width_m, pixels_m = _segments_in_perspective(view, scene, lines)
    pairs = set(zip(width_m.tolist(), pixels_m.tolist(), strict=True))
    share = max((float(pixel_share(0.0, *pair)) for pair in pairs), default=None)
    return {"lines": True, "styled": True, "share": share}


def _segments_in_map(scene: Scene, view: MapView, lines: DrapedLines, pixel_m: float) -> np.ndarray:
    """Return the mask (n,) of segments whose bounds in a map's CRS, with twice their reach as a margin, overlap the map."""
    x, y, _ = scene.world.map_position(view.grid.crs, lines.ends_earth_m)
    west, south, east, north = view.bounds
    margin = 2.0 * (REACH_WIDTHS * lines.index.width_m / pixel_m + 1.0)
    margin_x, margin_y = margin * (east - west) / view.cols, margin * (north - south) / view.rows
    in_x = (x.max(axis=1) + margin_x >= west) & (x.min(axis=1) - margin_x <= east)
    return in_x & (y.max(axis=1) + margin_y >= south) & (y.min(axis=1) - margin_y <= north)


def _segments_in_perspective(view: PerspectiveView, scene: Scene, lines: DrapedLines) -> tuple[np.ndarray, np.ndarray]:
    """Return the widths of segments in a perspective view, and lower bounds of the pixels' widths on them, metres (n,)."""
    frame = view.frame(scene.world)
    eye, camera_from_frame = view.in_frame(frame)
    ends = (frame.points_from_earth(lines.ends_earth_m) - eye) @ camera_from_frame.T
    middle = ends.mean(axis=1)
    radius = 0.5 * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) + REACH_WIDTHS * lines.index.width_m
    tangent_x = max(abs(view.col0), abs(view.col0 + view.cols * view.step_px)) / view.focal_px
    tangent_y = max(abs(view.row0), abs(view.row0 + view.rows * view.step_px)) / view.focal_px
    in_view = middle[:, 2] > -radius
    for axis, tangent in ((0, tangent_x), (1, tangent_y)):
        in_view &= np.abs(middle[:, axis]) <= tangent * middle[:, 2] + radius * np.hypot(1.0, tangent)
    distance_m = np.maximum(np.linalg.norm(middle, axis=1) - radius, 0.0)
    return lines.index.width_m[in_view], view.pixel_tangent * distance_m[in_view]


def line_albedos(scene: Scene, view: MapView | PerspectiveView) -> np.ndarray:
    """Return the linear albedos (3, 3) of asphalt, gravel and rivers in a view."""
    style = scene.style.name
    if style == "grey":
        return np.array(GREY_LINE_ALBEDOS)
    return np.array(MAP_LINE_ALBEDOS.get(style, LINE_ALBEDOS) if isinstance(view, MapView) else LINE_ALBEDOS)


def apply_roads(albedo: np.ndarray, block: ShadingBlock) -> None:
    """Blend the albedo (rows, cols, 3) of ground with that of roads and rivers, in place."""
    buffer, scene = block.buffer, block.scene
    lines = scene.objects.lines
    if lines is None or scene.style.name == "analysis":
        return
    run_in_chunks(
        len(albedo), _blend_lines, albedo, buffer.shading_inputs, scene.world.anchor_from_frame(buffer.frame),
        scene.elevation.water_m + WATER_HEIGHT_TOLERANCE_M, pixel_size(block), lines.index, line_albedos(scene, block.view),
    )  # fmt: skip


@compiled
def _blend_lines(first, last, albedo, shading_inputs, anchor_from_frame, water_m, size, index, colors):
    """Blend the albedo (rows, cols, 3) of the rows from ``first`` to ``last`` (exclusive) with ``colors`` (3, 3), in place.

    ``anchor_from_frame`` is the rotation (3, 3) and the translation (3,) to the anchor's axes. Ground below ``water_m`` metres does
    not change. ``size`` is a ``PixelSize`` and ``index`` a ``LineIndex``.
    """
    valid, kind, position, height, normal = shading_inputs
    rotation, origin = anchor_from_frame
    eye, tangent, map_pixel = size
    for i in range(first, last):
        for j in range(valid.shape[1]):
            if not valid[i, j] or kind[i, j] != RELIEF or height[i, j] <= water_m:
                continue
            p, n = position[i, j], normal[i, j]
            x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
            y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
            cell = find_cell(x, y, index)
            if cell < 0:
                continue
            across, along, view_x, view_y = map_pixel, map_pixel, 1.0, 0.0
            if tangent > 0.0:
                dx, dy, dz = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                distance = np.sqrt(dx * dx + dy * dy + dz * dz)
                facing = abs(n[0] * dx + n[1] * dy + n[2] * dz) / max(distance, 1e-9)
                across = tangent * distance
                along = across / max(facing, MIN_VIEW_COSINE)
                east = rotation[0, 0] * dx + rotation[0, 1] * dy + rotation[0, 2] * dz
                north = rotation[1, 0] * dx + rotation[1, 1] * dy + rotation[1, 2] * dz
                horizontal = np.sqrt(east * east + north * north)
                if horizontal > 0.0:
                    view_x, view_y = east / horizontal, north / horizontal
            road, river, road_kind = covered_shares(x, y, cell, index, across, along, view_x, view_y)
            for k in range(3):
                color = albedo[i, j, k] + river * (colors[2, k] - albedo[i, j, k])
                albedo[i, j, k] = color + road * (colors[road_kind, k] - color)


EFFECT = Effect("roads and rivers of the level file", judge, facts, stage="albedo", apply=apply_roads)
