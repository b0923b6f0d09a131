"""Cost of effects, and savings from omitting them: ratios within one run, because milliseconds do not compare between machines.

    python -m benchmarks.effects levels [--levels jacksboro ...] [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects plain [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects blocks [--repeats 5] [--json FILE] [--markdown FILE]
    python -m benchmarks.effects each [--effects haze ...] [--repeats 5] [--json FILE] [--markdown FILE]

`levels` draws the bundled levels' main views, and the map where there is relief. The frame as planned and the frame with all
effects forced on take turns. Forced effects include those that the level's weather does not call for. A level without snow or haze
has none to draw, so the saving is the cost of their code without any effect.

`plain` draws a plain at noon without trees, as a map and in perspective. Its reference is a frame made without any code of effects
or plans: geometry, attached shadow and shading alone, and a frame's data layers. Both pictures are identical to the bit. The target
applies to the frame with its plan. ``all on`` is the ratio of a frame with all effects forced on.

`blocks` draws random blocks of tiles on bundled levels of terrain only, ``--repeats`` of each zoom and sun, as the map service
does. It draws them with all steps of their plans, and without steps that a block provably does not need. It counts the blocks that
skipped casters outside the block, and the sweep. It also counts those that did not skip them although they changed nothing. The
pictures are identical to the bit.

`each` draws a scene that calls for an effect, with it and without it. ``ms/Mpx`` is the time of the effect's own pass. ``of
shading`` is its ratio to the frame's pass of shading. ``facts_ms`` is the time that planning spends on the facts by which it
decides on the effect. Shadows have no pass of their own, so they only have the ratio of the frame. Effects with a pass are drawn
without cast shadows, beside which they would hardly change the ratio of the frame.

Whole frames are timed by the CPU time of all threads (llvmpipe draws with several), which other load on the machine disturbs
little. ``wall`` is the same ratio by wall time. Passes and facts are work of one thread. They are timed by wall time and compared
within one frame. Every frame starts without cached shadow maps. The first round does not count: it compiles loops and computes the
level's caches, such as the horizons of ``sky_view``. All figures are medians.
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
import rasterio
from affine import Affine
from morecantile import tms as matrix_sets

from skugga.api.catalogue import bundled_levels, find_level
from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached import attached
from skugga.shadows.draw import SHADED, heights_suffice, picture_of
from skugga.shadows.executed_effects import executed_effects
from skugga.shadows.ground_pictures import ground_picture
from skugga.shadows.passes import PassLog
from skugga.shadows.picture import Picture
from skugga.shadows.plan import Plan
from skugga.shadows.render import SHADING_PASS, apply_refraction, bands_of, render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.slopes import extent_on_grid
from skugga.terrain.describe import describe
from skugga.terrain.effects import EFFECTS
from skugga.terrain.gbuffer.antialias import picture_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import BLOCK_PX, MapView, blocks_of, tile_grid
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import EffectName, load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from skugga.terrain.shading import shade, srgb_encoded
from skugga.terrain.sky import sky_pixel_colors

SIDE_PX, CELL_M, WAVE_M, RELIEF_M = 1024, 10.0, 2500.0, 0.3
"""The plain: cells a side and a map's pixels, their size, and the length and height of the waves of its ground."""

MAX_PLAIN = 1.15
"""The largest ratio of a plain at noon to a frame without any code of effects."""

SIZE = [800, 500]

RIDGE = {"kind": "perspective", "eye": [-84.12, 36.18333, 900], "target": [-84.22, 36.27333, 0], "fov": 34, "size": SIZE}
LAKE = {"kind": "perspective", "eye": [-84.093, 36.19133, 320], "target": [-84.17, 36.20533, 0], "fov": 34, "size": SIZE}
WINDOW = {"kind": "map", "crs": "EPSG:32616", "bounds": [735_900, 4_008_200, 755_900, 4_020_700], "size": SIZE}
"""Views of the Jacksboro fault: over its ridges, over its valley as a lake, and from above."""

EVENING = {"azimuth": 250, "altitude": 15}

JACKSBORO: dict[EffectName, dict[str, Any]] = {
    "refraction": {"sun": {"time": "2024-10-21T17:45:00-04:00"}},
    "cast_shadows": {},
    "outside_casters": {},
    "snow": {"weather": {"snow": True}},
    "clouds": {"weather": {"cloud_cover": 0.4}},
    "sky_view": {"weather": {"cloud_cover": 1.0}},
    "lamps": {"sun": "none", "lights": {"mast": {"kind": "omni", "position": [-84.17, 36.21333, 300]}}},
    "water": {"water": {"level": 311}},
    "haze": {"weather": {"visibility": 45_000}},
}
"""Keys that call for an effect on the Jacksboro fault."""

