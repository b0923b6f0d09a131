"""`perspective_shadow_map`: a depth map in the post-perspective space of the camera, fine near the eye and coarse far away.

The method is that of Stamminger and Drettakis 2002, "Perspective shadow maps". ``skugga.shadows.maps.post_perspective`` computes
the map's matrix, and ``docs/perspective-shadow-maps.md`` derives it. This module fits it to the receivers, draws the map and looks
it up. Taps, their weights, cached maps and foliage are as in ``docs/shadow-maps.md``. A fall-back to a uniform map is recorded with
its reason.

**Comparison on a known triangle.** The map's matrix P keeps lines and planes. With a receiver at p, a triangle's corners p + s_k,
and the map's coordinates x, y, z of p, let

    W_k = (P (p + s_k))_w,  (X_k, Y_k, Z_k) = (P s_k)_xyz - (x, y, z) (P s_k)_w.

These differences are exact. With homogeneous weights c_k, whose sum weighted by W_k is 1, a point of the triangle, and the weights
at (dx, dy) beside p, are

    (x, y, z) + sum of c_k (X_k, Y_k, Z_k),
    c = (X cross Y + dx Y cross W + dy W cross X) / ((X cross Y).W).

If all are at least 0, the texel's centre falls into the triangle, also with corners behind the horizon. Its depth z + c.Z is
compared with the map's without a bias. Only the rasteriser's grid of 1/256 texel, the rounding of positions and half a depth step
are subtracted, and for grazing light at most the range of the corners' depths. Errors grow with 1/w^2 towards the horizon.

**Bias beside it.** The receiver moves along its unit normal n. Let r and u be the steps in the frame that move it by one texel to
the right and up at the same depth: two columns of the inverse of the Jacobian

    J = (P_3x3 - (x, y, z) P_w) / w

at p. (A, B, C) are the products of n with the three columns, times 1/w. In the map the plane of the point, how much nearer a
texel's centre at (i, j) is, and what a step of b along n gains, are

    A dx + B dy + C dz = 0,    |i n.r + j n.u| / (w |C|),    b / (w' |C|)    with    w' = w + b n.P_w.

With n taps a side, k = n/2 + 1/128, and the crease c of ``docs/shadow-maps.md``,

    b = k (|n.r| + |n.u| + c max(|r + u|, |r - u|)) / (1 - c^2 / 2),    b / (1 - b n.P_w / w)

is enough on every slope. ``bias_scale`` multiplies b and the triangle's difference in depth.

The float32 error of a position is 16 units in the last place of the triangle's largest coordinate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from skugga.shadows.algorithm import AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings, SettingsRequest
from skugga.shadows.area_light import mean_visibility_of_area_light
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.camera import Camera, Light
from skugga.shadows.maps.filling import visibility_by_maps
from skugga.shadows.maps.perspective_fit import latest_start_depths, min_map_ranges
from skugga.shadows.maps.post_perspective import (
    PostPerspective,
    fit_to_bounds,
    is_clear_of_horizon,
    post_perspectives,
    texel_size_in_picture,
    uniform_matrix,
)
from skugga.shadows.maps.post_perspective_view import post_perspective_view
from skugga.shadows.maps.relevant_trees import with_relevant_trees
from skugga.shadows.maps.resolve import TUNED_MAP_SIZES, calibration_overrides, resolve_perspective_map
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.shadows.maps.texels import perspective_map_texel_px, texel_on_level_ground_m
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, MIN_NEAR_PLANE_SHARE, POSITION_ERROR, DepthMap, depth_step_count
from skugga.shadows.maps.work import perspective_map_work
from skugga.shadows.passes import PassLog
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_trees, has_casters
from skugga.terrain.compiled import compiled
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.tree_instances import TreeInstances
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.light_space import light_bounds
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import SUN, CasterKind, Shadows
from skugga.terrain.scene import Scene

PASSES = ("depth map", "visibility")
"""Names of the passes that the algorithm runs, in order."""

RECEIVER_SAMPLE_SIZE = 1024
"""Number of receivers from which a map's matrix is chosen. The map is fitted to all receivers."""

