"""Assemble the intermediate pictures of a frame from the layers that the passes of its blocks kept."""

from __future__ import annotations

import numpy as np

from skugga.shadows.passes import LINE_LAYERS, PIXEL_LAYERS, PassLayer
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import PixelWindow

MAX_LAYER_TEXELS = 64_000_000
"""Upper bound of the texels of a layer that has a size of its own, such as a depth map."""


class LayerCollector:
    """Collector of a frame's intermediate pictures, by layer and light.

    Layers with one value for each pixel (``PIXEL_LAYERS``) are placed at their blocks' windows in a frame of ``size`` (rows, cols).
    Pictures of other layers, such as depth maps, are tiled. Lines are joined.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._pixel_layers: dict[tuple[PassLayer, str], list[np.ndarray]] = {}
        self._sized_layers: dict[tuple[PassLayer, str], list[np.ndarray]] = {}

    def add_block(
        self, layers: dict[tuple[PassLayer, str], list[np.ndarray]], frame_window: PixelWindow, block_window: PixelWindow
    ) -> None:
        """Add the layers of a block: its pixels in ``block_window`` become the frame's pixels in ``frame_window``.

        Raises ``InputError`` for too many texels.
        """
        for (layer, light), pictures in layers.items():
            if layer in PIXEL_LAYERS:
                frame_pictures = self._pixel_layers.setdefault(
                    (layer, light), [_empty_picture(self._size, picture.dtype) for picture in pictures]
                )
                for frame_picture, picture in zip(frame_pictures, pictures, strict=True):
                    frame_picture[frame_window] = picture[block_window]
            else:
                tiles = self._sized_layers.setdefault((layer, light), [])
                tiles += pictures
                if sum(picture.size for picture in tiles) > MAX_LAYER_TEXELS:
                    amount = f"{layer} has {sum(picture.size for picture in tiles)} texels"
                    raise InputError.over_limit("layer", amount, str(MAX_LAYER_TEXELS), "Use a smaller view or smaller maps")

    @property
    def pictures(self) -> dict[tuple[PassLayer, str], list[np.ndarray]]:
        """The pictures by layer and light, in the form that ``add_block`` of another collector takes."""
        return {**self._pixel_layers, **self._sized_layers}

    @property
    def assembled_pictures(self) -> dict[PassLayer, dict[str, np.ndarray]]:
        """The assembled picture of each layer and light."""
        out: dict[PassLayer, dict[str, np.ndarray]] = {}
        for (layer, light), pictures in (*self._pixel_layers.items(), *self._sized_layers.items()):
            out.setdefault(layer, {})[light] = np.concatenate(pictures) if layer in LINE_LAYERS else tiled_pictures(pictures)
        return out


def tiled_pictures(pictures: list[np.ndarray]) -> np.ndarray:
    """Return pictures (rows, cols) or (rows, cols, bands) of one dtype as one picture, tiled row by row.

    The tiles form a grid with about as many columns as rows. Gaps between them are NaN, or 0 for integers.
    """
    rows, cols = (max(picture.shape[axis] for picture in pictures) for axis in (0, 1))
    tile_cols = int(np.ceil(np.sqrt(len(pictures))))
    size = -(-len(pictures) // tile_cols) * rows, tile_cols * cols
    out = _empty_picture((*size, *pictures[0].shape[2:]), pictures[0].dtype)
    for number, picture in enumerate(pictures):
        row, col = number // tile_cols * rows, number % tile_cols * cols
        out[row : row + picture.shape[0], col : col + picture.shape[1]] = picture
    return out


def _empty_picture(size: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return a picture of NaN, or of 0 for integers. ``size`` is its shape: rows, columns, and bands if it has any."""
    return np.full(size, np.nan if dtype.kind == "f" else 0, dtype)
