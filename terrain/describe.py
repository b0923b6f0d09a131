"""Build the descriptor of a scene and a view: the facts that the selector decides from.

This module decides nothing. The facts of a map hold for all its tiles, so none is computed for each tile.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.casters.clip_space import affine_camera_error_px
from skugga.terrain.casters.overview_cells import overview_on_grid
from skugga.terrain.effects import EFFECTS
from skugga.terrain.effects.lamps import visible_lamps
from skugga.terrain.facts.caster_facts import caster_facts_of, drawn_trees_of, slopes_deg
from skugga.terrain.facts.coarse_view import CoarseView, coarse_view_of
from skugga.terrain.facts.descriptor import Descriptor, join_bands
from skugga.terrain.facts.fact_types import Band, Fact, LampFacts
from skugga.terrain.facts.light_facts import MIN_EYE_DISTANCE_M, ViewProbes, facts_of_lights
from skugga.terrain.facts.plane_facts import plane_facts
from skugga.terrain.facts.row_widths import row_width_ratio
from skugga.terrain.facts.visible_points import edge_share, ground_points, probes_in_map, probes_in_view
from skugga.terrain.gbuffer.ground_mesh import ground_mesh
from skugga.terrain.gbuffer.supersampling import PixelSampling, max_ground_pixels, subdivision_level, supersampled_view
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, step_at_anchor_m
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene


def describe(
    scene: Scene, view: MapView | PerspectiveView, name: str = "map", pixel_sampling: PixelSampling = "means"
) -> Descriptor:
    """Return the descriptor of a view of a scene.

    ``name`` is the view's name. ``pixel_sampling`` says whether a map's pixels show means of the nodes that they cover (``means``),
    or single points (``points``). With means, a coarse map has the descriptor of the finer map whose pixels it averages.
    """
    pieces = 1 if pixel_sampling == "points" or not isinstance(view, MapView) else 2 ** subdivision_level(scene, view)
    sampled_view = supersampled_view(scene, view, pixel_sampling)
    low, high = scene.height_range_m
    coarse_view = None if isinstance(view, MapView) else coarse_view_of(scene, view)
    visible_lamp_names = visible_lamps(scene, view, coarse_view)
    lamps = tuple(
        LampFacts(
            name=lamp.name, kind=lamp.kind, cutoff_deg=lamp.cutoff_deg, reference_m=lamp.reference_distance_m,
            reaches=lamp.name in visible_lamp_names, radius_m=lamp.radius_m,
        )
        for lamp in scene.lamps.values()
    )  # fmt: skip
    effects = scene.loaded.level.effects
    all_lamps = effects != "auto" and effects.get("lamps") == "on"
    lamp_names = [lamp.name for lamp in lamps if lamp.reaches or all_lamps]
    mean_deg, p95_deg, highest_deg = slopes_deg(scene.world, scene.elevation)
    trees = drawn_trees_of(scene, sampled_view)
    if isinstance(sampled_view, MapView):
        view_facts = _map_facts(scene, sampled_view)
        if pieces > 1 and isinstance(view, MapView):
            shown_pixels = min(min(view.rows, BLOCK_PX) * min(view.cols, BLOCK_PX), max_ground_pixels(scene, view))
            view_facts["pixels"] = max(int(shown_pixels * pieces**2), 1)
        probes = ViewProbes(scene, None, probes_in_map(scene, view_facts["pixel_m"], trees), trees)
        rows, cols = min(sampled_view.rows, BLOCK_PX), min(sampled_view.cols, BLOCK_PX)
    else:
        assert coarse_view is not None and isinstance(view, PerspectiveView)
        view_facts = _perspective_facts(scene, view, coarse_view)
        probes, rows, cols = ViewProbes(scene, view, probes_in_view(coarse_view, view, trees), trees), view.rows, view.cols
    receiver_planes, plane_share = plane_facts(scene, coarse_view, probes.probes)
    return Descriptor(
        view=name, flat_world=scene.world.is_flat, radius_m=scene.world.radius_m, casters=scene.objects.caster_kinds, lamps=lamps,
        relief_m=high - low, rows=rows, cols=cols, edge_share=0.0 if coarse_view is None else edge_share(coarse_view, trees),
        pieces=pieces, stands=caster_facts_of(scene, sampled_view, trees), moves=bool(scene.loaded.level.moving_keys),
        mean_slope_deg=mean_deg, p95_slope_deg=p95_deg, highest_slope_deg=highest_deg,
        sun_azimuth_deg=scene.sun and scene.sun.azimuth_deg, sun_altitude_deg=scene.sun and scene.sun.altitude_deg,
        highest_sun_deg=scene.highest_sun_deg, receiver_planes=receiver_planes, plane_share=plane_share,
        tallest_m=scene.objects.tallest_object_m, weather=scene.loaded.level.weather,
        lights=facts_of_lights(probes, _visible_area_share(scene, view_facts["receivers_light_m"]), lamp_names),
        facts={key: _nan_to_none(effect.facts(scene, view, coarse_view)) for key, effect in EFFECTS.items()
               if effect.facts is not None},
        **view_facts,
    )  # fmt: skip


def _nan_to_none(facts: dict[str, Fact]) -> dict[str, Fact]:
    """Return an effect's facts with ``None`` instead of NaN, such as for the difference of two shadows of infinite length."""
    return {key: None if isinstance(fact, float) and np.isnan(fact) else fact for key, fact in facts.items()}


