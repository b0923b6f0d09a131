"""`hybrid`: a small shadow map decides pixels where it can, and shadow volumes decide the others.

Source: E. Chan and F. Durand, An Efficient Hybrid Shadow Rendering Algorithm, Eurographics Symposium on Rendering 2004.

Volumes are drawn only in rectangles of tiles with marked pixels (``skugga.shadows.volumes.tiles``), which saves time. A stencil bit
limits counting to marked pixels, which makes the restriction exact.

The setting ``mask`` selects the marked pixels:

- ``original`` is the paper's: a pixel is marked if the comparisons with the 2 x 2 texels round it disagree. It misses casters that
  are thinner than a texel and lie between texel centres.
- ``conservative`` marks all pixels except those where ``docs/conservative-map.md`` proves that map and volumes agree. It misses no
  caster, however thin.
- ``off`` marks all receivers, so that volumes decide them all: the picture of ``conservative`` without its map.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from skugga.shadows.algorithm import MAP_SIZES_FOR_OTHER_CASTERS, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings, SettingsRequest
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.hybrid.conservative_map import LIT, MASKED, SHADED
from skugga.shadows.hybrid.layers import keep_conservative_layers
from skugga.shadows.hybrid.maps import classify_pixels
from skugga.shadows.hybrid.settings import HybridSettings, resolve_hybrid
from skugga.shadows.hybrid.work import hybrid_work
from skugga.shadows.maps.filling import visibility_by_maps
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import lamp_map, sun_maps
from skugga.shadows.passes import PassLog
from skugga.shadows.volumes.drawing import count_faces_in_front, count_volumes
from skugga.shadows.volumes.shadow_volume import GROUND_EXCLUSION_REASON, VOLUME_CACHES, VOLUME_REFUSALS, has_too_much_ground
from skugga.shadows.volumes.tiles import marked_tiles
from skugga.shadows.volumes.volumes import volumes_of
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.level.level import SUN, CasterKind, Shadows
from skugga.terrain.scene import Scene

PASSES = ("silhouettes", "map", "mask", "stencil")
"""Names of the passes that the algorithm runs, in order."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: HybridSettings,
    log: PassLog,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols), 0 or 1.

    The value is undefined off the surface and in attached shadow. Raises ``GraphicsError``.
    """
    passes = log.pass_names(light, kinds, PASSES)
    light_in_frame = np.array(scene.light_position(light, buffer.frame))
    with log.record_pass(passes[0]) as record:
        volumes = volumes_of(buffer, scene, light_in_frame, kinds, casters, record)
    receiver_mask = buffer.valid & ~attached_shadow_mask(buffer, scene, light)
    if settings.mask == "off":
        for map_pass in passes[1:3]:
            with log.record_pass(map_pass) as record:
                record.note = "not drawn: without a mask volumes decide all pixels"
        classes = np.where(receiver_mask, np.uint8(MASKED), np.uint8(LIT))
    elif settings.mask == "original":
        classes = _classify_by_comparison(buffer, scene, light, kinds, casters, settings, receiver_mask, passes, log)
    else:
        classes = classify_pixels(buffer, scene, light, kinds, volumes, settings.map.map_size, receiver_mask, passes, log)
        keep_conservative_layers(log, buffer, scene, light, volumes, settings.map.map_size, receiver_mask)
    log.keep_layer("volumes", light, count_faces_in_front, buffer, scene, volumes)
    is_masked = classes == MASKED
    log.keep_layer("silhouettes", light, lambda: np.where(is_masked, np.uint8(255), np.uint8(0)))
    with log.record_pass(passes[3]) as record:
        row, col = np.nonzero(is_masked[: buffer.view.rows])
        record.marked += len(row)
        record.tiles += int(marked_tiles(row, col, (buffer.view.rows, buffer.view.cols)).sum())
        counts = count_volumes(buffer, scene, light_in_frame, volumes, settings, is_masked, True, record)
    log.keep_layer("stencil", light, counts.copy)
    return np.where(np.where(is_masked, counts > 0, classes == SHADED), np.float32(0.0), np.float32(1.0))


def _classify_by_comparison(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: HybridSettings,
    receiver_mask: np.ndarray,
    passes: list[str],
    log: PassLog,
) -> np.ndarray:
    """Return the class of each point by comparison with 2 x 2 texels: LIT, SHADED or MASKED, uint8 (rows, cols).

    Further samples (rows below the view's) are masked: volumes decide them. ``passes`` are the names of the algorithm's passes for
    the light and the kinds.
    """
    map_settings = settings.map
    if isinstance(map_settings, ShadowMapSettings):
        maps = sun_maps(buffer, scene, map_settings, None)
    else:
        maps = [depth_map for depth_map in [lamp_map(buffer, scene.lamps[light], map_settings, None)] if depth_map is not None]
    if not maps:  # a lamp that shines on nothing
        with log.record_pass(passes[1]):
            pass
    visibility = visibility_by_maps(maps, buffer, scene, light, kinds, casters, map_settings, (passes[1], passes[2]), log)
    classes = np.where(visibility < 0.5, np.uint8(SHADED), np.uint8(255 - SHADED))
    classes[receiver_mask & (visibility > 0.0) & (visibility < 1.0)] = MASKED
    classes[buffer.view.rows :][receiver_mask[buffer.view.rows :]] = MASKED
    return classes


def _calibration_settings(descriptor: Descriptor, light: str, calibration_extent: str) -> Iterator[AlgorithmSettings | None]:
    """Yield the settings that a calibration of this extent measures (``CostInputs``): map sizes."""
    sizes = (512, 2048) if calibration_extent != "few" and light == SUN and not descriptor.relief_m else (1024,)
    for size in sizes:
        yield resolve_hybrid(SettingsRequest(descriptor, light, Shadows(map_size=size)))[0]


ALGORITHM = Algorithm(
    name="hybrid",
    needs_view_pixels=True,
    description="a small map, and shadow volumes only where it cannot decide",
    plural_name="hybrid",
    fill_visibility=fill_visibility,
    passes=PASSES,
    refusals={
        **VOLUME_REFUSALS,
        "area light": "its map leaves pixels at hard edges to volumes, and a penumbra has no hard edge (shadow_volume serves it)",
    },
    layers=("shadow-map", "stencil", "silhouettes", "volumes", "light-frustum", "light-bounds", "light-view"),
    settings_types=(HybridSettings,),
    resolve_settings=resolve_hybrid,
    cache_names=("skugga.shadows.hybrid.maps", *VOLUME_CACHES),
    search=SettingsSearch(
        map_sizes_for_other_casters=MAP_SIZES_FOR_OTHER_CASTERS,
        is_excluded=has_too_much_ground,
        exclusion_reason=GROUND_EXCLUSION_REASON,
        other_variants=({"mask": "original"}, {"map_size": 2048}),
    ),
    cost=CostInputs(
        hybrid_work,
        pass_of_part={"silhouettes": "silhouettes", "conservative map": "map", "counting": "stencil"},
        calibration_settings=_calibration_settings,
    ),
    marker=PlotMarker("triangle", "green"),
)
