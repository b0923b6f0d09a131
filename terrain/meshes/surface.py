"""Surfaces of models: textures with mip levels, colours of vertices, normal maps and gloss, for each triangle.

Texture coordinates have their origin in the upper left corner of the picture, as in glTF.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from PIL import Image

from skugga.terrain.meshes.texture_loops import sample_centroids
from skugga.terrain.meshes.texture_types import Atlas
from skugga.terrain.srgb import linear_of_srgb, srgb_of_linear

WRAP_REPEAT, WRAP_CLAMP, WRAP_MIRROR = 0, 1, 2
"""Modes of coordinates outside of a texture."""

NORMAL_STEPS = 127.0
"""Steps of a normal map's components from 0 to 1. Its bytes 127 and 128 both are 0, which 8 bits cannot express exactly."""

NORMAL_SCALE = 32767.0
"""Integer value of the component 1 of a normal in an ``Atlas``."""

ROUGH_METAL = 0.99
"""Roughness and metallic factor from which on a metal scatters light as Lambert's law says: the default material of glTF."""


@dataclass(frozen=True, eq=False)
class Texture:
    """A picture on triangles.

    Attributes
    ----------
    levels
        Mip levels (h, w, 3), each half as large as the one before, down to one texel: uint8 sRGB of colours, or int16 vectors of
        normals, whose length is less than 1 where they are means.
    wrap
        Modes of coordinates outside of the picture, across and down.
    """

    levels: tuple[np.ndarray, ...]
    wrap: tuple[int, int] = (WRAP_REPEAT, WRAP_REPEAT)

    @cached_property
    def ranges(self) -> np.ndarray:
        """Smallest and largest linear value of each channel in each level of colours, (levels, 2, 3)."""
        extremes = [(level.min(axis=(0, 1)), level.max(axis=(0, 1))) for level in self.levels]
        return linear_of_srgb(np.array(extremes) / 255.0)

    @cached_property
    def tilts(self) -> np.ndarray:
        """Largest tangent of the angle between a normal and the surface's in each level of normals, (levels,)."""
        vectors = [level.reshape(-1, 3).astype(np.float64) for level in self.levels]
        return np.array([(np.hypot(v[:, 0], v[:, 1]) / np.maximum(v[:, 2], 1.0)).max() for v in vectors])

    def level_at(self, texels: float) -> int:
        """Return the finest mip level that a footprint at least ``texels`` wide is filtered from."""
        return min(int(np.log2(max(texels, 1.0))), len(self.levels) - 1)


@dataclass(frozen=True, eq=False)
class Material:
    """What triangles are made of.

    Attributes
    ----------
    factor
        (3,), linear factor of the colour.
    texture, normal_map
        Pictures of colours and of normals; ``None`` without.
    normal_scale
        Factor of the tangential components of the normal map.
    roughness, metallic
        Factors of glTF, 0 to 1.
    is_glossy
        Whether the material mirrors the sun. Other materials follow Lambert's law.
    """

    factor: tuple[float, float, float] = (1.0, 1.0, 1.0)
    texture: Texture | None = None
    normal_map: Texture | None = None
    normal_scale: float = 1.0
    roughness: float = 1.0
    metallic: float = 0.0
    is_glossy: bool = False


