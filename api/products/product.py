"""The record of a product, which is one kind of picture or raster that Skugga computes.

Each product has a module in this folder. Commands, Python, tiles, maps, WMS, WMTS, TileJSON, legends and archives read its record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import urlencode

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from skugga.api.raster_profile import RasterProfile
from skugga.shadows.passes import PassLayer
from skugga.shadows.picture import Needs
from skugga.terrain.errors import InputError, Problem
from skugga.terrain.level.level_errors import allowed_phrase

if TYPE_CHECKING:
    from skugga.api.color_scale import ColorScale
    from skugga.shadows.picture import Picture
    from skugga.shadows.render import Frame
    from skugga.terrain.geo.camera import PerspectiveView
    from skugga.terrain.geo.grid import MapView
    from skugga.terrain.geo.world import World
    from skugga.terrain.scene import Scene

PictureFormat = Literal["png", "webp", "jpg"]
MapFormat = Literal["png", "webp", "jpg", "tif", "npy"]
MEDIA_TYPES: dict[MapFormat, str] = {
    "png": "image/png", "webp": "image/webp", "jpg": "image/jpeg", "tif": "image/tiff", "npy": "application/x-npy",
}  # fmt: skip
"""Media type of each format: pictures, and arrays of numbers."""

PICTURE_FORMATS: tuple[PictureFormat, ...] = ("png", "webp", "jpg")

ViewKind = Literal["map", "perspective"]
"""Kinds of views."""

HeightEncoding = Literal["mapbox", "terrarium"]
"""Encodings of heights in colours, by MapLibre's names."""

NEEDS_FRAME: Needs = frozenset({"frame", "reach"})
"""Needs of a product that is computed from a whole frame: the rendered view with all its buffers."""
NEEDS_NOTHING: Needs = frozenset()
"""Needs of a product that no picture is drawn for."""


class ProductOptions(BaseModel):
    """Base model of the options of a product.

    A product with options derives from this model. Each field becomes an option of every front end. The ``description`` and
    ``examples`` of a field are its documentation. ``UNSERVED`` maps fields that HTTP does not accept to the values that HTTP uses.
    These fields never appear in a query. ``REMEDIES`` maps options that other tools have, and this product has not, to what to do
    instead.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    UNSERVED: ClassVar[Mapping[str, Any]] = {}
    REMEDIES: ClassVar[Mapping[str, str]] = {}

    def query(self) -> str:
        """Return the options as a query string. Options with their default value are omitted."""
        return urlencode(self.model_dump(mode="json", exclude_defaults=True, exclude=set(self.UNSERVED)))


@dataclass(frozen=True, eq=False)
class ProductInput:
    """The input of a product's computation: the scene, the pixels of a view or of a block of a map, and the drawn picture.

    Attributes
    ----------
    scene
        The scene under the request's sun.
    view
        The pixels to compute, including a margin of ``margin_px`` pixels of a map on each side. If the product needs no picture,
        pixels of a map lie on the nodes of a grid.
    options
        The product's options.
    picture
        The drawn view; ``None`` for a product that needs no picture.
    on_step
        A callback, to be called after each step that ``Product.step_count`` counts.
    """

    scene: Scene
    view: MapView | PerspectiveView
    options: Any
    picture: Picture | None = None
    on_step: Callable[[], None] = field(default=lambda: None)

    @property
    def map_view(self) -> MapView:
        """The view, for a product that exists for maps only."""
        from skugga.terrain.geo.grid import MapView

        assert isinstance(self.view, MapView)
        return self.view

    @property
    def required_picture(self) -> Picture:
        """The drawn view, for a product that needs a picture."""
        assert self.picture is not None
        return self.picture

    @property
    def frame(self) -> Frame:
        """The rendered frame of the view, with all its buffers, for a product that needs one."""
        assert self.picture is not None and self.picture.frame is not None
        return self.picture.frame

    @cached_property
    def _ground(self) -> tuple[np.ndarray, np.ndarray]:
        """Heights of a map's ground in metres, float32 (rows, cols), and its valid mask, bool (rows, cols)."""
        view = self.map_view
        return self.scene.surface(view.grid).heights(int(view.row0), int(view.col0), view.rows, view.cols)

    @property
    def ground_height_m(self) -> np.ndarray:
        """Heights of a map's ground in metres, float32 (rows, cols), NaN outside the data. Holes are filled as for shadows."""
        return self._ground[0]

    @property
    def ground_valid(self) -> np.ndarray:
        """The valid mask of a map's ground, bool (rows, cols). Holes are not valid."""
        return self._ground[1]

    @cached_property
    def ground_normal_enu(self) -> np.ndarray:
        """Unit normals of a map's ground, float32 (rows, cols, 3), in east, true north and up; NaN without data."""
        from skugga.terrain.gbuffer.ground_normals import ground_normals_enu

        return ground_normals_enu(self.scene, self.map_view)


