"""A browser page that records every fault: errors in its console, failed requests, requests to other origins."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import ConsoleMessage, FloatRect, Page, Request, Response

MAX_TOLD = 4
"""Faults in a report: a map has dozens of tiles, which fail together."""

GIVEN_UP = "net::ERR_ABORTED"
"""Chromium's error for requests that the page itself has cancelled."""


class WatchedPage:
    """A page, its requests and its faults. It may request from some origins only."""

    def __init__(self, page: Page, origins: Sequence[str]) -> None:
        self.page = page
        self.wrong: list[str] = []
        self.asked: list[str] = []
        self.forgiven: re.Pattern[str] | None = None
        """Faults that the test provokes, and that are ignored."""
        self.waiting: set[Request] = set()
        self._origins = tuple(f"{origin}/" for origin in origins)
        page.on("console", self._said)
        page.on("pageerror", lambda error: self.wrong.append(f"uncaught: {error}"))
        page.on("request", self._requested)
        page.on("response", self._answered)
        page.on("requestfinished", lambda request: self.waiting.discard(request))
        page.on("requestfailed", self._failed)

    def allow(self, origin: str) -> None:
        """Allow requests to another origin, too."""
        self._origins += (f"{origin.rstrip('/')}/",)

    def check(self) -> None:
        """Fail the test if the page has had a fault."""
        self.wrong = [each for each in self.wrong if self.forgiven is None or not self.forgiven.search(each)]
        if self.wrong:
            pytest.fail("\n".join(["on the page:", *self.wrong[:MAX_TOLD]]), pytrace=False)

    def pixels(self, clip: FloatRect | None = None) -> np.ndarray:
        """Return a screenshot of the page, or of a part of it, (rows, cols, 3) uint8."""
        return np.asarray(Image.open(BytesIO(self.page.screenshot(clip=clip))).convert("RGB"))

    def _said(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.wrong.append(f"console: {message.text}")

    def _requested(self, request: Request) -> None:
        if request.url.startswith(("data:", "blob:")):
            return
        self.waiting.add(request)
        self.asked.append(request.url)
        if not request.url.startswith(self._origins):
            self.wrong.append(f"not from the service: {request.url}")

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.wrong.append(f"{response.status}: {response.url}")

    def _failed(self, request: Request) -> None:
        self.waiting.discard(request)
        if request.failure != GIVEN_UP:
            self.wrong.append(f"{request.failure}: {request.url}")
