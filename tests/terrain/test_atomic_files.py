"""Atomic writes: a file or set of files is replaced completely, or not at all after an error."""

from __future__ import annotations

import os
import re
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from skugga.terrain.atomic_files import atomic_folder, atomic_path, remove_partial_files, write_atomically


def file_names(folder):
    """Return the sorted names of a folder's files."""
    return sorted(path.name for path in folder.iterdir())


def test_text_and_bytes_are_written_unchanged(tmp_path):
    write_atomically(tmp_path / "a.txt", "Höhe\r\n")
    write_atomically(tmp_path / "b.bin", bytes(range(256)))
    assert (tmp_path / "a.txt").read_bytes() == "Höhe\r\n".encode()
    assert (tmp_path / "b.bin").read_bytes() == bytes(range(256))
    assert file_names(tmp_path) == ["a.txt", "b.bin"]


def test_full_disk_keeps_the_old_file(tmp_path, full_disk):
    path = tmp_path / "a.bin"
    write_atomically(path, b"old")
    with full_disk(1000), pytest.raises(OSError, match="large") as caught:
        write_atomically(path, bytes(5000))
    assert caught.value.filename == str(path)
    assert path.read_bytes() == b"old" and file_names(tmp_path) == ["a.bin"]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_interrupted_write_keeps_the_old_file(tmp_path, error):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(error), atomic_path(path) as part:
        part.write_bytes(b"half of the new")
        raise error
    assert path.read_bytes() == b"old" and file_names(tmp_path) == ["a.bin"]


def test_writing_nothing_is_an_error(tmp_path):
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.bin"):
        pass
    assert file_names(tmp_path) == []


def test_file_is_synced_before_it_is_moved(tmp_path, monkeypatch):
    order = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr("skugga.terrain.atomic_files.os.fsync", lambda number: (order.append("sync"), fsync(number)))
    monkeypatch.setattr("skugga.terrain.atomic_files.os.replace", lambda a, b: (order.append("replace"), replace(a, b)))
    write_atomically(tmp_path / "a.bin", b"new")
    assert order == ["sync", "replace", "sync"]


def test_permissions_and_symbolic_links_are_kept(tmp_path):
    (tmp_path / "other").mkdir()
    target = tmp_path / "other" / "a.bin"
    target.write_bytes(b"old")
    target.chmod(0o640)
    (tmp_path / "link.bin").symlink_to(target)
    write_atomically(tmp_path / "link.bin", b"new")
    assert target.read_bytes() == b"new" and stat.S_IMODE(target.stat().st_mode) == 0o640
    assert (tmp_path / "link.bin").is_symlink()


def test_new_file_has_default_permissions(tmp_path):
    (tmp_path / "usual").write_bytes(b"")
    write_atomically(tmp_path / "a.bin", b"new")
    assert (tmp_path / "a.bin").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_error_names_the_target_path(tmp_path):
    with pytest.raises(IsADirectoryError) as caught:
        write_atomically(tmp_path, b"new")
    assert caught.value.filename == str(tmp_path)
    with pytest.raises(FileNotFoundError) as missing:
        write_atomically(tmp_path / "nowhere" / "a.bin", b"new")
    assert missing.value.filename == str(tmp_path / "nowhere" / "a.bin")


