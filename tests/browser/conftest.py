"""Debian's Chromium, without a window, before a real service of one bundled level: its own pages, and map clients that read it.

What is wrong on a page that nobody asked for (an error in its console, a request that fails) fails every test of it. The page of
a failed test lies in ``tests/output``.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
from playwright.sync_api import Browser, Error, FloatRect, Page, ViewportSize, expect, sync_playwright

from skugga.api.catalogue import find_level
from skugga.api.http.server.app import create_app
from skugga.api.http.server.routes_viewer import STATIC_FOLDER
from skugga.api.settings import Settings
from tests.api.conftest import Client, running
from tests.browser.map_clients import CLIENTS, LEVEL, LIBRARIES, WINDOW_PX, MapClient, served_folder
from tests.browser.watched_page import WatchedPage
from tests.golden import OUTPUT

HERE = Path(__file__).parent

CHROMIUM = Path("/usr/bin/chromium")
IN_SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
"""Root may have no sandbox; the map is drawn by the same rasteriser on every machine."""

WINDOW = ViewportSize(width=1280, height=800)

READY_S, DRAWN_S = 180, 90
"""A render process compiles at its first start; a map takes seconds."""

STILL = 3
"""So many pictures in a row that are alike: tiles fade in, and are decoded a moment after they have come."""

MARGIN_PX = 6
"""Left off all round: the address of a view is rounded."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder need a browser, also one that does not say so."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.browser)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Take a picture of each page of a failed test while it is open."""
    report = yield
    shown = [value for value in getattr(item, "funcargs", {}).values() if isinstance(value, WatchedPage)]
    if report.when == "call" and report.failed:
        OUTPUT.mkdir(exist_ok=True)
        name = re.sub("[^A-Za-z0-9_.-]+", "-", item.name)
        for number, watched in enumerate(dict.fromkeys(shown)):
            path = OUTPUT / f"{name}-{number}.png"
            # A page that is gone has no picture, and that is no other failure.
            with suppress(Error):
                watched.page.screenshot(path=path)
                report.sections.append(("the page", f"see {path}"))
    return report


def missing(what: str) -> NoReturn:
    """End a test for which something is not there; on CI that is a failure."""
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


@dataclass(frozen=True, eq=False)
class Shown:
    """What a person sees of the level, and what was asked for to draw it."""

    pixels: np.ndarray
    """The level's part of the map, (rows, cols, 3) uint8."""

    queries: set[tuple[tuple[str, str], ...]]
    """The queries of the tiles that were asked for since the picture before; none where they were known."""


class Viewer(WatchedPage):
    """The viewer on a page."""

    def __init__(self, page: Page, client: Client) -> None:
        self.address = str(client.base_url)
        super().__init__(page, [self.address])
        bounds = {level["name"]: level["bounds"] for level in client.get("/levels").json()}
        self._bounds: list[float] | None = bounds.get(LEVEL)

    def hide_preparations(self) -> None:
        """Tell the page that nothing is left to prepare: what the service compiles in the background has a line of its own."""
        self.page.route(re.compile("/readyz$"), lambda route: route.fulfill(json={"status": "ready", "preparing": None}))

    def open(self, fragment: str = "") -> Shown:
        """Open the page, of an address's part after ``#``, and wait for its map."""
        self.page.goto(f"{self.address}/{fragment}")
        return self.shown()

    def settled(self) -> None:
        """Wait until the map shows what the page is set to, and the address says it."""
        end = time.monotonic() + DRAWN_S
        while True:
            self.check()
            failed = self.page.locator("#status.failed:visible")
            if failed.count():
                pytest.fail(f"the page says: {failed.inner_text()}", pytrace=False)
            data = self.page.evaluate("() => new Promise(requestAnimationFrame).then(() => ({...document.body.dataset}))")
            if data.get("shown") and data.get("busy") != "true" and data.get("written") != "false" and not self.waiting:
                return
            if time.monotonic() > end:
                pytest.fail(f"not drawn after {DRAWN_S} s: {data}, {len(self.waiting)} requests wait")

    def shown(self) -> Shown:
        """The level on the map, once all is there and the picture stands still."""
        end = time.monotonic() + DRAWN_S
        before, alike = None, 0
        while alike < STILL:
            self.settled()
            pixels = self.pixels(self.place())
            alike = alike + 1 if before is not None and np.array_equal(before, pixels) else 1
            before = pixels
            assert time.monotonic() < end, "the picture does not stand still"
        tiles = [address for address in self.asked if "/tiles/" in address]
        self.asked.clear()
        assert before is not None
        return Shown(before, {tuple(sorted(parse_qsl(urlsplit(tile).query))) for tile in tiles})

    def place(self) -> FloatRect:
        """Where the level lies in the window, by the view in the page's address."""
        found = re.search(r"map=([\d.]+)/(-?[\d.]+)/(-?[\d.]+)", self.page.url)
        assert found, self.page.url
        zoom, lat, lon = map(float, found.groups())
        assert self._bounds is not None, f"the service has no {LEVEL}"
        west, south, east, north = self._bounds
        round_the_earth = 512 * 2**zoom
        left, right = (WINDOW["width"] / 2 + (x - lon) / 360 * round_the_earth for x in (west, east))
        top, bottom = (WINDOW["height"] / 2 + (_down(y) - _down(lat)) * round_the_earth for y in (north, south))
        assert 0 <= left < right <= WINDOW["width"] and 0 <= top < bottom <= WINDOW["height"], "the level fits the window"
        x, y = round(left) + MARGIN_PX, round(top) + MARGIN_PX
        return FloatRect(x=x, y=y, width=round(right) - MARGIN_PX - x, height=round(bottom) - MARGIN_PX - y)


