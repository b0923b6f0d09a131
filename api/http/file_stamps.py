"""Which files a level hangs on, and whether any of them has changed: rasters that a VRT names, and files beside a file, too."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path

import rasterio
from rasterio.errors import RasterioError

from terrain.level.level import LoadedLevel

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
    """The files that a level hangs on, whether or not they are there: its own, the ones that it names, what those name if GDAL
    knows, and what would lie beside them. Opens rasters.
    """
    files = dict.fromkeys([loaded.path])
    for source in loaded.sources:
        files |= dict.fromkeys(_with_parts(Path(source)))
    found = list(files)
    return tuple(dict.fromkeys([*found, *(beside for path in found[:MAX_FILES] for beside in _beside(path))]))


def file_stamps(files: Iterable[Path]) -> tuple[Stamp, ...]:
    """The stamp of each file."""
    return tuple(_stamp(path) for path in files)


def _with_parts(source: Path) -> list[Path]:
    """A source, and the files that its dataset consists of; of a VRT those of its rasters, which may be VRTs themselves."""
    found, left = {source: None}, [source]
    while left and len(found) < MAX_FILES:
        for path in _parts(left.pop()):
            if path not in found:
                found[path] = None
                if path.suffix.lower() == ".vrt":
                    left.append(path)
    return list(found)


def _parts(path: Path) -> list[Path]:
    if not path.is_file():  # neither what is remote or bundled, nor a pipe, which would be read for ever
        return []
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with rasterio.open(path) as dataset:
                return [Path(name) for name in dataset.files if not name.startswith("/vsi")]
    except RasterioError:  # vectors and models
        return []


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
