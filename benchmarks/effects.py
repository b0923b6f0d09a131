"""Cost of effects, and savings from omitting them: ratios within one run, because milliseconds do not compare between machines.

    python -m benchmarks.effects levels [--levels jacksboro ...] [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects plain [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects blocks [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects each [--effects haze ...] [--repeats 5] [--json FILE] [--markdown FILE]

`levels` draws 20 views of the bundled levels (``SAVING_VIEWS``) as HTTP and the command line draw colours. The planned picture
and the picture with all effects forced on take turns, and both include the time of their plan. The targets are a median ratio of
at most ``MAX_MEDIAN_RATIO`` and no ratio above ``MAX_RATIO``; the last line says whether they are met. Forced effects include those
that the level's weather does not require. In a level without snow, the forced effect of snow changes no pixel, so its saving is the
time of its code alone. With ``--levels`` it draws only the views of these levels, or, of other level files, the main view and the
map.

`plain` draws a plain at noon without trees, as a map and in perspective. The reference frame runs no code of effects or plans, only
geometry, attached shadow, shading and the data layers. Both pictures are bitwise identical. The target applies to the frame with
its plan. ``all on`` is the ratio of a frame with all effects forced on.

`blocks` draws random blocks of tiles on bundled levels of terrain only, ``--repeats`` of each zoom and sun, as the map service
does. It draws them with all steps of their plans, and without steps that a block provably does not need. It counts the blocks that
skip casters outside the block, and those that skip the sweep. It also counts the blocks that run such a step in vain: the step
changes no pixel. The pictures are bitwise identical.

`each` draws a scene that requires an effect, with the effect and without it. ``ms/Mpx`` is the time of the effect's own pass. ``of
shading`` is its ratio to the frame's shading pass. ``facts_ms`` is the planner's time to compute the facts that decide on the
effect. Shadows have no pass of their own, so they only have the ratio of the frame. Effects with a pass are drawn without cast
shadows, which would dominate the time of the frame.

Times of whole frames are CPU times of all threads, since other load on the machine affects them little. ``wall`` is the same ratio
by wall time. Passes and facts run in one thread. Their times are wall times, compared within one frame. Every frame starts without
cached shadow maps. The first round does not count: it compiles loops and fills the level's caches, such as the horizons of
``sky_view``. All figures are medians.
"""

from __future__ import annotations

import argparse
import json
import resource
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, TypeVar, get_args
from unittest.mock import patch

import numpy as np
from morecantile import tms as matrix_sets

from benchmarks.effect_reference import frame_without_effects, level_scene, plain_scene
from skugga.api.catalogue import find_level
from skugga.selector.planner.planner import make_plan
from skugga.shadows.draw import SHADING_NEEDS, can_draw_from_heights, draw, picture_of
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.ground_pictures import ground_picture
from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.picture import Needs, Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import SHADING_PASS, apply_refraction, render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.describe import describe
from skugga.terrain.effects import EFFECTS
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, tile_grid
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import EffectName, load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene

MAX_PLAIN_RATIO = 1.15
"""The largest ratio of a plain at noon to a frame without any code of effects."""

MAX_MEDIAN_RATIO, MAX_RATIO = 0.9, 1.05
"""The largest median, and the largest single ratio, of a planned picture to one with all effects on."""

THESIS_LEVELS = tuple(
    f"thesis_{name}{light}" for name in ("boxgrid", "rocks", "room", "street", "water_tower") for light in ("", "_sun")
)

SAVING_VIEWS = (
    ("jacksboro", "map"), ("jacksboro_alpine", "map"),
    ("jacksboro_wooded", "valley"), ("jacksboro_wooded", "village"), ("jacksboro_wooded", "map"),
    ("spatialace", "main"), ("spatialace", "close"), ("spatialace", "map"),
    *((level, "main") for level in THESIS_LEVELS),
    ("thesis_boxgrid_sun", "close"), ("thesis_room_sun", "close"),
)  # fmt: skip
"""Levels and views in which planned pictures are compared with those with all effects on: the main view of each bundled level, the
maps of levels with relief, and four further views."""

