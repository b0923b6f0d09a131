"""Compute rasters of an open level: shadow and light, any product, and hours of sun."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from skugga.api.compute import raster_array
from skugga.api.library.argument_types import (
    AltitudeDeg,
    AzimuthCount,
    AzimuthDeg,
    Bounds,
    Cells,
    CrsLike,
    Date,
    DayCount,
    HeightM,
    MinAltitudeDeg,
    Resolution,
    Share,
    StepMinutes,
    ThresholdHours,
    Time,
    validate_arguments,
)
from skugga.api.library.caller_warnings import warn_caller
from skugga.api.library.level_state import LevelState, crs_text, requested_sun
from skugga.api.library.memory import check_memory
from skugga.api.products import PRODUCTS, RASTER_PRODUCTS, product_named
from skugga.api.raster_view import RasterView, extent_warning, raster_view
from skugga.api.request import ProductRequest
from skugga.shadows.horizons.azimuths import DEFAULT_AZIMUTHS, SkyViewKind
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import Shadows

SHADED_PRODUCTS = tuple(name for name in RASTER_PRODUCTS if PRODUCTS[name].when == "sun")
"""Raster products that depend on the sun of a moment."""

PART_REMEDY = (
    "Use a part, as cells=np.s_[:4096, :4096], or a file: `skugga shade`, `sunhours` and `compute` write rasters of any size"
)


class LevelRasters(LevelState):
    """The methods of ``OpenLevel`` that compute rasters."""

    @validate_arguments
    def shade(
        self,
        layer: str = "mask",
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
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
        request = ProductRequest(product=layer, sun=requested_sun(time, azimuth, altitude))
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), shadows)

    @validate_arguments
    def compute(
        self,
        product: str,
        *,
        time: Time | None = None,
        azimuth: AzimuthDeg | None = None,
        altitude: AltitudeDeg | None = None,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
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
            product=product, options=product_record.options_of(product_options), sun=requested_sun(time, azimuth, altitude)
        )
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), shadows)

    @validate_arguments
    def sun_hours(
        self,
        date: Date,
        *,
        to: Date | None = None,
        every_days: DayCount = 1,
        window: str = "00:00-24:00",
        clock: str = "solar",
        quantity: str = "hours",
        step_min: StepMinutes | None = None,
        threshold_h: ThresholdHours = 2.0,
        least_altitude: MinAltitudeDeg = 0.0,
        height: HeightM = 0.0,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
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

    @validate_arguments
    def irradiation(
        self,
        date: Date | None = None,
        *,
        to: Date | None = None,
        year: int | None = None,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
        **options: Any,
    ) -> np.ndarray:
        """Compute the energy of sunlight and skylight over dates as a raster.

        Parameters
        ----------
        date
            The date, or the first of several dates.
        to
            The last of several dates.
        year
            A whole year instead of dates.
        bounds, crs, resolution, like, cells
            As in ``shade``.
        **options
            ``days="mean"`` computes one day for each month. ``per`` is ``period``, ``month``, ``day`` or ``hour``. ``part`` is
            ``total``, ``beam``, ``circumsolar``, ``sky``, ``horizon_band`` or ``reflected``, and ``by_part=True`` gives a band for
            each. ``plane`` is ``ground`` or ``level``, or ``tilt`` and ``plane_azimuth`` give a plane in degrees. ``albedo``,
            ``linke`` (turbidity), ``weather``, ``weather_columns``, ``transmissivity`` of trees, ``clock``, ``step_min`` and
            ``checkpoint`` are those of the command.

        Returns
        -------
        numpy.ndarray
            kWh/m2, float32 (rows, cols), or (bands, rows, cols) with several periods or parts; NaN without ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        product = product_named("irradiation")
        request = ProductRequest(
            product="irradiation", options=product.options_of({"date": date, "to": to, "year": year, **options})
        )
        array = self._compute_raster(request, (bounds, crs, resolution, like, cells), {})
        return array if array.ndim == 2 else np.moveaxis(array, -1, 0)

    @validate_arguments
    def sky_view(
        self,
        kind: SkyViewKind = "solid_angle",
        *,
        azimuths: AzimuthCount = DEFAULT_AZIMUTHS,
        transmissivity: Share = 0.0,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
    ) -> np.ndarray:
        """Compute the sky view factor as a raster.

        Parameters
        ----------
        kind
            The definition, as in ``skugga.sky_view``: ``solid_angle``, ``cosine``, ``tilted``, ``openness`` or
            ``negative_openness``.
        azimuths
            The number of azimuths, 8 to 360.
        transmissivity
            The share of the light that comes through the crowns of the level's trees, 0 to 1.
        bounds, crs, resolution, like, cells
            As in ``shade``.

        Returns
        -------
        numpy.ndarray
            float32 (rows, cols), 0 to 1 or degrees; NaN without ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        options = {"kind": kind, "azimuths": azimuths, "transmissivity": transmissivity}
        request = ProductRequest(product="sky_view", options=product_named("sky_view").options_of(options))
        return self._compute_raster(request, (bounds, crs, resolution, like, cells), {})

    @validate_arguments
    def horizons(
        self,
        azimuths: AzimuthCount = DEFAULT_AZIMUTHS,
        *,
        bounds: Bounds | None = None,
        crs: CrsLike | None = None,
        resolution: Resolution | None = None,
        like: Path | None = None,
        cells: Cells | None = None,
    ) -> np.ndarray:
        """Compute the horizons of all cells of a raster. ``horizon`` is the one of a point.

        Parameters
        ----------
        azimuths
            The number of azimuths, 8 to 360. Band k is towards the azimuth 360 k / azimuths in degrees, clockwise from true north.
        bounds, crs, resolution, like, cells
            As in ``shade``.

        Returns
        -------
        numpy.ndarray
            Horizon angles, float32 (azimuths, rows, cols), in degrees: -90 where no ground lies towards an azimuth, NaN without
            ground.

        Raises
        ------
        SkuggaError
            For a wrong argument, and for arrays that do not fit into memory.
        """
        options = {"azimuths": azimuths, "dtype": "float32"}
        request = ProductRequest(product="horizon", options=product_named("horizon").options_of(options))
        return np.moveaxis(self._compute_raster(request, (bounds, crs, resolution, like, cells), {}), -1, 0)

    def _compute_raster(
        self,
        request: ProductRequest,
        grid_arguments: tuple[Bounds | None, CRS | None, float | None, Path | None, tuple[slice, slice] | None],
        shadows: dict[str, Any],
    ) -> np.ndarray:
        """Compute a raster for a request. ``grid_arguments`` holds bounds, CRS, resolution, raster file and slices of cells."""
        profile = request.product_record.profile(request.options)
        raster = self._raster(*grid_arguments, np.dtype(profile.dtype).itemsize * profile.bands)
        self._issue_object_warnings()
        for text in request.product_record.warnings(request.options, self._scene):
            warn_caller(text)
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
        """Return the cell grid of an array. Raises ``InputError`` for an array that does not fit into memory.

        The other parameters are those of ``shade``. ``bytes_per_cell`` is the memory that the array needs for each cell.
        """
        if cells is None:
            raster = raster_view(self._scene, bounds, crs_text(crs), resolution, like)
            if like is not None and (text := extent_warning(self._scene, raster)) is not None:
                warn_caller(text)
        else:
            for name, value in (("bounds", bounds), ("crs", crs), ("resolution", resolution), ("like", like)):
                if value is not None:
                    raise InputError.conflict(
                        name, "cells", "Use one of them; cells selects rows and columns of the level's own grid"
                    )
            (top, bottom, _), (left, right, _) = (part.indices(count) for part, count in zip(cells, self.shape, strict=True))
            if top >= bottom or left >= right:
                raise InputError(
                    "cells",
                    cells,
                    f"slices that select at least one of the level's {self.shape[0]} rows and {self.shape[1]} columns",
                )
            raster = self._own_raster.raster_part(top, left, bottom - top, right - left)
        check_memory("cells" if resolution is None else "resolution", *raster.shape, bytes_per_cell, PART_REMEDY)
        return raster