def _visible_area_share(scene: Scene, visible_extent_m: tuple[float, float, float] | None) -> float:
    """Return the share of the level's area that a map's block or a perspective view shows, as seen from the sun.

    ``visible_extent_m`` is the extent of what it shows in light space (right, up, along the light), in metres; ``None`` without a
    sun, which gives 1.
    """
    if visible_extent_m is None or scene.light_space is None:
        return 1.0
    ground_light = scene.light_space.points_from_earth(ground_points(scene.world, scene.elevation).point_earth_m)
    extent = np.maximum(np.ptp(ground_light, axis=0), 1e-9) if len(ground_light) else np.ones(3)
    return float(np.prod(np.minimum(np.array(visible_extent_m[:2]) / extent[:2], 1.0)))


def _map_facts(scene: Scene, view: MapView) -> dict[str, Any]:
    """Return the fields of the ``Descriptor`` that depend on the kind of view, by name, for a map."""
    node_m, pixel_m = step_at_anchor_m(scene.world, view.grid), map_pixel_m(scene.world, view)
    relief_m = _block_relief_m(scene.elevation, BLOCK_PX * pixel_m, scene.world.metres_per_unit) + scene.objects.tallest_object_m
    return {
        "view_kind": "map", "pixel_m": pixel_m, "node_m": node_m, "block_relief_m": relief_m,
        "receivers_light_m": _max_receiver_extent_m(scene, view, relief_m),
        "bend_px": affine_camera_error_px(scene, view.grid, view.row_step, view.col_step),
        "row_width_ratio": row_width_ratio(scene, view.grid, view),
    }  # fmt: skip


