"""Which files a level hangs on, and whether any of them has changed: rasters that a VRT names, and files beside a file, too."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from pathlib import Path

from skugga.terrain.level.level import LoadedLevel
from skugga.terrain.level.linked_files import is_remote, sidecar_files

MAX_FILES = 20_000
"""Of a mosaic: those beyond are not watched."""

Stamp = tuple[int, int, int, int] | None
"""Time of the last change of the contents and of the file itself (nanoseconds), size in bytes, and number of a file; ``None``
where there is none, as for bundled data. The second of the times changes even where a tool sets the first one back."""


def watched_files(loaded: LoadedLevel) -> tuple[Path, ...]:
    """The files that a level hangs on, whether or not they are there: its own, the ones that it names, what those lead to, and what
    would lie beside them.
    """
    found = dict.fromkeys([loaded.path, *(Path(source) for source in loaded.linked_sources[:MAX_FILES] if not is_remote(source))])
    return tuple(dict.fromkeys([*found, *(beside for path in found for beside in sidecar_files(path))]))


def file_stamps(files: Iterable[Path]) -> tuple[Stamp, ...]:
    """The stamp of each file."""
    return tuple(_stamp(path) for path in files)


def level_version(loaded: LoadedLevel, stamps: Sequence[Stamp]) -> str:
    """The version of a level whose watched files have these stamps: it changes with its text and with the files that it names."""
    is_raster = str(loaded.path) in loaded.sources  # a raster that is a level by itself; a level file's text is in the digest
    text = repr((loaded.digest, tuple(stamps if is_raster else stamps[1:])))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _stamp(path: Path) -> Stamp:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