COLOR_NEEDS: Needs = frozenset({"color"})

VIEW_SIZE_PX = [800, 500]
"""Width and height of the views below."""

RIDGE_VIEW = {
    "kind": "perspective",
    "eye": [-84.12, 36.18333, 900],
    "target": [-84.22, 36.27333, 0],
    "fov": 34,
    "size": VIEW_SIZE_PX,
}
LAKE_VIEW = {
    "kind": "perspective",
    "eye": [-84.093, 36.19133, 320],
    "target": [-84.17, 36.20533, 0],
    "fov": 34,
    "size": VIEW_SIZE_PX,
}
MAP_VIEW = {"kind": "map", "crs": "EPSG:32616", "bounds": [735_900, 4_008_200, 755_900, 4_020_700], "size": VIEW_SIZE_PX}
"""Views of the Jacksboro fault: over its ridges, over its valley as a lake, and from above."""

EVENING_SUN = {"azimuth": 250, "altitude": 15}
"""Azimuth and altitude of the sun in the scenes of ``each``, degrees."""

LEVEL_KEYS_BY_EFFECT: dict[EffectName, dict[str, Any]] = {
    "refraction": {"sun": {"time": "2024-10-21T17:45:00-04:00"}},
    "cast_shadows": {},
    "outside_casters": {},
    "snow": {"weather": {"snow": True}},
    "clouds": {"weather": {"cloud_cover": 0.4}},
    "sky_view": {"weather": {"cloud_cover": 1.0}},
    "lamps": {"sun": "none", "lights": {"mast": {"kind": "omni", "position": [-84.17, 36.21333, 300]}}},
    "water": {"water": {"level": 311}},
    "haze": {"weather": {"visibility": 45_000}},
    "precipitation": {"weather": {"precipitation": "rain"}},
}
"""Keys of a level over the Jacksboro fault that requires the effect."""

BUNDLED_VIEW_BY_EFFECT: dict[EffectName, tuple[str, str]] = {
    "alpha_test": ("jacksboro_wooded", "valley"),
    "soft_edges": ("jacksboro_wooded", "valley"),
    "crowns": ("jacksboro_wooded", "valley"),
    "ground_materials": ("jacksboro_wooded", "village"),
    "ground_detail": ("jacksboro_wooded", "village"),
    "facades": ("jacksboro_wooded", "village"),
}
"""Bundled level and its view that require the effect."""

TERRAIN_ONLY_LEVELS = ("jacksboro", "jacksboro_alpine")
"""Bundled levels without trees and meshes."""
BLOCK_COUNTERS = ("outside", "no outside", "outside in vain", "sweep", "no sweep", "sweep in vain")
"""Names of the counters of blocks, in two groups of three: one group for casters outside the block, one for the sweep. The first
counts blocks whose plan has the step, the second blocks that skipped it, the third blocks in which it changed nothing."""

BLOCK_ZOOMS, BLOCK_SUNS_DEG = (13, 15, 17), (8.0, 20.0, 35.0, 50.0)
"""Zooms of the blocks, from about the raster's resolution to a sixteenth of a cell per pixel, and altitudes of the sun."""

