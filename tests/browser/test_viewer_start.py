"""The viewer while the service starts: progress, polling and recovery. The tests answer ``/readyz`` themselves."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from tests.browser.conftest import LEVEL, Viewer
from tests.browser.test_viewer_access import PHONE, axe_violations

TILES = "compiling loops for map tiles"
HOURS = "compiling loops for hours of sun"

PATHS_WITHOUT_RENDERING = re.compile(
    r"^/($|assets/|levels$|base-maps\.json$|readyz$|openapi\.json$|levels/[^/]+/(lines\.json|WebMercatorQuad/tilejson\.json)\?)"
)
"""Paths whose answers need no rendering."""

EVENING = f"level={LEVEL}&time=2024-10-21T16:20:00-04:00"


class ServiceReadiness:
    """The answers of ``/readyz`` to a page, and the times of its requests."""

    def __init__(self, page: Page) -> None:
        self.times: list[float] = []
        self._reply: dict[str, Any] | None = None
        self.elapsed_s: float | None = None
        page.route(re.compile("/readyz$"), self._answer)

    def starting(self, task: str | None = None, done: int = 0, total: int = 0) -> None:
        """Answer that nothing can be drawn yet."""
        problem = {"type": "about:blank", "title": "Service Unavailable", "status": 503, "detail": "No render process is ready."}
        elapsed = {} if self.elapsed_s is None else {"elapsed_s": self.elapsed_s}
        preparing = _preparing(task, done, total)
        body = problem | {"preparing": preparing and preparing | elapsed}
        self._reply = {"status": 503, "content_type": "application/problem+json", "json": body}

    def ready(self, task: str | None = None, done: int = 0, total: int = 0) -> None:
        """Answer that tiles can be drawn; the task is prepared in the background."""
        self._reply = {"status": 200, "json": {"status": "ready", "preparing": _preparing(task, done, total)}}

    def hidden(self) -> None:
        """Answer 404, like a proxy that does not forward the address."""
        self._reply = {"status": 404, "body": "not here"}

    def unreachable(self) -> None:
        """Refuse connections."""
        self._reply = None

    def _answer(self, route: Route) -> None:
        self.times.append(time.monotonic())
        if self._reply is None:
            route.abort("connectionrefused")
        else:
            route.fulfill(**self._reply)


def _preparing(task: str | None, done: int, total: int) -> dict[str, Any] | None:
    """Return the value ``preparing`` of ``/readyz``: the running task with its progress, ``None`` without a task."""
    return None if task is None else {"task": task, "done": done, "total": total}


@pytest.fixture
def readiness(viewer: Viewer) -> ServiceReadiness:
    """Return the readiness that the viewer polls; nothing can be drawn at first."""
    return _readiness_of(viewer)


def _readiness_of(viewer: Viewer) -> ServiceReadiness:
    """Return the fake readiness of the viewer's service, which is starting."""
    viewer.allowed_faults = re.compile("503|404|ERR_CONNECTION_REFUSED")
    readiness = ServiceReadiness(viewer.page)
    readiness.starting()
    return readiness


def rendering_requests(viewer: Viewer) -> list[str]:
    """Return the page's requests that need rendering."""
    paths = [url.removeprefix(viewer.address) for url in viewer.requested_urls]
    return [path for path in paths if not PATHS_WITHOUT_RENDERING.match(path)]


@contextmanager
def assert_no_reload(viewer: Viewer) -> Iterator[None]:
    """Assert that the page is not loaded again meanwhile."""
    viewer.page.evaluate("() => { window.isSame = true; }")
    yield
    assert viewer.page.evaluate("() => window.isSame === true")


def bounding_boxes(page: Page) -> dict[str, Any]:
    """Return the boxes of the page's permanent parts."""
    parts = ("#side", "#sun", ".maplibregl-ctrl-top-right", "#minutes", "#days")
    return {part: page.locator(part).bounding_box() for part in parts}


