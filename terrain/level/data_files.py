"""What may be opened as data: regular files, that lead to nothing but more of them, and what is read through GDAL's addresses."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from skugga.terrain.errors import SourceError
from skugga.terrain.level.linked_files import is_remote, linked_files, vrt_elements

FOLDER = "a folder"

_KINDS = (
    (stat.S_ISDIR, FOLDER), (stat.S_ISFIFO, "a pipe"), (stat.S_ISCHR, "a device"), (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)  # fmt: skip

_ALLOWED = "a regular file"


def special_kind(path: Path | str) -> str | None:
    """What a path leads to that is no regular file, in words; ``None`` for a regular file, and where there is nothing.

    Reading from a device or a pipe may never end.
    """
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return None
    return next((words for is_kind, words in _KINDS if is_kind(mode)), None)


def check_file(source: str) -> None:
    """Raise ``SourceError`` for what is there and no regular file, and for what leads to such a one."""
    for each in (source, *linked_files(source)):
        if not is_remote(each) and (kind := special_kind(each)) is not None:
            raise SourceError(source, kind if each == source else f"leads to {each}, {kind}", _ALLOWED)


def check_geodata(source: str) -> None:
    """Raise ``SourceError`` for what GDAL shall not open: neither a regular file nor a folder (some formats are folders), or a
    virtual raster that leads to such a thing, takes the bytes of any file for cells, or has code in it.
    """
    for each in (source, *linked_files(source)):
        if is_remote(each):
            continue
        if each.startswith("<"):
            raise SourceError(source, "a virtual file inside of another", "virtual rasters of files")
        kind = special_kind(each)
        if kind not in (None, FOLDER):
            raise SourceError(source, kind if each == source else f"leads to {each}, {kind}", _ALLOWED)
        root = None if kind == FOLDER else vrt_elements(Path(each))
        for element in () if root is None else root.iter():
            if element.get("subClass") == "VRTRawRasterBand":
                raise SourceError(source, f"a band of raw bytes, in {Path(each).name}", "virtual rasters of rasters")
            if element.tag == "PixelFunctionLanguage" and (element.text or "").strip().lower() == "python":
                raise SourceError(source, f"a band made by a Python function, in {Path(each).name}", "virtual rasters without code")
