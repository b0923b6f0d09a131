"""The project's own PNG encoder, read back by Pillow."""

from __future__ import annotations

import io
import zlib
from functools import partial

import numpy as np
import pytest
from PIL import Image

from skugga.api import png
from skugga.api.png import encode_png

PICTURE_SHAPES = {"gray": (5, 7), "gray and alpha": (5, 7, 2), "RGB": (256, 256, 3), "RGBA": (1, 9, 4), "one pixel": (1, 1, 3)}


@pytest.mark.parametrize("shape", PICTURE_SHAPES.values(), ids=PICTURE_SHAPES)
def test_png_survives_a_round_trip(shape):
    array = np.random.default_rng(3).integers(0, 256, shape).astype(np.uint8)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(array)))), array)


def test_sixteen_bit_png_survives_a_round_trip():
    array = np.random.default_rng(3).integers(0, 65536, (6, 11)).astype(np.uint16)
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(array)))), array)


def test_strided_views_are_written():
    array = np.arange(12 * 10 * 3).reshape(12, 10, 3).astype(np.uint8)[::-2, 1:8]
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(array)))), array)


def test_zlib_gives_the_same_picture(monkeypatch):
    array = np.random.default_rng(3).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    monkeypatch.setattr(png, "_compress", partial(zlib.compress, level=3))
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(encode_png(array)))), array)


def test_smooth_shading_takes_less_than_pillow_s(tmp_path):
    row, col = np.mgrid[:256, :256]
    shade = 128 + 60 * np.sin(row / 17.0) * np.cos(col / 23.0)
    array = np.stack([shade, shade * 0.9, shade * 0.7], axis=-1).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(array).save(out, "PNG", compress_level=4)
    assert len(encode_png(array)) < 1.1 * len(out.getvalue())
