"""Replication of the SpatialAce thesis (Chalmers) on the cost of shadow maps.

It measures frames with redrawn and cached maps by map size, and the errors with 16 bits and 512 texels.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.algorithms import Row, measure_frames_by_map_size
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.times import interleaved_times
from benchmarks.seeds.verdicts import (
    SPATIALACE,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_max_percent,
    format_percent,
    format_ratio,
    format_whole_percent,
)
from benchmarks.seeds.views import (
    ShadowOverrides,
    ViewWithTruth,
    bundled_scene,
    sees_sun_when_moved,
    shared_settings,
    single_map_overrides,
    view_with_truth,
)
from skugga.api.device_calibration import calibration_for
from skugga.selector.select import select
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.metrics import block_shadow_shares, coverage_error
from skugga.shadows.truth.truth import coverage_truth
from skugga.terrain.cache import clear_caches
from skugga.terrain.gl.device import device

REPEATS = 21
"""Number of timed turns. Other work on the machine disturbs the least time of many turns least."""
FRAME_SIZE_PX = (800, 600)
MAP_SIZES = (64, 128, 256, 512, 1024)
"""Texels a side of the measured shadow maps."""
THESIS_MAP_SIZE = "512"
"""The size that the thesis chooses."""

THESIS_FPS_WITHOUT_SHADOWS = 58.88
THESIS_FPS = {"redrawn": (12.35, 10.21, 6.03, 2.22, 0.83), "kept": (16.68, 16.68, 16.68, 16.41, 16.15)}
"""The thesis's frames a second, without shadows and by map size."""

BLOCK_PX = 16
"""Side of the blocks whose shadow shares are compared."""

TERMINATOR_DISTANCE_TEXELS = 2.0
"""Distance behind the first hit of a ray from the sun, in texels, up to which a point counts as near the terminator."""

MIN_STEEP_GROWTH, MAX_FLAT_GROWTH, MIN_LARGE_GAIN = 1.5, 1.1, 2.0
"""Ratios of costs between the largest and the smallest map: a growth is steep from the first on, and flat up to the second. A gain
is large from the third ratio on."""

MAX_COVERAGE_ERROR = 0.03
"""The engine's default target error (``shadows.max_error``)."""

MAX_DEPTH_CHANGE = 0.1
"""Largest change of the error between 16 and 24 depth bits, as a share of the error."""

MIN_LIT_SHARE = 0.01
"""Minimum share of lit points on surfaces that face away from the sun. Below it the map has no acne there."""


def measure() -> Figures:
    """Measure times and errors of shadow maps of 16 bits by size, in the SpatialAce level's main view."""
    truth_view = view_with_truth(bundled_scene("spatialace"), "main", FRAME_SIZE_PX)
    rows = measure_frames_by_map_size(REPEATS, MAP_SIZES, _frame_clock(), depth_bits=16)
    true_shares = coverage_truth(truth_view.buffer, truth_view.scene, truth_view.casters, BLOCK_PX)

    def quality(overrides: ShadowOverrides) -> dict[str, float]:
        visibility = truth_view.visibility(truth_view.plan(overrides))
        wrong_cast = truth_view.errors(visibility)["wrong_cast"]
        return {"wrong_cast": wrong_cast, "coverage": coverage_error(block_shadow_shares(1.0 - visibility), true_shares)}

    def filtered_overrides(size: int, bits: int) -> ShadowOverrides:
        return single_map_overrides(size, depth_bits=bits, filter="auto")

    return {
        "load": list(os.getloadavg()[:2]),
        "times": {
            f"{name} {size}": {"ratio": row["least_ms"] / rows["none", 0]["least_ms"], "draws": row["map_draws"]}
            for (name, size), row in rows.items()
        },
        "records": {f"{name} {size}": _shadow_records(row) for (name, size), row in rows.items() if name != "none"},
        "expected": {str(size): _expected_at_rest(truth_view, filtered_overrides(size, 16)) for size in MAP_SIZES},
        "passes_ms": _measure_passes_ms(truth_view, {size: truth_view.plan(filtered_overrides(size, 16)) for size in MAP_SIZES}),
        "quality": {str(size): quality(filtered_overrides(size, 16)) for size in MAP_SIZES},
        "deeper": {str(size): quality(filtered_overrides(size, 24)) for size in MAP_SIZES},
        "without": quality({"algorithm": "none"}),
        "hidden": {
            str(size): _measure_away_facing_surfaces(
                truth_view, truth_view.plan(single_map_overrides(size, depth_bits=16, bias="polygon_offset"))
            )
            for size in MAP_SIZES
        },
    }


