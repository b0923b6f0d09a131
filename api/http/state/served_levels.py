"""The levels of a service: their facts without rendering, and checks of their files for changes."""

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

from skugga.api.errors import NotServedError, with_option_names
from skugga.api.file_stamps import Stamp, file_stamps, level_version, watched_files
from skugga.api.http.state.level_checks import FileCheck
from skugga.api.matrices import LonLatBounds, ZoomRange, finest_detail_m, matrix_set_of, served_matrix_sets, zoom_range
from skugga.api.products import MAP_PRODUCTS, PRODUCTS, VIEW_PRODUCTS
from skugga.api.workers.jobs import LevelKey
from skugga.terrain.errors import InputError, LevelError, Problem, SkuggaError, UnsupportedError, printable
from skugga.terrain.geo.clock import time_zone_at
from skugga.terrain.geo.sun import Sun, sun_of
from skugga.terrain.geo.world import LONGITUDE_LATITUDE, World, transformer
from skugga.terrain.level.algorithm_names import served_algorithms
from skugga.terrain.level.data_roots import DataRoots
from skugga.terrain.level.level import SUN, LoadedLevel, expand_override, load_level, override_lights
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.linked_files import is_remote
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.level.rasters import LEVEL_SUFFIXES
from skugga.terrain.scene import Scene, build_scene, with_default_sun
from skugga.terrain.style import STYLES

DEFAULT_MATRIX_SET = "WebMercatorQuad"

log = logging.getLogger("skugga")


