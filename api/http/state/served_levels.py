"""The levels of a service: what is known of each without drawing it, and whether its files have changed."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from pyproj import CRS

from skugga.api.errors import NotServedError
from skugga.api.file_stamps import Stamp, file_stamps, level_version, watched_files
from skugga.api.http.state.level_checks import LevelCheck
from skugga.api.matrices import LonLatBounds, ZoomRange, detail_m, matrix_set_of, served_matrix_sets, zoom_range
from skugga.api.products import MAP_PRODUCTS, PRODUCTS, VIEW_PRODUCTS
from skugga.api.workers.jobs import LevelKey
from skugga.terrain.errors import InputError, LevelError, SkuggaError, UnsupportedError, printable
from skugga.terrain.geo.clock import time_zone_at
from skugga.terrain.geo.sun import Sun, sun_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, transformer
from skugga.terrain.level.algorithm_names import served_algorithms
from skugga.terrain.level.data_roots import DataRoots
from skugga.terrain.level.level import SUN, LoadedLevel, expand_override, lights_named, load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.linked_files import is_remote
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.level.rasters import LEVEL_SUFFIXES
from skugga.terrain.scene import Scene, build_scene, with_own_sun
from skugga.terrain.style import STYLES

DEFAULT_MATRIX_SET = "WebMercatorQuad"

log = logging.getLogger("skugga")


@dataclass(frozen=True)
class ServedLevel:
    """A level as the service knows it. ``version`` changes with the level's text and the files it names.

    ``bounds`` is what is looked at, ``data_bounds`` all of the raster: west, south, east, north in degrees, ``None`` in
    a flat world. ``zooms`` are by tile matrix set, ``view_sizes`` (width, height) in pixels by view (``map`` is among them
    whether the level names it or not), ``None`` for a view that cannot be drawn. ``map_crs`` is that of maps that name none,
    ``lowest_m`` the height of its lowest ground, ``style`` the name of its own style. ``sun_is_default`` says whether the
    level names no sun, so that a low one of its place was chosen. ``warnings`` are sentences on what may be
    wrong with it. ``files`` are those that it hangs on, its own first, each with its stamp when it was read.
    """

    loaded: LoadedLevel
    origin: LevelSource
    version: str
    world: World
    bounds: LonLatBounds | None
    data_bounds: LonLatBounds | None
    zooms: dict[str, ZoomRange]
    view_sizes: dict[str, tuple[int, int] | None]
    map_crs: CRS
    lowest_m: float
    style: str
    sun_is_default: bool = False
    warnings: tuple[str, ...] = ()
    files: tuple[Path, ...] = ()
    stamps: tuple[Stamp, ...] = ()

    @property
    def name(self) -> str:
        """The level's name in addresses."""
        return self.loaded.name

    @cached_property
    def key(self) -> LevelKey:
        """What render processes are told."""
        return LevelKey(**{**self.origin.model_dump(), "path": self.loaded.path, "version": self.version})

    @cached_property
    def time_zone(self) -> str | None:
        """The time zone of the middle of what is looked at, as Europe/Oslo; ``None`` in a flat world."""
        if self.bounds is None:
            return None
        west, south, east, north = self.bounds
        return time_zone_at((west + east) / 2, (south + north) / 2)

    def zooms_in(self, matrix_set: str) -> ZoomRange:
        """The zooms of a tile matrix set.

        Raises ``NotServedError`` for an unknown one or one elsewhere on earth, ``UnsupportedError`` off the earth.
        """
        matrix_set_of(matrix_set)
        if self.world.off_earth is not None:
            raise UnsupportedError("level", self.name, f"{self.world.off_earth}, so there are no tiles")
        if matrix_set not in self.zooms:
            raise NotServedError("tms", f"{self.name} lies outside of {matrix_set}; it has {', '.join(self.zooms)}.")
        return self.zooms[matrix_set]

    def view_named(self, name: str | None) -> str:
        """A view's name; where none is given ``map``, if the level lists it, else its first view. Raises ``InputError``."""
        views = self.loaded.level.views
        if name is None:
            return "map" if "map" in views else next(iter(views), "map")
        if name not in self.view_sizes:
            raise InputError("view", name, ", ".join(self.view_sizes))
        return name

    def lights(self, spec: SunSpec | None) -> tuple[str, ...]:
        """The lights of a picture under a request's sun (``None``: the level's own): the sun first, unless there are only
        others."""
        every = self.loaded.level.light_names
        sunless = spec is None and self.loaded.level.sun == "none"
        return every[1:] if sunless and len(every) > 1 else every

    def sun(self, spec: SunSpec | None) -> Sun | None:
        """The sun of a request, or the level's own; ``None`` where it has none. Raises ``InputError``."""
        level_sun = self.loaded.level.sun
        chosen = spec or level_sun
        return None if chosen is None or chosen == "none" else sun_of(chosen, self.world)

    def summary(self) -> dict[str, Any]:
        """What ``/levels`` says of it; ``minzoom`` and ``maxzoom`` are those of Web Mercator tiles."""
        level, zooms = self.loaded.level, self.zooms.get(DEFAULT_MATRIX_SET)
        sun = None if level.sun is None or level.sun == "none" else level.sun.model_dump(mode="json", exclude_none=True)
        kinds = {**({} if sun is None else {SUN: SUN}), **{name: light.kind for name, light in level.lights.items()}}
        return {
            "name": self.name,
            "title": level.title or self.name,
            "attribution": level.attribution,
            "bounds": self.bounds,
            "minzoom": zooms and zooms.first,
            "maxzoom": zooms and zooms.last,
            "views": list(level.views),
            "view_kinds": {name: {"kind": view.kind, "size": self.view_sizes[name]} for name, view in level.views.items()},
            "lights": {name: {"kind": kind} for name, kind in kinds.items()},
            "layers": [name for name in VIEW_PRODUCTS if PRODUCTS[name].pass_layer is None],
            "layers_between": [name for name in VIEW_PRODUCTS if PRODUCTS[name].pass_layer is not None],
            "styles": list(STYLES),
            "style": self.style,
            "map_layers": list(MAP_PRODUCTS),
            "products": [
                {
                    "name": name,
                    "about": PRODUCTS[name].about,
                    "when": PRODUCTS[name].when,
                    "legend": bool(PRODUCTS[name].color_scale),
                }
                for name in MAP_PRODUCTS
            ],
            "algorithms": list(served_algorithms()),
            "sun": sun,
            "sun_is_default": self.sun_is_default,
            "time_zone": self.time_zone,
            "warnings": list(self.warnings),
            "tile_matrix_sets": {name: {"minzoom": range_.first, "maxzoom": range_.last} for name, range_ in self.zooms.items()},
        }


