"""Layers of a frame and their files: the same for the command line and HTTP."""

from __future__ import annotations

import io
import warnings
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from PIL import Image

from shadows.passes import PassLayer
from shadows.render import Frame
from terrain.errors import InputError
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import MapView
from terrain.scene import Scene

PictureLayer = Literal["color", "shadow", "mask"]
DataLayer = Literal["visibility", "depth", "position"]

PASS_LAYERS: frozenset[PassLayer] = frozenset(get_args(PassLayer))
LAYERS: tuple[str, ...] = (*get_args(PictureLayer), *get_args(DataLayer), *get_args(PassLayer))
SUFFIXES: dict[str, tuple[str, ...]] = {
    "color": (".png", ".webp", ".tif", ".jpg"),
    "shadow": (".png", ".webp", ".tif"), "mask": (".png", ".webp", ".tif"),
    "visibility": (".npy", ".tif"), "depth": (".npy", ".tif"), "position": (".npy",),
    "shadow-map": (".npy", ".png"), "stencil": (".npy", ".png"), "shadow-height": (".npy", ".tif"),
    "silhouettes": (".npy", ".png"), "volumes": (".npy", ".png"),
}  # fmt: skip
"""Layer -> file suffixes that can hold it without loss, or as a picture to look at."""

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
    def there(self) -> np.ndarray: ...

    @property
    def opaque(self) -> np.ndarray: ...


def picture_of(frame: Pictured, layer: str) -> np.ndarray:
    """A picture layer as a uint8 array, row 0 northernmost.

    ``color`` and ``shadow`` are RGBA (shadow: black, alpha = 1 - visibility), transparent where there is no surface (the sky of
    a perspective view's colour is opaque); ``mask`` is gray: 0 shadow, 255 lit, 128 no surface. Raises ``InputError``.
    """
    there, visibility = frame.there, frame.visibility
    if layer == "color":
        alpha = np.where(frame.opaque, np.uint8(255), np.uint8(0))
        return np.concatenate([frame.color, alpha[..., None]], axis=-1)
    if layer == "shadow":
        out = np.zeros((*there.shape, 4), np.uint8)
        out[..., 3] = np.rint(255.0 * (1.0 - np.where(there, visibility, 1.0)))
        return out
    if layer == "mask":
        return np.where(there, np.where(visibility < 0.5, MASK_SHADOW, MASK_LIT), MASK_NO_SURFACE).astype(np.uint8)
    raise InputError("layer", layer, ", ".join(get_args(PictureLayer)))


def layer_of(scene: Scene, frame: Frame, layer: str) -> np.ndarray:
    """Any layer of a frame, row 0 the upper one: a picture layer, or data with NaN where there is no surface.

    ``visibility`` is float32; ``depth`` float32, metres: in a map straight down from the level's highest ground, in
    perspective along the view's axis from the eye; ``position`` float64 (rows, cols, 3), x and y in the view's CRS (of a
    perspective view: that of the level's maps) and height in metres. The layers of ``shadows.passes`` are as they were kept,
    of the frame's first light. Raises ``InputError``.
    """
    if layer in get_args(PictureLayer):
        return picture_of(frame, layer)
    if layer in PASS_LAYERS:
        return _kept(frame, layer)
    view, there = frame.view, frame.there
    if layer == "visibility":
        return frame.visibility
    if layer == "depth" and isinstance(view, MapView):
        return np.where(there, scene.height_range_m[1] - frame.height_m, np.nan).astype(np.float32)
    if layer == "depth" and isinstance(view, PerspectiveView):
        return ((frame.position_earth_m - view.eye_earth_m) @ view.earth_from_camera[:, 2]).astype(np.float32)
    if layer == "position":
        out = np.full((view.rows, view.cols, 3), np.nan)
        row, col = np.nonzero(there)
        if isinstance(view, MapView):
            out[row, col, 0] = view.grid.x(view.col0 + col * view.col_step)
            out[row, col, 1] = view.grid.y(view.row0 + row * view.row_step)
            out[row, col, 2] = frame.height_m[row, col]
        elif frame.position_earth_m is not None:
            out[row, col] = np.stack(scene.world.map_position(scene.map_crs, frame.position_earth_m[row, col]), axis=-1)
        return out
    raise InputError("layer", layer, ", ".join(LAYERS))