Row = dict[str, Any]
"""Figures of one view by column of the table or key of the JSON file."""
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Times of a frame, without the frame itself, so that the next frame can reuse its memory.

    Attributes
    ----------
    drawn_effects
        Effects that were drawn.
    passes_ms
        Wall milliseconds of each pass.
    plan_ms
        CPU milliseconds of all threads for the plan.
    cpu_ms
        CPU milliseconds of all threads for plan and frame.
    wall_ms
        Wall milliseconds for plan and frame.
    """

    drawn_effects: frozenset[EffectName]
    passes_ms: dict[str, float]
    plan_ms: float
    cpu_ms: float
    wall_ms: float


def draw_planned_frame(scene: Scene, view: MapView | PerspectiveView, name: str) -> FrameTimes:
    """Plan and draw a frame without cached shadow maps, and return its times. ``name`` is the name of the view."""
    return _time_plan_and_draw(scene, view, name, lambda plan: render_frame(scene, view, plan).passes)


def draw_planned_picture(scene: Scene, view: MapView | PerspectiveView, name: str) -> FrameTimes:
    """Plan and draw the colours of a view on the fastest path that shows them, and return the times (``skugga.shadows.draw``)."""
    return _time_plan_and_draw(scene, view, name, lambda plan: draw(scene, view, plan, COLOR_NEEDS).passes)


def _time_plan_and_draw(
    scene: Scene, view: MapView | PerspectiveView, name: str, draw_passes: Callable[[Plan], Sequence[PassRecord]]
) -> FrameTimes:
    """Plan and draw a view without cached shadow maps, and return its times."""
    clear_caches("light")
    wall, start = time.perf_counter(), time.process_time()
    plan = make_plan(describe(scene, view, name), scene.loaded.level)
    planned = time.process_time()
    passes = draw_passes(plan)
    end = time.process_time()
    wall_ms, passes_ms = 1000.0 * (time.perf_counter() - wall), {record.name: record.ms for record in passes}
    return FrameTimes(executed_effects(passes), passes_ms, 1000.0 * (planned - start), 1000.0 * (end - start), wall_ms)


def measure_cpu_ms(function: Callable[..., object], *arguments: object) -> float:
    """Return the CPU milliseconds of all threads that a call takes."""
    start = time.process_time()
    function(*arguments)
    return 1000.0 * (time.process_time() - start)


def run_interleaved(repeats: int, *functions: Callable[[], T]) -> list[list[T]]:
    """Run functions in rounds, in alternating order, and return the results of each. The first round does not count."""
    results: list[list[T]] = [[] for _ in functions]
    for number in range(repeats + 1):
        for index in [*range(len(functions))][:: 1 if number % 2 else -1]:
            result = functions[index]()
            if number:
                results[index].append(result)
    return results


def with_forced_effects(scene: Scene, effects: dict[EffectName, str]) -> Scene:
    """Return a scene whose level forces some effects. ``effects`` maps their names to "on" or "off"."""
    own_level = scene.loaded.level
    level = own_level.model_copy(update={"effects": {**({} if own_level.effects == "auto" else own_level.effects), **effects}})
    return replace(scene, loaded=scene.loaded.model_copy(update={"level": level}))


def measure_levels(args: argparse.Namespace) -> list[Row]:
    """Compare the planned picture with a picture with all effects forced on."""
    rows: list[Row] = []
    bundled = [name for name in dict.fromkeys(level for level, _ in SAVING_VIEWS) if not args.levels or name in args.levels]
    others = [name for name in args.levels if name not in bundled]
    for path in [find_level(name) for name in [*bundled, *others]]:
        scene = build_scene(load_level(path))
        all_on_scene = with_forced_effects(scene, dict.fromkeys(get_args(EffectName), "on"))
        low, high = scene.height_range_m
        main = next(iter(scene.loaded.level.views))
        names = [view for level, view in SAVING_VIEWS if level == path.stem] or ([main, "map"] if high > low else [main])
        for name in dict.fromkeys(names):
            view = scene.view(name)
            planned_frames, all_on = run_interleaved(
                args.repeats, *(partial(draw_planned_picture, variant, view, name) for variant in (scene, all_on_scene))
            )
            rows.append({
                "level": path.stem, "view": name, "Mpx": view.rows * view.cols / 1e6,
                "runs": f"{len(planned_frames[0].drawn_effects)} of {len(EFFECTS)}",
                "plan_ms": _median(frame.plan_ms for frame in planned_frames),
                "planned_ms": _median(frame.cpu_ms for frame in planned_frames),
                "all_on_ms": _median(frame.cpu_ms for frame in all_on),
                "planned / all on": _ratio(planned_frames, all_on, "cpu_ms"), "wall": _ratio(planned_frames, all_on, "wall_ms"),
                "effects": sorted(planned_frames[0].drawn_effects),
            })  # fmt: skip
            print(path.stem, name, f"{rows[-1]['planned / all on']:.3f}", flush=True)
    ratios = [row["planned / all on"] for row in rows]
    is_met = np.median(ratios) <= MAX_MEDIAN_RATIO and max(ratios) <= MAX_RATIO
    print(
        f"{len(rows)} views: median {np.median(ratios):.3f} (at most {MAX_MEDIAN_RATIO}), largest {max(ratios):.3f} (at most "
        f"{MAX_RATIO}): {'met' if is_met else 'NOT met'}",
        flush=True,
    )
    return rows


def measure_plain(args: argparse.Namespace) -> list[Row]:
    """Compare a planned frame of a plain at noon with geometry, attached shadow and shading alone."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = plain_scene(Path(folder))
        all_on_scene = with_forced_effects(scene, dict.fromkeys(get_args(EffectName), "on"))
        for name in scene.loaded.level.views:
            view = scene.view(name)
            planned_frames, all_on, reference_ms = run_interleaved(
                args.repeats,
                *(partial(draw_planned_frame, variant, view, name) for variant in (scene, all_on_scene)),
                partial(measure_cpu_ms, frame_without_effects, scene, view),
            )
            frame = render_frame(scene, view, make_plan(describe(scene, view, name), scene.loaded.level))
            if frame.effects or (frame.color != frame_without_effects(scene, view)[0]).any():
                raise AssertionError(f"{name}: the frame differs from that without effects; it ran {sorted(frame.effects)}")
            ratio, forced_on = (
                _median(timed_frame.cpu_ms / ms for timed_frame, ms in zip(frames, reference_ms, strict=True))
                for frames in (planned_frames, all_on)
            )
            rows.append({
                "view": name, "bare_ms": _median(reference_ms),
                "plan_ms": _median(timed_frame.plan_ms for timed_frame in planned_frames),
                "without plan": _median(
                    (timed_frame.cpu_ms - timed_frame.plan_ms) / ms
                    for timed_frame, ms in zip(planned_frames, reference_ms, strict=True)
                ),
                "with plan": ratio, "at most": MAX_PLAIN_RATIO, "met": "yes" if ratio <= MAX_PLAIN_RATIO else "NO",
                "all on": forced_on,
            })  # fmt: skip
    return rows