class ServedLevels:
    """The levels by name: of ``sources``, and of all level files of a ``folder``. A level whose file or raster changes on disk is
    read anew when it is next asked for; ``read_folder`` finds which files the folder has.

    What a level is read from lies in the folder, in that of a source, or in one of ``data_roots``. Reads files: to be used from
    threads other than the event loop's. Raises ``LevelError``, ``SourceError`` or ``InputError`` for a source that cannot be
    served, naming it, and ``InputError`` for a folder that cannot be read and for two levels of one name.
    """

    def __init__(
        self,
        sources: Sequence[Path | LevelSource],
        remote_sources: bool = False,
        fresh_s: float = 0.0,
        wait_s: float = 60.0,
        folder: Path | None = None,
        data_roots: Sequence[Path] = (),
    ) -> None:
        self._remote_sources, self._fresh_s, self._wait_s = remote_sources, fresh_s, wait_s
        self._folder, self._data_roots = folder, tuple(data_roots)
        self._checks: dict[str, LevelCheck[ServedLevel]] = {}
        self._reading = threading.Lock()
        for source in map(LevelSource.of, sources):
            check = self._checked(source, [file.parent for file in _named_files(source)])
            if check.name in self._checks:
                allowed = f"files of different names, or NAME=FILE: a level '{check.name}' is served already"
                raise InputError("LEVEL", str(source.path), allowed)
            self._checks[check.name] = check
        self._named = dict(self._checks)
        self.read_folder()

    def read_folder(self) -> None:
        """Serve the level files that the folder has now. One that is new and cannot be served is told of in the log, and left out.

        Raises ``InputError`` for a folder that cannot be read and for two levels of one name; then the levels stay as they are.
        """
        if self._folder is None:
            return
        with self._reading:
            before, checks = self._checks, dict(self._named)
            for name, path in _level_files(self._folder, checks).items():
                check = before.get(name)
                if check is None or check.value.origin.path != path:
                    try:
                        check = self._checked(LevelSource(path=path), [self._folder])
                    except SkuggaError as error:
                        log.error("level file %s is left out: %s", path, error)
                        continue
                    except Exception as error:  # a bug, or what a library raises: the others are served all the same
                        log.exception("level file %s is left out: %r", path, error)
                        continue
                checks[name] = check
            self._checks = checks  # whole: others go through it meanwhile
        new, gone = ([name for name in one if name not in other] for one, other in ((checks, before), (before, checks)))
        log.info("levels of %s: new: %s; gone: %s", self._folder, ", ".join(new) or "none", ", ".join(gone) or "none")

    def read_folder_again(self) -> None:
        """``read_folder`` for a service that runs: what is wrong is told of in the log."""
        try:
            self.read_folder()
        except InputError as error:
            log.error("the levels stay as they are: %s", error)

    def serves(self, path: Path) -> bool:
        """Whether a file is a level that is served; no file is looked at."""
        return any(check.value.loaded.path == path for check in self._checks.values())

    def _checked(self, source: LevelSource, roots: Iterable[Path]) -> LevelCheck[ServedLevel]:
        level = self._read(source.model_copy(update={"roots": (*roots, *self._data_roots)}))
        return LevelCheck(level.name, level, partial(self._look, level.name), self._fresh_s, self._wait_s)

    async def current(self, name: str) -> ServedLevel:
        """A level as it is now, or as it was last if reading it takes too long; no file is looked at in the event loop.

        Raises ``NotServedError``, or what reading raises if it was broken since.
        """
        return await self._check(name).current()

    def get(self, name: str) -> ServedLevel:
        """A level as it is now, however long that takes. Raises as ``current`` does."""
        return self._check(name).now()

    def unchanged(self, name: str) -> ServedLevel | None:
        """A level of which it is known that its files have not changed lately; no file is looked at."""
        check = self._checks.get(name)
        return None if check is None else check.known()

    def known(self) -> list[ServedLevel]:
        """All levels as they were last read: no file is looked at."""
        return [check.value for check in self._checks.values()]

    def known_named(self) -> list[ServedLevel]:
        """The levels of the sources, without those of the folder, as they were last read."""
        return [check.value for check in self._named.values()]

    def names(self) -> list[str]:
        """The levels' names."""
        return list(self._checks)

    def look_again(self) -> None:
        """Look at the files of every level when it is next asked for."""
        for check in self._checks.values():
            check.expire()

    def all(self) -> list[ServedLevel]:
        """All levels as they are now; one that was broken since is left out."""
        levels = []
        for name, check in self._checks.items():
            try:
                levels.append(check.now())
            except SkuggaError as error:
                log.error("level %s: %s", name, error)
        return levels

    def _check(self, name: str) -> LevelCheck[ServedLevel]:
        checks = self._checks
        if name not in checks:
            raise NotServedError("level", f"Unknown level {name[:60]!r}; served: {', '.join(checks)}.")
        return checks[name]

    def _look(self, name: str) -> ServedLevel:
        """A level, read anew if a file of its has changed, or if it could not be read last time."""
        check = self._check(name)
        level = check.value
        if check.error is None and file_stamps(level.files) == level.stamps:
            return level
        read = self._read(level.origin)
        log.info("level %s has changed and was read anew", name)
        return read

    def _read(self, origin: LevelSource) -> ServedLevel:
        loaded, path = load_level(origin), origin.path
        remote = [source for source in loaded.linked_sources if is_remote(source)]
        if remote and not self._remote_sources:
            raise LevelError(str(path), remote[0], "local files; SKUGGA_REMOTE_SOURCES=true allows remote ones")
        if origin.roots is not None:
            DataRoots(origin.roots).check_opened(loaded)
        for key, settings in loaded.level.shadows.all_settings.items():
            if not names_in(settings.algorithm) <= set(served_algorithms()):
                allowed = f"in a level that is served: {', '.join(['auto', *served_algorithms()])}"
                raise LevelError(f"{path}: {key}.algorithm", settings.algorithm, allowed)
            if settings.fit == "tight":
                allowed = "auto or stable in a served level: tiles with a tight fit do not join"
                raise LevelError(f"{path}: {key}.fit", "tight", allowed)
        files = watched_files(loaded)
        stamps = file_stamps(files)  # before they are read: what changes meanwhile is seen at the next look
        scene = build_scene(loaded.without_sun)
        try:
            return _served(loaded, origin, scene, files, stamps)
        finally:
            scene.close()


