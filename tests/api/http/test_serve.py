"""The service as a process: what it loads, how it starts and how it stops."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from skugga.api.cli.main import main
from tests.api.conftest import CORNER, ZOOM, write_level

ROOT = Path(__file__).resolve().parents[3]
TIMEOUT_S = 60

SERVE_SCRIPT = """
import sys
from pathlib import Path
from skugga.api.http.server.server import serve
from skugga.api.settings import Settings

if __name__ == "__main__":
    serve(Settings(port=0, workers=1), [Path(path) for path in sys.argv[1:]])
"""


@contextmanager
def serving_process(
    levels: Sequence[Path], log_pattern: str, environment: dict[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield a serving process that has logged a match of ``log_pattern``, and the match's first group; kill it at the end."""
    command = [sys.executable, "-c", SERVE_SCRIPT, *map(str, levels)]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process, next_log_match(process, log_pattern)
        finally:
            process.kill()


def next_log_match(process: subprocess.Popen[str], log_pattern: str) -> str:
    """Return the first group of the next match of ``log_pattern`` in a service's log."""
    assert process.stderr is not None
    for line in process.stderr:
        match = re.search(log_pattern, line)
        if match:
            return match.group(1)
    raise AssertionError(f"the service ended without a log line that matches '{log_pattern}'")


def is_running(pid: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_service_loads_no_opengl_and_ends_with_its_worker(folder: Path):
    """The level's sun has a time: that needs pvlib, which imports pandas, but only in the render process."""
    level = write_level(folder, "summer", sun={"time": "2024-06-21T18:00:00+02:00"})
    with serving_process([level], r"on (http://\S+)") as (process, address):
        worker = next_log_match(process, r"render process (\d+) ready")
        with httpx.Client(base_url=address, timeout=TIMEOUT_S) as client:
            tile = client.get(f"/levels/summer/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png")
        assert tile.status_code == 200, tile.content
        assert "server-timing" in tile.headers
        libraries = [Path(f"/proc/{pid}/maps").read_text() for pid in (process.pid, worker)]
        assert ["libEGL" in text for text in libraries] == [False, True], "only the render process has OpenGL"
        assert ["/pandas/" in text for text in libraries] == [False, True], "only the render process imports pvlib"

        process.send_signal(signal.SIGTERM)
        _, log_text = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode in (0, -signal.SIGTERM)
        assert "Traceback" not in log_text
        assert not is_running(int(worker))


def test_signal_during_start_ends_the_service(hills_level: Path):
    with serving_process([hills_level], r"on (http://\S+)") as (process, address):
        assert httpx.get(f"{address}/healthz").status_code == 200
        for signal_number in (signal.SIGUSR1, signal.SIGHUP):
            process.send_signal(signal_number)
            assert httpx.get(f"{address}/levels").status_code == 200, "this signal does not end the service"
        process.send_signal(signal.SIGINT)
        _, log_text = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode == 0
        assert "Traceback" not in log_text
        assert "SIGUSR1" in log_text and "SIGHUP" in log_text


def test_worker_ends_with_a_killed_service(hills_level: Path):
    with serving_process([hills_level], r"render process (\d+) ready") as (process, worker):
        process.kill()
        # The worker holds its end of the error pipe open until it ends, which is soon after its own pipe is closed.
        process.communicate(timeout=TIMEOUT_S)
        assert not is_running(int(worker))


def test_invalid_level_ends_the_service_at_once(tmp_path: Path, monkeypatch, capsys):
    level_file = tmp_path / "wrong.yaml"
    level_file.write_text("version: 7\nterrain: {source: dem.tif}", encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["skugga", "serve", str(level_file)])
    with pytest.raises(SystemExit) as exit_info:
        main()
    assert exit_info.value.code == 2
    error_text = capsys.readouterr().err
    assert error_text.count("\n") == 1
    assert "wrong.yaml" in error_text and "version" in error_text