def _perspective_facts(scene: Scene, view: PerspectiveView, coarse_view: CoarseView) -> dict[str, Any]:
    """Return the fields of the ``Descriptor`` that depend on the kind of view, by name, for a perspective view."""
    points, distance_m = coarse_view.points_frame_m, coarse_view.distance_m
    median_m = float(np.median(distance_m)) if len(points) else 1.0
    bands: tuple[Band, ...] = ()
    extent = None
    if scene.light_space is not None:
        rotation, translation = scene.light_space.transform_from_frame(coarse_view.buffer.frame)
        reach = _bounds_at_unit_distance(view, rotation @ coarse_view.buffer.frame.frame_from_earth)
        visible = _LightSpacePoints(points @ rotation.T + translation, coarse_view.eye_frame_m @ rotation.T + translation, *reach)
        bands = _distance_bands(distance_m, visible, scene.objects.tallest_object_m, coarse_view.spacing_tangent)
        all_bands = join_bands(bands) if bands else None
        span = (
            np.full(3, median_m * view.pixel_tangent)
            if all_bands is None
            else np.subtract(all_bands.high_light_m, all_bands.low_light_m)
        )
        extent = tuple(span.tolist())
    grid = ground_mesh(scene, view).grid
    return {
        "view_kind": "perspective", "pixel_m": median_m * view.pixel_tangent, "node_m": step_at_anchor_m(scene.world, grid),
        "pixel": view.pixel_tangent, "bands": bands, "seen_share": float(coarse_view.buffer.valid.mean()),
        "block_relief_m": float(np.ptp(coarse_view.height_m)) if len(points) else 0.0, "receivers_light_m": extent,
        "row_width_ratio": row_width_ratio(scene, grid),
    }  # fmt: skip


@dataclass(frozen=True, eq=False)
class _LightSpacePoints:
    """The visible points in light space.

    Attributes
    ----------
    points_m
        (n, 3), the points in metres.
    eye_m
        (3,), the eye in metres.
    min_offset_per_distance, max_offset_per_distance
        (3,), lower and upper bounds of the offset of a visible point from the eye, per unit of distance.
    """

    points_m: np.ndarray
    eye_m: np.ndarray
    min_offset_per_distance: np.ndarray
    max_offset_per_distance: np.ndarray