MAX_FIT_ROUNDS = 8
"""Upper bound of the rounds in which the outermost receivers join the sample. Afterwards the map is widened to hold them."""

MAX_SAMPLE_OVERSHOOT = 1.125
"""Upper bound of the map coordinates of receivers outside of the sample, as a multiple of the map's inner half width."""

CLIP_POSITION_ERROR = 2.0 * POSITION_ERROR
"""Upper bound of the float32 error of positions, as a share of their coordinates."""

MAX_TEXEL_PX = 4.0
"""Upper bound of a texel's size in pixels (root mean square) for a single map.

Above it the view gets several maps, since some edges are then off by over two pixels (``docs/reports/seeds.md``, figure 52).
"""

MAX_DISTANCE_RANGES = 4
"""Upper bound of the number of maps, the same as for the cascades of a shadow map."""

MapCandidates = Callable[[Camera, Light, np.ndarray, float, np.ndarray], list[PostPerspective]]
"""Type of functions that return a map's candidate matrices, as ``post_perspectives`` does."""

FRONT_DEPTH_SHARE = 0.01
"""Share of the map's depth range in front of the nearest receiver."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: PerspectiveMapSettings,
    log: PassLog,
    find_candidates: MapCandidates = post_perspectives,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols) in [0, 1].

    The value has no meaning off the surface and where the surface faces away from the light. ``find_candidates`` returns the
    matrices among which the map's is chosen. Raises ``GraphicsError``.
    """
    if settings.slide_back == "off":
        find_candidates = partial(post_perspectives, slides_back=False)
    if settings.filter == "sun":
        fill = partial(fill_visibility, find_candidates=find_candidates)
        return mean_visibility_of_area_light(fill, buffer, scene, light, kinds, casters, settings, log, filter=1)
    depth_pass, visibility_pass = log.pass_names(light, kinds, PASSES)
    trees = caster_trees(buffer, kinds)
    with log.record_pass(depth_pass) as record:  # fitting a map is part of making it
        receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
        shaded = receivers.any() and has_casters(scene, buffer, kinds)
        fitted_maps = perspective_maps(buffer, receivers, scene, light, settings, trees, find_candidates) if shaded else []
        record.note = next(
            filter(None, [record.note, *(fitted_map.uniform_map_reason for fitted_map in fitted_maps)]), ""
        )  # the first note of any part of a view
        maps = [with_relevant_trees(fitted_map.depth_map, buffer, samples_sun_disc=False) for fitted_map in fitted_maps]
    for depth_map in maps:
        if depth_map.space_from_frame is not None:
            log.keep_layer(
                "post-perspective", light, post_perspective_view, device(), depth_map.space_from_frame, buffer, scene, light
            )
    return visibility_by_maps(maps, buffer, scene, light, kinds, casters, settings, (depth_pass, visibility_pass), log)


@dataclass(frozen=True, eq=False)
class FittedMap:
    """A perspective map that is fitted to its receivers.

    Attributes
    ----------
    depth_map
        The map to draw.
    texel_px
        Size of its texels in pixels of the picture, root mean square.
    uniform_map_reason
        The reason for a uniform map; empty otherwise.
    """

    depth_map: DepthMap
    texel_px: float
    uniform_map_reason: str