@dataclass(frozen=True)
class ServedLevel:
    """The facts of a level that the service uses without rendering.

    Attributes
    ----------
    loaded : LoadedLevel
        The parsed level file.
    origin : LevelSource
        The files and options from which the level was loaded.
    version : str
        Digest that changes with the level's text and with the files that it names.
    world : World
        Geometry of the level's world: its CRS, its anchor, and whether it is flat.
    bounds : tuple of float or None
        Displayed extent: west, south, east, north in degrees; ``None`` if the level is not on the earth.
    data_bounds : tuple of float or None
        Extent of the raster: west, south, east, north in degrees; ``None`` if the level is not on the earth.
    zooms : dict of str to ZoomRange
        Zooms by tile matrix set.
    view_sizes : dict of str to tuple
        (width, height) in pixels by view; ``None`` for a view that cannot be rendered. ``map`` is always included.
    map_crs : CRS
        Default CRS of maps.
    lowest_ground_m : float
        Lowest height of the ground in metres.
    style : str
        Name of the level's own style.
    sun_is_default : bool
        Whether the level file names no sun. The level then has a default sun, low over its place.
    warnings : tuple of str
        Sentences about possible faults of the level.
    files : tuple of Path
        The files that the level depends on, the level file first.
    stamps : tuple of Stamp
        Stamp of each file (times, size and inode) just before it was read.
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
    lowest_ground_m: float
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
        """The level's key in jobs of render processes."""
        return LevelKey(**{**self.origin.model_dump(), "path": self.loaded.path, "version": self.version})

    @cached_property
    def time_zone(self) -> str | None:
        """The time zone of the centre of ``bounds``, such as Europe/Oslo; ``None`` without bounds."""
        if self.bounds is None:
            return None
        west, south, east, north = self.bounds
        return time_zone_at((west + east) / 2, (south + north) / 2)

    def zooms_in(self, matrix_set: str) -> ZoomRange:
        """Return the zooms at which the level is served in a tile matrix set.

        Raises ``NotServedError`` for a set that is unknown or does not cover the level, and ``UnsupportedError`` for a level that
        is not on the earth.
        """
        matrix_set_of(matrix_set)
        if self.world.off_earth_reason is not None:
            raise UnsupportedError("level", self.name, f"{self.world.off_earth_reason}, so it has no tiles")
        if matrix_set not in self.zooms:
            raise NotServedError("tms", f"tms: {self.name} lies outside of {matrix_set}. Use one of {', '.join(self.zooms)}.")
        return self.zooms[matrix_set]

    def view_named(self, name: str | None) -> str:
        """Return the name of a view after a check.

        ``None`` means the view ``map`` if the level file lists it, else the file's first view, else ``map``. Raises ``InputError``
        for an unknown view.
        """
        views = self.loaded.level.views
        if name is None:
            return "map" if "map" in views else next(iter(views), "map")
        if name not in self.view_sizes:
            raise InputError("view", name, ", ".join(self.view_sizes))
        return name

    def lights(self, sun_spec: SunSpec | None) -> tuple[str, ...]:
        """Return the names of the level's lights under the sun ``sun_spec`` of a request (``None``: the level's own sun).

        The sun comes first. It is left out if neither the request nor the level has a sun and the level has other lights."""
        names = self.loaded.level.light_names
        sunless = sun_spec is None and self.loaded.level.sun == "none"
        return names[1:] if sunless and len(names) > 1 else names

    def sun(self, sun_spec: SunSpec | None) -> Sun | None:
        """Return the sun of a request (``sun_spec``), else the level's own; ``None`` without both. Raises ``InputError``."""
        spec = sun_spec or self.loaded.level.sun
        return None if spec is None or spec == "none" else sun_of(spec, self.world)

    def summary(self) -> dict[str, Any]:
        """Return the level's entry in ``/levels``. Its ``minzoom`` and ``maxzoom`` are those of tiles in ``DEFAULT_MATRIX_SET``."""
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
                    "about": PRODUCTS[name].description,
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
    """The levels of ``sources`` and of all level files of a ``folder``, by name.

    A level whose files change on disk is reloaded at its next use (``ttl_s`` and ``max_wait_s``: as in ``FileCheck``).
    ``read_folder`` adds and removes levels of the folder. The data of a level must lie in the folder, in the folder of its source,
    or in one of ``data_roots``. Remote data (URLs) are allowed if ``remote_sources`` is set. Methods that read files must not run
    in the thread of the event loop.

    Raises
    ------
    LevelError, SourceError
        A source cannot be served. The message names it.
    InputError
        A source cannot be served, the folder cannot be read, or two levels have one name.
    """

    def __init__(
        self,
        sources: Sequence[Path | LevelSource],
        remote_sources: bool = False,
        ttl_s: float = 0.0,
        max_wait_s: float = 60.0,
        folder: Path | None = None,
        data_roots: Sequence[Path] = (),
    ) -> None:
        self._remote_sources, self._ttl_s, self._max_wait_s = remote_sources, ttl_s, max_wait_s
        self._folder, self._data_roots = folder, tuple(data_roots)
        self._checks: dict[str, FileCheck[ServedLevel]] = {}
        self._folder_lock = threading.Lock()
        for source in map(LevelSource.of, sources):
            check = self._make_check(source, [file.parent for file in _named_files(source)])
            if check.name in self._checks:
                fault = Problem(f"'{source.path}' and another level are both named '{check.name}'")
                raise InputError("LEVEL", fault, "Rename one of them, or give NAME=FILE")
            self._checks[check.name] = check
        self._source_checks = dict(self._checks)
        self.read_folder()

    def read_folder(self) -> None:
        """Serve the level files that the folder has now: add those that are new, and remove those that are gone.

        A new file that cannot be served is logged and left out. Raises ``InputError`` for a folder that cannot be read and for two
        levels of one name. The served levels are then unchanged.
        """
        if self._folder is None:
            return
        with self._folder_lock:
            before, checks = self._checks, dict(self._source_checks)
            for name, path in _level_files(self._folder, checks).items():
                check = before.get(name)
                if check is None or check.value.origin.path != path:
                    try:
                        check = self._make_check(LevelSource(path=path), [self._folder])
                    except SkuggaError as error:
                        log.error("level file %s is left out: %s", path, error)
                        continue
                    except Exception as error:  # a bug or an error of a library: other levels are still served
                        log.exception("level file %s is left out: %r", path, error)
                        continue
                checks[name] = check
            self._checks = checks  # replaced as a whole: other threads may iterate over the old one
        new, removed = ([name for name in names if name not in other] for names, other in ((checks, before), (before, checks)))
        log.info(
            "folder of levels %s: added: %s; removed: %s", self._folder, ", ".join(new) or "none", ", ".join(removed) or "none"
        )

    def reload_folder(self) -> None:
        """Run ``read_folder``, and log its error instead of raising it: a running service keeps its levels."""
        try:
            self.read_folder()
        except InputError as error:
            log.error("%s The levels are unchanged.", error)

    def is_served(self, path: Path) -> bool:
        """Return whether the level file at ``path`` is served. Reads no file."""
        return any(check.value.loaded.path == path for check in self._checks.values())

    def _make_check(self, source: LevelSource, allowed_roots: Iterable[Path]) -> FileCheck[ServedLevel]:
        """Read a level, and return the check that keeps it up to date.

        The data of the level must lie in ``allowed_roots`` or in the service's data folders. Raises ``LevelError``,
        ``SourceError`` or ``InputError``.
        """
        level = self._read_level(source.model_copy(update={"roots": (*allowed_roots, *self._data_roots)}))
        return FileCheck(level.name, level, partial(self._check_files, level.name), self._ttl_s, self._max_wait_s)

    async def current(self, name: str) -> ServedLevel:
        """Return the present version of a level, or its last one if reading takes too long. Files are read in another thread.

        Raises ``NotServedError`` for an unknown name, and the error of reading for a level that can no longer be read.
        """
        return await self._check(name).current()

    def reload_if_changed(self, name: str) -> ServedLevel:
        """Read a level in this thread if it has changed, and return it, without a time limit. Raises the errors of ``current``."""
        return self._check(name).check_now()

    def fresh_level(self, name: str) -> ServedLevel | None:
        """Return a level if it can be used without waiting for a check, else ``None``. Reads no file."""
        check = self._checks.get(name)
        return None if check is None else check.fresh_value()

    def cached_levels(self) -> list[ServedLevel]:
        """Return all levels as they were last read. Reads no file."""
        return [check.value for check in self._checks.values()]

    def cached_source_levels(self) -> list[ServedLevel]:
        """Return the levels of ``sources``, without those of the folder, as they were last read. Reads no file."""
        return [check.value for check in self._source_checks.values()]

    def names(self) -> list[str]:
        """Return the levels' names."""
        return list(self._checks)

    def expire_all(self) -> None:
        """Make the files of every level be checked for changes at its next use."""
        for check in self._checks.values():
            check.expire()

    def current_levels(self) -> list[ServedLevel]:
        """Return the present version of all levels. Levels that can no longer be read are logged and left out."""
        levels = []
        for name, check in self._checks.items():
            try:
                levels.append(check.check_now())
            except SkuggaError as error:
                log.error("level %s: %s", name, error)
        return levels

    def _check(self, name: str) -> FileCheck[ServedLevel]:
        """Return the check of a level by its name. Raises ``NotServedError``."""
        checks = self._checks
        if name not in checks:
            raise NotServedError("level", f"level: {name[:60]!r} is not served. Levels: {', '.join(checks)}.")
        return checks[name]

    def _check_files(self, name: str) -> ServedLevel:
        """Return a level; reload it if one of its files has changed or if the last check failed."""
        check = self._check(name)
        level = check.value
        if check.error is None and file_stamps(level.files) == level.stamps:
            return level
        reloaded = self._read_level(level.origin)
        log.info("level %s has changed and was reloaded", name)
        return reloaded

    def _read_level(self, origin: LevelSource) -> ServedLevel:
        """Read a level's files and return its facts. Raises an error if the service does not allow its data or its algorithms."""
        loaded, path = load_level(origin), origin.path
        remote = [source for source in loaded.linked_sources if is_remote(source)]
        if remote and not self._remote_sources:
            raise LevelError(str(path), remote[0], "local files (SKUGGA_REMOTE_SOURCES=true allows remote ones)")
        if origin.roots is not None:
            DataRoots(origin.roots).check_opened_files(loaded)
        for key, settings in loaded.level.shadows.all_settings.items():
            if not algorithm_names_in(settings.algorithm) <= set(served_algorithms()):
                allowed = f"{', '.join(['auto', *served_algorithms()])} in a served level"
                raise LevelError(f"{path}: {key}.algorithm", settings.algorithm, allowed)
            if settings.fit == "tight":
                allowed = "auto or stable in a served level, since tiles with a tight fit do not match at their edges"
                raise LevelError(f"{path}: {key}.fit", "tight", allowed)
        files = watched_files(loaded)
        stamps = file_stamps(files)  # before reading: the next check then sees changes made meanwhile
        scene = build_scene(loaded.without_sun)
        try:
            return _served_level_of(loaded, origin, scene, files, stamps)
        finally:
            scene.close()