def measure_blocks(args: argparse.Namespace) -> list[Row]:
    """Compare blocks of tiles with all steps of their plans and without the steps that they do not need."""
    random, rows = np.random.default_rng(0), []
    for name in args.levels or TERRAIN_ONLY_LEVELS:
        base = build_scene(load_level(find_level(name)))
        for zoom, altitude in product(BLOCK_ZOOMS, BLOCK_SUNS_DEG):
            grid = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom)
            ends = extent_on_grid(base.world, base.elevation, grid)
            counts: dict[str, int] = dict.fromkeys(BLOCK_COUNTERS, 0)
            ratios: list[float] = []
            for _ in range(args.repeats):
                row, col = (float(random.integers(first, max(last - BLOCK_PX, first + 1))) for first, last in ends)
                scene = base.with_sun(SunSpec(azimuth=float(random.uniform(0.0, 360.0)), altitude=altitude))
                view = MapView(grid, row, col, 1.0, 1.0, BLOCK_PX, BLOCK_PX)
                _count_block(scene, view, counts, ratios)
            rows.append(
                {"level": name, "zoom": zoom, "sun_deg": altitude, "blocks": args.repeats, **counts, "time": _median(ratios)}
            )
            print(*rows[-1].values(), flush=True)
    return rows


def _count_block(scene: Scene, view: MapView, counts: dict[str, int], ratios: list[float]) -> None:
    """Draw a block with and without the steps that it does not need, and add the result to ``counts`` and ``ratios``.

    ``counts`` has the keys ``BLOCK_COUNTERS``. ``ratios`` are CPU times without those steps divided by times with them. Raises
    ``AssertionError`` if the pictures differ.
    """
    plans = [
        make_plan(describe(variant, view), variant.loaded.level)
        for variant in (scene, with_forced_effects(scene, {"outside_casters": "off"}))
    ]
    if "cast_shadows" not in plans[0].effect_names:
        return
    block_by_variant, ms = {}, {}
    for name, plan in ({"first": plans[0], "drawn": plans[0], "alone": plans[1]}).items():  # the first draw reads the ground
        clear_caches("light")
        start = time.process_time()
        block_by_variant[name] = _draw_single_block(scene, view, plan)
        ms[name] = time.process_time() - start
    with (
        patch("skugga.shadows.block_casters.culled_patches", lambda *arguments: frozenset()),
        patch("skugga.shadows.block_casters.block_ground_casts_no_shadow", lambda *arguments: False),
    ):
        clear_caches("light")
        start = time.process_time()
        full_block = _draw_single_block(scene, view, plans[0])
        ratios.append(ms["drawn"] / (time.process_time() - start))
    drawn_block = block_by_variant["drawn"]
    if (drawn_block.color != full_block.color).any() or (drawn_block.opacity != full_block.opacity).any():
        raise AssertionError(f"{view}: a skipped step changes the picture")
    effects_run = executed_effects(drawn_block.passes)
    counts["outside"] += "outside_casters" in plans[0].effect_names
    counts["no outside"] += "outside_casters" in plans[0].effect_names - effects_run
    counts["outside in vain"] += "outside_casters" in effects_run and bool(
        (block_by_variant["alone"].opacity == full_block.opacity).all()
    )
    counts["sweep"] += 1
    counts["no sweep"] += "cast_shadows" not in effects_run
    counts["sweep in vain"] += "cast_shadows" in effects_run and not drawn_block.opacity.any()


