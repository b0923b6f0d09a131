"""Render processes are distributed over EGL devices."""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from skugga.api.seed import local_pool
from skugga.api.workers.jobs import WorkerReady
from skugga.api.workers.pool import Pool
from skugga.api.workers.worker_config import WorkerConfig
from tests.api.http.test_serve import ROOT
from tests.api.workers.test_pool import run_with_pool, wait_until
from tests.terrain.gl.egl_machines import duplicate_mesa_environment

SERVE_SCRIPT = "import sys; from skugga.api.cli.main import main; sys.argv[0] = 'skugga'; main()"


def report_device_number(pipe: Connection, config: WorkerConfig) -> None:
    """Report the device of this worker's number, and answer nothing."""
    pipe.send(WorkerReady("card", egl_device=f"EGL device {config.number}"))
    signal.pause()


def test_a_replaced_process_keeps_its_device_number(caplog: pytest.LogCaptureFixture):
    def ready_devices() -> list[tuple[str, str]]:
        return re.findall(r"render process (\d+) ready after .*: card, EGL device (\d+)", caplog.text)

    async def scenario(pool: Pool) -> None:
        await wait_until(lambda: len(ready_devices()) == 3)
        assert sorted(number for _, number in ready_devices()) == ["0", "1", "2"]
        os.kill(int(next(pid for pid, number in ready_devices() if number == "1")), signal.SIGKILL)
        await wait_until(lambda: len(ready_devices()) == 4)
        assert ready_devices()[-1][1] == "1"

    with caplog.at_level(logging.INFO, "skugga"):
        run_with_pool(scenario, report_device_number, workers=3)


def test_seeding_processes_have_device_numbers(monkeypatch: pytest.MonkeyPatch):
    pool_arguments: list[tuple] = []
    monkeypatch.setattr(local_pool, "RenderProcess", lambda *args: pool_arguments.append(args))
    local_pool.LocalPool(3)
    assert [number for _, _, number in pool_arguments] == [0, 1, 2]


@pytest.mark.long
@pytest.mark.usefixtures("gl")
def test_a_service_uses_two_devices(hills_level: Path, tmp_path: Path):
    environment = {
        **os.environ,
        **duplicate_mesa_environment(tmp_path),
        "SKUGGA_EGL_DEVICE": "0,1",
        "SKUGGA_WORKERS": "2",
        "SKUGGA_PORT": "0",
    }
    command = [sys.executable, "-c", SERVE_SCRIPT, "serve", str(hills_level)]
    with subprocess.Popen(command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        device_numbers: list[str] = []
        for line in process.stderr:
            device_numbers += re.findall(r"ready after .*EGL device (\d+)", line)
            if len(device_numbers) == 2:
                break
        process.kill()
    assert device_numbers == ["0", "1"]
