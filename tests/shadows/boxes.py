"""Boxes over level ground, and their visibility by shadow maps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import shadow_map
from skugga.shadows.passes import PassLog
from skugga.shadows.visibility import receivers_of
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.render import plan_of

View = MapView | PerspectiveView


def box(size_m: tuple[float, float, float], bottom_m: float = 0.0, at_m: tuple[float, float] = (0.0, 0.0)) -> trimesh.Trimesh:
    """Return a closed box over a position, its faces outwards.

    A pebble on the ground keeps a hovering box from being set down.
    """
    mesh = trimesh.creation.box(extents=size_m)
    mesh.apply_translation([*at_m, bottom_m + size_m[2] / 2])
    if not bottom_m:
        return mesh
    pebble = trimesh.creation.box(extents=(0.01, 0.01, 0.01))
    pebble.apply_translation([*at_m, 0.005])
    return trimesh.util.concatenate([mesh, pebble])


def build_mesh_scene(folder: Path, meshes: list[trimesh.Trimesh], azimuth: float, altitude: float, **keys) -> Scene:
    """Return a scene of meshes, whose heights count from level ground of 200 m a side."""
    names = [f"mesh{number}.obj" for number in range(len(meshes))]
    for name, mesh in zip(names, meshes, strict=True):
        mesh.export(folder / name)
    level = {
        "version": 1, "terrain": {"flat": {"size": [200, 200], "cells": [20, 20]}},
        "meshes": [{"source": name, "at": [0, 0]} for name in names],
        "sun": {"azimuth": azimuth, "altitude": altitude}, **keys,
    }  # fmt: skip
    path = folder / "boxes.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")  # JSON is YAML
    return build_scene(load_level(path))


def visibility(
    scene: Scene, view: View, light: str = "sun", bias_scale: float = 1.0, **overrides
) -> tuple[np.ndarray, GeometryBuffer]:
    """Return the visibility of a light by shadow maps, and its geometry buffer. Attached shadow counts; NaN marks no surface."""
    buffer = geometry_buffer(scene, view)
    rendered = np.ones(buffer.valid.shape, np.float32)
    for step in plan_of(scene, view, algorithm="shadow_map", **overrides).steps:
        if step.light == light and step.settings is not None:
            settings = step.settings.model_copy(update={"bias_scale": bias_scale})
            receivers = receivers_of(buffer, scene, light)
            rendered *= shadow_map.fill_visibility(
                receivers, scene, light, step.kinds, find_casters(scene, buffer), settings, PassLog()
            )
    rendered[attached_shadow_mask(buffer, scene, light)] = 0.0
    rendered[~buffer.valid] = np.nan
    return rendered, buffer