def _named_files(source: LevelSource) -> list[Path]:
    """Return the files that a source names, and the same paths with symbolic links resolved."""
    files = [file for file in (source.path, source.canopy, source.buildings) if file is not None]
    return [*files, *map(Path, map(os.path.realpath, files))]


def _level_files(folder: Path, reserved_names: Collection[str]) -> dict[str, Path]:
    """Return the paths of a folder's level files by level name, without hidden files.

    Raises ``InputError`` for a folder that cannot be read, for a name in ``reserved_names``, or for a name that appears twice.
    """
    try:
        files = sorted(
            path for path in folder.iterdir() if path.suffix.lower() in LEVEL_SUFFIXES and path.name[0] != "." and not path.is_dir()
        )
    except OSError as error:
        raise InputError(
            "SKUGGA_LEVELS", Problem(f"'{folder}' cannot be read ({error.strerror})"), "Give a folder of level files"
        ) from None
    paths: dict[str, Path] = {}
    for path in files:
        name = printable(path.stem)
        if name in paths or name in reserved_names:
            raise InputError("SKUGGA_LEVELS", Problem(f"'{path}' and another level are both named '{name}'"), "Rename one of them")
        paths[name] = path
    return paths


def algorithm_names_in(algorithm: str | dict[str, Any] | None) -> set[str]:
    """Return the names of the algorithms in a setting ``algorithm``: a name, or names by kind of caster, by light, or by both.

    ``auto`` and ``None`` name no algorithm.
    """
    if algorithm is None:
        return set()
    return {name for kinds in expand_override(algorithm, override_lights(algorithm)).values() for name in kinds.values()}


