"""Rain and falling snow in perspective views: streaks and flakes between the eye and what it sees.

Drops fall on cylinders round the eye, one for each of a few distances. A cylinder is divided into cells, and a hash of the cell
says whether a drop is in it, and where. With time all cells fall at the drops' speed and drift with a constant wind, so that a drop
moves along one line. A surface nearer than a cylinder hides it.

A streak is as long as the path of a drop during an exposure. One narrower than two pixels or shorter than three is drawn that wide
and long, and fainter. Its smooth profile then always meets pixels' centres, and a moving drop does not flicker.

Farther drops are too small to be seen one by one: they are the haze to which precipitation reduces the visibility
(``skugga.terrain.level.parts.Weather.precipitation_extinction_per_m``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from skugga.terrain.compiled import compiled, internal, run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.scene import Scene
from skugga.terrain.sky import OVERCAST_SKY_COLOR, sky_brightness

NEAREST_LAYER_M, LAYER_DISTANCE_RATIO, LAYER_COUNT = 1.5, 1.6, 7
"""Distance of the nearest cylinder, the ratio of neighbouring distances, and the number of cylinders: up to 25 m."""

EXPOSURE_S = 0.02
"""Time during which a drop moves along its streak."""

WIND_SLOPE = {"rain": 0.12, "snowfall": 0.5}
"""Drift sideways per metre of fall."""

FALL_M_PER_S = {"rain": 7.0, "snowfall": 1.1}
"""Speed of fall of drops of 2 mm (R. Gunn and G. D. Kinzer 1949), and of flakes."""

RADIUS_M = {"rain": 0.001, "snowfall": 0.004}
"""Radius of visible drops and flakes."""

OPACITY = {"rain": 0.55, "snowfall": 0.9}
"""Opacity of a drop and a flake. A drop shows the sky behind it, too."""

DROPS_PER_M3 = {"rain": 60.0, "snowfall": 25.0}
"""Number of visible drops and flakes per cubic metre at 1 mm/h. It grows with the root of the rate."""

CELL_LENGTHS, MAX_CELL_SHARE = 2.0, 0.35
"""Length of a cell in lengths of a streak, and the maximum share of a cell's width that a streak takes."""


class Drops(NamedTuple):
    """The drops of a view.

    Attributes
    ----------
    color
        (3,), linear colour.
    fall_m
        Distance that all drops have fallen since second 0, metres.
    wind_slope, radius_m, length_m, opacity, count_per_m3
        Drift per metre of fall, half the width and the length of a streak, its opacity, and the number of drops per cubic metre.
    """

    color: np.ndarray
    fall_m: float
    wind_slope: float
    radius_m: float
    length_m: float
    opacity: float
    count_per_m3: float


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: ``weather.precipitation`` is ``rain`` or ``snowfall``, and the view is perspective.

    Left out: maps; data (masks, visibilities); no precipitation.
    """
    kind = descriptor.facts["precipitation"]["kind"]
    if kind == "none":
        return Verdict(False, "the level sets no precipitation")
    if descriptor.view_kind == "map":
        return Verdict(False, "a map view has no drops before the eye")
    return Verdict(True, f"{kind} falls before the eye")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of precipitation: its ``kind``."""
    return {"kind": scene.loaded.level.weather.precipitation}


def drops_of(scene: Scene) -> Drops | None:
    """Return the drops of a scene; ``None`` without precipitation."""
    weather = scene.loaded.level.weather
    kind = weather.precipitation
    if kind == "none":
        return None
    radius_m, fall_m_per_s = RADIUS_M[kind], FALL_M_PER_S[kind]
    white = np.array(OVERCAST_SKY_COLOR) if kind == "rain" else np.array([0.92, 0.93, 0.95])
    return Drops(
        white * sky_brightness(scene), scene.clock_seconds * fall_m_per_s, WIND_SLOPE[kind], radius_m,
        2.0 * radius_m + fall_m_per_s * EXPOSURE_S, OPACITY[kind], DROPS_PER_M3[kind] * float(np.sqrt(weather.precipitation_rate)),
    )  # fmt: skip


def apply_precipitation(color: np.ndarray, block: ShadingBlock) -> None:
    """Blend drops and flakes over the colours (rows, cols, 3) of a perspective view, in place."""
    scene, view, buffer = block.scene, block.view, block.buffer
    drops = drops_of(scene)
    if isinstance(view, MapView) or drops is None:
        return
    eye, camera_from_frame = view.in_frame(buffer.frame)
    up = eye - scene.world.up_origin(buffer.frame)
    up = camera_from_frame @ (up / np.linalg.norm(up))
    # The cylinders' azimuths begin at the axis of the earth, so that drops stay where they are as the camera turns.
    axis = view.earth_from_camera.T @ (np.array([0.0, 1.0, 0.0]) if scene.world.is_flat else np.array([0.0, 0.0, 1.0]))
    north = axis - (axis @ up) * up
    length = float(np.linalg.norm(north))
    north = north / length if length > 1e-9 else np.array([1.0, 0.0, 0.0])
    row, col = (indices.ravel() for indices in np.indices(buffer.valid.shape))
    row, col = block.pixels_of_points(row, col)
    pixels = np.array([view.col0, view.row0, view.step_px, view.focal_px, view.pixel_tangent])
    run_in_chunks(
        row.size, _draw_drops, row, col, pixels, np.stack([np.cross(north, up), north, up]), eye, buffer.valid.ravel(),
        buffer.position_frame_m.reshape(-1, 3), drops, color.reshape(-1, 3),
    )  # fmt: skip


