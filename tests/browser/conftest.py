"""Headless Debian Chromium and a real service of one bundled level, for the service's pages and for map clients.

An unexpected fault on a page (an error in its console, a request that fails) fails every test of it. A picture of the page of a
failed test lies in ``tests/output``.
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
from tests.browser.map_clients import CLIENTS, LEVEL, LIBRARIES, WINDOW_PX, MapClient, serve_folder
from tests.browser.watched_page import WatchedPage
from tests.golden import OUTPUT

HERE = Path(__file__).parent

CHROMIUM = Path("/usr/bin/chromium")
SOFTWARE_GL_FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
"""Root cannot use the sandbox. SwiftShader draws the map by the same rasteriser on every machine."""

WINDOW_SIZE_PX = ViewportSize(width=1280, height=800)

READY_TIMEOUT_S, DRAWN_TIMEOUT_S = 180, 90
"""Timeouts of the service's start, at which a render worker may compile, and of drawing a map."""

EQUAL_SCREENSHOT_COUNT = 3
"""Number of equal screenshots in a row after which the map counts as drawn. Tiles fade in after they arrive."""

MARGIN_PX = 6
"""Margin that is cut off on all sides of the level, because the page's address rounds the view."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark every test of this folder as a browser test."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.browser)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Take a picture of each page of a failed test while it is open."""
    report = yield
    watched_pages = [value for value in getattr(item, "funcargs", {}).values() if isinstance(value, WatchedPage)]
    if report.when == "call" and report.failed:
        OUTPUT.mkdir(exist_ok=True)
        name = re.sub("[^A-Za-z0-9_.-]+", "-", item.name)
        for number, watched in enumerate(dict.fromkeys(watched_pages)):
            path = OUTPUT / f"{name}-{number}.png"
            # A closed page has no picture, which is no further failure.
            with suppress(Error):
                watched.page.screenshot(path=path)
                report.sections.append(("the page", f"see {path}"))
    return report


def skip_missing(requirement: str) -> NoReturn:
    """Skip a test whose requirement is missing; fail it on CI."""
    if os.environ.get("CI"):
        pytest.fail(requirement)
    pytest.skip(requirement)


@dataclass(frozen=True, eq=False)
class LevelPicture:
    """The level's pixels on the page, and the queries of the tiles requested for them."""

    pixels: np.ndarray
    """The level's part of the map, (rows, cols, 3) uint8."""

    queries: set[tuple[tuple[str, str], ...]]
    """Query parameters of the tiles requested since the previous picture; empty if all tiles were cached."""


class Viewer(WatchedPage):
    """The viewer on a page."""

    def __init__(self, page: Page, client: Client) -> None:
        self.address = str(client.base_url)
        super().__init__(page, [self.address])
        bounds = {level["name"]: level["bounds"] for level in client.get("/levels").json()}
        self._bounds: list[float] | None = bounds.get(LEVEL)

    def hide_preparations(self) -> None:
        """Answer ``/readyz`` without preparations, which the page would show on a line of their own."""
        self.page.route(re.compile("/readyz$"), lambda route: route.fulfill(json={"status": "ready", "preparing": None}))

    def open(self, fragment: str = "") -> LevelPicture:
        """Open the page at a URL fragment, including its ``#``, and wait for its map."""
        self.page.goto(f"{self.address}/{fragment}")
        return self.wait_until_drawn()

    def wait_until_settled(self) -> None:
        """Wait until the map, the one that it is compared with, and the address match the page's settings."""
        end = time.monotonic() + DRAWN_TIMEOUT_S
        while True:
            self.check()
            failed = self.page.locator("#status.failed:visible")
            if failed.count():
                pytest.fail(f"the page shows an error: {failed.inner_text()}", pytrace=False)
            data = self.page.evaluate("() => new Promise(requestAnimationFrame).then(() => ({...document.body.dataset}))")
            behind = data.get("busy") == "true" or data.get("written") == "false" or data.get("compared") == "false"
            if data.get("shown") and not behind and not self.waiting:
                return
            if time.monotonic() > end:
                pytest.fail(f"the map is not drawn after {DRAWN_TIMEOUT_S} s: {data}, {len(self.waiting)} pending requests")

    def wait_until_drawn(self) -> LevelPicture:
        """Return the level on the map, once all tiles are drawn and the picture is still."""
        end = time.monotonic() + DRAWN_TIMEOUT_S
        before, equal_count = None, 0
        while equal_count < EQUAL_SCREENSHOT_COUNT:
            self.wait_until_settled()
            pixels = self.pixels(self.level_rectangle())
            equal_count = equal_count + 1 if before is not None and np.array_equal(before, pixels) else 1
            before = pixels
            assert time.monotonic() < end, f"the map still changes after {DRAWN_TIMEOUT_S} s"
        tiles = [address for address in self.requested_urls if "/tiles/" in address]
        self.requested_urls.clear()
        assert before is not None
        return LevelPicture(before, {tuple(sorted(parse_qsl(urlsplit(tile).query))) for tile in tiles})

    def level_rectangle(self) -> FloatRect:
        """Return the level's rectangle in the window, computed from the view in the page's address."""
        match = re.search(r"map=([\d.]+)/(-?[\d.]+)/(-?[\d.]+)", self.page.url)
        assert match, self.page.url
        zoom, lat, lon = map(float, match.groups())
        assert self._bounds is not None, f"the service has no {LEVEL}"
        west, south, east, north = self._bounds
        round_the_earth = 512 * 2**zoom
        left, right = (WINDOW_SIZE_PX["width"] / 2 + (x - lon) / 360 * round_the_earth for x in (west, east))
        top, bottom = (
            WINDOW_SIZE_PX["height"] / 2 + (_mercator_y_share(y) - _mercator_y_share(lat)) * round_the_earth for y in (north, south)
        )
        assert 0 <= left < right <= WINDOW_SIZE_PX["width"] and 0 <= top < bottom <= WINDOW_SIZE_PX["height"], (
            "the level fits the window"
        )
        x, y = round(left) + MARGIN_PX, round(top) + MARGIN_PX
        return FloatRect(x=x, y=y, width=round(right) - MARGIN_PX - x, height=round(bottom) - MARGIN_PX - y)


