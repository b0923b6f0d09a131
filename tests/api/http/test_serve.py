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

from tests.api.conftest import CORNER, ZOOM

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

INSPECT_SCRIPT = f"""
import sys
from pathlib import Path
from skugga.api.http.server.app import create_app
from skugga.api.settings import Settings
from skugga.terrain.gl import device as gl
from tests.api.conftest import running

if __name__ == "__main__":
    app = create_app(Settings(workers=1), [Path(sys.argv[1])])
    assert "pvlib" not in sys.modules, "a service without requests does not import pvlib"
    with running(app) as client:
        tile = client.get("/levels/timed/tiles/WebMercatorQuad/{ZOOM}/{CORNER[0]}/{CORNER[1]}.png")
        assert tile.status_code == 200, tile.content
        assert "server-timing" in tile.headers
    assert not gl.is_device_open(), "the service's process has made an OpenGL context"
    assert "pvlib" not in sys.modules
"""


@contextmanager
def serving_process(
    levels: Sequence[Path], log_pattern: str, environment: dict[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Yield a serving process that has logged a match of ``log_pattern``, and the match's first group; kill it at the end."""
    command = [sys.executable, "-c", SERVE_SCRIPT, *map(str, levels)]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None
            for line in process.stderr:
                match = re.search(log_pattern, line)
                if match:
                    yield process, match.group(1)
                    return
            raise AssertionError(f"the service ended without a log line that matches '{log_pattern}'")
        finally:
            process.kill()


def is_running(pid: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.parametrize("signal_number", [pytest.param(signal.SIGINT, marks=pytest.mark.long), signal.SIGTERM])
def test_signal_ends_service_and_worker(hills_level: Path, signal_number: signal.Signals):
    with serving_process([hills_level], r"render process (\d+) ready") as (process, worker):
        process.send_signal(signal_number)
        _, log_text = process.communicate(timeout=TIMEOUT_S)
        assert process.returncode in (0, -signal_number)
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


def test_service_process_has_no_opengl(hills_level: Path, client):
    timed = hills_level.with_name("timed.yaml")
    process = subprocess.run(
        [sys.executable, "-c", INSPECT_SCRIPT, str(timed)], cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S
    )
    assert process.returncode == 0, process.stderr


def test_invalid_level_ends_the_service_at_once(tmp_path: Path):
    level_file = tmp_path / "wrong.yaml"
    level_file.write_text("version: 7\nterrain: {source: dem.tif}", encoding="utf-8")
    script = "import sys; from skugga.api.cli.main import main; sys.argv = ['skugga', 'serve', sys.argv[1]]; main()"
    command = [sys.executable, "-c", script, str(level_file)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S)
    assert process.returncode == 2
    assert process.stderr.count("\n") == 1
    assert "wrong.yaml" in process.stderr and "version" in process.stderr
