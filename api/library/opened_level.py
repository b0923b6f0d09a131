"""A level that is open: pictures and rasters of it as arrays, one after the other."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, cast
from urllib.parse import urlencode

import numpy as np
from affine import Affine
from pyproj import CRS
from rasterio.errors import NotGeoreferencedWarning
from rasterio.io import MemoryFile

from skugga.api.catalogue import find_level
from skugga.api.compute import compute, plan_for, raster_array
from skugga.api.device_calibration import calibration_for
from skugga.api.film_span import USUAL_FPS, film_span
from skugga.api.library.checked import (
    AltitudeDeg,
    AnyCrs,
    AzimuthDeg,
    Bounds,
    Cells,
    Date,
    Days,
    HeightM,
    LeastAltitudeDeg,
    Resolution,
    Size,
    StepMinutes,
    ThresholdHours,
    Time,
    Transform,
    checked,
)
from skugga.api.library.grids import Heights
from skugga.api.library.memory import check_memory
from skugga.api.library.tile_service import TileService
from skugga.api.point.report import around_point, point_report
from skugga.api.point.values import PointQuery, PointReport
from skugga.api.products import PRODUCTS, RASTER_PRODUCTS, product_named
from skugga.api.raster_view import RasterView, raster_view
from skugga.api.request import ProductRequest
from skugga.selector.film import film_frames, frame_moments
from skugga.selector.film_request import FilmRequest
from skugga.selector.replanning import Replanner
from skugga.shadows.point.horizon import PointHorizon, horizon_profile
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.camera_file import load_camera_path
from skugga.terrain.level.level import Shadows, load_level, parse_sun
from skugga.terrain.level.level_source import LevelSource, parse_positive, parse_units
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

ARRAY = "the array"
"""Name of a raster in memory in messages."""

SHADED_PRODUCTS = tuple(name for name in RASTER_PRODUCTS if PRODUCTS[name].when == "sun")
"""Products of the sun of a moment."""

SMALLER_PART = "a part, as cells=np.s_[:4096, :4096]; or a file: `skugga shade` and `skugga sunhours` write rasters of any size"


class OpenLevel:
    """A level's scene. To be closed, or used by ``with``; not to be shared between threads.

    Arrays on its own cells, or on those of another raster, have that raster's order; all others have row 0 in the north.
    """

    def __init__(self, scene: Scene, held: MemoryFile | None = None) -> None:
        self._open: Scene | None = scene
        self._held = held
        self._own = raster_view(scene)
        self._served: TileService | None = None
        self._folder: TemporaryDirectory[str] | None = None

    @property
    def _scene(self) -> Scene:
        if self._open is None:
            raise InputError("level", Problem("it is closed"), "a level that is open")
        return self._open

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

    @checked
    def render(
        self,
        view: str = "map",
        layer: str = "color",
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        size: Size | None = None,
        bounds: Bounds | None = None,
        crs: AnyCrs | None = None,
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
        product, seen = product_named(layer), scene.view(view, bounds, _named(crs), size)
        plan = plan_for(scene, seen, view, product, shadows)
        return compute(scene, seen, ProductRequest(product=layer), plan).array

    @checked
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
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        size: Size | None = None,
        bounds: Bounds | None = None,
        crs: AnyCrs | None = None,
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
        request = FilmRequest(span, view, way, size, bounds, _named(crs), shadows)
        moments = frame_moments(scene, request)
        replanner = Replanner(device=calibration_for(scene.loaded.level.shadows, shadows))
        return (frame.color for frame in film_frames(scene, request, moments, replanner))

    @checked
    def shade(
        self,
        layer: str = "mask",
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        bounds: Bounds | None = None,
        crs: AnyCrs | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
        **shadows: Any,
    ) -> np.ndarray:
        """A raster of shade on the level's own cells, those of ``like``, or square ones of a ``resolution`` in ``crs``.

        ``layer`` is ``mask``, ``visibility``, ``cosi``, ``color`` or ``shadow``. Arrays are (rows, cols), or (rows, cols, 4) of the
        last two. The sun is as in ``render``. ``cells`` are rows and columns of the level's own (``shape``), as
        ``np.s_[:512, 512:1024]``.

        Raises ``SkuggaError``, also for arrays that do not fit into memory.
        """
        product_named(layer, SHADED_PRODUCTS)
        request = ProductRequest(product=layer, sun=_sun(time, azimuth, altitude))
        return self._computed(request, (bounds, crs, resolution, like, cells), shadows)

    @checked
    def compute(
        self,
        product: str,
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        bounds: Bounds | None = None,
        crs: AnyCrs | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
        **options: Any,
    ) -> np.ndarray:
        """Compute any product as a raster (rows, cols) or (rows, cols, bands), by its name: ``mask``, ``height``, ``sunhours``, ...

        ``options`` are those of the product, as ``date="2024-03-21"`` of ``sunhours``; of one that shows shadows also the keys of a
        level's ``shadows``. Sun and cells are as in ``shade``. Raises ``SkuggaError``, also for arrays that do not fit into memory.
        """
        named = product_named(product, RASTER_PRODUCTS, "product")
        shadows = {name: value for name, value in options.items() if named.needs and name in Shadows.model_fields}
        own = {name: value for name, value in options.items() if name not in shadows}
        request = ProductRequest(product=product, options=named.options_of(own), sun=_sun(time, azimuth, altitude))
        return self._computed(request, (bounds, crs, resolution, like, cells), shadows)

    @checked
    def sun_hours(
        self,
        date: Date,
        *,
        to: Date | None = None,
        every_days: Days = 1,
        window: str = "00:00-24:00",
        clock: str = "solar",
        quantity: str = "hours",
        step_min: StepMinutes | None = None,
        threshold_h: ThresholdHours = 2.0,
        least_altitude: LeastAltitudeDeg = 0.0,
        height: HeightM = 0.0,
        bounds: Bounds | None = None,
        crs: AnyCrs | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
    ) -> np.ndarray:
        """How long the sun is seen, float32 (rows, cols), NaN where there is no surface: ``hours`` (the mean of the dates),
        ``first`` or ``last`` sun (minutes from midnight by the clock), the ``longest`` spell (hours) or the number of ``days``
        with at least ``threshold_h`` hours.

        Counted is sun at least ``least_altitude`` degrees high, seen from ``height`` metres above the ground, in a daily
        ``window`` of the dates from ``date`` to ``to``. ``clock`` is ``solar``, ``utc``, an offset or a zone as ``Europe/Oslo``;
        the sun is looked for every ``step_min`` minutes (``None``: as often as hours need to be right on that ground), and
        crossings in between are found. Cells are as in ``shade``. Raises ``SkuggaError``.
        """
        options = {
            "date": date, "to": to, "every_days": every_days, "window": window, "clock": clock, "quantity": quantity,
            "step_min": step_min, "threshold_h": threshold_h, "least_altitude": least_altitude, "height": height,
        }  # fmt: skip
        request = ProductRequest(product="sunhours", options=product_named("sunhours").options_of(options))
        return self._computed(request, (bounds, crs, resolution, like, cells), {})

    @checked
    def point(
        self,
        lon: float,
        lat: float,
        *,
        time: Time | None = None,
        date: Date | None = None,
        clock: str | None = None,
        height: float = 0.0,
        year: int | None = None,
        crs: AnyCrs | None = None,
    ) -> PointReport:
        """The sun at a point, ``height`` metres above the ground: now (``time``), on a day, and on each day of a year. With a
        ``crs``, as pyproj takes it, ``lon`` and ``lat`` are x and y of it. Raises ``SkuggaError``.
        """
        scene = self._scene.with_sun(_sun(time, None, None))
        query = PointQuery(lon=lon, lat=lat, height=height, date=cast("datetime.date | None", date), clock=clock, year=year)
        return point_report(scene, query, crs)

    @checked
    def horizon(self, lon: float, lat: float, *, height: float = 0.0, crs: AnyCrs | None = None) -> PointHorizon:
        """The horizon of a point in 720 directions, by ground, buildings and trees: ``azimuth_deg`` clockwise from true north, and
        ``elevation_deg``. The point is as in ``point``. Raises ``SkuggaError``.
        """
        query = PointQuery(lon=lon, lat=lat, height=height)
        return horizon_profile(around_point(self._scene, query, crs))

    @checked
    def as_leaflet_layer(
        self,
        layer: str = "color",
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
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

    def _computed(
        self,
        request: ProductRequest,
        place: tuple[Bounds | None, CRS | None, float | None, Path | None, tuple[slice, slice] | None],
        shadows: dict[str, Any],
    ) -> np.ndarray:
        """Compute a raster by a request."""
        product = request.record
        raster = self._raster(*place, np.dtype(product.dtype).itemsize * product.bands)
        return raster_array(self._scene, raster, request, shadows)

    def _raster(
        self,
        bounds: Bounds | None,
        crs: CRS | None,
        resolution: float | None,
        like: Path | None,
        cells: tuple[slice, slice] | None,
        bytes_a_cell: int,
    ) -> RasterView:
        """The cells of an array that fits into memory."""
        if cells is None:
            raster = raster_view(self._scene, bounds, _named(crs), resolution, like)
        else:
            for name, value in (("bounds", bounds), ("crs", crs), ("resolution", resolution), ("like", like)):
                if value is not None:
                    raise InputError(name, value, "nothing beside cells: they are the level's own")
            (top, bottom, _), (left, right, _) = (part.indices(count) for part, count in zip(cells, self.shape, strict=True))
            if top >= bottom or left >= right:
                raise InputError("cells", cells, f"rows and columns of the level's own {self.shape[0]} x {self.shape[1]}")
            raster = self._own.cells(top, left, bottom - top, right - left)
        check_memory("cells" if resolution is None else "resolution", *raster.shape, bytes_a_cell, SMALLER_PART)
        return raster

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
        if self._open is not None:
            self._open.close()
            self._open = None
        if self._held is not None:
            self._held.close()

    def __enter__(self) -> OpenLevel:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@checked
def open_level(
    source: str | Path,
    *,
    canopy: Path | None = None,
    buildings: Path | None = None,
    nodata: float | None = None,
    units: str | None = None,
    positive: str | None = None,
) -> OpenLevel:
    """Open a level: a bundled one by its name, a level file, or a raster of heights, if wanted with ``canopy`` heights or trees,
    footprints of ``buildings``, the value of cells without a height, the unit of heights (``m``, ``ft``, ``us-ft``, ...), and
    whether they grow ``up`` or ``down``. Raises ``SkuggaError``.
    """
    stated = {"units": parse_units("units", units), "positive": parse_positive("positive", positive)}
    level = LevelSource(path=find_level(str(source)), canopy=canopy, buildings=buildings, nodata=nodata, **stated)
    return OpenLevel(build_scene(load_level(level)))


@checked
def open_heights(height_m: Heights, transform: Transform, crs: AnyCrs) -> OpenLevel:
    """Open an array of heights (rows, cols), metres, as a level: its geotransform, and its CRS as pyproj takes it.

    There is no ground where the array is masked, not finite, or beyond a million. Raises ``SkuggaError``.
    """
    return level_of_heights(cast(np.ndarray, height_m), transform, crs)


def level_of_heights(heights: np.ndarray, transform: Affine, crs: CRS) -> OpenLevel:
    """Open a grid of heights (``grid_of_heights``), metres, as a level. Raises ``InputError``."""
    held = MemoryFile(filename="heights.tif")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # refused with a sentence
            with held.open(
                driver="GTiff", height=heights.shape[0], width=heights.shape[1], count=1, dtype="float32", nodata=float("nan"),
                crs=crs.to_wkt(), transform=transform, bigtiff="if_safer",
            ) as dataset:  # fmt: skip
                dataset.write(heights, 1)
        # Heights are metres and grow upwards, whatever the vertical axis of the CRS says.
        source = LevelSource(path=Path(held.name), units="m", positive="up")
        return OpenLevel(build_scene(load_level(source)), held)
    except InputError as error:
        held.close()
        error.name = error.name.replace(held.name, ARRAY)
        error.args = (str(error).replace(held.name, ARRAY),)
        raise
    except BaseException:
        held.close()
        raise


def _named(crs: CRS | None) -> str | None:
    return None if crs is None else crs.srs


def _sun(time: Time | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    return parse_sun(_iso(time), azimuth, altitude)


def _iso(time: Time | None) -> str | None:
    return cast("str | None", time)  # by its type
