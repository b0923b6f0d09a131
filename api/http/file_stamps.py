"""Which files a level hangs on, and whether any of them has changed: rasters that a VRT names, and files beside a file, too."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from terrain.level.level import LoadedLevel
from terrain.level.linked_files import is_remote

ADDED_ENDINGS = (".aux.xml", ".ovr", ".msk", ".vat.dbf")
"""Endings that GDAL adds to a raster's name: statistics and georeference, overviews, masks."""

OTHER_ENDINGS = (".aux", ".tfw", ".wld", ".jgw", ".pgw", ".prj", ".hdr", ".dbf", ".shx", ".cpg", ".qpj", ".bin")
"""Endings that take the place of a file's own: world files, coordinate systems, parts of shapefiles and of glTF."""

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
    return tuple(dict.fromkeys([*found, *(beside for path in found for beside in _beside(path))]))


def file_stamps(files: Iterable[Path]) -> tuple[Stamp, ...]:
    """The stamp of each file."""
    return tuple(_stamp(path) for path in files)


def _beside(path: Path) -> list[Path]:
    stem = path.with_suffix("")
    added = [path.with_name(path.name + ending) for ending in ADDED_ENDINGS]
    return added + [stem.with_name(stem.name + ending) for ending in OTHER_ENDINGS]


def _stamp(path: Path) -> Stamp:
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ctime_ns, status.st_size, status.st_ino
