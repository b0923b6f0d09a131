"""Count the work of the hybrid for the cost model: its map, the mask, and its volumes in marked pixels."""

from __future__ import annotations

import numpy as np

from skugga.shadows.hybrid.settings import HybridSettings
from skugga.shadows.maps.windows import POSITION_ERROR
from skugga.shadows.maps.work import shadow_map_work
from skugga.shadows.volumes.tiles import CULLING_TILE_PX
from skugga.shadows.volumes.work import silhouette_work, stencil_counts, volume_faces
from skugga.shadows.work import Work, Workload
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX

MIN_TEXEL_SHARE = 256.0 * POSITION_ERROR
"""Minimum texel size of a hybrid's map, as a share of the extent of the visible points.

The share is that of ``MIN_TEXEL_ROUNDING_ERRORS`` rounding errors.
"""


def hybrid_work(workload: Workload, settings: HybridSettings) -> Work:
    """Return the hybrid's work for a picture, as counts by part."""
    texel_px, size = _texel_px(workload, settings.map.map_size)
    marked_share = 1.0 if settings.mask == "off" else _masked_share(workload, texel_px + CULLING_TILE_PX)
    counting = silhouette_work(workload) | {
        workload.part_name_in_view("counting"): stencil_counts(workload, settings, marked_share)
    }
    if settings.mask == "off":
        return counting
    if settings.mask == "original":
        return counting | shadow_map_work(workload, settings.map)
    _, caps, ground = volume_faces(workload)
    faces = 6.0 if workload.light_kind == "omni" else 1.0
    texels = faces * size**2
    map_counts = {
        "blocks": 1.0, "texels": texels, "texels of ground": texels if workload.caster_facts("relief") else 0.0, "texels in shadow":
        texels * workload.facts.cast_share, "caps": caps, "ground": ground, "facing": workload.facing_pixel_count,
    }  # fmt: skip
    mask = {"blocks": 1.0, "facing": workload.facing_pixel_count, "pixels": workload.pixel_count, "texels": texels}
    if workload.is_cached("conservative maps"):
        return counting | {"mask": mask}
    return counting | {workload.part_name_in_view("conservative map"): map_counts, "mask": mask}


def _texel_px(workload: Workload, map_size: int) -> tuple[float, float]:
    """Return the size of a map's texel in pixels, and the number of texels a side.

    ``map_size`` is the requested number of texels a side, which is lowered where texels would get too small.
    """
    extent_m = np.sqrt(workload.visible_ground_projected_m2)
    far_m = max((band.far_m for band in workload.descriptor.bands), default=extent_m)
    texel_m = max(extent_m / map_size, MIN_TEXEL_SHARE * far_m / 2.0)
    return texel_m / workload.descriptor.pixel_m, extent_m / texel_m


def _masked_share(workload: Workload, side_px: float) -> float:
    """Return the share of the picture in squares of ``side_px`` pixels that a shadow edge crosses; 1 without facts on casters."""
    if not workload.facts.casts:
        return 1.0
    log_texel_sizes = np.log2(TEXEL_SIZES_PX)
    shares = [
        band.share * np.interp(np.log2(side_px), log_texel_sizes, band.differs)
        for kind, casting in workload.facts.casts.items() if kind in workload.kinds
        for band in casting.bands
    ]  # fmt: skip
    return float(min(sum(shares), 1.0))
