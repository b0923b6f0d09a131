"""The accuracy report: compare the errors and times of candidate plans on one view with ray-traced ground truth.

A candidate is a plan with one algorithm, or one combination of algorithms, and its settings. All are drawn on the same geometry.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from skugga.selector.candidates import candidates, name_of
from skugga.selector.measure.view_truth import TRUTH_SAMPLES_PER_PIXEL, ErrorName, View, ViewTruth, truth_of_view
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.render import bands_of
from skugga.shadows.truth import truth as truth_module
from skugga.shadows.truth.metrics import error_metrics
from skugga.shadows.visibility import fill_steps, with_apparent_sun
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.errors import InputError
from skugga.terrain.gbuffer.antialias import MultisampledBuffer, picture_buffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView, blocks_of
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene

COUNTERS = ("triangles", "draws", "map_texels", "edges", "marked", "tiles")
"""Counters of the render passes that a comparison reports, summed over the passes."""

TIMING_REPEATS = 5
"""Number of timed repeats of each candidate, if the time limit allows."""

TIME_LIMIT_S, DRAWING_TIME_SHARE = 70.0, 0.85
"""Time limit of a comparison in seconds, and the share of it after which no further candidates are drawn."""

FINE_TRUTH_SAMPLES_PER_PIXEL = 16
"""Number of sub-samples of a pixel for fine truth, a square number."""

NO_CAST_SHADOW_REMARK = "no cast shadow in the view: only false shadow can be measured"
"""Remark on a view without cast shadow."""


@dataclass(frozen=True, eq=False)
class ComparisonRow:
    """The result of a comparison for one candidate plan.

    Attributes
    ----------
    figures
        Errors, times and settings by name, as ``compare --json`` prints them.
    visibility
        Visibility of the light, uint8 (rows, cols): from 0 (dark) to 255 (lit); 255 in pixels without a surface.
    false_shadow
        Pixels that are dark, but lit in truth, bool (rows, cols).
    missed_shadow
        Pixels that are lit, but dark in truth, bool (rows, cols).
    """

    figures: dict[str, Any]
    visibility: np.ndarray
    false_shadow: np.ndarray
    missed_shadow: np.ndarray


@dataclass(frozen=True, eq=False)
class Comparison:
    """The comparison of a view's candidates.

    Attributes
    ----------
    view
        The view.
    light
        Name of the light.
    rows
        One row for each candidate.
    valid
        Valid mask of the surface, bool (rows, cols).
    error_metric
        Name of the error that is compared with the requested limit in this view.
    undecided_share
        Share of the surface, in [0, 1], for which truth is undecided, since samples within a pixel disagree.
    cast_share
        Share of the surface in true cast shadow, in [0, 1].
    simplification_share
        Share of the pixels that change because the ground is drawn with fewer nodes than its data have, in [0, 1].
    noise_floor
        Error of a second truth with other sub-samples, in [0, 1]. Smaller errors are not significant.
    remarks
        Remarks for the reader, for example that it is night.
    left_out
        Names of the candidates that were not drawn, because of the time limit.
    default_row_name
        Name of the default plan's row; empty if it is not among the rows.
    """

    view: View
    light: str
    rows: list[ComparisonRow]
    valid: np.ndarray
    error_metric: ErrorName
    undecided_share: float
    cast_share: float
    simplification_share: float
    noise_floor: float
    remarks: list[str]
    left_out: tuple[str, ...] = ()
    default_row_name: str = ""


Times = tuple[float, dict[str, float]]
"""Milliseconds of one execution of a plan: the total, and by render pass."""

DrawnBlock = tuple[MultisampledBuffer, Casters]
"""The geometry of a view's block, and the casters that reach it."""


@dataclass(frozen=True, eq=False)
class TimedRun:
    """The result of one execution of a plan's steps.

    Attributes
    ----------
    times
        Times of the execution, milliseconds.
    parts
        Visibilities in [0, 1], one array (rows, cols) for each block of the view.
    log
        Log of the render passes.
    """

    times: Times
    parts: list[np.ndarray]
    log: PassLog


@dataclass(frozen=True, eq=False)
class TimedPlan:
    """A plan with the measurements of its executions so far.

    Attributes
    ----------
    plan
        The plan.
    row
        Its result, still without final times.
    first_times
        Times of the first execution.
    repeat_times
        Times of all other executions.
    rest_ms
        Milliseconds of executions in which nothing had moved since the one before, so that maps and volumes were cached.
    """

    plan: Plan
    row: ComparisonRow
    first_times: Times
    repeat_times: list[Times] = field(default_factory=list)
    rest_ms: list[float] = field(default_factory=list)