def test_start_card_shows_the_progress(viewer: Viewer, readiness: ServiceReadiness):
    """The card shows it in words, as a bar, and for screen readers."""
    viewer.page.goto(viewer.address)
    card, bar = viewer.page.locator("#start"), viewer.page.get_by_role("progressbar")
    expect(card).to_contain_text("The service is starting")
    expect(bar).to_have_attribute("aria-label", "Waiting for a render process")
    expect(bar).not_to_have_attribute("aria-valuenow", re.compile(""))

    readiness.starting("starting a render process")
    expect(bar).to_have_attribute("aria-label", "Starting a render process")

    readiness.starting(TILES, 57, 180)
    expect(card.get_by_role("heading")).to_have_text("First start")
    expect(card).to_contain_text("Compiling, once for this installation.")
    expect(card).to_contain_text("Compiling loops for map tiles")
    expect(card).to_contain_text("57 of 180")
    expect(card).to_contain_text(re.compile(r"\d+ s so far$"))
    for name, value in {"valuemin": "0", "valuemax": "180", "valuenow": "57", "valuetext": "57 of 180"}.items():
        expect(bar).to_have_attribute(f"aria-{name}", value)
    spoken = viewer.page.locator("#said")
    expect(spoken).to_have_role("status")
    expect(spoken).to_have_text(re.compile("^First start. Compiling loops for map tiles."))
    viewer.page.wait_for_timeout(500)  # the bar is animated
    filled_box, bar_box = bar.locator("span").bounding_box(), bar.bounding_box()
    assert filled_box is not None and bar_box is not None
    assert (filled_box["x"] + filled_box["width"] - bar_box["x"]) / bar_box["width"] == pytest.approx(57 / 180, abs=0.01)


def test_start_card_counts_from_the_services_start(viewer: Viewer, readiness: ServiceReadiness):
    """It does not count from when the page was opened."""
    readiness.elapsed_s = 100.0
    readiness.starting(TILES, 57, 180)
    viewer.page.goto(viewer.address)
    card = viewer.page.locator("#start")
    expect(card).to_contain_text(re.compile(r"1 min 4\d s so far$"))
    readiness.elapsed_s = None  # an older service, without this field
    readiness.starting(TILES, 58, 180)
    viewer.page.reload()
    expect(card).to_contain_text(re.compile(r"180\d s so far$"))


def test_start_card_shows_the_time_left(viewer: Viewer, readiness: ServiceReadiness):
    """The estimate appears once enough progress has been seen, and not before."""
    viewer.page.goto(viewer.address)
    card = viewer.page.locator("#start")
    begin = time.monotonic()
    while (seconds := time.monotonic() - begin) < 8:
        readiness.starting(TILES, 20 + int(5 * seconds), 180)
        assert seconds > 4 or "left" not in card.inner_text()
        viewer.page.wait_for_timeout(200)
    expect(card).to_contain_text(re.compile(r"\d+ s so far, about (20|25|30) s left$"))


LATE_COMPARED_MAP = (
    "{ const after = window.setTimeout; window.setTimeout = (run, ms, ...rest) => after(run, ms === 60 ? 8000 : ms, ...rest); }"
)
"""Script that prolongs the wait of ``other_map.ts`` before it takes over a style."""


def test_nothing_is_drawn_before_readiness(viewer: Viewer, readiness: ServiceReadiness):
    """Neither controls nor the address cause rendering. Once the service is ready, all that was set last is drawn.

    The compared map takes over the first map's style late here, as on a busy machine: the page is not settled before.
    """
    viewer.page.add_init_script(LATE_COMPARED_MAP)
    viewer.page.goto(f"{viewer.address}/#{EVENING}&layer=shadow")
    page, card = viewer.page, viewer.page.locator("#start")
    expect(card).to_be_visible()
    expect(page.locator("#sun-words")).to_contain_text("high")
    page.get_by_label("Level", exact=True).select_option(LEVEL)
    expect(page.locator("#clock")).to_have_value("17:45")  # the level's own
    page.evaluate("hash => { location.hash = hash; }", f"{EVENING}&point=-84.25,36.3&panel=point&solid=1&compare=time:09:30")
    expect(page.locator("#clock")).to_have_value("16:20")
    for panel in ("Views", "Compare", "Why", "Use", "Point"):
        page.get_by_role("tab", name=panel).click()
        page.wait_for_timeout(700)
    expect(page.get_by_role("button", name="Play the day")).to_be_disabled()
    page.evaluate("() => document.activeElement.blur()")
    page.keyboard.press("Space")
    page.get_by_role("button", name="Ask at the middle of the map").click()
    page.locator(".maplibregl-ctrl-zoom-in").click()
    page.get_by_label("Time", exact=True).fill("15:10")
    page.wait_for_timeout(1000)
    assert not rendering_requests(viewer)
    expect(card).to_be_visible()
    expect(page.locator("#status")).to_be_hidden()
    expect(page.locator("body.working")).not_to_be_attached()

    with assert_no_reload(viewer):
        readiness.ready()
        expect(card).to_be_hidden()
        viewer.wait_until_settled()
    paths = rendering_requests(viewer)
    assert any("/tiles/" in path for path in paths)
    times = {path.partition("time=2024-10-21T")[2][:7] for path in paths if "/tiles/" in path and "terrain-rgb" not in path}
    assert times == {"15%3A10", "09%3A30"}, "tiles are requested for the last chosen time and for the time of the comparison only"
    assert any("/point?" in path for path in paths)


