"""The archives of tiles of a service: those that are served by themselves, and those that answer for tiles of levels."""

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
from skugga.api.http.state.archive_file import ArchiveFile, changed
from skugga.api.http.state.level_checks import LevelCheck
from skugga.api.http.state.served_levels import ServedLevel
from skugga.api.products import PRODUCTS
from skugga.terrain.errors import InputError, SkuggaError, printable

log = logging.getLogger("skugga")

TileKind = tuple[str, str, str, str]
"""Layer, format, tile matrix set, and what is asked of the picture as a canonical query string."""


@dataclass(frozen=True, eq=False)
class LevelArchives:
    """The archives of a level that can be read, by path, and those that answer by the kind of tile: of one kind the first."""

    files: dict[Path, ArchiveFile]
    by_kind: dict[TileKind, ArchiveFile]
    version: str

    @classmethod
    def of(cls, files: dict[Path, ArchiveFile]) -> LevelArchives:
        """Some archives, the first of one kind before others."""
        by_kind: dict[TileKind, ArchiveFile] = {}
        for archive in files.values():
            said = archive.of_skugga
            layer, format, tms, query = (str(said.get(key, "")) for key in ("layer", "format", "tms", "query"))
            if layer in PRODUCTS and PRODUCTS[layer].when == "none":
                query = ""  # heights hang on no light
            if format == archive.format:
                by_kind.setdefault((layer, format, tms, in_utc(query)), archive)
        return cls(files, by_kind, " ".join(archive.version for archive in files.values()))

    def answering(self, layer: str, format: str, tms: str, query: str, zoom: int) -> ArchiveFile | None:
        """The archive of such tiles, if it has them of that zoom; ``query`` as ``PictureRequest.query`` says it."""
        archive = self.by_kind.get((layer, format, tms, in_utc(query))) if self.by_kind else None
        return archive if archive is not None and zoom in archive.zooms else None


def in_utc(query: str) -> str:
    """A canonical query with its ``time`` in UTC, if it has one: an instant has a spelling for each offset."""
    if "time=" not in query:
        return query
    pairs = parse_qsl(query)
    try:
        return urlencode(
            {key: datetime.fromisoformat(value).astimezone(UTC).isoformat() if key == "time" else value for key, value in pairs}
        )
    except (ValueError, OverflowError):  # no instant: of an archive that says nothing that could be asked for
        return query


NO_ARCHIVES = LevelArchives.of({})


class ServedArchives:
    """Archives by name, and those that levels name. One that changes on disk is opened anew when it is next asked for.

    Opens the named ones: to be made in a thread other than the event loop's. Raises ``ArchiveError`` for one that cannot be served,
    and ``InputError`` for two of one name.
    """

    def __init__(self, paths: Sequence[Path], fresh_s: float = 0.0, wait_s: float = 60.0) -> None:
        self._fresh_s, self._wait_s = fresh_s, wait_s
        self._named: dict[str, LevelCheck[ArchiveFile]] = {}
        self._of_levels: dict[str, tuple[tuple[Path, ...], LevelCheck[LevelArchives]]] = {}
        self._told: dict[Path, str] = {}
        for path in paths:
            name = printable(path.stem)
            if name in self._named:
                raise InputError("LEVEL", str(path), f"files of different names: an archive '{name}' is served already")
            archive = ArchiveFile(path)
            self._named[name] = LevelCheck(name, archive, partial(self._look, name), fresh_s, wait_s, "archive")

    def names(self) -> list[str]:
        """The names of those that are served by themselves."""
        return list(self._named)

    def known(self) -> dict[str, ArchiveFile]:
        """Those that are served by themselves as they were last read: no file is looked at."""
        return {name: check.value for name, check in self._named.items()}

    async def current(self, name: str) -> ArchiveFile:
        """An archive that is served by itself as it is now; no file is looked at in the event loop.

        Raises ``NotServedError``, and ``ArchiveError`` where it was broken since.
        """
        if name not in self._named:
            raise NotServedError("archive", f"Unknown archive {name[:60]!r}; served: {', '.join(self._named) or 'none'}.")
        return await self._named[name].current()

    async def of_level(self, level: ServedLevel) -> LevelArchives:
        """The archives of a level as they are now. One that cannot be read is told of in the log, and left out."""
        return await self._check_of(level).current() if level.loaded.archives else NO_ARCHIVES

    def unchanged_of(self, level: ServedLevel) -> LevelArchives | None:
        """The archives of a level, if it is known that they have not changed lately; no file is looked at."""
        return self._check_of(level).known() if level.loaded.archives else NO_ARCHIVES

    def check_level(self, level: ServedLevel) -> None:
        """Open a level's archives. Raises ``ArchiveError`` for one that cannot be read."""
        if level.loaded.archives:
            self._check_of(level).value = LevelArchives.of({path: ArchiveFile(path) for path in level.loaded.archives})

    def look_again(self) -> None:
        """Look at every file when it is next asked for."""
        for named in self._named.values():
            named.expire()
        for _, of_level in self._of_levels.values():
            of_level.expire()

    def _check_of(self, level: ServedLevel) -> LevelCheck[LevelArchives]:
        paths = level.loaded.archives
        found = self._of_levels.get(level.name)
        if found is None or found[0] != paths:
            look = partial(self._look_of_level, level.name)
            found = paths, LevelCheck(level.name, NO_ARCHIVES, look, self._fresh_s, self._wait_s, "archives of level")
            self._of_levels[level.name] = found
        return found[1]

    def _look(self, name: str) -> ArchiveFile:
        check = self._named[name]
        try:
            return self._as_it_is(check.value if check.error is None else None, check.value.path)
        except ArchiveError as error:
            self._tell(check.value.path, error)
            raise

    def _look_of_level(self, name: str) -> LevelArchives:
        paths, check = self._of_levels[name]
        before, files = check.value.files, {}
        for path in paths:
            try:
                files[path] = self._as_it_is(before.get(path), path)
            except ArchiveError as error:
                self._tell(path, error, "; its tiles are rendered")
        return check.value if files == before else LevelArchives.of(files)

    def _as_it_is(self, archive: ArchiveFile | None, path: Path) -> ArchiveFile:
        if archive is not None and not changed(archive, path):
            return archive
        opened = ArchiveFile(path)
        if archive is not None or path in self._told:
            log.info("archive %s has changed and was opened anew", path)
        self._told.pop(path, None)
        return opened

    def _tell(self, path: Path, error: SkuggaError, then: str = "") -> None:
        """Log what is wrong with a file, once."""
        if self._told.get(path) != str(error):
            self._told[path] = str(error)
            log.error("archive %s%s", error, then)


def archive_facts(name: str, archive: ArchiveFile) -> dict[str, Any]:
    """What is said of an archive: by its metadata where they say it."""
    said = archive.metadata
    return {
        "name": name,
        "title": str(said.get("name") or name),
        "attribution": str(said.get("attribution") or ""),
        "bounds": list(archive.bounds),
        "minzoom": archive.zooms[0],
        "maxzoom": archive.zooms[-1],
        "format": archive.format,
        "layer": archive.of_skugga.get("layer"),
    }
