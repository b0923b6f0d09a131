"""Scene and view -> Descriptor: facts that choices are made from. No decision is made here, and none per tile."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError
from scipy.ndimage import maximum_filter, minimum_filter

from terrain.casters.clip_space import bend_px
from terrain.casters.reach import overview_on_grid
from terrain.effects import EFFECTS
from terrain.effects.effect import Fact, Look
from terrain.effects.lamps import lamp_reaches
from terrain.facts.caster_facts import map_pixel_m, slopes_deg, stands_of, trees_of
from terrain.facts.light_facts import Seen, facts_of_lights
from terrain.facts.look import look_at_scene
from terrain.facts.parts import (
    TEXEL_LADDER_PX,
    AtLeastZero,
    Band,
    CastBand,
    CasterFacts,
    Casting,
    Facts,
    LampFacts,
    LightFacts,
    Positive,
    Share,
    Slope,
    shares_add_up,
)
from terrain.facts.seen_points import edge_share, ground_points, points_in_look, points_in_map
from terrain.gbuffer.ground_mesh import ground_mesh
from terrain.geo.camera import PerspectiveView
from terrain.geo.grid import BLOCK_PX, MapView
from terrain.ground.elevation import Elevation
from terrain.ground.surface import step_at_anchor_m
from terrain.level.level import SUN, CasterKind
from terrain.level.parts import Weather
from terrain.scene import Scene

__all__ = [
    "TEXEL_LADDER_PX", "Band", "CastBand", "CasterFacts", "Casting", "Descriptor", "LampFacts", "LightFacts", "describe",
    "joined",
]  # fmt: skip

NEAREST_M = 1.0
"""What is nearer than this counts as this far away."""


def _number_of_text(fact: object) -> object:
    return {"Infinity": np.inf, "-Infinity": -np.inf}.get(fact, fact) if isinstance(fact, str) else fact


def _a_number(fact: Fact) -> Fact:
    if isinstance(fact, float) and np.isnan(fact):
        raise PydanticCustomError("nan", "a number that is one")
    return fact


class Descriptor(Facts):
    """What is known of a scene and a view; a function of (level, zoom, sun) for map views.

    ``pixel_m`` is a pixel's side on the ground (in perspective at the median distance of what is seen; ``pixel`` is its tangent);
    ``rows`` x ``cols`` of them, ``pixels`` in all, are drawn at a time: a map's block or a whole perspective view, of which
    ``seen_share`` shows a surface and not the sky, and in ``edge_share`` something ends, so that they get further samples
    (``terrain.gbuffer.antialias``; 0 in a map). ``casters`` are the kinds there are, ``stands`` what there is of each, ``lights``
    what each light does. ``relief_m`` is the range of the ground's heights, the slopes are those of the raster's overview,
    ``moves`` whether anything does by the clock. ``receivers_light_m`` is the largest extent of a block's receivers in light
    space: right, up and along the light, metres; ``None`` without a sun. ``bands`` are what a perspective view shows under the
    sun, by distance. ``highest_sun_deg`` is the sun's largest altitude anywhere over the level. ``bend_px`` is how far a map lies
    off what a camera could see of it (``terrain.casters.clip_space``). ``tallest_m`` is how far anything rises above its ground.
    ``facts`` are what effects go by besides, by effect; JSON has no infinity: there it is written as text.
    """

    model_config = ConfigDict(ser_json_inf_nan="strings")

    view: str
    view_kind: Literal["map", "perspective"]
    flat_world: bool
    pixel_m: Positive
    pixel: Positive | None = None
    rows: Annotated[int, Field(ge=1)] = BLOCK_PX
    cols: Annotated[int, Field(ge=1)] = BLOCK_PX
    pixels: Annotated[int, Field(ge=1)] = BLOCK_PX**2
    seen_share: Share = 1.0
    edge_share: Share = 0.0
    node_m: Positive
    casters: tuple[CasterKind, ...]
    stands: tuple[CasterFacts, ...] = ()
    lamps: tuple[LampFacts, ...] = ()
    lights: dict[str, LightFacts] = {}
    relief_m: AtLeastZero
    block_relief_m: AtLeastZero
    mean_slope_deg: Slope = 0.0
    p95_slope_deg: Slope = 0.0
    highest_slope_deg: Slope = 0.0
    sun_azimuth_deg: Annotated[float, Field(ge=-360, le=720, allow_inf_nan=False)] | None
    sun_altitude_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None
    highest_sun_deg: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] | None
    receivers_light_m: tuple[AtLeastZero, AtLeastZero, AtLeastZero] | None
    bands: tuple[Band, ...] = ()
    bend_px: AtLeastZero = 0.0
    tallest_m: AtLeastZero = 0.0
    moves: bool = False
    weather: Weather = Weather()
    facts: dict[str, dict[str, Annotated[Fact, BeforeValidator(_number_of_text), AfterValidator(_a_number)]]] = {}

    @model_validator(mode="before")
    @classmethod
    def _counted(cls, data: Any) -> Any:
        if isinstance(data, dict) and "pixels" not in data:
            rows, cols = (data.get(key, BLOCK_PX) for key in ("rows", "cols"))
            if isinstance(rows, int) and isinstance(cols, int) and min(rows, cols) > 0:
                return {**data, "pixels": rows * cols}
        return data

    @model_validator(mode="after")
    def _of_one_piece(self) -> Descriptor:
        _once("casters", list(self.casters), None)
        _once("stands", [its.kind for its in self.stands], self.casters)
        _once("lamps", [lamp.name for lamp in self.lamps], None)
        sun = () if self.highest_sun_deg is None else (SUN,)
        _once("lights", list(self.lights), (*sun, *(lamp.name for lamp in self.lamps)))
        for name, light in self.lights.items():
            _once(f"lights.{name}.casts", list(light.casts), self.casters)
        given = [value is not None for value in (self.sun_azimuth_deg, self.sun_altitude_deg, self.highest_sun_deg)]
        if any(given) != all(given):
            raise PydanticCustomError("sun", "a sun takes sun_azimuth_deg, sun_altitude_deg and highest_sun_deg; no sun, none")
        if not self.mean_slope_deg <= self.highest_slope_deg or not self.p95_slope_deg <= self.highest_slope_deg:
            raise PydanticCustomError(
                "slope", "highest_slope_deg {highest} lies below another slope", {"highest": self.highest_slope_deg}
            )
        shares_add_up([band.share for band in self.bands], "bands")
        return self


def _once(key: str, names: list[str], allowed: tuple[str, ...] | None) -> None:
    for number, name in enumerate(names):
        if name in names[:number]:
            raise PydanticCustomError("twice", "{key}: '{name}' stands there twice", {"key": key, "name": name})
        if allowed is not None and name not in allowed:
            what = ", ".join(allowed) or "nothing"
            raise PydanticCustomError(
                "unknown", "{key}: '{name}' is not allowed; allowed: {what}", {"key": key, "name": name, "what": what}
            )


def describe(scene: Scene, view: MapView | PerspectiveView, name: str = "map") -> Descriptor:
    """The descriptor of a view of a scene."""
    low, high = scene.height_range_m
    look = None if isinstance(view, MapView) else look_at_scene(scene, view)
    lamps = tuple(
        LampFacts(
            name=lamp.name, kind=lamp.kind, cutoff_deg=lamp.cutoff_deg, reference_m=lamp.reference_m,
            reaches=lamp_reaches(scene, lamp, view, look),
        )
        for lamp in scene.lamps.values()
    )  # fmt: skip
    mean_deg, p95_deg, highest_deg = slopes_deg(scene.world, scene.elevation)
    own = _map_facts(scene, view) if isinstance(view, MapView) else _perspective_facts(scene, view, look)
    trees = trees_of(scene, view)
    if isinstance(view, MapView):
        seen = Seen(scene, None, points_in_map(scene, own["pixel_m"], trees), trees)
        rows, cols = min(view.rows, BLOCK_PX), min(view.cols, BLOCK_PX)
    else:
        seen, rows, cols = Seen(scene, view, points_in_look(look, view, trees), trees), view.rows, view.cols
    return Descriptor(
        view=name, flat_world=scene.world.flat, casters=scene.population.kinds, lamps=lamps, relief_m=high - low,
        rows=rows, cols=cols, edge_share=0.0 if look is None else edge_share(look, trees),
        stands=stands_of(scene, view, trees), moves=_moves(scene),
        mean_slope_deg=mean_deg, p95_slope_deg=p95_deg, highest_slope_deg=highest_deg,
        sun_azimuth_deg=scene.sun and scene.sun.azimuth_deg, sun_altitude_deg=scene.sun and scene.sun.altitude_deg,
        highest_sun_deg=scene.highest_sun_deg, tallest_m=scene.population.tallest_m, weather=scene.loaded.level.weather,
        lights=facts_of_lights(seen, _area_share(scene, own["receivers_light_m"])),
        facts={key: _known(effect.facts(scene, view, look)) for key, effect in EFFECTS.items() if effect.facts is not None}, **own,
    )  # fmt: skip


def _known(facts: dict[str, Fact]) -> dict[str, Fact]:
    """Facts of an effect, ``None`` for what is no number: the difference of two shadows without end, say."""
    return {key: None if isinstance(fact, float) and np.isnan(fact) else fact for key, fact in facts.items()}


def _moves(scene: Scene) -> bool:
    """Whether anything moves by the clock: a caster, or clouds that hide part of the sky."""
    level = scene.loaded.level
    drifts = 0.0 < level.weather.cloud_cover < 1.0
    return drifts or any(mesh.motion is not None and mesh.motion.spin != 0.0 for mesh in level.meshes)


def _area_share(scene: Scene, seen_light_m: tuple[float, float, float] | None) -> float:
    """What is seen at a time as a share of the level's area across the sun's light."""
    if seen_light_m is None or scene.light is None:
        return 1.0
    at = scene.light.from_earth(ground_points(scene.world, scene.elevation).point_earth_m)
    whole = np.maximum(np.ptp(at, axis=0), 1e-9) if len(at) else np.ones(3)
    return float(np.prod(np.minimum(np.array(seen_light_m[:2]) / whole[:2], 1.0)))


def _map_facts(scene: Scene, view: MapView) -> dict[str, Any]:
    node_m, pixel_m = step_at_anchor_m(scene.world, view.grid), map_pixel_m(scene, view)
    relief_m = _block_relief_m(scene.elevation, BLOCK_PX * pixel_m, scene.world.metres_per_unit) + scene.population.tallest_m
    return {
        "view_kind": "map", "pixel_m": pixel_m, "node_m": node_m, "block_relief_m": relief_m,
        "receivers_light_m": _receivers_light_m(scene, view, relief_m),
        "bend_px": bend_px(scene, view.grid, view.row_step, view.col_step),
    }  # fmt: skip


def _perspective_facts(scene: Scene, view: PerspectiveView, look: Look) -> dict[str, Any]:
    points, away_m = look.points_frame_m, look.away_m
    median_m = float(np.median(away_m)) if len(points) else 1.0
    bands: tuple[Band, ...] = ()
    extent = None
    if scene.light is not None:
        rotation, translation = scene.light.from_frame(look.buffer.frame)
        bands = _bands(away_m, points @ rotation.T + translation, scene.population.tallest_m, look.spacing)
        whole = joined(bands) if bands else None
        span = np.full(3, median_m * view.pixel) if whole is None else np.subtract(whole.high_light_m, whole.low_light_m)
        extent = tuple(span.tolist())
    grid = ground_mesh(scene, view).grid
    return {
        "view_kind": "perspective", "pixel_m": median_m * view.pixel, "node_m": step_at_anchor_m(scene.world, grid),
        "pixel": view.pixel, "bands": bands, "seen_share": float(look.buffer.there.mean()),
        "block_relief_m": float(np.ptp(look.height_m)) if len(points) else 0.0, "receivers_light_m": extent,
    }  # fmt: skip


def _bands(away_m: np.ndarray, light_m: np.ndarray, tallest_m: float, slack: float) -> tuple[Band, ...]:
    """Bands of points at distances (n,) with light-space coordinates (n, 3); ``slack`` is how far apart they lie, as a share of
    their distance, and what stands on the ground may rise by ``tallest_m``.
    """
    octave = np.ceil(np.log2(np.maximum(away_m, NEAREST_M))).astype(int)
    order = np.argsort(octave, kind="stable")
    first = np.flatnonzero(np.diff(octave[order], prepend=octave.min(initial=0) - 1))
    if not len(first):
        return ()
    shares = np.diff(first, append=len(octave)) / len(octave)
    lows, highs = (end.reduceat(light_m[order], first, axis=0) for end in (np.minimum, np.maximum))
    bands = []
    for number, share, low, high in zip(octave[order][first].tolist(), shares.tolist(), lows, highs, strict=True):
        margin = slack * 2.0**number + tallest_m * np.array([0.0, 1.0, 1.0])
        bounds = {"low_light_m": tuple((low - margin).tolist()), "high_light_m": tuple((high + margin).tolist())}
        bands.append(Band(near_m=2.0 ** (number - 1), far_m=2.0**number, share=share, **bounds))
    return tuple(bands)


def joined(bands: tuple[Band, ...]) -> Band:
    """The band of neighbouring bands."""
    low = np.min([band.low_light_m for band in bands], axis=0)
    high = np.max([band.high_light_m for band in bands], axis=0)
    bounds = {"low_light_m": tuple(low.tolist()), "high_light_m": tuple(high.tolist())}
    return Band(near_m=bands[0].near_m, far_m=bands[-1].far_m, share=min(sum(band.share for band in bands), 1.0), **bounds)


def _receivers_light_m(scene: Scene, view: MapView, relief_m: float) -> tuple[float, float, float] | None:
    """The largest light-space extent of blocks laid out over the level: 3 x 3 of them, 17 x 17 points each, plus relief."""
    if scene.light is None:
        return None
    row, col, _ = overview_on_grid(scene.world, scene.elevation, view.grid)
    known = np.isfinite(row) & np.isfinite(col)
    widest = np.zeros(3)
    if known.any():
        spans = []
        for values, step in ((row[known], view.row_step), (col[known], view.col_step)):
            side = min(BLOCK_PX * step, float(np.ptp(values)) + 2.0 * 2**scene.elevation.overview.level)
            spans.append((np.linspace(values.min() + side / 2, max(values.max() - side / 2, values.min() + side / 2), 3), side))
        (mid_rows, height), (mid_cols, width) = spans
        middle, across = float(np.mean(scene.height_range_m)), np.linspace(-0.5, 0.5, 17)
        rows = (mid_rows[:, None] + across * height)[:, None, :, None]
        cols = (mid_cols[:, None] + across * width)[None, :, None, :]
        point, up = scene.world.ground(view.grid.crs, *np.broadcast_arrays(view.grid.x(cols), view.grid.y(rows)))
        points = scene.light.from_earth(point + middle * up).reshape(9, -1, 3)
        known = np.isfinite(points).all(axis=2, keepdims=True)
        ends = np.where(known, points, -np.inf).max(axis=1) - np.where(known, points, np.inf).min(axis=1)
        widest = np.maximum(widest, ends.max(axis=0))
    altitude = np.radians(scene.light.altitude_deg)
    widest += relief_m * np.array([0.0, abs(np.cos(altitude)), abs(np.sin(altitude))])
    return tuple(float(v) for v in np.maximum(widest, step_at_anchor_m(scene.world, view.grid)))  # type: ignore[return-value]


@lru_cache(maxsize=32)
def _block_relief_m(elevation: Elevation, block_m: float, metres_per_unit: float) -> float:
    """The largest range of heights within a block's side anywhere on the level, from the overview."""
    overview = elevation.overview
    cell_m = elevation.cell_size_m(metres_per_unit) * 2**overview.level
    size = [int(np.clip(np.ceil(block_m / cell_m) + 1, 1, n)) for n in overview.heights_m.shape]
    top = maximum_filter(np.nan_to_num(overview.high_m, nan=-np.inf), size=size, mode="nearest")
    bottom = minimum_filter(np.nan_to_num(overview.heights_m, nan=np.inf), size=size, mode="nearest")
    ranges = (top - bottom)[np.isfinite(top) & np.isfinite(bottom)]
    return float(ranges.max()) if ranges.size else 0.0
