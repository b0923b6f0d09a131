"""Files that are written whole or not at all: beside the place where they shall lie, and moved there when they are complete.

A disk that fills up, an error or an interrupt leaves what lay there before, and nothing beside it.
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

_NAME_LENGTH = 60
"""Characters of a file's name that the folder beside it takes over: names have 255 bytes at most."""

_PROBE_BYTES = 2**20
"""Size of the file by which ``disk_error`` looks for room: more than the buffers of the libraries whose writes it explains."""


def write_whole(path: Path, content: bytes | str) -> None:
    """Write bytes, or text as UTF-8 with its line ends as they are. Raises ``OSError`` with the path."""
    with replaced_whole(path) as part, part.open("wb") as file:
        file.write(content.encode("utf-8") if isinstance(content, str) else content)


@contextmanager
def replaced_whole(path: Path) -> Iterator[Path]:
    """Where to write what shall become the file ``path``: a place of the same name in a folder beside it, for this alone.

    When the block has ended the file there is synced to the disk and takes its place, with the rights of the one that it replaces.
    A link stays, and what it leads to is replaced. What is no regular file (a pipe, ``/dev/stdout``) is written into.
    Raises ``OSError`` with the path: also where the block raises one, or has written no file.
    """
    target = path.resolve()
    # Named before it is made, so that an interrupt at any moment finds what to remove.
    beside = f"{_beside(target)}{secrets.token_hex(4)}"
    folder = target.parent / beside
    try:
        mode = _writable_mode(target)
        special = mode is not None and not stat.S_ISREG(mode)
        if special:
            folder = Path(tempfile.gettempdir()) / beside
        folder.mkdir(0o700)
        part = folder / target.name
        yield part
        _sync(part)
        if special:
            with part.open("rb") as source, target.open("wb") as sink:
                shutil.copyfileobj(source, sink)
            return
        if mode is not None:
            part.chmod(stat.S_IMODE(mode))
        os.replace(part, target)
        with suppress(OSError):  # a folder that may not be read: the file is there
            _sync(target.parent)
    except OSError as error:
        if error.filename is not None and beside not in str(error.filename) and Path(str(error.filename)) != target:
            raise  # of another file
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error) or os.strerror(number), str(path)) from error
    finally:
        _remove(folder)


@contextmanager
def replaced_together(folder: Path) -> Iterator[Path]:
    """Where to write files that shall lie in ``folder`` together: a folder for this alone, in it, or beside where it shall be.

    When the block has ended the files are synced to the disk and take their places, all of them or none. ``folder`` itself is made
    if need be. Raises ``OSError`` with the path: also where the block raises one.
    """
    target = folder.resolve()
    beside = f"{_beside(target)}{secrets.token_hex(4)}"
    is_new = not target.is_dir()
    part = (target.parent if is_new else target) / beside
    try:
        part.mkdir()
        yield part
        for path in part.iterdir():
            _sync(path)
        if is_new:
            os.replace(part, target)
        else:
            _move_all(part, target)
        with suppress(OSError):  # a folder that may not be read: the files are there
            _sync(target)
    except OSError as error:
        if error.filename is not None and beside not in str(error.filename):
            raise  # of another file
        number = error.errno or errno.EIO
        raise OSError(number, error.strerror or str(error) or os.strerror(number), str(folder)) from error
    finally:
        _remove(part)


def _move_all(part: Path, target: Path) -> None:
    """Move all files of a folder into another one on the same disk, or none of them: those of before are kept until it is done."""
    kept = part / ".before"
    moved: list[Path] = []
    names = sorted(path.name for path in part.iterdir())
    for name in names:
        if (target / name).is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(target / name))
    kept.mkdir()
    try:
        for name in names:
            with suppress(FileNotFoundError):
                os.replace(target / name, kept / name)
            moved.append(target / name)
            os.replace(part / name, target / name)
    except BaseException:
        for path in moved:
            path.unlink(missing_ok=True)
        for path in kept.iterdir():
            os.replace(path, target / path.name)
        raise


def _remove(folder: Path) -> None:
    try:
        shutil.rmtree(folder, ignore_errors=True)
    except BaseException:  # an interrupt just now
        shutil.rmtree(folder, ignore_errors=True)
        raise


def forget_halves(path: Path) -> None:
    """Delete what processes left that were killed while they wrote a file. Nobody may be writing it now."""
    target = path.resolve()
    for folder in target.parent.glob(f"{glob.escape(_beside(target))}????????"):
        shutil.rmtree(folder, ignore_errors=True)


def disk_error(path: Path, size: int = _PROBE_BYTES) -> OSError | None:
    """Return the error that writing ``size`` bytes beside ``path`` meets now, or ``None``: libraries tell that a write failed, and
    not why.
    """
    probe = path.parent / f"{_beside(path)}{secrets.token_hex(4)}"
    try:
        with probe.open("wb") as file:
            file.write(bytes(size))
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        number = error.errno or errno.EIO
        return OSError(number, error.strerror or os.strerror(number), str(path))
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return None


def write_error(path: Path, what: str, error: Exception) -> OSError:
    """Return why ``what`` could not be written to ``path``: as the disk says it, or as the library does if the disk takes files."""
    refused = disk_error(path)
    return refused or OSError(errno.EIO, f"{what} could not be written whole ({error.__cause__ or error})", str(path))


def _beside(target: Path) -> str:
    """What the names of folders begin with in which a file is written."""
    return f".{target.name[:_NAME_LENGTH]}."


def _writable_mode(target: Path) -> int | None:
    """The mode of a file that may be written; ``None`` where there is none. Raises ``OSError``."""
    try:
        mode = target.stat().st_mode
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not os.access(target, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    return mode


def _sync(path: Path) -> None:
    """Wait until a file, or a folder's names, are on the disk: some disks tell only then that they are full."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # file systems that know no sync
            raise
    finally:
        os.close(descriptor)
