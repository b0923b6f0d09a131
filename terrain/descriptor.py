"""Scene and view -> Descriptor: facts that choices are made from. No decision is made here, and none per tile."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict
from scipy.ndimage import maximum_filter, minimum_filter

from terrain.camera import PerspectiveView
from terrain.clip_space import bend_px
from terrain.effects import EFFECTS
from terrain.effects.effect import Fact, Look
from terrain.effects.lamps import lamp_reaches
from terrain.elevation import Elevation
from terrain.grid import BLOCK_PX, MapView
from terrain.ground_mesh import ground_mesh
from terrain.level import CasterKind
from terrain.level_parts import Weather
from terrain.picture import Visible, buffer_of
from terrain.reach import overview_on_grid
from terrain.scene import Scene
from terrain.surface import step_at_anchor_m

LOOK_PX = 8
"""Distance of the pixels from which a perspective view is described."""

NEAREST_M = 1.0
"""What is nearer than this counts as this far away."""


class LampFacts(BaseModel):
    """A light besides the sun: half angle of its cone (180: an omni light), the distance that it is meant for, and whether any of
    its light can be seen in the view.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    kind: Literal["spot", "omni"]
    cutoff_deg: float
    reference_m: float
    reaches: bool = True


class Band(BaseModel):
    """What is seen at distances from ``near_m`` to ``far_m``, the next power of two: its share of all that is seen, and its bounds
    in light space, metres.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    near_m: float
    far_m: float
    share: float
    low_light_m: tuple[float, float, float]
    high_light_m: tuple[float, float, float]


class Descriptor(BaseModel):
    """What is known of a scene and a view; a function of (level, zoom, sun) for map views.

    ``pixel_m`` is a pixel's side on the ground (in perspective at the median distance of what is seen; ``pixel`` is its
    tangent), ``casters`` the kinds there are, ``relief_m`` the range of the ground's heights. ``receivers_light_m`` is the
    largest extent of a block's receivers in light space: right, up and along the light, metres; ``None`` without a sun.
    ``bands`` are what a perspective view shows under the sun, by distance. ``highest_sun_deg`` is the sun's largest altitude
    anywhere over the level. ``bend_px`` is how far a map lies off what a camera could see of it (``terrain.clip_space``).
    ``tallest_m`` is how far anything rises above its ground. ``facts`` are what effects go by besides, by effect.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    view: str
    view_kind: Literal["map", "perspective"]
    flat_world: bool
    pixel_m: float
    pixel: float | None = None
    node_m: float
    casters: tuple[CasterKind, ...]
    lamps: tuple[LampFacts, ...] = ()
    relief_m: float
    block_relief_m: float
    sun_azimuth_deg: float | None
    sun_altitude_deg: float | None
    highest_sun_deg: float | None
    receivers_light_m: tuple[float, float, float] | None
    bands: tuple[Band, ...] = ()
    bend_px: float = 0.0
    tallest_m: float = 0.0
    weather: Weather = Weather()
    facts: dict[str, dict[str, Fact]] = {}


def describe(scene: Scene, view: MapView | PerspectiveView, name: str = "map") -> Descriptor:
    """The descriptor of a view of a scene."""
    low, high = scene.height_range_m
    look = None if isinstance(view, MapView) else _look(scene, view)
    lamps = tuple(
        LampFacts(
            name=lamp.name, kind=lamp.kind, cutoff_deg=lamp.cutoff_deg, reference_m=lamp.reference_m,
            reaches=lamp_reaches(scene, lamp, view, look),
        )
        for lamp in scene.lamps.values()
    )  # fmt: skip
    return Descriptor(
        view=name, flat_world=scene.world.flat, casters=scene.population.kinds, lamps=lamps, relief_m=high - low,
        sun_azimuth_deg=scene.sun and scene.sun.azimuth_deg, sun_altitude_deg=scene.sun and scene.sun.altitude_deg,
        highest_sun_deg=scene.highest_sun_deg, tallest_m=scene.population.tallest_m, weather=scene.loaded.level.weather,
        facts={key: effect.facts(scene, view, look) for key, effect in EFFECTS.items() if effect.facts is not None},
        **(_map_facts(scene, view) if isinstance(view, MapView) else _perspective_facts(scene, view, look)),
    )  # fmt: skip


