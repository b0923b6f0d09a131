"""Models from OBJ, PLY and glTF files, with their colours.

- Units are metres.
- glTF is Y-up by its specification (section 3.4). It is rotated to east, north, up, with its front (+Z) facing south.
- OBJ and PLY do not state an up axis. They are read as Z-up, the convention of geodata and CAD.
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from skugga.terrain.errors import SourceError
from skugga.terrain.level.data_files import check_file
from skugga.terrain.level.linked_files import gltf_array
from skugga.terrain.meshes.body import MAX_SMOOTHED_CORNERS, NEUTRAL_GRAY, Body, srgb_albedo
from skugga.terrain.meshes.model_surface import describe_materials, read_surface

Y_UP_SUFFIXES = (".glb", ".gltf")

MODEL_SUFFIXES = (".obj", ".ply", *Y_UP_SUFFIXES)
"""Suffixes of model files. GDAL reads all other files."""

MAX_MODEL_TRIANGLES = 5_000_000

MAX_TEXTURE_PIXELS = 8192 * 8192

_REMEDY = "Use a model with triangles: .obj, .ply, .glb or .gltf"


def is_model(source: str) -> bool:
    """Return whether a file is a model, by its suffix."""
    return source.lower().endswith(MODEL_SUFFIXES)


def read_model(source: str) -> Body:
    """Return the model in a file as one body with its lowest point at height 0.

    The horizontal origin is the file's. Raises ``SourceError`` if the file is missing or broken, has no triangles, more than
    ``MAX_MODEL_TRIANGLES``, or coordinates that are not finite.
    """
    check_file(source)
    if not Path(source).exists():
        raise SourceError(source, "no such file", _REMEDY)
    parts = _load_parts(source)
    if sum(len(part.faces) for part in parts) > MAX_MODEL_TRIANGLES:
        raise _too_many_triangles(source, sum(len(part.faces) for part in parts))
    for part in parts:
        if not 0 <= part.faces.min() <= part.faces.max() < len(part.vertices):
            raise SourceError(source, "triangles refer to missing vertices", _REMEDY)
        _check_texture(source, part)
    y_up = source.lower().endswith(Y_UP_SUFFIXES)
    vertices, triangles, albedo, count = [], [], [], 0
    for part in parts:
        faces = np.asarray(part.faces)
        vertices.append(np.asarray(part.vertices, np.float64))
        triangles.append(faces + count)
        albedo.append(_albedo(part, linear=y_up))
        count += len(part.vertices)
    points = np.concatenate(vertices)
    if not np.isfinite(points).all():
        raise SourceError(source, "vertices that are not finite", "Use finite coordinates")
    if y_up:
        points = points[:, (0, 2, 1)] * (1.0, -1.0, 1.0)
    try:
        surface, notes = read_surface(parts)
    except (OSError, SyntaxError, TypeError, ValueError) as error:  # Pillow's errors of broken pictures, and wrong types in glTF
        raise SourceError(source, f"materials cannot be read ({str(error)[:80]})", "Use PNG or JPEG textures") from None
    colors = np.concatenate(albedo)
    if surface is not None:
        colors = np.where(surface.material[:, None] >= 0, surface.mean_albedo(), colors)
    body = _without_duplicates(Body(points, np.concatenate(triangles), colors, surface, notes))
    if not len(body.triangles):
        raise SourceError(source, "no triangle with an area", _REMEDY)
    lowest = body.vertices_m[body.triangles][..., 2].min()
    return replace(body, vertices_m=body.vertices_m - (0.0, 0.0, lowest))


def _without_duplicates(body: Body) -> Body:
    """Return a body without repeated triangles: only the first of identical triangles in the same orientation remains.

    Repetitions are looked for only if more corners meet at a vertex than on any usual surface (``MAX_SMOOTHED_CORNERS``).
    """
    merged_triangles = body.merged_triangles
    if not len(merged_triangles) or np.bincount(merged_triangles.ravel()).max() <= MAX_SMOOTHED_CORNERS:
        return body
    first = merged_triangles.argmin(axis=1)[:, None]
    rotated_triangles = np.take_along_axis(merged_triangles, (first + np.arange(3)) % 3, axis=1)
    _, unique_rows = np.unique(rotated_triangles, axis=0, return_index=True)
    unique_rows.sort()
    if len(unique_rows) == len(merged_triangles):
        return body
    surface = None if body.surface is None else body.surface.select(unique_rows)
    return replace(body, triangles=body.triangles[unique_rows], albedo=body.albedo[unique_rows], surface=surface)


def _load_parts(source: str) -> list[trimesh.Trimesh]:
    """Return the parts of a file that have triangles, as trimesh reads them. Suppresses trimesh's warnings and log messages."""
    _check_counts(source)
    log = logging.getLogger("trimesh")
    disabled, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(source, process=False, allow_remote=False)
            copies = sum(len(scene.geometry[name].faces) for name in _instance_names(scene))
            if copies > MAX_MODEL_TRIANGLES:
                raise _too_many_triangles(source, copies)
            describe_materials(source, scene)
            parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except SourceError:
        raise
    except Exception as error:  # trimesh's readers raise errors of any kind for broken files
        reason = " ".join(str(error).replace(source, "the file").split()) or type(error).__name__
        raise SourceError(source, f"cannot be read ({reason[:80]})", _REMEDY) from None
    finally:
        log.disabled = disabled
    if not parts:
        raise SourceError(source, "no triangle", _REMEDY)
    return parts


