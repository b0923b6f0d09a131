"""Accuracy against time: every capable algorithm over a grid of settings, on one geometry, held against truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import numpy as np

from selector.rules import choose
from shadows import truth as truth_module
from shadows.attached import attached, lamp_in_frame
from shadows.metrics import BLOCK_PX as COVERAGE_PX
from shadows.metrics import block_shares, coverage_error, errors_of
from shadows.passes import PassLog
from shadows.perspective_shadow_map import perspective_map
from shadows.plan import LampMapSettings, PerspectiveMapSettings, Plan, ShadowMapSettings, Step
from shadows.registry import ALGORITHMS
from shadows.render import FILLS, bands_of, forget_kept
from shadows.truth import Truth
from shadows.truth_cache import cached_truth
from terrain.camera import PerspectiveView
from terrain.casting import caster_trees
from terrain.descriptor import Descriptor, describe
from terrain.errors import InputError, UnsupportedError
from terrain.geometry import GeometryBuffer
from terrain.grid import MapView, blocks_of
from terrain.level import SUN, AlgorithmName, Level
from terrain.picture import geometry_of
from terrain.reach import Casters, casters_of
from terrain.scene import Scene

View = MapView | PerspectiveView

MAP_SIZES = (512, 1024, 2048, 4096)
PERSPECTIVE_SIZES = MAP_SIZES[:3]
FILTERS = (1, 3)
DEPTHS = (16, 24)
VARIANTS: dict[AlgorithmName, list[dict[str, Any]]] = {
    "shadow_map": [
        {"map_size": size, "filter": taps, "depth_bits": bits}
        for size, taps in product(MAP_SIZES, FILTERS)
        for bits in (DEPTHS if (size, taps) == (MAP_SIZES[-1], FILTERS[0]) else DEPTHS[:1])
    ],
    "perspective_shadow_map": [{"map_size": size, "filter": taps} for size, taps in product(PERSPECTIVE_SIZES, FILTERS)],
    "hybrid": [{"mask": "conservative"}, {"mask": "original"}],
}
"""Settings that an algorithm is compared with; one that is not listed has its own alone."""

COUNTERS = ("triangles", "draws", "map_texels", "edges", "marked", "tiles")
REPEATS, ENOUGH_S = 5, 5.0
"""A row is measured so often, but not again once that has taken so many seconds."""

FINE_SAMPLES = 16
SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Ground:
    """One block's part of a view: its geometry, its casters, its truth, and where it lies in the view."""

    buffer: GeometryBuffer
    light: str
    casters: Casters
    truth: Truth
    true_shares: np.ndarray
    row: int
    col: int


@dataclass(frozen=True, eq=False)
class Row:
    """One candidate: the plan, its figures as ``compare --json`` prints them, and where it was wrong."""

    figures: dict[str, Any]
    false_shadow: np.ndarray
    missed_shadow: np.ndarray


@dataclass(frozen=True, eq=False)
class Comparison:
    """All rows of a view, and what holds for all of them.

    ``surface`` is the share of pixels that the drawn grid's simplification changes, ``noise_floor`` the share of decidable
    pixels that truth's own sub-samples get wrong, ``remarks`` what a reader must know (no surface, night, nothing casts).
    """

    view: View
    rows: list[Row]
    boundary: float
    surface: float
    noise_floor: float
    remarks: list[str]


def candidates(scene: Scene, view: View, name: str = "map") -> Iterator[Plan]:
    """The plans to compare: every capable algorithm but truth itself, with its settings, for all lights alike."""
    descriptor, level = describe(scene, view, name), scene.loaded.level
    for algorithm in ALGORITHMS:
        if algorithm == "truth":
            continue
        for settings in VARIANTS.get(algorithm, [{}]):
            yield from _as_far_as_it_serves(descriptor, level, algorithm, settings)


def _as_far_as_it_serves(descriptor: Descriptor, level: Level, name: AlgorithmName, settings: dict[str, Any]) -> Iterator[Plan]:
    """The plan of an algorithm for everything; where it cannot serve that, for the sun's relief and meshes, or relief alone,
    beside shadow maps.
    """
    for asked in (name, {"relief": name, "meshes": name}, {"relief": name}):
        with suppress(UnsupportedError):  # to whoever asks for it by name it says why
            plan = choose(descriptor, level, {"algorithm": asked, **settings})
            if name in (used for per_kind in plan.algorithm.values() for used in per_kind.values()):
                yield plan
                return


