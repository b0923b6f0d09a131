"""The viewer plays a day. Fake tiles have one grey for each time, so that a picture shows its time."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Error, Route, expect

from tests.browser.conftest import Viewer
from tests.browser.test_viewer_access import axe_violations

DATE = "2024-12-21"
FIRST, LAST = 8 * 60 - 10, 18 * 60
"""The day's steps lie between these, in minutes by the clock of -05:00."""

COMPARED_GREY = 60
"""Greys by which fake tiles of shadows are brighter than those of shaded relief."""

COLOR_TOLERANCE = 3
"""Tolerance of colours on the screen, of 255."""


def tile_grey(minutes: int) -> int:
    """Return the grey of a time's tiles, from 40 to 160, far from the ground's colour."""
    return 40 + round((minutes - FIRST) / 5)


class FakeDay:
    """A viewer whose fake tiles have one grey for each time."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer, self.requested_urls = viewer, []
        self.broken = False
        self.held_routes: list[Route] | None = None
        """Requests that are held back; None: requests are answered at once."""
        viewer.page.route(re.compile("/tiles/"), self._answer)

    def open(self, minutes: int, fragment: str = "") -> None:
        """Open the page at a time of the day, with further parts of the fragment."""
        self.viewer.page.goto(f"{self.viewer.address}/#time={DATE}T{minutes // 60:02}:{minutes % 60:02}:00-05:00{fragment}")
        self.viewer.wait_until_settled()
        expect(self.viewer.page.locator(".marks b").first).to_be_visible()

    def play(self) -> None:
        """Press the play button."""
        self.viewer.page.get_by_role("button", name="Play the day").click()

    @property
    def minutes(self) -> int:
        """The time of day that the page shows."""
        return int(self.viewer.page.locator("#minutes").input_value())

    def picture(self) -> np.ndarray:
        """Return the level's greys on the page, (rows, cols) uint8."""
        pixels = self.viewer.pixels(self.viewer.level_rectangle())
        assert int(np.ptp(pixels.astype(int), axis=2).max()) <= COLOR_TOLERANCE, "the page shows a colour, but all tiles are grey"
        return pixels[..., 0]

    def wait_until_later(self, minutes: int) -> None:
        """Wait until the page shows a later time of the same day."""
        self.viewer.page.wait_for_function("least => Number(document.getElementById('minutes').value) > least", arg=minutes)

    def release(self) -> None:
        """Answer the held requests, and later ones at once."""
        routes, self.held_routes = self.held_routes or [], None
        for route in routes:
            with suppress(Error):  # the page has cancelled it
                self._answer(route)

    def _answer(self, route: Route) -> None:
        if self.held_routes is not None:
            self.held_routes.append(route)
            return
        query = parse_qs(urlsplit(route.request.url).query)
        (time,) = query["time"]
        minutes = int(time[11:13]) * 60 + int(time[14:16])
        self.requested_urls.append(route.request.url)
        if self.broken:
            route.fulfill(status=500, json={"title": "Internal Server Error", "status": 500, "detail": "The worker is gone."})
            return
        picture = BytesIO()
        grey = tile_grey(minutes) + (COMPARED_GREY if query.get("layer") == ["shadow"] else 0)
        Image.new("RGB", (256, 256), (grey,) * 3).save(picture, "PNG")
        route.fulfill(body=picture.getvalue(), content_type="image/png")


@pytest.fixture
def day(viewer: Viewer) -> FakeDay:
    """Return a day of fake tiles in a window, not yet opened."""
    return FakeDay(viewer)


RECORD_FRAMES = """({x, y, width, height}) => {
  const map = document.querySelector('.maplibregl-canvas');
  const pen = new OffscreenCanvas(8, 8).getContext('2d', {willReadFrequently: true});
  window.looks = [];
  const look = () => {
    pen.drawImage(map, x, y, width, height, 0, 0, 8, 8);
    const channels = pen.getImageData(0, 0, 8, 8).data.filter((_, index) => index % 4 < 3);
    window.looks.push([Math.min(...channels), Math.max(...channels)]);
    requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
}"""
"""Record in every frame the darkest and the brightest channel of 64 places on the level."""


