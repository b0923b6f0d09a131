"""Generated scenes for calibration: grounds, meshes and forests of several sizes, written as levels to a temporary folder.

They contain nothing of the levels that Skugga bundles. So the bundled levels can test the predictions.
"""

from __future__ import annotations

import json
from collections.abc import Container, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.generated_ground import ENGINEERING_CRS_WKT
from skugga.terrain.level.level import CasterKind, load_level
from skugga.terrain.scene import Scene, build_scene

FLOOR_TERRAIN: dict[str, Any] = {"flat": {"size": [160, 160], "cells": [80, 80]}}
"""A level's ``terrain``: a flat ground of 160 x 160 m."""

BALL_RADIUS_M = 5.0
"""Default radius of the balls of ``_balls``, metres."""

GLOBE_CRS, GLOBE_MIDDLE_M = "EPSG:32632", (500_000.0, 5_300_000.0)
"""CRS of the scenes on a globe, and the coordinates of their middle."""


@dataclass(frozen=True, eq=False)
class CalibrationView:
    """A view of a generated scene.

    Attributes
    ----------
    name
        Name of the scene.
    scene
        The scene.
    view
        The view.
    light
        Name of the light to time.
    kinds
        Kinds of casters whose shadows are timed.
    calibration_extent
        Which settings of each algorithm are timed: all (``full``), less (``some``), or only those that need this scene (``few``).
    """

    name: str
    scene: Scene
    view: MapView | PerspectiveView
    light: str
    kinds: tuple[CasterKind, ...]
    calibration_extent: str


def calibration_views(folder: Path, names: Container[str] | None = None) -> Iterator[CalibrationView]:
    """Yield the calibration views of some names, or all. The files of their levels are written to ``folder``."""
    for name, level, view, size, light, kinds, calibration_extent in calibration_levels(folder):
        if names is not None and name not in names:
            continue
        path = folder / f"{name}.yaml"
        path.write_text(json.dumps({"version": 1, **level}), encoding="utf-8")  # JSON is YAML
        scene = build_scene(load_level(path))
        yield CalibrationView(name, scene, scene.view(view, size=size), light, kinds, calibration_extent)