def _named_files(source: LevelSource) -> list[Path]:
    """The files that a source names, and those that they lead to if they are links."""
    named = [file for file in (source.path, source.canopy, source.buildings) if file is not None]
    return [*named, *map(Path, map(os.path.realpath, named))]


def _level_files(folder: Path, taken: Collection[str]) -> dict[str, Path]:
    """The level files of a folder by name, none of which is taken. Raises ``InputError``. Editors' hidden files are none."""
    try:
        files = sorted(
            path for path in folder.iterdir() if path.suffix.lower() in LEVEL_SUFFIXES and path.name[0] != "." and not path.is_dir()
        )
    except OSError as error:
        raise InputError("SKUGGA_LEVELS", str(folder), f"a folder that can be read ({error.strerror})") from None
    found: dict[str, Path] = {}
    for path in files:
        name = printable(path.stem)
        if name in found or name in taken:
            raise InputError("SKUGGA_LEVELS", str(path), f"files of different names: another one is a level '{name}', too")
        found[name] = path
    return found


def names_in(algorithm: str | dict[str, Any] | None) -> set[str]:
    """The algorithms that an override names, whichever way it is spelt."""
    if algorithm is None:
        return set()
    return {name for kinds in expand_override(algorithm, lights_named(algorithm)).values() for name in kinds.values()}


