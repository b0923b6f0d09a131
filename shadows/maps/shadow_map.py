"""`shadow_map`: depth maps from the light.

The sun's map is orthographic and follows the view. A spot has one perspective map, an omni light has six. ``docs/shadow-maps.md``
derives the window of a map (``windows``), comparison and bias, the filter (``lookup``), and the sun's disc (``sun_disc``).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from skugga.shadows.algorithm import AccuracyInputs, Algorithm, CostInputs, PlotMarker, SettingsSearch
from skugga.shadows.algorithm_settings import AlgorithmSettings, SettingsRequest
from skugga.shadows.area_light import mean_visibility_of_area_light
from skugga.shadows.maps.edge_samples import maps_for_samples
from skugga.shadows.maps.filling import visibility_by_maps
from skugga.shadows.maps.relevant_trees import with_relevant_trees
from skugga.shadows.maps.resolve import TUNED_MAP_SIZES, calibration_overrides, resolve_shadow_map
from skugga.shadows.maps.settings import LampMapSettings, ShadowMapSettings
from skugga.shadows.maps.sun_disc import nearest_caster_m
from skugga.shadows.maps.texels import shadow_map_texel_m, shadow_map_texel_px
from skugga.shadows.maps.windows import lamp_map, sun_maps
from skugga.shadows.maps.work import shadow_map_work
from skugga.shadows.passes import PassLog
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_trees, has_casters
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN, CasterKind, Shadows
from skugga.terrain.scene import Scene

PASSES = ("depth map", "visibility")
"""Names of the passes that the algorithm runs, in order."""


def fill_visibility(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: ShadowMapSettings | LampMapSettings,
    log: PassLog,
) -> np.ndarray:
    """Return a light's visibility at a buffer's points where only some kinds of casters block it, float32 (rows, cols) in [0, 1].

    The value has no meaning off the surface and where the surface faces away from the light. Samples of a view's pixels are looked
    up in the sun's maps of these pixels, and are NaN outside of them. Raises ``GraphicsError``.
    """
    if isinstance(settings, LampMapSettings) and settings.filter == "sun":
        return mean_visibility_of_area_light(fill_visibility, buffer, scene, light, kinds, casters, settings, log, filter=1)
    depth_pass, visibility_pass = log.pass_names(light, kinds, PASSES)
    if buffer.first_sample_row == 0 and light == SUN and (light, kinds) in log.fitted_maps:
        with log.record_pass(visibility_pass):
            maps, unserved = maps_for_samples(log.fitted_maps[light, kinds], buffer, scene)
        visibility = visibility_by_maps(maps, buffer, scene, light, kinds, casters, settings, (depth_pass, visibility_pass), log)
        visibility[unserved] = np.nan
        return visibility
    trees = caster_trees(buffer, kinds)
    maps = []
    with log.record_pass(depth_pass):  # fitting a map is part of making it
        if not has_casters(scene, buffer, kinds):
            pass
        elif isinstance(settings, ShadowMapSettings):
            nearest_m = nearest_caster_m(scene, buffer, kinds, casters, trees) if settings.filter == "sun" else np.inf
            maps = [
                with_relevant_trees(fitted_map, buffer, settings.filter == "sun")
                for fitted_map in sun_maps(buffer, scene, settings, trees, nearest_m)
            ]
            if not isinstance(buffer.view, MapView):
                log.fitted_maps[light, kinds] = maps
        elif (lamp_depth_map := lamp_map(buffer, scene.lamps[light], settings, trees)) is not None:
            maps = [lamp_depth_map]
    return visibility_by_maps(maps, buffer, scene, light, kinds, casters, settings, (depth_pass, visibility_pass), log)


def _is_tunable(descriptor: Descriptor, light: str, key: str, value: int) -> bool:
    """Return whether the value ``value`` of the setting ``key`` (a field of ``Shadows``) makes sense for a light of a view.

    Only ``cascades`` is limited: to the sun, in a perspective view with at least as many bands of distance.
    """
    return key != "cascades" or (light == SUN and value <= len(descriptor.bands))


def _calibration_settings(descriptor: Descriptor, light: str, calibration_extent: str) -> Iterator[AlgorithmSettings | None]:
    """Yield the settings that a calibration of this extent measures (``CostInputs``): sizes, cascades and taps."""
    map_overrides = calibration_overrides(descriptor, light, calibration_extent)
    for overrides in [
        *map_overrides.sizes,
        *(CALIBRATED_CASCADES if descriptor.bands and light == SUN else ()),
        *map_overrides.filters,
    ]:
        yield resolve_shadow_map(SettingsRequest(descriptor, light, Shadows(**{"filter": 3, "cascades": 1} | overrides)))[0]


CALIBRATED_CASCADES: tuple[dict[str, Any], ...] = (
    {"map_size": 1024, "cascades": 2}, {"map_size": 1024, "cascades": 4}, {"map_size": 2048, "cascades": 4},
)  # fmt: skip
"""Overrides with several cascades that a calibration measures."""

BASELINE_OVERRIDES = {"map_size": 1024, "filter": 1}
"""Overrides of the map from which ``REPORT_VARIANTS`` differ."""

REPORT_VARIANTS: tuple[dict[str, Any], ...] = tuple(BASELINE_OVERRIDES | change for change in (
    {"cascades": 1}, {"cascades": 2}, {"cascades": 4}, {"filter": "sun"}, {"filter": 5}, {"depth_bits": 16}, {"depth_bits": 24},
    {"depth_bits": 32}, {"bias": "normal_offset"}, {"bias": "polygon_offset"}, {"fit": "tight"}, {"culling": "front"},
))  # fmt: skip
"""Settings that the report varies one at a time, from the map ``BASELINE_OVERRIDES``."""

ALGORITHM = Algorithm(
    name="shadow_map",
    description="depth map from the light, fitted to the view",
    plural_name="shadow maps",
    fill_visibility=fill_visibility,
    passes=PASSES,
    layers=("shadow-map", "light-frustum", "light-bounds", "light-view"),
    settings_types=(ShadowMapSettings, LampMapSettings),
    resolve_settings=resolve_shadow_map,
    cache_names=("skugga.terrain.gl.depth_targets", "skugga.shadows.maps.sun_disc.disc_samples_before_edges"),
    search=SettingsSearch(
        search_space={"map_size": TUNED_MAP_SIZES, "cascades": (1, 2, 4)},
        is_tunable=_is_tunable,
        resolution_variants=tuple({"map_size": size, "filter": taps} for size, taps in product((2048, 1024, 4096, 512), (1, 3))),
        other_variants=REPORT_VARIANTS,
    ),
    cost=CostInputs(shadow_map_work, calibration_settings=_calibration_settings),
    accuracy=AccuracyInputs(texel_px=shadow_map_texel_px, texel_m=shadow_map_texel_m),
    marker=PlotMarker("circle", "blue"),
)