def _bounds_at_unit_distance(view: PerspectiveView, light_from_earth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lower and upper bounds (3,) of the offset from the eye of any point that a view shows up to distance 1.

    Offsets are along the axes of light space. The bounds enclose the cone round the view's corners.
    """
    last = np.array([view.cols - 1, view.rows - 1])
    (left, top), (right, bottom) = (
        (np.array([view.col0, view.row0]) + view.step_px * px) / view.focal_px for px in (np.full(2, -0.5), last + 0.5)
    )
    corners = np.array([[x, y, 1.0] for x in (left, right) for y in (top, bottom)])
    corners /= np.linalg.norm(corners, axis=1, keepdims=True)
    axis = corners.sum(axis=0) / np.linalg.norm(corners.sum(axis=0))
    half_angle = np.arccos(np.clip((corners @ axis).min(), -1.0, 1.0))
    cosine = np.clip(light_from_earth @ view.earth_from_camera @ axis, -1.0, 1.0)
    low, high = (np.maximum(np.cos(np.maximum(np.arccos(axis_cosine) - half_angle, 0.0)), 0.0) for axis_cosine in (-cosine, cosine))
    return -low, high


def _distance_bands(
    distance_m: np.ndarray, visible_points: _LightSpacePoints, max_object_height_m: float, spacing_tangent: float
) -> tuple[Band, ...]:
    """Return the visible surfaces by distance: one ``Band`` for each power of two in the points' distances (n,).

    ``spacing_tangent`` is the distance between neighbouring points as a share of their distance from the eye. It widens each band's
    bounds. The bounds also leave room for objects of height ``max_object_height_m``, as far as the view shows them.
    """
    light_m = visible_points.points_m
    octave = np.ceil(np.log2(np.maximum(distance_m, MIN_EYE_DISTANCE_M))).astype(int)
    order = np.argsort(octave, kind="stable")
    first = np.flatnonzero(np.diff(octave[order], prepend=octave.min(initial=0) - 1))
    if not len(first):
        return ()
    shares = np.diff(first, append=len(octave)) / len(octave)
    lows, highs = (end.reduceat(light_m[order], first, axis=0) for end in (np.minimum, np.maximum))
    bands = []
    for number, share, low, high in zip(octave[order][first].tolist(), shares.tolist(), lows, highs, strict=True):
        margin_m, objects_m = spacing_tangent * 2.0**number, max_object_height_m * np.array([0.0, 1.0, 1.0])
        low = (
            np.maximum(
                low - objects_m, np.minimum(low, visible_points.eye_m + 2.0**number * visible_points.min_offset_per_distance)
            )
            - margin_m
        )
        high = (
            np.minimum(
                high + objects_m, np.maximum(high, visible_points.eye_m + 2.0**number * visible_points.max_offset_per_distance)
            )
            + margin_m
        )
        bounds = {"low_light_m": tuple(low.tolist()), "high_light_m": tuple(high.tolist())}
        bands.append(Band(near_m=2.0 ** (number - 1), far_m=2.0**number, share=share, **bounds))
    return tuple(bands)


def _max_receiver_extent_m(scene: Scene, view: MapView, relief_m: float) -> tuple[float, float, float] | None:
    """Return the largest extent of a block's visible surfaces in light space: right, up, along the light, metres.

    ``None`` without a sun. Nine blocks (3 x 3) over the level are sampled, with 17 x 17 points each. ``relief_m``, the range of
    heights in a block, is added.
    """
    if scene.light_space is None:
        return None
    row, col, _ = overview_on_grid(scene.world, scene.elevation, view.grid)
    valid = np.isfinite(row) & np.isfinite(col)
    max_extent = np.zeros(3)
    if valid.any():
        spans = []
        for values, step in ((row[valid], view.row_step), (col[valid], view.col_step)):
            side = min(BLOCK_PX * step, float(np.ptp(values)) + 2.0 * 2**scene.elevation.overview.lod)
            spans.append((np.linspace(values.min() + side / 2, max(values.max() - side / 2, values.min() + side / 2), 3), side))
        (mid_rows, height), (mid_cols, width) = spans
        mean_height_m, offsets = float(np.mean(scene.height_range_m)), np.linspace(-0.5, 0.5, 17)
        rows = (mid_rows[:, None] + offsets * height)[:, None, :, None]
        cols = (mid_cols[:, None] + offsets * width)[None, :, None, :]
        point, up = scene.world.points_at_zero_height(view.grid.crs, *np.broadcast_arrays(view.grid.x(cols), view.grid.y(rows)))
        points = scene.light_space.points_from_earth(point + mean_height_m * up).reshape(9, -1, 3)
        valid = np.isfinite(points).all(axis=2, keepdims=True)
        ends = np.where(valid, points, -np.inf).max(axis=1) - np.where(valid, points, np.inf).min(axis=1)
        max_extent = np.maximum(max_extent, ends.max(axis=0))
    altitude = np.radians(scene.light_space.altitude_deg)
    max_extent += relief_m * np.array([0.0, abs(np.cos(altitude)), abs(np.sin(altitude))])
    right, up, along_light = np.maximum(max_extent, step_at_anchor_m(scene.world, view.grid)).tolist()
    return right, up, along_light


@cached("scene", MIB)
def _block_relief_m(elevation: Elevation, block_m: float, metres_per_unit: float) -> float:
    """Return the largest range of heights in metres within a square of side ``block_m`` on the level, from its overview."""
    from scipy.ndimage import maximum_filter, minimum_filter

    overview = elevation.overview
    cell_m = elevation.cell_size_m(metres_per_unit) * 2**overview.lod
    size = [int(np.clip(np.ceil(block_m / cell_m) + 1, 1, n)) for n in overview.mean_heights_m.shape]
    top = maximum_filter(np.nan_to_num(overview.max_heights_m, nan=-np.inf), size=size, mode="nearest")
    bottom = minimum_filter(np.nan_to_num(overview.mean_heights_m, nan=np.inf), size=size, mode="nearest")
    ranges = (top - bottom)[np.isfinite(top) & np.isfinite(bottom)]
    return float(ranges.max()) if ranges.size else 0.0
