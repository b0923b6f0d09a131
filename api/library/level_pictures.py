"""Render pictures and films of an open level."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skugga.api.compute import compute, plan_for
from skugga.api.device_calibration import calibration_for
from skugga.api.film_span import DEFAULT_FPS, film_span
from skugga.api.library.argument_types import AltitudeDeg, AzimuthDeg, Bounds, CrsLike, Size, Time, validate_arguments
from skugga.api.library.level_state import LevelState, crs_text, iso_time, requested_sun
from skugga.api.products import product_named
from skugga.api.request import ProductRequest
from skugga.selector.film import film_frames, frame_moments
from skugga.selector.film_request import FilmRequest
from skugga.selector.replanning import Replanner
from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.level.camera_file import load_camera_path


class LevelPictures(LevelState):
    """The methods of ``OpenLevel`` that render views."""

    @validate_arguments
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
        crs: CrsLike | None = None,
        seconds: float | None = None,
        style: str | None = None,
        slope_exaggeration: float | None = None,
        sky: str | None = None,
        ramp: ColorRamp | None = None,
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
        sky
            The sky that lights the ground of maps: ``even``, ``clear`` or ``overcast``; default: the style's.
        ramp
            Pairs of a height in metres and a colour such as ``#b3c2a2``, with increasing heights, in place of the style's colours.
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
        scene = self._scene.with_sun(requested_sun(time, azimuth, altitude)).at_second(seconds)
        scene = scene.with_style(style, slope_exaggeration, sky, ramp)
        product, rendered_view = product_named(layer), scene.view(view, bounds, crs_text(crs), size)
        self._issue_object_warnings()
        plan = plan_for(scene, rendered_view, view, product, shadows)
        return compute(scene, rendered_view, ProductRequest(product=layer), plan).array

    @validate_arguments
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
        crs: CrsLike | None = None,
        seconds: float | None = None,
        style: str | None = None,
        slope_exaggeration: float | None = None,
        sky: str | None = None,
        ramp: ColorRamp | None = None,
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
        time, azimuth, altitude, size, bounds, crs, seconds, style, slope_exaggeration, sky, ramp, **shadows
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
        span = film_span(iso_time(start), iso_time(end), step, fps, camera_path, seconds)
        scene = self._scene.with_sun(requested_sun(time, azimuth, altitude)).with_style(style, slope_exaggeration, sky, ramp)
        request = FilmRequest(span, view, camera_path, size, bounds, crs_text(crs), shadows)
        moments = frame_moments(scene, request)
        self._issue_object_warnings()
        replanner = Replanner(device=calibration_for(scene.loaded.level.shadows, shadows))
        return (frame.color for frame in film_frames(scene, request, moments, replanner))
