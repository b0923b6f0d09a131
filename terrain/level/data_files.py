"""Check data files before they are opened.

Regular files are allowed if they refer to regular files only. The remote addresses and virtual file systems of GDAL are allowed,
too.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from skugga.terrain.errors import SourceError
from skugga.terrain.level.linked_files import is_remote, linked_files, vrt_elements

FOLDER_KIND = "a folder"

_SPECIAL_FILE_KINDS = (
    (stat.S_ISDIR, FOLDER_KIND), (stat.S_ISFIFO, "a pipe"), (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)  # fmt: skip

_REMEDY = "Use a regular file"


def special_file_kind(path: Path | str) -> str | None:
    """Return the kind of a path that is not a regular file, in words, such as "a pipe".

    Returns ``None`` for a regular file and for a path that does not exist. Callers reject the other kinds, since reading from a
    device or a pipe may never end.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None
    return next((words for is_kind, words in _SPECIAL_FILE_KINDS if is_kind(mode)), None)


def check_file(source: str) -> None:
    """Raise ``SourceError`` if a file, or a file that it refers to, exists but is not a regular file."""
    for file in (source, *linked_files(source)):
        if not is_remote(file) and (kind := special_file_kind(file)) is not None:
            raise SourceError(source, f"{kind}, not a regular file" if file == source else f"refers to {file}, {kind}", _REMEDY)


def check_geodata(source: str) -> None:
    """Raise ``SourceError`` for a source that GDAL must not open.

    A source and the files that it refers to must be regular files or folders, since some formats are folders. A virtual raster
    (VRT) must not read the raw bytes of a file as cells, contain another VRT as text, or contain Python code.
    """
    for file in (source, *linked_files(source)):
        if is_remote(file):
            continue
        if file.startswith("<"):
            raise SourceError(source, "it contains another virtual file as text", "Use a virtual file that names its parts")
        kind = special_file_kind(file)
        if kind not in (None, FOLDER_KIND):
            raise SourceError(source, f"{kind}, not a regular file" if file == source else f"refers to {file}, {kind}", _REMEDY)
        root = None if kind == FOLDER_KIND else vrt_elements(Path(file))
        for element in () if root is None else root.iter():
            if element.get("subClass") == "VRTRawRasterBand":
                raise SourceError(
                    source, f"{Path(file).name} has a band that reads raw bytes", "Use a virtual raster whose parts are rasters"
                )
            if element.tag == "PixelFunctionLanguage" and (element.text or "").strip().lower() == "python":
                raise SourceError(source, f"{Path(file).name} has a band with Python code", "Use a virtual raster without code")
