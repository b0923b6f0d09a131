"""Count the work of depth maps: drawing them and looking points up in them.

A perspective map is a perspective shadow map (Stamminger and Drettakis 2002, "Perspective shadow maps").
"""

from __future__ import annotations

from math import ceil

import numpy as np

from skugga.shadows.area_light import scale_work
from skugga.shadows.maps.settings import LampMapSettings, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, MAP_SIZE_STEP
from skugga.shadows.work import Counts, Work, Workload
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gl.depth_targets import depth_bytes
from skugga.terrain.level.level import SUN

DRAWING_COUNTS = frozenset({
    "texels", "texels of ground", "texels of leaves", "texels in shadow", "triangles", "trees", "ground", "trees drawn",
})  # fmt: skip
"""Names of the counts of drawing a map. The others are those of fitting it and of looking points up."""

MapWindows = list[tuple[float, float]]
"""Number of texels of each of a light's maps, and its area across the light in square metres."""


def shadow_map_work(workload: Workload, settings: ShadowMapSettings | LampMapSettings) -> Work:
    """Return the work of the sun's maps, or of a lamp's."""
    if isinstance(settings, ShadowMapSettings):
        windows = sun_windows(workload.descriptor, settings)
        return {
            workload.part_name_in_view("shadow_map"): _map_counts(workload, windows, settings.filter, workload.facing_pixel_count)
        }
    if settings.filter == "sun":
        return scale_work(shadow_map_work(workload, settings.model_copy(update={"filter": 1})), settings.light_points)
    faces = 6 if workload.light_kind == "omni" else 1
    windows = [(float(settings.map_size**2), workload.level_ground_projected_m2)] * faces
    return {f"shadow_map, {workload.light_kind}": _map_counts(workload, windows, settings.filter, workload.visible_pixel_count)}


def perspective_map_work(
    workload: Workload, settings: PerspectiveMapSettings, algorithm: str = "perspective_shadow_map"
) -> Work:  # fmt: skip
    """Return the work of a perspective map, for the rates of an algorithm."""
    if settings.filter == "sun":
        work = perspective_map_work(workload, settings.model_copy(update={"filter": 1}), algorithm)
        return scale_work(work, settings.light_points)
    windows = [(float(settings.map_size**2), workload.visible_ground_projected_m2)]
    return {f"{algorithm}, {workload.light_kind}": _map_counts(workload, windows, settings.filter, workload.facing_pixel_count)}


def _map_counts(workload: Workload, windows: MapWindows, filter: int | str, lookup_count: float) -> Counts:
    """Return the counts of drawing depth maps and looking ``lookup_count`` points up in them. Cached maps are not drawn.

    ``windows`` are the maps' sizes. ``filter`` is the number of taps along a side, or ``sun``. Drawing and look-ups are counted
    together, since a device may defer the drawing until the look-up needs it.
    """
    count, texels = float(len(windows)), float(sum(texels for texels, _ in windows))
    leaves, trees = 0.0, 0.0
    for window_texels, window_m2 in windows:
        leaves += window_texels * workload.tree_layers if workload.tree_count else 0.0
        trees += workload.trees_within(window_m2) if workload.light == SUN else workload.tree_count
    counts = {
        "blocks": 1.0, "maps": count, "fitted pixels": workload.pixel_count * count, f"look-ups, filter {filter}": lookup_count,
        # A processor's cache holds a smaller share of a larger map.
        "look-ups by texels": lookup_count * texels / max(count, 1.0) / 2.0**20,
        "texels": texels, "texels of ground": texels if workload.caster_facts("relief") else 0.0, "texels of leaves": leaves,
        # The share of a map that casters cover. It is unknown for a lamp.
        "texels in shadow": texels * workload.facts.cast_share if workload.light == SUN else 0.0,
        "triangles": count * workload.triangle_count("meshes"), "trees": count * workload.tree_count,
    }  # fmt: skip
    ground = {"ground": count * workload.ground_triangle_count}
    if workload.is_map_view:  # the nodes of the block are read whatever casts
        ground |= {"pixels": workload.pixel_count, "nodes": workload.node_count}
    else:
        ground["trees drawn"] = trees
    counts |= ground
    if workload.is_cached("depth maps"):
        return {name: count for name, count in counts.items() if name not in DRAWING_COUNTS}
    return counts


def depth_map_sizes(work: Work, depth_bits: int) -> tuple[int, int]:
    """Return the number of depth maps that a step's work draws, and the bytes of their texels.

    ``work`` is that of a frame made anew. Maps have ``depth_bits`` bits a texel.
    """
    parts = [counts for counts in work.values() if "maps" in counts]
    texels = sum(counts["texels"] for counts in parts)
    return round(sum(counts["maps"] for counts in parts)), depth_bytes(1, round(texels), depth_bits)


def sun_windows(descriptor: Descriptor, settings: ShadowMapSettings) -> MapWindows:
    """Return the number of texels of each of the sun's maps, and its area perpendicular to the light, square metres.

    The maps are predicted from a descriptor, as ``skugga.shadows.maps.windows`` makes them.
    """
    spans_m = []
    if descriptor.bands:
        near_m = 0.0
        for cascade in settings.cascades:
            far_m = np.inf if cascade.far_m is None else cascade.far_m
            run = [band for band in descriptor.bands if near_m <= band.near_m < far_m]
            if run:
                spans_m.append((tuple(
                    max(band.high_light_m[k] for band in run) - min(band.low_light_m[k] for band in run) for k in (0, 1)
                ), cascade))  # fmt: skip
            near_m = far_m
    elif descriptor.receivers_light_m is not None:
        spans_m.append((descriptor.receivers_light_m[:2], settings.cascades[0]))
    windows = []
    for span_m, cascade in spans_m:
        size = [side / texel + 2 * MAP_BORDER_TEXELS for side, texel in zip(span_m, cascade.texel_m, strict=True)]
        if settings.fit == "tight":
            size = [float(settings.map_size)] * 2
        texels = float(ceil(size[0] / MAP_SIZE_STEP) * MAP_SIZE_STEP * ceil(size[1] / MAP_SIZE_STEP) * MAP_SIZE_STEP)
        windows.append((texels, span_m[0] * span_m[1]))
    return windows
