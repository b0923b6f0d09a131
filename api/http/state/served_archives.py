"""The tile archives (PMTiles files) of a service.

Some archives have their own addresses under ``/archives``. Others hold tiles of a level, which then need not be rendered.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode

from skugga.api.errors import ArchiveError, NotServedError
from skugga.api.http.state.archive_file import ArchiveFile, has_changed
from skugga.api.http.state.level_checks import FileCheck
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.products import PRODUCTS
from skugga.terrain.errors import InputError, Problem, SkuggaError, printable

log = logging.getLogger("skugga")

TileKind = tuple[str, str, str, str]
"""Kind of an archive's tiles: layer, format, tile matrix set, and canonical query string with times in UTC."""


@dataclass(frozen=True, eq=False)
class LevelArchives:
    """The readable archives of a level.

    Attributes
    ----------
    files : dict of Path to ArchiveFile
        The archives by path.
    by_tile_kind : dict of TileKind to ArchiveFile
        The first archive of each kind of tile.
    version : str
        The versions of all archives in one text, for entity tags.
    """

    files: dict[Path, ArchiveFile]
    by_tile_kind: dict[TileKind, ArchiveFile]
    version: str

    @classmethod
    def of(cls, files: dict[Path, ArchiveFile]) -> LevelArchives:
        """Return the archives of a level. If several have the same kind of tile, the first one is used."""
        by_tile_kind: dict[TileKind, ArchiveFile] = {}
        for archive in files.values():
            metadata = archive.skugga_metadata
            layer, format, tms, query = (str(metadata.get(key, "")) for key in ("layer", "format", "tms", "query"))
            if layer in PRODUCTS and PRODUCTS[layer].when == "none" and not PRODUCTS[layer].options.model_fields:
                query = ""  # heights do not depend on light
            if format == archive.format:
                by_tile_kind.setdefault((layer, format, tms, with_utc_time(query)), archive)
        return cls(files, by_tile_kind, " ".join(archive.version for archive in files.values()))

    def archive_of(self, layer: str, format: str, tms: str, query: str, zoom: int) -> ArchiveFile | None:
        """Return the archive with a kind of tile at a zoom, or ``None``.

        ``tms`` is the name of the tile matrix set. ``query`` is the canonical query string of the request.
        """
        archive = self.by_tile_kind.get((layer, format, tms, with_utc_time(query))) if self.by_tile_kind else None
        return archive if archive is not None and zoom in archive.zooms else None


def with_utc_time(query: str) -> str:
    """Return a canonical query string with its ``time`` in UTC, so that one instant has one spelling."""
    if "time=" not in query:
        return query
    pairs = parse_qsl(query)
    try:
        return urlencode(
            {key: datetime.fromisoformat(value).astimezone(UTC).isoformat() if key == "time" else value for key, value in pairs}
        )
    except (ValueError, OverflowError):  # the archive's time is invalid, so no request matches it
        return query


NO_ARCHIVES = LevelArchives.of({})


