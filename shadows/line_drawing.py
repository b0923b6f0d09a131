"""Draw lines over a picture, with their hidden parts dashed."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LINE_WIDTH_PX, HIDDEN_WIDTH_PX = 2.2, 1.6
"""Widths of visible and of hidden lines, pixels."""

DASH_PX, GAP_PX = 7.0, 6.0
"""Lengths of the dashes of hidden lines and of the gaps between them, pixels."""

SUBPIXELS = 4
"""Subpixels along a pixel's side, by which lines are anti-aliased."""


class Line(NamedTuple):
    """A straight line in a picture.

    Attributes
    ----------
    start, end
        (2,): column and row of both ends, pixels; a pixel's centre has integers.
    start_nearness, end_nearness
        The nearness of both ends: a number that is linear along the line in the picture, and grows towards the eye.
    """

    start: np.ndarray
    end: np.ndarray
    start_nearness: float
    end_nearness: float


def line_opacity(lines: list[Line], surface_nearness: np.ndarray) -> np.ndarray:
    """Return the opacity of lines in a picture, float32 (rows, cols) in [0, 1].

    ``surface_nearness`` (rows, cols) is that of the visible surface, in front of which a line is visible; -inf without a surface.
    """
    from PIL import Image, ImageDraw

    rows, cols = surface_nearness.shape
    image = Image.new("L", (cols * SUBPIXELS, rows * SUBPIXELS))
    draw = ImageDraw.Draw(image)
    for line in lines:
        for start, end, is_visible in _parts(line, surface_nearness):
            ends = [tuple((SUBPIXELS * (point + 0.5) - 0.5).tolist()) for point in (start, end)]
            width = round(SUBPIXELS * (LINE_WIDTH_PX if is_visible else HIDDEN_WIDTH_PX))
            draw.line(ends, fill=255 if is_visible else 190, width=width)
    small = image.resize((cols, rows), Image.Resampling.BOX)
    return np.asarray(small, np.float32) / np.float32(255.0)


def _parts(line: Line, surface_nearness: np.ndarray) -> list[tuple[np.ndarray, np.ndarray, bool]]:
    """Return the visible parts of a line and the dashes of its hidden parts: start (2,), end (2,), and whether it is visible."""
    rows, cols = surface_nearness.shape
    shares = _shares_in_picture(line.start, line.end, rows, cols)
    if shares is None:
        return []
    length_px = float(np.linalg.norm(line.end - line.start)) * (shares[1] - shares[0])
    share = np.linspace(*shares, max(int(np.ceil(length_px)), 1) + 1)
    points = line.start + share[:, None] * (line.end - line.start)
    col, row = np.clip(np.rint(points).astype(np.int64), 0, [cols - 1, rows - 1]).T
    nearness = line.start_nearness + share * (line.end_nearness - line.start_nearness)
    is_visible = nearness >= surface_nearness[row, col]
    is_drawn = is_visible | (np.arange(len(share)) % (DASH_PX + GAP_PX) < DASH_PX)
    parts, first = [], 0
    for last in range(1, len(share)):
        if last + 1 == len(share) or is_visible[last] != is_visible[first] or is_drawn[last] != is_drawn[first]:
            if is_drawn[first]:
                parts.append((points[first], points[last], bool(is_visible[first])))
            first = last
    return parts


def _shares_in_picture(start: np.ndarray, end: np.ndarray, rows: int, cols: int) -> tuple[float, float] | None:
    """Return the shares of a line (2,), (2,) between which it lies in a picture; ``None`` outside of it."""
    low, high, along = -0.5 - start, np.array([cols, rows]) - 0.5 - start, end - start
    with np.errstate(divide="ignore", invalid="ignore"):
        bounds = np.sort(np.stack([low / along, high / along]), axis=0)
    bounds[:, along == 0.0] = np.where((low <= 0.0) & (high >= 0.0), [[-np.inf], [np.inf]], [[np.inf], [-np.inf]])[:, along == 0.0]
    first, last = max(0.0, float(bounds[0].max())), min(1.0, float(bounds[1].min()))
    return (first, last) if first < last else None
