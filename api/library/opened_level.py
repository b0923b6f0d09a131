"""Open levels: bundled levels, level files, rasters, and arrays of heights."""

from __future__ import annotations

import re
import warnings
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
from skugga.api.library.argument_types import AltitudeDeg, AzimuthDeg, CrsLike, Time, Transform, validate_arguments
from skugga.api.library.caller_warnings import warn_caller
from skugga.api.library.grids import Heights
from skugga.api.library.level_pictures import LevelPictures
from skugga.api.library.level_points import LevelPoints
from skugga.api.library.level_rasters import LevelRasters
from skugga.api.library.level_state import requested_sun
from skugga.api.library.tile_service import TileService
from skugga.terrain.errors import InputError
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource, parse_positive, parse_units
from skugga.terrain.scene import Scene, build_scene

ARRAY_NAME = "the array"
"""Name of a raster in memory, for messages."""

ARRAY_REMEDIES = {
    "nodata": "set those cells to NaN", "units": "convert the heights to metres", "positive": "negate the depths",
}  # fmt: skip
"""Remedies for a raster in memory, by the option that a file would need."""

_FILE_REMEDY_PATTERN = re.compile(
    r"write terrain: \{(\w+): [^}]*\} \(without a level file: [^)]*\)(?:\. UNIT is one of [\w-]+(?:, [\w-]+)*)?"
)


class OpenLevel(LevelPictures, LevelRasters, LevelPoints):
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
        super().__init__(scene)
        self._source = source
        self._memory_file = memory_file
        self._tile_service: TileService | None = None
        self._folder: TemporaryDirectory[str] | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings from opening the level, for example of a border without data that the raster does not declare."""
        texts = super().warnings
        return texts if self._memory_file is None else tuple(map(_with_array_remedies, texts))

    @validate_arguments
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

        spec = requested_sun(time, azimuth, altitude)
        sun = {} if spec is None else spec.model_dump(mode="json", exclude_none=True)
        query = {key: value for key, value in {"layer": layer, **sun, **shadows}.items() if value is not None}
        tile_json = self._service().tile_json(urlencode(query))
        return TileLayer(
            url=tile_json["tiles"][0], name=self.name, attribution=tile_json.get("attribution", ""), max_zoom=24,
            min_zoom=tile_json["minzoom"], max_native_zoom=tile_json["maxzoom"],
        )  # fmt: skip

    def _service(self) -> TileService:
        """Return the tile service of the level, and start it at the first call. A raster in memory is written to a file for it."""
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
        self._close_scene()
        if self._memory_file is not None:
            self._memory_file.close()

    def __enter__(self) -> OpenLevel:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@validate_arguments
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


@validate_arguments
def open_heights(height_m: Heights, transform: Transform, crs: CrsLike) -> OpenLevel:
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
        error.args = (_with_array_remedies(str(error)).replace(memory_file.name, ARRAY_NAME),)
        raise
    except BaseException:
        memory_file.close()
        raise


def level_of_source(source: LevelSource, ground_name: str | None = None, memory_file: MemoryFile | None = None) -> OpenLevel:
    """Open a level and issue the warnings about its ground. Raises ``InputError``.

    ``ground_name`` is the name of the ground in warnings; ``None``: that of its raster. ``memory_file`` holds a raster in
    memory and is closed with the level.
    """
    level = OpenLevel(build_scene(load_level(source)), source, memory_file)
    for text in level.warnings:
        if ground_name is None:
            warn_caller(f"{level._scene.elevation.name}: {text}")
        else:
            warn_caller(f"{ground_name}: {_with_array_remedies(text)}")
    return level


def _with_array_remedies(text: str) -> str:
    """Return a message with the remedies for a raster in memory instead of those for a file."""
    return _FILE_REMEDY_PATTERN.sub(lambda match: ARRAY_REMEDIES[match[1]], text)
