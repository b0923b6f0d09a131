"""Compute pictures and rasters of an open level as arrays."""

from __future__ import annotations

import datetime
import re
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
from skugga.api.film_span import DEFAULT_FPS, film_span
from skugga.api.library.caller_warnings import warn_caller
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
from skugga.api.point.report import point_report, point_surroundings
from skugga.api.point.values import PointQuery, PointReport
from skugga.api.products import PRODUCTS, RASTER_PRODUCTS, product_named
from skugga.api.raster_view import RasterView, extent_warning, raster_view
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

ARRAY_NAME = "the array"
"""Name of a raster in memory, for messages."""

ARRAY_REMEDIES = {
    "nodata": "set those cells to NaN", "units": "convert the heights to metres", "positive": "negate the depths",
}  # fmt: skip
"""Remedies for a raster in memory, by the option that a file would need."""

_FILE_REMEDY = re.compile(
    r"write terrain: \{(\w+): [^}]*\} \(without a level file: [^)]*\)(?:\. UNIT is one of [\w-]+(?:, [\w-]+)*)?"
)

SHADED_PRODUCTS = tuple(name for name in RASTER_PRODUCTS if PRODUCTS[name].when == "sun")
"""Raster products that depend on the sun of a moment."""

PART_REMEDY = "Use a part, as cells=np.s_[:4096, :4096], or a file: `skugga shade` and `skugga sunhours` write rasters of any size"