@internal
def _hash_share(layer, row, col, seed):
    """Return a pseudo-random number in [0, 1) of a cell."""
    h = np.uint64(layer * 7919 + seed * 104729 + 1) * np.uint64(0x9E3779B97F4A7C15)
    h ^= np.uint64(row + 1073741824) * np.uint64(0xC2B2AE3D27D4EB4F)
    h ^= h >> np.uint64(29)
    h *= np.uint64(0xBF58476D1CE4E5B9)
    h ^= np.uint64(col + 1073741824) * np.uint64(0x165667B19E3779F9)
    h ^= h >> np.uint64(32)
    h *= np.uint64(0x94D049BB133111EB)
    h ^= h >> np.uint64(29)
    return np.float64(h >> np.uint64(11)) / 9007199254740992.0


@compiled
def drop_opacity(layer, azimuth, rise, pixel_tangent, drops):
    """Return the opacity of the drops of one cylinder in a direction.

    ``azimuth`` is in radians, ``rise`` the tangent of the altitude.
    """
    _, fall_m, slope, radius_m, length_m, opacity, count_per_m3 = drops
    distance_m = NEAREST_LAYER_M * LAYER_DISTANCE_RATIO**layer
    # Cells have the same size at every altitude. Otherwise drops would not fall along lines.
    level_pixel_m = pixel_tangent * distance_m
    cell_m = CELL_LENGTHS * max(length_m, 3.0 * level_pixel_m)
    per_m2 = count_per_m3 * distance_m * (LAYER_DISTANCE_RATIO - 1.0)
    width_m = max(1.0 / (per_m2 * cell_m), 2.0 * max(radius_m, level_pixel_m) / MAX_CELL_SHARE)
    pixel_m = level_pixel_m * np.sqrt(1.0 + rise * rise)
    half_width_m, drawn_length_m = max(radius_m, pixel_m), min(max(length_m, 3.0 * pixel_m), cell_m)
    opacity *= radius_m / half_width_m * length_m / drawn_length_m
    columns = max(int(2.0 * np.pi * distance_m / width_m), 1)
    width_m = 2.0 * np.pi * distance_m / columns
    drops_per_cell = per_m2 * cell_m * width_m
    height = distance_m * rise + fall_m
    x = (distance_m * azimuth + slope * height) / width_m
    col = int(np.floor(x))
    col_in_turn = col % columns
    y = height / cell_m + _hash_share(layer, 0, col_in_turn, 3)  # columns are shifted, so that drops do not lie in rows
    row = int(np.floor(y))
    if _hash_share(layer, row, col_in_turn, 0) >= drops_per_cell:
        return 0.0
    margin = min(half_width_m / width_m, 0.5)
    middle = margin + (1.0 - 2.0 * margin) * _hash_share(layer, row, col_in_turn, 1)
    foot = (1.0 - drawn_length_m / cell_m) * _hash_share(layer, row, col_in_turn, 2)
    along = 2.0 * ((y - row - foot) * cell_m / drawn_length_m - 0.5)
    across = (x - col - middle) * width_m / half_width_m
    if abs(along) >= 1.0 or abs(across) >= 1.0:
        return 0.0
    along, across = 1.0 - along * along, 1.0 - across * across
    # Of several drops in a cell, the variation about their mean is seen. The mean is haze.
    return (1.0 - (1.0 - opacity) ** np.sqrt(max(drops_per_cell, 1.0))) * along * along * across * across


@compiled
def _draw_drops(first, last, rows, cols, pixels, axes, eye, valid, position, drops, color):
    """Blend drops over the colours (n, 3) of the points from ``first`` to ``last`` (exclusive), in place.

    ``rows`` and ``cols`` (n,) are the points' pixels. ``pixels`` (5,) holds the view's ``col0``, ``row0``, ``step_px``,
    ``focal_px`` and ``pixel_tangent``. ``axes`` (3, 3) are east, north and up in the camera's axes. ``valid`` (n,) and
    ``position`` (n, 3) are those of the geometry buffer.
    """
    for n in range(first, last):
        cx, cy = (pixels[0] + cols[n] * pixels[2]) / pixels[3], (pixels[1] + rows[n] * pixels[2]) / pixels[3]
        east = cx * axes[0, 0] + cy * axes[0, 1] + axes[0, 2]
        north = cx * axes[1, 0] + cy * axes[1, 1] + axes[1, 2]
        level = max(np.sqrt(east * east + north * north), 1e-6)
        rise = (cx * axes[2, 0] + cy * axes[2, 1] + axes[2, 2]) / level
        if abs(rise) > 20.0:
            continue
        azimuth, surface_m = np.arctan2(east, north), np.inf
        if valid[n]:
            dx, dy, dz = position[n, 0] - eye[0], position[n, 1] - eye[1], position[n, 2] - eye[2]
            surface_m = np.sqrt(dx * dx + dy * dy + dz * dz) / np.sqrt(1.0 + rise * rise)
        transmittance = 1.0
        for layer in range(LAYER_COUNT):
            if NEAREST_LAYER_M * LAYER_DISTANCE_RATIO**layer >= surface_m:
                break
            transmittance *= 1.0 - drop_opacity(layer, azimuth, rise, pixels[4], drops)
        for k in range(3):
            color[n, k] = drops.color[k] + (color[n, k] - drops.color[k]) * transmittance


EFFECT = Effect("streaks of rain and flakes of snow within 25 m of the eye", judge, facts, stage="color", apply=apply_precipitation)
