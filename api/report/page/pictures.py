"""Pictures of a report, small enough to embed: the ground once, and the shadow and errors of each row (measured plan).

A row's picture shows its shadow in grays, false shadow in red and missed shadow in blue. Each colour encodes one step of visibility
and one class of error, in lossless WebP. A script can therefore decode both from the pixels and draw the shadow over the ground.
"""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from PIL import Image

GRAY_LEVELS, FEW_GRAY_LEVELS = 16, 8
"""Number of visibility levels from dark to lit, and the fallback that is tried before pictures are shrunk."""
CORRECT, FALSE_SHADOW, MISSED_SHADOW = range(3)
"""Error classes. The palette index is visibility level + number of levels * class."""

MAX_SIDE_PX = 4096
"""Maximum side of a picture; browsers refuse larger canvases."""


@dataclass(frozen=True)
class ReportPictures:
    """The encoded pictures of a report.

    Attributes
    ----------
    ground
        ``data:`` URI of the ground.
    row_uris
        ``data:`` URI of each row.
    rows, cols
        Size of the pictures, pixels.
    shrink_factor
        Number of view pixels along each side of a picture pixel.
    gray_levels
        Number of steps of visibility from dark to lit.
    """

    ground: str
    row_uris: list[str]
    rows: int
    cols: int
    shrink_factor: int
    gray_levels: int

    @property
    def character_count(self) -> int:
        """Total number of characters of all URIs."""
        return len(self.ground) + sum(map(len, self.row_uris))


@dataclass(frozen=True, eq=False)
class ErrorPicture:
    """Visibility and errors of a row.

    Attributes
    ----------
    visibility
        Cast visibility, uint8 (rows, cols), 0 dark to 255 lit.
    false_shadow, missed_shadow
        Error masks, bool (rows, cols).
    """

    visibility: np.ndarray
    false_shadow: np.ndarray
    missed_shadow: np.ndarray


def report_pictures(ground: np.ndarray, rows: list[ErrorPicture], max_characters: int) -> ReportPictures:
    """Return pictures of at most ``max_characters`` characters, shrunk by the smallest sufficient integer factor.

    ``ground`` is uint8 (rows, cols, 3). At each factor, many steps of gray are tried first, then few. Visibility is averaged over a
    block of pixels. A block with any wrong pixel is wrong, so that no error disappears.
    """
    shrink_factor = -(-max(ground.shape[:2]) // MAX_SIDE_PX)
    while True:
        for gray_levels in (GRAY_LEVELS, FEW_GRAY_LEVELS):
            result = _encoded_pictures(ground, rows, shrink_factor, gray_levels, max_characters)
            if result.character_count <= max_characters or shrink_factor >= max(ground.shape[:2]):
                return result
        shrink_factor += 1


def palette_indexes(row: ErrorPicture, shrink_factor: int = 1, gray_levels: int = GRAY_LEVELS) -> np.ndarray:
    """Return the palette indexes, uint8 (rows, cols), of a row's picture that is shrunk by an integer factor."""
    level = np.rint(_pixel_blocks(row.visibility, shrink_factor).mean(axis=(1, 3)) * ((gray_levels - 1) / 255.0))
    false, missed = (_pixel_blocks(errors, shrink_factor).sum(axis=(1, 3)) for errors in (row.false_shadow, row.missed_shadow))
    errors = np.where(missed > false, MISSED_SHADOW, np.where(false > 0, FALSE_SHADOW, CORRECT))
    return (level + gray_levels * errors).astype(np.uint8)


def palette(gray_levels: int = GRAY_LEVELS) -> np.ndarray:
    """Return colours, uint8 (3 * gray_levels, 3): ``gray_levels`` grays of visibility, then as many reds, then as many blues.

    The eye cannot distinguish the reds, nor the blues. Their small differences encode the visibility of wrong pixels.
    """
    level = np.arange(gray_levels)
    grays = np.repeat(np.rint(160 + level * (85 / (gray_levels - 1)))[:, None], 3, axis=1)
    reds, blues = (np.array(colour) + level[:, None] * (0, 1, 0) for colour in ((214, 30, 30), (30, 70, 214)))
    return np.concatenate([grays, reds, blues]).astype(np.uint8)


def _encoded_pictures(
    ground: np.ndarray, rows: list[ErrorPicture], shrink_factor: int, gray_levels: int, max_characters: int
) -> ReportPictures:
    """Return the pictures at a factor and a number of gray steps. Encoding stops once they exceed ``max_characters`` characters."""
    small = np.rint(_pixel_blocks(ground, shrink_factor).mean(axis=(1, 3))).astype(np.uint8)
    ground_uri, row_uris = _webp(small, quality=80, method=4), []
    size = len(ground_uri)
    for row in rows:
        row_uris.append(
            _webp(palette(gray_levels)[palette_indexes(row, shrink_factor, gray_levels)], lossless=True, quality=25, method=3)
        )
        size += len(row_uris[-1])
        if size > max_characters:
            break
    height, width = small.shape[:2]
    return ReportPictures(ground_uri, row_uris, height, width, shrink_factor, gray_levels)


def _pixel_blocks(values: np.ndarray, shrink_factor: int) -> np.ndarray:
    """Return the pixels of an image in squares: (rows, shrink_factor, cols, shrink_factor, ...), padded by repeating the edge.

    ``rows`` and ``cols`` of the result count squares of ``shrink_factor`` pixels a side.
    """
    rows, cols = values.shape[:2]
    margins = [(0, -rows % shrink_factor), (0, -cols % shrink_factor), *[(0, 0)] * (values.ndim - 2)]
    filled = np.pad(values, margins, mode="edge")
    return filled.reshape(
        filled.shape[0] // shrink_factor, shrink_factor, filled.shape[1] // shrink_factor, shrink_factor, *values.shape[2:]
    )


def _webp(picture: np.ndarray, **options: int) -> str:
    """Return a picture, uint8, as a ``data:`` URI of a WebP file. ``options`` are Pillow's options of the encoder."""
    file = BytesIO()
    Image.fromarray(picture).save(file, "WEBP", **options)
    return f"data:image/webp;base64,{b64encode(file.getvalue()).decode()}"