def _mercator_y_share(latitude: float) -> float:
    """Return the distance south of the equator in Web Mercator, as a fraction of the equator's length."""
    return -math.asinh(math.tan(math.radians(latitude))) / math.tau


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """Yield the browser."""
    if not CHROMIUM.exists():
        skip_missing(f"there is no {CHROMIUM}: 'make test-browser' installs it, or 'apt-get install chromium'")
    expect.set_options(timeout=1000 * DRAWN_TIMEOUT_S)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=SOFTWARE_GL_FLAGS)
        try:
            yield browser
        finally:
            browser.close()


@pytest.fixture(scope="session")
def service() -> Iterator[Client]:
    """Yield a service of the level whose render worker is ready, so that only the page can be slow."""
    with ready_service([find_level(LEVEL)]) as client:
        yield client


@contextmanager
def ready_service(levels: Sequence[Path]) -> Iterator[Client]:
    """Yield a client of a service of levels, once it can draw."""
    with running(create_app(Settings(workers=1), list(levels))) as client:
        end = time.monotonic() + READY_TIMEOUT_S
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < end, "no render process is ready"
            time.sleep(0.2)
        yield client


@pytest.fixture
def make_viewer(chromium: Browser, service: Client) -> Iterator[Callable[..., Viewer]]:
    """Yield a factory of viewers, not yet opened, in windows of their own; its arguments are those of ``new_context``."""
    with viewer_factory(chromium, service) as make_viewer:
        yield make_viewer


@contextmanager
def viewer_factory(chromium: Browser, service: Client) -> Iterator[Callable[..., Viewer]]:
    """Yield a factory of viewers of a service; a fault on any of them fails the test."""
    if not (STATIC_FOLDER / "index.html").is_file():
        skip_missing("the viewer is not built: 'make viewer' does it")
    with ExitStack() as stack:

        def make_viewer(**window: Any) -> Viewer:
            context = stack.enter_context(chromium.new_context(**{"viewport": WINDOW_SIZE_PX, "locale": "en-GB"} | window))
            # A busy machine is slow, which is no fault.
            context.set_default_timeout(1000 * DRAWN_TIMEOUT_S)
            viewer = Viewer(context.new_page(), service)
            # Called last, and only if the test has not failed.
            stack.push(lambda failed, *_: None if failed else viewer.check())
            return viewer

        yield make_viewer


@pytest.fixture
def viewer(make_viewer: Callable[..., Viewer]) -> Viewer:
    """Return a viewer, not yet opened, in a window of its own."""
    return make_viewer()


@pytest.fixture
def service_page(chromium: Browser, service: Client) -> Iterator[WatchedPage]:
    """Yield a page, not yet opened, that may request from the service alone."""
    with chromium.new_context(viewport=WINDOW_SIZE_PX, base_url=str(service.base_url)) as context:
        watched = WatchedPage(context.new_page(), [str(service.base_url)])
        yield watched
        watched.check()


@pytest.fixture(scope="session")
def clients_address() -> Iterator[str]:
    """Yield the address of the pages with map clients, on another server than the service, like a third-party site."""
    missing_libraries = [name for name in LIBRARIES if not (CLIENTS / "node_modules" / name).is_dir()]
    if missing_libraries:
        skip_missing(f"there is no {', '.join(missing_libraries)} in {CLIENTS}: 'make test-browser' installs it")
    with serve_folder(CLIENTS) as address:
        yield address


@pytest.fixture
def map_client(chromium: Browser, service: Client, clients_address: str) -> Iterator[MapClient]:
    """Yield a page for a map client, not yet opened."""
    with chromium.new_context(viewport=ViewportSize(width=WINDOW_PX, height=WINDOW_PX)) as context:
        client = MapClient(context.new_page(), service, clients_address)
        yield client
        client.check()
