"""Atomic writes: a file is written in a temporary folder beside its target and moved there when it is complete.

A full disk, an error or an interrupt leaves the previous file in place and no temporary file behind.
"""

from __future__ import annotations

import errno
import glob
import os
import secrets
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_MAX_TEMP_NAME_CHARS = 60
"""Characters of a file's name in its temporary folder's name. Names have at most 255 bytes."""

_WRITE_PROBE_BYTES = 2**20
"""Size of the test file with which ``disk_error`` looks for free space.

Larger than the write buffers of the libraries whose errors it explains.
"""


def write_atomically(path: Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8 with unchanged line ends, atomically. Raises ``OSError`` with the path."""
    with atomic_path(path) as part, part.open("wb") as file:
        file.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path whose file replaces ``path`` atomically when the block ends.

    The temporary file has the same name, in a folder of its own beside the target. When the block ends it is synced to the disk and
    takes the target's place and permissions. A symbolic link stays; the file that it points to is replaced. If the target is no
    regular file (a pipe, ``/dev/stdout``), the bytes are copied into it.

    Raises ``OSError`` with ``path`` as its file name if writing fails, or if the block writes no file. An ``OSError`` of the block
    about another file is raised unchanged.
    """
    target = path.resolve()
    # Named before it is created, so that an interrupt at any moment finds the folder to remove.
    temp_name = f"{_temp_prefix(target)}{secrets.token_hex(4)}"
    folder = target.parent / temp_name
    try:
        mode = _writable_mode(target)
        is_special = mode is not None and not stat.S_ISREG(mode)
        if is_special:
            folder = Path(tempfile.gettempdir()) / temp_name
        folder.mkdir(0o700)
        part = folder / target.name
        yield part
        _fsync(part)
        if is_special:
            with part.open("rb") as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink)
            return
        if mode is not None:
            part.chmod(stat.S_IMODE(mode))
        os.replace(part, target)
        with suppress(OSError):  # the folder may be unreadable; the file is in place
            _fsync(target.parent)
    except OSError as error:
        if error.filename is not None and temp_name not in str(error.filename) and Path(str(error.filename)) != target:
            raise  # an error of another file
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error) or os.strerror(number), str(path)) from error
    finally:
        _remove_folder(folder)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder whose files replace those in ``folder`` together when the block ends.

    When the block ends the files are synced to the disk and moved, either all of them or none. ``folder`` is created if it does not
    exist; the temporary folder is in it, or beside it if it is new.

    Raises ``OSError`` with ``folder`` as its file name if writing fails. An ``OSError`` of the block about another file is raised
    unchanged.
    """
    target = folder.resolve()
    temp_name = f"{_temp_prefix(target)}{secrets.token_hex(4)}"
    is_new = not target.is_dir()
    part = (target.parent if is_new else target) / temp_name
    try:
        part.mkdir()
        yield part
        for path in part.iterdir():
            _fsync(path)
        if is_new:
            os.replace(part, target)
        else:
            _move_files(part, target)
        with suppress(OSError):  # the folder may be unreadable; the files are in place
            _fsync(target)
    except OSError as error:
        if error.filename is not None and temp_name not in str(error.filename):
            raise  # an error of another file
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error) or os.strerror(number), str(folder)) from error
    finally:
        _remove_folder(part)


def _move_files(temp_folder: Path, target: Path) -> None:
    """Move all files of a folder into another one on the same disk, or none. Replaced files are backed up until all are moved."""
    backup = temp_folder / ".before"
    moved_paths: list[Path] = []
    names = sorted(path.name for path in temp_folder.iterdir())
    for name in names:
        if (target / name).is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target / name))
    backup.mkdir()
    try:
        for name in names:
            with suppress(FileNotFoundError):
                os.replace(target / name, backup / name)
            moved_paths.append(target / name)
            os.replace(temp_folder / name, target / name)
    except BaseException:
        for path in moved_paths:
            path.unlink(missing_ok=True)
        for path in backup.iterdir():
            os.replace(path, target / path.name)
        raise


def _remove_folder(folder: Path) -> None:
    """Delete a folder with all its files, even if an interrupt arrives meanwhile. Errors are ignored."""
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except BaseException:  # an interrupt while it runs
        shutil.rmtree(folder, ignore_errors=True)
        raise


def remove_partial_files(path: Path) -> None:
    """Delete the temporary folders that killed processes left while they wrote a file.

    Call it only while no process writes the file.
    """
    target = path.resolve()
    for folder in target.parent.glob(f"{glob.escape(_temp_prefix(target))}????????"):
        shutil.rmtree(folder, ignore_errors=True)


def disk_error(path: Path, probe_bytes: int = _WRITE_PROBE_BYTES) -> OSError | None:
    """Write ``probe_bytes`` bytes to a test file beside ``path`` and return the error, or ``None`` without one.

    It finds the cause of a failed write, such as a full disk. Libraries report that a write failed, but not why. The test file is
    removed.
    """
    probe = path.parent / f"{_temp_prefix(path)}{secrets.token_hex(4)}"
    try:
        with probe.open("wb") as file:
            file.write(bytes(probe_bytes))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        number = error.errno or errno.EIO
        return OSError(number, error.strerror or os.strerror(number), str(path))
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


def write_error(path: Path, content_name: str, error: Exception) -> OSError:
    """Return an ``OSError`` that explains why a write of ``content_name`` to ``path`` failed.

    It is the disk's error, if writing still fails (``disk_error``). Otherwise it quotes the library's ``error``.
    """
    disk_failure = disk_error(path)
    return disk_failure or OSError(
        errno.EIO, f"{content_name} could not be written completely ({error.__cause__ or error})", str(path)
    )


def _temp_prefix(target: Path) -> str:
    """Return the prefix of the names of a file's temporary folders."""
    return f".{target.name[:_MAX_TEMP_NAME_CHARS]}."


def _writable_mode(target: Path) -> int | None:
    """Return the mode bits (``st_mode``) of a file; ``None`` if it does not exist.

    Raises ``OSError`` for a folder, and for a file without write permission.
    """
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return mode


def _fsync(path: Path) -> None:
    """Sync a file, or a folder's entries, to the disk. Some disks report only then that they are full."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems without sync
            raise
    finally:
        os.close(descriptor)