def _frame_clock() -> Callable[[], float]:
    """Return the clock of whole frames: on software renderers that of the processor, which other load changes little."""
    return time.process_time if device().egl_device.is_software else time.perf_counter


def _shadow_records(row: Row) -> dict[str, float]:
    """Return what the engine recorded of a frame's shadow passes: milliseconds, draw calls, and maps taken from its cache.

    ``row`` is a row of ``measure_frames_by_map_size``. Times are the least of all turns. A frame asks for its map several
    times: for its pixels, for samples at the edges of surfaces, and for those at the edges of shadows.
    """
    map_ms, look_up_ms = (
        sum(ms for pass_name, ms in row["least_passes_ms"].items() if pass_name.endswith(name))
        for name in ("depth map", "visibility")
    )
    records = {"map": map_ms, "look-up": look_up_ms, "frame": row["least_ms"]}
    return records | {"draws": row["map_draws"], "kept": row["maps_kept"]}


def _expected_at_rest(truth_view: ViewWithTruth, overrides: ShadowOverrides) -> float:
    """Return the time of a frame at rest that a plan of the policy ``predict`` expects, over that of a frame made anew.

    The level's figure turns. It is taken to rest, as it does in the measured frames.
    """
    level = truth_view.scene.loaded.level
    descriptor = truth_view.descriptor.model_copy(update={"moves": False})
    predicted = select(descriptor, level, overrides, "predict", calibration_for(level.shadows, overrides)).predicted
    return 1.0 if predicted is None or predicted.ms_at_rest is None else predicted.ms_at_rest / predicted.ms


def _measure_passes_ms(truth_view: ViewWithTruth, plans: dict[int, Plan]) -> dict[str, dict[str, float]]:
    """Return by map size the median milliseconds of drawing a shadow map and of looking it up. The sizes take turns."""

    def draw_frame(plan: Plan) -> PassLog:
        clear_caches("light")
        log = PassLog()
        truth_view.visibility(plan, log)
        return log

    def pass_ms(log: PassLog, name: str) -> float:
        return sum(record.ms for record in log.records.values() if record.name.endswith(name))

    runs = interleaved_times({str(size): lambda plan=plan: draw_frame(plan) for size, plan in plans.items()}, REPEATS)
    return {
        size: {name: float(np.median([pass_ms(log, name) for _, log in size_runs])) for name in ("depth map", "visibility")}
        for size, size_runs in runs.items()
    }


def _measure_away_facing_surfaces(truth_view: ViewWithTruth, plan: Plan) -> dict[str, float]:
    """Measure the result of a shadow map alone on surfaces that face away from the sun, with the bias ``polygon_offset``.

    Their normals are flipped, so that the map treats them as receivers. The figures are:

    * ``lit``: the share of such surfaces that the map leaves lit.
    * ``near``: the share that lies within ``TERMINATOR_DISTANCE_TEXELS`` texels, along the rays, behind the first hit from the sun.
    * ``lit_near``: the same share among the surfaces that are left lit.
    """
    faces_away = truth_view.faces_away
    flipped = replace(
        truth_view.buffer,
        normal_frame=np.where(faces_away[..., None], -1.0, 1.0).astype(np.float32) * truth_view.buffer.normal_frame,
    )
    left_lit = faces_away & (replace(truth_view, buffer=flipped).visibility(plan) >= 0.5)
    settings = shared_settings(truth_view, plan)
    assert isinstance(settings, ShadowMapSettings)
    texel_m = max(settings.cascades[0].texel_m)
    near_terminator = sees_sun_when_moved(truth_view, flipped, TERMINATOR_DISTANCE_TEXELS * texel_m) & faces_away
    return {
        "texel_m": texel_m,
        "turned": float(faces_away.sum() / truth_view.buffer.valid.sum()),
        "lit": float(left_lit.sum() / faces_away.sum()),
        "near": float(near_terminator.sum() / faces_away.sum()),
        "lit_near": float((left_lit & near_terminator).sum() / max(left_lit.sum(), 1)),
    }


