"""Mesa's shader cache on a full disk."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from skugga.terrain.gl.shader_cache import DISABLE_VARIABLE, safe_shader_cache

MESA_INDEX_BYTES = 1_310_728


@pytest.fixture
def index_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a sparse index file, as Mesa creates it."""
    monkeypatch.setenv(DISABLE_VARIABLE, "false")
    monkeypatch.setenv("MESA_SHADER_CACHE_DIR", str(tmp_path))
    path = tmp_path / "mesa_shader_cache" / "index"
    path.parent.mkdir()
    with path.open("wb") as file:
        file.truncate(MESA_INDEX_BYTES)
    return path


def test_an_existing_index_is_allocated_in_full(index_file: Path):
    assert index_file.stat().st_blocks * 512 < MESA_INDEX_BYTES
    with index_file.open("r+b") as file:
        file.write(b"kept")
    with safe_shader_cache():
        assert index_file.stat().st_blocks * 512 >= MESA_INDEX_BYTES == index_file.stat().st_size
    assert index_file.read_bytes()[:5] == b"kept\0" and os.environ[DISABLE_VARIABLE] == "false"


def test_an_index_made_while_opening_is_allocated_in_full(index_file: Path):
    index_file.unlink()
    with safe_shader_cache(), index_file.open("wb") as file:
        file.truncate(MESA_INDEX_BYTES)
    assert index_file.stat().st_blocks * 512 >= MESA_INDEX_BYTES


def test_a_disk_without_room_for_an_index_disables_the_cache(index_file: Path, full_disk):
    index_file.unlink()
    with full_disk(1000), safe_shader_cache():
        assert os.environ[DISABLE_VARIABLE] == "true"
    assert list(index_file.parent.iterdir()) == []


def test_a_disk_without_room_to_allocate_disables_the_cache(index_file: Path, monkeypatch: pytest.MonkeyPatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with safe_shader_cache():
        assert os.environ[DISABLE_VARIABLE] == "true"


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Mount a disk of 2 MiB without free space."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "skugga-test", disk], capture_output=True, text=True)
    if mounted.returncode:
        pytest.skip(f"no file system can be mounted here: {mounted.stderr.strip()}")
    try:
        with pytest.raises(OSError, match="No space"), (disk / "all").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        yield disk
    finally:
        subprocess.run(["umount", disk], check=True)


MANY_PROGRAMS_SCRIPT = """
import moderngl
from skugga.terrain.gl.device import device
context = device().ctx
for number in range(40):
    main = f"#version 330\\nvoid main() {{ gl_Position = vec4({number}.0); }}"
    array = context.vertex_array(context.program(vertex_shader=main, fragment_shader="#version 330\\nvoid main() {}"), [])
    context.simple_framebuffer((4, 4)).use()
    array.render(vertices=3)
context.finish()
"""


def test_a_process_draws_while_the_cache_s_disk_is_full(gl, small_disk: Path):
    """Mesa's own sparse index ended the process: 40 shaders write to 40 places in the index."""
    (small_disk / "all").write_bytes(bytes(2**21 - 2**16))  # enough for folders, and for a sparse file
    environment = {**os.environ, "MESA_SHADER_CACHE_DIR": str(small_disk)}
    process = subprocess.run([sys.executable, "-c", MANY_PROGRAMS_SCRIPT], env=environment, capture_output=True, text=True)
    assert process.returncode == 0, (process.returncode, process.stderr)