def _down(latitude: float) -> float:
    """Web Mercator's way south from the equator, as a share of the way round the earth."""
    return -math.asinh(math.tan(math.radians(latitude))) / math.tau


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """The browser."""
    if not CHROMIUM.exists():
        missing(f"there is no {CHROMIUM}: 'make test-browser' installs it, or 'apt-get install chromium'")
    expect.set_options(timeout=1000 * DRAWN_S)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=IN_SOFTWARE)
        try:
            yield browser
        finally:
            browser.close()


@pytest.fixture(scope="session")
def service() -> Iterator[Client]:
    """A service of the level with one render process that is ready: what is slow then is the page."""
    with ready_service([find_level(LEVEL)]) as client:
        yield client


@contextmanager
def ready_service(levels: Sequence[Path]) -> Iterator[Client]:
    """A service of levels that can draw."""
    with running(create_app(Settings(workers=1), list(levels))) as client:
        end = time.monotonic() + READY_S
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < end, "no render process is ready"
            time.sleep(0.2)
        yield client


@pytest.fixture
def make_viewer(chromium: Browser, service: Client) -> Iterator[Callable[..., Viewer]]:
    """Makes viewers, not yet opened, in windows of their own: of Playwright's ``new_context``."""
    with viewers_of(chromium, service) as make:
        yield make


@contextmanager
def viewers_of(chromium: Browser, service: Client) -> Iterator[Callable[..., Viewer]]:
    """Makes viewers of a service; what went wrong on one of them fails the test."""
    if not (STATIC_FOLDER / "index.html").is_file():
        missing("the viewer is not built: 'make viewer' does it")
    with ExitStack() as stack:

        def make(**window: Any) -> Viewer:
            context = stack.enter_context(chromium.new_context(**{"viewport": WINDOW, "locale": "en-GB"} | window))
            # On a busy machine everything takes longer, and nothing is wrong with that.
            context.set_default_timeout(1000 * DRAWN_S)
            viewer = Viewer(context.new_page(), service)
            # Called last, and not after a test that failed anyway.
            stack.push(lambda failed, *_: None if failed else viewer.check())
            return viewer

        yield make


@pytest.fixture
def viewer(make_viewer: Callable[..., Viewer]) -> Viewer:
    """A viewer in a window of its own, not yet opened."""
    return make_viewer()


@pytest.fixture
def own_page(chromium: Browser, service: Client) -> Iterator[WatchedPage]:
    """A page that asks the service alone, not yet opened."""
    with chromium.new_context(viewport=WINDOW, base_url=str(service.base_url)) as context:
        watched = WatchedPage(context.new_page(), [str(service.base_url)])
        yield watched
        watched.check()


@pytest.fixture(scope="session")
def clients_address() -> Iterator[str]:
    """Where pages with map clients are: not on the service, but as on somebody's own site."""
    lacking = [name for name in LIBRARIES if not (CLIENTS / "node_modules" / name).is_dir()]
    if lacking:
        missing(f"there is no {', '.join(lacking)} in {CLIENTS}: 'make test-browser' installs it")
    with served_folder(CLIENTS) as address:
        yield address


@pytest.fixture
def map_client(chromium: Browser, service: Client, clients_address: str) -> Iterator[MapClient]:
    """A page for a map client, not yet opened."""
    with chromium.new_context(viewport=ViewportSize(width=WINDOW_PX, height=WINDOW_PX)) as context:
        client = MapClient(context.new_page(), service, clients_address)
        yield client
        client.check()
