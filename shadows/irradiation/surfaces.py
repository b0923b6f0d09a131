"""The surface of a block that receives light, and the surfaces that shade it: bare ground, or ground with buildings and trees.

With objects, light is measured on what a map shows without its trees: ground, and roofs. Buildings are part of the surface that
shades it. So are crowns of trees, as columns that reach down to the ground (``skugga.shadows.horizons.object_ground``); under them
no light arrives but that which crowns let through.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from skugga.shadows.horizons.block_ground import block_grid
from skugga.shadows.horizons.grid import HorizonGrid
from skugga.shadows.horizons.object_ground import OBJECT_NODES, has_objects, is_under_crown, object_grids, roof_normals_enu
from skugga.shadows.horizons.sky_view import ground_slopes
from skugga.shadows.irradiation.planes import Plane, PlaneNormals, normals_of_plane, normals_of_slopes
from skugga.terrain.casters.caster_types import PATCH_QUADS, Patch
from skugga.terrain.gbuffer.bare_nodes import BareNodes, bare_nodes, bounding_positions
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import HeightWindow, Surface
from skugga.terrain.scene import Scene


@dataclass(frozen=True, eq=False)
class ShadingSurface:
    """A surface that shades a block.

    Attributes
    ----------
    grid
        The surface, and the eyes that receive light.
    share
        Its share of the light: of the two surfaces of a block with trees that let light through, one has none.
    window
        The surface round the block, for the sweep; ``None``: the ground of the block's nodes.
    lift_m
        float32 (rows, cols), metres: how far the surface lies above the eyes; infinite under crowns. ``None``: it lies at the eyes.
    without_trees
        The surface without its trees; ``None``: it has none.
    """

    grid: HorizonGrid
    share: float = 1.0
    window: HeightWindow | None = None
    lift_m: np.ndarray | None = None
    without_trees: HorizonGrid | None = None

    def patches_beside(self, patches: tuple[Patch, ...]) -> tuple[Patch, ...]:
        """Return the patches of ground that the surface does not hold itself."""
        window = self.window
        return patches if window is None else tuple(patch for patch in patches if not _is_inside(patch, window))


@dataclass(frozen=True, eq=False)
class BlockSurfaces:
    """The surfaces of a block.

    Attributes
    ----------
    nodes
        The nodes of the block, which bound what receives light.
    height_m
        float32 (rows, cols), metres: the height of the surface that receives light; NaN without one.
    normals
        The planes that receive light.
    plane
        Which planes these are.
    shading
        The surfaces that shade it.
    """

    nodes: BareNodes
    height_m: np.ndarray
    normals: PlaneNormals
    plane: Plane
    shading: tuple[ShadingSurface, ...]


def block_surfaces(scene: Scene, view: MapView, plane: Plane, transmissivity: float) -> BlockSurfaces:
    """Return the surfaces of a block.

    ``view`` has a node in each pixel. ``transmissivity`` is the share of light that comes through crowns of trees.
    """
    nodes = bare_nodes(scene, view, 1)
    if not has_objects(scene):
        grid = block_grid(scene, view)
        height_m = np.where(nodes.shows_ground, nodes.height_m, np.float32(np.nan))
        return BlockSurfaces(nodes, height_m, _normals(grid, plane), plane, (ShadingSurface(grid),))
    solid, wooded = object_grids(scene, view)
    window = _aligned_window(scene, view)
    under_sky = ShadingSurface(solid, transmissivity if wooded is not None else 1.0, _raised(window, view, solid))
    shading = [under_sky] if under_sky.share > 0.0 else []
    if wooded is not None and transmissivity < 1.0:
        lift_m = np.nan_to_num(wooded.height_m[wooded.eyes] - solid.eye_heights_m)
        lift_m[is_under_crown(solid, wooded)] = np.inf
        shading.append(ShadingSurface(wooded, 1.0 - transmissivity, _raised(window, view, wooded), lift_m, solid))
    tops = [float(np.nanmax(surface.window.height_m)) for surface in shading if surface.window is not None]
    low_m = float(np.nanmin(window.height_m)) if np.isfinite(window.height_m).any() else 0.0
    surface = Surface(scene.world, scene.elevation, view.grid)
    position_frame_m, valid = bounding_positions(surface, view, nodes.frame, (low_m, max(tops)))
    nodes = replace(nodes, position_frame_m=position_frame_m, valid=valid)
    normals = _normals(solid, plane)
    if plane == "ground":
        normals = _with_roofs(normals, roof_normals_enu(scene, view))
    height_m = np.where(nodes.shows_ground, solid.eye_heights_m, np.float32(np.nan))
    return BlockSurfaces(nodes, height_m, normals, plane, tuple(shading))


def _normals(grid: HorizonGrid, plane: Plane) -> PlaneNormals:
    """Return the normals of the planes at a grid's eyes."""
    shape = grid.eye_heights_m.shape
    if plane == "ground":
        return normals_of_slopes(*ground_slopes(grid))
    if plane == "level":
        zeros = np.zeros(shape, np.float32)
        return PlaneNormals(zeros, zeros, np.ones(shape, np.float32))
    return normals_of_plane(plane, (shape[0], shape[1]))


