"""The folders that a level and all that it leads to have to lie in, where there are such.

Symbolic links are followed, and what GDAL itself opens beside a raster is looked at.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

from skugga.terrain.errors import Problem, LevelError, SourceError
from skugga.terrain.level.linked_files import files_beside, is_remote
from skugga.terrain.level.rasters import open_raster

_SCHEMES = ("http", "https", "ftp", "s3", "gs", "az", "oss", "swift")
_ARCHIVES = re.compile(r"(?:/vsi(?:zip|gzip|tar|7z|rar)/)+")
_ELSEWHERE = re.compile(r"/vsi(?:curl|s3|gs|az|adls|oss|swift|webhdfs|hdfs|mem)(?:_streaming)?[/?]")


class LevelFiles(Protocol):
    """The files of a level that was read: ``LoadedLevel`` has them."""

    @property
    def path(self) -> Path:
        """The level's file."""

    @property
    def archives(self) -> Sequence[Path]:
        """Its archives of tiles."""

    @property
    def linked_sources(self) -> Sequence[str]:
        """The files and addresses that it leads to."""


class DataRoots:
    """Folders, some of which may not be there. Raises ``LevelError`` for what does not lie in one of them, or below."""

    def __init__(self, roots: Sequence[Path]) -> None:
        self._roots = tuple(dict.fromkeys(os.path.realpath(root) for root in roots))

    def check_path(self, level: Path, file: str) -> None:
        """Look at a file or folder, which need not be there, or at an address."""
        local = _local_path(file) if is_remote(file) else file
        if local is None or local.startswith("<"):  # a virtual file inside of another is never opened
            return
        real = self._real(local)
        if not any(real == root or real.startswith(root.rstrip(os.sep) + os.sep) for root in self._roots):
            where = file if real == os.path.abspath(local) else f"{file}, which leads to {real}"
            raise LevelError(
                str(level), Problem(f"{where} is in none of the folders of levels and data"),
                f"{', '.join(self._roots)}; SKUGGA_DATA_ROOTS allows other folders",
            )  # fmt: skip
        if os.path.isdir(real):
            for folder, folders, names in os.walk(real):
                for link in filter(os.path.islink, (os.path.join(folder, name) for name in (*folders, *names))):
                    self.check_path(level, link)

    def check_level(self, loaded: LevelFiles) -> None:
        """Look at a level's file, all that it leads to, and what lies beside that."""
        for archive in loaded.archives:
            self.check_path(loaded.path, str(archive))
        for file in (str(loaded.path), *loaded.linked_sources):
            self.check_path(loaded.path, file)
            if not is_remote(file):
                for beside in filter(os.path.islink, map(str, files_beside(Path(file)))):
                    self.check_path(loaded.path, beside)

    def check_opened(self, loaded: LevelFiles) -> None:
        """Look at what GDAL says that it opens for the level's rasters: text that leads to a file has many forms."""
        known = dict.fromkeys(each for each in loaded.linked_sources if not is_remote(each))
        waiting = list(known)
        while waiting:
            for file in _opened_with(waiting.pop()):
                if not is_remote(file) and not os.path.lexists(file):
                    raise LevelError(str(loaded.path), Problem(f"leads to {file}, which is no file"), "rasters that are files")
                self.check_path(loaded.path, file)
                if file not in known:
                    known[file] = None
                    waiting.append(file)

    def _real(self, file: str) -> str:
        folder, name = os.path.split(file)
        if name in ("", ".", ".."):
            return os.path.realpath(file)
        path = os.path.join(os.path.realpath(folder or os.curdir), name)
        return os.path.realpath(path) if os.path.islink(path) else path


def _local_path(address: str) -> str | None:
    """The file of this machine that an address is of, or the address where that is not known; ``None`` if it is elsewhere."""
    inside = _ARCHIVES.sub("", address, count=1) if address.startswith("/vsi") else address
    if "file:" in address.lower():
        return address
    if inside.startswith("/vsi"):
        return None if _ELSEWHERE.match(inside) else inside
    scheme, found, _ = inside.partition("://")
    if found:
        return None if scheme.lower().rpartition("+")[2] in _SCHEMES else address
    return address if "{" in inside else inside


def _opened_with(file: str) -> Iterable[str]:
    """The files that GDAL opens for a raster, with its overviews; none for what is no raster."""
    from rasterio.errors import RasterioError

    try:
        with warnings.catch_warnings(action="ignore"), open_raster(file) as dataset:
            if dataset.count:
                dataset.overviews(1)  # else they are not among the files
            return list(dataset.files)
    except (RasterioError, SourceError):
        return ()
