"""Layers of a frame and their files: the same for the command line and HTTP. A layer is a record in ``LAYERS``, and no more.

What draws and what writes is imported where it is used: the names of layers are options of commands and parameters of HTTP.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Protocol, get_args

import numpy as np

from skugga.api.png import encode_png
from skugga.api.terrain_encodings import terrain_rgb, terrarium
from skugga.shadows.passes import PassLayer
from skugga.terrain.errors import InputError
from skugga.terrain.whole_files import write_whole

if TYPE_CHECKING:
    from skugga.shadows.render import Frame
    from skugga.terrain.scene import Scene

PASS_LAYERS: frozenset[PassLayer] = frozenset(get_args(PassLayer))
"""Layers that an algorithm leaves behind, if it is told beforehand to keep them."""

LOSSY_QUALITY = 90
"""Of JPEG, and of WebP where a map is to be looked at and not to be computed with."""

PictureFormat = Literal["png", "webp", "jpg"]
MEDIA_TYPES: dict[PictureFormat, str] = {"png": "image/png", "webp": "image/webp", "jpg": "image/jpeg"}
"""Formats of pictures over HTTP."""

MapFormat = Literal["png", "webp", "jpg", "tif", "npy"]
MAP_MEDIA_TYPES: dict[MapFormat, str] = {
    "png": "image/png", "webp": "image/webp", "jpg": "image/jpeg", "tif": "image/tiff", "npy": "application/x-npy",
}  # fmt: skip
"""Formats of tiles and maps over HTTP: pictures, and arrays to compute with."""

HeightEncoding = Literal["mapbox", "terrarium", "metres"]
"""How heights are told: in colours, by the names that MapLibre has for it, or as numbers."""

VOLUME_COLOR = (255, 120, 30)
"""sRGB of shadow volumes in a picture: warmer than ground, snow and sky are."""

FACE_COVERS, ALL_COVER = 0.12, 0.8
"""Share of the light from behind that each face of a volume takes in a picture, of the most that all of them together take: what
lies behind a hundred volumes can still be made out.
"""

MASK_SHADOW, MASK_NO_SURFACE, MASK_LIT = 0, 128, 255


class Pictured(Protocol):
    """What the picture layers are made of: part of a frame and of a served block."""

    @property
    def color(self) -> np.ndarray: ...

    @property
    def visibility(self) -> np.ndarray: ...

    @property
    def opacity(self) -> np.ndarray: ...

    @property
    def there(self) -> np.ndarray: ...

    @property
    def opaque(self) -> np.ndarray: ...


@dataclass(frozen=True, kw_only=True)
class Layer:
    """A layer: ``about`` what it is, the ``suffixes`` of files that hold it without loss or as a picture to look at, and how
    its array is made, row 0 the upper one.

    A layer with a ``picture`` (of uint8: gray or RGBA, with JPEG RGBA) is served over HTTP, in those formats that are among its
    suffixes; any other has ``data``. Of tiles and maps data are served too, where ``pixels`` takes them from what was drawn, or
    where they are heights in an ``encoding``: those hang on no light. ``shown`` makes of an array that is no picture one for PNG,
    over the frame's colour. ``nodata`` is what a TIFF has where there is no surface. A layer ``to_look_at`` is the colour that is
    seen: it may be compressed with loss, and is of all lights together; others are to be computed with, and of one light. One
    ``of_points`` takes the visibility at pixels' own points; others what is shown, which is drawn faster.
    """

    about: str = ""
    suffixes: tuple[str, ...]
    picture: Callable[[Pictured], np.ndarray] | None = None
    data: Callable[[Scene, Frame], np.ndarray] | None = None
    pixels: Callable[[Pictured], np.ndarray] | None = None
    encoding: HeightEncoding | None = None
    shown: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    nodata: float | None = None
    to_look_at: bool = False
    of_points: bool = True

    @property
    def formats(self) -> tuple[PictureFormat, ...]:
        """The formats that it is served in."""
        return tuple(each for each in MEDIA_TYPES if f".{each}" in self.suffixes) if self.picture else ()

    @property
    def map_formats(self) -> tuple[MapFormat, ...]:
        """The formats that tiles and maps of it are served in."""
        served = self.picture or self.pixels or self.encoding
        return tuple(each for each in MAP_MEDIA_TYPES if f".{each}" in self.suffixes) if served else ()


def _color(frame: Pictured) -> np.ndarray:
    """RGBA, transparent where there is no surface; the sky of a perspective view is opaque."""
    alpha = np.where(frame.opaque, np.uint8(255), np.uint8(0))
    return np.concatenate([frame.color, alpha[..., None]], axis=-1)


def _shadow(frame: Pictured) -> np.ndarray:
    """RGBA: black, alpha = 1 - visibility, transparent where there is no surface."""
    out = np.zeros((*frame.there.shape, 4), np.uint8)
    out[..., 3] = frame.opacity
    return out


def _mask(frame: Pictured) -> np.ndarray:
    classes = np.where(frame.visibility < 0.5, MASK_SHADOW, MASK_LIT)
    return np.where(frame.there, classes, MASK_NO_SURFACE).astype(np.uint8)


def _visibility(scene: Scene, frame: Frame) -> np.ndarray:
    """float32, NaN where there is no surface."""
    return frame.visibility


def encoded_heights(height_m: np.ndarray, nodata_m: float, encoding: HeightEncoding) -> np.ndarray:
    """Heights (rows, cols) as RGB (rows, cols, 3) uint8, where those that are NaN are told as ``nodata_m``; in metres as float32
    (rows, cols) with NaN.
    """
    if encoding == "metres":
        return height_m.astype(np.float32)
    known = np.where(np.isnan(height_m), nodata_m, height_m)
    return terrain_rgb(known) if encoding == "mapbox" else terrarium(known)


def nodata_height_m(lowest_m: float) -> float:
    """The height that is told of places off the data: whole metres at or below a level's lowest ground, so that none stands up."""
    return float(np.floor(lowest_m))


