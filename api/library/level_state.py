"""The scene of an open level and facts about it, shared by the groups of methods of ``OpenLevel``."""

from __future__ import annotations

from pathlib import Path
from typing import cast

from affine import Affine
from pyproj import CRS

from skugga.api.library.argument_types import Time
from skugga.api.library.caller_warnings import warn_caller
from skugga.api.raster_view import raster_view
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.level import parse_sun
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene


class LevelState:
    """The scene of an open level, its cell grid and its warnings."""

    def __init__(self, scene: Scene) -> None:
        self._open_scene: Scene | None = scene
        self._own_raster = raster_view(scene)
        self._has_issued_object_warnings = False

    @property
    def _scene(self) -> Scene:
        """The scene. Raises ``InputError`` if the level is closed."""
        if self._open_scene is None:
            raise InputError("level", Problem("it is closed"), "Open it again")
        return self._open_scene

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

    def _issue_object_warnings(self) -> None:
        """Issue the warnings about objects once, before the first result. The files of the objects are then read."""
        if not self._has_issued_object_warnings:
            texts, self._has_issued_object_warnings = self._scene.objects.warnings, True
            for text in texts:
                warn_caller(text)

    def _close_scene(self) -> None:
        """Close the scene and its files. Further calls do nothing."""
        if self._open_scene is not None:
            self._open_scene.close()
            self._open_scene = None


def crs_text(crs: CRS | None) -> str | None:
    """Return a CRS as text for the engine; ``None`` for ``None``."""
    return None if crs is None else crs.srs


def requested_sun(time: Time | None, azimuth: float | None, altitude: float | None) -> SunSpec | None:
    """Return the sun that a call requests by time or by angles; ``None`` means the level's own. Raises ``InputError``."""
    return parse_sun(iso_time(time), azimuth, altitude)


def iso_time(time: Time | None) -> str | None:
    """Return a validated time as ISO 8601 text, to which ``Time`` has converted it."""
    return cast("str | None", time)
