"""Check that a level, and all files that it refers to directly or indirectly, lie in allowed folders.

Symbolic links are resolved first. The files that GDAL opens along with a raster, such as overviews, are checked too.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Protocol

from skugga.terrain.errors import LevelError, Problem, SourceError
from skugga.terrain.level.linked_files import is_remote, sidecar_files
from skugga.terrain.level.rasters import open_raster

_REMOTE_SCHEMES = ("http", "https", "ftp", "s3", "gs", "az", "oss", "swift")
_ARCHIVE_VSI = re.compile(r"(?:/vsi(?:zip|gzip|tar|7z|rar)/)+")
_REMOTE_VSI = re.compile(r"/vsi(?:curl|s3|gs|az|adls|oss|swift|webhdfs|hdfs|mem)(?:_streaming)?[/?]")


class LevelFiles(Protocol):
    """The files of a level. ``skugga.terrain.level.level.LoadedLevel`` implements this protocol."""

    @property
    def path(self) -> Path:
        """Path of the level file."""

    @property
    def archives(self) -> Sequence[Path]:
        """Paths of its tile archives."""

    @property
    def linked_sources(self) -> Sequence[str]:
        """Files and addresses that the level refers to, directly or indirectly."""


class DataRoots:
    """Allowed folders of levels and data, which need not exist. The checks raise ``LevelError`` for a file outside all of them."""

    def __init__(self, roots: Sequence[Path]) -> None:
        self._roots = tuple(dict.fromkeys(os.path.realpath(root) for root in roots))

    def check_path(self, level: Path, file: str) -> None:
        """Check that a file, folder or address lies in an allowed folder. It need not exist; remote addresses pass.

        All symbolic links within a folder are checked, too. ``level`` is the level file, for the message.
        """
        local = _local_path(file) if is_remote(file) else file
        if local is None or local.startswith("<"):  # a VRT as text is never opened
            return
        real = self._resolve_links(local)
        if not any(real == root or real.startswith(root.rstrip(os.sep) + os.sep) for root in self._roots):
            file_text = file if real == os.path.abspath(local) else f"{file}, which resolves to {real},"
            raise LevelError(
                str(level), Problem(f"{file_text} lies outside the folders of levels and data"),
                f"Move it into one of {', '.join(self._roots)}, or add its folder to SKUGGA_DATA_ROOTS",
            )  # fmt: skip
        if os.path.isdir(real):
            for folder, folders, names in os.walk(real):
                for link in filter(os.path.islink, (os.path.join(folder, name) for name in (*folders, *names))):
                    self.check_path(level, link)

    def check_level(self, loaded: LevelFiles) -> None:
        """Check a level file, its archives, all files that it refers to, and the links among their sidecar files."""
        for archive in loaded.archives:
            self.check_path(loaded.path, str(archive))
        for file in (str(loaded.path), *loaded.linked_sources):
            self.check_path(loaded.path, file)
            if not is_remote(file):
                for sidecar in filter(os.path.islink, map(str, sidecar_files(Path(file)))):
                    self.check_path(loaded.path, sidecar)

    def check_opened_files(self, loaded: LevelFiles) -> None:
        """Check all files that GDAL opens for the level's rasters, according to GDAL itself.

        This finds references between files in formats that ``linked_files`` does not parse.
        """
        checked = dict.fromkeys(source for source in loaded.linked_sources if not is_remote(source))
        queue = list(checked)
        while queue:
            for file in _files_opened_by_gdal(queue.pop()):
                if not is_remote(file) and not os.path.lexists(file):
                    raise LevelError(
                        str(loaded.path), Problem(f"refers to {file}, which does not exist"), "Use rasters whose parts are files"
                    )
                self.check_path(loaded.path, file)
                if file not in checked:
                    checked[file] = None
                    queue.append(file)

    def _resolve_links(self, file: str) -> str:
        """Return a file's absolute path without symbolic links. A final link is resolved, too."""
        folder, name = os.path.split(file)
        if name in ("", ".", ".."):
            return os.path.realpath(file)
        path = os.path.join(os.path.realpath(folder or os.curdir), name)
        return os.path.realpath(path) if os.path.islink(path) else path


def _local_path(address: str) -> str | None:
    """Return the path of the local file that GDAL opens for an address, such as a file in ``/vsizip/``.

    Returns the address itself if the path cannot be derived from it, and ``None`` for a remote address.
    """
    path = _ARCHIVE_VSI.sub("", address, count=1) if address.startswith("/vsi") else address
    if "file:" in address.lower():
        return address
    if path.startswith("/vsi"):
        return None if _REMOTE_VSI.match(path) else path
    scheme, separator, _ = path.partition("://")
    if separator:
        return None if scheme.lower().rpartition("+")[2] in _REMOTE_SCHEMES else address
    return address if "{" in path else path


def _files_opened_by_gdal(file: str) -> Iterable[str]:
    """Return the files that GDAL opens for a raster and its overviews; none if the file is not a raster."""
    from rasterio.errors import RasterioError

    try:
        with warnings.catch_warnings(action="ignore"), open_raster(file) as dataset:
            if dataset.count:
                dataset.overviews(1)  # without this call ``files`` lacks the overviews
            return list(dataset.files)
    except (RasterioError, SourceError):
        return ()