def test_map_appears_once_the_service_is_ready(viewer: Viewer, readiness: ServiceReadiness):
    """It shows the place, the layer and the time of the address, without a reload."""
    readiness.starting(TILES, 170, 180)
    viewer.page.goto(f"{viewer.address}/#{EVENING}&layer=shadow&map=10.10/36.29500/-84.24500")
    expect(viewer.page.locator("#start")).to_be_visible()
    viewer.page.wait_for_timeout(1000)
    assert not rendering_requests(viewer)
    expect(viewer.page.locator(".marks")).to_have_text("Sunrise and sunset come with the map.")
    before = bounding_boxes(viewer.page)
    with assert_no_reload(viewer):
        readiness.ready()
        expect(viewer.page.locator("#start")).to_be_hidden()
        level_picture = viewer.wait_until_drawn()
    assert level_picture.queries == {(("layer", "shadow"), ("time", "2024-10-21T16:20:00-04:00"))}
    assert len(np.unique(level_picture.pixels.reshape(-1, 3), axis=0)) > 20
    assert "map=10.10/36.29500/-84.24500" in viewer.page.url
    expect(viewer.page.get_by_role("button", name="Sunset")).to_be_visible()
    expect(viewer.page.get_by_role("button", name="Play the day")).to_be_enabled()
    expect(viewer.page.locator("#said")).to_have_text("The service is ready. The map is being drawn.")
    assert bounding_boxes(viewer.page) == before, "no part of the page has moved"


def test_background_work_is_shown_on_one_line(viewer: Viewer, readiness: ServiceReadiness):
    """The line comes and goes beside a drawn map; then polling ends."""
    readiness.ready(HOURS, 57, 180)
    viewer.open(f"#{EVENING}")
    status = viewer.page.locator("#status")
    expect(status).to_have_text(re.compile("^Preparing hours of sun: 57 of 180"))
    expect(viewer.page.locator("#status-words")).to_have_text("Preparing hours of sun")
    expect(viewer.page.locator("#start")).to_be_hidden()
    expect(status.get_by_role("button")).to_be_hidden()
    readiness.ready("preparing level valley", 2, 3)
    expect(status).to_have_text(re.compile("^Preparing level valley: 2 of 3"))
    readiness.ready()
    expect(status).to_be_hidden()
    poll_count = len(readiness.times)
    viewer.page.wait_for_timeout(3000)
    assert len(readiness.times) == poll_count


def test_slow_tiles_show_the_preparation(viewer: Viewer, readiness: ServiceReadiness):
    waiting: list[Route] = []
    readiness.ready(HOURS, 57, 180)
    viewer.page.route(re.compile("/tiles/"), lambda route: waiting.append(route))
    viewer.page.goto(viewer.address)
    expect(viewer.page.locator("#status")).to_contain_text("Still drawing. Preparing hours of sun: 57 of 180")
    readiness.ready()
    expect(viewer.page.locator("#status")).to_contain_text("Still drawing. What nobody has looked at")
    viewer.page.unroute(re.compile("/tiles/"))
    for route in waiting:
        route.continue_()
    viewer.wait_until_drawn()


def test_polling_intervals_are_bounded(viewer: Viewer, readiness: ServiceReadiness):
    """The page polls twice a second before the map, every other second beside it, and backs off while nothing answers."""
    viewer.page.goto(viewer.address)

    def gaps(min_count: int) -> np.ndarray:
        viewer.page.wait_for_timeout(1000)
        readiness.times.clear()
        while len(readiness.times) < min_count + 1:
            viewer.page.wait_for_timeout(50)
        return np.diff(readiness.times)

    assert gaps(4).min() > 0.4
    readiness.unreachable()
    outage_gaps = gaps(2)
    assert outage_gaps[0] > 1.8 and outage_gaps[1] > 3.8
    readiness.ready(HOURS, 1, 9)
    expect(viewer.page.locator("#status")).to_contain_text("Preparing hours of sun: 1 of 9")
    assert gaps(1)[0] > 1.9