def _with_roofs(normals: PlaneNormals, roof_normal_enu: np.ndarray) -> PlaneNormals:
    """Return normals with those of roofs, float32 (rows, cols, 3), where they are not NaN."""
    is_roof = np.isfinite(roof_normal_enu[..., 0])
    east, north, up = (
        np.where(is_roof, roof_normal_enu[..., axis], component) for axis, component in enumerate(normals.components)
    )
    return PlaneNormals(east, north, up)


def _aligned_window(scene: Scene, view: MapView) -> HeightWindow:
    """Return the bare ground round a block as far as objects count, to the sides of whole patches of casters."""
    (first_row, rows), (first_col, cols) = (
        _aligned(int(first), count) for first, count in ((view.row0, view.rows), (view.col0, view.cols))
    )
    surface = Surface(scene.world, scene.elevation, view.grid)
    window = surface.height_window(first_row, first_col, rows, cols, includes_rim=True)
    return HeightWindow(window.row0, window.col0, np.array(window.height_m), window.valid)


def _aligned(first: int, count: int) -> tuple[int, int]:
    """Return the first node and the number of nodes of whole patches round a row of nodes, with a margin for objects."""
    start = (first - OBJECT_NODES) // PATCH_QUADS * PATCH_QUADS
    stop = -(-(first + count - 1 + OBJECT_NODES) // PATCH_QUADS) * PATCH_QUADS
    return start, stop - start + 1


def _raised(window: HeightWindow, view: MapView, grid: HorizonGrid) -> HeightWindow:
    """Return a window of heights, raised to the surface of a grid where that has heights."""
    heights_m = window.height_m.copy()
    eye_row, eye_col = (eyes.start for eyes in grid.eyes)
    row, col = int(view.row0) - eye_row - window.row0, int(view.col0) - eye_col - window.col0
    rows, cols = grid.height_m.shape
    first_row, first_col = max(row, 0), max(col, 0)
    last_row, last_col = min(row + rows, window.shape[0]), min(col + cols, window.shape[1])
    place = slice(first_row, last_row), slice(first_col, last_col)
    source = slice(first_row - row, last_row - row), slice(first_col - col, last_col - col)
    heights_m[place] = np.fmax(heights_m[place], grid.height_m[source])
    return HeightWindow(window.row0, window.col0, heights_m, window.valid)


def _is_inside(patch: Patch, window: HeightWindow) -> bool:
    """Return whether a window holds all nodes of a patch at full detail."""
    if patch.lod:
        return False
    row, col = patch.row * PATCH_QUADS - window.row0, patch.col * PATCH_QUADS - window.col0
    rows, cols = window.shape
    return 0 <= row and row + PATCH_QUADS < rows and 0 <= col and col + PATCH_QUADS < cols
