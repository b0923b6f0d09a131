"""`sweep`: the sun's shadows of a heightfield by lines along the sun's azimuth, in time linear in its nodes, without OpenGL.

``skugga.shadows.sweep.lines`` describes the algorithm. The ground that casts shadows is the drawn ground at full detail. Accuracy
does not depend on the azimuth. Only ground casts shadows, but anything that stands on it receives them: at each position a line
gives the height above which the sun is visible.

**Windows.** Ground towards the sun comes in patches, with a coarser level of detail farther away
(``skugga.terrain.casters.reach``). Each level of detail is swept separately, the coarsest first. A sweep ends with the highest ray
height on each line, and the next finer sweep starts from these. This is valid because a maximum does not depend on the order along
a line. The coarser ground must lie towards the sun. Within a level of detail, strips of lines are independent and are distributed
over several cores.

**Lines.** The t of a position is its right coordinate in light space, in cells. All points of a ray have the same t. The rays'
positions on a grid are computed for ground of mean height. On the round earth the vertical direction changes by a hundredth of a
degree per kilometre. So high ground far from the reference position is shifted sideways from the line that was computed for it. The
shift is some metres at the far corners of a wide block.

**The sun's disc** (``filter`` sun) is a set of points, each a sun with an azimuth and an altitude of its own
(``skugga.shadows.area_light``). Each point has its own lines: suns of other azimuths cross other nodes.

**Points.** A map's nodes are evaluated at their positions. Other points are sorted by the pair of grid rows between which they lie.
Points of the ground take their ray height from the triangles that cast shadows. In a perspective view these are the triangles of
the drawn ground, decimated or not.

**Columns.** If the ground consists of upright columns, each point has its own ray (``skugga.shadows.sweep.columns``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from skugga.shadows.algorithm import AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.area_light import mean_visibility_of_area_light, scale_work
from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.requirements import Requirement
from skugga.shadows.sweep.columns import column_sweep
from skugga.shadows.sweep.grid import NO_RAY_HEIGHTS, SweepPoints, sweep_nodes, sweep_to_state
from skugga.shadows.sweep.ground_windows import GroundWindow, ground_of_view, grounds_of_block, lies_behind
from skugga.shadows.sweep.orientation import GridOrientation
from skugga.shadows.sweep.position_cubics import RAYS_BEND_REASON
from skugga.shadows.sweep.quad_crossings import NO_GROUND_RAY_HEIGHT
from skugga.shadows.sweep.rays import SunRays, rays_at
from skugga.shadows.sweep.settings import SweepSettings, resolve_sweep
from skugga.shadows.sweep.targets import SweepTargets, max_abs_ray_height_m, targets_of_buffer, targets_of_nodes
from skugga.shadows.work import Work, Workload, is_decimated
from skugga.terrain.casters.caster_types import Casters, Patch
from skugga.terrain.compiled import CORES
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.bare_nodes import BareNodes
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import NodeHeights
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene

PASSES = ("sweep",)
"""Names of the passes that the algorithm runs, in order."""

RAY_HEIGHT_ROUNDING = 8.0 * float(np.finfo(np.float32).eps)
"""float32 rounding of a ray height, as a share of the largest one. Ground that exceeds a ray by less casts no shadow."""

MIN_LINES_PER_COLUMN = 2
"""Minimum number of lines per column of a supersampled grid, in which the columns of one pixel share the pixel's lines."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: SweepSettings,
    log: PassLog,
) -> np.ndarray:
    """Return the visibility of the sun at a buffer's points, with the ground as the only caster.

    Parameters
    ----------
    buffer
        The points (rows, cols) that the view shows.
    scene
        The scene.
    light
        The name of the sun.
    kinds
        The kinds of casters.
    casters
        The ground that can cast shadows on the points.
    settings
        The sweep lines per column of the grid, the filter, and the number of points of the sun's disc.
    log
        The record of passes. It also stores the layer ``shadow-height`` if that is requested.

    Returns
    -------
    np.ndarray
        float32 (rows, cols) in [0, 1]; undefined where the buffer shows no surface.

    Raises
    ------
    UnsupportedError
        The sun's rays bend too much across the view.
    """
    if settings.filter == "sun":
        return mean_visibility_of_area_light(
            fill_visibility, buffer, scene, light, kinds, casters, settings, log, masks_attached_shadow=False, filter=1
        )
    (sweep_pass,) = log.pass_names(light, kinds, PASSES)
    with log.record_pass(sweep_pass) as record:
        if not buffer.valid.any():
            return np.ones(buffer.valid.shape, np.float32)
        if buffer.columns is not None:
            return _visibility_over_columns(buffer, scene, light, casters, log, record)
        rays, grounds = _grounds_of_view(buffer, scene, casters)
        targets = targets_of_buffer(rays, grounds[-1], buffer)
        log.keep_layer("shadow-height", light, _shadow_height_m, rays, grounds, targets, settings.lines, buffer.height_m)
        record.bytes = max(record.bytes, _byte_size(grounds, targets))
        return _lit_mask(rays, grounds, targets, settings.lines).astype(np.float32)


