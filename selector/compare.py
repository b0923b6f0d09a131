"""Accuracy against time: every capable algorithm over a grid of settings, on one geometry, held against truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from selector.rules import choose
from shadows import truth as truth_module
from shadows.attached import attached
from shadows.metrics import BLOCK_PX as COVERAGE_PX
from shadows.metrics import block_shares, coverage_error, errors_of
from shadows.passes import PassLog
from shadows.plan import Plan, ShadowMapSettings
from shadows.registry import ALGORITHMS
from shadows.render import FILLS
from shadows.truth import Truth
from shadows.truth_cache import cached_truth
from terrain.descriptor import describe
from terrain.geometry import GeometryBuffer, map_geometry
from terrain.grid import MapView, blocks_of
from terrain.reach import Casters, casters_of
from terrain.scene import Scene

MAP_SIZES = (512, 1024, 2048, 4096)
FILTERS = (1, 3)
DEPTHS = (16, 24)
REPEATS = 5
FINE_SAMPLES = 16
SAMPLES = 4


@dataclass(frozen=True, eq=False)
class Ground:
    """One block's part of a view: its geometry, its casters, its truth, and where it lies in the view."""

    buffer: GeometryBuffer
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

    view: MapView
    rows: list[Row]
    boundary: float
    surface: float
    noise_floor: float
    remarks: list[str]


def candidates(scene: Scene, view: MapView, name: str = "map") -> Iterator[Plan]:
    """The plans to compare: every capable algorithm but truth itself, its settings crossed."""
    descriptor, level = describe(scene, view, name), scene.loaded.level
    for algorithm in ALGORITHMS.values():
        if algorithm.name == "truth" or descriptor.view_kind not in algorithm.views:
            continue
        if algorithm.name != "shadow_map":
            yield choose(descriptor, level, {"algorithm": algorithm.name})
            continue
        for size in MAP_SIZES:
            for taps in FILTERS:
                for bits in DEPTHS if (size, taps) == (MAP_SIZES[-1], FILTERS[0]) else DEPTHS[:1]:
                    asked = {"algorithm": algorithm.name, "map_size": size, "filter": taps, "depth_bits": bits}
                    plan = choose(descriptor, level, asked)
                    if plan.headline == algorithm.name:
                        yield plan


def compare(
    scene: Scene, view: MapView, name: str = "map", fine: bool = False, on_step: Callable[[int, int], None] | None = None
) -> Comparison:
    """Measure every candidate on one geometry; ``on_step(done, total)`` is called as the work goes on."""
    plans = list(candidates(scene, view, name))
    total = len(plans) + 2
    step = on_step or (lambda done, of: None)
    grounds = [_ground(scene, block, row, col, fine) for block, row, col in blocks_of(view)]
    step(1, total)
    first = grounds[0]
    real = _whole_truth(view, grounds)
    floor = _noise_floor(scene, grounds, real, view)
    surface = truth_module.surface_error(first.buffer, scene, first.casters)
    step(2, total)
    pixel_m = describe(scene, view, name).pixel_m
    rows = []
    largest = max(plans, key=_map_size, default=None)
    if largest is not None and real.there.any():  # compiles, allocates, fills caches: what no row is to pay for
        _measure(scene, view, grounds, real, largest, pixel_m, repeats=1)
    for done, plan in enumerate(plans, start=3):
        rows.append(_measure(scene, view, grounds, real, plan, pixel_m))
        step(done, total)
    _mark_pareto(rows)
    return Comparison(view, rows, real.boundary, surface, floor, _remarks(scene, real, rows))


def false_colours(base: np.ndarray, row: Row) -> np.ndarray:
    """An error picture (rows, cols, 3) uint8 over a gray one (rows, cols): false shadow red, missed shadow blue."""
    out = np.repeat((120 + base.astype(float) * 0.5)[..., None], 3, axis=2)
    out[row.false_shadow] = (214, 30, 30)
    out[row.missed_shadow] = (30, 70, 214)
    return np.clip(out, 0, 255).astype(np.uint8)


def _ground(scene: Scene, block: MapView, row: int, col: int, fine: bool) -> Ground:
    frame = scene.world.frame_near(block.grid.crs, *block.centre)
    buffer = map_geometry(scene.surface(block.grid), block, frame)
    casters = casters_of(scene, buffer)
    real = cached_truth(buffer, scene, casters, FINE_SAMPLES if fine else SAMPLES)
    shares = truth_module.coverage_truth(buffer, scene, casters, COVERAGE_PX)
    return Ground(buffer, casters, real, shares, row, col)


