"""Pictures of a report, small enough to lie in its page: the ground once, and of each row its shadow and where that is wrong.

A row's picture shows its errors by itself, red and blue over its shadow in grays; since each of its colours stands for one level
of visibility and one class and none is lost (WebP without loss), a script can read both back from the pixels and lay the shadow
over the ground.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from PIL import Image

GRAY_LEVELS, FEW_GRAY_LEVELS = 16, 8
"""Steps of visibility from dark to lit; and those taken where pictures would have to be shrunk otherwise."""
CORRECT, FALSE_SHADOW, MISSED_SHADOW = range(3)
"""Classes; a colour's index is its level of visibility + the number of levels times its class."""

MAX_SIDE_PX = 4096
"""Of a larger picture browsers refuse to make a canvas."""


@dataclass(frozen=True)
class Pictures:
    """``data:`` URIs of the ground and of each row: ``rows`` x ``cols`` pixels, each for ``factor`` x ``factor`` of the view, in
    so many ``levels`` of visibility.
    """

    ground: str
    of_rows: list[str]
    rows: int
    cols: int
    factor: int
    levels: int

    @property
    def size(self) -> int:
        """Characters of all URIs."""
        return len(self.ground) + sum(map(len, self.of_rows))


@dataclass(frozen=True, eq=False)
class ErrorPicture:
    """What is drawn of a row: cast visibility uint8 (rows, cols) 0 dark to 255 lit, and its false and missed shadow, bool."""

    visibility: np.ndarray
    false_shadow: np.ndarray
    missed_shadow: np.ndarray


def report_pictures(ground: np.ndarray, rows: list[ErrorPicture], most: int) -> Pictures:
    """Pictures of at most so many characters, shrunk by the least whole factor that does it, in many levels if that is enough.

    ``ground`` is uint8 (rows, cols, 3). Visibility is averaged; a pixel that stands for a wrong one is wrong: none vanishes.
    """
    factor = -(-max(ground.shape[:2]) // MAX_SIDE_PX)
    while True:
        for levels in (GRAY_LEVELS, FEW_GRAY_LEVELS):
            result = _at(ground, rows, factor, levels, most)
            if result.size <= most or factor >= max(ground.shape[:2]):
                return result
        factor += 1


def indexes(row: ErrorPicture, factor: int = 1, levels: int = GRAY_LEVELS) -> np.ndarray:
    """The palette's indexes uint8 of a row's picture, shrunk by a whole factor."""
    level = np.rint(_blocks(row.visibility, factor).mean(axis=(1, 3)) * ((levels - 1) / 255.0))
    false, missed = (_blocks(wrong, factor).sum(axis=(1, 3)) for wrong in (row.false_shadow, row.missed_shadow))
    wrong = np.where(missed > false, MISSED_SHADOW, np.where(false > 0, FALSE_SHADOW, CORRECT))
    return (level + levels * wrong).astype(np.uint8)


def palette(levels: int = GRAY_LEVELS) -> np.ndarray:
    """Colours uint8 (3 * levels, 3): grays of visibility, then reds and blues too near one another for the eye to tell apart."""
    level = np.arange(levels)
    grays = np.repeat(np.rint(160 + level * (85 / (levels - 1)))[:, None], 3, axis=1)
    reds, blues = (np.array(colour) + level[:, None] * (0, 1, 0) for colour in ((214, 30, 30), (30, 70, 214)))
    return np.concatenate([grays, reds, blues]).astype(np.uint8)


def _at(ground: np.ndarray, rows: list[ErrorPicture], factor: int, levels: int, most: int) -> Pictures:
    """The pictures at a factor in some levels, or as many of them as show that they are too big."""
    small = np.rint(_blocks(ground, factor).mean(axis=(1, 3))).astype(np.uint8)
    ground_uri, of_rows = _webp(small, quality=80, method=4), []
    size = len(ground_uri)
    for row in rows:
        of_rows.append(_webp(palette(levels)[indexes(row, factor, levels)], lossless=True, quality=25, method=3))
        size += len(of_rows[-1])
        if size > most:
            break
    high, wide = small.shape[:2]
    return Pictures(ground_uri, of_rows, high, wide, factor, levels)


def _blocks(values: np.ndarray, factor: int) -> np.ndarray:
    """Blocks of pixels (rows, factor, cols, factor, ...); the last ones are filled up from the edge."""
    rows, cols = values.shape[:2]
    margins = [(0, -rows % factor), (0, -cols % factor), *[(0, 0)] * (values.ndim - 2)]
    filled = np.pad(values, margins, mode="edge")
    return filled.reshape(filled.shape[0] // factor, factor, filled.shape[1] // factor, factor, *values.shape[2:])


def _webp(picture: np.ndarray, **options: int) -> str:
    file = BytesIO()
    Image.fromarray(picture).save(file, "WEBP", **options)
    return f"data:image/webp;base64,{b64encode(file.getvalue()).decode()}"
