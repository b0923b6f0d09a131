"""Colour scales: tiles and legend have the same colours, with any colour map."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from skugga.api.color_scale import ColorScale


@pytest.mark.parametrize("colormap", ["inferno", "viridis", "twilight", "twilight_r", "Set1"])
def test_tiles_and_legend_have_the_same_colours(colormap):
    """Some of the colour maps do not have 256 colours."""
    scale = ColorScale("A scale", colormap, 0.0, 360.0, ((0.0, "0"), (180.0, "180"), (360.0, "360")))
    legend = np.asarray(Image.open(io.BytesIO(scale.legend("png"))).convert("RGB")).astype(int)
    bar = legend[int(legend.shape[0] * 0.52)]  # a row through the middle of the bar
    left, right = round(0.06 * bar.shape[0]), round(0.94 * bar.shape[0])
    for share in (0.1, 0.5, 0.9):
        tile_color = scale.to_rgba(np.array([[360.0 * share]]))[0, 0, :3].astype(int)
        near = bar[round(left + share * (right - left)) - 2 : round(left + share * (right - left)) + 3]
        assert np.abs(near - tile_color).max(axis=1).min() <= 6, (colormap, share, tile_color.tolist(), near.tolist())


def test_a_cyclic_colour_map_ends_as_it_begins():
    colors = ColorScale("A scale", "twilight", 0.0, 360.0, ((0.0, "0"), (360.0, "360"))).to_rgba(np.array([[0.0, 360.0, 180.0]]))[0]
    first, last, middle = colors[:, :3].astype(int)
    assert np.abs(first - last).max() <= 3 < np.abs(first - middle).max()
