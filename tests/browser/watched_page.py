"""A browser page that records every fault: errors in its console, failed requests, requests to other origins."""

from __future__ import annotations

import re
from collections.abc import Sequence
from io import BytesIO

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import ConsoleMessage, FloatRect, Page, Request, Response

MAX_LISTED_FAULTS = 4
"""Maximum number of faults in a report. Dozens of tiles may fail together."""

ABORTED_ERROR = "net::ERR_ABORTED"
"""Chromium's error for requests that the page itself has cancelled."""


class WatchedPage:
    """A page, its requests and its faults. It may request from some origins only."""

    def __init__(self, page: Page, origins: Sequence[str]) -> None:
        self.page = page
        self.faults: list[str] = []
        self.requested_urls: list[str] = []
        self.allowed_faults: re.Pattern[str] | None = None
        """Faults that the test provokes, and that are ignored."""
        self.waiting: set[Request] = set()
        self._origins = tuple(f"{origin}/" for origin in origins)
        page.on("console", self._on_console)
        page.on("pageerror", lambda error: self.faults.append(f"uncaught: {error}"))
        page.on("request", self._on_request)
        page.on("response", self._on_response)
        page.on("requestfinished", lambda request: self.waiting.discard(request))
        page.on("requestfailed", self._on_request_failed)

    def allow(self, origin: str) -> None:
        """Allow requests to another origin, too."""
        self._origins += (f"{origin.rstrip('/')}/",)

    def check(self) -> None:
        """Fail the test if the page has had a fault."""
        self.faults = [fault for fault in self.faults if self.allowed_faults is None or not self.allowed_faults.search(fault)]
        if self.faults:
            pytest.fail("\n".join(["on the page:", *self.faults[:MAX_LISTED_FAULTS]]), pytrace=False)

    def pixels(self, clip: FloatRect | None = None) -> np.ndarray:
        """Return a screenshot of the page, or of a part of it, (rows, cols, 3) uint8."""
        return np.asarray(Image.open(BytesIO(self.page.screenshot(clip=clip))).convert("RGB"))

    def _on_console(self, message: ConsoleMessage) -> None:
        """Record an error in the console as a fault."""
        if message.type == "error":
            self.faults.append(f"console: {message.text}")

    def _on_request(self, request: Request) -> None:
        """Record a request, as a fault if it goes to another host."""
        if request.url.startswith(("data:", "blob:")):
            return
        self.waiting.add(request)
        self.requested_urls.append(request.url)
        if not request.url.startswith(self._origins):
            self.faults.append(f"not from the service: {request.url}")

    def _on_response(self, response: Response) -> None:
        """Record a response with an error status as a fault."""
        if response.status >= 400:
            self.faults.append(f"{response.status}: {response.url}")

    def _on_request_failed(self, request: Request) -> None:
        """Record a failed request as a fault, unless the page cancelled it."""
        self.waiting.discard(request)
        if request.failure != ABORTED_ERROR:
            self.faults.append(f"{request.failure}: {request.url}")