def test_unreachable_service_is_polled_again(viewer: Viewer, readiness: ServiceReadiness):
    """Not even the list of levels is available at first."""
    viewer.page.route(re.compile("/levels$"), lambda route: route.abort("connectionrefused"))
    readiness.unreachable()
    viewer.page.goto(f"{viewer.address}/#{EVENING}")
    card = viewer.page.locator("#start")
    expect(card).to_contain_text("The service does not answer")
    expect(card).to_contain_text("This page keeps trying")
    expect(viewer.page.get_by_role("progressbar")).not_to_have_attribute("aria-valuenow", re.compile(""))
    assert not rendering_requests(viewer)
    with assert_no_reload(viewer):
        viewer.page.unroute(re.compile("/levels$"))
        readiness.starting(TILES, 3, 180)
        expect(card).to_contain_text("3 of 180")
        expect(viewer.page.get_by_label("Level", exact=True)).to_have_value(LEVEL)
        readiness.ready()
        expect(card).to_be_hidden()
        assert viewer.wait_until_drawn().queries == {(("time", "2024-10-21T16:20:00-04:00"),)}


def test_viewer_survives_a_restart_of_the_service(viewer: Viewer, readiness: ServiceReadiness):
    """The map stays, a line reports the outage, and settings changed meanwhile are drawn afterwards."""
    readiness.ready()
    viewer.open(f"#{EVENING}")
    everything_else = re.compile("/levels")
    viewer.page.route(everything_else, lambda route: route.abort("connectionrefused"))
    readiness.unreachable()
    viewer.page.get_by_label("Time", exact=True).fill("09:30")
    status = viewer.page.locator("#status")
    expect(status).to_contain_text("The service does not answer. Trying again")
    expect(viewer.page.locator("#start")).to_be_hidden()
    viewer.page.wait_for_timeout(2500)
    expect(viewer.page.locator("#status.failed")).to_be_hidden()

    viewer.page.unroute(everything_else)
    viewer.requested_urls.clear()
    readiness.starting("starting a render process")
    expect(status).to_contain_text("The service is starting")
    viewer.page.wait_for_timeout(1500)
    assert not rendering_requests(viewer)
    with assert_no_reload(viewer):
        readiness.ready()
        expect(status).to_be_hidden()
        morning = viewer.wait_until_drawn()
    assert (("time", "2024-10-21T09:30:00-04:00"),) in morning.queries
    expect(viewer.page.locator("#sun-words")).to_contain_text("119.1°")


def test_viewer_works_behind_a_proxy_without_readyz(viewer: Viewer, readiness: ServiceReadiness):
    readiness.hidden()
    assert viewer.open(f"#{EVENING}").queries
    assert len(readiness.times) == 1


def test_ready_service_shows_no_start_card(viewer: Viewer, readiness: ServiceReadiness):
    """The card does not even flash, and the page polls once."""
    viewer.page.add_init_script("""
      new MutationObserver(() => {
        if (document.querySelector('#start:not([hidden])')) window.hasFlashed = true;
      }).observe(document, {subtree: true, childList: true, attributes: true});
    """)
    readiness.ready()
    viewer.open(f"#{EVENING}")
    assert len(readiness.times) == 1
    assert not viewer.page.evaluate("() => window.hasFlashed")
    with viewer.page.expect_request(re.compile("/readyz$")):
        readiness.starting()
        viewer.page.reload()
    expect(viewer.page.locator("#start")).to_be_visible()
    assert viewer.page.evaluate("() => window.hasFlashed"), "the observer detects the card when it is shown"


@pytest.mark.parametrize("window", [{}, {"color_scheme": "dark"}, PHONE], ids=["light", "dark", "phone"])
def test_start_card_is_accessible(make_viewer: Callable[..., Viewer], window: dict[str, Any]):
    """axe finds no serious violation; the card overlaps neither the dock nor the map's buttons."""
    viewer = make_viewer(**window)
    readiness = _readiness_of(viewer)
    readiness.starting(TILES, 57, 180)
    viewer.page.goto(viewer.address)
    card = viewer.page.locator("#start .card")
    expect(card).to_contain_text("57 of 180")
    expect(viewer.page.locator("#sun-words")).to_contain_text("high")
    assert not axe_violations(viewer.page)
    heights = set()
    for task, total in ((None, 0), ("starting a render process", 0), (TILES, 180)):
        poll_count = len(readiness.times)
        if task is None:
            readiness.unreachable()
        else:
            readiness.starting(task, total // 20, total)
        while len(readiness.times) < poll_count + 2:
            viewer.page.wait_for_timeout(100)
        box = card.bounding_box()
        assert box is not None
        heights.add(box["height"])
        for part in ("#sun", "#side", ".maplibregl-ctrl-top-right .maplibregl-ctrl-group"):
            other = viewer.page.locator(part).bounding_box()
            assert other is not None
            apart_x = box["x"] >= other["x"] + other["width"] or other["x"] >= box["x"] + box["width"]
            apart_y = box["y"] >= other["y"] + other["height"] or other["y"] >= box["y"] + box["height"]
            assert apart_x or apart_y, part
    assert len(heights) == 1, "the height of the card does not change"