def test_played_day_has_no_blank_frame(day: FakeDay):
    """Each frame is whole, of one time or blended from two, and time advances. No tile is requested twice."""
    day.open(9 * 60)
    day.viewer.page.evaluate(RECORD_FRAMES, day.viewer.level_rectangle())
    day.play()
    day.wait_until_later(16 * 60 + 30)
    frames = np.array(day.viewer.page.evaluate("() => window.looks"))
    assert np.ptp(frames, axis=1).max() <= COLOR_TOLERANCE, "a frame shows the ground, or two times side by side"
    # The map below the day's pictures shows the starting time, so a missing picture would be seen.
    assert np.diff(frames[:, 0]).min() >= -COLOR_TOLERANCE, "a frame shows an earlier time than the frame before it"
    assert tile_grey(9 * 60) - COLOR_TOLERANCE <= frames.min() and frames.max() <= tile_grey(LAST) + COLOR_TOLERANCE
    assert len(np.unique(frames[:, 0])) > 40, "the frames show most steps of the day"
    expect(day.viewer.page.locator("#sun-words")).to_contain_text("high")

    # In the next round only the times before the start of this one are new.
    day.viewer.page.wait_for_function("() => Number(document.getElementById('minutes').value) < 600")
    day.wait_until_later(9 * 60)
    request_count = len(day.requested_urls)
    assert len(set(day.requested_urls)) == request_count, "no tile is requested twice"
    day.wait_until_later(12 * 60)
    assert len(day.requested_urls) == request_count

    day.viewer.page.get_by_role("button", name="Pause the day").click()
    day.viewer.wait_until_settled()
    assert abs(int(day.picture().max()) - tile_grey(day.minutes)) <= COLOR_TOLERANCE, (
        "the page shows the time at which the day was paused"
    )


def test_day_goes_on_after_the_map_moves(day: FakeDay):
    day.open(9 * 60)
    day.play()
    day.wait_until_later(9 * 60 + 20)
    day.viewer.page.locator(".maplibregl-ctrl-zoom-in").click()
    day.wait_until_later(day.minutes + 60)
    middle = day.viewer.pixels()[250:300, 700:900].astype(int)
    assert int(np.ptp(middle)) <= COLOR_TOLERANCE
    assert tile_grey(FIRST) <= middle.max() <= tile_grey(LAST)


def test_compared_map_plays_along(day: FakeDay):
    """Both sides always show the same time, and rest at it after a pause. The day goes on without the comparison."""
    day.open(9 * 60, "&compare=layer:shadow&compare-split=0.3")
    page = day.viewer.page
    expect(page.locator(".other-map")).to_be_visible()
    box = page.locator(".divider .handle").bounding_box()
    assert box is not None
    line = round(box["x"] + box["width"] / 2)

    def greys() -> tuple[int, int]:
        row = day.viewer.pixels()[200].astype(int)
        return int(row[line - 40].max()), int(row[line + 40].max())

    day.play()
    day.wait_until_later(9 * 60 + 20)
    seen = []
    for _ in range(8):
        left, right = greys()
        assert abs(right - left - COMPARED_GREY) <= COLOR_TOLERANCE, "the two sides show different times"
        seen.append(left)
        day.wait_until_later(day.minutes)
    assert max(seen) - min(seen) > 2 * COLOR_TOLERANCE, "the day does not go on"

    page.get_by_role("button", name="Pause the day").click()
    day.viewer.wait_until_settled()
    page.wait_for_function("() => !document.querySelector('#status:not([hidden])')")
    page.wait_for_timeout(500)
    left, right = greys()
    assert abs(left - tile_grey(day.minutes)) <= COLOR_TOLERANCE
    assert abs(right - left - COMPARED_GREY) <= COLOR_TOLERANCE

    day.play()
    day.wait_until_later(day.minutes)
    page.get_by_role("button", name="End the comparison").first.click()
    day.wait_until_later(day.minutes + 10)
    left, right = greys()
    assert abs(right - left) <= COLOR_TOLERANCE


def test_hidden_page_pauses_the_day(day: FakeDay):
    day.open(9 * 60)
    day.play()
    day.wait_until_later(9 * 60 + 20)
    hide = """hidden => {
      Object.defineProperty(document, 'hidden', {get: () => hidden, configurable: true});
      document.dispatchEvent(new Event('visibilitychange'));
    }"""
    day.viewer.page.evaluate(hide, True)
    day.viewer.page.wait_for_timeout(500)  # a step in progress ends
    paused = day.minutes
    day.viewer.page.wait_for_timeout(1500)
    assert day.minutes == paused
    day.viewer.page.evaluate(hide, False)
    day.wait_until_later(paused)