OTHER_VIEWS: dict[EffectName, tuple[str, str]] = {
    "alpha_test": ("jacksboro_wooded", "valley"),
    "soft_edges": ("jacksboro_wooded", "valley"),
    "crowns": ("jacksboro_wooded", "valley"),
    "ground_detail": ("jacksboro_wooded", "village"),
}
"""Bundled levels, and their views, that call for other effects."""

BARE_LEVELS = ("jacksboro", "jacksboro_alpine")
COUNTED_CASES = ("outside", "no outside", "outside in vain", "sweep", "no sweep", "sweep in vain")
"""Counted kinds of blocks. Their plans list ground outside the block; they skipped it; they drew it but it changed nothing. The
last three are the same for the sweep."""

BLOCK_ZOOMS, BLOCK_SUNS_DEG = (13, 15, 17), (8.0, 20.0, 35.0, 50.0)
"""Levels, zooms and suns of blocks of terrain only: from about the raster's resolution to a sixteenth of it."""

Row = dict[str, Any]
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class TimedFrame:
    """Times of a frame. It does not hold the frame itself, so that the next frame can reuse its memory.

    Attributes
    ----------
    effects
        Effects that were drawn.
    passes_ms
        Wall milliseconds of each pass.
    plan_ms
        CPU milliseconds of all threads for the plan.
    ms
        CPU milliseconds of all threads for plan and frame.
    wall_ms
        Wall milliseconds for plan and frame.
    """

    effects: frozenset[EffectName]
    passes_ms: dict[str, float]
    plan_ms: float
    ms: float
    wall_ms: float


def draw_planned_frame(scene: Scene, view: MapView | PerspectiveView, name: str) -> TimedFrame:
    """Plan and draw a frame without cached shadow maps, and return its times. ``name`` is the view's name."""
    clear_caches("light")
    wall, start = time.perf_counter(), time.process_time()
    plan = make_plan(describe(scene, view, name), scene.loaded.level)
    chosen = time.process_time()
    frame = render_frame(scene, view, plan)
    end = time.process_time()
    wall_ms, passes_ms = 1000.0 * (time.perf_counter() - wall), {record.name: record.ms for record in frame.passes}
    return TimedFrame(frame.effects, passes_ms, 1000.0 * (chosen - start), 1000.0 * (end - start), wall_ms)


def cpu_ms_of(work: Callable[..., object], *of: object) -> float:
    """Return the CPU milliseconds of all threads that a call takes."""
    start = time.process_time()
    work(*of)
    return 1000.0 * (time.process_time() - start)


def interleaved(repeats: int, *works: Callable[[], T]) -> list[list[T]]:
    """Return the results of each function, one for each round. The functions take turns in starting a round.

    The first round does not count.
    """
    results: list[list[T]] = [[] for _ in works]
    for number in range(repeats + 1):
        for which in [*range(len(works))][:: 1 if number % 2 else -1]:
            result = works[which]()
            if number:
                results[which].append(result)
    return results


def with_forced_effects(scene: Scene, effects: dict[EffectName, str]) -> Scene:
    """Return a scene whose level forces some effects on or off."""
    own_level = scene.loaded.level
    level = own_level.model_copy(update={"effects": {**({} if own_level.effects == "auto" else own_level.effects), **effects}})
    return replace(scene, loaded=scene.loaded.model_copy(update={"level": level}))


def levels(args: argparse.Namespace) -> list[Row]:
    """Compare the frame as planned with the frame with all effects on."""
    rows = []
    for path in [find_level(name) for name in args.levels] or bundled_levels():
        scene = build_scene(load_level(path))
        all_on_scene = with_forced_effects(scene, dict.fromkeys(get_args(EffectName), "on"))
        low, high = scene.height_range_m
        main = next(iter(scene.loaded.level.views))
        for name in dict.fromkeys([main, "map"] if high > low else [main]):
            view = scene.view(name)
            planned_frames, all_on = interleaved(
                args.repeats, *(partial(draw_planned_frame, variant, view, name) for variant in (scene, all_on_scene))
            )
            rows.append({
                "level": path.stem, "view": name, "Mpx": view.rows * view.cols / 1e6,
                "runs": f"{len(planned_frames[0].effects)} of {len(EFFECTS)}",
                "plan_ms": _median(frame.plan_ms for frame in planned_frames),
                "planned_ms": _median(frame.ms for frame in planned_frames), "all_on_ms": _median(frame.ms for frame in all_on),
                "planned / all on": _ratio(planned_frames, all_on, "ms"), "wall": _ratio(planned_frames, all_on, "wall_ms"),
                "effects": sorted(planned_frames[0].effects),
            })  # fmt: skip
            print(path.stem, name, f"{rows[-1]['planned / all on']:.2f}", flush=True)
    return rows