def compare(
    scene: Scene,
    view: View,
    name: str = "map",
    fine: bool = False,
    on_step: Callable[[int, int], None] | None = None,
    light: str | None = None,
) -> Comparison:
    """Measure every candidate on one geometry; ``on_step(done, total)`` is called as the work goes on.

    ``light`` is the light that is looked at: the first one (the sun, where there is one) if it is ``None``.
    """
    plans = list(candidates(scene, view, name))
    total = len(plans) + 2
    step = on_step or (lambda done, of: None)
    grounds = _grounds(scene, view, light, fine)
    step(1, total)
    first = grounds[0]
    real = _whole_truth(view, grounds)
    floor = _noise_floor(scene, grounds, real, view)
    surface = truth_module.surface_error(first.buffer, scene, first.casters)
    step(2, total)
    pixel_m = describe(scene, view, name).pixel_m
    rows = []
    if real.there.any():  # compiles, allocates, fills caches: what no row is to pay for
        for largest in {plan.headline: plan for plan in sorted(plans, key=_map_size)}.values():
            _measure(scene, view, grounds, real, largest, pixel_m, repeats=1)
    for done, plan in enumerate(plans, start=3):
        rows.append(_measure(scene, view, grounds, real, plan, pixel_m))
        step(done, total)
    _mark_pareto(rows)
    return Comparison(view, rows, real.boundary, surface, floor, _remarks(scene, real, rows))


def measure(scene: Scene, view: View, plan: Plan, light: str | None = None, fine: bool = False, repeats: int = 1) -> Row:
    """Measure one plan; ``light`` as in ``compare``."""
    grounds = _grounds(scene, view, light, fine)
    pixel_m = describe(scene, view, plan.view).pixel_m
    return _measure(scene, view, grounds, _whole_truth(view, grounds), plan, pixel_m, repeats)


def false_colours(base: np.ndarray, row: Row) -> np.ndarray:
    """An error picture (rows, cols, 3) uint8 over a gray one (rows, cols): false shadow red, missed shadow blue."""
    out = np.repeat((120 + base.astype(float) * 0.5)[..., None], 3, axis=2)
    out[row.false_shadow] = (214, 30, 30)
    out[row.missed_shadow] = (30, 70, 214)
    return np.clip(out, 0, 255).astype(np.uint8)


def _grounds(scene: Scene, view: View, light: str | None, fine: bool) -> list[Ground]:
    if light is not None and light not in scene.light_names:
        raise InputError("light", light, ", ".join(scene.light_names) or "nothing: the level has no lights")
    light = light or (*scene.light_names, SUN)[0]
    parts = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    return [_ground(scene, light, block, row, col, fine) for block, row, col in parts]


def _ground(scene: Scene, light: str, block: View, row: int, col: int, fine: bool) -> Ground:
    buffer = geometry_of(scene, block)
    casters = casters_of(scene, buffer)
    real = cached_truth(buffer, scene, casters, FINE_SAMPLES if fine else SAMPLES, light)
    shares = truth_module.coverage_truth(buffer, scene, casters, COVERAGE_PX, light=light)
    return Ground(buffer, light, casters, real, shares, row, col)


def _paste(view: View, grounds: list[Ground], parts: list[np.ndarray], empty: Any) -> np.ndarray:
    """One array of the view from one of each block."""
    whole = np.full((view.rows, view.cols), empty, dtype=np.asarray(parts[0]).dtype)
    for ground, part in zip(grounds, parts, strict=True):
        rows, cols = part.shape
        top, left = max(ground.row, 0), max(ground.col, 0)
        bottom, right = min(ground.row + rows, view.rows), min(ground.col + cols, view.cols)
        whole[top:bottom, left:right] = part[top - ground.row : bottom - ground.row, left - ground.col : right - ground.col]
    return whole


def _whole_truth(view: View, grounds: list[Ground]) -> Truth:
    fields = ("lit", "attached", "decidable", "there")
    return Truth(*(_paste(view, grounds, [getattr(g.truth, field) for g in grounds], False) for field in fields))


