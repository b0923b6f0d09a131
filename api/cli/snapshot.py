"""One snapshot: level -> scene -> descriptor -> plan -> frame, in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from skugga.api.cli.warnings import say_own_sun, say_warnings
from skugga.api.device_calibration import calibration_for
from skugga.api.picture_cost import check_cost, time_limit_ms
from skugga.selector.select import plan_of_view
from skugga.shadows.passes import PassLayer
from skugga.shadows.render import Frame, render_frame
from skugga.terrain.compiling.ahead import MAPS_OF_CASTERS, PICTURES, VIEWS
from skugga.terrain.compiling.hooks import need
from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import LoadedLevel, load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

MOST_SECONDS = 1e9
"""Of a level's clock, either way, as in level files."""


class Appearance(NamedTuple):
    """How a picture is to look; ``None``: as the level says."""

    style: str | None = None
    slope_exaggeration: float | None = None


AS_THE_LEVEL_SAYS = Appearance()


def snapshot(
    level: Path | LevelSource,
    view: str,
    sun: SunSpec | None,
    overrides: dict[str, Any],
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    on_block: Callable[[int, int], None] | None = None,
    seconds: float | None = None,
    layers: frozenset[PassLayer] = frozenset(),
    look: Appearance = AS_THE_LEVEL_SAYS,
    max_ms: float | None = None,
) -> tuple[Scene, Frame]:
    """The scene and the frame of a level's view, with intermediate ``layers``.

    Raises ``SkuggaError``, also where a block or a view is expected to take longer than ``max_ms``, or than a service would draw.
    """
    scene, view_value = scene_and_view(level, view, sun, size, bounds, crs, seconds)
    if sun is None:
        say_own_sun(scene)
    scene = scene.with_style(*look)
    device = calibration_for(scene.loaded.level.shadows, overrides)
    plan = plan_of_view(scene, view_value, view, overrides, device=device)
    most_ms = time_limit_ms() if max_ms is None else max_ms
    check_cost(plan, "a block of the map" if isinstance(view_value, MapView) else "the view", most_ms, "--max-ms")
    return scene, render_frame(scene, view_value, plan, on_block, layers)


def scene_and_view(
    level: Path | LevelSource,
    view: str,
    sun: SunSpec | None,
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    seconds: float | None = None,
) -> tuple[Scene, MapView | PerspectiveView]:
    """A level's scene under a sun, at a second of its clock, and one of its views. Raises ``SkuggaError``."""
    check_seconds(seconds)
    loaded = load_level(level)
    need_for_view(loaded, view)
    scene = build_scene(loaded).with_sun(sun).at_second(seconds)
    say_warnings(scene)
    return scene, scene.view(view, bounds, crs, size)


def need_for_view(loaded: LoadedLevel, view: str) -> None:
    """Declare which loops a picture of a level's view needs."""
    named = loaded.level.views.get(view)
    if named is not None and named.kind == "perspective":
        need(VIEWS)
    else:
        need(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else PICTURES)


def check_seconds(seconds: float | None) -> None:
    """Raise ``InputError`` for a reading that the clock of what moves does not have."""
    if seconds is not None and not abs(seconds) <= MOST_SECONDS:
        raise InputError("--seconds", seconds, f"seconds of the clock, {-MOST_SECONDS:g} to {MOST_SECONDS:g}")


def statistics(scene: Scene, frame: Frame) -> dict[str, Any]:
    """What ``--stats`` writes: plan, passes with milliseconds, caster reach, sun, view and device."""
    from skugga.terrain.gl import device as gl

    used_gl = gl.is_open()
    return {
        "level": scene.loaded.name,
        "plan": frame.plan.model_dump(mode="json"),
        "effects": sorted(frame.effects),
        "passes": [asdict(record) for record in frame.passes],
        "ms": sum(record.ms for record in frame.passes),
        "caster_reach": asdict(frame.reach),
        "sun": None
        if scene.sun is None
        else {"azimuth": scene.sun.azimuth_deg, "altitude": scene.sun.altitude_deg, "time": _iso(scene)},
        "view": _view(frame.view),
        "device": {"renderer": gl.device().renderer, "version": gl.device().version} if used_gl else None,
    }


def _view(view: MapView | PerspectiveView) -> dict[str, Any]:
    size = [view.cols, view.rows]
    if isinstance(view, MapView):
        return {"crs": view.grid.crs.to_string(), "bounds": view.bounds, "size": size, "node_step": view.grid.step}
    return {"eye_earth_m": list(view.eye_earth_m), "focal_px": view.focal_px, "size": size}


def _iso(scene: Scene) -> str | None:
    return scene.sun.time.isoformat() if scene.sun and scene.sun.time else None