def _kept(frame: Frame, layer: PassLayer) -> np.ndarray:
    by_light, light = frame.layers.get(layer, {}), next(iter(frame.visibilities))
    if not by_light:
        raise InputError("layer", layer, "a layer of something that was drawn: the view shows nothing under a light")
    if light not in by_light:
        raise InputError("light", light, f"for layer {layer}: {', '.join(by_light)}")
    return by_light[light]


def viewable(layer: str, array: np.ndarray, color: np.ndarray) -> np.ndarray:
    """A layer as a picture for PNG. ``shadow-map``: uint16, nearest to the light brightest, black where nothing casts.

    ``stencil``: uint8, its values spread so that the largest is bright. ``volumes``: uint8 (rows, cols, 3), translucent over the
    frame's ``color``, which is repeated where several algorithms left their volumes beside one another. Any other layer is a
    picture already.
    """
    if layer == "shadow-map":
        return np.rint(65535.0 * (1.0 - np.nan_to_num(array, nan=1.0))).astype(np.uint16)
    if layer == "stencil":
        return array * np.uint8(255 // max(int(array.max()), 1))
    if layer == "volumes":
        behind = np.tile(color, (array.shape[0] // color.shape[0], array.shape[1] // color.shape[1], 1))
        covered = (ALL_COVER * (1.0 - (1.0 - FACE_COVERS) ** np.arange(256)))[array, None]
        return np.rint((1.0 - covered) * behind + covered * np.array(VOLUME_COLOR)).astype(np.uint8)
    return array


def encode_picture(array: np.ndarray, suffix: str) -> bytes:
    """PNG, lossless WebP or JPEG (of opaque colour) of a picture layer (RGBA or gray)."""
    out = io.BytesIO()
    image = Image.fromarray(array)
    if suffix == ".png":
        image.save(out, "PNG", compress_level=4)
    elif suffix == ".webp":
        image.save(out, "WEBP", lossless=True, method=1, exact=True)
    elif suffix in (".jpg", ".jpeg"):
        image.convert("RGB").save(out, "JPEG", quality=92)
    else:
        raise InputError("format", suffix, "png, webp, jpg")
    return out.getvalue()


def write_layer(scene: Scene, frame: Frame, layer: str, path: Path) -> None:
    """Write a layer to a file by its suffix; ``.tif`` of a map view is georeferenced. Raises ``InputError``."""
    suffix = path.suffix.lower()
    check_suffix(layer, path)
    array = layer_of(scene, frame, layer)
    if suffix == ".npy":
        with path.open("wb") as file:
            np.save(file, array)
    elif suffix == ".tif":
        _write_tiff(frame, array, path)
    else:
        path.write_bytes(encode_picture(viewable(layer, array, frame.color), suffix))


def check_suffix(layer: str, path: Path) -> None:
    """Raise ``InputError`` unless a file of this suffix can hold the layer."""
    if layer not in SUFFIXES:
        raise InputError("layer", layer, ", ".join(LAYERS))
    if path.suffix.lower() not in SUFFIXES[layer]:
        raise InputError("output", str(path), f"for layer {layer}: {', '.join(SUFFIXES[layer])}")
    if not path.parent.is_dir():
        raise FileNotFoundError(2, "its folder does not exist", str(path))


def _write_tiff(frame: Frame, array: np.ndarray, path: Path) -> None:
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.transform import from_bounds

    bands = array[None] if array.ndim == 2 else np.moveaxis(array, -1, 0)
    view = frame.view
    where = {}
    if isinstance(view, MapView):
        where = {"crs": view.grid.crs.to_wkt(), "transform": from_bounds(*view.bounds, view.cols, view.rows)}
    nodata = np.nan if bands.dtype.kind == "f" else (MASK_NO_SURFACE if len(bands) == 1 else None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)  # a perspective view has no place on a map
        with rasterio.open(
            path, "w", driver="GTiff", width=view.cols, height=view.rows, count=bands.shape[0], dtype=bands.dtype,
            **where, compress="deflate", nodata=nodata,
        ) as dataset:  # fmt: skip
            dataset.write(bands)