def _map_facts(scene: Scene, view: MapView) -> dict[str, Any]:
    node_m = step_at_anchor_m(scene.world, view.grid)
    pixel_m = node_m * float(np.sqrt(view.row_step * view.col_step))
    relief_m = _block_relief_m(scene.elevation, BLOCK_PX * pixel_m, scene.world.metres_per_unit) + scene.population.tallest_m
    return {
        "view_kind": "map", "pixel_m": pixel_m, "node_m": node_m, "block_relief_m": relief_m,
        "receivers_light_m": _receivers_light_m(scene, view, relief_m),
        "bend_px": bend_px(scene, view.grid, view.row_step, view.col_step),
    }  # fmt: skip


def _look(scene: Scene, view: PerspectiveView) -> Look:
    """Everything but the trees in every ``LOOK_PX``-th pixel; in every one, if those show the sky alone."""
    look = _look_every(scene, view, LOOK_PX)
    return look if len(look.points_frame_m) else _look_every(scene, view, 1)


def _look_every(scene: Scene, view: PerspectiveView, px: int) -> Look:
    coarse = replace(view, step=view.step * px, rows=-(-view.rows // px), cols=-(-view.cols // px))
    looked = buffer_of(scene, coarse, Visible(scene, coarse, view.frame(scene.world), kinds=("relief", "meshes")))
    points = looked.position_frame_m[looked.there]
    eye, _ = view.in_frame(looked.frame)
    away_m = np.linalg.norm(points - eye, axis=-1)
    return Look(looked, eye, points, away_m, looked.height_m[looked.there], coarse.pixel)


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
        "pixel": view.pixel, "bands": bands,
        "block_relief_m": float(np.ptp(look.height_m)) if len(points) else 0.0, "receivers_light_m": extent,
    }  # fmt: skip


def _bands(away_m: np.ndarray, light_m: np.ndarray, tallest_m: float, slack: float) -> tuple[Band, ...]:
    """Bands of points at distances (n,) with light-space coordinates (n, 3); ``slack`` is how far apart they lie, as a share of
    their distance, and what stands on the ground may rise by ``tallest_m``.
    """
    octave = np.ceil(np.log2(np.maximum(away_m, NEAREST_M)))
    bands = []
    for number in np.unique(octave):
        here = light_m[octave == number]
        margin = slack * 2.0**number + tallest_m * np.array([0.0, 1.0, 1.0])
        low, high = (tuple(float(v) for v in bound) for bound in (here.min(axis=0) - margin, here.max(axis=0) + margin))
        share = len(here) / len(light_m)
        bands.append(Band(near_m=2.0 ** (number - 1), far_m=2.0**number, share=share, low_light_m=low, high_light_m=high))
    return tuple(bands)


def joined(bands: tuple[Band, ...]) -> Band:
    """The band of neighbouring bands."""
    low = np.min([band.low_light_m for band in bands], axis=0)
    high = np.max([band.high_light_m for band in bands], axis=0)
    bounds = {"low_light_m": tuple(low.tolist()), "high_light_m": tuple(high.tolist())}
    return Band(near_m=bands[0].near_m, far_m=bands[-1].far_m, share=sum(band.share for band in bands), **bounds)


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
        for mid_row in mid_rows:
            for mid_col in mid_cols:
                rows, cols = np.meshgrid(mid_row + across * height, mid_col + across * width)
                point, up = scene.world.ground(view.grid.crs, view.grid.x(cols), view.grid.y(rows))
                points = scene.light.from_earth(point + middle * up).reshape(-1, 3)
                points = points[np.isfinite(points).all(axis=1)]
                if len(points):
                    widest = np.maximum(widest, np.ptp(points, axis=0))
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
