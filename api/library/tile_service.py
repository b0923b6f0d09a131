"""Run a tile service of one level for notebooks, in a separate process."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import time
import weakref
from pathlib import Path
from typing import IO, Any
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import urlopen

from skugga.terrain.errors import RenderError

READY_S = 600.0
"""Timeout of the start. With empty caches the service compiles for some minutes."""

WHEN_IDLE = "SKUGGA_CALIBRATE_WHEN_IDLE", "SKUGGA_PROBE_WHEN_IDLE"

ASKED_EVERY_S = 0.1


class TileService:
    """A local service of a level file or a raster. It ends on ``close``, or when the object is garbage collected.

    The constructor raises ``RenderError`` if the service does not start.
    """

    def __init__(self, level: Path) -> None:
        self.name = level.stem
        self._said = tempfile.TemporaryFile("w+")  # noqa: SIM115  # open as long as the process runs
        port = _free_port()
        self.address = f"http://127.0.0.1:{port}"
        command = "from skugga.api.cli.main import main; main()"
        process = subprocess.Popen(
            [sys.executable, "-c", command, "serve", str(level), "--port", str(port)],
            env={**dict.fromkeys(WHEN_IDLE, "false"), **os.environ},  # the notebook process is not idle
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._said,
        )  # fmt: skip
        self._end = weakref.finalize(self, _end, process, self._said)
        self._wait(process)

    def tile_json(self, query: str) -> dict[str, Any]:
        """Return the TileJSON of its Web Mercator tiles for a query string. Raises ``RenderError``."""
        address = f"{self.address}/levels/{quote(self.name)}/WebMercatorQuad/tilejson.json?{query}"
        try:
            with urlopen(address) as answer:
                return dict(json.load(answer))
        except HTTPError as error:
            with error:
                raise RenderError(json.load(error).get("detail", str(error))) from None

    def close(self) -> None:
        """End the service."""
        self._end()

    def _wait(self, process: subprocess.Popen[bytes]) -> None:
        until = time.monotonic() + READY_S
        while time.monotonic() < until and process.poll() is None:
            try:
                with urlopen(f"{self.address}/readyz"):
                    return
            except OSError:
                time.sleep(ASKED_EVERY_S)
        self._said.seek(0)
        last = self._said.read().strip().rpartition("\n")[2]
        self.close()
        raise RenderError(f"the tile service of {self.name} did not start: {last or f'no answer in {READY_S:g} s'}")


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def _end(process: subprocess.Popen[bytes], said: IO[str]) -> None:
    said.close()
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