@dataclass(frozen=True, kw_only=True)
class Product:
    """A kind of picture or raster.

    Attributes
    ----------
    name
        The name in commands, queries and files.
    description
        A description in one line, in lower case.
    formats
        The file formats that hold it without loss, or as a picture.
    compute
        Returns the array (rows, cols) or (rows, cols, bands) of a ``ProductInput``.
    view_kinds
        The kinds of views that it exists for.
    when
        The dependence on time: ``none``, the ``sun`` of a moment, or the ``days`` that its options name.
    needs, perspective_needs
        The images to draw for a map, and for a perspective view (``None``: the same). If none, ``compute`` uses the scene only.
    margin_px
        Margin in pixels around a block or tile that ``compute`` needs. It is computed and cropped, so that there are no seams.
    options
        The model of its options.
    profile
        Returns the form of its rasters for options. ``compute`` returns arrays of that form.
    is_smooth
        Whether overviews of its rasters are means. Means are wrong for classes and angles.
    unit
        The unit of its values.
    is_picture
        Whether the array itself is a picture of uint8: gray, RGB or RGBA.
    is_display
        Whether it shows the colours that people see: all lights together, in a style, and with lossy compression.
    encoding
        The encoding of heights, for map clients.
    pass_layer
        The layer of a pass that it shows.
    to_picture
        Returns a picture for PNG, from the array and the frame's colour.
    draw_over_frame
        Returns a picture for PNG, from the array and the frame, in place of ``to_picture``.
    color_scale
        Returns the colour scale of pictures and legends, for options and a world.
    describe
        Returns ``description`` and ``unit`` for options, if they depend on the options.
    empty
        Returns the array of a map without data, from rows, columns and the height of the level's lowest ground in metres; ``None``:
        the empty array of ``profile``.
    sees_all_ground
        Whether each cell depends on all ground of the level, not only on that of the cell and on what shades it.
    blocks
        Returns the blocks of a large map, for options; ``None``: those of ``skugga.terrain.geo.grid.blocks_of``.
    step_count
        Returns the number of steps of a block, for progress bars.
    tags
        Returns the metadata tags of rasters, for options and a scene. By default the tags are the options.
    check
        Raises ``SkuggaError`` if a service does not compute the product of a scene.
    warnings
        Returns sentences about options that do not fit a scene, in a command or in Python.
    is_served
        Whether HTTP serves it.
    is_view_only
        Whether it exists for single views only, not for rasters of any size.
    """

    name: str
    description: str
    formats: tuple[MapFormat, ...]
    compute: Callable[[ProductInput], np.ndarray]
    view_kinds: tuple[ViewKind, ...] = ("map", "perspective")
    when: Literal["none", "sun", "days"] = "sun"
    needs: Needs = NEEDS_NOTHING
    perspective_needs: Needs | None = None
    margin_px: int = 0
    options: type[ProductOptions] = ProductOptions
    profile: Callable[[Any], RasterProfile] = lambda _: RasterProfile()
    is_smooth: bool = True
    unit: str = ""
    is_picture: bool = False
    is_display: bool = False
    encoding: HeightEncoding | None = None
    pass_layer: PassLayer | None = None
    to_picture: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    draw_over_frame: Callable[[np.ndarray, Frame], np.ndarray] | None = None
    color_scale: Callable[[Any, World], ColorScale] | None = None
    describe: Callable[[Any], tuple[str, str]] | None = None
    empty: Callable[[int, int, float], np.ndarray] | None = None
    sees_all_ground: bool = False
    blocks: Callable[[Scene, MapView, Any], list[tuple[MapView, int, int]]] | None = None
    step_count: Callable[[Any], int] = lambda _: 1
    tags: Callable[[Any, Scene], dict[str, str]] = lambda options, _: {
        name: str(value) for name, value in options.model_dump(mode="json", exclude_none=True).items()
    }
    check: Callable[[Scene], None] = lambda _: None
    warnings: Callable[[Any, Scene], tuple[str, ...]] = lambda _, __: ()
    is_served: bool = True
    is_view_only: bool = False

    @property
    def view_formats(self) -> tuple[PictureFormat, ...]:
        """The formats of views over HTTP."""
        if self.pass_layer is not None:
            return ("png",) if "png" in self.formats else ()
        if not (self.is_served and self.is_picture and self.when == "sun" and "perspective" in self.view_kinds):
            return ()
        return tuple(format for format in PICTURE_FORMATS if format in self.formats)

    @property
    def map_formats(self) -> tuple[MapFormat, ...]:
        """The formats of tiles and maps over HTTP."""
        if not self.is_served or self.pass_layer is not None or "map" not in self.view_kinds:
            return ()
        return tuple(format for format in MEDIA_TYPES if format in self.formats)

    @property
    def is_raster(self) -> bool:
        """Whether the product can be written as a georeferenced raster of any size."""
        return "map" in self.view_kinds and "tif" in self.formats and not self.is_view_only and self.pass_layer is None

    def band_names(self, options: ProductOptions) -> tuple[str, ...]:
        """Return a description of each band, for options."""
        profile = self.profile(options)
        if profile.band_names:
            return profile.band_names
        return (
            (self.description_and_unit(options)[0],) if profile.bands == 1 else ("red", "green", "blue", "alpha")[: profile.bands]
        )

    def needs_of(self, view: MapView | PerspectiveView) -> Needs:
        """Return the images to draw for a view."""
        from skugga.terrain.geo.grid import MapView

        return self.needs if isinstance(view, MapView) or self.perspective_needs is None else self.perspective_needs

    def description_and_unit(self, options: ProductOptions) -> tuple[str, str]:
        """Return the description and the unit of values for some options."""
        return (self.description, self.unit) if self.describe is None else self.describe(options)

    def options_of(self, values: Mapping[str, Any]) -> ProductOptions:
        """Validate names and values of options, and return them as a model.

        Raises
        ------
        InputError
            If an option is unknown, missing or wrong.
        """
        try:
            return self.options(**values)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(map(str, first["loc"])) or "options"
            if first["type"] == "missing":
                description = self.options.model_fields[name].description or "a value"
                raise InputError.missing(
                    name, f"{self.name} needs {description[:1].lower()}{description[1:].rstrip('.')}"
                ) from None
            if first["type"] == "extra_forbidden":
                option_names = ", ".join(self.options.model_fields)
                remedy = self.options.REMEDIES.get(name, f"Use one of {option_names}" if option_names else "Omit it")
                raise InputError(name, Problem(f"{self.name} has no such option"), remedy) from None
            raise InputError(name, first["input"], allowed_phrase(first)) from None

    def empty_array(self, options: ProductOptions, rows: int, cols: int, lowest_ground_m: float = 0.0) -> np.ndarray:
        """Return the array (rows, cols) or (rows, cols, bands) of a map without data, for options.

        ``lowest_ground_m`` is the height of the level's lowest ground in metres. Encoded heights show it.
        """
        if self.empty is not None:
            return self.empty(rows, cols, lowest_ground_m)
        return self.profile(options).empty_array(rows, cols)

    def empty_picture(self, options: ProductOptions, rows: int, cols: int, lowest_ground_m: float = 0.0) -> np.ndarray:
        """Return the picture of a map without data, which is transparent for a product with a colour scale.

        The parameters are those of ``empty_array``.
        """
        if self.color_scale:
            return np.zeros((rows, cols, 4), np.uint8)
        return self.empty_array(options, rows, cols, lowest_ground_m)
