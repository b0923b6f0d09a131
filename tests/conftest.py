"""Shared fixtures: rasters and levels made from parameters, and the OpenGL device with an error check around each test."""

from __future__ import annotations

import json
import logging
import os
import resource
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from skugga.terrain.compiling.ahead_of_time import PRODUCTS, compile_ahead
from skugga.terrain.compiling.loop_cache import loop_store
from skugga.terrain.cores import usable_cores
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.bare_names import refuse_bare_names
from tests.rasters import write_geotiff

pytest_plugins = ["tests.hard_cases.table"]

refuse_bare_names()

# No deadline: the first example of a property may compile a loop. Examples are the same each time; `make hunt` draws others.
settings.register_profile("skugga", deadline=None, derandomize=True)
settings.load_profile("skugga")

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def pytest_configure(config: pytest.Config) -> None:
    """Compile all loops in parallel before a run in several processes, which would otherwise compile the same loops."""
    if getattr(config.option, "numprocesses", None) and not hasattr(config, "workerinput"):
        compile_ahead(PRODUCTS, usable_cores())


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that writes golden pictures."""
    parser.addoption("--regenerate-goldens", action="store_true", help="write golden pictures anew; look at each")


@pytest.fixture
def gl():
    """Return the process's OpenGL device. A test that leaves an OpenGL error behind fails."""
    from skugga.terrain.gl.device import device

    owner = device()
    owner.check("before the test")
    yield owner
    owner.check("after the test")


@pytest.fixture(autouse=True)
def _check_gl_errors() -> Iterator[None]:
    """Fail a test that leaves an OpenGL error behind."""
    yield
    from skugga.terrain.gl import device as module

    if module._device is not None:
        module._device.check("a test")


@pytest.fixture(scope="session", autouse=True)
def _isolated_cache(tmp_path_factory: pytest.TempPathFactory, pytestconfig: pytest.Config) -> Iterator[None]:
    """Keep the machine's caches, its calibration among them, from tests and from services that many tests share.

    Services must not calibrate the device either. Compiled code stays from run to run: Mesa's shaders in pytest's cache,
    loops in the user's store.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKUGGA_CALIBRATE_WHEN_IDLE", "false")
        patch.setenv("SKUGGA_PROBE_WHEN_IDLE", "false")
        patch.setenv("NUMBA_CACHE_DIR", str(loop_store().folder))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
        patch.setenv("MESA_SHADER_CACHE_DIR", str(pytestconfig.cache.mkdir("shaders")))
        yield


@pytest.fixture(scope="session", autouse=True)
def _forked_render_processes(_isolated_cache: None, pytestconfig: pytest.Config) -> Iterator[None]:
    """Fork render processes of services in the tests' own process from one that has imported their modules and has no
    OpenGL.

    The imports take seconds. Services in separate processes, as in ``tests/api/http/test_serve.py``, spawn them as for
    users.
    """
    with pytest.MonkeyPatch.context() as patch:
        forkserver = get_context("forkserver")
        forkserver.set_forkserver_preload(
            ["tests.api.workers.fake_workers", "skugga.api.workers.warm_up", "skugga.api.workers.render_worker"]
        )
        if module := sys.modules.get("skugga.api.workers.piped_process"):
            patch.setattr(module, "get_context", lambda method: forkserver)
        yield


@pytest.fixture(autouse=True)
def _clean_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Remove settings of the machine from the environment."""
    for name in os.environ:
        if name.startswith("SKUGGA_") and name not in (
            "SKUGGA_EXPECT_RENDERER",
            "SKUGGA_CALIBRATE_WHEN_IDLE",
            "SKUGGA_PROBE_WHEN_IDLE",
        ):
            monkeypatch.delenv(name)


@pytest.fixture(autouse=True)
def _propagate_log(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the log propagate again: a service of another test may have stopped that."""
    monkeypatch.setattr(logging.getLogger("skugga"), "propagate", True)


@pytest.fixture
def write_raster(tmp_path: Path) -> Callable[..., Path]:
    """Return ``write_raster(heights, crs, x0, y0, cell)``, which writes a GeoTIFF whose north-west corner is (x0, y0)."""

    def write(
        heights: np.ndarray,
        crs: str,
        x0: float,
        y0: float,
        cell: float | tuple[float, float],
        name: str = "dem.tif",
        **options,
    ) -> Path:
        return write_geotiff(tmp_path / name, heights, crs, x0, y0, cell, **options)

    return write


@pytest.fixture
def make_scene(tmp_path: Path) -> Callable[..., Scene]:
    """Return ``make_scene(raster, azimuth, altitude)``, which builds the scene of a level over a raster."""

    def make(source: Path | str, azimuth: float = 180.0, altitude: float = 30.0, **keys) -> Scene:
        terrain = {"source": str(source), **keys.pop("terrain", {})}
        level = {"version": 1, "terrain": terrain, "sun": {"azimuth": azimuth, "altitude": altitude}, **keys}
        path = tmp_path / "level.yaml"
        # JSON is YAML.
        path.write_text(json.dumps(level), encoding="utf-8")
        return build_scene(load_level(path))

    return make


@pytest.fixture
def shared_data() -> Path:
    """Return the folder of real rasters beside the repository, or skip the test without it."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"no sample rasters at {SHARED_DATA}")
    return SHARED_DATA


@pytest.fixture
def full_disk() -> Callable[[int], AbstractContextManager[None]]:
    """Return a context manager ``full_disk(max_bytes)`` in which no file can exceed ``max_bytes`` bytes, as on a full disk."""

    @contextmanager
    def limit_file_sizes(max_bytes: int) -> Iterator[None]:
        signal_action, (soft_limit, hard_limit) = signal.getsignal(signal.SIGXFSZ), resource.getrlimit(resource.RLIMIT_FSIZE)
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then a write fails with an error instead of ending the process
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, hard_limit))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft_limit, hard_limit))
            signal.signal(signal.SIGXFSZ, signal_action)

    return limit_file_sizes