def compare(
    scene: Scene,
    view: View,
    name: str = "map",
    fine: bool = False,
    on_step: Callable[[int, int], None] | None = None,
    light: str | None = None,
    time_limit_s: float = TIME_LIMIT_S,
    plans: Sequence[Plan] | None = None,
    only: Collection[str] = (),
) -> Comparison:
    """Measure the errors and times of all candidate plans of a view on one geometry.

    Each candidate is drawn once for its errors. Then all candidates are timed in turns, fastest first, so that other load on the
    machine affects them alike. In perspective views in which nothing moves, each is timed a second time in its turn, with the maps
    and volumes that the first time left in caches. Repeats that would end after the time limit are left out. After a share of
    ``DRAWING_TIME_SHARE`` of the limit, further variants of algorithms that were drawn already are left out, too. Each algorithm is
    drawn at least once. Candidates from ``plans`` and ``only`` are always drawn.

    Parameters
    ----------
    scene
        The scene.
    view
        The view.
    name
        Name of the view.
    fine
        Whether truth uses 16 sub-samples of a pixel instead of 4.
    on_step
        Called as ``on_step(done, total)`` to report progress.
    light
        Name of the light. ``None``: the sun, or the first light of a level without a sun.
    time_limit_s
        Time limit, seconds.
    plans
        Plans to measure instead of ``candidates``.
    only
        Names of the candidates to measure; empty: all.

    Raises
    ------
    InputError
        A name or a light is unknown.
    """
    start = time.perf_counter()
    light = _check_light(scene, light)
    is_explicit, default = plans is not None or bool(only), ""
    if plans is None:
        plans = candidates(scene, view, name, light)
        default = name_of(plans[0], light) if plans else ""
        plans = _select_plans(plans, light, only)
    total = len(plans) + TIMING_REPEATS + 2
    step = on_step or (lambda done, total_steps: None)
    effects = frozenset().union(*(plan.effect_names for plan in plans))
    scene = with_apparent_sun(scene, effects)
    view_truth = truth_of_view(scene, view, light, FINE_TRUTH_SAMPLES_PER_PIXEL if fine else TRUTH_SAMPLES_PER_PIXEL, effects)
    pictures = picture_blocks(scene, view)
    step(1, total)
    first = view_truth.blocks[0]
    floor = _noise_floor(scene, view_truth)
    simplification_share = truth_module.simplification_error(first.buffer, scene, first.casters)
    step(2, total)
    descriptor = describe(scene, view, name, "points")
    pixel_m, rests = descriptor.pixel_m, descriptor.view_kind == "perspective" and not descriptor.moves
    trials: list[TimedPlan] = []
    left_out: list[str] = []
    draw_times_s: dict[str, float] = {}
    for done, plan in enumerate(plans, start=3):
        began_s, names = time.perf_counter() - start, set(plan.algorithm.get(light, {}).values())
        ends_s = began_s + max((draw_times_s.get(algorithm, 0.0) for algorithm in names), default=0.0)
        if not is_explicit and names <= draw_times_s.keys() and ends_s > DRAWING_TIME_SHARE * time_limit_s:
            left_out.append(name_of(plan, light))
        else:
            trials.append(_first_run(scene, view_truth, pictures, plan, pixel_m))
            trial_s = time.perf_counter() - start - began_s
            draw_times_s |= {algorithm: min(trial_s, draw_times_s.get(algorithm, trial_s)) for algorithm in names}
        step(done, total)
    for repeat in range(TIMING_REPEATS):
        for trial in sorted(trials, key=lambda trial: trial.first_times[0]) if view_truth.full_truth.valid.any() else []:
            if time.perf_counter() - start + trial.first_times[0] / 1000.0 < time_limit_s:
                trial.repeat_times.append(run_light(scene, pictures, trial.plan, light).times)
                if rests and time.perf_counter() - start + trial.first_times[0] / 1000.0 < time_limit_s:
                    trial.rest_ms.append(run_light_at_rest(scene, pictures, trial.plan, light).times[0])
        step(len(plans) + 3 + repeat, total)
    rows = [_with_times(trial) for trial in trials]
    _mark_pareto(rows, view_truth.error_name)
    remarks = _remarks(scene, view_truth, rows)
    return Comparison(
        view, light, rows, view_truth.full_truth.valid, view_truth.error_name, view_truth.full_truth.undecidable_share,
        view_truth.full_truth.cast_share, simplification_share, floor, remarks, tuple(left_out), default,
    )  # fmt: skip