def test_reduced_motion_does_not_fade(make_viewer: Callable[..., Viewer]):
    day = FakeDay(make_viewer(reduced_motion="reduce"))
    day.open(9 * 60)
    day.play()
    unblended_greys = {tile_grey(minutes) for minutes in range(FIRST, LAST + 1, 10)}
    for _ in range(12):
        shown_grey = int(day.picture()[0, 0])
        assert min(abs(shown_grey - unblended_grey) for unblended_grey in unblended_greys) <= 1, (
            "the page shows a picture blended from two times"
        )
    day.wait_until_later(9 * 60)


def test_moving_the_sun_stops_the_day(day: FakeDay):
    day.open(9 * 60)
    day.play()
    day.wait_until_later(9 * 60 + 10)
    day.viewer.page.get_by_label("Time", exact=True).fill("12:00")
    expect(day.viewer.page.get_by_role("button", name="Play the day")).to_be_visible()
    day.viewer.wait_until_settled()
    assert day.minutes == 12 * 60
    assert abs(int(day.picture().max()) - tile_grey(12 * 60)) <= COLOR_TOLERANCE


def test_waiting_day_shows_progress_and_can_be_stopped(day: FakeDay):
    """Progress counts tiles and pictures. The next picture is requested first, and nothing after a stop."""
    day.viewer.hide_preparations()
    day.open(9 * 60 + 5)
    day.held_routes = []
    day.play()
    status = day.viewer.page.locator("#status")
    expect(status).to_contain_text(re.compile(r"^Drawing 09:10: 0 of \d+ tiles, 0 of \d+ pictures of the day"))
    times = [parse_qs(urlsplit(route.request.url).query)["time"][0][11:16] for route in day.held_routes]
    assert times[0] == "09:10" and times == sorted(times), "the next picture of the day is requested first, the others in order"
    assert not axe_violations(day.viewer.page)
    status.get_by_role("button", name="Stop").click()
    expect(status).to_be_hidden()
    expect(day.viewer.page.get_by_role("button", name="Play the day")).to_be_visible()
    day.release()
    day.viewer.wait_until_settled()
    request_count = len(day.requested_urls)
    day.viewer.page.wait_for_timeout(1000)
    assert len(day.requested_urls) == request_count
    assert day.minutes == 9 * 60 + 5

    day.play()
    day.wait_until_later(9 * 60 + 30)
    expect(status).to_be_hidden()


def test_day_begins_once_the_sunrise_is_known(day: FakeDay):
    """Until then the page says so, and the day can be stopped."""
    held_routes: list[Route] = []
    day.viewer.hide_preparations()
    day.viewer.page.route(re.compile("/point[?]"), lambda route: held_routes.append(route))
    day.viewer.page.goto(f"{day.viewer.address}/#time={DATE}T09:00:00-05:00")
    day.viewer.page.wait_for_function("() => document.body.dataset.shown")
    status = day.viewer.page.locator("#status")
    day.play()
    expect(status).to_contain_text("The day begins as soon as its sunrise is known")
    status.get_by_role("button", name="Stop").click()
    expect(status).to_be_hidden()
    day.play()
    expect(status).to_contain_text("The day begins")
    day.viewer.page.unroute(re.compile("/point[?]"))
    for route in held_routes:
        route.continue_()
    day.wait_until_later(9 * 60 + 10)


def test_failed_day_shows_the_error(day: FakeDay):
    day.open(9 * 60)
    day.viewer.allowed_faults = re.compile("500")
    day.broken = True
    day.play()
    status = day.viewer.page.locator("#status.failed")
    expect(status).to_contain_text("The worker is gone. (500)")
    expect(day.viewer.page.get_by_role("button", name="Play the day")).to_be_visible()
    below = day.viewer.pixels()[200:500, 500:1000].astype(int)
    assert np.abs(below - tile_grey(day.minutes)).max() <= COLOR_TOLERANCE, "the earlier picture stays visible"