def calibration_levels(
    folder: Path,
) -> Iterator[tuple[str, dict[str, Any], str, tuple[int, int], str, tuple[CasterKind, ...], str]]:
    """Yield the definition of each calibration view.

    It holds the name, the content of a level file, the name of the view, its width and height in pixels, and the ``light``,
    ``kinds`` and ``calibration_extent`` of ``CalibrationView``. Files to which the levels refer are written to ``folder``.
    """
    few, several, many = _balls(folder, 1, 5), _balls(folder, 1, 40), _balls(folder, 3, 36)
    near, wide = _camera([-30, -46, 34], [0, -4, 0]), _camera([40, -70, 60], [0, 0, 0])
    spot: dict[str, Any] = {"kind": "spot", "position": [20, -30, 60], "target": [0, 0, 0], "cutoff": 40}
    yield "few_balls", _level(FLOOR_TERRAIN, near, meshes=[few]), "main", (640, 512), "sun", ("meshes",), "full"
    yield (
        "few_balls_small",
        _level(FLOOR_TERRAIN, wide, meshes=[few], sun=(300, 20)),
        "main",
        (360, 280),
        "sun",
        ("meshes",),
        "some",
    )
    yield "many_balls", _level(FLOOR_TERRAIN, wide, meshes=[many]), "main", (640, 512), "sun", ("meshes",), "some"
    yield (
        "many_balls_large",
        _level(FLOOR_TERRAIN, near, meshes=[many], sun=(60, 48)),
        "main",
        (960, 720),
        "sun",
        ("meshes",),
        "few",
    )
    dense = _box_lattice(folder)
    low, far = _camera([-26, -34, 16], [0, 0, 6]), _camera([60, -50, 48], [0, 0, 0])
    yield "lattice", _level(FLOOR_TERRAIN, low, meshes=[dense], sun=(100, 24)), "main", (640, 512), "sun", ("meshes",), "some"
    yield "lattice_far", _level(FLOOR_TERRAIN, far, meshes=[dense], sun=(220, 40)), "main", (400, 320), "sun", ("meshes",), "few"
    yield "few_balls_map", _level(FLOOR_TERRAIN, near, meshes=[few], sun=(60, 45)), "map", (256, 256), "sun", ("meshes",), "full"
    yield "many_balls_map", _level(FLOOR_TERRAIN, near, meshes=[many], sun=(60, 25)), "map", (384, 384), "sun", ("meshes",), "some"
    for name, cell_m, size_px in (("globe_map", 0.5, 512), ("coarse_globe_map", 2.0, 320)):
        level = _level(_plain_on_globe(folder, name, cell_m), near, meshes=[_moved(several)], sun=(60, 25))
        x, y = GLOBE_MIDDLE_M
        level["views"] = {"map": {"kind": "map", "bounds": [x - 56.0, y - 56.0, x + 56.0, y + 56.0]}}
        yield name, level, "map", (size_px, size_px), "sun", ("meshes",), "some"
    for kind, lamp in (("spot", spot), ("omni", {"kind": "omni", "position": [8, -8, 30]})):
        level = _level(FLOOR_TERRAIN, near, meshes=[many], sun=None) | {"lights": {"lamp": lamp}}
        yield f"{kind}_balls", level, "main", (640, 512), "lamp", ("meshes",), "full"
        level = _level(FLOOR_TERRAIN, wide, meshes=[few], sun=None) | {"lights": {"lamp": lamp}}
        yield f"{kind}_few_balls", level, "main", (360, 280), "lamp", ("meshes",), "some"
    hills, fine_hills = _hills(3200, 40, 350), _hills(4000, 16, 500)
    over, down = _camera([-900, -1100, 900], [0, 0, 0]), _camera([1200, 900, 1500], [-200, 0, 0])
    yield "hills", _level(hills, over, sun=(120, 25)), "main", (640, 512), "sun", ("relief",), "full"
    yield "fine_hills", _level(fine_hills, down, sun=(250, 15)), "main", (480, 400), "sun", ("relief",), "some"
    wide, high_camera = _hills(8000, 8, 700), _camera([-2200, -2600, 1900], [0, 0, 0])
    yield "wide_hills", _level(wide, high_camera, sun=(200, 20)), "main", (400, 320), "sun", ("relief",), "few"
    yield "wide_hills_map", _level(wide, high_camera, sun=(310, 12)), "map", (448, 448), "sun", ("relief",), "few"
    yield "hills_map", _level(hills, over, sun=(120, 25)), "map", (280, 280), "sun", ("relief",), "full"
    yield "fine_hills_map", _level(fine_hills, down, sun=(250, 15)), "map", (256, 256), "sun", ("relief",), "some"
    houses = {**_balls(folder, 2, 60, radius_m=12.0), "at": _positions(60, 900.0)}
    grove, wood = _forest(folder, "grove", 400.0, 60.0), _forest(folder, "wood", 1500.0, 130.0)
    close = _camera([-150, -200, 160], [0, 0, 0])
    all_kinds: tuple[CasterKind, ...] = ("relief", "meshes", "forest")
    yield (
        "grove",
        _level(hills, close, meshes=[houses], forest=[grove], sun=(200, 35)),
        "main",
        (640, 512),
        "sun",
        all_kinds,
        "some",
    )
    yield "wood", _level(hills, over, forest=[wood], sun=(150, 22)), "main", (400, 320), "sun", ("relief", "forest"), "few"
    above = _camera([10, -50, 70], [0, 0, 0])
    yield "below_in_the_wood", _level(hills, above, forest=[wood], sun=(70, 50)), "main", (400, 320), "sun", ("forest",), "few"
    yield "wood_map", _level(hills, over, forest=[wood], sun=(150, 40)), "map", (448, 448), "sun", ("forest",), "few"
    inside = {"kind": "map", "bounds": [-400.0, -400.0, 400.0, 400.0]}
    level = _level(hills, over, forest=[wood], sun=(150, 40))
    level["views"]["map"] = inside
    yield "in_the_wood_map", level, "map", (384, 384), "sun", ("forest",), "few"
    yield "grove_map", _level(hills, over, forest=[grove], sun=(150, 30)), "map", (320, 320), "sun", ("forest",), "few"


def _level(
    terrain: dict[str, Any], main: dict[str, Any], sun: tuple[float, float] | None = (140.0, 38.0), **level_keys: Any
) -> dict[str, Any]:
    """Return the content of a level file with a terrain, the view ``main``, and a view ``map`` of the ground's middle.

    ``terrain`` and ``main`` are entries of the level file. ``sun`` is an azimuth and an altitude in degrees; ``None``: no sun.
    ``level_keys`` are further keys of the level file.
    """
    placed: Any = "none" if sun is None else {"azimuth": sun[0], "altitude": sun[1]}
    size_m = (terrain.get("flat") or terrain.get("generate") or {"size": [160.0]})["size"]
    half_m = 0.35 * size_m[0]  # away from the rim, where the ground ends
    plan = {"kind": "map", "bounds": [-half_m, -half_m, half_m, half_m]}
    return {"terrain": terrain, "views": {"main": main, "map": plan}, "sun": placed, **level_keys}