def plain(args: argparse.Namespace) -> list[Row]:
    """Compare a planned frame of a plain at noon with geometry, attached shadow and shading alone."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        scene = flat_land(Path(folder))
        all_on_scene = with_forced_effects(scene, dict.fromkeys(get_args(EffectName), "on"))
        for name in scene.loaded.level.views:
            view = scene.view(name)
            planned_frames, all_on, bare = interleaved(
                args.repeats,
                *(partial(draw_planned_frame, variant, view, name) for variant in (scene, all_on_scene)),
                partial(cpu_ms_of, bare_frame, scene, view),
            )
            frame = render_frame(scene, view, make_plan(describe(scene, view, name), scene.loaded.level))
            if frame.effects or (frame.color != bare_frame(scene, view)[0]).any():
                raise AssertionError(f"{name}: not the bare frame; it ran {sorted(frame.effects)}")
            ratio, forced_on = (
                _median(timed_frame.ms / ms for timed_frame, ms in zip(frames, bare, strict=True))
                for frames in (planned_frames, all_on)
            )
            rows.append({
                "view": name, "bare_ms": _median(bare), "plan_ms": _median(timed_frame.plan_ms for timed_frame in planned_frames),
                ("without "
                    "plan"): _median(
                    (timed_frame.ms - timed_frame.plan_ms) / ms for timed_frame, ms in zip(planned_frames, bare, strict=True)
                ),
                "with plan": ratio, "at most": MAX_PLAIN, "met": "yes" if ratio <= MAX_PLAIN else "NO", "all on": forced_on,
            })  # fmt: skip
    return rows


def flat_land(folder: Path) -> Scene:
    """Return a scene of a plain in UTM with decimetres of relief, under a clear sky at noon."""
    y, x = np.mgrid[0:SIDE_PX, 0:SIDE_PX] * (2.0 * np.pi * CELL_M / WAVE_M)
    heights = (100.0 + 0.5 * RELIEF_M * np.sin(x) * np.sin(y)).astype(np.float32)
    transform = Affine(CELL_M, 0.0, 500_000.0, 0.0, -CELL_M, 5_300_000.0)
    shape = {"height": SIDE_PX, "width": SIDE_PX, "count": 1, "dtype": "float32", "crs": "EPSG:32633", "transform": transform}
    with rasterio.open(folder / "plain.tif", "w", driver="GTiff", **shape) as dataset:
        dataset.write(heights, 1)
    views = {
        "map": {"kind": "map", "size": [SIDE_PX, SIDE_PX]},
        "camera": {"kind": "perspective", "eye": [15.04, 47.79, 60], "target": [15.08, 47.82, 0], "fov": 45, "size": [1280, 1024]},
    }
    return _scene_of(folder, {"terrain": {"source": "plain.tif"}, "sun": {"azimuth": 180, "altitude": 60}, "views": views})


def bare_frame(scene: Scene, view: MapView | PerspectiveView) -> list[np.ndarray]:
    """Return the arrays of a ``Frame``: colours, visibility, heights and, in perspective, positions.

    They are drawn with geometry, attached shadow and shading only: no cast shadows, no effects.
    """
    blocks = blocks_of(view) if isinstance(view, MapView) else bands_of(view)
    arrays: list[np.ndarray] = []
    for block_view, row, col in blocks:
        pieces = _bare_block(scene, block_view)
        arrays = arrays or [np.zeros((view.rows, view.cols, *piece.shape[2:]), piece.dtype) for piece in pieces]
        window = tuple(slice(max(offset, 0), end) for offset, end in ((row, view.rows), (col, view.cols)))
        for out, piece in zip(arrays, pieces, strict=True):
            inside = piece[max(-row, 0) : view.rows - row, max(-col, 0) : view.cols - col]
            out[window][: inside.shape[0], : inside.shape[1]] = inside
    return arrays


def _bare_block(scene: Scene, view: MapView | PerspectiveView) -> list[np.ndarray]:
    above = isinstance(view, MapView)
    picture = picture_buffer(scene, view)
    buffer, own_buffer = picture.buffer, picture.pixel_buffer
    visibility = 1.0 - attached(buffer, scene).astype(np.float32)
    linear, layers = shade(buffer, scene, visibility), [visibility[: view.rows], own_buffer.height_m]
    if not above:
        row, col = np.nonzero(~buffer.valid)
        linear[row, col] = sky_pixel_colors(scene, view, *picture.pixels_of_points(row, col))
        linear = picture.averaged(linear)
        layers.append(own_buffer.position_frame_m)
    return [srgb_encoded(linear), *layers]


def blocks(args: argparse.Namespace) -> list[Row]:
    """Compare blocks of tiles that are drawn with all steps of their plans, and without steps that they do not need."""
    random, rows = np.random.default_rng(0), []
    for name in args.levels or BARE_LEVELS:
        base = build_scene(load_level(find_level(name)))
        for zoom, altitude in product(BLOCK_ZOOMS, BLOCK_SUNS_DEG):
            grid = tile_grid(matrix_sets.get("WebMercatorQuad"), zoom)
            ends = extent_on_grid(base.world, base.elevation, grid)
            counts, ratios = (
                dict.fromkeys(("outside", "no outside", "outside in vain", "sweep", "no sweep", "sweep in vain"), 0),
                [],
            )
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
        block_by_variant[name] = _drawn_block(scene, view, plan)
        ms[name] = time.process_time() - start
    with (
        patch("skugga.shadows.block_casters.culled_patches", lambda *of: frozenset()),
        patch("skugga.shadows.block_casters.block_ground_casts_no_shadow", lambda *of: False),
    ):
        clear_caches("light")
        start = time.process_time()
        full_block = _drawn_block(scene, view, plans[0])
        ratios.append(ms["drawn"] / (time.process_time() - start))
    drawn_block = block_by_variant["drawn"]
    if (drawn_block.color != full_block.color).any() or (drawn_block.opacity != full_block.opacity).any():
        raise AssertionError(f"{view}: what was left out shows")
    ran = executed_effects(drawn_block.passes)
    counts["outside"] += "outside_casters" in plans[0].effect_names
    counts["no outside"] += "outside_casters" in plans[0].effect_names - ran
    counts["outside in vain"] += "outside_casters" in ran and bool((block_by_variant["alone"].opacity == full_block.opacity).all())
    counts["sweep"] += 1
    counts["no sweep"] += "cast_shadows" not in ran
    counts["sweep in vain"] += "cast_shadows" in ran and not drawn_block.opacity.any()


def _drawn_block(scene: Scene, view: MapView, plan: Plan) -> Picture:
    """Draw a block as ``skugga.shadows.draw`` does, but as a single block wherever it lies. ``draw`` may cut it from up to four."""
    if heights_suffice(scene, view, plan, SHADED):
        log = PassLog()
        picture = ground_picture(apply_refraction(scene, plan, log), view, plan, SHADED, log)
        if picture is not None:
            return replace(picture, passes=tuple(log.records.values()))
    return picture_of(render_frame(scene, view, plan), SHADED)


def measure_each_effect(args: argparse.Namespace) -> list[Row]:
    """Measure every effect by itself, in scenes that call for it."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        for effect in args.effects or get_args(EffectName):
            for scene, name in _views_with_effect(effect, Path(folder)):
                if effect in make_plan(describe(scene, scene.view(name), name), scene.loaded.level).effect_names:
                    rows.append(_with_and_without(effect, scene, name, args.repeats))
                    print(effect, name, f"{rows[-1]['on / off']:.2f}", flush=True)
    return rows


