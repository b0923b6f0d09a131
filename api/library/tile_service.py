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
from typing import IO, Any
from urllib.error import HTTPError
from urllib.parse import quote
from urllib.request import urlopen

from skugga.terrain.errors import RenderError
from skugga.terrain.level.level_source import LevelSource

START_TIMEOUT_S = 600.0
"""Seconds within which the service must be ready. With empty caches it compiles loops (functions that numba compiles to machine
code) for some minutes."""

IDLE_WORK_VARIABLES = "SKUGGA_CALIBRATE_WHEN_IDLE", "SKUGGA_PROBE_WHEN_IDLE"
"""Environment variables that switch off calibrations and probes while a service is idle."""

POLL_INTERVAL_S = 0.1
"""Seconds between two checks whether the service is ready."""


class TileService:
    """A local service of a level file or a raster. It ends on ``close``, or when the object is garbage collected.

    The constructor raises ``RenderError`` if the service does not start.
    """

    def __init__(self, level: LevelSource) -> None:
        self.name = level.path.stem
        self._log_file = tempfile.TemporaryFile("w+")  # noqa: SIM115  # open as long as the process runs
        port = _free_port()
        self.address = f"http://127.0.0.1:{port}"
        options = [f"--{name}={getattr(level, name)}" for name in level.options]
        command = "from skugga.api.cli.main import main; main()"
        process = subprocess.Popen(
            [sys.executable, "-c", command, "serve", str(level.path), "--port", str(port), *options],
            env={**dict.fromkeys(IDLE_WORK_VARIABLES, "false"), **os.environ},  # the notebook process is not idle
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=self._log_file,
        )  # fmt: skip
        self._stop_process = weakref.finalize(self, _stop_process, process, self._log_file)
        self._wait_until_ready(process)

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
        self._stop_process()

    def _wait_until_ready(self, process: subprocess.Popen[bytes]) -> None:
        """Wait until the service answers that it can draw. Raises ``RenderError`` if it ends, or after ``START_TIMEOUT_S``."""
        deadline = time.monotonic() + START_TIMEOUT_S
        while time.monotonic() < deadline and process.poll() is None:
            try:
                with urlopen(f"{self.address}/readyz"):
                    return
            except OSError:
                time.sleep(POLL_INTERVAL_S)
        self._log_file.seek(0)
        last_line = self._log_file.read().strip().rpartition("\n")[2]
        self.close()
        raise RenderError(f"the tile service of {self.name} did not start: {last_line or f'no answer in {START_TIMEOUT_S:g} s'}")


def _free_port() -> int:
    """Return a TCP port of this machine that is free now."""
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def _stop_process(process: subprocess.Popen[bytes], log_file: IO[str]) -> None:
    """Close the log file, and end the process: by SIGTERM, and by SIGKILL if it has not ended after ten seconds."""
    log_file.close()
    process.terminate()
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
