"""A wheel with compiled loops, installed into an empty environment with an empty home and a read-only site-packages."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import sysconfig
import time
import urllib.error
import urllib.request
import venv
from pathlib import Path

import numpy as np
import pytest

from skugga.terrain.compiling.bundle import use_bundled_loops
from tests.rasters import write_geotiff

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def wheel_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the interpreter of a read-only environment with the wheel. Its dependencies come from this environment."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "scripts/make_wheel.py", folder], cwd=ROOT, check=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    (wheel,) = folder.glob("*.whl")
    assert wheel.stat().st_size < 20 * 2**20
    assert not (ROOT / "terrain" / "compiling" / "bundled").exists()
    venv.create(folder / "env")
    python = folder / "env" / "bin" / "python"
    site = next((folder / "env" / "lib").glob("python*/site-packages"))
    # A path entry for packages: Python does not follow an editable installation of Skugga in it.
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    subprocess.run([sys.executable, "-m", "pip", "--python", python, "install", "-qq", "--no-deps", wheel], check=True)
    for path in [site, *site.rglob("*")]:
        path.chmod(path.stat().st_mode & ~0o222)
    return python


@pytest.fixture
def dem(tmp_path: Path) -> Path:
    """File of a raster of hills."""
    rows, cols = np.mgrid[:200, :200] / 30.0
    heights = (500.0 + 300.0 * np.sin(rows) * np.cos(cols)).astype(np.float32)
    return write_geotiff(tmp_path / "dem.tif", heights, "EPSG:32632", 600_000, 5_100_000, 30)


@pytest.fixture
def user_environment(tmp_path: Path) -> dict[str, str]:
    """Return the environment variables of a user with an empty home."""
    (tmp_path / "home").mkdir()
    inherited = {name: value for name, value in os.environ.items() if name in ("PATH", "LANG", "SKUGGA_EXPECT_RENDERER")}
    return {**inherited, "HOME": str(tmp_path / "home"), "SKUGGA_CALIBRATE_WHEN_IDLE": "false", "PYTHONDONTWRITEBYTECODE": "1"}


def test_the_first_mask_of_a_wheel_compiles_nothing(
    wheel_python: Path, dem: Path, user_environment: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"):
        monkeypatch.delenv(name, raising=False)
    command = ["shade", dem, "--azimuth", "237", "--altitude", "12", "-o", dem.with_name("mask.tif")]
    skugga = wheel_python.with_name("skugga")
    process = subprocess.run([skugga, *command], env=user_environment, cwd=dem.parent, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert dem.with_name("mask.tif").is_file()
    assert not list(Path(user_environment["HOME"]).rglob("*.loop"))
    assert not use_bundled_loops(), "a clone compiles for its own processor"


def test_a_wheel_has_one_name(wheel_python: Path) -> None:
    (record,) = wheel_python.parents[1].glob("lib/python*/site-packages/skugga-*.dist-info/RECORD")
    files = [line.partition(",")[0] for line in record.read_text(encoding="utf-8").splitlines()]
    names = {name.partition("/")[0] for name in files if not name.startswith("../")}
    assert names == {"skugga", record.parent.name}
    assert not any(path.is_symlink() for path in record.parents[1].joinpath("skugga").rglob("*"))


def test_a_wheel_renders(wheel_python: Path, dem: Path, user_environment: dict[str, str]) -> None:
    command = ["render", dem, "--azimuth", "237", "--altitude", "12", "--size", "64x64", "-o", dem.with_name("color.png")]
    process = subprocess.run(
        [wheel_python.with_name("skugga"), *command], env=user_environment, cwd=dem.parent, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert dem.with_name("color.png").read_bytes().startswith(b"\x89PNG")


def test_a_wheel_of_another_version_compiles(wheel_python: Path, dem: Path, user_environment: dict[str, str]) -> None:
    command = ["shade", dem, "--azimuth", "237", "--altitude", "12", "-o", dem.with_name("mask.tif")]
    changed_environment = {**user_environment, "NUMBA_OPT": "1"}  # changes the key of every loop
    process = subprocess.run(
        [wheel_python.with_name("skugga"), *command], env=changed_environment, cwd=dem.parent, capture_output=True, text=True
    )
    assert process.returncode == 0, process.stderr
    assert dem.with_name("mask.tif").is_file() and list(
        (Path(user_environment["HOME"]) / ".cache" / "skugga" / "loops").glob("*.loop")
    )


def test_the_library_does_not_set_the_processor_for_numba(wheel_python: Path, user_environment: dict[str, str]) -> None:
    code = "import os, skugga; skugga.shadow; print(sorted(set(os.environ) & {'NUMBA_CPU_NAME', 'NUMBA_CPU_FEATURES'}))"
    process = subprocess.run(
        [wheel_python, "-c", code], env=user_environment, capture_output=True, text=True, check=True, cwd=user_environment["HOME"]
    )
    assert process.stdout.strip() == "[]"


def test_the_service_of_a_wheel_draws_its_first_tile(wheel_python: Path, dem: Path, user_environment: dict[str, str]) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url, log = f"http://127.0.0.1:{port}", dem.with_name("log")
    with log.open("w") as log_file, subprocess.Popen(
        [wheel_python.with_name("skugga"), "serve", dem, "--port", str(port)], env=user_environment, cwd=dem.parent, stderr=log_file
    ) as server:  # fmt: skip
        try:
            deadline = time.monotonic() + 900.0  # processes of a busy machine start slowly
            while True:
                try:
                    with urllib.request.urlopen(f"{url}/levels/dem/tiles/WebMercatorQuad/11/1082/728.png", timeout=300) as response:
                        assert response.read().startswith(b"\x89PNG")
                    break
                except (urllib.error.URLError, ConnectionError, TimeoutError):
                    assert time.monotonic() < deadline and server.poll() is None, log.read_text()
                    time.sleep(0.1)
        finally:
            server.terminate()
    assert "compiling" not in log.read_text()