class OpenLevel:
    """An open level, which computes pictures and rasters as arrays.

    Close it, or use it in a ``with`` statement. Do not share it between threads. Arrays on the cells of the level's raster, or of
    another raster, have that raster's order of rows and columns. All other arrays have row 0 in the north.

    Examples
    --------
    >>> import numpy as np
    >>> import skugga
    >>> heights = np.zeros((4, 5), np.float32)
    >>> with skugga.open_heights(heights, (30.0, 0.0, 500000.0, 0.0, -30.0, 5200000.0), "EPSG:32633") as level:
    ...     level.shape
    (4, 5)
    """

    def __init__(self, scene: Scene, source: LevelSource, memory_file: MemoryFile | None = None) -> None:
        self._open: Scene | None = scene
        self._source = source
        self._memory_file = memory_file
        self._own_raster = raster_view(scene)
        self._tile_service: TileService | None = None
        self._folder: TemporaryDirectory[str] | None = None
        self._has_warned_of_objects = False

    @property
    def _scene(self) -> Scene:
        if self._open is None:
            raise InputError("level", Problem("it is closed"), "Open it again")
        return self._open

    @property
    def name(self) -> str:
        """The name of the level."""
        return self._scene.loaded.name

    @property
    def path(self) -> Path:
        """The file of the level."""
        return self._scene.loaded.path

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings from opening the level, for example of a border without data that the raster does not declare."""
        return self._scene.warnings

    @property
    def crs(self) -> CRS:
        """The CRS of the level's own grid."""
        return self._own_raster.crs

    @property
    def transform(self) -> Affine:
        """The geotransform of the level's own grid."""
        return self._own_raster.transform

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the level's own grid."""
        return self._own_raster.shape

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
        """Render a layer of a view of the level.

        Parameters
        ----------
        view
            The name of a view.
        layer
            The layer: ``color``, ``shadow``, ``mask`` or another one that ``skugga render --help`` lists.
        time
            The time of the sun, with an offset from UTC, or datetime64 in UTC.
        azimuth, altitude
            The direction of the sun in degrees, instead of ``time``. The default is the level's own sun.
        size
            (columns, rows) of the picture.
        bounds
            West, south, east and north in ``crs``.
        crs
            The CRS, in any form that pyproj accepts.
        seconds
            The time on the clock of moving objects; default: the level's.
        style
            The name of a style.
        slope_exaggeration
            Factor by which slopes are exaggerated, in shading only.
        **shadows
            Keys of a level's ``shadows``, as ``algorithm="shadow_volume"``.

        Returns
        -------
        numpy.ndarray
            uint8 (rows, cols, 4) for ``color`` and ``shadow``, uint8 (rows, cols) for ``mask``. ``skugga render --help`` describes
            the others.

        Raises
        ------
        SkuggaError
            For a wrong argument, or if rendering fails.
        """
        scene = self._scene.with_sun(_sun(time, azimuth, altitude)).with_style(style, slope_exaggeration).at_second(seconds)
        product, rendered_view = product_named(layer), scene.view(view, bounds, _crs_text(crs), size)
        self._warn_of_objects()
        plan = plan_for(scene, rendered_view, view, product, shadows)
        return compute(scene, rendered_view, ProductRequest(product=layer), plan).array

    @checked
    def film(
        self,
        view: str = "map",
        *,
        start: Time | None = None,
        end: Time | None = None,
        step: str | None = None,
        path: Path | None = None,
        fps: float = DEFAULT_FPS,
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
        """Return an iterator of the pictures of a film.

        All pictures are checked before this returns. Each one is drawn when the iterator reaches it.

        Parameters
        ----------
        view
            The name of a view.
        start, end
            Times of a moving sun, with an offset from UTC, or datetime64 in UTC. For a fixed sun: readings of the level's clock,
            as ``0s``.
        step
            The time between two pictures, as ``10m``.
        path
            A camera file, for a moving camera.
        fps
            Pictures per second. Without ``step``, a film with clock readings has ``1 / fps`` seconds between pictures.
        time, azimuth, altitude, size, bounds, crs, seconds, style, slope_exaggeration, **shadows
            As in ``render``.

        Returns
        -------
        Iterator[numpy.ndarray]
            Pictures, uint8 (rows, cols, 3).

        Raises
        ------
        SkuggaError
            For a wrong argument, or if drawing fails.
        """
        camera_path = None if path is None else load_camera_path(path)
        span = film_span(_iso(start), _iso(end), step, fps, camera_path, seconds)
        scene = self._scene.with_sun(_sun(time, azimuth, altitude)).with_style(style, slope_exaggeration)
        request = FilmRequest(span, view, camera_path, size, bounds, _crs_text(crs), shadows)
        moments = frame_moments(scene, request)
        self._warn_of_objects()
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
        """Compute a raster of shadow or light for a moment.

        The default cells are the level's own.

        Parameters
        ----------
        layer
            ``mask``, ``visibility``, ``cosi``, ``color`` or ``shadow``.
        time, azimuth, altitude
            The sun, as in ``render``.
        bounds
            West, south, east and north in ``crs``.
        crs
            The CRS of the cells, in any form that pyproj accepts.
        resolution
            The side of square cells, in units of ``crs``.
        like
            A raster file whose cells are used.
        cells
            Slices of the level's own rows and columns (``shape``), as ``np.s_[:512, 512:1024]``.
        **shadows
            Keys of a level's ``shadows``.

        Returns
        -------
        numpy.ndarray
            (rows, cols), or (rows, cols, 4) for ``color`` and ``shadow``.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        product_named(layer, SHADED_PRODUCTS)
        request = ProductRequest(product=layer, sun=_sun(time, azimuth, altitude))
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), shadows)

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
        """Compute any product as a raster, by its name.

        Parameters
        ----------
        product
            The name of the product: ``mask``, ``height``, ``sunhours``, ...
        time, azimuth, altitude, bounds, crs, resolution, like, cells
            As in ``shade``.
        **options
            Options of the product, as ``date="2024-03-21"`` of ``sunhours``. A product with shadows also takes the keys of a
            level's ``shadows``.

        Returns
        -------
        numpy.ndarray
            (rows, cols) or (rows, cols, bands).

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        product_record = product_named(product, RASTER_PRODUCTS, "product")
        shadows = {name: value for name, value in options.items() if product_record.needs and name in Shadows.model_fields}
        product_options = {name: value for name, value in options.items() if name not in shadows}
        request = ProductRequest(
            product=product, options=product_record.options_of(product_options), sun=_sun(time, azimuth, altitude)
        )
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), shadows)

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
        """Compute hours of direct sun, or another quantity of direct sun, as a raster.

        Parameters
        ----------
        date
            The date, or the first of several dates.
        to
            The last of several dates.
        every_days
            Days between two of several dates.
        window
            The part of each date that counts, as ``08:00-16:00``.
        clock
            The clock of date and window: ``solar``, ``utc``, an offset, or a zone such as ``Europe/Oslo``.
        quantity
            ``hours`` (mean of the dates), ``first`` or ``last`` (sun of any date, minutes from midnight by the clock), ``longest``
            (longest unbroken sun, hours), or ``days`` (number of days with at least ``threshold_h`` hours of sun).
        step_min
            Minutes between two tested suns; ``None``: as short as accurate hours need on this ground. Crossings of the horizon
            between two suns are interpolated.
        threshold_h
            Hours of sun from which a day counts.
        least_altitude
            The smallest altitude of a sun that counts, in degrees.
        height
            Height of the observer above the ground in metres.
        bounds, crs, resolution, like, cells
            As in ``shade``.

        Returns
        -------
        numpy.ndarray
            float32 (rows, cols), NaN without a surface.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        options = {
            "date": date, "to": to, "every_days": every_days, "window": window, "clock": clock, "quantity": quantity,
            "step_min": step_min, "threshold_h": threshold_h, "least_altitude": least_altitude, "height": height,
        }  # fmt: skip
        request = ProductRequest(product="sunhours", options=product_named("sunhours").options_of(options))
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), {})

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
        """Report the sun at a point: at a time, on a day, and on each day of a year.

        Parameters
        ----------
        lon, lat
            The point in degrees, or its x and y in ``crs``.
        time
            The time, as in ``render``.
        date
            The day.
        clock
            The clock of the day, as in ``sun_hours``.
        height
            Metres above the ground.
        year
            A year, for the hours of sun of each of its days.
        crs
            The CRS of ``lon`` and ``lat``, in any form that pyproj accepts.

        Returns
        -------
        PointReport
            The report.

        Raises
        ------
        SkuggaError
            For a wrong argument.
        """
        scene = self._scene.with_sun(_sun(time, None, None))
        query = PointQuery(lon=lon, lat=lat, height=height, date=cast("datetime.date | None", date), clock=clock, year=year)
        self._warn_of_objects()
        return point_report(scene, query, crs)

    @checked
    def horizon(self, lon: float, lat: float, *, height: float = 0.0, crs: AnyCrs | None = None) -> PointHorizon:
        """Return the horizon profile of a point in 720 directions, from ground, buildings and trees.

        Parameters
        ----------
        lon, lat, height, crs
            The point, as in ``point``.

        Returns
        -------
        PointHorizon
            ``azimuth_deg``, clockwise from true north, and ``elevation_deg``.

        Raises
        ------
        SkuggaError
            For a wrong argument.
        """
        query = PointQuery(lon=lon, lat=lat, height=height)
        self._warn_of_objects()
        return horizon_profile(point_surroundings(self._scene, query, crs))

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
        """Return the level as a layer of an ipyleaflet map. ``map.add(level)`` calls this method.

        A process on this machine serves the tiles.

        Parameters
        ----------
        layer
            ``color``, ``shadow`` (an overlay for another map) or ``mask``.
        time, azimuth, altitude, **shadows
            As in ``render``.

        Returns
        -------
        ipyleaflet.TileLayer
            The layer.

        Raises
        ------
        SkuggaError
            For a wrong argument, or if the tile service does not start.
        ImportError
            Without ipyleaflet.
        """
        from ipyleaflet import TileLayer

        spec = _sun(time, azimuth, altitude)
        sun = {} if spec is None else spec.model_dump(mode="json", exclude_none=True)
        query = {key: value for key, value in {"layer": layer, **sun, **shadows}.items() if value is not None}
        tile_json = self._service().tile_json(urlencode(query))
        return TileLayer(
            url=tile_json["tiles"][0], name=self.name, attribution=tile_json.get("attribution", ""), max_zoom=24,
            min_zoom=tile_json["minzoom"], max_native_zoom=tile_json["maxzoom"],
        )  # fmt: skip

    def _compute_raster(
        self,
        request: ProductRequest,
        grid: tuple[Bounds | None, CRS | None, float | None, Path | None, tuple[slice, slice] | None],
        shadows: dict[str, Any],
    ) -> np.ndarray:
        """Compute a raster for a request. ``grid`` holds bounds, CRS, resolution, raster file and slices of cells."""
        product = request.product_record
        raster = self._raster(*grid, np.dtype(product.dtype).itemsize * product.bands)
        self._warn_of_objects()
        return raster_array(self._scene, raster, request, shadows)

    def _raster(
        self,
        bounds: Bounds | None,
        crs: CRS | None,
        resolution: float | None,
        like: Path | None,
        cells: tuple[slice, slice] | None,
        bytes_per_cell: int,
    ) -> RasterView:
        """Return the cell grid of an array. Raises ``InputError`` for an array that does not fit into memory."""
        if cells is None:
            raster = raster_view(self._scene, bounds, _crs_text(crs), resolution, like)
            if like is not None and (text := extent_warning(self._scene, raster)) is not None:
                warn_caller(text)
        else:
            for name, value in (("bounds", bounds), ("crs", crs), ("resolution", resolution), ("like", like)):
                if value is not None:
                    raise InputError.conflict(name, "cells", "Use one of them; cells are the level's own")
            (top, bottom, _), (left, right, _) = (part.indices(count) for part, count in zip(cells, self.shape, strict=True))
            if top >= bottom or left >= right:
                raise InputError("cells", cells, f"rows and columns of the level's own {self.shape[0]} x {self.shape[1]}")
            raster = self._own_raster.cells(top, left, bottom - top, right - left)
        check_memory("cells" if resolution is None else "resolution", *raster.shape, bytes_per_cell, PART_REMEDY)
        return raster

    def _warn_of_objects(self) -> None:
        """Issue the warnings about objects once, before the first result. The files of the objects are then read."""
        if not self._has_warned_of_objects:
            texts, self._has_warned_of_objects = self._scene.objects.warnings, True
            for text in texts:
                warn_caller(text)

    def _service(self) -> TileService:
        if self._tile_service is None:
            source = self._source
            if self._memory_file is not None:  # another process cannot read this memory
                self._folder = TemporaryDirectory(prefix="skugga-")
                path = Path(self._folder.name) / "heights.tif"
                path.write_bytes(self._memory_file.getbuffer())
                source = source.model_copy(update={"path": path})
            self._tile_service = TileService(source)
        return self._tile_service

    def close(self) -> None:
        """Close the files and end the tile service."""
        if self._tile_service is not None:
            self._tile_service.close()
        if self._folder is not None:
            self._folder.cleanup()
        if self._open is not None:
            self._open.close()
            self._open = None
        if self._memory_file is not None:
            self._memory_file.close()

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
    """Open a level: a bundled level, a level file, or a raster of heights.

    Ground that looks wrong, for example an undeclared nodata value, causes a ``UserWarning``. So do files of trees and buildings
    that look wrong, at the first result.

    Parameters
    ----------
    source
        The name of a bundled level, or the path of a level file or a raster.
    canopy
        A file of canopy heights or trees, for a raster.
    buildings
        A file of footprints of buildings, for a raster.
    nodata
        The value of cells without a height.
    units
        The unit of heights: ``m``, ``ft``, ``us-ft``, ...
    positive
        Whether heights grow ``up`` or ``down``.

    Returns
    -------
    OpenLevel
        The level, to be closed or used in a ``with`` statement.

    Raises
    ------
    SkuggaError
        For a wrong argument or file.
    """
    vertical_axis = {"units": parse_units("units", units), "positive": parse_positive("positive", positive)}
    level = LevelSource(path=find_level(str(source)), canopy=canopy, buildings=buildings, nodata=nodata, **vertical_axis)
    return level_of_source(level)


@checked
def open_heights(height_m: Heights, transform: Transform, crs: AnyCrs) -> OpenLevel:
    """Open an array of heights as a level. Heights that look wrong cause a ``UserWarning``.

    Parameters
    ----------
    height_m
        Heights (rows, cols) in metres. Cells are without ground if they are masked, not finite, or beyond a million metres.
    transform
        The geotransform, or its six numbers.
    crs
        The CRS, in any form that pyproj accepts.

    Returns
    -------
    OpenLevel
        The level, to be closed or used in a ``with`` statement.

    Raises
    ------
    SkuggaError
        For a wrong argument.
    """
    return level_of_heights(cast(np.ndarray, height_m), transform, crs)


def level_of_heights(heights: np.ndarray, transform: Affine, crs: CRS) -> OpenLevel:
    """Open a grid of heights in metres (``grid_of_heights``) as a level and issue the ground's warnings. Raises ``InputError``."""
    memory_file = MemoryFile(filename="heights.tif")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # load_level raises an error for it
            with memory_file.open(
                driver="GTiff", height=heights.shape[0], width=heights.shape[1], count=1, dtype="float32", nodata=float("nan"),
                crs=crs.to_wkt(), transform=transform, bigtiff="if_safer",
            ) as dataset:  # fmt: skip
                dataset.write(heights, 1)
        # Heights are metres and grow upwards, whatever the vertical axis of the CRS says.
        source = LevelSource(path=Path(memory_file.name), units="m", positive="up")
        return level_of_source(source, ARRAY_NAME, memory_file)
    except InputError as error:
        memory_file.close()
        error.name = error.name.replace(memory_file.name, ARRAY_NAME)
        error.args = (str(error).replace(memory_file.name, ARRAY_NAME),)
        raise
    except BaseException:
        memory_file.close()
        raise


def level_of_source(source: LevelSource, ground_name: str | None = None, memory_file: MemoryFile | None = None) -> OpenLevel:
    """Open a level and issue the warnings about its ground under a name; ``None`` for that of its raster. Raises ``InputError``."""
    level = OpenLevel(build_scene(load_level(source)), source, memory_file)
    for text in level.warnings:
        if ground_name is None:
            warn_caller(f"{level._scene.elevation.name}: {text}")
        else:
            warn_caller(f"{ground_name}: {_FILE_REMEDY.sub(lambda match: ARRAY_REMEDIES[match[1]], text)}")
    return level


def _crs_text(crs: CRS | None) -> str | None:
    return None if crs is None else crs.srs


def _sun(time: Time | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    return parse_sun(_iso(time), azimuth, altitude)


def _iso(time: Time | None) -> str | None:
    return cast("str | None", time)  # ``Time`` converts it to text
