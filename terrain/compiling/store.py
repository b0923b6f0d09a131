"""Content-addressed store of compiled loops: one file for each loop and signature, named by a digest of all its inputs.

The name determines the content. The store therefore needs no index, and concurrent writers do not conflict. Files are in the user's
cache folder. A bundled read-only folder, if the installation has one, is searched first.
"""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import stat
import tempfile
import time
from contextlib import suppress
from pathlib import Path

from skugga.terrain.compiling.bundle import BUNDLED_LOOPS_FOLDER
from skugga.terrain.user_cache import user_cache_folder

FOLDER_VARIABLE = "NUMBA_CACHE_DIR"
"""Environment variable that overrides the folder in the user's cache."""

ENTRY_SUFFIX = ".loop"

MAX_FOLDER_BYTES = 256 * 2**20
"""Maximum size of the writable folder. All loops of one version take 10 MB."""

EVICTION_TARGET_SHARE = 0.75
"""Fraction of ``MAX_FOLDER_BYTES`` that an eviction leaves, so that not every write evicts."""

SCAN_EVERY_BYTES = 8 * 2**20
"""Number of bytes that a process writes between two checks of the folder's size."""

TOUCH_AFTER_S = 86_400.0
"""Age of an entry's time stamp after which a read renews it. The time stamp is the time of last use."""

MIN_ABANDONED_FILE_AGE_S = 3600.0
"""Age after which a partial file is treated as left behind by a killed process."""

_MAGIC = b"skugga-loop-1\n"
_DIGEST_BYTES = 32

log = logging.getLogger("skugga")


class LoopStore:
    """Files of compiled loops by name.

    Parameters
    ----------
    folder
        Folder for reading and writing. The first write creates it with mode 0700.
    bundled_folder
        Read-only folder that is searched first, or ``None`` if the installation has none.

    Attributes
    ----------
    problem : str or None
        Why entries cannot be stored or read, as a sentence that names the folder. ``None`` while no problem has occurred.
    """

    def __init__(self, folder: Path, bundled_folder: Path | None = None) -> None:
        self.folder, self.bundled = folder, bundled_folder
        self.problem: str | None = None
        self._unscanned_bytes = SCAN_EVERY_BYTES  # the first write checks the size

    def read(self, name: str) -> bytes | None:
        """Return the content of an entry, or ``None`` if it is missing or corrupt, or if another user may have written it."""
        if self.bundled is not None and (content := _read_verified(self.bundled / (name + ENTRY_SUFFIX))) is not None:
            return content
        path = self.folder / (name + ENTRY_SUFFIX)
        try:
            with path.open("rb") as file:
                state = os.fstat(file.fileno())
                if not _is_trusted(state):
                    self._warn(f"{path} is ignored, since another user owns it or may write it")
                    return None
                entry = file.read()
        except FileNotFoundError:
            return None
        except OSError as error:
            self._warn(f"{self.folder} cannot be read: {error.strerror}")
            return None
        content = _verified_content(entry)
        if content is None:
            self._warn(f"{path} is damaged, so its loop is compiled again")
            return None
        if time.time() - state.st_mtime > TOUCH_AFTER_S:
            with suppress(OSError):
                os.utime(path)
        return content

    def write(self, name: str, content: bytes) -> None:
        """Store an entry atomically. A folder that is not writable is logged once and raises no error."""
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            number, partial = tempfile.mkstemp(prefix=".partial-", dir=self.folder)
            try:
                with os.fdopen(number, "wb") as file:
                    file.write(_MAGIC + hashlib.sha256(content).digest() + content)
                os.replace(partial, self.folder / (name + ENTRY_SUFFIX))
            except BaseException:
                with suppress(OSError):
                    os.unlink(partial)
                raise
            self._unscanned_bytes += len(content)
            if self._unscanned_bytes >= SCAN_EVERY_BYTES:
                self._unscanned_bytes = 0
                self._evict()
        except OSError as error:
            self._warn(f"{self.folder} cannot be written ({error.strerror}), so every process compiles its loops again")

    def contains(self, name: str) -> bool:
        """Return whether an entry has a file. The file may turn out to be corrupt."""
        folders = (self.folder,) if self.bundled is None else (self.bundled, self.folder)
        return any((folder / (name + ENTRY_SUFFIX)).is_file() for folder in folders)

    def _evict(self) -> None:
        """Evict the least recently used entries beyond ``MAX_FOLDER_BYTES``, and remove partial files of killed processes."""
        with (self.folder / ".lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:  # another process is evicting, or the file system has no locks
                return
            now_s, entries = time.time(), []
            for file in os.scandir(self.folder):
                with suppress(FileNotFoundError):
                    state = file.stat(follow_symlinks=False)
                    if file.name.startswith(".partial-") and now_s - state.st_mtime > MIN_ABANDONED_FILE_AGE_S:
                        os.unlink(file.path)
                    elif file.name.endswith(ENTRY_SUFFIX):
                        entries.append((state.st_mtime, state.st_size, file.path))
            total = sum(size for _, size, _ in entries)
            if total <= MAX_FOLDER_BYTES:
                return
            for _, size, path in sorted(entries):
                with suppress(FileNotFoundError):
                    os.unlink(path)
                total -= size
                if total <= EVICTION_TARGET_SHARE * MAX_FOLDER_BYTES:
                    return

    def _warn(self, problem: str) -> None:
        """Log the first problem of the store and set ``problem``. Later problems are ignored."""
        if self.problem is None:
            self.problem = f"compiled loops: {problem}. Set {FOLDER_VARIABLE} to another folder"
            log.warning("%s", self.problem)


def default_store() -> LoopStore:
    """Return this user's store.

    Its folder is ``NUMBA_CACHE_DIR`` if that is set, otherwise the user's cache. The bundled folder is searched first.
    """
    named = os.environ.get(FOLDER_VARIABLE)
    return LoopStore(
        Path(named) if named else user_cache_folder("loops"), BUNDLED_LOOPS_FOLDER if BUNDLED_LOOPS_FOLDER.is_dir() else None
    )


def _is_trusted(state: os.stat_result) -> bool:
    """Return whether only this user or root can have written a file. Its content is executed, so others are not trusted."""
    return state.st_uid in (os.geteuid(), 0) and not state.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _read_verified(path: Path) -> bytes | None:
    """Return the content of an entry's file; ``None`` if it is corrupt or cannot be read."""
    try:
        return _verified_content(path.read_bytes())
    except OSError:
        return None


def _verified_content(entry: bytes) -> bytes | None:
    """Return the content of an entry after checking its checksum, or ``None`` if the entry is corrupt."""
    start = len(_MAGIC) + _DIGEST_BYTES
    if not entry.startswith(_MAGIC) or hashlib.sha256(entry[start:]).digest() != entry[len(_MAGIC) : start]:
        return None
    return entry[start:]
