"""A level that is open: pictures and rasters of it as arrays, one after the other."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any
from urllib.parse import urlencode

import numpy as np
from affine import Affine
from pyproj import CRS
from rasterio.io import MemoryFile

from api.catalogue import find_level
from api.device_calibration import calibration_for
from api.film_span import USUAL_FPS, film_span
from api.layers import PASS_LAYERS, frame_layer
from api.library.tile_service import TileService
from api.point.report import around_point, point_report
from api.point.values import PointQuery, PointReport
from api.shade import Bounds, raster_view, shade_array
from api.sun_hours import sun_hours_array
from selector.film import film_frames, frame_moments
from selector.film_request import FilmRequest
from selector.replanning import Replanner
from selector.select import plan_of_view
from shadows.point.horizon import PointHorizon, horizon_round
from shadows.render import render_frame
from shadows.sun_hours.sun_hours import SunRules
from terrain.geo.clock import clock_named, date_of
from terrain.geo.daily_windows import readings_of, windows_asked
from terrain.level.camera_file import load_camera_path
from terrain.level.level import load_level, parse_sun
from terrain.level.level_source import LevelSource, units_named
from terrain.level.parts import SunSpec
from terrain.scene import Scene, build_scene

Time = datetime.datetime | np.datetime64 | str


class OpenLevel:
    """A level's scene. To be closed, or used by ``with``; not to be shared between threads.

    Arrays on its own cells, or on those of another raster, have that raster's order; all others have row 0 in the north.
    """

    def __init__(self, scene: Scene, held: MemoryFile | None = None) -> None:
        self._scene = scene
        self._held = held
        self._own = raster_view(scene)
        self._served: TileService | None = None
        self._folder: TemporaryDirectory[str] | None = None

    @property
    def name(self) -> str:
        """Its name."""
        return self._scene.loaded.name

    @property
    def path(self) -> Path:
        """The file that it was opened from."""
        return self._scene.loaded.path

    @property
    def warnings(self) -> tuple[str, ...]:
        """What was noticed when it was opened, as a collar that the raster does not declare."""
        return self._scene.warnings

    @property
    def crs(self) -> CRS:
        """The CRS of its own grid."""
        return self._own.crs

    @property
    def transform(self) -> Affine:
        """The geotransform of its own grid."""
        return self._own.transform

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of its own grid."""
        return self._own.shape

    def render(
        self,
        view: str = "map",
        layer: str = "color",
        *,
        time: Time | None = None,
        azimuth: float | None = None,
        altitude: float | None = None,
        size: tuple[int, int] | None = None,
        bounds: Bounds | None = None,
        crs: str | None = None,
        seconds: float | None = None,
        style: str | None = None,
        slope_exaggeration: float | None = None,
        **shadows: Any,
    ) -> np.ndarray:
        """A layer of one of the level's views: uint8 (rows, cols, 4) of ``color`` and ``shadow``, (rows, cols) of ``mask``; else as
        ``skugga render --help`` tells.

        The sun is that of a ``time`` (with an offset from UTC, or datetime64 in UTC), or of ``azimuth`` and ``altitude``, degrees;
        else the level's own. ``size`` is (columns, rows); ``bounds`` are west, south, east, north in ``crs``. ``style`` is a named
        one, ``slope_exaggeration`` multiplies slopes in shading alone. ``shadows`` are the keys of a level's ``shadows``, as
        ``algorithm="shadow_volume"``. Raises ``SkuggaError``.
        """
        scene = self._scene.with_sun(_sun(time, azimuth, altitude)).with_style(style, slope_exaggeration).at_second(seconds)
        seen = scene.view(view, bounds, crs, size)
        device = calibration_for(scene.loaded.level.shadows, shadows)
        plan = plan_of_view(scene, seen, view, shadows, device=device)
        kept = frozenset(pass_layer for pass_layer in PASS_LAYERS if pass_layer == layer)
        return frame_layer(scene, render_frame(scene, seen, plan, None, kept), layer)

    def film(
        self,
        view: str = "map",
        *,
        start: Time | None = None,
        end: Time | None = None,
        step: str | None = None,
        path: Path | None = None,
        fps: float = USUAL_FPS,
        time: Time | None = None,
        azimuth: float | None = None,
        altitude: float | None = None,
        size: tuple[int, int] | None = None,
        bounds: Bounds | None = None,
        crs: str | None = None,
        seconds: float | None = None,
        style: str | None = None,
        slope_exaggeration: float | None = None,
        **shadows: Any,
    ) -> Iterator[np.ndarray]:
        """The pictures of a film, uint8 (rows, cols, 3), each drawn when it is taken; all are looked at before this returns.

        ``start`` and ``end`` are times (with an offset from UTC, or datetime64 in UTC), between which the sun moves, or readings of
        the level's clock as ``0s``, under a sun that rests; ``step`` is what lies between two pictures, as ``10m``. ``path`` is a
        camera file: a camera that moves. ``fps`` pictures a second make the step of a film that plays at its own pace. The rest is
        as in ``render``. Raises ``SkuggaError``.
        """
        way = None if path is None else load_camera_path(path)
        span = film_span(_iso(start), _iso(end), step, fps, way, seconds)
        scene = self._scene.with_sun(_sun(time, azimuth, altitude)).with_style(style, slope_exaggeration)
        request = FilmRequest(span, view, way, size, bounds, crs, shadows)
        moments = frame_moments(scene, request)
        replanner = Replanner(device=calibration_for(scene.loaded.level.shadows, shadows))
        return (frame.color for frame in film_frames(scene, request, moments, replanner))

    def shade(
        self,
        layer: str = "mask",
        *,
        time: Time | None = None,
        azimuth: float | None = None,
        altitude: float | None = None,
        bounds: Bounds | None = None,
        crs: str | None = None,
        resolution: float | None = None,
        like: Path | None = None,
        **shadows: Any,
    ) -> np.ndarray:
        """A raster of shade on the level's own cells, those of ``like``, or square ones of a ``resolution`` in ``crs``.

        It is one of ``api.shade_layers.SHADE_LAYERS``: (rows, cols), or (rows, cols, 4) of ``color`` and ``shadow``. The sun is as
        in ``render``.

        Raises ``SkuggaError``.
        """
        raster = raster_view(self._scene, bounds, crs, resolution, like)
        return shade_array(self._scene, raster, layer, _sun(time, azimuth, altitude), shadows)

    def sun_hours(
        self,
        date: datetime.date | str,
        *,
        to: datetime.date | str | None = None,
        every_days: int = 1,
        window: str = "00:00-24:00",
        clock: str = "solar",
        quantity: str = "hours",
        step_min: float | None = None,
        threshold_h: float = 2.0,
        least_altitude: float = 0.0,
        height: float = 0.0,
        bounds: Bounds | None = None,
        crs: str | None = None,
        resolution: float | None = None,
        like: Path | None = None,
    ) -> np.ndarray:
        """How long the sun is seen, float32 (rows, cols), NaN where there is no surface: ``hours`` (the mean of the dates),
        ``first`` or ``last`` sun (minutes from midnight by the clock), the ``longest`` spell (hours) or the number of ``days``
        with at least ``threshold_h`` hours.

        Counted is sun at least ``least_altitude`` degrees high, seen from ``height`` metres above the ground, in a daily
        ``window`` of the dates from ``date`` to ``to``. ``clock`` is ``solar``, ``utc``, an offset or a zone as ``Europe/Oslo``;
        the sun is looked for every ``step_min`` minutes (``None``: as often as hours need to be right on that ground), and
        crossings in between are found. Cells are as in ``shade``. Raises ``SkuggaError``.
        """
        first = _day("date", date)
        last = first if to is None else _day("to", to)
        windows = windows_asked(self._scene.world, first, last, every_days, readings_of(window), clock_named("clock", clock))
        rules = SunRules(step_min, threshold_h, least_altitude, height)
        return sun_hours_array(self._scene, raster_view(self._scene, bounds, crs, resolution, like), windows, rules, quantity)

    def point(
        self,
        lon: float,
        lat: float,
        *,
        time: Time | None = None,
        date: datetime.date | str | None = None,
        clock: str | None = None,
        height: float = 0.0,
        year: int | None = None,
        crs: Any = None,
    ) -> PointReport:
        """The sun at a point, ``height`` metres above the ground: now (``time``), on a day, and on each day of a year. With a
        ``crs``, as pyproj takes it, ``lon`` and ``lat`` are x and y of it. Raises ``SkuggaError``.
        """
        scene = self._scene.with_sun(_sun(time, None, None))
        day = None if date is None else _day("date", date)
        query = PointQuery(lon=lon, lat=lat, height=height, date=day, clock=clock, year=year)
        return point_report(scene, query, None if crs is None else CRS.from_user_input(crs))

    def horizon(self, lon: float, lat: float, *, height: float = 0.0, crs: Any = None) -> PointHorizon:
        """The horizon of a point in 720 directions, by ground, buildings and trees: ``azimuth_deg`` clockwise from true north, and
        ``elevation_deg``. The point is as in ``point``. Raises ``SkuggaError``.
        """
        query = PointQuery(lon=lon, lat=lat, height=height)
        return horizon_round(around_point(self._scene, query, None if crs is None else CRS.from_user_input(crs)))

    def as_leaflet_layer(
        self,
        layer: str = "color",
        *,
        time: Time | None = None,
        azimuth: float | None = None,
        altitude: float | None = None,
        **shadows: Any,
    ) -> Any:
        """The level as a layer of an ipyleaflet map, served by a process on this machine: ``map.add(level)`` calls it.

        ``layer`` is ``color``, ``shadow`` (to lie over another map) or ``mask``; the sun and ``shadows`` are as in ``render``.
        Raises ``SkuggaError``, and ``ImportError`` without ipyleaflet.
        """
        from ipyleaflet import TileLayer

        spec = _sun(time, azimuth, altitude)
        sun = {} if spec is None else spec.model_dump(mode="json", exclude_none=True)
        query = {key: value for key, value in {"layer": layer, **sun, **shadows}.items() if value is not None}
        said = self._service().tile_json(urlencode(query))
        return TileLayer(
            url=said["tiles"][0], name=self.name, attribution=said.get("attribution", ""), max_zoom=24,
            min_zoom=said["minzoom"], max_native_zoom=said["maxzoom"],
        )  # fmt: skip

    def _service(self) -> TileService:
        if self._served is None:
            path = self.path
            if self._held is not None:  # memory that another process cannot read
                self._folder = TemporaryDirectory(prefix="skugga-")
                path = Path(self._folder.name) / "heights.tif"
                path.write_bytes(self._held.getbuffer())
            self._served = TileService(path)
        return self._served

    def close(self) -> None:
        """Close its files, and end its tile service."""
        if self._served is not None:
            self._served.close()
        if self._folder is not None:
            self._folder.cleanup()
        self._scene.close()
        if self._held is not None:
            self._held.close()

    def __enter__(self) -> OpenLevel:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


