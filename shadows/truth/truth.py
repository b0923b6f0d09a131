"""Algorithm `truth`: ray-traced visibility of a light, through the same triangles and from the same points as all algorithms.

- A pixel is lit if its triangle's geometric normal faces the light, and a ray from its visible point to the light hits nothing. The
  ray starts off the triangle by the offset that ``skugga.terrain.casters.rays`` derives.
- A pixel is *decidable* if the results at one, two and four times this offset, and at S stratified sub-samples of the pixel, all
  agree. Otherwise it is boundary, where no error counts.
- If several triangles share a point, the one that faces the light most counts (``skugga.terrain.gbuffer.light_facing``). Another of
  them may rise above the ray to the light. The ray's offset hides it if it rises by less, at all three offsets. So these triangles
  are tested without an offset. A pixel where this test and the ray disagree is dark and boundary.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import get_args

import numpy as np
from pydantic import Field

from skugga.shadows.algorithm import Algorithm, CostInputs
from skugga.shadows.algorithm_settings import AlgorithmSettings, ResolvedSettings, SettingsRequest
from skugga.shadows.area_light import disc_points, sun_disc_directions
from skugga.shadows.attached_shadow import attached_shadow_mask, faces_away
from skugga.shadows.passes import PassLog
from skugga.shadows.work import Work, Workload
from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_meshes, caster_sheets, caster_trees, occluding_trees
from skugga.terrain.casters.rays import RayScene, trees_as_mesh
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer, MapNodes
from skugga.terrain.gbuffer.light_facing import MIN_LIGHT_SINE, FacingNormals, facing_normals
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.gbuffer.smooth_ground import move_to_smooth_ground
from skugga.terrain.gbuffer.view_geometry import geometry_buffer, shared_nodes
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.light_space import light_bounds
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.lights import light_position
from skugga.terrain.scene import Scene

UNLIMITED_TRIANGLES = 2**31
"""Triangle limit that no ground reaches: its mesh is not decimated."""

PASSES = ("rays",)
"""Names of the passes that the algorithm runs, in order."""

AREA_LIGHT_SAMPLES = 64
"""Samples of an area light."""

ALL_CASTER_KINDS: tuple[CasterKind, ...] = get_args(CasterKind)
"""All kinds of casters."""


class TruthSettings(AlgorithmSettings):
    """Settings of ray-traced truth: samples of the sun's disc or a lamp's sphere (1: its centre only)."""

    light_samples: int = Field(default=1, ge=1, le=1024)


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of one buffer under one light: bool masks (rows, cols), False off the surface.

    Attributes
    ----------
    lit
        Pixels whose visible point is lit.
    attached_shadow_mask
        Pixels in attached shadow: their normal does not face the light.
    decidable
        Pixels where an algorithm can be compared with truth.
    valid
        Pixels with a surface.
    """

    lit: np.ndarray
    attached_shadow_mask: np.ndarray
    decidable: np.ndarray
    valid: np.ndarray

    @property
    def undecidable_share(self) -> float:
        """Share of undecidable pixels of the surface; 0 without a surface."""
        return float(1.0 - self.decidable.sum() / self.valid.sum()) if self.valid.any() else 0.0

    @property
    def cast_share(self) -> float:
        """Share of the surface's pixels in cast shadow (attached shadow excluded); 0 without a surface."""
        return float((self.valid & ~self.attached_shadow_mask & ~self.lit).sum() / self.valid.sum()) if self.valid.any() else 0.0


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: TruthSettings,
    log: PassLog,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols) in [0, 1].

    If ``light_samples`` is more than 1, the light is an area. Visibility is then the mean over that many stratified points of it.
    """
    (rays_pass,) = log.pass_names(light, kinds, PASSES)
    with log.record_pass(rays_pass):
        rays = ray_scene(buffer, scene, casters, kinds)
        return area_light_visibility(buffer, scene, light, rays, settings.light_samples)


def trace_truth(
    buffer: GeometryBuffer,
    scene: Scene,
    casters: Casters,
    sample_count: int = 4,
    light: str = SUN,
    kinds: tuple[CasterKind, ...] = ALL_CASTER_KINDS,
    rays: RayScene | None = None,
    nodes: MapNodes | None = None,
) -> Truth:
    """Return the truth of a buffer's points.

    Parameters
    ----------
    buffer
        The geometry buffer.
    scene
        Its scene.
    casters
        The casters that can shade it.
    sample_count
        Sub-samples of a pixel, a square number.
    light
        The sun or a lamp's name.
    kinds
        Kinds of casters.
    rays
        Occluders, if already built (``ray_scene``).
    nodes
        Ground nodes that the sub-samples share, if already computed (``sample_nodes``).
    """
    dark = np.zeros(buffer.valid.shape, bool)
    is_attached = attached_shadow_mask(buffer, scene, light) & buffer.valid
    if (light == SUN and not scene.sun_is_up) or not buffer.valid.any():
        return Truth(dark, is_attached, buffer.valid.copy(), buffer.valid)
    rays = rays or ray_scene(buffer, scene, casters, kinds)
    has_free_ray = _free_ray_mask(buffer, scene, light, rays)
    lit = has_free_ray & ~_own_facet_mask(buffer, scene, light)
    decidable = buffer.valid & (lit == has_free_ray)
    for offset_factor in (2.0, 4.0):
        decidable &= _free_ray_mask(buffer, scene, light, rays, offset_factor) == lit
    nodes = nodes or sample_nodes(buffer, scene, sample_count)
    for view in jittered_views(buffer.view, sample_count):
        sample = geometry_buffer(scene, view, buffer.frame, nodes=nodes)
        decidable &= sample.valid & (lit_mask(sample, scene, light, rays) == lit)
    return Truth(lit, is_attached, decidable, buffer.valid)


def sample_nodes(buffer: GeometryBuffer, scene: Scene, sample_count: int) -> MapNodes | None:
    """Return the ground nodes that the sub-samples of a map's buffer or its parts share; ``None`` if they share none."""
    return shared_nodes(scene, jittered_views(buffer.view, sample_count), buffer.frame)


