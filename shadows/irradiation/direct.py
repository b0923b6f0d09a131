"""Direct light: the irradiation of a block from the sun's direction, sun by sun.

The line sweep (``skugga.shadows.sweep``) says which cells see each sun. Its light counts there by the cosine of the angle of
incidence. Suns are sorted by azimuth, and their light is added up in the order of the sweep's grid, which is turned a few times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from skugga.shadows.horizons.block_ground import block_plane
from skugga.shadows.irradiation.planes import PlaneNormals, normals_in_block_plane
from skugga.shadows.irradiation.suns import SunIntervals
from skugga.shadows.irradiation.surfaces import BlockSurfaces, ShadingSurface
from skugga.shadows.sun_hours.sun_hours import LINES_PER_COLUMN, under_clear_sky
from skugga.shadows.sweep.orientation import GridOrientation, copy_values
from skugga.shadows.sweep.sweep import NodeClearance, clearance_of_nodes
from skugga.terrain.casters.ground_extent import holds_all_ground
from skugga.terrain.casters.reach import find_sun_casters
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.geo.sun import Sun, azimuth_and_altitude, direction_enu
from skugga.terrain.scene import Scene


class DirectLight:
    """Adds up the direct light of a block.

    ``height_index`` (rows, cols) is the (fractional) number of each cell's height among those that light is given for.
    """

    def __init__(self, scene: Scene, surfaces: BlockSurfaces, height_index: np.ndarray) -> None:
        self._scene, self._surfaces, self._height_index = under_clear_sky(scene), surfaces, height_index
        nodes = surfaces.nodes
        self._plane = block_plane(scene.world, nodes.view, *nodes.view.centre_node)
        self._normals = normals_in_block_plane(surfaces.normals, self._plane.east_north_of_cell_m, scene.world.curvature)
        self._has_all_ground = holds_all_ground(scene, nodes.view)

    def irradiation(
        self, suns: SunIntervals, lights: Sequence[np.ndarray], numbers: np.ndarray, on_sun: Callable[[], None]
    ) -> list[np.ndarray]:
        """Return the irradiation by some of the suns, float32 (rows, cols), kWh/m2, for each kind of light.

        ``lights`` (heights, n) are on planes that face the sun, W/m2. ``numbers`` (m,) selects suns. ``on_sun()`` is called after
        each of them.
        """
        energy_kwh = np.ascontiguousarray(np.moveaxis(np.stack(lights) * suns.hours / 1000.0, -1, 0), np.float32)
        sums = [_TurnedSums(self._normals, self._height_index, len(lights), surface) for surface in self._surfaces.shading]
        for number in numbers[np.argsort(suns.azimuth_deg[numbers], kind="stable")].tolist():
            towards = _towards_enu(suns, number)
            for clearance, surface_sums in zip(self._clearances(suns, number), sums, strict=True):
                surface_sums.add(clearance, towards.astype(np.float32), energy_kwh[number])
            on_sun()
        totals = [np.zeros(self._height_index.shape, np.float32) for _ in lights]
        for surface, surface_sums in zip(self._surfaces.shading, sums, strict=True):
            for total, light_sum in zip(totals, surface_sums.totals(), strict=True):
                total += np.float32(surface.share) * light_sum
        return totals

    def lit_cells(self, suns: SunIntervals, number: int) -> np.ndarray:
        """Return which cells see a sun behind opaque trees, bool (rows, cols). ``number`` is its index."""
        clearance, surface = list(self._clearances(suns, number))[-1], self._surfaces.shading[-1]
        ray_height_m = clearance.ray_height_m
        if surface.lift_m is not None:
            lift_m = clearance.orientation.sun_aligned_view(surface.lift_m)
            ray_height_m = ray_height_m - lift_m * np.float32(clearance.ray_height_per_metre)
        return clearance.orientation.grid_order_view(ray_height_m >= clearance.shadow_ray_height_m)

    def _clearances(self, suns: SunIntervals, number: int) -> Iterator[NodeClearance]:
        """Yield the ray heights of each shading surface under a sun, whose index is ``number``."""
        lit = self._lit_scene(_towards_enu(suns, number), float(suns.refraction_deg[number]))
        nodes = self._surfaces.nodes
        patches = () if self._has_all_ground else find_sun_casters(lit, nodes)
        for surface in self._surfaces.shading:
            yield clearance_of_nodes(nodes, lit, surface.patches_beside(patches), LINES_PER_COLUMN, surface.window)

    def _lit_scene(self, towards_enu: np.ndarray, refraction_deg: float) -> Scene:
        """Return the scene under the sun in a direction (3,), east, north and up at the block's centre."""
        to_sun_earth = self._plane.earth_from_enu @ towards_enu
        at_anchor = azimuth_and_altitude(to_sun_earth, self._scene.world.earth_from_anchor)
        return replace(self._scene, sun=Sun(*at_anchor, to_sun_earth, None, refraction_deg))