def _served_level_of(
    loaded: LoadedLevel, origin: LevelSource, scene: Scene, files: tuple[Path, ...], stamps: tuple[Stamp, ...]
) -> ServedLevel:
    """Return the facts of a level from its scene, and log warnings about its ground.

    ``files`` are the files that the level depends on, and ``stamps`` are theirs before they were read.
    """
    world, data_bounds, zooms = scene.world, None, {}
    bounds = scene.bounds_lon_lat if world.off_earth_reason is None else None
    if bounds is not None:
        west, south, east, north = transformer(scene.elevation.crs, LONGITUDE_LATITUDE).transform_bounds(
            *scene.elevation.bounds, densify_pts=21
        )
        data_bounds = (west, south, east + 360.0 if east < west else east, north)
        detail = finest_detail_m(scene)
        zooms_by_set = {name: zoom_range(matrix_set, world, bounds, detail) for name, matrix_set in served_matrix_sets().items()}
        zooms = {name: range_ for name, range_ in zooms_by_set.items() if range_ is not None}
    sun_is_default = loaded.level.sun is None
    loaded = with_default_sun(loaded, world, scene.elevation)
    version = level_version(loaded, stamps)
    view_sizes = {name: _view_size(scene, name) for name in {"map": None, **loaded.level.views}}
    ground_warnings = tuple(map(with_option_names, scene.warnings))  # to whoever wrote the command line of the service
    for text in ground_warnings:
        log.warning("level %s: %s", loaded.name, text)
    return ServedLevel(
        loaded, origin, version, world, bounds, data_bounds, zooms, view_sizes, scene.map_crs, scene.height_range_m[0],
        scene.style.name, sun_is_default, ground_warnings, files, stamps,
    )  # fmt: skip


def _view_size(scene: Scene, name: str) -> tuple[int, int] | None:
    """Return (width, height) of a view in pixels; ``None`` for a view that cannot be rendered, which is logged."""
    try:
        view = scene.view(name)
    except SkuggaError as error:  # the level still has tiles
        log.warning("level %s: view %s cannot be rendered: %s", scene.loaded.name, name, error)
        return None
    return view.cols, view.rows