def make_section(figures: Figures) -> Section:
    """Format the claims on the cost and quality of small shadow maps, and the table of figures."""
    frames, pass_times_ms, quality = figures["times"], figures["passes_ms"], figures["quality"]
    first, last = str(MAP_SIZES[0]), str(MAP_SIZES[-1])
    growth = {mode: frames[f"{mode} {last}"]["ratio"] / frames[f"{mode} {first}"]["ratio"] for mode in THESIS_FPS}
    thesis_gain = {mode: fps[0] / fps[-1] for mode, fps in THESIS_FPS.items()}
    cached_ratio, redrawn_ratio = (frames[f"{mode} {THESIS_MAP_SIZE}"]["ratio"] for mode in ("kept", "redrawn"))
    size_index = MAP_SIZES.index(int(THESIS_MAP_SIZE))
    thesis_redraw_ratio = THESIS_FPS["kept"][size_index] / THESIS_FPS["redrawn"][size_index]
    map_share = {
        size: pass_ms["depth map"] / (pass_ms["depth map"] + pass_ms["visibility"]) for size, pass_ms in pass_times_ms.items()
    }
    grows_steeply, stays_flat, caching_pays = (
        at_least(growth["redrawn"], MIN_STEEP_GROWTH),
        at_most(growth["kept"], MAX_FLAT_GROWTH),
        at_least(redrawn_ratio / cached_ratio, MIN_LARGE_GAIN),
    )
    coverage, coverage_without = quality[THESIS_MAP_SIZE]["coverage"], figures["without"]["coverage"]
    max_depth_change = max(abs(pass_ms["coverage"] - figures["deeper"][size]["coverage"]) for size, pass_ms in quality.items())
    size_suffices = all_of(
        (
            at_most(coverage, MAX_COVERAGE_ERROR),
            at_least(coverage_without, MIN_LARGE_GAIN * coverage),
            at_most(max_depth_change, MAX_DEPTH_CHANGE * coverage),
        ),
    )
    hidden_figures = figures["hidden"][THESIS_MAP_SIZE]
    normals_hide_leaks = all_of(
        (
            at_least(hidden_figures["lit"], MIN_LIT_SHARE),
            at_least(hidden_figures["lit_near"], MIN_LARGE_GAIN * hidden_figures["near"]),
        )
    )
    claims = [
        Claim(
            SPATIALACE,
            f"redrawing the map for each frame costs the more the larger it is: {format_ratio(thesis_gain['redrawn'])} times as "
            "much at "
            f"{last} as at {first}",
            f"{format_ratio(growth['redrawn'])} times as much (held from {MIN_STEEP_GROWTH:g} on)",
            grows_steeply,
            f"making the map is {format_whole_percent(map_share[first])} of the shadow's time at {first} texels a side and "
            f"{format_whole_percent(map_share[last])} at {last}"
            + choose_reason(
                grows_steeply,
                ", so its texels are what a frame pays for",
                "; the rest is looking it up at each pixel, of which there are as many whatever its size. By the thesis's own "
                "account much of its time went into making the depth buffer and storing it away as a texture, and better drivers "
                "halved that; here a map is looked up where it was drawn",
                "; what a larger map costs is as much as it takes to count as steep",
            ),
        ),
        Claim(
            SPATIALACE,
            f"while nothing moves a kept map costs hardly more the larger it is: {format_ratio(thesis_gain['kept'])} "
            f"times as much at {last} "
            f"as at {first}",
            f"{format_ratio(growth['kept'])} times as much (held up to {MAX_FLAT_GROWTH:g})",
            stays_flat,
            choose_reason(
                stays_flat,
                "a pixel looks up the same number of texels whatever the size",
                f"looking it up takes {format_ratio(pass_times_ms[last]['visibility'] / pass_times_ms[first]['visibility'])} times "
                f"as long at {last} "
                "as at "
                f"{first}",
            ),
        ),
        Claim(
            SPATIALACE,
            f"keeping the map is what makes a map of {THESIS_MAP_SIZE} bearable: redrawn frames take "
            f"{format_ratio(thesis_redraw_ratio)} "
            "times as "
            f"long",
            f"{format_ratio(redrawn_ratio / cached_ratio)} times as long (held from {MIN_LARGE_GAIN:g} on)",
            caching_pays,
            choose_reason(
                caching_pays,
                "drawing is most of what the shadow costs",
                f"the look-up is paid either way: a kept frame takes {format_ratio(cached_ratio)} times as long as one without "
                "shadows, "
                f"a redrawn one {format_ratio(redrawn_ratio)} times",
            ),
        ),
        Claim(
            SPATIALACE,
            f"16 bits of depth and {THESIS_MAP_SIZE} texels a side suffice: a little coarse, but far better than none",
            f"blocks' shadow shares are off by {format_percent(coverage)}, without shadows by "
            f"{format_percent(coverage_without)}; 24 bits change "
            f"that by {format_max_percent(max_depth_change)} at any size (held if off by at most "
            f"{format_percent(MAX_COVERAGE_ERROR)}, by "
            "at most half "
            f"of that without, and if bits change at most {format_whole_percent(MAX_DEPTH_CHANGE)} of it)",
            size_suffices,
            f"a texel is {hidden_figures['texel_m']:.1f} m wide, "
            + choose_reason(
                size_suffices,
                "next to which a step of 16 bits is small",
                "and edges are off by as much",
                "and what edges are off by is about what is allowed",
            ),
        ),
        Claim(
            SPATIALACE,
            "a map's self-shadow does not reach the edges; giving what is turned away from the sun the shadow's shade hides that",
            f"of the surface turned away a biased map of {THESIS_MAP_SIZE} alone leaves {format_percent(hidden_figures['lit'])} "
            "lit, and "
            f"{format_whole_percent(hidden_figures['lit_near'])} of that lies within {TERMINATOR_DISTANCE_TEXELS:g} texels, along "
            "the "
            "rays, of what "
            f"the sun meets first, where {format_whole_percent(hidden_figures['near'])} of all that is turned away lies; decided "
            "by the "
            f"normal, none of it is lit (held if at least {format_percent(MIN_LIT_SHARE)} is lit, near there at least "
            f"{MIN_LARGE_GAIN:g} times as often "
            f"as elsewhere)",
            normals_hide_leaks,
            choose_reason(
                normals_hide_leaks,
                "where a surface has just turned away the map holds its own lit side, less than the bias before it; that is why "
                "attached shadow is decided before any algorithm here",
                "what the map leaves lit does not gather where surfaces turn away",
            ),
        ),
    ]
    table = [
        {
            "map": size,
            "redrawn": format_ratio(frames[f"redrawn {size}"]["ratio"]),
            "kept": format_ratio(frames[f"kept {size}"]["ratio"]),
            "theirs redrawn": format_ratio(THESIS_FPS_WITHOUT_SHADOWS / THESIS_FPS["redrawn"][k]),
            "theirs kept": format_ratio(THESIS_FPS_WITHOUT_SHADOWS / THESIS_FPS["kept"][k]),
            "map made": format_whole_percent(map_share[size]),
            "wrong_cast": format_percent(quality[size]["wrong_cast"]),
            "coverage": format_percent(quality[size]["coverage"]),
            "turned away, lit by the map": format_percent(figures["hidden"][size]["lit"]),
        }
        for k, size in enumerate(map(str, MAP_SIZES))
    ]
    load = " and ".join(f"{value:.1f}" for value in figures["load"])
    record_table = []
    for k, size in enumerate(map(str, MAP_SIZES)):
        redrawn, kept = (figures["records"][f"{mode} {size}"] for mode in ("redrawn", "kept"))
        redrawn_shadow, kept_shadow = (frames[f"{mode} {size}"]["ratio"] - 1.0 for mode in ("redrawn", "kept"))
        record_table.append(
            {
                "map": size,
                "map pass, redrawn": f"{redrawn['map']:.1f} ms",
                "map pass, kept": f"{kept['map']:.1f} ms",
                "look-up, redrawn": f"{redrawn['look-up']:.1f} ms",
                "look-up, kept": f"{kept['look-up']:.1f} ms",
                "draw calls": f"{redrawn['draws']}, {kept['draws']}",
                "maps from the cache": f"{redrawn['kept']}, {kept['kept']}",
                "shadow, kept of redrawn": format_ratio(kept_shadow / redrawn_shadow),
                "expected by the plan": format_ratio(figures["expected"][size]),
                "frame, kept of redrawn": format_ratio(kept["frame"] / redrawn["frame"]),
                "their frame": format_ratio(THESIS_FPS["redrawn"][k] / THESIS_FPS["kept"][k]),
            }
        )
    return Section(
        "SpatialAce: maps redrawn and kept",
        f"`spatialace --view main`, {FRAME_SIZE_PX[0]} x {FRAME_SIZE_PX[1]}, one map of 16 bits. Times are those of whole "
        f"frames, taken in turns, the least of {REPEATS}, as ratios to frames without shadows, on a software renderer "
        "in time of the processor (the thesis's: "
        f"{THESIS_FPS_WITHOUT_SHADOWS} frames a second "
        "over those "
        "with the map). `map made` is the share of fitting and drawing the map in the shadow time; `coverage` is the error of "
        "shadow shares in blocks. The second table is the engine's own record of the same frames: least milliseconds of its "
        "passes on "
        "this "
        "device, draw calls into maps, and maps that its cache served. A frame asks for its map several times, for pixels and for "
        "samples at edges, so that one made anew is served too, after its first draw. *map pass* includes the fit of the map to "
        "the visible points, which every frame makes; what a device draws only when it is read falls to *look-up*. *shadow, kept "
        "of redrawn* is that of the frames in the first table, without what they take without shadows. *expected by the plan* is "
        "the time at rest over that of a new frame, as `skugga select` tells both for a level whose figure rests. "
        f"Load averages over the last minute and five minutes while measuring: {load}.",
        [
            ("Frames against frames without shadows, and errors", table),
            ("What the engine records of its passes and caches (redrawn, kept)", record_table),
        ],
        claims,
    )
