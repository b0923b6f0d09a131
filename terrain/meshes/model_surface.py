"""Textures and materials of model files, as trimesh reads them, with what trimesh drops of glTF: samplers and alpha modes.

Not read: a second set of texture coordinates, texture transforms, and textures of emission, occlusion, roughness and metallic
factor; the mean of the last two counts. Warnings tell what of these changes the picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from skugga.terrain.level.linked_files import gltf_array
from skugga.terrain.meshes.surface import (
    ROUGH_METAL,
    WRAP_CLAMP,
    WRAP_MIRROR,
    WRAP_REPEAT,
    Material,
    Surface,
    Texture,
    color_texture,
    normal_texture,
)
from skugga.terrain.srgb import linear_of_srgb

MATERIAL_KEY = "skugga_material"
"""Key of a mesh's metadata in trimesh: the JSON object of its material in the glTF file, with its ``number``."""

GLTF_WRAPS = {33071: WRAP_CLAMP, 33648: WRAP_MIRROR, 10497: WRAP_REPEAT}
"""Wrap modes by their numbers in glTF files."""

TRIANGLE_MODES = (4, 5)
"""Modes of glTF primitives that trimesh reads as triangles: lists and strips. Lists are the default."""

READ_MODES = (0, 1, *TRIANGLE_MODES)
"""Modes of glTF primitives that trimesh reads: points and lines, too."""


def _gltf_materials(path: Path) -> list[dict[str, Any]]:
    """Return the materials of a glTF file as JSON objects. Samplers are resolved: each texture has ``wrap``, its wrap modes."""
    materials, textures, samplers = (gltf_array(path, name) for name in ("materials", "textures", "samplers"))
    for texture in textures:
        sampler = _item(samplers, texture.get("sampler"))
        texture["wrap"] = tuple(GLTF_WRAPS.get(sampler.get(key, 10497), WRAP_REPEAT) for key in ("wrapS", "wrapT"))
    for number, material in enumerate(materials):
        material["number"] = number
        for info in (material.get("normalTexture"), _part(material, "pbrMetallicRoughness").get("baseColorTexture")):
            if isinstance(info, dict):
                info["wrap"] = _item(textures, info.get("index")).get("wrap", (WRAP_REPEAT, WRAP_REPEAT))
    return materials


def describe_materials(source: str, scene: trimesh.Scene) -> None:
    """Write the material of each mesh of a glTF file as a JSON object to the mesh's metadata, which copies keep.

    trimesh keeps the order of the file's primitives. Meshes of other files do not change.
    """
    if not source.lower().endswith((".glb", ".gltf")):
        return
    materials = _gltf_materials(Path(source))
    primitives = [
        primitive
        for mesh in gltf_array(Path(source), "meshes")
        for primitive in mesh.get("primitives", [])
        if primitive.get("mode", 4) in READ_MODES
    ]
    geometries = list(scene.geometry.values())
    if len(primitives) != len(geometries):
        primitives = [{} for _ in geometries]
    for primitive, geometry in zip(primitives, geometries, strict=True):
        geometry.metadata[MATERIAL_KEY] = _item(materials, primitive.get("material"))


def read_surface(parts: list[trimesh.Trimesh]) -> tuple[Surface | None, tuple[str, ...]]:
    """Return textures and materials of a file's meshes, and warnings. ``None`` if each triangle has one colour and no gloss."""
    materials: dict[tuple[object, ...], Material] = {}
    textures: dict[tuple[object, ...], Texture] = {}
    ignored: dict[str, dict[str, None]] = {}
    uvs, colors, numbers = [], [], []
    for part in parts:
        faces, described = np.asarray(part.faces), _part(part.metadata, MATERIAL_KEY)
        uv, color = _uv(part), _vertex_colors(part, is_linear=MATERIAL_KEY in part.metadata)
        for problem in _ignored(described, has_uv=uv is not None):
            ignored.setdefault(problem, {})[str(described.get("name") or f"number {described['number']}")] = None
        key = _material_key(part, described, uv is not None)
        if key not in materials:
            materials[key] = _read_material(part, described, uv is not None, textures)
        material = materials[key]
        varies = material.texture is not None or material.normal_map is not None or material.is_glossy
        varies = varies or (color is not None and bool(np.ptp(color[faces], axis=1).any()))
        uvs.append(np.zeros((*faces.shape, 2), np.float32) if uv is None else uv[faces])
        colors.append(np.ones((*faces.shape, 3), np.float32) if color is None else color[faces])
        numbers.append(np.full(len(faces), list(materials).index(key) if varies else -1, np.int32))
    surface = Surface(np.concatenate(uvs), np.concatenate(colors), np.concatenate(numbers), tuple(materials.values()))
    warnings = tuple(f"material {_names(sorted(names))} {problem}" for problem, names in ignored.items())
    return (surface if (surface.material >= 0).any() else None), warnings


def _names(names: list[str]) -> str:
    """Return the first of some names, and how many others there are."""
    return f"'{names[0]}'" + (f" (and {len(names) - 1} more)" if len(names) > 1 else "")


def _uv(part: trimesh.Trimesh) -> np.ndarray | None:
    """Return the texture coordinates (n, 2) float32 of a mesh's vertices, from the upper left corner; ``None`` without."""
    visual = part.visual
    if not isinstance(visual, TextureVisuals) or visual.uv is None or len(visual.uv) != len(part.vertices):
        return None
    uv = np.asarray(visual.uv, np.float64)[:, :2] * (1.0, -1.0) + (0.0, 1.0)  # trimesh counts from the lower left corner
    return uv.astype(np.float32) if np.isfinite(uv).all() else None


