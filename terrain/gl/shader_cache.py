"""Guard of Mesa's shader cache against a full disk.

Mesa maps the index of its cache, a sparse file, into memory. A write into a hole of that file ends the process (SIGBUS) if the disk
is full.
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from skugga.terrain.atomic_files import disk_error

DISABLE_VARIABLE = "MESA_SHADER_CACHE_DISABLE"
"""Environment variable that disables Mesa's shader cache."""

DISK_FULL_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}

log = logging.getLogger("skugga")


@contextmanager
def safe_shader_cache() -> Iterator[None]:
    """Guard the creation of an OpenGL context within the block against a full disk.

    Allocates the disk blocks of Mesa's cache index before and after. If the disk is full, disables Mesa's shader cache in this
    process instead.
    """
    index = _index_path()
    if not _has_room(index):
        os.environ[DISABLE_VARIABLE] = "true"
        log.warning("%s: the disk is full. Compiled shaders are not cached.", index.parent)
    yield
    with suppress(OSError):  # Mesa may have created the index just now
        _fill_holes(index)


def _index_path() -> Path:
    """Return the path of the index file that Mesa maps into memory. Mesa's other cache formats (one file, database) have none."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(os.environ.get("MESA_SHADER_CACHE_DIR") or home) / "mesa_shader_cache" / "index"


def _has_room(index: Path) -> bool:
    """Return whether the disk has room for Mesa's cache index, and allocate the index's disk blocks."""
    try:
        _fill_holes(index)
        return True
    except FileNotFoundError:
        folder = next(parent for parent in index.parents if parent.is_dir())
        disk_failure: OSError | None = disk_error(folder / index.name, 2 * 2**20)
    except OSError as error:
        disk_failure = error
    return disk_failure is None or disk_failure.errno not in DISK_FULL_ERRNOS  # Mesa handles a folder without write permission


def _fill_holes(index: Path) -> None:
    """Allocate the missing blocks of a sparse file without changing its content. Raises ``OSError``."""
    with index.open("r+b") as file:
        size = os.fstat(file.fileno()).st_size
        if size:
            os.posix_fallocate(file.fileno(), 0, size)
