"""Models for tests: boards with a texture, a normal map or a gloss, as glTF files, and changes of their JSON."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

BOARD_M = (4.0, 4.0, 0.5)
"""Width, height and depth of a board."""


def board(**material: Any) -> trimesh.Trimesh:
    """Return an upright board in the axes of glTF. Each side shows the whole texture, upright on the four upright sides."""
    box = trimesh.creation.box(BOARD_M)
    corners, normals = box.vertices[box.faces].reshape(-1, 3), box.face_normals.repeat(3, axis=0)
    right = np.stack([normals[:, 2], np.abs(normals[:, 1]), -normals[:, 0]], axis=1)
    up = np.where(np.abs(normals[:, 1:2]) > 0.5, (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    right[:, 1] = 0.0
    right[np.abs(normals[:, 1]) > 0.5] = (1.0, 0.0, 0.0)
    uv = np.stack([np.sign(np.einsum("ij,ij->i", corners, axis)) for axis in (right, up)], axis=1) / 2.0 + 0.5
    mesh = trimesh.Trimesh(corners, np.arange(len(corners)).reshape(-1, 3), process=False)
    mesh.visual = TextureVisuals(uv=uv, material=PBRMaterial(**material))
    return mesh


def checker(side: int, count: int = 64) -> Image.Image:
    """Return a picture of black and white squares, ``side`` texels wide."""
    row, col = np.indices((count, count)) // side
    return Image.fromarray(np.repeat(((row + col) % 2 * 255).astype(np.uint8)[..., None], 3, axis=2))


def normal_map(x: float | np.ndarray, y: float | np.ndarray, count: int = 64) -> Image.Image:
    """Return the normal map of unit normals whose components to the right and upwards are ``x`` and ``y``."""
    vectors = np.zeros((count, count, 3))
    vectors[..., 0], vectors[..., 1] = x, y
    vectors[..., 2] = np.sqrt(1.0 - vectors[..., 0] ** 2 - vectors[..., 1] ** 2)
    return Image.fromarray(np.rint(127.5 + 127.5 * vectors).astype(np.uint8))


def write_gltf(path: Path, mesh: trimesh.Trimesh | trimesh.Scene, change: Callable[[dict[str, Any]], object]) -> None:
    """Write a .gltf file beside its data, with its JSON changed by ``change``."""
    scene = mesh if isinstance(mesh, trimesh.Scene) else trimesh.Scene(mesh)
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        if name == "model.gltf":
            described = json.loads(data)
            change(described)
            path.write_text(json.dumps(described))
        else:
            (path.parent / name).write_bytes(data)