def measure_plan(
    scene: Scene, view: View, plan: Plan, light: str | None = None, fine: bool = False, repeats: int = 0
) -> ComparisonRow:
    """Measure the errors and the time of one plan. ``light`` and ``fine`` are those of ``compare``.

    The time is the median of ``repeats`` executions after the first one. Without repeats it is that of the first one, which
    includes compilation.
    """
    scene, light = with_apparent_sun(scene, plan.effect_names), _check_light(scene, light)
    view_truth = truth_of_view(
        scene, view, light, FINE_TRUTH_SAMPLES_PER_PIXEL if fine else TRUTH_SAMPLES_PER_PIXEL, plan.effect_names
    )
    pictures = picture_blocks(scene, view)
    trial = _first_run(scene, view_truth, pictures, plan, describe(scene, view, plan.view, "points").pixel_m)
    trial.repeat_times.extend(run_light(scene, pictures, plan, light).times for _ in range(repeats))
    return _with_times(trial)


def false_colours(base: np.ndarray, row: ComparisonRow) -> np.ndarray:
    """Return a picture of errors, uint8 (rows, cols, 3): false shadow is red, and missed shadow is blue.

    ``base`` (rows, cols) is a gray picture of the view, which is shown paler in all other pixels.
    """
    out = np.repeat((120 + base.astype(float) * 0.5)[..., None], 3, axis=2)
    out[row.false_shadow] = (214, 30, 30)
    out[row.missed_shadow] = (30, 70, 214)
    return np.clip(out, 0, 255).astype(np.uint8)


def _check_light(scene: Scene, light: str | None) -> str:
    """Return the name of the light to compare: ``light``, or by default the sun or the first light of a level without a sun.

    Raises ``InputError`` for an unknown light.
    """
    if light is not None and light not in scene.light_names:
        raise InputError("light", light, ", ".join(scene.light_names) or "none (the level has no lights)")
    return light or (*scene.light_names, SUN)[0]


def _select_plans(plans: list[Plan], light: str, names: Collection[str]) -> list[Plan]:
    """Return the plans with the given names; all plans if ``names`` is empty. Raises ``InputError`` for an unknown name."""
    by_name = {name_of(plan, light): plan for plan in plans}
    for name in names:
        if name not in by_name:
            raise InputError("only", name, ", ".join(by_name))
    return [plan for name, plan in by_name.items() if not names or name in names]


def _noise_floor(scene: Scene, view_truth: ViewTruth) -> float:
    """Return the error of a second truth, with sub-samples of another seed, against the view's truth.

    Errors of algorithms below this value are not significant.
    """
    light = view_truth.blocks[0].light
    if (light == SUN and not scene.sun_is_up) or not view_truth.full_truth.valid.any():
        return 0.0
    votes = []
    for ground in view_truth.blocks:
        rays = truth_module.ray_scene(ground.buffer, scene, ground.casters, truth_module.ALL_CASTER_KINDS)
        count = np.zeros(ground.buffer.valid.shape, np.float32)
        for sub_view in truth_module.jittered_views(ground.buffer.view, TRUTH_SAMPLES_PER_PIXEL, seed=1):
            sample = geometry_buffer(scene, sub_view, ground.buffer.frame)
            count += truth_module.lit_mask(sample, scene, light, rays)
        votes.append(np.where(ground.buffer.valid, count / TRUTH_SAMPLES_PER_PIXEL, np.nan))
    if view_truth.error_name == "coverage":
        return view_truth.coverage(votes)
    return error_metrics(view_truth.assemble(votes, np.nan), view_truth.full_truth, 1.0).wrong_cast


def _first_run(scene: Scene, view_truth: ViewTruth, pictures: Sequence[DrawnBlock], plan: Plan, pixel_m: float) -> TimedPlan:
    """Execute a plan for the first time, and return it with its errors, but without final times.

    ``pictures`` are the blocks of the view, and ``pixel_m`` is the side of a pixel, metres.
    """
    light, truth = view_truth.blocks[0].light, view_truth.full_truth
    run = run_light(scene, pictures, plan, light)
    for ground, part in zip(view_truth.blocks, run.parts, strict=True):
        part[ground.attached_shadow_mask] = 0.0
        part[~ground.buffer.valid] = np.nan
    errors = view_truth.errors(run.parts, plan.steps_of_light(light), pixel_m, soft_edges=True)
    shown_visibility = np.nan_to_num(view_truth.assemble(run.parts, np.nan), nan=1.0)
    dark, true_dark = shown_visibility < 0.5, ~truth.lit
    records = run.log.records.values()
    figures = {
        "name": name_of(plan, light),
        "algorithm": plan.model_dump(mode="json")["algorithm"],
        "settings": plan.model_dump(mode="json")["settings"],
        **asdict(errors),
        "coverage": view_truth.coverage(run.parts),
        "bytes": max((record.bytes for record in records), default=0),
        "counters": {name: sum(getattr(record, name) for record in records) for name in COUNTERS},
        "notes": [record.note for record in records if record.note],
    }
    levels = np.rint(255.0 * shown_visibility).astype(np.uint8)
    row = ComparisonRow(figures, levels, truth.decidable & dark & ~true_dark, truth.decidable & ~dark & true_dark)
    return TimedPlan(plan, row, run.times)