def _draw_single_block(scene: Scene, view: MapView, plan: Plan) -> Picture:
    """Draw a block like ``skugga.shadows.draw``, but without splitting it at the block boundaries of the tile grid."""
    if can_draw_from_heights(scene, view, plan, SHADING_NEEDS):
        log = PassLog()
        picture = ground_picture(apply_refraction(scene, plan, log), view, plan, SHADING_NEEDS, log)
        if picture is not None:
            return replace(picture, passes=tuple(log.records.values()))
    return picture_of(render_frame(scene, view, plan), SHADING_NEEDS)


def measure_each_effect(args: argparse.Namespace) -> list[Row]:
    """Measure every effect by itself, in scenes that require it."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for effect in args.effects or get_args(EffectName):
            for scene, name in _views_with_effect(effect, Path(folder)):
                if effect in make_plan(describe(scene, scene.view(name), name), scene.loaded.level).effect_names:
                    rows.append(_with_and_without(effect, scene, name, args.repeats))
                    print(effect, name, f"{rows[-1]['on / off']:.2f}", flush=True)
    return rows


def _views_with_effect(effect: EffectName, folder: Path) -> Iterator[tuple[Scene, str]]:
    """Yield scenes that require an effect, each with the name of a view that shows it. Level files are written into ``folder``."""
    if effect in BUNDLED_VIEW_BY_EFFECT:
        level, name = BUNDLED_VIEW_BY_EFFECT[effect]
        yield build_scene(load_level(find_level(level))), name
        return
    keys = {"terrain": {"source": "jacksboro"}, "sun": EVENING_SUN, **LEVEL_KEYS_BY_EFFECT[effect]}
    if EFFECTS[effect].apply is not None:
        keys["effects"] = {"cast_shadows": "off"}
    views = {"map": MAP_VIEW, "camera": LAKE_VIEW if effect == "water" else RIDGE_VIEW}
    scene = level_scene(folder, {**keys, "views": views})
    for name in views:
        yield scene, name


def _with_and_without(effect: EffectName, scene: Scene, name: str, repeats: int) -> Row:
    """Return the row of an effect in the view ``name`` of a scene that requires it."""
    view, scene_without = scene.view(name), with_forced_effects(scene, {effect: "off"})
    run, left_out = run_interleaved(
        repeats, *(partial(draw_planned_frame, variant, view, name) for variant in (scene, scene_without))
    )
    row: Row = {
        "effect": effect,
        "view": name,
        "on / off": _ratio(run, left_out, "cpu_ms"),
        "wall": _ratio(run, left_out, "wall_ms"),
    }
    row |= {"ms/Mpx": "", "of shading": "", "facts_ms": ""}
    if EFFECTS[effect].apply is not None:
        row["ms/Mpx"] = _median(frame.passes_ms[effect] for frame in run) / (view.rows * view.cols / 1e6)
        row["of shading"] = _median(frame.passes_ms[effect] / frame.passes_ms[SHADING_PASS] for frame in run)
    if EFFECTS[effect].facts is not None:
        row["facts_ms"] = _median(measure_facts_ms(scene, view)[effect] for _ in range(repeats))
    return row


def measure_facts_ms(scene: Scene, view: MapView | PerspectiveView) -> dict[EffectName, float]:
    """Return by effect the milliseconds to compute the facts that decide whether a plan has the effect."""
    with _time_facts() as milliseconds:
        describe(scene, view)
    return milliseconds


@contextmanager
def _time_facts() -> Iterator[dict[EffectName, float]]:
    """Record by effect the milliseconds to compute its facts, while the context manager is active."""
    milliseconds: dict[EffectName, float] = {}
    untimed = dict(EFFECTS)

    def with_timer(effect_name: EffectName, facts: Callable[..., T]) -> Callable[..., T]:
        def timed_facts(*arguments: Any) -> T:
            start = time.perf_counter()
            result = facts(*arguments)
            milliseconds[effect_name] = 1000.0 * (time.perf_counter() - start)
            return result

        return timed_facts

    EFFECTS.update(
        {name: replace(effect, facts=effect.facts and with_timer(name, effect.facts)) for name, effect in untimed.items()}
    )
    try:
        yield milliseconds
    finally:
        EFFECTS.update(untimed)


def _median(values: Iterable[float]) -> float:
    """Return the median of the values."""
    return float(np.median([*values]))


def _ratio(frames: Sequence[FrameTimes], other_frames: Sequence[FrameTimes], field: str) -> float:
    """Return the median ratio over rounds of a field of two frames, such as ``cpu_ms``."""
    return _median(getattr(frame, field) / getattr(other, field) for frame, other in zip(frames, other_frames, strict=True))


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "levels": measure_levels,
    "plain": measure_plain,
    "blocks": measure_blocks,
    "each": measure_each_effect,
}


def markdown_table(rows: list[Row]) -> str:
    """Return rows as a Markdown table of their numbers and strings. Other values are only in the JSON file."""
    keys = [key for key, value in rows[0].items() if isinstance(value, int | float | str)]
    lines = [keys, ["---"] * len(keys), *([_format_cell(row[key]) for key in keys] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _format_cell(value: float | str) -> str:
    """Format a cell of a table, floats with three significant digits or as integers from 100."""
    return (f"{value:.3g}" if value < 100.0 else f"{value:.0f}") if isinstance(value, float) else str(value)


def main() -> None:
    """Run the measurement that the command line names, and print and write its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(MEASUREMENTS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--levels", nargs="+", default=[], help="bundled levels or level files; for levels and blocks")
    parser.add_argument("--effects", nargs="+", choices=get_args(EffectName), help="effects to measure; for each")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    rows = MEASUREMENTS[args.what](args)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    machine = f"{device().renderer}; peak memory {peak_mib:.0f} MiB; CPU time of all threads, {args.repeats} repeats"
    text = f"{machine}\n\n{markdown_table(rows)}"
    print(text, end="")
    if args.markdown:
        args.markdown.write_text(text, encoding="utf-8")
    if args.json:
        report = {"renderer": device().renderer, "peak_mib": peak_mib, "repeats": args.repeats, "rows": rows}
        args.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