def _paste(view: MapView, grounds: list[Ground], parts: list[np.ndarray], empty: Any) -> np.ndarray:
    """One array of the view from one of each block."""
    whole = np.full((view.rows, view.cols), empty, dtype=np.asarray(parts[0]).dtype)
    for ground, part in zip(grounds, parts, strict=True):
        rows, cols = part.shape
        top, left = max(ground.row, 0), max(ground.col, 0)
        bottom, right = min(ground.row + rows, view.rows), min(ground.col + cols, view.cols)
        whole[top:bottom, left:right] = part[top - ground.row : bottom - ground.row, left - ground.col : right - ground.col]
    return whole


def _whole_truth(view: MapView, grounds: list[Ground]) -> Truth:
    fields = ("lit", "attached", "decidable", "there")
    return Truth(*(_paste(view, grounds, [getattr(g.truth, field) for g in grounds], False) for field in fields))


def _noise_floor(scene: Scene, grounds: list[Ground], real: Truth, view: MapView) -> float:
    """Wrong share of truth's own sub-samples of another seed (their majority) against truth."""
    if scene.sun is None or (scene.highest_sun_deg or 0.0) <= 0.0 or not real.there.any():
        return 0.0
    votes = []
    for ground in grounds:
        rays = truth_module.ray_scene(ground.buffer, scene, ground.casters)
        to_sun = ground.buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
        count = np.zeros(ground.buffer.there.shape, np.float32)
        for its_view in truth_module.sub_views(ground.buffer.view, SAMPLES, seed=1):
            sample = map_geometry(scene.surface(its_view.grid), its_view, ground.buffer.frame)
            count += truth_module.lit_from(sample, rays, to_sun)
        votes.append(count / SAMPLES)
    return errors_of(_paste(view, grounds, votes, np.nan), real, 1.0).wrong


def _map_size(plan: Plan) -> int:
    settings = plan.settings.get("sun", {}).get("relief")
    return settings.map_size if isinstance(settings, ShadowMapSettings) else 0


def _measure(
    scene: Scene, view: MapView, grounds: list[Ground], real: Truth, plan: Plan, pixel_m: float, repeats: int = REPEATS
) -> Row:
    name = plan.algorithm["sun"]["relief"]
    settings = plan.settings.get("sun", {}).get("relief")
    times_ms, parts = [], []
    log = PassLog()
    for _ in range(repeats if real.there.any() else 1):
        log, start = PassLog(), time.perf_counter()
        parts = [_visibility(scene, ground, name, settings, log) for ground in grounds]
        times_ms.append((time.perf_counter() - start) * 1000.0)
        if name not in FILLS:
            times_ms = [0.0]
            break
    for ground, part in zip(grounds, parts, strict=True):
        part[attached(ground.buffer, scene)] = 0.0
        part[~ground.buffer.there] = np.nan
    visibility = _paste(view, grounds, parts, np.nan)
    found = errors_of(visibility, real, pixel_m, texel_footprint_px(scene, settings, pixel_m))
    shares = [coverage_error(block_shares(1.0 - part), ground.true_shares) for ground, part in zip(grounds, parts, strict=True)]
    dark, true_dark = np.nan_to_num(visibility, nan=1.0) < 0.5, ~real.lit
    figures = {
        "algorithm": plan.model_dump(mode="json")["algorithm"],
        "settings": plan.model_dump(mode="json")["settings"],
        **asdict(found),
        "coverage": float(np.mean(shares)),
        "ms_median": float(np.median(times_ms)),
        "ms_p95": float(np.quantile(times_ms, 0.95)),
        "bytes": max((record.bytes for record in log.records.values()), default=0),
        "counters": {
            "triangles": sum(record.triangles for record in log.records.values()),
            "draws": sum(record.draws for record in log.records.values()),
            "map_texels": sum(record.map_texels for record in log.records.values()),
        },
        "pareto": False,
    }
    return Row(figures, real.decidable & dark & ~true_dark, real.decidable & ~dark & true_dark)


def _visibility(scene: Scene, ground: Ground, name: str, settings: Any, log: PassLog) -> np.ndarray:
    if name not in FILLS:
        return np.ones(ground.buffer.there.shape, np.float32)
    return FILLS[name](ground.buffer, scene, ground.casters, settings, log)


def texel_footprint_px(scene: Scene, settings: Any, pixel_m: float) -> float:
    """A texel's larger side on level ground, in pixels."""
    if not isinstance(settings, ShadowMapSettings) or scene.sun is None:
        return 0.0
    sine = np.sin(np.radians(max(scene.sun.altitude_deg, 0.5)))
    return float(max(settings.texel_m[0], settings.texel_m[1] / sine) / pixel_m)


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
    elif scene.sun is None or (scene.highest_sun_deg or 0.0) <= 0.0:
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
