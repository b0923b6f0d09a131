"""Probes of a level's maps, scale by scale: what plans of its tiles go by (``skugga.selector.map_probes``)."""

from __future__ import annotations

from collections.abc import Callable
from math import log2
from typing import TYPE_CHECKING, Any

from skugga.selector.map_probes import MapClass, MapProbes, ProbedClass, map_class
from skugga.selector.measure.probe import DEFAULT_BUDGET_S, ProbedView, probed_plan
from skugga.terrain.errors import InputError
from skugga.terrain.geo.grid import BLOCK_PX, MapView, map_view
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

FINEST, COARSEST_PX = 3, 128
"""Probed are pixels of a cell's side over 2 ** ``FINEST``, and so on up to those of which ``COARSEST_PX`` show the level, as tiles
do.
"""


PROBED_PLACES = ((0.5, 0.5), (0.3, 0.62), (0.68, 0.28))
"""Middles of blocks, as shares of a level's sides: one block says little of others (``benchmarks/selection/blocks.py``)."""

WIDE_BLOCKS = 2.0
"""Several are probed of a level that is longer than so many."""


def probed_scales(scene: Scene) -> range:
    """The scales of a level's tiles (``skugga.selector.map_probes.MapClass``)."""
    view, finest = _whole(scene), round(log2(scene.elevation.cell_size_m(scene.world.metres_per_unit))) - FINEST
    longest_m = max(view.rows, view.cols) * map_pixel_m(scene.world, view)
    return range(finest, max(round(log2(longest_m / COARSEST_PX)), finest) + 1)


def under_class_sun(scene: Scene, sun: int) -> Scene:
    """A scene under the sun that stands for a class of suns: its own, if that is one of them, else one in the middle of the class,
    above the same point of the compass.
    """
    own = scene.sun
    if own is not None and (found := map_class(1.0, own.altitude_deg)) is not None and found.sun == sun:
        return scene
    azimuth_deg = 180.0 if own is None else own.azimuth_deg
    return scene.with_sun(SunSpec(azimuth=azimuth_deg, altitude=MapClass(0, sun).sun_altitude_deg))


def probe_blocks(
    scene: Scene,
    pixel_m: float,
    device: DeviceProfile | None,
    overrides: dict[str, Any] | None = None,
    budget_s: float = DEFAULT_BUDGET_S,
) -> ProbedView:
    """Probe blocks of a level's maps with pixels of a side of ``pixel_m`` metres: the plan of the first, and what was seen in
    all of them.

    Raises ``SkuggaError``.
    """
    places = probed_places(scene, pixel_m)
    probed = [
        probed_plan(scene, map_block(scene, pixel_m, at), overrides=overrides, device=device, budget_s=budget_s / len(places))
        for at in places
    ]
    lights = dict.fromkeys(light for each in probed for light in each.seen)
    return ProbedView(
        probed[0].plan, {light: tuple(seen for each in probed for seen in each.seen.get(light, ())) for light in lights}
    )


def probed_places(scene: Scene, pixel_m: float) -> tuple[tuple[float, float], ...]:
    """Where blocks of a level are probed, as ``map_block`` takes it: in one place only where one block shows much of the level."""
    whole = _whole(scene)
    longest_px = max(whole.rows, whole.cols) * map_pixel_m(scene.world, whole) / pixel_m
    return PROBED_PLACES if longest_px > WIDE_BLOCKS * BLOCK_PX else PROBED_PLACES[:1]


def probe_maps(
    scene: Scene,
    device: DeviceProfile | None,
    overrides: dict[str, Any] | None = None,
    budget_s: float = DEFAULT_BUDGET_S,
    on_scale: Callable[[int, ProbedView], None] = lambda scale, probed: None,
) -> MapProbes:
    """Probe a level's maps of all scales under its sun; ``on_scale(scale, probed)`` is called after each.

    Raises ``InputError`` where no sun shines, else ``SkuggaError``.
    """
    altitude_deg = None if scene.sun is None else scene.sun.altitude_deg
    of_sun = map_class(1.0, altitude_deg)
    if of_sun is None:
        raise InputError("altitude", altitude_deg, "a sun above the horizon: maps are probed under it")
    classes = []
    for scale in probed_scales(scene):
        probed = probe_blocks(scene, 2.0**scale, device, overrides, budget_s)
        on_scale(scale, probed)
        classes.append(ProbedClass(scale=scale, sun=of_sun.sun, seen=probed.seen))
    return MapProbes(classes=tuple(classes))


def _whole(scene: Scene) -> MapView:
    view = scene.view("map", scene.default_bounds(scene.map_crs))
    assert isinstance(view, MapView)
    return view


def map_block(scene: Scene, pixel_m: float, at: tuple[float, float] = (0.5, 0.5)) -> MapView:
    """A block of a level's map with pixels of a side of ``pixel_m`` metres; ``at`` is where its middle lies, as shares of the
    level's sides from the west and the south.
    """
    west, south, east, north = scene.default_bounds(scene.map_crs)
    whole = _whole(scene)
    half = BLOCK_PX / 2 * pixel_m / map_pixel_m(scene.world, whole) * (east - west) / whole.cols
    x, y = west + at[0] * (east - west), south + at[1] * (north - south)
    return map_view(scene.world, scene.map_crs, (x - half, y - half, x + half, y + half), BLOCK_PX, BLOCK_PX)
