"""Files that a level depends on, and the level's version. The files include the sources of a VRT and side-car files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.linked_files import is_remote, sidecar_files

MAX_WATCHED_FILES = 20_000
"""Upper bound of the number of a mosaic's source files whose changes are detected."""

Stamp = tuple[int, int, int, int] | None
"""A file's mtime and ctime (nanoseconds), size in bytes and inode number; ``None`` if it does not exist, as for bundled data. The
ctime changes even when a tool restores the mtime."""


def watched_files(loaded: LoadedLevel) -> tuple[Path, ...]:
    """Return the files that a level depends on, whether or not they exist.

    They are the level file, the files that it names, the files to which those refer, and possible side-car files of all of them.
    """
    files = dict.fromkeys(
        [loaded.path, *(Path(source) for source in loaded.linked_sources[:MAX_WATCHED_FILES] if not is_remote(source))]
    )
    return tuple(dict.fromkeys([*files, *(sidecar for path in files for sidecar in sidecar_files(path))]))


def file_stamps(files: Iterable[Path]) -> tuple[Stamp, ...]:
    """Return the stamp (times, size and inode) of each file; ``None`` for a file that does not exist."""
    return tuple(_file_stamp(path) for path in files)


def level_version(loaded: LoadedLevel, stamps: Sequence[Stamp]) -> str:
    """Return a level's version, a digest (16 hexadecimal digits) that changes with its text and its files.

    ``stamps`` are those of ``watched_files``. The digest includes them, so that a newer modification time alone changes the
    version. The stamp of the level file itself does not count, only its text.
    """
    is_raster = str(loaded.path) in loaded.sources  # a raster used as a level; the digest covers a level file's text
    text = repr((loaded.digest, tuple(stamps if is_raster else stamps[1:])))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _file_stamp(path: Path) -> Stamp:
    """Return the stamp of a file; ``None`` if it does not exist or cannot be inspected."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