def _heights(encoding: HeightEncoding) -> Callable[[Scene, Frame], np.ndarray]:
    def data(scene: Scene, frame: Frame) -> np.ndarray:
        return encoded_heights(frame.height_m, nodata_height_m(scene.height_range_m[0]), encoding)

    return data


def _depth(scene: Scene, frame: Frame) -> np.ndarray:
    """float32, metres: in a map straight down from the level's highest ground, else along the view's axis from the eye."""
    from skugga.terrain.geo.grid import MapView

    view = frame.view
    if isinstance(view, MapView):
        return np.where(frame.there, scene.height_range_m[1] - frame.height_m, np.nan).astype(np.float32)
    return ((frame.position_earth_m - view.eye_earth_m) @ view.earth_from_camera[:, 2]).astype(np.float32)


def _position(scene: Scene, frame: Frame) -> np.ndarray:
    """float64 (rows, cols, 3): x and y in the view's CRS (of a perspective view, that of the level's maps), and the height."""
    from skugga.terrain.geo.grid import MapView

    view = frame.view
    out = np.full((view.rows, view.cols, 3), np.nan)
    row, col = np.nonzero(frame.there)
    if isinstance(view, MapView):
        out[row, col, 0] = view.grid.x(view.col0 + col * view.col_step)
        out[row, col, 1] = view.grid.y(view.row0 + row * view.row_step)
        out[row, col, 2] = frame.height_m[row, col]
    elif frame.position_earth_m is not None:
        out[row, col] = np.stack(scene.world.map_position(scene.map_crs, frame.position_earth_m[row, col]), axis=-1)
    return out


def _kept(layer: PassLayer) -> Callable[[Scene, Frame], np.ndarray]:
    """A layer of ``skugga.shadows.passes`` as it was kept, of the frame's first light."""

    def data(scene: Scene, frame: Frame) -> np.ndarray:
        by_light, light = frame.layers.get(layer, {}), next(iter(frame.visibilities))
        if not by_light:
            raise InputError("layer", layer, "a layer of a drawn pass: in this view no light has any")
        if light not in by_light:
            raise InputError("light", light, f"for layer {layer}: {', '.join(by_light)}")
        return by_light[light]

    return data