def _towards_enu(suns: SunIntervals, number: int) -> np.ndarray:
    """Return the direction (3,) to a sun, east, north and up, at the position of the suns. ``number`` is its index."""
    return direction_enu(float(suns.azimuth_deg[number]), float(suns.altitude_deg[number]))


class _TurnedSums:
    """Sums of ``count`` kinds of direct light, in the order of the sun-aligned grid of the current orientation."""

    def __init__(self, normals: PlaneNormals, height_index: np.ndarray, count: int, surface: ShadingSurface) -> None:
        self._rasters = (*normals.components, height_index)
        self._lift_m = surface.lift_m
        self._totals = np.zeros((count, *height_index.shape), np.float32)
        self._orientation: GridOrientation | None = None
        self._turned: tuple[np.ndarray, ...] = ()
        self._turned_lift_m: np.ndarray | None = None
        self._sums = np.zeros((count, 0, 0), np.float32)

    def add(self, clearance: NodeClearance, towards: np.ndarray, energy_kwh: np.ndarray) -> None:
        """Add the light of a sun in the direction ``towards`` (east, north, up).

        ``energy_kwh`` (count, heights) is the energy of each kind of light at the heights, on a plane that faces the sun, kWh/m2.
        """
        self._turn(clearance.orientation)
        ray_height_m = clearance.ray_height_m
        if self._turned_lift_m is not None:
            ray_height_m = ray_height_m - self._turned_lift_m * np.float32(clearance.ray_height_per_metre)
        run_in_chunks(
            len(ray_height_m), _add_direct_light, ray_height_m, clearance.shadow_ray_height_m, *self._turned, towards, energy_kwh,
            self._sums,
        )  # fmt: skip

    def totals(self) -> np.ndarray:
        """Return the sums of all suns, float32 (count, rows, cols)."""
        self._flush()
        return self._totals

    def _turn(self, orientation: GridOrientation) -> None:
        """Continue in the order of an orientation."""
        if orientation == self._orientation:
            return
        self._flush()
        self._orientation = orientation
        self._turned = tuple(_turned_copy(raster, orientation) for raster in self._rasters)
        self._turned_lift_m = None if self._lift_m is None else _turned_copy(self._lift_m, orientation)
        self._sums = np.zeros((len(self._totals), *self._turned[0].shape), np.float32)

    def _flush(self) -> None:
        """Add the sums of the current orientation to the totals."""
        if self._orientation is not None:
            for total, light_sum in zip(self._totals, self._sums, strict=True):
                total += self._orientation.grid_order_view(light_sum)
        self._orientation = None


def _turned_copy(raster: np.ndarray, orientation: GridOrientation) -> np.ndarray:
    """Return a raster (rows, cols) in the order of an orientation of the grid."""
    view = orientation.sun_aligned_view(raster)
    out = np.empty(view.shape, view.dtype)
    copy_values(view, out)
    return out


# The loops compile to vector instructions. Unsigned indices cannot be negative, so the compiler omits a test.


@compiled
def _add_direct_light(first, last, ray_height, shadow_ray_height, east, north, up, height_index, towards, energy, out):
    """Add the light of one sun to rows [first, last) of ``out`` (kinds, n, m).

    A cell sees the sun if ``ray_height`` is not below ``shadow_ray_height``. ``east``, ``north`` and ``up`` are unit normals,
    ``towards`` (3,) is the direction to the sun in these axes. ``energy`` (kinds, k) is the energy of each kind of light at
    heights, whose (fractional) number is ``height_index``.
    """
    to_east, to_north, to_up = towards[0], towards[1], towards[2]
    last_step, cols = np.int32(energy.shape[1] - 2), out.shape[2]
    cosines = np.empty(cols, np.float32)  # 0 in shadow
    for row in range(first, last):
        for col in range(cols):
            cosine = max(to_up * up[row, col] + east[row, col] * to_east + north[row, col] * to_north, np.float32(0.0))
            cosines[col] = cosine if ray_height[row, col] >= shadow_ray_height[row, col] else np.float32(0.0)
        for kind in range(out.shape[0]):
            at_height, sums, index = energy[kind], out[kind, row], height_index[row]
            for col in range(cols):
                step = min(np.int32(index[col]), last_step)
                share, below = index[col] - np.float32(step), np.uintp(step)
                sums[col] += cosines[col] * (at_height[below] + share * (at_height[below + np.uintp(1)] - at_height[below]))
