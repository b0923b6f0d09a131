"""The viewer in a real browser: Debian's Chromium, without a window, before a real service of one bundled level.

What is wrong on a page that nobody asked for (an error in its console, a request that fails) fails every test of it. The page of
a failed test lies in ``tests/output``.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Generator, Iterator
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import NoReturn
from urllib.parse import parse_qsl, urlsplit

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Browser, ConsoleMessage, Error, FloatRect, Page, Request, Response, ViewportSize, sync_playwright

from api.catalogue import find_level
from api.http.app import create_app
from api.http.routes_viewer import STATIC_FOLDER
from api.settings import Settings
from tests.api.conftest import Client, running
from tests.golden import OUTPUT

HERE = Path(__file__).parent

CHROMIUM = Path("/usr/bin/chromium")
IN_SOFTWARE = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
"""Root may have no sandbox; the map is drawn by the same rasteriser on every machine."""

LEVEL = "jacksboro"
WINDOW = ViewportSize(width=1280, height=800)

READY_S, DRAWN_S = 180, 90
"""A render process compiles at its first start; a map takes seconds."""

STILL = 3
"""So many pictures in a row that are alike: tiles fade in, and are decoded a moment after they have come."""

MARGIN_PX = 6
"""Left off all round: the address of a view is rounded."""

MOST_TOLD = 4
"""A map has dozens of tiles, which go wrong together."""

GIVEN_UP = "net::ERR_ABORTED"
"""What Chromium says of requests that the page itself no longer wants."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """All tests of this folder need a browser, also one that does not say so."""
    for item in items:
        if item.path.is_relative_to(HERE):
            item.add_marker(pytest.mark.browser)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Take a picture of the page of a failed test while it is open."""
    report = yield
    viewer = getattr(item, "funcargs", {}).get("viewer")
    if viewer is not None and report.when == "call" and report.failed:
        OUTPUT.mkdir(exist_ok=True)
        path = OUTPUT / f"{item.name}.png"
        # A page that is gone has no picture, and that is no other failure.
        with suppress(Error):
            viewer.page.screenshot(path=path)
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
    """The queries of the tiles that were asked for since the picture before."""


class Viewer:
    """The viewer on a page, and what goes wrong there."""

    def __init__(self, page: Page, client: Client) -> None:
        self.page = page
        self.wrong: list[str] = []
        self._address = str(client.base_url)
        self._bounds: list[float] = next(level["bounds"] for level in client.get("/levels").json() if level["name"] == LEVEL)
        self._tiles: list[str] = []
        self._waiting: set[Request] = set()
        page.on("console", self._said)
        page.on("pageerror", lambda error: self.wrong.append(f"uncaught: {error}"))
        page.on("request", self._asked)
        page.on("response", self._answered)
        page.on("requestfinished", lambda request: self._waiting.discard(request))
        page.on("requestfailed", self._failed)

    def open(self) -> Shown:
        """Open the page, and wait for its map."""
        self.page.goto(self._address)
        return self.shown()

    def check(self) -> None:
        """Fail if anything has gone wrong on the page."""
        if self.wrong:
            pytest.fail("\n".join(["on the page:", *self.wrong[:MOST_TOLD]]), pytrace=False)

    def shown(self) -> Shown:
        """The map, once tiles have been asked for since the last time, all are there, and the picture stands still."""
        end = time.monotonic() + DRAWN_S
        before, alike = None, 0
        while alike < STILL:
            self.check()
            failed = self.page.locator("#status.failed:visible")
            if failed.count():
                pytest.fail(f"the page says: {failed.inner_text()}", pytrace=False)
            busy = self.page.locator("#status").is_visible() or bool(self._waiting)
            if time.monotonic() > end:
                pytest.fail(f"not drawn after {DRAWN_S} s: {len(self._tiles)} tiles asked for, {busy=}")
            self.page.evaluate("() => new Promise(requestAnimationFrame)")
            if busy or not self._tiles:
                before, alike = None, 0
                continue
            pixels = self._pixels()
            alike = alike + 1 if before is not None and np.array_equal(before, pixels) else 1
            before = pixels
        tiles, self._tiles = self._tiles, []
        assert before is not None
        return Shown(before, {tuple(sorted(parse_qsl(urlsplit(tile).query))) for tile in tiles})

    def _pixels(self) -> np.ndarray:
        png = self.page.screenshot(clip=self._place())
        return np.asarray(Image.open(BytesIO(png)).convert("RGB"))

    def _place(self) -> FloatRect:
        """Where the level lies in the window, by the view in the page's address."""
        found = re.search(r"map=([\d.]+)/(-?[\d.]+)/(-?[\d.]+)", self.page.url)
        assert found, self.page.url
        zoom, lat, lon = map(float, found.groups())
        west, south, east, north = self._bounds
        round_the_earth = 512 * 2**zoom
        left, right = (WINDOW["width"] / 2 + (x - lon) / 360 * round_the_earth for x in (west, east))
        top, bottom = (WINDOW["height"] / 2 + (_down(y) - _down(lat)) * round_the_earth for y in (north, south))
        assert 0 <= left < right <= WINDOW["width"] and 0 <= top < bottom <= WINDOW["height"], "the level fits the window"
        x, y = round(left) + MARGIN_PX, round(top) + MARGIN_PX
        return FloatRect(x=x, y=y, width=round(right) - MARGIN_PX - x, height=round(bottom) - MARGIN_PX - y)

    def _said(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.wrong.append(f"console: {message.text}")

    def _asked(self, request: Request) -> None:
        if request.url.startswith(("data:", "blob:")):
            return
        self._waiting.add(request)
        if not request.url.startswith(f"{self._address}/"):
            self.wrong.append(f"not from the service: {request.url}")
        if "/tiles/" in request.url:
            self._tiles.append(request.url)

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.wrong.append(f"{response.status}: {response.url}")

    def _failed(self, request: Request) -> None:
        self._waiting.discard(request)
        if request.failure != GIVEN_UP:
            self.wrong.append(f"{request.failure}: {request.url}")


def _down(latitude: float) -> float:
    """Web Mercator's way south from the equator, as a share of the way round the earth."""
    return -math.asinh(math.tan(math.radians(latitude))) / math.tau


@pytest.fixture(scope="session")
def chromium() -> Iterator[Browser]:
    """The browser."""
    if not CHROMIUM.exists():
        missing(f"there is no {CHROMIUM}: 'make test-browser' installs it, or 'apt-get install chromium'")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=IN_SOFTWARE)
        try:
            yield browser
        finally:
            browser.close()


@pytest.fixture(scope="session")
def service() -> Iterator[Client]:
    """A service of the level with one render process that is ready: what is slow then is the viewer."""
    if not (STATIC_FOLDER / "index.html").is_file():
        missing("the viewer is not built: 'make viewer' does it")
    with running(create_app(Settings(workers=1), [find_level(LEVEL)])) as client:
        end = time.monotonic() + READY_S
        while client.get("/readyz").status_code != 200:
            assert time.monotonic() < end, "no render process is ready"
            time.sleep(0.2)
        yield client


@pytest.fixture
def viewer(chromium: Browser, service: Client) -> Iterator[Viewer]:
    """A viewer in a window of its own, not yet opened."""
    context = chromium.new_context(viewport=WINDOW)
    try:
        viewer = Viewer(context.new_page(), service)
        yield viewer
        viewer.check()
    finally:
        context.close()
