"""Render one snapshot in this process: level -> scene -> descriptor -> plan -> picture -> product."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from skugga.api.cli.warnings import print_default_sun, print_warnings
from skugga.api.compute import ComputedProduct, compute, plan_for
from skugga.api.encoding import ARRAY_FORMATS, apply_color_scale, as_picture, encode_exactly
from skugga.api.picture_cost import MAX_MS_OPTION, check_cost, limit_or_service_limit_ms
from skugga.api.request import PictureRequest, ProductRequest
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.plan import Plan
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.compiling.ahead_of_time import MAPS_OF_CASTERS, PICTURES, VIEWS
from skugga.terrain.compiling.hooks import declare_product
from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import LoadedLevel, load_level
from skugga.terrain.level.level_source import LevelSource
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

MAX_CLOCK_S = 1e9
"""Largest absolute reading of a level's clock, as in level files."""


StyleOverrides = Mapping[str, Any]
"""Fields of a ``PictureRequest`` that change the style, as ``read_style`` returns them; absent fields keep the level's value."""

NO_STYLE_OVERRIDES: StyleOverrides = MappingProxyType({})


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A computed view with its context.

    Attributes
    ----------
    scene, view
        The scene and the view.
    plan
        The plan; ``None`` if the product needs no shadows.
    computed
        The product and its intermediate results.
    """

    scene: Scene
    view: MapView | PerspectiveView
    plan: Plan | None
    computed: ComputedProduct

    def write(self, request: ProductRequest, path: Path) -> None:
        """Write the snapshot in the format that the path's suffix names. A GeoTIFF of a map view is georeferenced."""
        product, format = request.product_record, path.suffix.lower().removeprefix(".")
        array = apply_color_scale(self.computed.array, product, request.options, self.scene.world, format)
        if format not in ARRAY_FORMATS:
            array = as_picture(array, product, self.computed.picture)
        write_atomically(path, encode_exactly(array, product, request.options, format, self.view))


def snapshot(
    level: Path | LevelSource,
    view: str,
    request: ProductRequest,
    overrides: dict[str, Any],
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    on_block: Callable[[int, int], None] | None = None,
    seconds: float | None = None,
    light: str | None = None,
    max_ms: float | None = None,
    style_overrides: StyleOverrides = NO_STYLE_OVERRIDES,
) -> Snapshot:
    """Compute a product of a level's view.

    The request sets the sun, and ``style_overrides`` sets the style. ``overrides`` replace settings of the level's
    ``shadows``. ``size`` is (width, height) in pixels. ``bounds`` are west, south, east and north in units of ``crs``.
    ``on_block(done, total)`` is called after each block of pixels. ``seconds`` is a reading of the level's clock. ``light``
    names the light whose visibility is computed; ``None`` takes the first. Raises ``SkuggaError``, also if a block or a view
    is expected to take longer than ``max_ms``, milliseconds. Without ``max_ms`` the time limit of a service applies.
    """
    scene, view_value = scene_and_view(level, view, request.sun, size, bounds, crs, seconds)
    if request.sun is None and request.product_record.when == "sun":
        print_default_sun(scene)
    scene = PictureRequest(**style_overrides).applied_to(scene)
    plan = plan_for(scene, view_value, view, request.product_record, overrides, has_time_limit=max_ms is not None)
    if plan is not None:
        is_map = isinstance(view_value, MapView)
        subject = "a block of the map" if is_map else "the view"
        check_cost(plan, subject, limit_or_service_limit_ms(max_ms), MAX_MS_OPTION, has_free_size=not is_map)
    return Snapshot(scene, view_value, plan, compute(scene, view_value, request, plan, light, on_block))


def scene_and_view(
    level: Path | LevelSource,
    view: str,
    sun: SunSpec | None,
    size: tuple[int, int] | None = None,
    bounds: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
    seconds: float | None = None,
) -> tuple[Scene, MapView | PerspectiveView]:
    """Return a level's scene under a sun at a second of its clock, and the view of that name. Raises ``SkuggaError``.

    ``size`` is (width, height) in pixels, and ``bounds`` are west, south, east and north in units of ``crs``; ``None`` keeps
    the view's own. ``seconds`` is a reading of the level's clock; ``None``: the level's own.
    """
    check_seconds(seconds)
    loaded = load_level(level)
    declare_view_loops(loaded, view)
    scene = build_scene(loaded).with_sun(sun).at_second(seconds)
    print_warnings(scene)
    return scene, scene.view(view, bounds, crs, size)


def declare_view_loops(loaded: LoadedLevel, view: str) -> None:
    """Declare which compiled loops a picture of a level's view needs, so that they can be compiled in advance."""
    named = loaded.level.views.get(view)
    if named is not None and named.kind == "perspective":
        declare_product(VIEWS)
    else:
        declare_product(MAPS_OF_CASTERS if loaded.level.forest or loaded.level.meshes else PICTURES)


def check_seconds(seconds: float | None) -> None:
    """Raise ``InputError`` for a clock reading in seconds outside the range of a level's clock."""
    if seconds is not None and not abs(seconds) <= MAX_CLOCK_S:
        raise InputError("--seconds", seconds, f"{-MAX_CLOCK_S:g} to {MAX_CLOCK_S:g} seconds")


def snapshot_statistics(result: Snapshot) -> dict[str, Any]:
    """Return the content of ``--stats``: plan, passes with milliseconds, caster reach, sun, view and device."""
    from skugga.terrain.gl import device as gl

    used_gl, sun, computed = gl.is_device_open(), result.scene.sun, result.computed
    return {
        "level": result.scene.loaded.name,
        "plan": None if result.plan is None else result.plan.model_dump(mode="json"),
        "effects": sorted(executed_effects(computed.passes)),
        "passes": [asdict(pass_record) for pass_record in computed.passes],
        "ms": sum(pass_record.ms for pass_record in computed.passes),
        "caster_reach": None if computed.reach is None else asdict(computed.reach),
        "sun": None
        if sun is None
        else {"azimuth": sun.azimuth_deg, "altitude": sun.altitude_deg, "time": sun.time and sun.time.isoformat()},
        "view": _view_facts(result.view),
        "device": {"renderer": gl.device().renderer, "version": gl.device().version} if used_gl else None,
    }


def _view_facts(view: MapView | PerspectiveView) -> dict[str, Any]:
    """Return a view as values for JSON: a map's CRS, bounds and size, or the eye, focal length and size of a perspective view."""
    size = [view.cols, view.rows]
    if isinstance(view, MapView):
        return {"crs": view.grid.crs.to_string(), "bounds": view.bounds, "size": size, "node_step": view.grid.step}
    return {"eye_earth_m": list(view.eye_earth_m), "focal_px": view.focal_px, "size": size}