def _views_with_effect(effect: EffectName, folder: Path) -> Iterator[tuple[Scene, str]]:
    """Yield scenes that call for an effect, with the name of a view that shows it."""
    if effect in OTHER_VIEWS:
        level, name = OTHER_VIEWS[effect]
        yield build_scene(load_level(find_level(level))), name
        return
    keys = {"terrain": {"source": "jacksboro"}, "sun": EVENING, **JACKSBORO[effect]}
    if EFFECTS[effect].apply is not None:
        keys["effects"] = {"cast_shadows": "off"}
    views = {"map": WINDOW, "camera": LAKE if effect == "water" else RIDGE}
    scene = _scene_of(folder, {**keys, "views": views})
    for name in views:
        yield scene, name


def _scene_of(folder: Path, keys: dict[str, Any]) -> Scene:
    path = folder / "level.yaml"
    path.write_text(json.dumps({"version": 1, **keys}), encoding="utf-8")
    return build_scene(load_level(path))


def _with_and_without(effect: EffectName, scene: Scene, name: str, repeats: int) -> Row:
    view, scene_without = scene.view(name), with_forced_effects(scene, {effect: "off"})
    run, left_out = interleaved(repeats, *(partial(draw_planned_frame, variant, view, name) for variant in (scene, scene_without)))
    row: Row = {"effect": effect, "view": name, "on / off": _ratio(run, left_out, "ms"), "wall": _ratio(run, left_out, "wall_ms")}
    row |= {"ms/Mpx": "", "of shading": "", "facts_ms": ""}
    if EFFECTS[effect].apply is not None:
        row["ms/Mpx"] = _median(frame.passes_ms[effect] for frame in run) / (view.rows * view.cols / 1e6)
        row["of shading"] = _median(frame.passes_ms[effect] / frame.passes_ms[SHADING_PASS] for frame in run)
    if EFFECTS[effect].facts is not None:
        row["facts_ms"] = _median(facts_ms(scene, view)[effect] for _ in range(repeats))
    return row


