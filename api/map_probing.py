"""Probe a level's maps at each scale. Plans of the level's tiles use the results (``skugga.selector.map_probes``).

A probe renders a few candidate algorithms on a block of the map, and compares them with ray-traced truth.
"""

from __future__ import annotations

from collections.abc import Callable
from math import log2
from typing import TYPE_CHECKING, Any

from skugga.selector.map_probes import MapClass, MapProbes, ProbedClass, map_class
from skugga.selector.measure.probe import ProbedView, probed_plan
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import BLOCK_PX, MapView, map_view
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

MAX_OVERSAMPLING_OCTAVES, MIN_LEVEL_SIDE_PX = 3, 128
"""Range of probed pixel sizes. The smallest is a cell's side divided by 2 ** ``MAX_OVERSAMPLING_OCTAVES``. At the largest, the
level's longer side has ``MIN_LEVEL_SIDE_PX`` pixels."""


PROBE_CENTERS = ((0.5, 0.5), (0.3, 0.62), (0.68, 0.28))
"""Centres of probed blocks, as fractions of the level's sides. One block alone predicts other blocks poorly
(``benchmarks/selection/blocks.py``)."""

SCALE_BUDGET_S = 3.0
"""Default time limit in seconds of the probes of one scale. A block is smaller than most views, and a level has many scales."""

MIN_BLOCKS_FOR_SEVERAL_PROBES = 2.0
"""Length of a level, in blocks, above which several blocks are probed."""


def probed_scales(scene: Scene) -> range:
    """Return the scales of a level's tiles, finest first. A pixel is about ``2 ** scale`` metres wide."""
    view, finest = (
        _level_map(scene),
        round(log2(scene.elevation.cell_size_m(scene.world.metres_per_unit))) - MAX_OVERSAMPLING_OCTAVES,
    )
    longest_m = max(view.rows, view.cols) * map_pixel_m(scene.world, view)
    return range(finest, max(round(log2(longest_m / MIN_LEVEL_SIDE_PX)), finest) + 1)


def with_class_sun(scene: Scene, sun_class: int) -> Scene:
    """Return a scene with a sun that represents a class of suns of similar altitude (``skugga.selector.map_probes.MapClass``).

    ``sun_class`` is the number of the class. The scene's own sun is kept if it belongs to the class. Otherwise the sun has the
    class's middle altitude and the same azimuth.
    """
    scene_sun = scene.sun
    if scene_sun is not None and (own_class := map_class(1.0, scene_sun.altitude_deg)) is not None and own_class.sun == sun_class:
        return scene
    azimuth_deg = 180.0 if scene_sun is None else scene_sun.azimuth_deg
    return scene.with_sun(SunSpec(azimuth=azimuth_deg, altitude=MapClass(0, sun_class).sun_altitude_deg))


def probe_blocks(
    scene: Scene,
    pixel_m: float,
    device: DeviceProfile | None,
    overrides: dict[str, Any] | None = None,
    budget_s: float = SCALE_BUDGET_S,
) -> ProbedView:
    """Probe some blocks of a level's map with pixels whose sides are ``pixel_m`` metres long.

    ``overrides`` replace settings of the level's ``shadows``. ``budget_s`` limits the seconds of all blocks together. Returns
    the plan of the first block and the measurements of all blocks. Raises ``SkuggaError``.
    """
    centers = probe_centers(scene, pixel_m)
    probed = [
        probed_plan(scene, map_block(scene, pixel_m, center), overrides=overrides, device=device, budget_s=budget_s / len(centers))
        for center in centers
    ]
    lights = dict.fromkeys(light for view_probe in probed for light in view_probe.observations)
    return ProbedView(
        probed[0].plan,
        {
            light: tuple(observation for view_probe in probed for observation in view_probe.observations.get(light, ()))
            for light in lights
        },
    )


def probe_centers(scene: Scene, pixel_m: float) -> tuple[tuple[float, float], ...]:
    """Return the centres of the blocks to probe, as ``center_fractions`` of ``map_block``. A level of few blocks has only one.

    ``pixel_m`` is the side of a pixel in metres.
    """
    level_map = _level_map(scene)
    longest_px = max(level_map.rows, level_map.cols) * map_pixel_m(scene.world, level_map) / pixel_m
    return PROBE_CENTERS if longest_px > MIN_BLOCKS_FOR_SEVERAL_PROBES * BLOCK_PX else PROBE_CENTERS[:1]


def probe_maps(
    scene: Scene,
    device: DeviceProfile | None,
    overrides: dict[str, Any] | None = None,
    budget_s: float = SCALE_BUDGET_S,
    on_scale: Callable[[int, ProbedView], None] = lambda scale, probed: None,
) -> MapProbes:
    """Probe a level's maps at all scales under its sun. ``on_scale(scale, probed)`` is called after each scale.

    ``overrides`` replace settings of the level's ``shadows``. ``budget_s`` limits the seconds of each scale. Raises
    ``InputError`` if no sun is above the horizon, and ``SkuggaError``.
    """
    altitude_deg = None if scene.sun is None else scene.sun.altitude_deg
    sun_class = map_class(1.0, altitude_deg)
    if sun_class is None:
        raise InputError("altitude", altitude_deg, "more than 0 degrees: maps are probed under a sun above the horizon")
    classes = []
    for scale in probed_scales(scene):
        probed = probe_blocks(scene, 2.0**scale, device, overrides, budget_s)
        on_scale(scale, probed)
        classes.append(ProbedClass(scale=scale, sun=sun_class.sun, seen=probed.observations))
    return MapProbes(classes=tuple(classes))


def _level_map(scene: Scene) -> MapView:
    """Return the map view of a level over its whole extent."""
    view = scene.view("map", scene.default_bounds(scene.map_crs))
    assert isinstance(view, MapView)
    return view


def map_block(scene: Scene, pixel_m: float, center_fractions: tuple[float, float] = (0.5, 0.5)) -> MapView:
    """Return a block of a level's map: a view of as many pixels as are drawn at once, each with a side of ``pixel_m`` metres.

    ``center_fractions`` is its centre, as fractions of the level's sides from the west and from the south.
    """
    west, south, east, north = scene.default_bounds(scene.map_crs)
    level_map = _level_map(scene)
    half = BLOCK_PX / 2 * pixel_m / map_pixel_m(scene.world, level_map) * (east - west) / level_map.cols
    x, y = west + center_fractions[0] * (east - west), south + center_fractions[1] * (north - south)
    return map_view(scene.world, scene.map_crs, (x - half, y - half, x + half, y + half), BLOCK_PX, BLOCK_PX)
