"""Summaries of levels for lists, and remarks for their authors."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skugga.terrain.errors import InputError, UnsupportedError, combined_error
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.level.pin_scope import uncovered_altitudes
from skugga.terrain.scene import Scene, build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile
    from skugga.shadows.plan import Plan


def _cost_remarks(scene: Scene) -> list[str]:
    """Return remarks on the expected times of a level's maps and views, and on level keys that reduce them.

    A remark concerns a picture that takes longer than ``SLOW_PICTURE_MS``, or a lamp's ball. Maps and views differ: a lamp's
    penumbrae may be narrower than a pixel of the one, and wide in the other.
    """
    from skugga.api.device_calibration import calibration_for
    from skugga.api.picture_cost import ESTIMATE_MARGIN, SLOW_PICTURE_MS

    shadows, views = scene.loaded.level.shadows, scene.loaded.level.views
    typical_device = calibration_for(shadows, {})
    if typical_device is None:
        return []
    # An algorithm that the level requests may not serve maps. Then only the views that the level lists are drawn.
    names = views if views and shadows.algorithm != "auto" else dict.fromkeys(("map", *views))
    plans = _predicted_plans(scene, names, typical_device)
    reported = [name for name, plan in plans.items() if _deserves_remark(scene, name, plan, SLOW_PICTURE_MS / ESTIMATE_MARGIN)]
    if not reported:
        return []
    plans = _predicted_plans(scene, reported, calibration_for(shadows, {}, shows_times=True))
    return [_cost_remark(scene, name, plan) for name, plan in plans.items() if _deserves_remark(scene, name, plan, SLOW_PICTURE_MS)]


def _predicted_plans(scene: Scene, names: Iterable[str], device: DeviceProfile | None) -> dict[str, Plan]:
    """Return the plans of the views with these names, by name, without views that the level's shadow settings do not support."""
    from skugga.selector.select import plan_of_view

    plans = {}
    for name in names:
        with suppress(UnsupportedError):
            plans[name] = plan_of_view(scene, scene.view(name), name, policy="predict", device=device)
    return plans


def _sphere_lamps(scene: Scene) -> list[str]:
    """Return the names of the lamps that are balls, not points."""
    return [name for name, lamp in scene.lamps.items() if lamp.radius_m > 0.0]


def _deserves_remark(scene: Scene, name: str, plan: Plan, slow_ms: float) -> bool:
    """Return whether a view's plan gets a remark: it takes longer than ``slow_ms``, or lamps that are balls make it costly.

    ``name`` is the view's name. A plan without a prediction gets none.
    """
    from skugga.api.picture_cost import sphere_lamps

    if plan.predicted is None:
        return False
    return plan.predicted.ms > slow_ms or bool(sphere_lamps(plan)) or (name == "map" and bool(_sphere_lamps(scene)))


def _cost_remark(scene: Scene, name: str, plan: Plan) -> str:
    """Return a remark on the expected time of the view ``name``, for a plan that has one."""
    from skugga.api.picture_cost import cost_remedy, is_over_limit, time_limit_ms
    from skugga.selector.formatting import format_duration

    assert plan.predicted is not None
    unit = " a block" if isinstance(scene.view(name), MapView) else ""
    subject = "a map" if name == "map" else f"view {name}"
    parts = [f"{subject} is expected to take {format_duration(plan.predicted.ms)}{unit}"]
    if is_over_limit(plan, time_limit_ms()):
        parts.append(f"a service refuses it, for it gives up pictures after {format_duration(time_limit_ms())}")
    filters = [
        getattr(settings, "filter", None) for lamp in _sphere_lamps(scene) for settings in plan.settings.get(lamp, {}).values()
    ]
    if (cheaper := cost_remedy(plan)) is not None:
        parts.append(cheaper)
    elif scene.loaded.level.shadows.filter == "auto" and filters and None not in filters:
        parts.append("penumbrae of lamps are narrower than a pixel here, so that 1 sample point of a lamp suffices")
    return "; ".join(parts)


