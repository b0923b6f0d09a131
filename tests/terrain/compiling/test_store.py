"""Files of compiled loops: written entries are read, damaged or foreign ones are not, and the folder's size stays bounded."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from skugga.terrain.compiling import store as module
from skugga.terrain.compiling.store import ENTRY_SUFFIX, LoopStore, default_store


@pytest.fixture
def store(tmp_path: Path) -> LoopStore:
    """An empty store of compiled loops."""
    return LoopStore(tmp_path / "loops")


def test_an_entry_is_read_as_it_was_written(store: LoopStore) -> None:
    assert store.read("loop-1") is None and not store.contains("loop-1")
    store.write("loop-1", b"machine code")
    assert store.read("loop-1") == b"machine code" and store.contains("loop-1")
    assert store.problem is None
    assert store.folder.stat().st_mode & 0o777 == 0o700
    assert not list(store.folder.glob(".partial-*"))


@pytest.mark.parametrize(
    "damage", [lambda entry: entry[:-1], lambda entry: b"", lambda entry: b"\x80" + entry[1:], lambda entry: entry + b"x"]
)
def test_a_damaged_entry_is_ignored_and_reported_once(
    store: LoopStore, caplog: pytest.LogCaptureFixture, damage: Callable[[bytes], bytes]
) -> None:
    for name in ("a", "b"):
        store.write(name, b"machine code")
        path = store.folder / (name + ENTRY_SUFFIX)
        path.write_bytes(damage(path.read_bytes()))
    assert store.read("a") is None and store.read("b") is None
    assert [str(store.folder) in record.message for record in caplog.records] == [True]
    store.write("a", b"machine code")
    assert store.read("a") == b"machine code"


def test_an_entry_that_others_may_write_is_not_read(store: LoopStore, caplog: pytest.LogCaptureFixture) -> None:
    store.write("a", b"machine code")
    (store.folder / ("a" + ENTRY_SUFFIX)).chmod(0o666)
    assert store.read("a") is None
    assert "another user" in caplog.text


@pytest.mark.skipif(os.geteuid() != 0, reason="only the administrator can give files away")
def test_an_entry_of_another_user_is_not_read(store: LoopStore) -> None:
    store.write("a", b"machine code")
    os.chown(store.folder / ("a" + ENTRY_SUFFIX), 12345, 12345)
    assert store.read("a") is None


def test_a_full_disk_is_reported_once_and_leaves_no_file(
    store: LoopStore, full_disk: Callable[[int], AbstractContextManager[None]], caplog: pytest.LogCaptureFixture
) -> None:
    with full_disk(1000):
        store.write("a", bytes(2000))
        store.write("b", bytes(2000))
    assert not store.contains("a") and not list(store.folder.glob(".partial-*"))
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert store.problem is not None and str(store.folder) in store.problem and "NUMBA_CACHE_DIR" in store.problem


def test_a_folder_that_cannot_be_created_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("no folder")
    store = LoopStore(tmp_path / "file" / "loops")
    store.write("a", b"machine code")
    assert store.read("a") is None
    assert len(caplog.records) == 1 and "file" in caplog.text


def test_least_recently_used_entries_are_evicted(store: LoopStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_FOLDER_BYTES", 10_000)
    monkeypatch.setattr(module, "SCAN_EVERY_BYTES", 0)
    old_mtime_s = time.time() - 10 * module.TOUCH_AFTER_S
    for number in range(8):
        store.write(f"loop-{number}", bytes(1000))
        os.utime(store.folder / f"loop-{number}{ENTRY_SUFFIX}", (old_mtime_s + number, old_mtime_s + number))
    assert store.read("loop-0") is not None  # used just now
    abandoned = store.folder / ".partial-of-a-killed-process"
    abandoned.write_bytes(b"half")
    os.utime(abandoned, (old_mtime_s, old_mtime_s))
    for number in range(8, 11):
        store.write(f"loop-{number}", bytes(1000))
    left = {path.name.removesuffix(ENTRY_SUFFIX) for path in store.folder.glob(f"*{ENTRY_SUFFIX}")}
    assert "loop-0" in left and "loop-10" in left and "loop-1" not in left and "loop-2" not in left
    assert sum(path.stat().st_size for path in store.folder.glob(f"*{ENTRY_SUFFIX}")) <= 10_000
    assert not abandoned.exists()


def test_a_bundled_entry_is_read_and_never_written(tmp_path: Path) -> None:
    LoopStore(tmp_path / "bundled").write("a", b"from the wheel")
    store = LoopStore(tmp_path / "own", tmp_path / "bundled")
    assert store.read("a") == b"from the wheel" and store.contains("a")
    store.write("b", b"own")
    assert not (tmp_path / "bundled" / ("b" + ENTRY_SUFFIX)).exists()
    path = tmp_path / "bundled" / ("a" + ENTRY_SUFFIX)
    path.write_bytes(path.read_bytes()[:-1])
    assert store.read("a") is None


def test_the_environment_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "named"))
    assert default_store().folder == tmp_path / "named"
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert default_store().folder == tmp_path / "cache" / "skugga" / "loops"
