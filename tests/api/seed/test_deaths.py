"""Twenty kills at random moments, of render processes and of the run itself: no work is lost, and no byte changes."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.api.seed.pmtiles_checker import check_archive
from tests.api.seed.runs import rough_ground, write_ground

pytestmark = pytest.mark.long

DEATHS, RUN_KILL_INTERVAL = 10, 3
"""Every third kill hits the run itself."""

SEED_OPTIONS = ("--zooms", "11-15", "--azimuth", "225", "--altitude", "12")


def command(folder: Path, output: str, *options: str) -> list[str]:
    """Return the command that seeds into the file ``output`` of a folder, with further options."""
    run = "from skugga.api.cli.main import main; main()"
    return [sys.executable, "-c", run, "seed", str(folder / "dem.tif"), *SEED_OPTIONS, "-o", str(folder / output), *options]


def render_processes(parent: int) -> list[int]:
    """Return the child processes of a run that draw."""
    pids = []
    for entry in Path("/proc").iterdir():
        try:
            status = (entry / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except (OSError, ValueError):
            continue
        if entry.name.isdigit() and int(status[1]) == parent:
            pids.append(int(entry.name))
    return pids


def done_tasks(folder: Path, output: str) -> int:
    """Return the number of finished tasks that ``--dry-run`` reports."""
    dry_run_output = subprocess.run(command(folder, output, "--dry-run"), capture_output=True, text=True, check=True).stdout
    match = re.search(r"Done: (\d+)", dry_run_output)
    assert match
    return int(match[1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with a raster of rough ground."""
    write_ground(tmp_path / "dem.tif", rough_ground(300))
    return tmp_path


def test_kills_do_not_change_the_archive(folder: Path):
    rng = random.Random(28)
    subprocess.run(command(folder, "whole.pmtiles", "--workers", "1", "--json"), check=True, capture_output=True)
    deaths, done_before, runs = 0, 0, 0
    while deaths < DEATHS:
        with subprocess.Popen(
            command(folder, "a.pmtiles", "--workers", "2"), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as run:
            runs += 1
            while run.poll() is None:
                time.sleep(rng.uniform(0.2, 5.0))
                deaths += 1
                victims = [run.pid] if deaths % RUN_KILL_INTERVAL == 0 else render_processes(run.pid) or [run.pid]
                try:
                    os.kill(rng.choice(victims), signal.SIGKILL)
                except ProcessLookupError:
                    deaths -= 1
            run.wait()
        done_count = done_tasks(folder, "a.pmtiles")
        assert done_count >= done_before, "finished tasks are not drawn again"
        done_before = done_count
        if run.returncode == 0:  # the run ended: repeat publishing, which must survive kills, too
            (folder / "a.pmtiles").unlink()
    assert runs > DEATHS / RUN_KILL_INTERVAL / 2
    last = subprocess.run(command(folder, "a.pmtiles", "--json", "--retry-failed"), capture_output=True, text=True, check=True)
    assert json.loads(last.stdout)["written"] in ([], [str(folder / "a.pmtiles")])  # the last death may have come after the archive
    assert (folder / "a.pmtiles").read_bytes() == (folder / "whole.pmtiles").read_bytes()
    check_archive(folder / "a.pmtiles")
    leftover_names = [path.name for path in folder.iterdir() if not path.name.startswith((".", "dem", "a.", "whole."))]
    assert leftover_names == []


def test_a_signal_ends_a_run_and_its_processes(folder: Path):
    with subprocess.Popen(command(folder, "a.pmtiles"), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True) as run:
        assert run.stderr is not None and run.stderr.readline().startswith("[1/")
        children = render_processes(run.pid)
        run.send_signal(signal.SIGTERM)
        assert run.wait(120) == 128 + signal.SIGTERM
    assert len(children) >= 1
    until = time.monotonic() + 120
    while any(Path(f"/proc/{pid}").exists() for pid in children) and time.monotonic() < until:
        time.sleep(0.1)
    assert not any(Path(f"/proc/{pid}").exists() for pid in children)
    assert done_tasks(folder, "a.pmtiles") >= 1 and not (folder / "a.pmtiles").exists()
