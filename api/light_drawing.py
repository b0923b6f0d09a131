"""Draw the layers that show a light's maps: lines over the eye's picture, what the light sees, and the post-perspective space."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.passes import CASTER_LINE, MAP_LINE, RECEIVER_LINE

if TYPE_CHECKING:
    from skugga.shadows.line_drawing import Line
    from skugga.shadows.render import Frame

MAP_COLORS = np.array([(230, 159, 0), (86, 180, 233), (0, 158, 115), (204, 121, 167)])
"""sRGB colours of maps, from the nearest on, which colour-blind readers can tell apart (Okabe and Ito 2008)."""

RECEIVER_COLOR, CASTER_COLOR = (255, 255, 255), (213, 60, 20)
"""sRGB colours of the boxes of receivers and of casters."""

EDGE_COLOR, RAY_COLOR = (40, 40, 40), (240, 190, 0)
"""sRGB colours of the edges of a post-perspective space, and of the rays to the light in it."""

BACKGROUND_COLOR, UNSEEN_COLOR = (244, 244, 242), (176, 176, 180)
"""sRGB colours of a post-perspective space where nothing is, and where the eye sees nothing."""

OUTLINE_OPACITY = 0.55
"""Opacity of the dark outline of lines over a picture, by which they show on any ground."""

DEPTH_TOLERANCE = 0.01
"""Share of its distance by which a line may lie behind a surface, and still is visible."""

NEAR_SHARE = 0.02
"""Distance from the eye at which lines are cut, as a share of that of the nearest visible point."""

MIN_TONE, MAX_TONE = 40.0, 235.0
"""Gray of what is farthest from the light and of what is nearest to it."""

RELIEF_SHARE = 0.35
"""Share of a light's view that the slope of its surfaces takes from their tone."""


def draw_lines_over_frame(lines: np.ndarray, frame: Frame) -> np.ndarray:
    """Return a frame's picture with lines over it, uint8 (rows, cols, 3). Hidden parts are dashed.

    ``lines`` (n, 8) are those of the layers ``light-frustum`` and ``light-bounds``.
    """
    from skugga.shadows.line_drawing import line_opacity

    distance_m = _view_depth_m(frame)
    near_m = NEAR_SHARE * float(np.nanmin(distance_m, initial=np.inf)) if np.isfinite(distance_m).any() else NEAR_SHARE
    surface = np.where(np.isfinite(distance_m), (1.0 - DEPTH_TOLERANCE) / distance_m, -np.inf)
    picture = frame.color.astype(np.float32)
    drawn = []
    for number, role in sorted({(int(line[6]), line[7]) for line in lines}, key=lambda group: (group[1], -group[0])):
        chosen = lines[(lines[:, 6] == number) & (lines[:, 7] == role)]
        drawn.append((role, number, line_opacity(_lines_in_view(chosen, frame, near_m), surface)))
    for _, _, opacity in drawn:
        picture = _blend(picture, _widened(opacity) * np.float32(OUTLINE_OPACITY), (0, 0, 0))
    for role, number, opacity in drawn:
        picture = _blend(picture, opacity, _line_color(role, number))
    return np.rint(picture).astype(np.uint8)


def _line_color(role: float, number: int) -> tuple[int, int, int]:
    """Return the colour of the lines of a role (``MAP_LINE`` and others) and of a map's number."""
    if role == MAP_LINE:
        red, green, blue = (int(part) for part in MAP_COLORS[number % len(MAP_COLORS)])
        return red, green, blue
    return {RECEIVER_LINE: RECEIVER_COLOR, CASTER_LINE: CASTER_COLOR}[role]


def _widened(opacity: np.ndarray) -> np.ndarray:
    """Return an opacity (rows, cols) that also covers the pixels around."""
    padded = np.pad(opacity, 1)
    rows, cols = opacity.shape
    return np.max([padded[row : row + rows, col : col + cols] for row in range(3) for col in range(3)], axis=0)