class SurfaceBounds(NamedTuple):
    """Bounds of what one material's triangles of a body show.

    Attributes
    ----------
    material
        The material.
    uv_per_m
        Smallest change of the texture coordinates over a metre on a triangle, in any direction.
    albedo_range
        (2, 3), smallest and largest albedo of the triangles' mean colours.
    color_range
        (2, 3), smallest and largest colour of the corners.
    """

    material: Material
    uv_per_m: float
    albedo_range: np.ndarray
    color_range: np.ndarray

    def shown_range(self, pixel_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return bounds (3,) of the albedo that pixels show that are at least ``pixel_m`` wide."""
        low, high = self.color_range * self.material.factor
        if self.material.texture is not None:
            texture = self.material.texture
            level = texture.level_at(self.uv_per_m * pixel_m * min(texture.levels[0].shape[:2]))
            low, high = low * texture.ranges[level, 0], high * texture.ranges[level, 1]
        return low, high

    def tilt(self, pixel_m: float) -> float:
        """Return an upper bound of the change of a unit normal by the normal map, for pixels at least ``pixel_m`` wide."""
        texture = self.material.normal_map
        if texture is None:
            return 0.0
        level = texture.level_at(self.uv_per_m * pixel_m * min(texture.levels[0].shape[:2]))
        return float(abs(self.material.normal_scale) * texture.tilts[level])


@dataclass(frozen=True, eq=False)
class Surface:
    """The materials of m triangles.

    Attributes
    ----------
    uv
        float32 (m, 3, 2), texture coordinates of the corners.
    color
        float32 (m, 3, 3), linear colours of the corners, factors of the texture.
    material
        int32 (m,), index in ``materials``; -1 for triangles of one colour.
    materials
        The materials.
    """

    uv: np.ndarray
    color: np.ndarray
    material: np.ndarray
    materials: tuple[Material, ...]

    def select(self, selection: np.ndarray) -> Surface:
        """Return the surface of the triangles that indices or a mask select."""
        return Surface(self.uv[selection], self.color[selection], self.material[selection], self.materials)

    @cached_property
    def atlas(self) -> Atlas:
        """All textures and materials as arrays for compiled loops."""
        return make_atlas(self.materials)

    def bounds(self, corners_m: np.ndarray, albedo: np.ndarray) -> list[SurfaceBounds]:
        """Return the bounds of each material in use, for triangles with corners (m, 3, 3) and mean colours ``albedo`` (m, 3)."""
        stretch, out = _uv_per_m(corners_m, self.uv), []
        for number in np.unique(self.material[self.material >= 0]):
            uses = self.material == number
            color = self.color[uses].reshape(-1, 3)
            out.append(
                SurfaceBounds(
                    self.materials[number],
                    float(stretch[uses].min()),
                    np.stack([albedo[uses].min(axis=0), albedo[uses].max(axis=0)]),
                    np.stack([color.min(axis=0), color.max(axis=0)]),
                )  # fmt: skip
            )
        return out

    def mean_albedo(self) -> np.ndarray:
        """Return the albedo (m, 3) float32 of each triangle: the texture at its centroid, as blurred as the triangle is wide."""
        out = np.ones((len(self.uv), 3), np.float32)
        sample_centroids(self.uv, self.color, self.material, self.atlas, out)
        return out


def _uv_per_m(corners_m: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return the smallest change (m,) of texture coordinates over a metre: the lesser singular value of each triangle's mapping."""
    edges = corners_m[:, 1:] - corners_m[:, :1]
    first = np.linalg.norm(edges[:, 0], axis=1)
    x = edges[:, 0] / np.maximum(first, 1e-30)[:, None]
    along = np.einsum("ij,ij->i", edges[:, 1], x)
    up = np.linalg.norm(edges[:, 1] - along[:, None] * x, axis=1)
    du = (uv[:, 1:] - uv[:, :1]).astype(np.float64)
    a = du[:, 0] / np.maximum(first, 1e-30)[:, None]
    b = (du[:, 1] - along[:, None] * a) / np.maximum(up, 1e-30)[:, None]
    total, det = np.einsum("ij,ij->i", a, a) + np.einsum("ij,ij->i", b, b), a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return np.sqrt(np.maximum(0.5 * (total - np.sqrt(np.maximum(total * total - 4.0 * det * det, 0.0))), 0.0))


def plain_surface(count: int) -> Surface:
    """Return the surface of ``count`` triangles of one colour each."""
    return Surface(
        np.zeros((count, 3, 2), np.float32), np.ones((count, 3, 3), np.float32), np.full(count, -1, np.int32), ()
    )  # fmt: skip


def concatenate_surfaces(surfaces: Sequence[Surface | None], counts: Sequence[int]) -> Surface | None:
    """Return the surface of several sets of triangles in order, of which each has ``counts`` triangles. ``None`` if none has one.

    Materials that several sets share are stored once.
    """
    if all(surface is None for surface in surfaces):
        return None
    materials: dict[Material, int] = {}
    parts, numbers = [], []
    for surface, count in zip(surfaces, counts, strict=True):
        part = plain_surface(count) if surface is None else surface
        number = np.array([*(materials.setdefault(item, len(materials)) for item in part.materials), -1], np.int32)
        parts.append(part)
        numbers.append(number[part.material])
    uv, color = (np.concatenate([getattr(part, name) for part in parts]) for name in ("uv", "color"))
    return Surface(uv, color, np.concatenate(numbers), tuple(materials))


def color_texture(image: Image.Image, wrap: tuple[int, int]) -> Texture:
    """Return the texture of a picture of sRGB colours. Its means are those of linear light; its alpha is dropped."""
    first = np.asarray(image.convert("RGB"))
    linear = linear_of_srgb(np.arange(256) / 255.0).astype(np.float32)[first]
    means = [np.rint(255.0 * srgb_of_linear(level)).astype(np.uint8) for level in _box_means(linear)]
    return Texture((first, *means), wrap)


def normal_texture(image: Image.Image, wrap: tuple[int, int]) -> Texture:
    """Return the texture of a normal map: unit vectors, and their means in its mip levels."""
    offset = np.asarray(image.convert("RGB")).astype(np.float32) - 127.5
    vector = np.sign(offset) * np.maximum(np.abs(offset) - 0.5, 0.0) / NORMAL_STEPS
    vector[..., 2] = np.maximum(vector[..., 2], 1e-3)
    vector /= np.linalg.norm(vector, axis=-1, keepdims=True)
    return Texture(tuple(np.rint(NORMAL_SCALE * level).astype(np.int16) for level in (vector, *_box_means(vector))), wrap)


def _box_means(values: np.ndarray) -> list[np.ndarray]:
    """Return the levels below ``values`` (h, w, 3) float32: each is the box-filtered mean of the one before at half its size."""
    levels = []
    while max(values.shape[:2]) > 1:
        height, width = (max(side // 2, 1) for side in values.shape[:2])
        channels = [Image.fromarray(np.ascontiguousarray(values[..., k])) for k in range(3)]
        values = np.stack([np.asarray(channel.resize((width, height), Image.Resampling.BOX)) for channel in channels], axis=-1)
        levels.append(values)
    return levels


def make_atlas(materials: Sequence[Material]) -> Atlas:
    """Return the textures of materials one after another, with the parameters of the materials."""
    atlases: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]] = {}
    for name, dtype in (("texture", np.uint8), ("normal_map", np.int16)):
        textures = list(dict.fromkeys(texture for item in materials if (texture := getattr(item, name)) is not None))
        texels, index = [np.zeros((0, 3), dtype)], {}
        rows: list[tuple[int, ...]] = []
        first = 0
        for texture in textures:
            index[texture] = len(rows)
            for number, level in enumerate(texture.levels):
                height, width = level.shape[:2]
                rows.append((first, height, width, *texture.wrap, len(texture.levels) - number))
                texels.append(level.reshape(-1, 3))
                first += height * width
        of_material = [-1 if getattr(item, name) is None else index[getattr(item, name)] for item in materials]
        levels = np.array(rows, np.int64).reshape(-1, 6)
        atlases[name] = np.concatenate(texels), levels, np.array(of_material, np.int64)
    factors = [(*m.factor, m.normal_scale, m.roughness, m.metallic, float(m.is_glossy)) for m in materials]
    return Atlas(
        linear_of_srgb(np.arange(256) / 255.0), *atlases["texture"], *atlases["normal_map"],
        np.array(factors, np.float64).reshape(-1, 7),
    )  # fmt: skip