def _served(
    loaded: LoadedLevel, origin: LevelSource, scene: Scene, files: tuple[Path, ...], stamps: tuple[Stamp, ...]
) -> ServedLevel:
    world, data_bounds, zooms = scene.world, None, {}
    bounds = scene.bounds_lon_lat if world.off_earth is None else None
    if bounds is not None:
        west, south, east, north = transformer(scene.elevation.crs, LONGITUDE_LATITUDE).transform_bounds(
            *scene.elevation.bounds, densify_pts=21
        )
        data_bounds = (west, south, east + 360.0 if east < west else east, north)
        detail = detail_m(scene)
        zooms_by_set = {name: zoom_range(matrix_set, world, bounds, detail) for name, matrix_set in served_matrix_sets().items()}
        zooms = {name: range_ for name, range_ in zooms_by_set.items() if range_ is not None}
    sun_is_default = loaded.level.sun is None
    loaded = with_own_sun(loaded, world, scene.elevation)
    version = level_version(loaded, stamps)
    view_sizes = {name: _view_size(scene, name) for name in {"map": None, **loaded.level.views}}
    for text in scene.warnings:
        log.warning("level %s: %s", loaded.name, text)
    return ServedLevel(
        loaded, origin, version, world, bounds, data_bounds, zooms, view_sizes, scene.map_crs, scene.height_range_m[0],
        scene.style.name, sun_is_default, scene.warnings, files, stamps,
    )  # fmt: skip


def _view_size(scene: Scene, name: str) -> tuple[int, int] | None:
    try:
        view = scene.view(name)
    except SkuggaError as error:  # the level has tiles all the same
        log.warning("level %s: view %s cannot be drawn: %s", scene.loaded.name, name, error)
        return None
    return view.cols, view.rows