def test_named_pipe_is_written_directly(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    received = []
    reader = threading.Thread(target=lambda: received.append(pipe.read_bytes()))
    reader.start()
    write_atomically(pipe, b"new")
    reader.join(30)
    assert received == [b"new"] and file_names(tmp_path) == ["pipe"]


def test_long_file_name_is_written(tmp_path):
    write_atomically(tmp_path / ("x" * 251 + ".bin"), b"new")
    assert file_names(tmp_path) == ["x" * 251 + ".bin"]


def test_error_of_another_file_keeps_its_name(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, atomic_path(tmp_path / "a.bin"):
        (tmp_path / "missing.txt").read_bytes()
    assert caught.value.filename == str(tmp_path / "missing.txt")


def file_contents(folder: Path) -> dict[str, bytes]:
    """Return the contents of a folder's files, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def write_three(folder: Path, content: bytes) -> None:
    """Write a folder of three files with the same content at once."""
    with atomic_folder(folder) as part:
        for name in "abc":
            (part / name).write_bytes(content)


def test_atomic_folder_writes_files_together(tmp_path):
    folder = tmp_path / "new"
    write_three(folder, b"first")
    (folder / "d").write_bytes(b"mine")
    (folder / "b").unlink()
    write_three(folder, b"second")
    assert file_contents(folder) == {**dict.fromkeys("abc", b"second"), "d": b"mine"} and file_names(tmp_path) == ["new"]
    (tmp_path / "usual").mkdir()
    assert stat.S_IMODE(folder.stat().st_mode) == stat.S_IMODE((tmp_path / "usual").stat().st_mode)


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
@pytest.mark.parametrize("folder_exists", [True, False])
def test_interrupted_folder_write_keeps_the_old_files(tmp_path, error, folder_exists):
    folder = tmp_path / "frames"
    if folder_exists:
        write_three(folder, b"old")
    with pytest.raises(error), atomic_folder(folder) as part:
        (part / "a").write_bytes(b"new")
        raise error
    assert file_names(tmp_path) == (["frames"] if folder_exists else [])
    assert not folder_exists or file_contents(folder) == dict.fromkeys("abc", b"old")


@pytest.mark.parametrize("move_number", range(7))
def test_interrupted_move_is_rolled_back(tmp_path, move_number, monkeypatch):
    """The interrupt comes at each of the moves: of a, of b, which is new, and of c."""
    folder, calls, replace = tmp_path / "frames", [], os.replace
    write_three(folder, b"old")
    (folder / "b").unlink()

    def interrupted(source, target):
        calls.append(source)
        if len(calls) == move_number + 1:
            raise KeyboardInterrupt
        replace(source, target)

    monkeypatch.setattr("skugga.terrain.atomic_files.os.replace", interrupted)
    if move_number < 6:
        with pytest.raises(KeyboardInterrupt):
            write_three(folder, b"new")
        assert file_contents(folder) == dict.fromkeys("ac", b"old")
    else:
        write_three(folder, b"new")
        assert file_contents(folder) == dict.fromkeys("abc", b"new")


def test_folder_in_place_of_a_file_is_an_error(tmp_path):
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "mine").write_bytes(b"mine")
    with pytest.raises(IsADirectoryError) as caught:
        write_three(tmp_path, b"new")
    assert caught.value.filename == str(tmp_path / "b") and file_names(tmp_path) == ["b"] and file_names(tmp_path / "b") == ["mine"]


def test_full_disk_keeps_the_old_files_of_a_folder(tmp_path, full_disk):
    write_three(tmp_path, b"old")
    with full_disk(1000), pytest.raises(OSError, match="large") as caught:
        write_three(tmp_path, bytes(5000))
    assert caught.value.filename == str(tmp_path) and file_contents(tmp_path) == dict.fromkeys("abc", b"old")


def test_atomic_files_imports_only_the_standard_library():
    code = "import sys, skugga.terrain.atomic_files; print('numpy' in sys.modules or 'rasterio' in sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert process.stdout.strip() == "False"


ALLOWED_WRITERS = {
    "api/point/horizons.py": "an archive in memory",
    "api/polygon_irradiation.py": "a temporary file that atomic_files moves into place",
    "shadows/irradiation/irradiation.py": "months, into the store that it is given",
    "api/month_folder.py": "a temporary file that atomic_files moves into place",
    "api/library/accessor.py": "a raster of its own that it reads from",
    "api/library/opened_level.py": "a raster of its own that its service reads",
    "api/raster_file.py": "a temporary file that atomic_files moves into place",
    "api/encoding.py": "into memory",
    "api/film_files.py": "temporary files that atomic_files moves into place",
    "api/animated_webp.py": "temporary files that atomic_files moves into place",
    "api/contour_lines.py": "a temporary file that atomic_files moves into place",
    "api/point/charts.py": "into memory",
    "api/color_scale.py": "into memory",
    "api/overviews.py": "a temporary file that atomic_files moves into place",
    "api/cli/seeding.py": "a log, line by line",
    "api/seed/archive.py": "a temporary file that atomic_files moves into place",
    "api/seed/ground_chunks.py": "into memory",
    "api/seed/publishing.py": "tiles of a folder, before the manifest that marks it complete",
    "api/seed/storage.py": "shards: renamed into place without fsync, because their digests are known",
    "api/seed/task_table.py": "its lock",
    "api/report/page/pictures.py": "into memory",
    "api/report/comparison.py": "a temporary file that atomic_files moves into place",
    "api/workers/process_life.py": "the OOM score of this process, in /proc",
    "selector/cost/calibration_scenes.py": "levels of its own in a temporary folder",
    "shadows/truth/cache.py": "a temporary file that atomic_files moves into place",
    "terrain/compiling/farm.py": "its lock",
    "terrain/compiling/store.py": "entries that are verified when they are read, so that nothing waits for the disk; its lock",
    "terrain/atomic_files.py": "the place where files are written",
    "terrain/trees/cached_pictures.py": "a temporary file that atomic_files moves into place",
}
"""Modules that may write without ``atomic_files``, and what they write."""

WRITE_CALL = re.compile(
    r"""\.write_(?:text|bytes)\(|\bopen\([^)]*["'][wax]b?\+?["']|\.(?:save|savefig|savez\w*|tofile)\(|np\.save\(|"""
    r"""os\.replace\(|shutil\.copyfileobj|raw\.write\("""
)


def modules_that_write():
    """Yield the paths of the modules that write files directly."""
    root = Path(__file__).parents[2]
    for package in ("terrain", "shadows", "selector", "api"):
        for path in (root / package).rglob("*.py"):
            if WRITE_CALL.search(path.read_text(encoding="utf-8")):
                yield str(path.relative_to(root))


def test_only_atomic_files_writes_files():
    modules = set(modules_that_write())
    assert modules == set(ALLOWED_WRITERS), "skugga.terrain.atomic_files writes files"


def test_partial_files_of_a_killed_writer_are_deleted(tmp_path: Path):
    path, other = tmp_path / "a[1].bin", tmp_path / "a1.bin"
    for target in (path, other):
        with atomic_path(target) as part:
            part.write_bytes(b"whole")
        left = f".{target.name}.0123abcd"
        (tmp_path / left).mkdir()
        (tmp_path / left / target.name).write_bytes(b"half")
    remove_partial_files(path)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [".a1.bin.0123abcd", "a1.bin", "a[1].bin"]
