"""The viewer plays the day of a perspective view, and has a film made of it. Fake pictures have one grey for each time."""

from __future__ import annotations

import re
from collections.abc import Callable
from io import BytesIO
from typing import Any
from urllib.parse import parse_qs, urlsplit

import pytest
from PIL import Image
from playwright.sync_api import Page, Route, expect

from tests.api.conftest import Client
from tests.browser.conftest import Viewer
from tests.browser.map_clients import LEVEL
from tests.browser.test_viewer_access import PHONE, axe_violations

START = "2024-12-21T09:00:00-05:00"
CAMERA = "views-eye=-84.3,36.3,50&views-target=-84.25,36.3,0"

COLOR_TOLERANCE = 3
"""Tolerance of colours on the screen, of 255."""


def picture_grey(minutes: int) -> int:
    """Return the grey of a time's pictures."""
    return 40 + minutes // 10


class FakeView:
    """The dialog of a view's whole picture, whose fake pictures have one grey for each time."""

    def __init__(self, viewer: Viewer) -> None:
        self.viewer, self.page = viewer, viewer.page
        self.times: list[str] = []
        self.is_broken = False
        viewer.page.route(re.compile("/snapshot[.]"), self._answer)

    def open(self) -> None:
        """Open the dialog of a camera of one's own at nine o'clock."""
        self.page.goto(f"{self.viewer.address}/#time={START}&panel=views&{CAMERA}")
        self.viewer.wait_until_settled()
        if self.page.locator("#sheet").is_visible():
            self.page.locator("#sheet").click()
        self.page.get_by_role("button", name="Whole picture").click()
        expect(self.page.locator("dialog img:visible")).to_have_count(1)
        self.times.clear()

    @property
    def minutes(self) -> int:
        """The time that the dialog shows."""
        return int(self.page.locator("#view-minutes").input_value())

    def grey(self) -> int:
        """Return the grey in the middle of the dialog's picture."""
        box = self.page.locator("dialog img:visible").bounding_box()
        assert box is not None
        pixels = self.viewer.pixels({"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2, "width": 4, "height": 4})
        return int(pixels.max())

    def wait_until_later(self, minutes: int) -> None:
        """Wait until the dialog shows a later time."""
        self.page.wait_for_function("least => Number(document.getElementById('view-minutes').value) > least", arg=minutes)

    def _answer(self, route: Route) -> None:
        if self.is_broken:
            route.fulfill(status=500, json={"detail": "The worker is gone."})
            return
        query = parse_qs(urlsplit(route.request.url).query)
        (time,) = query["time"]
        self.times.append(time[11:16])
        picture = BytesIO()
        size = tuple(map(int, query["size"][0].split("x"))) if "size" in query else (640, 512)
        Image.new("RGB", size, (picture_grey(int(time[11:13]) * 60 + int(time[14:16])),) * 3).save(picture, "PNG")
        route.fulfill(body=picture.getvalue(), content_type="image/png")


@pytest.fixture
def view(viewer: Viewer) -> FakeView:
    """Return a view of fake pictures in a window, not yet opened."""
    return FakeView(viewer)


def test_view_plays_the_day(view: FakeView):
    """Each time is requested once. A pause leaves the picture of its time; the page's own time stays."""
    view.open()
    play = view.page.get_by_role("dialog").get_by_role("button", name="Play the day")
    play.click()
    view.wait_until_later(12 * 60)
    view.page.get_by_role("dialog").get_by_role("button", name="Pause the day").click()
    expect(play).to_be_visible()
    assert abs(view.grey() - picture_grey(view.minutes)) <= COLOR_TOLERANCE
    assert len(set(view.times)) == len(view.times)
    assert view.page.locator("#minutes").input_value() == str(9 * 60)
    assert not axe_violations(view.page)

    view.page.keyboard.press("Escape")
    expect(view.page.get_by_role("dialog")).to_have_count(0)
    request_count = len(view.times)
    view.page.wait_for_timeout(800)
    assert len(view.times) == request_count, "a closed dialog requests nothing"


def test_slider_moves_the_time_of_a_view(view: FakeView):
    view.open()
    slider = view.page.get_by_label("Time of the view")
    slider.focus()
    slider.press("ArrowRight")
    slider.press("ArrowRight")
    expect(view.page.locator("dialog img:visible")).to_have_attribute("alt", re.compile("at 09:20$"))
    assert abs(view.grey() - picture_grey(9 * 60 + 20)) <= COLOR_TOLERANCE
    assert view.times == ["09:20"]


def test_failed_picture_of_the_day_is_told_in_the_dialog(view: FakeView):
    view.open()
    view.viewer.allowed_faults = re.compile("500")
    view.is_broken = True
    dialog = view.page.get_by_role("dialog")
    dialog.get_by_role("button", name="Play the day").click()
    expect(dialog.locator(".fail")).to_contain_text("The worker is gone. (500)")
    expect(dialog.get_by_role("button", name="Play the day")).to_be_visible()


def test_dialog_of_the_day_fits_a_phone(make_viewer: Callable[..., Viewer]):
    view = FakeView(make_viewer(**PHONE))
    view.open()
    view.page.get_by_role("dialog").get_by_role("button", name="Play the day").click()
    view.wait_until_later(9 * 60 + 10)
    for name in ("Pause the day", "Make a film", "Close"):
        box = view.page.get_by_role("dialog").get_by_role("button", name=name).bounding_box()
        assert box is not None and box["x"] >= 0 and box["x"] + box["width"] <= PHONE["viewport"]["width"]


class FakeAnimation:
    """An animation that the page asks for: drawn in three polls."""

    def __init__(self, page: Page) -> None:
        self.bodies: list[Any] = []
        self.polls = 0
        self.poll_count = 2
        self.methods: list[str] = []
        page.route(re.compile("/levels/[^/]+/animations$"), self._create)
        page.route(re.compile("/animations/abc$"), self._state)
        page.route(re.compile("/animations/abc/result$"), lambda route: route.fulfill(body=b"film", content_type="image/webp"))

    def _create(self, route: Route) -> None:
        self.bodies.append(route.request.post_data_json)
        self._answer(route, 202, "accepted")

    def _state(self, route: Route) -> None:
        self.methods.append(route.request.method)
        self.polls += 1
        self._answer(route, 200, "running" if self.polls < self.poll_count else "successful")

    def _answer(self, route: Route, status: int, word: str) -> None:
        state = {"jobID": "abc", "status": word, "message": "", "frames": 60, "frames_done": 30 * self.polls}
        route.fulfill(status=status, json=state, headers={"Retry-After": "1"})


def test_film_is_asked_for_and_saved(view: FakeView, service: Client):
    """The service accepts the order of the page."""
    animation = FakeAnimation(view.page)
    view.open()
    dialog = view.page.get_by_role("dialog")
    dialog.get_by_label("Time between the pictures of the film").select_option("every 5 minutes")
    with view.page.expect_download() as download:
        dialog.get_by_role("button", name="Make a film").click()
        expect(dialog).to_contain_text("The service is drawing the film: 30 of 60 pictures.")
    assert download.value.suggested_filename == f"{LEVEL}-my_view-2024-12-21.webp"
    expect(dialog).to_contain_text("The film is saved.")
    assert set(animation.methods) == {"GET"}
    (body,) = animation.bodies
    assert body["step"] == "5m"
    response = service.post(f"/levels/{LEVEL}/animations", json=body)
    assert response.status_code == 202, response.text
    assert response.json()["frames"] > 100
    service.delete(f"/animations/{response.json()['jobID']}")


def test_stopped_film_is_dismissed(view: FakeView):
    animation = FakeAnimation(view.page)
    animation.poll_count = 1000
    view.open()
    dialog = view.page.get_by_role("dialog")
    dialog.get_by_role("button", name="Make a film").click()
    expect(dialog).to_contain_text("The service is drawing the film")
    with view.page.expect_request(lambda request: request.method == "DELETE"):
        dialog.get_by_role("button", name="Stop the film").click()
    expect(dialog).to_contain_text("The film was stopped.")
