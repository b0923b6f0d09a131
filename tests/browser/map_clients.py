"""Third-party map clients on pages of another origin, and the pictures that they must show."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from playwright.sync_api import Page

from tests.api.conftest import Client
from tests.browser.watched_page import WatchedPage

CLIENTS = Path(__file__).parent / "clients"
"""The pages, and the libraries that npm installs beside them."""

LIBRARIES = ("leaflet", "maplibre-gl", "ol", "pmtiles")

LEVEL = "jacksboro"

TILE_PX = 256
WINDOW_PX = 2 * TILE_PX
"""A window shows the four tiles round a corner, pixel for pixel."""

MERCATOR_M = 6378137.0 * math.pi
"""Half of the equator's length in Web Mercator, metres."""

TIMES = "2024-10-21T14:05:00Z", "2024-10-21T21:35:00Z"
"""A morning and an evening in Tennessee, both on the time dimension that the service announces."""


class MapClient(WatchedPage):
    """A page with a map client that reads the service."""

    def __init__(self, page: Page, service: Client, address: str) -> None:
        self.service_address = str(service.base_url)
        super().__init__(page, [address, self.service_address])
        self._address = address

    def open(self, library: str) -> None:
        """Open the page of a library, and wait until it is loaded."""
        self.page.goto(f"{self._address}/{library}.html")
        self.page.wait_for_function("() => window.loaded")
        self.check()

    def run(self, script: str, **arguments: Any) -> Any:
        """Call a JavaScript function on the page with one object of the arguments, and return its awaited result."""
        try:
            return self.page.evaluate(script, arguments)
        finally:
            self.check()


class QuietFileServer(SimpleHTTPRequestHandler):
    """A file server without a log."""

    def log_message(self, format: str, *args: Any) -> None:
        """Discard the message."""


class RangeFileServer(QuietFileServer):
    """A file server of single byte ranges (RFC 9110, section 14) to pages of any origin, like object storage."""

    def do_GET(self) -> None:
        """Answer with the requested range."""
        match = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if match is None:
            self.send_error(416)
            return
        content = Path(self.translate_path(self.path)).read_bytes()
        first, last = int(match[1]), min(int(match[2]), len(content) - 1)
        self.send_response(206)
        for name, value in {
            "Access-Control-Allow-Origin": "*", "Content-Type": "application/vnd.pmtiles", "Content-Length": str(last + 1 - first),
            "Content-Range": f"bytes {first}-{last}/{len(content)}", "ETag": '"1"',
        }.items():  # fmt: skip
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content[first : last + 1])


@contextmanager
def serve_folder(folder: Path, files: Callable[..., QuietFileServer] = QuietFileServer) -> Iterator[str]:
    """Serve the files of a folder, and yield the server's address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(files, directory=str(folder))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


class SingleTileServer(QuietFileServer):
    """A server that answers every request with one picture, to pages of any origin."""

    def __init__(self, *args: Any, picture: bytes, **options: Any) -> None:
        self._picture = picture
        super().__init__(*args, **options)

    def do_GET(self) -> None:
        """Answer with the picture."""
        self.send_response(200)
        for name, value in {
            "Access-Control-Allow-Origin": "*",
            "Content-Type": "image/png",
            "Content-Length": str(len(self._picture)),
        }.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(self._picture)


@contextmanager
def serve_single_tile(picture: bytes) -> Iterator[str]:
    """Serve one picture as every tile, like a third-party server, and yield its address."""
    with serve_folder(CLIENTS, partial(SingleTileServer, picture=picture)) as address:
        yield address


class TileCorner:
    """The common corner of four tiles on the level, in Web Mercator or in degrees, depending on ``tms``.

    The positions of the tiles are computed independently of the service.
    """

    def __init__(self, tms: str, zoom: int, lon: float = -84.24, lat: float = 36.31) -> None:
        self.tms, self.zoom = tms, zoom
        mercator = tms == "WebMercatorQuad"
        if mercator:
            x, y = lon / 180 * MERCATOR_M, math.asinh(math.tan(math.radians(lat))) / math.pi * MERCATOR_M
            left, top, size = -MERCATOR_M, MERCATOR_M, 2 * MERCATOR_M / 2**zoom
        else:
            x, y, left, top, size = lon, lat, -180.0, 90.0, 180.0 / 2**zoom
        self.column, self.row = round((x - left) / size), round((top - y) / size)
        self.projection = "EPSG:3857" if mercator else "EPSG:4326"
        self.resolution = size / TILE_PX
        self.center = left + self.column * size, top - self.row * size
        x, y = self.center
        self.lon_lat = (x / MERCATOR_M * 180, math.degrees(math.atan(math.sinh(y / MERCATOR_M * math.pi)))) if mercator else (x, y)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north of the four tiles."""
        (x, y), half = self.center, TILE_PX * self.resolution
        return x - half, y - half, x + half, y + half

    def tiles(self, service: Client, **query: str) -> np.ndarray:
        """Return the four tiles as one picture, (rows, cols, 3) uint8."""
        rows = []
        for row in (self.row - 1, self.row):
            addresses = [f"/levels/{LEVEL}/tiles/{self.tms}/{self.zoom}/{col}/{row}.png" for col in (self.column - 1, self.column)]
            rows.append(np.hstack([fetch_picture(service, address, **query) for address in addresses]))
        return np.vstack(rows)


def fetch_picture(service: Client, address: str, **query: str) -> np.ndarray:
    """Return a picture of the service, which must be opaque, (rows, cols, 3) uint8."""
    answer = service.get(address, params=query)
    assert answer.status_code == 200, answer.text
    picture = np.asarray(Image.open(BytesIO(answer.content)).convert("RGBA"))
    assert (picture[..., 3] == 255).all(), "the picture extends beyond the level"
    return picture[..., :3]


def pixel_differences(picture: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the difference of two pictures at each pixel, in the channel that differs most."""
    assert picture.shape == other.shape
    return np.abs(picture.astype(int) - other).max(axis=2)