def perspective_maps(
    buffer: GeometryBuffer,
    receiver_mask: np.ndarray,
    scene: Scene,
    light: str,
    settings: PerspectiveMapSettings,
    trees: TreeInstances | None,
    find_candidates: MapCandidates = post_perspectives,
) -> list[FittedMap]:
    """Return the maps of a light for a perspective view's receivers in a mask (rows, cols), from the nearest to the farthest.

    The mask holds at least one receiver. One map suffices if its texels cover at most ``MAX_TEXEL_PX``. Otherwise the receivers are
    split into ranges of distance, at a geometric series along the view's axis. The result is the smallest number of ranges that
    keeps to this bound. If no number up to ``MAX_DISTANCE_RANGES`` does, it is the split with the smallest coarsest texels.
    """
    assert isinstance(buffer.view, PerspectiveView)
    best = [perspective_map(buffer, receiver_mask, scene, light, settings, trees, find_candidates)]
    eye, camera_from_frame = buffer.view.in_frame(buffer.frame)
    depth_m = (buffer.position_frame_m[receiver_mask] - eye) @ camera_from_frame[2]
    octaves = np.log2(depth_m / depth_m.min())
    for count in range(2, MAX_DISTANCE_RANGES + 1):
        coarsest_px = max(part.texel_px for part in best)
        if coarsest_px <= MAX_TEXEL_PX or octaves.max() < count:
            break
        range_number = np.full(receiver_mask.shape, -1)
        range_number[receiver_mask] = np.minimum((count * octaves / octaves.max()).astype(np.int64), count - 1)
        ranges = [range_mask for range_mask in (range_number == part for part in range(count)) if range_mask.any()]
        split_maps = [perspective_map(buffer, range_mask, scene, light, settings, trees, find_candidates) for range_mask in ranges]
        if max(part.texel_px for part in split_maps) < coarsest_px:
            best = split_maps
    return best