def facts_ms(scene: Scene, view: MapView | PerspectiveView) -> dict[EffectName, float]:
    """Return by effect the milliseconds that describing a view takes for the facts by which planning decides on the effect."""
    with _facts_timed() as milliseconds:
        describe(scene, view)
    return milliseconds


@contextmanager
def _facts_timed() -> Iterator[dict[EffectName, float]]:
    """Record by effect the milliseconds that its facts take, while the context manager is active."""
    milliseconds: dict[EffectName, float] = {}
    untimed = dict(EFFECTS)

    def watched(name: EffectName, facts: Callable[..., T]) -> Callable[..., T]:
        def timed_facts(*of: Any) -> T:
            start = time.perf_counter()
            result = facts(*of)
            milliseconds[name] = 1000.0 * (time.perf_counter() - start)
            return result

        return timed_facts

    EFFECTS.update({name: replace(effect, facts=effect.facts and watched(name, effect.facts)) for name, effect in untimed.items()})
    try:
        yield milliseconds
    finally:
        EFFECTS.update(untimed)


def _median(values: Iterable[float]) -> float:
    return float(np.median([*values]))


def _ratio(frames: Sequence[TimedFrame], other_frames: Sequence[TimedFrame], key: str) -> float:
    """Return the median over rounds of the ratio of two frames' figure ``key``, such as ``ms``."""
    return _median(getattr(frame, key) / getattr(other, key) for frame, other in zip(frames, other_frames, strict=True))


MEASUREMENTS: dict[str, Callable[[argparse.Namespace], list[Row]]] = {
    "levels": levels,
    "plain": plain,
    "blocks": blocks,
    "each": measure_each_effect,
}


def table(rows: list[Row]) -> str:
    """Return rows as a Markdown table of their numbers and strings. Other values are only in the JSON file."""
    keys = [key for key, value in rows[0].items() if isinstance(value, int | float | str)]
    lines = [keys, ["---"] * len(keys), *([_cell(row[key]) for key in keys] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cell(value: float | str) -> str:
    return (f"{value:.3g}" if value < 100.0 else f"{value:.0f}") if isinstance(value, float) else str(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(MEASUREMENTS))
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--levels", nargs="+", default=[], help="bundled levels or level files, of levels")
    parser.add_argument("--effects", nargs="+", choices=get_args(EffectName), help="of each")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--markdown", type=Path)
    args = parser.parse_args()
    rows = MEASUREMENTS[args.what](args)
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    machine = f"{device().renderer}; peak memory {peak_mib:.0f} MiB; CPU time of all threads, {args.repeats} repeats"
    text = f"{machine}\n\n{table(rows)}"
    print(text, end="")
    if args.markdown:
        args.markdown.write_text(text, encoding="utf-8")
    if args.json:
        report = {"renderer": device().renderer, "peak_mib": peak_mib, "repeats": args.repeats, "rows": rows}
        args.json.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