def open_level(
    source: str | Path,
    *,
    canopy: Path | None = None,
    buildings: Path | None = None,
    nodata: float | None = None,
    units: str | None = None,
) -> OpenLevel:
    """Open a level: a bundled one by its name, a level file, or a raster of heights, if wanted with ``canopy`` heights or trees,
    footprints of ``buildings``, the value of cells without a height, and the unit of heights (``m``, ``ft`` or ``us-ft``). Raises
    ``SkuggaError``.
    """
    path = find_level(str(source))
    return OpenLevel(
        build_scene(
            load_level(LevelSource(path=path, canopy=canopy, buildings=buildings, nodata=nodata, units=units_named("units", units)))
        )
    )


def open_heights(height_m: np.ndarray, transform: Affine, crs: Any) -> OpenLevel:
    """Open an array of heights (rows, cols), metres, NaN where there is no ground, as a level: its geotransform, and its CRS as
    pyproj takes it. Raises ``SkuggaError``, and ``ValueError`` for heights that are no grid.
    """
    height_m = np.asarray(height_m, np.float32)
    if height_m.ndim != 2:
        raise ValueError(f"height_m has the shape {height_m.shape}; it must be (rows, cols)")
    held = MemoryFile(ext=".tif")
    try:
        with held.open(
            driver="GTiff", height=height_m.shape[0], width=height_m.shape[1], count=1, dtype="float32", nodata=float("nan"),
            crs=CRS.from_user_input(crs).to_wkt(), transform=transform,
        ) as dataset:  # fmt: skip
            dataset.write(height_m, 1)
        return OpenLevel(build_scene(load_level(held.name)), held)
    except BaseException:
        held.close()
        raise


def _sun(time: Time | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    return parse_sun(_iso(time), azimuth, altitude)


def _iso(time: Time | None) -> str | None:
    if isinstance(time, np.datetime64):
        return f"{np.datetime_as_string(time, unit='s')}Z"
    return time.isoformat() if isinstance(time, datetime.datetime) else time


def _day(name: str, day: datetime.date | str) -> datetime.date:
    return date_of(name, day) if isinstance(day, str) else day
