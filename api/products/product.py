"""``Product``: one kind of picture or raster that Skugga computes. Each has a module of its own in this folder.

A product is described once, here. Commands, Python, tiles, maps, WMS, WMTS, TileJSON, legends and archives read this record.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Literal
from urllib.parse import urlencode

import numpy as np
from pydantic import BaseModel, ConfigDict, ValidationError

from skugga.shadows.passes import PassLayer
from skugga.shadows.picture import Needs
from skugga.terrain.errors import MISSING_VALUE, Problem, InputError

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
"""Formats of files: pictures, and arrays to compute with."""

PICTURE_FORMATS: tuple[PictureFormat, ...] = ("png", "webp", "jpg")

HeightEncoding = Literal["mapbox", "terrarium"]
"""Encodings of heights in colours, by MapLibre's names."""

ALLOWED = {
    "float_parsing": "a number", "int_parsing": "a whole number", "int_from_float": "a whole number",
    "date_parsing": "a date, as 2024-03-21", "date_from_datetime_parsing": "a date, as 2024-03-21",
    "date_from_datetime_inexact": "a date, as 2024-03-21",
}  # fmt: skip
"""What is allowed, by pydantic's names of errors."""

NEEDS_FRAME: Needs = frozenset({"frame", "reach"})
NEEDS_NOTHING: Needs = frozenset()


class ProductOptions(BaseModel):
    """Options of a product. A product with options derives from this model; each field becomes an option at every front end.

    A field's ``description`` and ``examples`` are its documentation. ``UNSERVED`` maps fields that HTTP does not take to the values
    that it uses instead. They never appear in a query.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    UNSERVED: ClassVar[Mapping[str, Any]] = {}

    def query(self) -> str:
        """Return the options as a query string, without those that have their default."""
        return urlencode(self.model_dump(mode="json", exclude_defaults=True, exclude=set(self.UNSERVED)))


@dataclass(frozen=True, eq=False)
class Part:
    """What a product is computed from: a view, or a block of a map.

    Attributes
    ----------
    scene
        The scene under the request's sun.
    view
        The pixels to compute. A map of a product that needs no picture has its pixels on nodes, and ``reach_px`` more on each side.
    options
        The product's options.
    picture
        The drawn view; ``None`` for a product that needs no picture.
    on_step
        To be called after each of the steps that ``Product.steps`` counts.
    """

    scene: Scene
    view: MapView | PerspectiveView
    options: Any
    picture: Picture | None = None
    on_step: Callable[[], None] = field(default=lambda: None)

    @property
    def map_view(self) -> MapView:
        """The view of a product that is computed for maps alone."""
        from skugga.terrain.geo.grid import MapView

        assert isinstance(self.view, MapView)
        return self.view

    @property
    def drawn(self) -> Picture:
        """The drawn view of a product that needs a picture."""
        assert self.picture is not None
        return self.picture

    @property
    def frame(self) -> Frame:
        """The frame of a product that needs one."""
        assert self.picture is not None and self.picture.frame is not None
        return self.picture.frame

    @cached_property
    def _ground(self) -> tuple[np.ndarray, np.ndarray]:
        view = self.map_view
        return self.scene.surface(view.grid).heights(int(view.row0), int(view.col0), view.rows, view.cols)

    @property
    def ground_height_m(self) -> np.ndarray:
        """Heights of a map's ground (rows, cols) float32, NaN off the data. Holes are filled as they are for casting shadows."""
        return self._ground[0]

    @property
    def ground_valid(self) -> np.ndarray:
        """bool (rows, cols): where a map's ground has data; holes have none."""
        return self._ground[1]

    @cached_property
    def ground_normal_enu(self) -> np.ndarray:
        """Unit normals of a map's ground (rows, cols, 3) float32 towards east, true north and up; NaN where it has no data."""
        from skugga.terrain.gbuffer.ground_normals import ground_normals_enu

        return ground_normals_enu(self.scene, self.map_view)