def picture_blocks(scene: Scene, view: View) -> list[DrawnBlock]:
    """Return the geometry and the casters of each block of a view. The geometry includes antialiasing samples at edges.

    The blocks of a map are its square blocks, and those of a perspective view are bands of rows, as in ``render_frame``.
    """
    parts = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    pictures = [picture_buffer(scene, part) for part, _, _ in parts]
    return [(picture, find_casters(scene, picture.pixel_buffer)) for picture in pictures]


def run_light(scene: Scene, pictures: Sequence[DrawnBlock], plan: Plan, light: str) -> TimedRun:
    """Execute a plan's steps for a light on the blocks of a view, with empty caches, and measure the time.

    The time includes antialiasing samples at edges, as in any picture. The resulting visibilities are those of whole pixels.
    ``pictures`` are the blocks of the view.
    """
    clear_caches("light")  # the time includes all work of a moving sun
    return run_light_at_rest(scene, pictures, plan, light)


def run_light_at_rest(scene: Scene, pictures: Sequence[DrawnBlock], plan: Plan, light: str) -> TimedRun:
    """Execute a plan's steps as ``run_light`` does, but with the caches as they are.

    Directly after ``run_light`` they hold its maps and volumes: the time is that of a frame in which nothing has moved.
    """
    steps = plan.steps_of_light(light)
    log, start = PassLog(), time.perf_counter()
    parts = []
    for picture, casters in pictures:
        parts.append(fill_steps(steps, picture.buffer, scene, casters, plan.effect_names, log)[: picture.picture_rows])
    ms = (time.perf_counter() - start) * 1000.0 if steps else 0.0
    stages: dict[str, float] = {}
    for name, record in log.records.items():
        stage = name.split(": ", 1)[1]
        stages[stage] = stages.get(stage, 0.0) + record.ms
    return TimedRun((ms, stages), parts, log)


def _with_times(trial: TimedPlan) -> ComparisonRow:
    """Add the final times to the result of a plan, and return it.

    The first execution counts only if there are no later ones, because it includes compilation and allocation.
    """
    runs = sorted(trial.repeat_times or [trial.first_times], key=lambda run: run[0])
    times_ms = [ms for ms, _ in runs]
    trial.row.figures.update({
        "ms_median": float(np.median(times_ms)),
        "ms_p95": float(np.quantile(times_ms, 0.95)),
        "runs": len(runs),
        "cold": not trial.repeat_times,
        "ms_at_rest": float(np.median(trial.rest_ms)) if trial.rest_ms else None,
        "stages": {name: round(ms, 3) for name, ms in runs[len(runs) // 2][1].items()},
        "pareto": False,
        "pareto_soft": False,
    })  # fmt: skip
    return trial.row


def _mark_pareto(rows: list[ComparisonRow], error: str) -> None:
    """Mark the candidates on the Pareto fronts of time and error: no other candidate is as good in both and better in one.

    The figure ``pareto`` is for the error named ``error``, and ``pareto_soft`` for ``soft_error``.
    """
    for front, by in (("pareto", error), ("pareto_soft", "soft_error")):
        keys = [(row.figures["ms_median"], row.figures[by]) for row in rows]
        for row, key in zip(rows, keys, strict=True):
            row.figures[front] = not any(other != key and other[0] <= key[0] and other[1] <= key[1] for other in keys)


def _remarks(scene: Scene, view_truth: ViewTruth, rows: list[ComparisonRow]) -> list[str]:
    """Return remarks for the reader on what a comparison cannot measure in this view."""
    truth, remarks = view_truth.full_truth, []
    if not truth.valid.any():
        remarks.append("the view shows no surface: there is nothing to compare")
    elif not scene.light_names:
        remarks.append("the level has no light: everything is dark, whatever the algorithm")
    elif scene.light_names == (SUN,) and not scene.sun_is_up:
        remarks.append("the sun is down: everything is in shadow, whatever the algorithm")
    elif truth.cast_share == 0.0:
        remarks.append(NO_CAST_SHADOW_REMARK)
    elif not truth.lit.any():
        remarks.append("nothing is lit: only missed shadow can be measured")
    if truth.valid.any() and view_truth.error_name == "coverage":
        remarks.append("coverage is the error that counts: truth cannot decide over half of the surface")
    if not rows:
        remarks.append("no shadow algorithm can serve this view")
    return remarks