def _noise_floor(scene: Scene, grounds: list[Ground], real: Truth, view: View) -> float:
    """Wrong share of truth's own sub-samples of another seed (their majority) against truth."""
    light = grounds[0].light
    if (light == SUN and not scene.sun_is_up) or not real.there.any():
        return 0.0
    votes = []
    for ground in grounds:
        rays = truth_module.ray_scene(ground.buffer, scene, ground.casters, truth_module.ALL_KINDS)
        count = np.zeros(ground.buffer.there.shape, np.float32)
        for its_view in truth_module.sub_views(ground.buffer.view, SAMPLES, seed=1):
            sample = geometry_of(scene, its_view, ground.buffer.frame)
            count += truth_module.lit_from(sample, scene, light, rays)
        votes.append(count / SAMPLES)
    return errors_of(_paste(view, grounds, votes, np.nan), real, 1.0).wrong


def _map_size(plan: Plan) -> int:
    sizes = [getattr(settings, "map_size", 0) for per_kind in plan.settings.values() for settings in per_kind.values()]
    return max(sizes, default=0)


def _measure(
    scene: Scene, view: View, grounds: list[Ground], real: Truth, plan: Plan, pixel_m: float, repeats: int = REPEATS
) -> Row:
    steps = [step for step in plan.steps if step.light == grounds[0].light and step.algorithm in FILLS]
    times_ms, parts = [], []
    log = PassLog()
    while not times_ms or (len(times_ms) < repeats and sum(times_ms) < 1000.0 * ENOUGH_S and steps and real.there.any()):
        forget_kept()  # every cost that a moving sun has is to be paid
        log, start = PassLog(), time.perf_counter()
        parts = [_visibility(scene, ground, steps, log) for ground in grounds]
        times_ms.append((time.perf_counter() - start) * 1000.0 if steps else 0.0)
    footprints = []
    for ground, part in zip(grounds, parts, strict=True):
        part[attached(ground.buffer, scene, ground.light)] = 0.0
        part[~ground.buffer.there] = np.nan
        texels = [texel_footprint_px(scene, step, ground.buffer, pixel_m) for step in steps or [None]]
        footprints.append(np.max(texels, axis=0))
    visibility = _paste(view, grounds, parts, np.nan)
    found = errors_of(visibility, real, pixel_m, _paste(view, grounds, footprints, 0.0))
    shares = [coverage_error(block_shares(1.0 - part), ground.true_shares) for ground, part in zip(grounds, parts, strict=True)]
    dark, true_dark = np.nan_to_num(visibility, nan=1.0) < 0.5, ~real.lit
    figures = {
        "algorithm": plan.model_dump(mode="json")["algorithm"],
        "settings": plan.model_dump(mode="json")["settings"],
        **asdict(found),
        "coverage": float(np.mean(shares)),
        "ms_median": float(np.median(times_ms)),
        "ms_p95": float(np.quantile(times_ms, 0.95)),
        "runs": len(times_ms),
        "bytes": max((record.bytes for record in log.records.values()), default=0),
        "counters": {name: sum(getattr(record, name) for record in log.records.values()) for name in COUNTERS},
        "notes": [record.note for record in log.records.values() if record.note],
        "pareto": False,
    }
    return Row(figures, real.decidable & dark & ~true_dark, real.decidable & ~dark & true_dark)


def _visibility(scene: Scene, ground: Ground, steps: list[Step], log: PassLog) -> np.ndarray:
    visibility = np.ones(ground.buffer.there.shape, np.float32)
    for step in steps:
        visibility *= FILLS[step.algorithm](ground.buffer, scene, step.light, step.kinds, ground.casters, step.settings, log)
    return visibility


