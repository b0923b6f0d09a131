"""Count the work of reconstructed volumes for the cost model, and tell the size of their texels."""

from __future__ import annotations

import numpy as np

from skugga.shadows.maps.texels import shadow_map_texel_m, shadow_map_texel_px
from skugga.shadows.maps.work import shadow_map_work
from skugga.shadows.reconstruction.settings import ReconstructionSettings
from skugga.shadows.work import Work, Workload
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import CasterKind
from skugga.terrain.scene import Scene


def reconstruction_work(workload: Workload, settings: ReconstructionSettings) -> Work:
    """Return the work of reconstructed volumes: the counts of the map, without its look-ups, and the receivers' pixels."""
    counts = next(iter(shadow_map_work(workload, settings.map).values()))
    drawn = {name: count for name, count in counts.items() if not name.startswith("look-ups")}
    return {f"reconstructed_volume, {workload.light_kind}": drawn | {"facing": workload.facing_pixel_count}}


def texel_px(
    descriptor: Descriptor, light: str, settings: ReconstructionSettings, band: CastBand, texels_per_pixel: float
) -> float:  # fmt: skip
    """Return the side of a texel in pixels, in a band of distances from the eye. ``texels_per_pixel`` is not used."""
    return shadow_map_texel_px(descriptor, light, settings.map, band, texels_per_pixel)


def texel_m(
    scene: Scene, light: str, kinds: tuple[CasterKind, ...], settings: ReconstructionSettings, buffer: GeometryBuffer
) -> float | np.ndarray:
    """Return a texel's larger side on level ground, metres, at a buffer's points (rows, cols), or one number for all."""
    return shadow_map_texel_m(scene, light, kinds, settings.map, buffer)