def _gray_of_depths(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """uint16, nearest to the light brightest, black where nothing casts."""
    return np.rint(65535.0 * (1.0 - np.nan_to_num(array, nan=1.0))).astype(np.uint16)


def _spread(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """uint8, values spread so that the largest is bright."""
    return array * np.uint8(255 // max(int(array.max()), 1))


def _over_color(array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """uint8 (rows, cols, 3): volumes translucent over the frame's colour, which is repeated where several algorithms left their
    volumes beside one another.
    """
    behind = np.tile(color, (array.shape[0] // color.shape[0], array.shape[1] // color.shape[1], 1))
    covered = (ALL_COVER * (1.0 - (1.0 - FACE_COVERS) ** np.arange(256)))[array, None]
    return np.rint((1.0 - covered) * behind + covered * np.array(VOLUME_COLOR)).astype(np.uint8)


LAYERS: dict[str, Layer] = {
    "color": Layer(
        about="shaded relief with cast shadows", picture=_color, suffixes=(".png", ".webp", ".tif", ".jpg"), to_look_at=True,
        of_points=False,
    ),
    "shadow": Layer(
        about="black with the shadow as opacity", picture=_shadow, suffixes=(".png", ".webp", ".tif"), of_points=False
    ),
    "mask": Layer(
        about=f"gray: {MASK_SHADOW} shadow, {MASK_LIT} lit, {MASK_NO_SURFACE} no surface",
        picture=_mask, suffixes=(".png", ".webp", ".tif", ".npy"), nodata=MASK_NO_SURFACE,
    ),
    "visibility": Layer(
        about="the share of the light that reaches the ground, 0 to 1", data=_visibility, pixels=lambda drawn: drawn.visibility,
        suffixes=(".npy", ".tif"), nodata=np.nan,
    ),
    "height": Layer(
        about="the ground's heights in metres", data=_heights("metres"), encoding="metres", suffixes=(".npy", ".tif"), nodata=np.nan
    ),
    "terrain-rgb": Layer(
        about="heights in Mapbox's encoding, for terrain in three dimensions", data=_heights("mapbox"), encoding="mapbox",
        suffixes=(".png", ".webp"),
    ),
    "terrarium": Layer(
        about="heights in Terrarium's encoding", data=_heights("terrarium"), encoding="terrarium", suffixes=(".png", ".webp")
    ),
    "depth": Layer(data=_depth, suffixes=(".npy", ".tif"), nodata=np.nan),
    "position": Layer(data=_position, suffixes=(".npy",)),
    "shadow-map": Layer(
        about="depths of shadow maps, nearest to the light brightest", data=_kept("shadow-map"), suffixes=(".npy", ".png"),
        shown=_gray_of_depths,
    ),
    "stencil": Layer(
        about="the stencil that shadow volumes count in", data=_kept("stencil"), suffixes=(".npy", ".png"), shown=_spread
    ),
    "silhouettes": Layer(
        about="edges of casters as the light sees them; of a hybrid, the pixels left to its volumes",
        data=_kept("silhouettes"), suffixes=(".npy", ".png"),
    ),
    "volumes": Layer(
        about="shadow volumes over the picture", data=_kept("volumes"), suffixes=(".npy", ".png"), shown=_over_color
    ),
    "shadow-height": Layer(data=_kept("shadow-height"), suffixes=(".npy", ".tif"), nodata=np.nan),
}  # fmt: skip
"""All layers. What the service serves, what the command line writes, and what either says of them, is read off here."""

PICTURE_LAYERS = tuple(name for name, layer in LAYERS.items() if layer.picture)
"""Layers that are served over HTTP as pictures of any view."""

MAP_LAYERS = tuple(name for name, layer in LAYERS.items() if layer.map_formats)
"""Layers that are served over HTTP as tiles and maps."""

BETWEEN_LAYERS = tuple(name for name, layer in LAYERS.items() if name in PASS_LAYERS and ".png" in layer.suffixes)
"""Layers that passes leave behind on the way to a picture, which are served over HTTP of views, as PNG."""

VIEW_LAYERS = (*PICTURE_LAYERS, *BETWEEN_LAYERS)
"""All layers that are served over HTTP of views."""


def view_formats(layer: str) -> tuple[PictureFormat, ...]:
    """The formats that a layer of ``VIEW_LAYERS`` is served in."""
    return ("png",) if layer in BETWEEN_LAYERS else LAYERS[layer].formats


if TYPE_CHECKING:
    ViewLayer = str
    MapLayer = str
else:
    ViewLayer = Literal[VIEW_LAYERS]
    MapLayer = Literal[MAP_LAYERS]


def picture_layer(frame: Pictured, layer: str) -> np.ndarray:
    """A picture layer as a uint8 array, row 0 northernmost. Raises ``InputError``."""
    picture = LAYERS[layer].picture if layer in LAYERS else None
    if picture is None:
        raise InputError("layer", layer, ", ".join(PICTURE_LAYERS))
    return picture(frame)


def map_layer(drawn: Pictured, layer: str) -> np.ndarray:
    """A layer of a drawn map that is served, row 0 northernmost: a picture of uint8, or data. Raises ``InputError``."""
    pixels = known(layer).pixels
    return picture_layer(drawn, layer) if pixels is None else pixels(drawn)


def frame_layer(scene: Scene, frame: Frame, layer: str) -> np.ndarray:
    """Any layer of a frame, row 0 the upper one: a picture, or data, NaN where there is no surface. Raises ``InputError``."""
    data = known(layer).data
    return picture_layer(frame, layer) if data is None else data(scene, frame)


def known(layer: str) -> Layer:
    """A layer by its name. Raises ``InputError``."""
    if layer not in LAYERS:
        raise InputError("layer", layer, ", ".join(LAYERS))
    return LAYERS[layer]


def viewable(layer: str, array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """A layer as a picture for PNG, over the frame's ``color``; most are pictures already."""
    shown = LAYERS[layer].shown
    return array if shown is None else shown(array, color)


def encode_picture(array: np.ndarray, suffix: str) -> bytes:
    """PNG, lossless WebP or JPEG (of opaque colour) of a picture layer (RGB, RGBA or gray)."""
    if suffix == ".png":
        return encode_png(array)
    from PIL import Image

    out = io.BytesIO()
    image = Image.fromarray(array)
    if suffix == ".webp":
        image.save(out, "WEBP", lossless=True, method=1, exact=True)
    elif suffix in (".jpg", ".jpeg"):
        image.convert("RGB").save(out, "JPEG", quality=LOSSY_QUALITY)
    else:
        raise InputError("format", suffix, "png, webp, jpg")
    return out.getvalue()


def write_layer(scene: Scene, frame: Frame, layer: str, path: Path) -> None:
    """Write a layer to a file by its suffix; ``.tif`` of a map view is georeferenced. Raises ``InputError``."""
    suffix = path.suffix.lower()
    check_suffix(layer, path)
    array = frame_layer(scene, frame, layer)
    if suffix == ".npy":
        content = npy(array)
    elif suffix == ".tif":
        content = geotiff(array, frame.view, LAYERS[layer].nodata)
    else:
        content = encode_picture(viewable(layer, array, frame.color), suffix)
    write_whole(path, content)


def check_suffix(layer: str, path: Path) -> None:
    """Raise ``InputError`` unless a file of this suffix can hold the layer."""
    if path.suffix.lower() not in known(layer).suffixes:
        raise InputError("output", str(path), f"for layer {layer}: {', '.join(LAYERS[layer].suffixes)}")
    if not path.parent.is_dir():
        raise FileNotFoundError(2, "folder not found", str(path))


def geotiff(array: np.ndarray, view: object, nodata: float | None) -> bytes:
    """The bytes of a GeoTIFF of an array (rows, cols) or (rows, cols, bands); of a map view it is georeferenced."""
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.io import MemoryFile
    from rasterio.transform import from_bounds

    from skugga.terrain.geo.grid import MapView

    bands = array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)
    where = {}
    if isinstance(view, MapView):
        where = {"crs": view.grid.crs.to_wkt(), "transform": from_bounds(*view.bounds, view.cols, view.rows)}
    with warnings.catch_warnings(), MemoryFile() as file:
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # a perspective view has no place on a map
        with file.open(
            driver="GTiff", width=bands.shape[2], height=bands.shape[1], count=bands.shape[0], dtype=bands.dtype,
            **where, compress="deflate", nodata=nodata,
        ) as dataset:  # fmt: skip
            dataset.write(bands)
        return bytes(file.read())


def npy(array: np.ndarray) -> bytes:
    """The bytes of an array as a ``.npy`` file."""
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()
