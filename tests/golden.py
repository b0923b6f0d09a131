"""Golden pictures: compared on the one rasteriser they were made on, 1 of 255 per channel; on another one within its tolerance.

On a failure the actual picture, the expected one and their magnified difference lie in ``tests/output``. A missing
picture is written off CI and fails on CI. ``pytest --regenerate-goldens`` writes them anew: look at each before it is
committed. They are made on that rasteriser alone.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

RENDERER = "llvmpipe"
TOLERANCE = 1

TOLERANCE_ELSEWHERE, MAX_OFF_ELSEWHERE = 32, 0.005
"""On another renderer than ``RENDERER`` five pixels in a thousand may differ by more than 32 of 255.

OpenGL leaves open how finely corners are rounded, how depths between them are, and which pixels a line covers. So a pixel through
whose centre an edge nearly goes falls to the other side, and differs by all that is between the two; no other one does. A
perspective shadow map is laid round the points that are seen: other pixels at edges, and all of its texels lie elsewhere, which
moves the soft edges of shadows by parts of a texel. Measured: 0 to 0.01 % of the pixels on Mesa's softpipe, up to 0.3 % with
perspective maps, 0.45 % where silhouettes are drawn as lines. A picture that is moved by a pixel, or lacks volumes, is beyond it.
"""

FOLDER = Path(__file__).parent / "golden"
OUTPUT = Path(__file__).parent / "output"


def assert_golden(
    name: str, picture: np.ndarray, renderer: str, regenerate: bool, tolerance: int = TOLERANCE, most_off: float = 0.0
) -> None:
    """Compare a uint8 picture (gray, RGB or RGBA) with ``golden/NAME.png``.

    A share ``most_off`` of its pixels may differ by more than ``tolerance`` of 255; on another renderer, more may.
    """
    at_home = renderer.startswith(RENDERER)  # which "zink (llvmpipe)" is not
    if not at_home:
        assert not regenerate, f"golden pictures are made on {RENDERER}; this is {renderer}"
        tolerance, most_off = max(tolerance, TOLERANCE_ELSEWHERE), max(most_off, MAX_OFF_ELSEWHERE)
    path = FOLDER / f"{name}.png"
    if regenerate or (not path.is_file() and not os.environ.get("CI") and at_home):
        FOLDER.mkdir(exist_ok=True)
        Image.fromarray(picture).save(path, optimize=True)
        return
    assert path.is_file(), f"there is no golden picture {path}: make it on {RENDERER} off CI, look at it, commit it"
    expected = np.asarray(Image.open(path))
    assert expected.shape == picture.shape, f"{name}: {picture.shape} instead of {expected.shape}"
    difference = np.abs(expected.astype(int) - picture.astype(int))
    share = (difference.reshape(*picture.shape[:2], -1).max(axis=-1) > tolerance).mean()
    if share <= most_off:
        return
    OUTPUT.mkdir(exist_ok=True)
    magnified = np.rint(255 * (difference / 255) ** 0.25).astype(np.uint8)
    if picture.ndim == 3 and picture.shape[2] == 4:
        magnified = magnified.max(axis=2)
    for kind, image in (("actual", picture), ("expected", expected), ("difference", magnified)):
        Image.fromarray(image).save(OUTPUT / f"{name}.{kind}.png")
    pytest.fail(
        f"{name} on {renderer}: {100 * share:.3f} % of the pixels differ by more than {tolerance} of 255, at most by "
        f"{difference.max()}; see {OUTPUT}/{name}.{{actual,expected,difference}}.png"
    )
