"""Scenes and reference frames of ``benchmarks.effects``: a plain, and frames that run no code of effects or plans."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
from affine import Affine

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.render import bands_of
from skugga.terrain.gbuffer.antialias import picture_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import encode_srgb, shade
from skugga.terrain.sky import sky_pixel_colors

SIDE_PX, CELL_M, WAVELENGTH_M, RELIEF_M = 1024, 10.0, 2500.0, 0.3
"""The plain: cells and map pixels per side, size of a cell, and wavelength and height of its sinusoidal ground."""


def level_scene(folder: Path, keys: dict[str, Any]) -> Scene:
    """Write a level file with the given keys and the version into a folder, and build its scene."""
    path = folder / "level.yaml"
    path.write_text(json.dumps({"version": 1, **keys}), encoding="utf-8")
    return build_scene(load_level(path))


def plain_scene(folder: Path) -> Scene:
    """Return a scene of a plain in UTM with decimetres of relief, under a clear sky at noon."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] * (2.0 * np.pi * CELL_M / WAVELENGTH_M)
    heights = (100.0 + 0.5 * RELIEF_M * np.sin(x) * np.sin(y)).astype(np.float32)
    transform = Affine(CELL_M, 0.0, 500_000.0, 0.0, -CELL_M, 5_300_000.0)
    shape = {"height": SIDE_PX, "width": SIDE_PX, "count": 1, "dtype": "float32", "crs": "EPSG:32633", "transform": transform}
    with rasterio.open(folder / "plain.tif", "w", driver="GTiff", **shape) as dataset:
        dataset.write(heights, 1)
    views = {
        "map": {"kind": "map", "size": [SIDE_PX, SIDE_PX]},
        "camera": {"kind": "perspective", "eye": [15.04, 47.79, 60], "target": [15.08, 47.82, 0], "fov": 45, "size": [1280, 1024]},
    }
    # The only effects that a plain calls for, in perspective.
    effects = {"ground_materials": "off", "ground_detail": "off", "haze": "off"}
    keys = {"terrain": {"source": "plain.tif"}, "sun": {"azimuth": 180, "altitude": 60}, "views": views, "effects": effects}
    return level_scene(folder, keys)


def frame_without_effects(scene: Scene, view: MapView | PerspectiveView) -> list[np.ndarray]:
    """Return colours, visibility, heights and, in perspective, positions of a frame without cast shadows and effects.

    All arrays have the shape (rows, cols, ...): sRGB colours, visibility in [0, 1], and metres.
    """
    blocks = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    arrays: list[np.ndarray] = []
    for block_view, row, col in blocks:
        pieces = _block_without_effects(scene, block_view)
        arrays = arrays or [np.zeros((view.rows, view.cols, *piece.shape[2:]), piece.dtype) for piece in pieces]
        window = tuple(slice(max(offset, 0), end) for offset, end in ((row, view.rows), (col, view.cols)))
        for out, piece in zip(arrays, pieces, strict=True):
            inside = piece[max(-row, 0) : view.rows - row, max(-col, 0) : view.cols - col]
            out[window][: inside.shape[0], : inside.shape[1]] = inside
    return arrays


def _block_without_effects(scene: Scene, view: MapView | PerspectiveView) -> list[np.ndarray]:
    """Return the arrays of ``frame_without_effects`` for one block of a map, or one band of rows of a perspective view."""
    is_map = isinstance(view, MapView)
    picture = picture_buffer(scene, view)
    buffer, own_buffer = picture.buffer, picture.pixel_buffer
    visibility = 1.0 - attached_shadow_mask(buffer, scene).astype(np.float32)
    linear, layers = shade(buffer, scene, visibility), [visibility[: view.rows], own_buffer.height_m]
    if not is_map:
        row, col = np.nonzero(~buffer.valid)
        linear[row, col] = sky_pixel_colors(scene, view, *picture.pixels_of_points(row, col))
        linear = picture.average_samples(linear)
        layers.append(own_buffer.position_frame_m)
    return [encode_srgb(linear), *layers]
