"""Mesa's cache of compiled shaders, on a disk that is full.

Mesa maps the index of its cache into memory, a file with holes. A write into a hole on a full disk ends the process (SIGBUS).
"""

from __future__ import annotations

import errno
import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from skugga.terrain.whole_files import disk_error

DISABLE = "MESA_SHADER_CACHE_DISABLE"
"""Environment variable by which Mesa keeps no shaders on disk."""

NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}

log = logging.getLogger("skugga")


@contextmanager
def safe_shader_cache() -> Iterator[None]:
    """Open OpenGL inside of this: the index has no holes then, or Mesa does without its cache where the disk has no room for it."""
    index = _index()
    if not _has_room(index):
        os.environ[DISABLE] = "true"
        log.warning("the disk of %s is full: shaders are not kept there", index.parent)
    yield
    with suppress(OSError):  # Mesa may have made the index only now
        _fill_holes(index)


def _index() -> Path:
    """The file that Mesa maps into memory. Where Mesa keeps its cache in another form there is none."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(os.environ.get("MESA_SHADER_CACHE_DIR") or home) / "mesa_shader_cache" / "index"


def _has_room(index: Path) -> bool:
    try:
        _fill_holes(index)
        return True
    except FileNotFoundError:
        folder = next(parent for parent in index.parents if parent.is_dir())
        refused: OSError | None = disk_error(folder / index.name, 2 * 2**20)
    except OSError as error:
        refused = error
    return refused is None or refused.errno not in NO_ROOM  # a folder that cannot be written is Mesa's to deal with


def _fill_holes(index: Path) -> None:
    """Give a file the blocks that it has no room for yet; what it holds stays. Raises ``OSError``."""
    with index.open("r+b") as file:
        size = os.fstat(file.fileno()).st_size
        if size:
            os.posix_fallocate(file.fileno(), 0, size)