def area_light_visibility(buffer: GeometryBuffer, scene: Scene, light: str, rays: RayScene, sample_count: int) -> np.ndarray:
    """Return the visibility float32 (rows, cols) of an area light, the mean over samples of its visible disc.

    Attached shadow is included, tested for each sample. Pixels off the surface are 0. One sample means the light's centre. A lamp
    without a radius is a point light. ``sample_count`` is the number of samples.
    """
    if sample_count == 1 or (light != SUN and scene.lamps[light].radius_m == 0.0):
        return lit_mask(buffer, scene, light, rays).astype(np.float32)
    visibility = np.zeros(buffer.valid.shape, np.float32)
    if light == SUN:
        assert scene.sun is not None
        for direction in sun_disc_directions(scene.sun.in_frame(buffer.frame), sample_count):
            visibility += lit_mask_towards(buffer, rays, direction)
        return visibility / np.float32(sample_count)
    return _sphere_visibility(buffer, scene, light, rays, sample_count)


def _sphere_visibility(buffer: GeometryBuffer, scene: Scene, light: str, rays: RayScene, sample_count: int) -> np.ndarray:
    """Return the visibility float32 (rows, cols) of a spherical lamp. All of its points shine into the lamp's cone.

    It is the mean over ``sample_count`` points of the disc that a point sees of the sphere.
    """
    lamp, source = scene.lamps[light], scene.light_position(light, buffer.frame)
    _, axis, _ = lamp.in_frame(buffer.frame)
    buffer, visibility = move_to_smooth_ground(buffer, source), np.zeros(buffer.valid.shape, np.float32)
    to_lamp = np.array(source[:3]) - buffer.position_frame_m
    towards = to_lamp / np.linalg.norm(to_lamp, axis=-1, keepdims=True)
    right = np.cross(towards, np.where(np.abs(towards[..., 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    up = np.cross(right, towards)
    normals, cosine = facing_normals(buffer, source, with_lifts=True), np.cos(np.radians(lamp.cutoff_deg))
    for right_m, up_m in lamp.radius_m * disc_points(sample_count):
        ray = to_lamp + right_m * right + up_m * up
        length = np.linalg.norm(ray, axis=-1)
        towards = (normals.normal_frame * ray).sum(axis=-1)
        facing = np.where(buffer.surface_kind == FOREST, np.abs(towards), towards) > MIN_LIGHT_SINE * length
        reached_mask = buffer.valid & facing & (-(ray @ axis) >= cosine * length)
        visibility += _unblocked_mask(buffer, rays, reached_mask, normals, ray, 1.0)
    return visibility / np.float32(sample_count)


def coverage_truth(
    buffer: GeometryBuffer,
    scene: Scene,
    casters: Casters,
    block_px: int,
    max_blocks: int = 256,
    sample_count: int = 64,
    light: str = SUN,
    rays: RayScene | None = None,
) -> np.ndarray:
    """Return the true shares of shadow in sampled blocks, float64 (rows // block_px, cols // block_px), NaN for other blocks.

    At most ``max_blocks`` blocks with a surface are sampled, stratified over the picture. A pixel has ``sample_count`` (a square
    number) regular sub-samples. ``rays`` is as in ``trace_truth``.
    """
    shape = tuple(size // block_px for size in buffer.valid.shape)
    out = np.full(shape, np.nan)
    has_surface = buffer.valid[: shape[0] * block_px, : shape[1] * block_px]
    has_surface = np.any(has_surface.reshape(shape[0], block_px, shape[1], block_px), axis=(1, 3))
    candidates = np.flatnonzero(has_surface)
    if not len(candidates) or (light == SUN and scene.sun is None):
        return out
    bounds = np.linspace(0, len(candidates), min(max_blocks, len(candidates)) + 1).astype(int)
    rng = np.random.default_rng(0)
    rays = rays or ray_scene(buffer, scene, casters, ALL_CASTER_KINDS)
    is_dark_everywhere = light == SUN and not scene.sun_is_up
    side = int(round(sample_count**0.5))
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        i, j = np.unravel_index(candidates[rng.integers(first, last)], shape)
        if is_dark_everywhere:
            out[i, j] = 1.0
            continue
        fine_view = buffer.view.part(i * block_px, j * block_px, block_px, block_px).finer(side)
        sample = geometry_buffer(scene, fine_view, buffer.frame)
        if sample.valid.any():
            out[i, j] = 1.0 - lit_mask(sample, scene, light, rays)[sample.valid].mean()
    return out


def simplification_error(buffer: GeometryBuffer, scene: Scene, casters: Casters, size_px: int = 256) -> float:
    """Return the simplification error: the share of pixels whose truth differs between the drawn and the full ground.

    In a map the full ground is the raster's bilinear surface on a grid of half its cells (or half the drawn step, if that is
    finer). In perspective it is the mesh without decimation. The test uses a window of ``size_px`` pixels a side round the centre
    of the surface, and each ground's own points. It is 0 without a sun.
    """
    view = buffer.view
    if not buffer.valid.any() or not scene.sun_is_up:
        return 0.0
    rows, cols = min(size_px, view.rows), min(size_px, view.cols)
    middle = [int(np.median(index)) for index in np.nonzero(buffer.valid)]
    row, col = (
        int(np.clip(m - side // 2, 0, size - side))
        for m, side, size in zip(middle, (rows, cols), (view.rows, view.cols), strict=True)
    )
    part = view.part(row, col, rows, cols)
    if isinstance(part, MapView):
        buffers = geometry_buffer(scene, part, buffer.frame), geometry_buffer(scene, _full_detail_view(scene, part), buffer.frame)
    elif buffer.ground is None or buffer.ground.tolerance_px == 0.0:
        return 0.0
    else:
        buffers = geometry_buffer(scene, part, buffer.frame), geometry_buffer(scene, part, buffer.frame, UNLIMITED_TRIANGLES)
    if not all(caster_buffer.valid.any() for caster_buffer in buffers):
        return 0.0
    # All blocks of a map share its nodes, so the cached rays of the whole buffer serve its part, too.
    caster_buffers = (buffer if isinstance(part, MapView) else buffers[0], buffers[1])
    rays = (
        ray_scene(
            caster_buffer, scene, casters if caster_buffer is buffer else find_casters(scene, caster_buffer), ALL_CASTER_KINDS
        )
        for caster_buffer in caster_buffers
    )
    lit = [lit_mask(caster_buffer, scene, SUN, buffer_rays) for caster_buffer, buffer_rays in zip(buffers, rays, strict=True)]
    valid = buffers[0].valid & buffers[1].valid
    return float((lit[0] != lit[1])[valid].mean()) if valid.any() else 0.0


def _full_detail_view(scene: Scene, part: MapView) -> MapView:
    """Return a part of a map on a grid of half the raster's cells, or of half the drawn step if that is finer."""
    surface = scene.surface(part.grid)
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    finer = max(int(np.ceil(np.log2(2.0 * surface.step_m / min(cell_m, surface.step_m)))), 1)
    scale = 2**finer
    grid = part.grid.finer(finer)
    return MapView(grid, part.row0 * scale, part.col0 * scale, part.row_step * scale, part.col_step * scale, part.rows, part.cols)


@cached("light", 2048 * MIB)
def ray_scene(
    buffer: GeometryBuffer, scene: Scene, casters: Casters, kinds: tuple[CasterKind, ...], traverse_sheets: bool = False
) -> RayScene:
    """Return the occluders of some kinds that can shade a buffer's points, cached because building them dominates the cost.

    With ``traverse_sheets`` rays walk the ground's cells instead of a BVH, which is faster for a few rays to the sun
    (``RayScene``).
    """
    trees = caster_trees(buffer, kinds)
    if trees is not None and scene.light_space is not None and not scene.lamps:
        rotation, translation = scene.light_space.transform_from_frame(buffer.frame)
        low, high = light_bounds(buffer.position_frame_m, buffer.valid, rotation, translation)
        pixel_m = 2.0 * max_pixel_m(buffer)  # sub-samples lie beside the pixels' points
        trees = occluding_trees(trees, rotation, translation, low - pixel_m, high + pixel_m)
    alpha = [] if trees is None or not len(trees) else [trees_as_mesh(trees)]
    return RayScene(caster_sheets(scene, buffer, casters, kinds), caster_meshes(scene, buffer, kinds), alpha, traverse_sheets)


def max_pixel_m(buffer: GeometryBuffer) -> float:
    """Return the largest side of a buffer's pixels on a surface that faces the viewer, metres."""
    if isinstance(buffer.view, PerspectiveView):
        eye, _ = buffer.view.in_frame(buffer.frame)
        return (
            float(np.linalg.norm(buffer.position_frame_m[buffer.valid] - eye, axis=-1).max(initial=0.0)) * buffer.view.pixel_tangent
        )
    steps = np.diff(buffer.position_frame_m[:: max(buffer.view.rows - 1, 1)], axis=1)
    sides_m = np.linalg.norm(steps, axis=-1)
    return float(np.nanmax(sides_m, initial=0.0))


def lit_mask(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    rays: RayScene,
    offset_factor: float = 1.0,
    receiver_mask: np.ndarray | None = None,
) -> np.ndarray:
    """Return which points of a buffer see a light, bool (rows, cols); False off the surface and outside of ``receiver_mask``.

    Rays start off their triangles by ``offset_factor`` times the offset of ``rays``. The triangles that share a point are tested
    without an offset as well.
    """
    return _free_ray_mask(buffer, scene, light, rays, offset_factor, receiver_mask) & ~_own_facet_mask(buffer, scene, light)


def _own_facet_mask(buffer: GeometryBuffer, scene: Scene, light: str) -> np.ndarray:
    """Return where one of the triangles that share a point blocks a light, bool (rows, cols)."""
    source = scene.light_position(light, buffer.frame)
    return facing_normals(move_to_smooth_ground(buffer, source), source).is_blocked


def _free_ray_mask(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    rays: RayScene,
    offset_factor: float = 1.0,
    receiver_mask: np.ndarray | None = None,
) -> np.ndarray:
    """Return which points have a triangle that faces a light and a ray to it that meets nothing, bool (rows, cols)."""
    if light == SUN:
        assert scene.sun is not None
        return lit_mask_towards(buffer, rays, scene.sun.in_frame(buffer.frame), offset_factor, receiver_mask)
    source = scene.light_position(light, buffer.frame)
    facing = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
    if receiver_mask is not None:
        facing &= receiver_mask
    buffer = move_to_smooth_ground(buffer, source)
    to_light = np.array(source[:3]) - buffer.position_frame_m
    return _unblocked_mask(buffer, rays, facing, facing_normals(buffer, source, with_lifts=True), to_light, offset_factor)


def _unblocked_mask(
    buffer: GeometryBuffer,
    rays: RayScene,
    facing_mask: np.ndarray,
    normals: FacingNormals,
    to_light: np.ndarray,
    offset_factor: float,
) -> np.ndarray:
    """Return which points in the mask ``facing_mask`` have nothing on their ray to a light, bool (rows, cols).

    ``to_light`` (rows, cols, 3) are the rays from the points to the light, metres. ``normals`` are those by which surfaces face the
    light, and ``offset_factor`` is that of ``lit_mask``.
    """
    directions = to_light[facing_mask]
    length = np.linalg.norm(directions, axis=-1)
    directions /= length[:, None]
    start = _offset_origins(buffer, facing_mask, normals, directions, offset_factor * rays.offset_m)
    out = np.zeros(buffer.valid.shape, bool)
    out[facing_mask] = ~rays.is_blocked(start, directions, length)
    return out


def lit_mask_towards(
    buffer: GeometryBuffer,
    rays: RayScene,
    direction: np.ndarray,
    offset_factor: float = 1.0,
    receiver_mask: np.ndarray | None = None,
) -> np.ndarray:
    """Return which points of a buffer see a direction (3,) of its frame, bool (rows, cols).

    The result is False off the surface and outside of ``receiver_mask``. Rays start off their triangles by ``offset_factor`` times
    the offset of ``rays``.
    """
    direction = np.asarray(direction, np.float64)
    source = light_position(direction, 0.0)
    buffer = move_to_smooth_ground(buffer, source)
    normals = facing_normals(buffer, source, with_lifts=True)
    facing = buffer.valid & ~faces_away(normals.normal_frame, buffer.surface_kind == FOREST, direction)
    if receiver_mask is not None:
        facing &= receiver_mask
    start = _offset_origins(buffer, facing, normals, direction, offset_factor * rays.offset_m)
    out = np.zeros(buffer.valid.shape, bool)
    out[facing] = ~rays.is_blocked(start, direction)
    return out


def _offset_origins(
    buffer: GeometryBuffer, facing_mask: np.ndarray, normals: FacingNormals, to_light: np.ndarray, offset_m: float
) -> np.ndarray:
    """Return the points (n, 3) in the mask ``facing_mask``, moved off their triangles to the light's side by ``offset_m`` metres.

    ``to_light`` (n, 3), or (3,) for all, are the unit directions to the light, and ``normals`` the normals by which surfaces face
    it.
    """
    side = np.where((normals.normal_frame[facing_mask] * to_light).sum(axis=-1, keepdims=True) < 0.0, -1.0, 1.0)
    lift = buffer.normal_frame if normals.lift_frame is None else normals.lift_frame
    return buffer.position_frame_m[facing_mask] + offset_m * side * lift[facing_mask]


def jittered_views(view: MapView | PerspectiveView, sample_count: int, seed: int = 0) -> list[MapView | PerspectiveView]:
    """Return views shifted within a pixel, one for each of ``sample_count`` sub-samples: a random offset in each of as many strata.

    Raises ``ValueError`` if ``sample_count`` is no square number. ``seed`` is that of the random offsets.
    """
    side = int(round(sample_count**0.5))
    if side * side != sample_count:
        raise ValueError(f"sample_count: {sample_count} is not a square number. Use 1, 4, 9, 16 ...")
    rng = np.random.default_rng(seed)
    offsets = [((i + rng.random()) / side - 0.5, (j + rng.random()) / side - 0.5) for i in range(side) for j in range(side)]
    return [view.shifted(row, col) for row, col in offsets]


def _resolve(request: SettingsRequest) -> ResolvedSettings:
    """Return the samples of an area light, or a point light and the reason why a requested filter has no effect."""
    if request.is_area_light:
        return TruthSettings(light_samples=AREA_LIGHT_SAMPLES), []
    return TruthSettings(), request.ignored_filter_reasons("truth")


def _work(workload: Workload, settings: TruthSettings) -> Work:
    """Return the counts of work by name (blocks, points, rays, triangles), under the name of the algorithm's only part."""
    rays = workload.facing_pixel_count * settings.light_samples
    return {"truth": {"blocks": 1.0, "seen": workload.visible_pixel_count, "rays": rays, "triangles": workload.all_triangle_count}}


def _calibration_settings(descriptor: Descriptor, light: str, calibration_extent: str) -> Iterator[AlgorithmSettings]:
    """Yield the settings that a calibration of this extent measures (``CostInputs``)."""
    if calibration_extent == "full":
        yield TruthSettings()


ALGORITHM = Algorithm(
    name="truth",
    description="ray tracing, the reference for comparisons; too slow for pictures",
    plural_name="truth",
    fill_visibility=fill_visibility,
    passes=PASSES,
    is_selectable=False,
    needs_opengl=False,
    settings_types=(TruthSettings,),
    resolve_settings=_resolve,
    cache_names=("skugga.shadows.truth.truth.ray_scene",),
    cost=CostInputs(_work, calibration_settings=_calibration_settings),
)