def _vertex_colors(part: trimesh.Trimesh, is_linear: bool) -> np.ndarray | None:
    """Return the linear colours (n, 3) float32 of a mesh's vertices; ``None`` without. glTF has linear ones, other files sRGB."""
    visual = part.visual
    if isinstance(visual, TextureVisuals):
        values = visual.vertex_attributes.get("color")
    else:
        values = visual.vertex_colors if isinstance(visual, ColorVisuals) and visual.kind == "vertex" else None
    if values is None or len(values) != len(part.vertices):
        return None
    values = np.asarray(values)[:, :3]
    largest = np.iinfo(values.dtype).max if values.dtype.kind in "ui" else 1
    share = np.clip(np.nan_to_num(values.astype(np.float64) / largest), 0.0, 1.0)
    return (share if is_linear else linear_of_srgb(share)).astype(np.float32)


def _material_key(part: trimesh.Trimesh, described: dict[str, Any], has_uv: bool) -> tuple[object, ...]:
    """Return a key that is the same for parts of one material."""
    visual = part.visual
    if described:
        return "gltf", described["number"], has_uv
    return ("visual", id(visual.material), has_uv) if isinstance(visual, TextureVisuals) else ("colors",)


def _read_material(
    part: trimesh.Trimesh, described: dict[str, Any], has_uv: bool, textures: dict[tuple[object, ...], Texture]
) -> Material:
    """Return the material of a mesh. ``described`` is its JSON object. ``textures`` caches those of the file by picture."""
    visual = part.visual
    if not isinstance(visual, TextureVisuals):
        return Material()
    source = visual.material
    if not isinstance(source, PBRMaterial):
        image = source.image if has_uv else None
        return Material(texture=None if image is None else _texture(image, (WRAP_REPEAT,) * 2, False, textures))
    base, bumps = _part(_part(described, "pbrMetallicRoughness"), "baseColorTexture"), _part(described, "normalTexture")
    texture = normal_map = None
    if has_uv and source.baseColorTexture is not None and not base.get("texCoord"):
        texture = _texture(source.baseColorTexture, base.get("wrap", (WRAP_REPEAT,) * 2), False, textures)
    if has_uv and source.normalTexture is not None and not bumps.get("texCoord"):
        normal_map = _texture(source.normalTexture, bumps.get("wrap", (WRAP_REPEAT,) * 2), True, textures)
    roughness, metallic = (1.0 if value is None else float(value) for value in (source.roughnessFactor, source.metallicFactor))
    if source.metallicRoughnessTexture is not None:
        means = np.asarray(source.metallicRoughnessTexture.convert("RGB")).mean(axis=(0, 1)) / 255.0
        roughness, metallic = roughness * means[1], metallic * means[2]
    roughness, metallic = (min(max(value, 0.0), 1.0) for value in (roughness, metallic))
    is_glossy = bool(described) and min(roughness, metallic) < ROUGH_METAL
    factor = _part(described, "pbrMetallicRoughness").get("baseColorFactor", (1.0, 1.0, 1.0))
    red, green, blue = (min(max(float(value), 0.0), 1.0) for value in factor[:3])
    return Material((red, green, blue), texture, normal_map, float(bumps.get("scale", 1.0)), roughness, metallic, is_glossy)


def _texture(
    image: Image.Image, wrap: tuple[int, int], is_normal_map: bool, textures: dict[tuple[object, ...], Texture]
) -> Texture:
    """Return the texture of a picture, from the cache ``textures`` if another material of the file has it, too."""
    key = image.size, image.mode, image.tobytes(), wrap, is_normal_map
    if key not in textures:
        textures[key] = (normal_texture if is_normal_map else color_texture)(image, wrap)
    return textures[key]


def _ignored(described: dict[str, Any], has_uv: bool) -> list[str]:
    """Return what a glTF material asks for that is ignored. ``has_uv`` is whether it has texture coordinates."""
    problems, mode = [], described.get("alphaMode", "OPAQUE")
    if mode != "OPAQUE":
        problems.append(f"has alphaMode {mode}, which is ignored: it is drawn and casts shadows as if it were opaque")
    infos = {
        "baseColorTexture": _part(_part(described, "pbrMetallicRoughness"), "baseColorTexture"),
        "normalTexture": _part(described, "normalTexture"),
    }
    for key, info in infos.items():
        if info and not has_uv:
            problems.append(f"has a {key}, but its triangles have no texture coordinates: it is not shown")
        elif info.get("texCoord"):
            problems.append(f"has a {key} with texture coordinates {info['texCoord']}, which are not read. Use coordinates 0")
        elif "KHR_texture_transform" in _part(info, "extensions"):
            problems.append(f"has a {key} with a transform, which is ignored. Apply it to the texture coordinates")
    if "emissiveTexture" in described or any(described.get("emissiveFactor", [])):
        problems.append("emits light, which is ignored")
    return problems


def _part(item: dict[str, Any], key: str) -> dict[str, Any]:
    """Return the JSON object under a key; empty without one."""
    value = item.get(key)
    return value if isinstance(value, dict) else {}


def _item(items: list[dict[str, Any]], number: object) -> dict[str, Any]:
    """Return an element of a JSON array of objects; empty if it has none with this number."""
    return items[number] if isinstance(number, int) and 0 <= number < len(items) else {}
