"""The ground of a block with the objects that stand on it: buildings as part of the surface, trees as crowns above it.

Buildings have the heights of a map's drawn surface, seen from above, so a wall stands between two nodes. A crown has the outline of
its tree's picture (``skugga.terrain.trees.crown_tops``) and reaches down to the ground. Objects count up to ``OBJECT_NODES`` from a
block, the bare ground beyond.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from skugga.shadows.horizons.block_ground import block_grid
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.terrain.gbuffer.ground_normals import directions_enu
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.tree_instances import tree_instances_in_map
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import BLOCK_PX, MapView
from skugga.terrain.scene import Scene
from skugga.terrain.trees.crown_tops import crown_profiles, raise_to_crowns

OBJECT_NODES = 512
"""Distance from a block, in nodes, up to which objects count."""

MIN_CROWN_M = 0.5
"""Height of a crown above the surface, metres, from which on it hides the sky overhead."""


def has_objects(scene: Scene) -> bool:
    """Return whether meshes or trees stand on a level's ground."""
    return bool(set(scene.objects.caster_kinds) - {"relief"})


def object_grids(scene: Scene, block: MapView) -> tuple[HorizonGrid, HorizonGrid | None]:
    """Return the ground of a block with its buildings, and the same with its trees, too; ``None`` without trees.

    The eyes of both stand on the ground and on roofs, below the trees.
    """
    bare = block_grid(scene, block)
    margins = [
        (min(eyes.start, OBJECT_NODES), min(total - eyes.stop, OBJECT_NODES))
        for eyes, total in zip(bare.eyes, bare.height_m.shape, strict=True)
    ]
    (up, down), (before, after) = margins
    window = block.part(-up, -before, block.rows + up + down, block.cols + before + after)
    place = (
        slice(bare.eyes[0].start - up, bare.eyes[0].stop + down),
        slice(bare.eyes[1].start - before, bare.eyes[1].stop + after),
    )
    solid = _with_surface(bare, place, _surface_height_m(_without_trees(scene), window))
    if "forest" not in scene.objects.caster_kinds:
        return solid, None
    wooded = replace(solid, height_m=_with_crowns(scene, block, solid), eye_height_m=solid.eye_heights_m)
    return solid, wooded


def is_under_crown(solid: HorizonGrid, wooded: HorizonGrid) -> np.ndarray:
    """Return which eyes have a crown above them, bool (eye rows, eye cols)."""
    return wooded.height_m[wooded.eyes] > solid.height_m[solid.eyes] + np.float32(MIN_CROWN_M)


def roof_normals_enu(scene: Scene, view: MapView) -> np.ndarray:
    """Return the unit normals of buildings that a map shows without trees, float32 (rows, cols, 3): east, north and up.

    They are NaN elsewhere.
    """
    scene, out = _without_trees(scene), np.full((view.rows, view.cols, 3), np.nan, np.float32)
    for row, col, part in _drawn_parts(view):
        buffer = geometry_buffer(scene, part)
        normals = directions_enu(scene, part, buffer.frame, buffer.normal_frame)
        is_building = (buffer.surface_kind == MESHES)[..., None]
        out[row : row + part.rows, col : col + part.cols] = np.where(is_building, normals, np.float32(np.nan))
    return out


def _with_surface(grid: HorizonGrid, place: tuple[slice, slice], surface_m: np.ndarray) -> HorizonGrid:
    """Return a grid whose ground is raised to a surface, float32, at the nodes of ``place``; NaN leaves it as it is."""
    height_m = grid.height_m.copy()
    height_m[place] = np.fmax(height_m[place], surface_m)
    return replace(grid, height_m=height_m)


def _with_crowns(scene: Scene, block: MapView, solid: HorizonGrid) -> np.ndarray:
    """Return the heights of a block's ground and buildings, float32 (rows, cols), metres, raised to the tops of crowns.

    Where cells are so wide that maps draw fewer and wider trees, crowns are as wide as those, and as high as the trees are.
    """
    height_m, grid, trees = solid.height_m.copy(), block.grid, scene.objects.trees
    pixel_m = float(np.sqrt(abs(np.linalg.det(solid.east_north_of_cell_m))))
    drawn = tree_instances_in_map(scene.objects, scene.world.frame_near(grid.crs, *block.centre), pixel_m)
    if trees is None or drawn is None:
        return height_m
    x, y, base_height_m = scene.objects.trees_in_crs(grid.crs)[drawn.tree_number].T
    row, col = (
        (index - start) / step
        for index, start, step in ((grid.row(y), block.row0, block.row_step), (grid.col(x), block.col0, block.col_step))
    )
    raise_to_crowns(
        height_m, row + solid.eyes[0].start, col + solid.eyes[1].start, drawn.quad_sizes_m[:, 0].astype(np.float64), base_height_m,
        trees.height_m[drawn.tree_number].astype(np.float64), drawn.variant, crown_profiles(), solid.east_north_of_cell_m,
    )  # fmt: skip
    return height_m


def _surface_height_m(scene: Scene, window: MapView) -> np.ndarray:
    """Return the heights of the drawn surface at the pixels of a map, float32 (rows, cols), metres; NaN without a surface."""
    out = np.full((window.rows, window.cols), np.nan, np.float32)
    for row, col, part in _drawn_parts(window):
        buffer = geometry_buffer(scene, part)
        out[row : row + part.rows, col : col + part.cols] = np.where(buffer.valid, buffer.height_m, np.float32(np.nan))
    return out


def _drawn_parts(view: MapView) -> Iterator[tuple[int, int, MapView]]:
    """Yield the parts of a map in which its surface is drawn, with their first row and column."""
    for row in range(0, view.rows, BLOCK_PX):
        for col in range(0, view.cols, BLOCK_PX):
            yield row, col, view.part(row, col, min(BLOCK_PX, view.rows - row), min(BLOCK_PX, view.cols - col))


def _without_trees(scene: Scene) -> Scene:
    """Return a scene without its trees."""
    level = scene.loaded.level
    if not level.forest:
        return scene
    bare = scene.loaded.model_copy(update={"level": level.model_copy(update={"forest": type(level.forest)()})})
    return replace(scene, loaded=bare, objects=replace(scene.objects, loaded=bare))