def _check_counts(source: str) -> None:
    """Raise ``SourceError`` for a glTF file with an accessor count that is negative, or larger than a model may have."""
    if not source.lower().endswith(Y_UP_SUFFIXES):
        return
    try:
        accessors = gltf_array(Path(source), "accessors")
    except (OSError, ValueError, RecursionError):
        return  # loading the file raises the error
    for number, accessor in enumerate(accessors):
        count = accessor.get("count")
        if not isinstance(count, int) or not 0 <= count <= 3 * MAX_MODEL_TRIANGLES:
            raise SourceError(source, f"accessor {number} has {count} elements", f"Use 0 to {3 * MAX_MODEL_TRIANGLES} elements")


def _too_many_triangles(source: str, count: int) -> SourceError:
    """Return the error of a model with ``count`` triangles, which are too many."""
    return SourceError.over_limit(source, f"{count} triangles", str(MAX_MODEL_TRIANGLES), "Simplify the model")


def _instance_names(scene: trimesh.Scene) -> list[str]:
    """Return the mesh's name of each instance in a scene. A mesh with several instances is listed several times."""
    names = [str(scene.graph[node][1]) for node in scene.graph.nodes_geometry]
    return [name for name in names if isinstance(scene.geometry.get(name), trimesh.Trimesh)]


def _check_texture(source: str, part: trimesh.Trimesh) -> None:
    """Raise ``SourceError`` for a texture that would take gigabytes once decoded."""
    material = getattr(part.visual, "material", None)
    image = material.baseColorTexture if isinstance(material, PBRMaterial) else getattr(material, "image", None)
    if image is not None and image.width * image.height > MAX_TEXTURE_PIXELS:
        pixels = f"a texture of {image.width} x {image.height} pixels"
        raise SourceError.over_limit(source, pixels, f"{MAX_TEXTURE_PIXELS} pixels", "Use a smaller texture")


def _albedo(part: trimesh.Trimesh, linear: bool) -> np.ndarray:
    """Return the linear albedo (m, 3) of a mesh's triangles.

    ``linear`` is whether colour factors are linear, as in glTF files, whose textures are sRGB (glTF 2.0, section 3.9.2). In other
    files all colours are sRGB.
    """
    decode = _linear_from_bytes if linear else _linear_from_srgb_bytes
    faces, visual = np.asarray(part.faces), part.visual
    if isinstance(visual, ColorVisuals) and visual.kind == "vertex":
        return decode(visual.vertex_colors)[faces].mean(axis=1)
    if isinstance(visual, ColorVisuals) and visual.kind == "face":
        return decode(visual.face_colors)
    if not isinstance(visual, TextureVisuals):
        return np.broadcast_to(srgb_albedo(NEUTRAL_GRAY), faces.shape)
    material = visual.material
    pbr = isinstance(material, PBRMaterial)
    if isinstance(material, PBRMaterial):
        image, factor = material.baseColorTexture, material.baseColorFactor
    else:
        image, factor = material.image, material.diffuse
    if image is None or visual.uv is None or len(visual.uv) != len(part.vertices):
        color = srgb_albedo(NEUTRAL_GRAY) if factor is None else decode(factor)
        return np.broadcast_to(color, faces.shape)
    texel = trimesh.visual.color.uv_to_color(np.asarray(visual.uv)[faces].mean(axis=1), image)
    tint = decode(factor) if pbr and factor is not None else np.ones(3, np.float32)
    return _linear_from_srgb_bytes(texel) * tint


def _linear_from_bytes(color: np.ndarray) -> np.ndarray:
    """Return linear colours (..., 3) float32 in [0, 1] from linear bytes (..., 3 or 4). Alpha is dropped."""
    return np.asarray(color)[..., :3].astype(np.float32) / np.float32(255)


def _linear_from_srgb_bytes(color: np.ndarray) -> np.ndarray:
    """Return linear colours (..., 3) float32 in [0, 1] from sRGB bytes (..., 3 or 4). Alpha is dropped."""
    return srgb_albedo(np.asarray(color)[..., :3] / 255.0)