def _blend(picture: np.ndarray, opacity: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """Return a picture (rows, cols, 3) with a colour over it, by an opacity (rows, cols)."""
    return picture + opacity[..., None] * (np.array(color, np.float32) - picture)


def _view_depth_m(frame: Frame) -> np.ndarray:
    """Return the distances of a perspective frame's points along the view's axis (rows, cols), metres; NaN in the sky."""
    _, _, depth_m = _project(frame.position_frame_m, frame)
    return np.where(frame.valid, depth_m, np.nan)


def _project(points: np.ndarray | None, frame: Frame) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return columns, rows and distances along the view's axis, metres, of points (..., 3) in a perspective frame."""
    from skugga.terrain.geo.camera import PerspectiveView

    view = frame.view
    assert isinstance(view, PerspectiveView) and frame.frame is not None and points is not None
    eye, camera_from_frame = view.in_frame(frame.frame)
    right, down, depth_m = np.moveaxis((points - eye) @ camera_from_frame.T, -1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        col = (right / depth_m * view.focal_px - view.col0) / view.step_px
        row = (down / depth_m * view.focal_px - view.row0) / view.step_px
    return col, row, depth_m


def _lines_in_view(lines: np.ndarray, frame: Frame, near_m: float) -> list[Line]:
    """Return lines (n, 8) of the frame in the eye's picture, without what is nearer to the eye than ``near_m`` metres."""
    from skugga.shadows.line_drawing import Line

    result = []
    ends = lines[:, :6].reshape(-1, 2, 3)
    _, _, depth_m = _project(ends, frame)
    for (start, end), (start_m, end_m) in zip(ends, depth_m, strict=True):
        if max(start_m, end_m) <= near_m:
            continue
        if start_m < near_m:
            start = start + (end - start) * (near_m - start_m) / (end_m - start_m)
        elif end_m < near_m:
            end = end + (start - end) * (near_m - end_m) / (start_m - end_m)
        cols, rows, cut_m = _project(np.stack([start, end]), frame)
        pixels = np.stack([cols, rows], axis=1)
        result.append(Line(pixels[0], pixels[1], 1.0 / float(cut_m[0]), 1.0 / float(cut_m[1])))
    return result


def tone_map_light_view(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """Return what a light sees as a gray picture, uint8 (rows, cols, 4), transparent where nothing casts.

    Tones follow the rank of a depth among all depths of ``array`` (rows, cols), so near and far parts alike show theirs; slopes are
    shaded. The parameter ``color``, the frame's colours, is not used.
    """
    seen = np.isfinite(array)
    out = np.zeros((*array.shape, 4), np.uint8)
    if not seen.any():
        return out
    depths = array[seen]
    levels = np.quantile(depths, np.linspace(0.0, 1.0, 257))
    spread = max(float(levels[-1] - levels[0]), 1e-9)
    rank = np.interp(depths, np.maximum.accumulate(levels + np.arange(257) * 1e-9 * spread), np.linspace(0.0, 1.0, 257))
    share = 0.5 * rank + 0.5 * (depths - levels[0]) / spread
    tone = np.zeros(array.shape)
    tone[seen] = MAX_TONE + (MIN_TONE - MAX_TONE) * share
    step_m = np.nan_to_num(np.diff(array, axis=1, append=np.nan)), np.nan_to_num(np.diff(array, axis=0, append=np.nan))
    typical_m = max(float(np.median(np.abs(np.concatenate([part[seen] for part in step_m])))), spread / 4096.0)
    slope = np.tanh((step_m[0] + step_m[1]) / (4.0 * typical_m))
    out[..., :3] = np.rint(tone * (1.0 - 0.5 * RELIEF_SHARE * (1.0 + slope)))[..., None]
    out[..., 3] = np.where(seen, 255, 0)
    out[~seen, :3] = 0
    return out


def draw_post_perspective(array: np.ndarray, frame: Frame) -> np.ndarray:
    """Return the layer ``post-perspective`` as a picture, uint8 (rows, cols, 3).

    What the eye sees has the colours of the frame; all else is gray, shaded by its slope in the space.
    """
    points, valid = array[..., :3].astype(np.float64), np.isfinite(array[..., 0])
    col, row, depth_m = _project(points, frame)
    inside = valid & (depth_m > 0.0) & (np.abs(col - frame.color.shape[1] / 2) < frame.color.shape[1] / 2)
    inside &= np.abs(row - frame.color.shape[0] / 2) < frame.color.shape[0] / 2
    at = np.rint(row[inside]).astype(np.int64), np.rint(col[inside]).astype(np.int64)
    at = tuple(np.clip(part, 0, size - 1) for part, size in zip(at, frame.color.shape, strict=False))
    seen_m = _view_depth_m(frame)[at]
    gray = _shaded_gray(points)[..., None] * np.array(UNSEEN_COLOR)
    picture = np.where(valid[..., None], gray, BACKGROUND_COLOR).astype(np.float32)
    is_seen = np.abs(seen_m - depth_m[inside]) <= 3.0 * DEPTH_TOLERANCE * depth_m[inside]
    chosen = np.flatnonzero(inside)[is_seen]
    picture.reshape(-1, 3)[chosen] = frame.color[at[0][is_seen], at[1][is_seen]]
    overlay = np.nan_to_num(array[..., 3:])
    picture = _blend(picture, overlay[..., 0], EDGE_COLOR)
    picture = _blend(picture, _widened(overlay[..., 1]) * np.float32(OUTLINE_OPACITY), (0, 0, 0))
    return np.rint(_blend(picture, overlay[..., 1], RAY_COLOR)).astype(np.uint8)


def _shaded_gray(points: np.ndarray) -> np.ndarray:
    """Return a shade (rows, cols) in [0.55, 1] by the slope of surfaces through points (rows, cols, 3) in the frame."""
    right, down = (np.diff(points, axis=axis, append=np.nan) for axis in (1, 0))
    normal = np.cross(right, down)
    length = np.linalg.norm(normal, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        facing = np.abs(normal @ np.array([0.36, 0.48, 0.8])) / length
    return 0.55 + 0.45 * np.nan_to_num(facing, nan=0.5)