class ServedArchives:
    """The archives with their own addresses, by name, and the archives of levels.

    An archive that changes on disk is reopened at its next use. ``ttl_s`` and ``max_wait_s`` are those of ``FileCheck``. The
    constructor opens the archives of ``paths``, so it must not run in the thread of the event loop. It raises ``ArchiveError`` for
    an unusable archive, and ``InputError`` for two archives of one name.
    """

    def __init__(self, paths: Sequence[Path], ttl_s: float = 0.0, max_wait_s: float = 60.0) -> None:
        self._ttl_s, self._max_wait_s = ttl_s, max_wait_s
        self._named_checks: dict[str, FileCheck[ArchiveFile]] = {}
        self._checks_by_level: dict[str, tuple[tuple[Path, ...], FileCheck[LevelArchives]]] = {}
        self._logged_errors: dict[Path, str] = {}
        for path in paths:
            name = printable(path.stem)
            if name in self._named_checks:
                raise InputError("LEVEL", Problem(f"'{path}' and another archive are both named '{name}'"), "Rename one of them")
            archive = ArchiveFile(path)
            self._named_checks[name] = FileCheck(name, archive, partial(self._check_file, name), ttl_s, max_wait_s, "archive")

    def names(self) -> list[str]:
        """Return the names of the archives with their own addresses."""
        return list(self._named_checks)

    def cached_archives(self) -> dict[str, ArchiveFile]:
        """Return the archives with their own addresses by name, as they were last read. Reads no file."""
        return {name: check.value for name, check in self._named_checks.items()}

    async def current(self, name: str) -> ArchiveFile:
        """Return the present version of an archive with its own address. Files are read in another thread.

        Raises ``NotServedError`` for an unknown name, and ``ArchiveError`` for an archive that can no longer be read.
        """
        if name not in self._named_checks:
            raise NotServedError(
                "archive", f"archive: {name[:60]!r} is not served. Archives: {', '.join(self._named_checks) or 'none'}."
            )
        return await self._named_checks[name].current()

    async def archives_of_level(self, level: ServedLevel) -> LevelArchives:
        """Return the present version of a level's archives. Unreadable archives are logged and left out."""
        return await self._check_of(level).current() if level.loaded.archives else NO_ARCHIVES

    def fresh_archives_of(self, level: ServedLevel) -> LevelArchives | None:
        """Return the archives of a level if they can be used without waiting for a check, else ``None``. Reads no file."""
        return self._check_of(level).fresh_value() if level.loaded.archives else NO_ARCHIVES

    def open_level_archives(self, level: ServedLevel) -> None:
        """Open the archives that a level names. Raises ``ArchiveError`` for an unreadable one."""
        if level.loaded.archives:
            self._check_of(level).value = LevelArchives.of({path: ArchiveFile(path) for path in level.loaded.archives})

    def expire_all(self) -> None:
        """Make every archive be checked for changes at its next use."""
        for archive_check in self._named_checks.values():
            archive_check.expire()
        for _, level_check in self._checks_by_level.values():
            level_check.expire()

    def _check_of(self, level: ServedLevel) -> FileCheck[LevelArchives]:
        """Return the check of a level's archives, which is renewed if the level names other files. Reads no file."""
        paths = level.loaded.archives
        entry = self._checks_by_level.get(level.name)
        if entry is None or entry[0] != paths:
            check = partial(self._check_level_archives, level.name)
            entry = paths, FileCheck(level.name, NO_ARCHIVES, check, self._ttl_s, self._max_wait_s, "archives of level")
            self._checks_by_level[level.name] = entry
        return entry[1]

    def _check_file(self, name: str) -> ArchiveFile:
        """Return the archive with its own address ``name``, reopened if its file has changed. Raises ``ArchiveError``."""
        check = self._named_checks[name]
        try:
            return self._reopen_if_changed(check.value if check.error is None else None, check.value.path)
        except ArchiveError as error:
            self._log_error(check.value.path, error)
            raise

    def _check_level_archives(self, name: str) -> LevelArchives:
        """Return the archives of the level ``name``; changed files are reopened. Unreadable archives are logged and left out."""
        paths, check = self._checks_by_level[name]
        before, files = check.value.files, {}
        for path in paths:
            try:
                files[path] = self._reopen_if_changed(before.get(path), path)
            except ArchiveError as error:
                self._log_error(path, error, " Its tiles are rendered.")
        return check.value if files == before else LevelArchives.of(files)

    def _reopen_if_changed(self, archive: ArchiveFile | None, path: Path) -> ArchiveFile:
        """Return ``archive`` if the file at ``path`` has not changed since it was opened, else the file opened anew.

        ``archive`` is ``None`` if the file is not open. Raises ``ArchiveError``.
        """
        if archive is not None and not has_changed(archive, path):
            return archive
        opened = ArchiveFile(path)
        if archive is not None or path in self._logged_errors:
            log.info("archive %s has changed and was reopened", path)
        self._logged_errors.pop(path, None)
        return opened

    def _log_error(self, path: Path, error: SkuggaError, consequence: str = "") -> None:
        """Log the error of a file, unless the same error of this file was logged last.

        ``consequence`` is appended to the message.
        """
        if self._logged_errors.get(path) != str(error):
            self._logged_errors[path] = str(error)
            log.error("archive %s%s", error, consequence)


def archive_summary(name: str, archive: ArchiveFile) -> dict[str, Any]:
    """Return the entry of an archive in ``/archives``: its name, title, attribution, bounds in degrees, zooms, format and layer."""
    metadata = archive.metadata
    return {
        "name": name,
        "title": str(metadata.get("name") or name),
        "attribution": str(metadata.get("attribution") or ""),
        "bounds": list(archive.bounds),
        "minzoom": archive.zooms[0],
        "maxzoom": archive.zooms[-1],
        "format": archive.format,
        "layer": archive.skugga_metadata.get("layer"),
    }
