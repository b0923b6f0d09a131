"""What a person sees who opens the viewer and moves the sun."""

from __future__ import annotations

import numpy as np
from playwright.sync_api import expect

from tests.browser.conftest import Viewer

GROUND = 0xEF, 0xEC, 0xE4
"""The map's colour where there is no tile."""


def dark_share(pixels: np.ndarray) -> float:
    """The share of a picture of shadows alone that is in shadow."""
    return float((pixels.max(axis=2) < 64).mean())


def test_it_opens_with_the_level_in_full_view(viewer: Viewer):
    level = viewer.open()
    expect(viewer.page).to_have_title("Jacksboro fault, Tennessee · Skugga")
    assert level.queries == {(("time", "2024-10-21T17:45:00-04:00"),)}
    assert len(np.unique(level.pixels.reshape(-1, 3), axis=0)) > 5000
    assert not (level.pixels == GROUND).all(axis=2).any(), "there is no hole in it"


def test_another_time_of_day_moves_the_shadows(viewer: Viewer):
    evening = viewer.open()
    time_of_day, sun = viewer.page.get_by_label("Time", exact=True), viewer.page.locator("#sun")
    expect(time_of_day).to_have_value("17:45")
    expect(sun).to_contain_text("Azimuth 246.3°")

    time_of_day.fill("09:30")
    morning = viewer.shown()
    assert morning.queries == {(("time", "2024-10-21T09:30:00-04:00"),)}
    expect(sun).to_contain_text("Azimuth 119.1°")
    moved = np.abs(morning.pixels.astype(int) - evening.pixels).max(axis=2) > 32
    assert moved.mean() > 0.3

    time_of_day.fill("17:45")
    assert np.array_equal(viewer.shown().pixels, evening.pixels), "and back again"


def test_a_lower_sun_casts_more_shadow(viewer: Viewer):
    viewer.open()
    viewer.page.get_by_label("Shadows only").check()
    assert viewer.shown().queries == {(("layer", "shadow"), ("time", "2024-10-21T17:45:00-04:00"))}
    viewer.page.get_by_label("Direction").check()
    viewer.shown()

    altitude = viewer.page.get_by_label("Altitude above the horizon")
    dark = {}
    for degrees in (12, 60):
        altitude.fill(str(degrees))
        shadows = viewer.shown()
        assert shadows.queries == {(("altitude", f"{degrees:.1f}"), ("azimuth", "315.0"), ("layer", "shadow"))}
        dark[degrees] = dark_share(shadows.pixels)
    assert dark[12] > 0.15
    assert dark[60] < 0.01, "no slope is as steep"