def texel_footprint_px(scene: Scene, step: Step | None, buffer: GeometryBuffer, pixel_m: float) -> np.ndarray:
    """A texel's larger side on level ground in pixels (rows, cols); 0 for an algorithm without texels, and off the surface."""
    settings = None if step is None else step.settings
    texel_m: float | np.ndarray = 0.0
    size_m: float | np.ndarray = pixel_m
    away_m: float | np.ndarray = 0.0
    if isinstance(buffer.view, PerspectiveView):
        eye, camera_from_frame = buffer.view.in_frame(buffer.frame)
        away_m = np.linalg.norm(buffer.position_frame_m - eye, axis=-1)
        size_m = (buffer.position_frame_m - eye) @ camera_from_frame[2] * buffer.view.pixel
    if isinstance(settings, ShadowMapSettings) and scene.sun is not None:
        sine = np.sin(np.radians(max(scene.sun.altitude_deg, 0.5)))
        sides = [max(cascade.texel_m[0], cascade.texel_m[1] / sine) for cascade in settings.cascades]
        texel_m = np.array(sides)[np.searchsorted([cascade.far_m for cascade in settings.cascades[:-1]], away_m)]
    elif isinstance(settings, LampMapSettings) and step is not None:
        lamp = scene.lamps[step.light]
        position, _ = lamp_in_frame(buffer, lamp)
        way = position - buffer.position_frame_m
        length_m = np.linalg.norm(way, axis=-1)
        tangent = 1.0 if lamp.kind == "omni" else np.tan(np.radians(lamp.cutoff_deg))
        texel_m = 2.0 * tangent * length_m / settings.map_size * length_m / np.maximum(np.abs(way[..., 2]), 0.01 * length_m)
    elif isinstance(settings, PerspectiveMapSettings) and step is not None:
        receivers = buffer.there & ~attached(buffer, scene, step.light)
        if receivers.any():
            drawn, _ = perspective_map(buffer, receivers, scene, step.light, settings, caster_trees(buffer, step.kinds))
            texel_m = texel_on_level_ground_m(np.reshape(drawn.uniforms["map_rows"], (4, 4)), buffer.position_frame_m)
    return np.broadcast_to(np.nan_to_num(texel_m / size_m), buffer.there.shape)


def texel_on_level_ground_m(map_from_frame: np.ndarray, position_frame_m: np.ndarray) -> np.ndarray:
    """A texel's larger side on level ground at points (..., 3), metres, where a projective map (4, 4) takes a frame to texels.

    A metre is as many texels as the least singular value of the map's derivative says, in the direction where texels are largest
    (J. Blinn, Consider the Lowly 2 x 2 Matrix, 1996).
    """
    x, y, _, w = np.moveaxis(position_frame_m @ map_from_frame[:, :3].T + map_from_frame[:, 3], -1, 0)
    (ux, uy), (vx, vy), _, (wx, wy) = map_from_frame[:, :2]
    a, b, c, d = ((k - at / w * along) / w for k, at, along in ((ux, x, wx), (uy, x, wy), (vx, y, wx), (vy, y, wy)))
    least = np.abs(np.hypot(a + d, b - c) - np.hypot(a - d, b + c)) / 2.0
    return 1.0 / np.maximum(least, 1e-30)


def _mark_pareto(rows: list[Row]) -> None:
    """A row is on the front if no other is at least as good in both time and ``wrong_cast`` and better in one."""
    keys = [(row.figures["ms_median"], row.figures["wrong_cast"]) for row in rows]
    for row, key in zip(rows, keys, strict=True):
        beaten = any(other != key and other[0] <= key[0] and other[1] <= key[1] for other in keys)
        row.figures["pareto"] = not beaten


def _remarks(scene: Scene, real: Truth, rows: list[Row]) -> list[str]:
    remarks = []
    if not real.there.any():
        remarks.append("the view shows no surface: there is nothing to compare")
    elif not scene.light_names:
        remarks.append("the level has no light: everything is dark, whatever the algorithm")
    elif scene.light_names == (SUN,) and not scene.sun_is_up:
        remarks.append("the sun is down: everything is in shadow, whatever the algorithm")
    elif not (real.there & ~real.attached & ~real.lit).any():
        remarks.append("nothing lies in cast shadow: only false shadow can be measured")
    elif not real.lit.any():
        remarks.append("nothing is lit: only missed shadow can be measured")
    if real.there.any() and real.boundary > 0.5:
        remarks.append("over half of the surface is not decidable: coverage is the error that counts")
    if not rows:
        remarks.append("no algorithm but none serves this view")
    return remarks
