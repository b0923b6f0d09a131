"""The viewer in a browser: opening it, moving the sun, and its address."""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import datetime, timedelta

import numpy as np
from playwright.sync_api import expect

from tests.api.conftest import Client
from tests.browser.conftest import LEVEL, Viewer

BACKGROUND_COLOR = 0xE9, 0xE6, 0xDD
"""The map's colour where there is no tile."""

ADDRESS_MS = 1000
"""The page writes its address once no control moves."""


def dark_share(pixels: np.ndarray) -> float:
    """Return the share of a picture of the shadow layer that is dark."""
    return float((pixels.max(axis=2) < 64).mean())


def test_viewer_opens_with_the_whole_level(viewer: Viewer):
    level = viewer.open()
    expect(viewer.page).to_have_title("Jacksboro fault, Tennessee · Skugga")
    assert level.queries == {(("time", "2024-10-21T17:45:00-04:00"),)}
    assert len(np.unique(level.pixels.reshape(-1, 3), axis=0)) > 5000
    assert not (level.pixels == BACKGROUND_COLOR).all(axis=2).any(), "no pixel of the level shows the background"


def test_time_of_day_moves_the_shadows(viewer: Viewer):
    evening = viewer.open()
    time_of_day, sun = viewer.page.get_by_label("Time", exact=True), viewer.page.locator("#sun-words")
    expect(time_of_day).to_have_value("17:45")
    expect(sun).to_contain_text("246.3°")

    time_of_day.fill("09:30")
    morning = viewer.wait_until_drawn()
    assert morning.queries == {(("time", "2024-10-21T09:30:00-04:00"),)}
    expect(sun).to_contain_text("119.1°")
    changed = np.abs(morning.pixels.astype(int) - evening.pixels).max(axis=2) > 32
    assert changed.mean() > 0.3

    time_of_day.fill("17:45")
    evening_again = viewer.wait_until_drawn()
    assert np.array_equal(evening_again.pixels, evening.pixels), "the earlier shadows return with the earlier time"
    assert not evening_again.queries, "cached tiles are not requested again"


def test_time_slider_moves_the_shadows(viewer: Viewer):
    viewer.open()
    slider = viewer.page.get_by_label("Time of day")
    box = slider.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    viewer.page.mouse.move(box["x"] + box["width"] * 1065 / 1440, middle)
    viewer.page.mouse.down()
    viewer.page.mouse.move(box["x"] + box["width"] / 2, middle, steps=3)
    viewer.page.mouse.up()
    noon = viewer.wait_until_drawn()
    minutes = int(slider.input_value())
    assert abs(minutes - 720) <= 15
    assert (("time", f"2024-10-21T{minutes // 60:02}:{minutes % 60:02}:00-04:00"),) in noon.queries
    expect(viewer.page.locator("#clock")).to_have_value(f"{minutes // 60:02}:{minutes % 60:02}")


def test_sun_times_equal_those_of_the_service(viewer: Viewer, service: Client):
    """They are those of the level's middle; a click on one sets the time."""
    viewer.open()
    west, south, east, north = next(
        level_entry["bounds"] for level_entry in service.get("/levels").json() if level_entry["name"] == LEVEL
    )
    position = {"lon": (west + east) / 2, "lat": (south + north) / 2}
    for date in ("2024-10-21", "2024-06-21"):
        viewer.page.get_by_label("Date", exact=True).fill(date)
        day = service.get(f"/levels/{LEVEL}/point", params={**position, "date": date, "clock": "-04:00"}).json()["day"]
        for name, instant in (("Sunrise", day["sunrise"]), ("Noon", day["noon"]), ("Sunset", day["sunset"])):
            rounded = datetime.fromisoformat(instant) + timedelta(seconds=30)
            expect(viewer.page.get_by_role("button", name=name)).to_have_text(f"{name} {rounded:%H:%M}")
    viewer.page.get_by_role("button", name="Noon").click()
    noon = datetime.fromisoformat(day["noon"]) + timedelta(seconds=30)
    expect(viewer.page.locator("#clock")).to_have_value(f"{noon:%H:%M}")
    viewer.wait_until_drawn()
    expect(viewer.page.locator("#sun-words")).to_contain_text(f"{day['noon_altitude']:.1f}° high")


def test_lower_sun_casts_more_shadow(viewer: Viewer):
    viewer.open()
    viewer.page.get_by_text("Shadows", exact=True).click()
    assert viewer.wait_until_drawn().queries == {(("layer", "shadow"), ("time", "2024-10-21T17:45:00-04:00"))}
    viewer.page.get_by_role("button", name="By direction").click()
    viewer.wait_until_drawn()

    altitude = viewer.page.get_by_label("Height above the horizon")
    dark = {}
    for degrees in (12, 60):
        altitude.fill(str(degrees))
        shadows = viewer.wait_until_drawn()
        assert shadows.queries == {(("altitude", f"{degrees}"), ("azimuth", "315"), ("layer", "shadow"))}
        dark[degrees] = dark_share(shadows.pixels)
    assert dark[12] > 0.15
    assert dark[60] < 0.01, "no slope is steeper than 60 degrees, so the ground casts no shadow"


def test_address_restores_all_settings(make_viewer: Callable[..., Viewer]):
    """Another viewer at this address shows the same. On a winter's day the local clock is that of winter, -05:00."""
    first, other = make_viewer(), make_viewer()
    first.open()
    first.page.get_by_label("Time", exact=True).fill("16:00")
    first.page.get_by_text("Shadows", exact=True).click()
    first.page.get_by_label("Day of the year").fill("355")
    first.page.locator(".maplibregl-ctrl-zoom-in").click()
    first.wait_until_settled()
    expect(first.page).to_have_url(re.compile("layer=shadow.*time=2024-12-20T16:00:00-05:00"))
    first.page.wait_for_timeout(ADDRESS_MS)
    other.page.goto(first.page.url)
    other.wait_until_settled()
    settings = "() => [clock, date, days, minutes].map(({value}) => value).concat(document.body.dataset.shown)"
    assert other.page.evaluate(settings) == first.page.evaluate(settings)
    assert other.page.url == first.page.url