def perspective_map(
    buffer: GeometryBuffer,
    receiver_mask: np.ndarray,
    scene: Scene,
    light: str,
    settings: PerspectiveMapSettings,
    trees: TreeInstances | None,
    find_candidates: MapCandidates = post_perspectives,
) -> FittedMap:
    """Return the map of a light for a perspective view's receivers in a mask (rows, cols), which holds at least one.

    ``trees`` are the casting trees; ``None`` without any.
    """
    chosen = np.flatnonzero(receiver_mask)
    sampled = chosen[:: max(len(chosen) // RECEIVER_SAMPLE_SIZE, 1)]
    position, corners = buffer.position_frame_m.reshape(-1, 3), buffer.corners_frame_m
    assert corners is not None
    sample, triangles = position[sampled], corners.reshape(-1, 3, 3)[sampled]
    if buffer.is_lifted is not None:  # these points lie on no triangle
        is_lifted = buffer.is_lifted.reshape(-1)[sampled]
        triangles[is_lifted] = sample[is_lifted][:, None]
    camera, source = camera_of(buffer), homogeneous_light(buffer, scene, light)
    inner = 1.0 - 2.0 * MAP_BORDER_TEXELS / settings.map_size
    uniform = uniform_matrix(source, sample)[3]
    nearest = MIN_NEAR_PLANE_SHARE * float((sample @ uniform[:3] + uniform[3]).max()) if light != SUN else 0.0
    outer_receivers = sample[:0]
    for _ in range(MAX_FIT_ROUNDS):
        best, *fallbacks = _required_candidates(find_candidates(camera, source, sample, inner, outer_receivers))
        low, high, outermost = _bounds_in_map(best.clip_from_frame, uniform, nearest, position, chosen)
        if is_clear_of_horizon(np.array([low[3], high[3]])) and max(-low[:2].min(), high[:2].max()) <= MAX_SAMPLE_OVERSHOOT * inner:
            break
        outer_receivers = np.concatenate([outer_receivers, position[outermost]])
    while not is_clear_of_horizon(np.array([low[3], high[3]])):
        best, *fallbacks = _required_candidates(fallbacks)
        low, high, _ = _bounds_in_map(best.clip_from_frame, uniform, nearest, position, chosen)
    receiver_box = best.clip_from_frame, low[:3].copy(), high[:3].copy()
    error_m = CLIP_POSITION_ERROR * np.linalg.norm(triangles, axis=-1).max(axis=1)
    widening = np.maximum(min_map_ranges(best.clip_from_frame, sample, error_m, settings.map_size) - (high - low)[:2], 0.0)
    low[:2], high[:2] = low[:2] - widening / 2.0, high[:2] + widening / 2.0
    half_texels = np.array([settings.map_size / 2, settings.map_size / 2, 1.0, 1.0])[:, None]
    texel_matrix = half_texels * fit_to_bounds(best.clip_from_frame, np.array([*low[:2], -1.0]), np.array([*high[:2], 1.0]), inner)
    taps = 1 if settings.filter == "sun" else settings.filter
    low[2] = min(low[2], float(latest_start_depths(texel_matrix, sample, triangles, error_m, taps / 2.0).min()))
    clip = fit_to_bounds(best.clip_from_frame, low[:3], high[:3], inner, FRONT_DEPTH_SHARE)
    size = settings.map_size
    to_texels = np.array([[size / 2, 0, 0, size / 2], [0, size / 2, 0, size / 2], [0, 0, 0.5, 0.5], [0, 0, 0, 1.0]])
    uniforms = {
        "lamp": False,
        "clip_rows": tuple(clip.ravel()),  # GLSL matrices are column-major: these columns are the rows
        "map_rows": tuple((to_texels @ clip).ravel()),
        "position_error": CLIP_POSITION_ERROR,
        "depth_step": 1.0 / depth_step_count(settings.depth_bits),
    }
    tree_bounds = None
    if trees is not None and light == SUN:
        assert scene.light_space is not None
        light_from_frame = scene.light_space.transform_from_frame(buffer.frame)
        first, last = light_bounds(buffer.position_frame_m, receiver_mask, *light_from_frame)
        tree_bounds = *light_from_frame, first, last
    shaders = "shadows/maps/perspective_light", "shadows/maps/perspective_receiver"
    assert isinstance(buffer.view, PerspectiveView)
    texel_px = texel_size_in_picture(camera, source, clip, sample) / (size / 2) / buffer.view.pixel_tangent
    depth_map = DepthMap(
        uniforms, (size, size), (np.eye(3),), settings.depth_bits, trees, chosen, tree_bounds, shaders,
        receiver_boxes=(receiver_box,), space_from_frame=best.space_from_frame,
    )  # fmt: skip
    return FittedMap(depth_map, texel_px, best.uniform_map_reason)


def _required_candidates(candidates: list[PostPerspective]) -> list[PostPerspective]:
    """Return the candidate maps, of which there must be one. Raises ``UnsupportedError`` otherwise: a uniform map always serves,
    but only with a slide-back.
    """
    if not candidates:
        reason = (
            "the light's map from a virtual camera at the real one has its horizon among the visible points, or at the view's axis"
        )
        raise UnsupportedError("slide_back", "off", f"{reason} (use auto)")
    return candidates


def camera_of(buffer: GeometryBuffer) -> Camera:
    """Return the camera of a perspective view in the buffer's frame."""
    assert isinstance(buffer.view, PerspectiveView)
    return Camera(*buffer.view.in_frame(buffer.frame))


def homogeneous_light(buffer: GeometryBuffer, scene: Scene, light: str) -> Light:
    """Return the sun or a lamp as a homogeneous point in the buffer's frame."""
    if light == SUN:
        assert scene.sun is not None
        return Light(np.array([*scene.sun.in_frame(buffer.frame), 0.0]), np.zeros(3))
    lamp = scene.lamps[light]
    position, axis, _ = lamp.in_frame(buffer.frame)
    return Light(np.array([*position, 1.0]), position + lamp.reference_distance_m * axis)


@compiled
def _bounds_in_map(matrix, plane, min_distance, position, point_indices):
    """Return the bounds, in a map, of the points (m, 3) at the indices ``point_indices``, and the outermost of these points.

    ``matrix`` (4, 4) maps homogeneous points of the frame to the map. The bounds are the minimum and maximum (4,) of x, y and z in
    the map, and of w as a share of the distance from the plane ``plane`` (4,). The outermost points (5,) are indices: both ends in
    x and in y, and the point nearest to the map's horizon (w = 0). Points nearer than ``min_distance`` to the plane do not count in
    z. ``position`` (n, 3) are the positions of all points, metres in the frame.
    """
    low, high, outermost = np.full(4, np.inf), np.full(4, -np.inf), np.full(5, point_indices[0])
    v = np.empty(4)
    for i in point_indices:
        p = position[i]
        w = matrix[3, 0] * p[0] + matrix[3, 1] * p[1] + matrix[3, 2] * p[2] + matrix[3, 3]
        share = 1.0 / w
        plane_distance = plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] + plane[3]
        for k in range(3):
            v[k] = (matrix[k, 0] * p[0] + matrix[k, 1] * p[1] + matrix[k, 2] * p[2] + matrix[k, 3]) * share
        v[3] = w / plane_distance
        for k in range(4):
            if k == 2 and plane_distance < min_distance:
                continue
            if v[k] < low[k]:
                low[k] = v[k]
                if k != 2:
                    outermost[2 * k if k < 2 else 4] = i
            if v[k] > high[k]:
                high[k] = v[k]
                if k < 2:
                    outermost[2 * k + 1] = i
    return low, high, outermost


def texel_on_ground_m(
    scene: Scene, light: str, kinds: tuple[CasterKind, ...], settings: PerspectiveMapSettings, buffer: GeometryBuffer,
    find_candidates: MapCandidates = post_perspectives,
) -> float | np.ndarray:  # fmt: skip
    """Return a texel's larger side on level ground at a buffer's points (rows, cols), metres; 0 where nothing faces the light."""
    receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
    if not receivers.any():
        return 0.0
    trees, texel_m = caster_trees(buffer, kinds), np.zeros(buffer.valid.shape)
    if settings.slide_back == "off":
        find_candidates = partial(post_perspectives, slides_back=False)
    for fitted_map in perspective_maps(buffer, receivers, scene, light, settings, trees, find_candidates):
        assert fitted_map.depth_map.point_indices is not None
        pixel_indices, map_rows = (
            np.unravel_index(fitted_map.depth_map.point_indices, texel_m.shape),
            np.reshape(fitted_map.depth_map.uniforms["map_rows"], (4, 4)),
        )
        texel_m[pixel_indices] = texel_on_level_ground_m(map_rows, buffer.position_frame_m[pixel_indices])
    return texel_m


def calibration_settings(descriptor: Descriptor, light: str, calibration_extent: str) -> Iterator[AlgorithmSettings | None]:
    """Yield the settings that a calibration of this extent measures (``CostInputs``): sizes and taps."""
    map_overrides = calibration_overrides(descriptor, light, calibration_extent)
    for overrides in [
        *map_overrides.sizes,
        *(filter_override for filter_override in map_overrides.filters if filter_override["filter"] != "sun"),
    ]:
        yield resolve_perspective_map(SettingsRequest(descriptor, light, Shadows(**{"filter": 3, "cascades": 1} | overrides)))[0]


ALGORITHM = Algorithm(
    name="perspective_shadow_map",
    description="depth map in post-perspective space: fine near the eye",
    plural_name="perspective shadow maps",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals={
        "map": "a map view has no perspective",
        "omni": "an omni light does not fit one post-perspective map",
    },
    layers=("shadow-map", "light-frustum", "light-bounds", "light-view", "post-perspective"),
    settings_types=(PerspectiveMapSettings,),
    resolve_settings=resolve_perspective_map,
    cache_names=("skugga.terrain.gl.depth_targets",),
    search=SettingsSearch(
        search_space={"map_size": TUNED_MAP_SIZES},
        is_excluded=lambda descriptor, kind: descriptor.camera_moves,
        exclusion_reason="its texels follow the camera, so edges would crawl while the camera moves; it is for stills",
        resolution_variants=tuple({"map_size": size, "filter": taps} for size, taps in product((1024, 2048, 512), (1, 3))),
    ),
    cost=CostInputs(perspective_map_work, calibration_settings=calibration_settings),
    accuracy=AccuracyInputs(texel_px=perspective_map_texel_px, texel_m=texel_on_ground_m),
    marker=PlotMarker("diamond", "sky"),
)
