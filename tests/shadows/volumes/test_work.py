"""Counts of the work of shadow volumes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from skugga.shadows.volumes.settings import VolumeSettings
from skugga.shadows.volumes.work import stencil_counts
from skugga.shadows.work import Counts, Workload
from skugga.terrain.describe import describe
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import build_scene
from tests.rasters import write_geotiff

CELL_M, SIDE_CELLS = 2.0, 300


def counts_over_a_box(folder: Path, terrain: str, position: str, size: tuple[int, int]) -> Counts:
    """Return the counts of volumes in a map of one block with a box in its middle."""
    trimesh.creation.box(extents=(9.0, 9.0, 9.0)).export(folder / "box.ply")
    path = folder / "level.yaml"
    path.write_text(
        f"version: 1\nterrain: {terrain}\nsun: {{azimuth: 140, altitude: 30}}\nmeshes: [{{source: box.ply, at: {position}}}]\n",
        encoding="utf-8",
    )
    scene = build_scene(load_level(path))
    view = scene.view(size=size)
    return stencil_counts(Workload(describe(scene, view), SUN, ("meshes",)), VolumeSettings())


@pytest.mark.parametrize(("size", "nodes_per_cell"), [((256, 256), 1), ((512, 512), 4)])
def test_maps_on_a_globe_draw_the_receiving_ground_into_each_part(gl, tmp_path, size, nodes_per_cell):
    """A flat world's map is drawn in one part, and its ground has a plane's depth. On a globe parts have 256 pixels a side.

    Where pixels are smaller than cells the drawn ground has nodes between those of the raster, too.
    """
    side_m = CELL_M * SIDE_CELLS
    write_geotiff(tmp_path / "dem.tif", np.zeros((SIDE_CELLS, SIDE_CELLS), np.float32), "EPSG:32632", 5e5, 5.3e6, CELL_M)
    middle = "[9.004, 47.8508]"
    globe = counts_over_a_box(tmp_path, "{source: dem.tif}", middle, size)
    flat = counts_over_a_box(
        tmp_path, f"{{flat: {{size: [{side_m}, {side_m}], cells: [{SIDE_CELLS}, {SIDE_CELLS}]}}}}", "[0, 0]", size
    )
    assert (globe["sheets"], flat["sheets"]) == ((size[0] // 256) ** 2, 1.0)
    assert flat["receiver nodes"] == 0.0
    assert globe["receiver nodes"] == pytest.approx(nodes_per_cell * SIDE_CELLS**2, rel=0.01)