def summary(source: Path | LevelSource) -> dict[str, Any]:
    """Return a level's name, title, bounds in degrees (``None`` in a flat world) and views. Raises ``SkuggaError``."""
    loaded = load_level(source)
    bounds = None
    if loaded.level.terrain.source is not None:  # generated terrain is a flat world, and takes a second to generate
        scene = build_scene(loaded.without_sun)
        bounds = scene.bounds_lon_lat
        scene.close()
    return {"name": loaded.name, "title": loaded.level.title, "bounds": bounds, "views": list(loaded.level.views)}


def remarks(source: Path | LevelSource) -> list[str]:
    """Validate a level, and return remarks for its author.

    Reads all files that the level names. Places its views and lights. Plans each view with the algorithms that the level requests.
    Raises ``SkuggaError``. One error lists everything that cannot be read or placed.
    """
    from skugga.selector.select import plan_of_view

    scene = build_scene(load_level(source))
    objects, is_generated = scene.objects, scene.loaded.level.terrain.source is None
    _check_files(scene)
    for name, view_scene in _views_to_plan(scene):
        try:
            plan_of_view(view_scene, view_scene.view(name), name, policy="rules")
        except UnsupportedError as error:
            raise UnsupportedError(f"{scene.loaded.path}: {error.name}", f"{error.value} in view {name}", error.allowed) from None
    elevation, notes = scene.elevation, []
    low, high = scene.height_range_m
    notes.append(
        f"{elevation.cols} x {elevation.rows} cells of about {elevation.cell_size_m(scene.world.metres_per_unit):.3g} m, "
        f"heights {low:.0f} to {high:.0f} m, {elevation.crs.name}"
    )
    if objects.trees is not None:
        heights = objects.trees.height_m
        notes.append(f"{len(heights)} trees, {heights.min():.1f} to {heights.max():.1f} m high")
    if objects.solids is not None:
        solids = objects.solids
        notes.append(f"{len(solids.is_closed)} meshes of {len(solids.triangles)} triangles, {sum(solids.is_closed)} of them closed")
    if scene.lamps:
        notes.append(f"lights: {', '.join(scene.lamps)}" + (" and the sun" if scene.sun is not None else ", no sun"))
    notes += _cost_remarks(scene)
    if moving_keys := scene.loaded.level.moving_keys:
        notes.append(f"moving objects: {', '.join(moving_keys)}")
    notes += objects.notes
    notes += [f"warning: {text}" for text in (*scene.warnings, *objects.warnings)]
    if not is_generated:
        notes.append(f"{elevation.vertical.statement}; if that is wrong, set terrain.units or terrain.positive")
    if scene.world.off_earth_reason is not None and not is_generated:
        notes.append(f"{scene.world.off_earth_reason}: no web tiles, and the sun is set by azimuth and altitude only")
    return notes


def _views_to_plan(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Yield view names with scenes under a sun. Plans of these show whether the level's shadow settings are supported."""
    level = scene.loaded.level
    for name in level.views if level.views and level.shadows.algorithm != "auto" else ("map",):
        yield name, scene
    pins = level.shadows.pins
    azimuth = 180.0 if scene.sun is None else scene.sun.azimuth_deg
    for number, pin in enumerate(pins):
        for name in level.views if level.views and pin.view is None else (pin.view or "map",):
            if pin.sun_altitude_deg is None and scene.sun is None:
                yield name, scene
            for low, high in uncovered_altitudes(pins, number, name):
                if high > 0.0:
                    yield name, scene.with_sun(SunSpec(azimuth=azimuth, altitude=(max(low, 0.0) + high) / 2))


def _check_files(scene: Scene) -> None:
    """Place a level's views and read the files that it names. Raises one ``InputError`` that lists all that is wrong."""
    from skugga.terrain.gbuffer.view_geometry import ground_imagery

    objects = scene.objects
    errors: list[InputError] = []
    reads: list[Callable[[], object]] = [partial(scene.view, name) for name in scene.loaded.level.views]
    reads += [
        lambda: ground_imagery(scene),
        lambda: objects.lines,
        lambda: objects.land_cover,
        lambda: objects.placement,
        lambda: objects.trees,
        lambda: scene.lamps,
    ]
    for read in reads:
        try:
            read()
        except InputError as error:
            errors.append(error)
    if errors:
        raise combined_error(errors)