def _visibility_over_columns(
    buffer: GeometryBuffer, scene: Scene, light: str, casters: Casters, log: PassLog, record: PassRecord
) -> np.ndarray:
    """Return the visibility as ``fill_visibility`` does, for a map whose ground is upright columns with flat tops."""
    sweep = column_sweep(buffer, scene, casters)
    sunlit = sweep.obstruction_height_m(False, CORES) <= 0.0

    def shadow_height_m() -> np.ndarray:
        return buffer.height_m + sweep.obstruction_height_m(True, CORES).astype(np.float32)

    log.keep_layer("shadow-height", light, shadow_height_m)
    record.bytes = max(record.bytes, sweep.nbytes)
    return sunlit.astype(np.float32)


def find_lit_nodes(
    nodes: BareNodes,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: SweepSettings,
    log: PassLog,
) -> np.ndarray:
    """Return which nodes of ground without objects see the sun, a point, from the heights alone: bool (rows, cols).

    The result includes attached shadow (surfaces that face away from the sun). If all triangles around a node face away from the
    sun, so does the triangle that the node's ray crosses. That triangle rises above the ray, so the sweep finds it as a caster.
    Parameters and errors are those of ``fill_visibility``.
    """
    (sweep_pass,) = log.pass_names(light, kinds, PASSES)
    with log.record_pass(sweep_pass) as record:
        rays = rays_at(scene, nodes.view.grid, *_reference_node(scene, nodes.view, nodes.shows_ground))
        grounds = grounds_of_block(rays, nodes.surface, casters.patches, casters.culled_patches)
        targets = targets_of_nodes(rays, grounds[-1], nodes)
        lines = max(settings.lines // nodes.nodes_per_pixel, MIN_LINES_PER_COLUMN)
        lit, _, _ = _sweep_grounds(grounds, targets, lines, NO_RAY_HEIGHTS)
        log.keep_layer("shadow-height", light, lambda: _shadow_height_m(rays, grounds, targets, lines, nodes.height_m))
        record.bytes = max(record.bytes, _byte_size(grounds, targets))
        return rays.orientation.grid_order_copy(lit, targets.grid_window)


@dataclass(frozen=True, eq=False)
class NodeClearance:
    """The ray heights that decide whether nodes see the sun, in the order of the sun-aligned grid.

    The sun-aligned grid is the map's grid, rotated and mirrored so that the sun stands before row 0. A ray height is the coordinate
    at right angles to the sun's rays, in the vertical plane of the sun. A node sees the sun while
    ``ray_height_m - shadow_ray_height_m`` is at least 0.

    Attributes
    ----------
    orientation
        How the sun-aligned grid was made from the map's grid.
    ray_height_m
        float32 (n, m), metres: the nodes' ray heights.
    shadow_ray_height_m
        float32 (n, m), metres: the ray heights above which the sun is visible; about ``NO_GROUND_RAY_HEIGHT`` where no ground lies
        between the node and the sun.
    ray_height_per_metre
        Change of a ray height per metre of height.
    """

    orientation: GridOrientation
    ray_height_m: np.ndarray
    shadow_ray_height_m: np.ndarray
    ray_height_per_metre: float


def clearance_of_nodes(
    nodes: BareNodes, scene: Scene, patches: tuple[Patch, ...], lines: int, surface: NodeHeights | None = None
) -> NodeClearance:
    """Return the ray heights that decide whether nodes of ground without objects see the sun.

    ``patches`` are the ground beside the nodes that may cast shadows on them, ``lines`` the sweep lines per column. ``surface`` is
    the surface round the nodes, on which these stand instead of on their ground; no patch at full detail lies in it. Raises the
    errors of ``find_lit_nodes``.
    """
    rays = rays_at(scene, nodes.view.grid, *_reference_node(scene, nodes.view, nodes.shows_ground))
    if surface is None:
        grounds = grounds_of_block(rays, nodes.surface, patches)
    else:  # coarser ground counts at the window's edge towards the sun, so that which lies behind the nodes must not count
        patches = tuple(patch for patch in patches if not (patch.lod and lies_behind(rays, patch, nodes.surface)))
        grounds = grounds_of_block(rays, surface, patches)
    ground = grounds[-1]
    targets = targets_of_nodes(rays, ground, nodes)
    (first_row, last_row), (first_col, last_col) = targets.row_range, targets.col_range
    window = slice(first_row, last_row), slice(first_col + 1, last_col + 1)  # after the left border
    shadow_ray_heights = np.empty(
        ground.sun_aligned_grid.ray_height.shape, np.float32
    )  # only the window is written: the rest takes no memory
    shadow_ray_heights[window] = NO_GROUND_RAY_HEIGHT
    _sweep_grounds(grounds, targets, lines, shadow_ray_heights)
    return NodeClearance(
        rays.orientation, ground.sun_aligned_grid.ray_height[window], shadow_ray_heights[window], rays.ray_height_per_metre
    )


def _byte_size(grounds: list[GroundWindow], targets: SweepTargets) -> int:
    """Return the approximate size, bytes, of the arrays that a sweep holds."""
    sheets = sum(ground.sun_aligned_grid.ray_height.nbytes for ground in grounds)
    return sheets + 33 * targets.row.size + grounds[-1].sun_aligned_grid.ray_height.size


def _grounds_of_view(buffer: GeometryBuffer, scene: Scene, casters: Casters) -> tuple[SunRays, list[GroundWindow]]:
    """Return the sun's rays over a view, and the ground that may shade it, by level of detail, the coarsest first."""
    view = buffer.view
    if isinstance(view, MapView):
        rays = rays_at(scene, view.grid, *_reference_node(scene, view, buffer.valid))
        assert buffer.surface is not None
        return rays, grounds_of_block(rays, buffer.surface.with_rim, casters.patches, casters.culled_patches)
    assert buffer.ground is not None
    rays, ground = ground_of_view(scene, buffer.ground, buffer.frame)
    return rays, [ground]


def _reference_node(scene: Scene, view: MapView, valid: np.ndarray) -> tuple[float, float]:
    """Return the (fractional) row and column at which light space is upright: the view's centre, or the middle of its ground.

    Verticals lean away from this node, and shadows are shifted across the rays by this lean (``skugga.shadows.bent_rays``). On the
    earth they lean so little that the centre serves. On a small body a raster may lie in a corner of its block, kilometres from the
    block's centre. ``valid`` (rows, cols) are the pixels that show ground.
    """
    if scene.world.is_on_earth:
        return view.centre_node
    rows, cols = np.flatnonzero(valid.any(axis=1)), np.flatnonzero(valid.any(axis=0))
    if not len(rows):
        return view.centre_node
    row, col = (int(rows[0]) + int(rows[-1])) / 2, (int(cols[0]) + int(cols[-1])) / 2
    return view.row0 + row * view.row_step, view.col0 + col * view.col_step


def _sweep_grounds(
    grounds: list[GroundWindow], targets: SweepTargets, lines: int, shadow_ray_heights: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sweep the ground of all levels of detail, and return what ``sweep_nodes`` returns for the finest one.

    ``shadow_ray_heights`` is the output array of ``sweep_nodes``.
    """
    *coarser, ground = grounds
    entry, lod = None, 0
    for coarse in coarser:
        level_t_range = targets.t_range[0] / 2**coarse.lod, targets.t_range[1] / 2**coarse.lod
        entry = sweep_to_state(
            coarse.sun_aligned_grid, lines, level_t_range, entry, 2.0 ** (lod - coarse.lod), coarse.first_ground_row
        )
        lod = coarse.lod
    sun_aligned_grid = ground.sun_aligned_grid
    points = SweepPoints(
        targets.row,
        targets.col,
        targets.t,
        targets.ray_height_m,
        RAY_HEIGHT_ROUNDING * max_abs_ray_height_m(sun_aligned_grid.ray_height, targets),
    )
    return sweep_nodes(
        sun_aligned_grid, lines, targets.t_range, entry, 2.0**lod, targets.row_range, targets.col_range, points, shadow_ray_heights,
        CORES, ground.first_ground_row,
    )  # fmt: skip


def _lit_mask(rays: SunRays, grounds: list[GroundWindow], targets: SweepTargets, lines: int) -> np.ndarray:
    """Return which of a buffer's points see the sun, a point: bool (rows, cols)."""
    lit_nodes, lit_points, _ = _sweep_grounds(grounds, targets, lines, NO_RAY_HEIGHTS)
    sunlit = np.ones(targets.on_node_mask.shape, np.bool_)
    if targets.on_node_mask.any():
        sunlit[:] = rays.orientation.grid_order_view(lit_nodes)[targets.grid_window]
    sunlit[targets.off_node_mask] = lit_points
    return sunlit


def _shadow_height_m(
    rays: SunRays, grounds: list[GroundWindow], targets: SweepTargets, lines: int, height_m: np.ndarray
) -> np.ndarray:
    """Return the height above which the sun is visible: float32 (rows, cols), metres, never below that of the surface.

    ``height_m`` (rows, cols) is the height of the surface. ``lines`` is the number of sweep lines per column. ``grounds`` are the
    ground by level of detail, the coarsest first.
    """
    ray_height = grounds[-1].sun_aligned_grid.ray_height
    shadow_ray_heights = np.full(ray_height.shape if targets.on_node_mask.any() else (0, 0), NO_GROUND_RAY_HEIGHT, np.float32)
    _, _, points_above_m = _sweep_grounds(grounds, targets, lines, shadow_ray_heights)
    above_m = np.zeros(targets.on_node_mask.shape, np.float32)
    if targets.on_node_mask.any():
        shadow_height, node_height = (
            rays.orientation.grid_order_view(values[:, 1:-1])[targets.grid_window] for values in (shadow_ray_heights, ray_height)
        )
        above_m[:] = shadow_height - node_height
    above_m[targets.off_node_mask] = points_above_m
    return height_m + np.fmax(above_m, 0.0) / np.float32(
        rays.ray_height_per_metre
    )  # NaN: rounding may put a point outside of the ground


def _work(workload: Workload, settings: SweepSettings) -> Work:
    """Return the counts of work of a sweep by name, under the name of the algorithm's part (``CostInputs``)."""
    nodes = workload.node_count + workload.outside_triangle_count / 2.0 if workload.is_map_view else _ground_nodes(workload)
    rasterised = workload.triangle_count("relief") * workload.has_decimated_ground
    counts = {
        "blocks": 1.0, "nodes": nodes, "steps": nodes * settings.lines, "pixels": workload.pixel_count,
        "points": workload.visible_pixel_count,
        "answers": workload.visible_pixel_count, "decimated": rasterised, "outside": workload.outside_triangle_count / 2.0,
    }  # fmt: skip
    if workload.is_cached("sun-aligned ground") and settings.filter != "sun":  # the cache holds the ground for one sun
        del counts["decimated"]
    work = {workload.part_name_in_view("sweep"): counts}
    return scale_work(work, settings.light_points) if settings.filter == "sun" else work


def _ground_nodes(workload: Workload) -> float:
    """Return the number of nodes of a perspective view's whole ground; half the number of its triangles if it is unknown."""
    relief = workload.caster_facts("relief")
    return workload.triangle_count("relief") / 2.0 if relief is None or relief.nodes is None else float(relief.nodes)


def _calibration_settings(descriptor: Descriptor, light: str, calibration_extent: str) -> Iterator[AlgorithmSettings]:
    """Yield the settings that a calibration of this extent measures (``CostInputs``)."""
    yield SweepSettings()
    yield SweepSettings(lines=4)
    if calibration_extent == "full":
        yield SweepSettings(filter="sun")


DIVERGING_RAYS_REASON = "a lamp's rays diverge, but the lines of the sweep run along one azimuth"
"""The reason with which the sweep refuses lamps."""

REFUSALS: dict[Requirement, str] = {
    "spot": DIVERGING_RAYS_REASON,
    "omni": DIVERGING_RAYS_REASON,
    "meshes": "meshes are not a heightfield: the sweep has one height per position",
    "forest": "trees are not a heightfield: light passes under crowns and between leaves",
    "bent rays": RAYS_BEND_REASON,
}
"""The requirements that the sweep cannot serve, each with the reason."""

FULL_DETAIL_GROUP, DECIMATED_GROUP = "sweep", "sweep of decimated ground"
"""Groups of views with separate constants of the error model: those that draw all nodes of the ground, and all others."""

ALGORITHM = Algorithm(
    name="sweep",
    description="line sweep over the heightfield along the sun's azimuth; needs no OpenGL",
    plural_name="sweep",
    fill_visibility=fill_visibility,
    allows_caster_culling=lambda settings: True,
    lit_nodes_finder=lambda settings: find_lit_nodes if settings.filter == 1 else None,
    passes=PASSES,
    refusals=REFUSALS,
    layers=("shadow-height",),
    needs_opengl=False,
    settings_types=(SweepSettings,),
    resolve_settings=resolve_sweep,
    cache_names=("skugga.shadows.sweep.ground_windows.ground_of_view",),
    search=SettingsSearch(other_variants=({"filter": "sun"},)),
    cost=CostInputs(_work, calibration_settings=_calibration_settings),
    accuracy=AccuracyInputs(
        error_groups=(FULL_DETAIL_GROUP, DECIMATED_GROUP),
        error_group_of=lambda descriptor: DECIMATED_GROUP if is_decimated(descriptor) else FULL_DETAIL_GROUP,
    ),
    marker=PlotMarker("star", "orange"),
)
