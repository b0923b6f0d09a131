"""Golden pictures of the viewer at half its size: light, dark, on a phone. Fonts are the machine's, so letters may differ."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image

from tests.browser.conftest import WINDOW_SIZE_PX, Viewer
from tests.browser.test_viewer_access import PHONE
from tests.golden import assert_golden

TOLERANCE, MAX_DIFFERING_SHARE = 24, 0.02
"""Letters cover less of the page than this; a panel that has moved, or a shadow, covers more."""

PAGES = {
    "light": ({}, ""),
    "dark": ({"color_scheme": "dark"}, ""),
    "phone": (PHONE, ""),
    "direction": ({}, "#azimuth=315&altitude=30"),
}


@pytest.mark.parametrize("name", PAGES)
def test_viewer_equals_its_golden_picture(make_viewer: Callable[..., Viewer], request: pytest.FixtureRequest, name: str):
    window, fragment = PAGES[name]
    viewer = (
        make_viewer(viewport=WINDOW_SIZE_PX, reduced_motion="reduce")
        if not window
        else make_viewer(reduced_motion="reduce", **window)
    )
    viewer.hide_preparations()
    viewer.page.goto(f"{viewer.address}/{fragment}")
    viewer.wait_until_settled()
    if not fragment:
        viewer.page.locator(".marks b").first.wait_for()
    viewer.page.wait_for_timeout(500)
    pixels = Image.fromarray(viewer.pixels())
    half = np.asarray(pixels.resize((pixels.width // 2, pixels.height // 2), Image.Resampling.BOX))
    assert_golden(
        f"viewer-{name}", half, "llvmpipe", request.config.getoption("--regenerate-goldens"), TOLERANCE, MAX_DIFFERING_SHARE
    )
