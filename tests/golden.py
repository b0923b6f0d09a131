"""Golden pictures: within 1 of 255 per channel on their own rasteriser, within its tolerance on another one.

On a failure ``tests/output`` has the actual picture, the expected one and their magnified difference. A missing picture is
written outside CI and fails on CI. ``pytest --regenerate-goldens`` rewrites them: look at each before the commit. They are
made only on that rasteriser.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

REFERENCE_RENDERER = "llvmpipe"
TOLERANCE = 1

OTHER_RENDERER_TOLERANCE, OTHER_RENDERER_MAX_DIFFERING_SHARE = 32, 0.005
"""On another renderer than ``RENDERER`` five pixels in a thousand may differ by more than 32 of 255.

OpenGL does not specify the rounding of vertices, the interpolation of depths, and the pixels that a line covers. So a pixel whose
centre lies almost on an edge may change sides, and then differs by the full contrast. No other pixel changes. A perspective shadow
map is fitted to the visible points: if pixels at edges change, all of its texels move, and with them the soft edges of shadows by
parts of a texel. Measured: 0 to 0.01 % of the pixels on Mesa's softpipe, up to 0.3 % with perspective maps, 0.45 % where
silhouettes are drawn as lines. A picture shifted by a pixel, or without volumes, exceeds the tolerance.
"""

FOLDER = Path(__file__).parent / "golden"
OUTPUT = Path(__file__).parent / "output"


def assert_golden(
    name: str, picture: np.ndarray, renderer: str, regenerate: bool, tolerance: int = TOLERANCE, max_differing_share: float = 0.0
) -> None:
    """Compare a uint8 picture (gray, RGB or RGBA) with ``golden/NAME.png``.

    A share ``max_differing_share`` of its pixels may differ by more than ``tolerance`` of 255. On another renderer, more may.
    """
    is_reference_renderer = renderer.startswith(REFERENCE_RENDERER)  # not true for "zink (llvmpipe)"
    if not is_reference_renderer:
        assert not regenerate, f"golden pictures are made on {REFERENCE_RENDERER}; this is {renderer}"
        tolerance, max_differing_share = (
            max(tolerance, OTHER_RENDERER_TOLERANCE),
            max(max_differing_share, OTHER_RENDERER_MAX_DIFFERING_SHARE),
        )
    path = FOLDER / f"{name}.png"
    if regenerate or (not path.is_file() and not os.environ.get("CI") and is_reference_renderer):
        FOLDER.mkdir(exist_ok=True)
        Image.fromarray(picture).save(path, optimize=True)
        return
    assert path.is_file(), f"there is no golden picture {path}: make it on {REFERENCE_RENDERER} off CI, look at it, commit it"
    expected = np.asarray(Image.open(path))
    assert expected.shape == picture.shape, f"{name}: {picture.shape} instead of {expected.shape}"
    difference = np.abs(expected.astype(int) - picture.astype(int))
    share = (difference.reshape(*picture.shape[:2], -1).max(axis=-1) > tolerance).mean()
    if share <= max_differing_share:
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
