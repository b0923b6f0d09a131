"""Sites for cases about places, world scale and time: hills with houses, anywhere, as far as each algorithm can serve them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from scipy.ndimage import gaussian_filter

from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View
from tests.rasters import ENGINEERING

HOUSE_POSITIONS_M = [[-60.3, 20.7], [-20.1, -40.9], [33.7, 5.3], [55.9, -70.1], [10.3, 71.7]]
"""Metres east and north of the ground's middle."""

CELLS, CELL_M = 96, 4.0


def hills(cells: int = CELLS, height_m: float = 60.0, seed: int = 11) -> np.ndarray:
    """Return rolling heights (cells, cells) float32 with a range of some metres and a roughness of decimetres per cell."""
    noise = np.random.default_rng(seed).normal(size=(2, cells, cells))
    broad, rough = gaussian_filter(noise[0], 7.0, mode="wrap"), gaussian_filter(noise[1], 1.0, mode="wrap")
    return (height_m * broad / np.abs(broad).max() + 0.5 * rough).astype(np.float32)


def site(
    trial: Trial, sun: tuple[float, float] = (237.0, 17.0), offset: tuple[float, float] = (0.0, 0.0), name: str = "site"
) -> Scene:
    """Return hills with houses in an engineering CRS, the raster's middle at an offset in metres.

    The sweep gets the hills without houses. Algorithms that project shadows on a plane get a level floor with the houses.
    """
    heights = hills() if trial.algorithm != "planar" else np.zeros((CELLS, CELLS), np.float32)
    half = CELLS * CELL_M / 2
    raster = trial.raster(heights, ENGINEERING, offset[0] - half, offset[1] + half, CELL_M, name=name)
    houses: dict = {}
    if trial.algorithm != "sweep":
        trimesh.creation.box(extents=(21.0, 13.0, 24.0)).export(trial.folder / "house.ply")
        houses = {"meshes": [{"source": "house.ply", "at": HOUSE_POSITIONS_M, "turn": 17.3}]}
    oblique = {"kind": "perspective", "eye": [150.3, 110.7, 70], "target": [0, 0, 0], "fov": 45, "size": [128, 96]}
    return trial.scene(raster, sun, name=name, views={"oblique": oblique}, **houses)


def views_of(trial: Trial, scene: Scene, px: int) -> Iterator[View]:
    """Return the views of a site that its algorithm serves: the oblique one, and the map where the algorithm has maps."""
    yield scene.view("oblique", size=(px, px * 3 // 4))
    if trial.serves_maps:
        yield scene.view(size=(px, px))


def differing_share(first: RenderedView, second: RenderedView) -> float:
    """Return the share of the pixels whose class differs between two pictures; each picture must have both light and shadow."""
    valid = first.buffer.valid
    assert 0.02 < first.dark[valid].mean() < 0.98, "light and shadow"
    return float(((first.dark != second.dark) | (valid != second.buffer.valid)).mean())