def _plain_on_globe(folder: Path, name: str, cell_m: float) -> dict[str, Any]:
    """Return a level's ``terrain``: a plain of 160 x 160 m with a CRS, so that the world is a globe.

    Its raster, which is named after ``name`` and has cells of ``cell_m`` metres, is written to ``folder``.
    """
    import rasterio

    cells, (x, y) = round(160.0 / cell_m), GLOBE_MIDDLE_M
    path = folder / f"{name}.tif"
    with rasterio.open(
        path, "w", driver="GTiff", width=cells, height=cells, count=1, dtype="float32", crs=GLOBE_CRS,
        transform=rasterio.transform.from_origin(x - 80.0, y + 80.0, cell_m, cell_m),
    ) as raster:  # fmt: skip
        raster.write(np.zeros((1, cells, cells), np.float32))
    return {"source": path.name}


def _moved(meshes: dict[str, Any]) -> dict[str, Any]:
    """Return an entry of a level's ``meshes`` with its positions moved from the origin to ``GLOBE_MIDDLE_M``, as longitudes and
    latitudes.
    """
    from pyproj import Transformer

    to_lon_lat = Transformer.from_crs(GLOBE_CRS, "OGC:CRS84", always_xy=True)
    positions = [to_lon_lat.transform(GLOBE_MIDDLE_M[0] + x, GLOBE_MIDDLE_M[1] + y) for x, y in meshes["at"]]
    return {**meshes, "at": [list(position) for position in positions]}


def _camera(eye: list[float], target: list[float]) -> dict[str, Any]:
    """Return the level file's entry of a perspective view, with the positions x, y and z of eye and target in metres."""
    return {"kind": "perspective", "eye": eye, "target": target, "fov": 45}


def _hills(side_m: float, cell_m: float, relief_m: float) -> dict[str, Any]:
    """Return a level's ``terrain``: generated ridges, ``relief_m`` metres high, on a square.

    The square has sides of ``side_m`` metres and cells of ``cell_m`` metres.
    """
    return {"generate": {"kind": "ridges", "size": [side_m, side_m], "cell": cell_m, "relief": relief_m, "seed": 5}}


def _positions(count: int, side_m: float) -> list[list[float]]:
    """Return evenly spread positions x and y, metres, in a square with sides of ``side_m`` around the origin.

    They are multiples of the golden ratio along one axis, and even steps along the other. There are ``count`` of them.
    """
    number = np.arange(count)
    places = np.stack([(number * 0.6180339887498949) % 1.0 - 0.5, (number + 0.5) / count - 0.5], axis=1)
    return np.round(places * side_m, 3).tolist()


def _balls(folder: Path, halvings: int, count: int, radius_m: float = BALL_RADIUS_M) -> dict[str, Any]:
    """Return an entry of a level's ``meshes``: ``count`` balls with 20 x 4^halvings triangles each, on evenly spread positions.

    The file of a ball is written to ``folder``.
    """
    import trimesh

    path = folder / f"ball_{halvings}_{radius_m:g}.ply"
    trimesh.creation.icosphere(subdivisions=halvings, radius=radius_m).export(path)
    return {"source": path.name, "at": _positions(count, 110.0)}


def _box_lattice(folder: Path) -> dict[str, Any]:
    """Return an entry of a level's ``meshes``: a lattice of 8 x 8 x 6 boxes, whose shadow volumes overlap in many layers."""
    import trimesh

    steps = (np.arange(count) - (count - 1) / 2.0 for count in (8, 8, 6))
    places = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3) * np.array([4.0, 4.0, 2.5])
    boxes = [trimesh.creation.box((1.2, 1.2, 1.2), trimesh.transformations.translation_matrix(place)) for place in places]
    trimesh.util.concatenate(boxes).export(folder / "lattice.ply")
    return {"source": "lattice.ply", "at": [0.0, 0.0]}


def _forest(folder: Path, name: str, side_m: float, density: float) -> dict[str, Any]:
    """Return an entry of a level's ``forest``: a square with sides of ``side_m`` metres, with ``density`` trees per hectare.

    The file of the square, which is named after ``name``, is written to ``folder``.
    """
    half = side_m / 2.0
    ring = [[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path = folder / f"{name}.geojson"
    crs = {"type": "name", "properties": {"name": ENGINEERING_CRS_WKT}}
    path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}), encoding="utf-8")
    return {"source": path.name, "density": density, "height": [8, 16], "species": "mixed", "seed": 3}
