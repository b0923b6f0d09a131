"""Intermediate pictures of a frame, put together from what the passes of its blocks left behind."""

from __future__ import annotations

import numpy as np

from skugga.shadows.passes import OF_PIXELS, PassLayer
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import PixelWindow

MAX_TEXELS = 64_000_000
"""Most texels of a layer that has a size of its own."""


class LayerCollector:
    """Pictures by layer and light: those of pixels at their blocks' places in a frame of ``size`` (rows, cols), others beside
    one another.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._of_pixels: dict[tuple[PassLayer, str], list[np.ndarray]] = {}
        self._others: dict[tuple[PassLayer, str], list[np.ndarray]] = {}

    def add(
        self, kept: dict[tuple[PassLayer, str], list[np.ndarray]], frame_window: PixelWindow, block_window: PixelWindow
    ) -> None:
        """Put in what a block's passes kept; its pixels ``block_window`` are the frame's ``frame_window``.

        Raises ``InputError`` for too many texels.
        """
        for (layer, light), pictures in kept.items():
            if layer in OF_PIXELS:
                frame_pictures = self._of_pixels.setdefault(
                    (layer, light), [_empty(self._size, picture.dtype) for picture in pictures]
                )
                for frame_picture, picture in zip(frame_pictures, pictures, strict=True):
                    frame_picture[frame_window] = picture[block_window]
            else:
                others = self._others.setdefault((layer, light), [])
                others += pictures
                if sum(picture.size for picture in others) > MAX_TEXELS:
                    raise InputError("layer", layer, f"at most {MAX_TEXELS} texels: a smaller view, or smaller maps")

    @property
    def pictures(self) -> dict[tuple[PassLayer, str], list[np.ndarray]]:
        """The pictures by layer and light, as they can be added to another collector."""
        return {**self._of_pixels, **self._others}

    @property
    def whole(self) -> dict[PassLayer, dict[str, np.ndarray]]:
        """Layer -> light -> picture."""
        out: dict[PassLayer, dict[str, np.ndarray]] = {}
        for (layer, light), pictures in (*self._of_pixels.items(), *self._others.items()):
            out.setdefault(layer, {})[light] = tiled_pictures(pictures)
        return out


def tiled_pictures(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures (rows, cols) of one type row by row in a grid that is about as wide as high, NaN (or 0) between them."""
    rows, cols = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    across = int(np.ceil(np.sqrt(len(pictures))))
    out = _empty((-(-len(pictures) // across) * rows, across * cols), pictures[0].dtype)
    for number, picture in enumerate(pictures):
        row, col = number // across * rows, number % across * cols
        out[row : row + picture.shape[0], col : col + picture.shape[1]] = picture
    return out


def _empty(size: tuple[int, int], dtype: np.dtype) -> np.ndarray:
    return np.full(size, np.nan if dtype.kind == "f" else 0, dtype)
