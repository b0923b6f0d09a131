"""GDAL cache limits: set in the environment of the parent process for its workers, unless the user has set them."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import pytest

from skugga.terrain.level.gdal_guard import CACHE_LIMIT_SETTINGS

WORKER_SCRIPT = """
import json, multiprocessing, os, sys

def print_limits():
    import rasterio
    from rasterio._env import get_gdal_config
    names = json.loads(sys.argv[1])
    print(json.dumps([os.environ.get(name) for name in names] + [get_gdal_config(name) for name in names]))

if __name__ == "__main__":
    PARENT
    process = multiprocessing.get_context("spawn").Process(target=print_limits)
    process.start()
    process.join()
"""

PARENT_IMPORTS = {
    "the service's pool": "import skugga.api.workers.pool",
    "a library's user": "import skugga",
    "whoever opens rasters": "import skugga.terrain.ground.elevation",
}


def limits_in_a_worker(folder, parent: str, **overrides: str) -> list[list[str]]:
    """Return the limits in the environment of a child process, and the values that GDAL uses there."""
    script = folder / "parent.py"
    script.write_text(WORKER_SCRIPT.replace("PARENT", parent), encoding="utf-8")
    environment = {name: value for name, value in os.environ.items() if name not in CACHE_LIMIT_SETTINGS} | overrides
    process = subprocess.run(
        [sys.executable, str(script), json.dumps([*CACHE_LIMIT_SETTINGS])],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.returncode == 0, process.stderr
    limits = json.loads(process.stdout)
    return [
        [str(value) for value in limits[: len(CACHE_LIMIT_SETTINGS)]],
        [str(value) for value in limits[len(CACHE_LIMIT_SETTINGS) :]],
    ]


@pytest.mark.parametrize("parent", PARENT_IMPORTS.values(), ids=PARENT_IMPORTS)
def test_workers_inherit_the_limits_of_their_parent(tmp_path, parent):
    environment, gdal = limits_in_a_worker(tmp_path, parent)
    assert environment == list(CACHE_LIMIT_SETTINGS.values())
    assert gdal == [str(128 * 2**20), *list(CACHE_LIMIT_SETTINGS.values())[1:]]


def test_limits_of_the_user_take_precedence(tmp_path):
    environment, gdal = limits_in_a_worker(tmp_path, PARENT_IMPORTS["the service's pool"], GDAL_CACHEMAX="64")
    assert environment == ["64", *list(CACHE_LIMIT_SETTINGS.values())[1:]] and gdal[0] == str(64 * 2**20)


def test_command_line_sets_the_limits(tmp_path):
    script = "import os, sys; sys.argv = ['skugga', '--version']; from skugga.api.cli.main import main\n"
    script += "try: main()\nexcept SystemExit: pass\n"
    script += "print([os.environ[name] for name in sys.stdin.read().split()])"
    environment = {name: value for name, value in os.environ.items() if name not in CACHE_LIMIT_SETTINGS}
    process = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        input=" ".join(CACHE_LIMIT_SETTINGS),
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert process.stdout.splitlines()[-1] == str(list(CACHE_LIMIT_SETTINGS.values())), process.stderr