@dataclass(frozen=True, kw_only=True)
class Product:
    """A kind of picture or raster.

    Attributes
    ----------
    name
        The name in commands, queries and files.
    about
        What it shows, in one line without a capital; empty for what HTTP does not serve.
    formats
        The formats that hold it without loss, or as a picture.
    compute
        Returns the array (rows, cols) or (rows, cols, bands) of a part.
    view_kinds
        The kinds of views that it exists for.
    when
        What it depends on besides the level: ``none``, the ``sun`` of a moment, or ``days`` that its options name.
    needs, perspective_needs
        What is to be drawn of a map, and of a perspective view (``None``: the same). Nothing: ``compute`` goes by the scene alone.
    reach_px
        Pixels around a part that ``compute`` needs. They are computed and cut off, so that blocks and tiles have no seams.
    options
        The model of its options.
    dtype, bands, nodata, is_smooth, unit
        Of its rasters. Overviews of smooth ones are means, which are wrong for classes and angles.
    is_picture
        Whether the array is a picture as it is, of uint8: gray, RGB or RGBA.
    is_display
        Whether it is the colour that people see: of all lights together, in a style, and compressed with loss.
    encoding
        The encoding of heights, for map clients.
    pass_layer
        The intermediate picture of a pass that it shows.
    to_picture
        Makes a picture for PNG of the array and the frame's colour.
    color_scale
        Returns the colours of its numbers, which pictures and legends show, for options in a world.
    describe
        Returns ``about`` and ``unit`` for options, where they depend on these.
    empty
        Returns the array (rows, cols) of a map without data, whose level's lowest ground is so high; ``None``: ``nodata``.
    blocks
        Returns the blocks of a large map, as ``skugga.terrain.geo.grid.blocks_of``; ``None``: those.
    steps
        Returns into how many steps a block is divided, for progress bars.
    tags
        Returns what rasters say of options in a scene; without it the options themselves.
    check
        Raises ``SkuggaError`` where a service does not compute it of a scene.
    is_served
        Whether HTTP serves it.
    """

    name: str
    about: str
    formats: tuple[MapFormat, ...]
    compute: Callable[[Part], np.ndarray]
    view_kinds: tuple[Literal["map", "perspective"], ...] = ("map", "perspective")
    when: Literal["none", "sun", "days"] = "sun"
    needs: Needs = NEEDS_NOTHING
    perspective_needs: Needs | None = None
    reach_px: int = 0
    options: type[ProductOptions] = ProductOptions
    dtype: str = "float32"
    bands: int = 1
    nodata: float | None = float("nan")
    is_smooth: bool = True
    unit: str = ""
    is_picture: bool = False
    is_display: bool = False
    encoding: HeightEncoding | None = None
    pass_layer: PassLayer | None = None
    to_picture: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    color_scale: Callable[[Any, World], ColorScale] | None = None
    describe: Callable[[Any], tuple[str, str]] | None = None
    empty: Callable[[int, int, float], np.ndarray] | None = None
    blocks: Callable[[Scene, MapView], list[tuple[MapView, int, int]]] | None = None
    steps: Callable[[Any], int] = lambda _: 1
    tags: Callable[[Any, Scene], dict[str, str]] = lambda options, _: {
        name: str(value) for name, value in options.model_dump(mode="json", exclude_none=True).items()
    }
    check: Callable[[Scene], None] = lambda _: None
    is_served: bool = True

    @property
    def view_formats(self) -> tuple[PictureFormat, ...]:
        """The formats that HTTP serves views in."""
        if self.pass_layer is not None:
            return ("png",) if "png" in self.formats else ()
        if not (self.is_served and self.is_picture and self.when == "sun" and "perspective" in self.view_kinds):
            return ()
        return tuple(each for each in PICTURE_FORMATS if each in self.formats)

    @property
    def map_formats(self) -> tuple[MapFormat, ...]:
        """The formats that HTTP serves tiles and maps in."""
        if not self.is_served or self.pass_layer is not None or "map" not in self.view_kinds:
            return ()
        return tuple(each for each in MEDIA_TYPES if each in self.formats)

    @property
    def is_raster(self) -> bool:
        """Whether it can be written as a georeferenced raster of any size."""
        return "map" in self.view_kinds and "tif" in self.formats and self.is_served and self.pass_layer is None

    def band_names(self, options: ProductOptions) -> tuple[str, ...]:
        """What each band holds with some options."""
        if self.bands == 1:
            return (self.about_of(options)[0],)
        return ("red", "green", "blue", "alpha")[: self.bands]

    def needs_of(self, view: MapView | PerspectiveView) -> Needs:
        """What is to be drawn of a view."""
        from skugga.terrain.geo.grid import MapView

        return self.needs if isinstance(view, MapView) or self.perspective_needs is None else self.perspective_needs

    def about_of(self, options: ProductOptions) -> tuple[str, str]:
        """What it shows with some options, and in which unit."""
        return (self.about, self.unit) if self.describe is None else self.describe(options)

    def options_of(self, given: Mapping[str, Any]) -> ProductOptions:
        """Return the options of names and values.

        Raises
        ------
        InputError
            An option is unknown, missing or wrong.
        """
        try:
            return self.options(**given)
        except ValidationError as error:
            first = error.errors()[0]
            name = ".".join(map(str, first["loc"])) or "options"
            if first["type"] == "missing":
                about = self.options.model_fields[name].description or "a value"
                raise InputError(name, MISSING_VALUE, f"{about.rstrip('.')}, for {self.name}") from None
            if first["type"] == "extra_forbidden":
                raise InputError(
                    name, Problem(f"{self.name} has no such option"), ", ".join(self.options.model_fields) or "none"
                ) from None
            allowed = ALLOWED.get(first["type"], first["msg"].removeprefix("Input should be "))
            raise InputError(name, first["input"], allowed) from None

    def empty_array(self, rows: int, cols: int, lowest_m: float = 0.0) -> np.ndarray:
        """Return the array of a map without data."""
        if self.empty is not None:
            return self.empty(rows, cols, lowest_m)
        shape: Sequence[int] = (rows, cols) if self.bands == 1 else (rows, cols, self.bands)
        return np.full(shape, 0 if self.nodata is None else self.nodata, self.dtype)

    def empty_picture(self, rows: int, cols: int, lowest_m: float = 0.0) -> np.ndarray:
        """Return what pictures show of a map without data: where they have the colours of a scale, nothing."""
        return np.zeros((rows, cols, 4), np.uint8) if self.color_scale else self.empty_array(rows, cols, lowest_m)
