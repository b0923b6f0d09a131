"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005): replication of its advice (table 1, section 8.2)."""

from __future__ import annotations

import numpy as np

from benchmarks.benchmark_views import IN_SHADOW_VIEW
from benchmarks.contact_sheet import named_view
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.grades import ERROR_SIZE_PX, MAX_ZERO_ERROR_SHARE, algorithm_errors, errors_by_camera_move
from benchmarks.seeds.times import LIGHT_BY_SUFFIX, measure_times, time_ratio
from benchmarks.seeds.verdicts import (
    ABBREVIATIONS,
    DRAW_FACTOR,
    HYBRID,
    PSM,
    SCENE_TITLES,
    SM,
    SV,
    THESIS,
    THESIS_ALGORITHMS,
    all_of,
    at_most,
    choose_reason,
    format_by_scene,
    format_percent,
    format_whole_percent,
    join_scene_names,
)
from benchmarks.seeds.views import bundled_scene, trace_view_truth

OUTDOOR_SIZE_PX = (400, 320)
OUTDOOR_VIEWS = (("jacksboro", "ridges"), ("spatialace", "main"))
"""Large outdoor views under the sun: level and view."""

MIN_WORSE_VIEWS = 3
"""Minimum number of views that counts as "many cases"."""

MAX_CACHED_TIME_RATIO = 0.8
"""Largest ratio of times that counts as "considerably less time"."""


def measure() -> Figures:
    near = {
        f"boxgrid{sun}, {view}": measure_times(f"thesis_boxgrid{sun}", view, (SV, HYBRID))
        for sun in LIGHT_BY_SUFFIX
        for view in (IN_SHADOW_VIEW, "close")
    }
    return {
        "views": {
            f"{scene}{sun}": measure_times(f"thesis_{scene}{sun}", "main") for sun in LIGHT_BY_SUFFIX for scene in SCENE_TITLES
        },
        "near": near,
        "paths": {scene: errors_by_camera_move(f"thesis_{scene}") for scene in SCENE_TITLES},
        "outdoors": {
            " ".join(level_and_view): _view_errors(*level_and_view, OUTDOOR_SIZE_PX, (SM, PSM)) for level_and_view in OUTDOOR_VIEWS
        },
        "sun": {scene: _view_errors(f"thesis_{scene}_sun", "main", ERROR_SIZE_PX, (SM, PSM)) for scene in SCENE_TITLES},
        "from": {
            view: {scene: _view_errors(f"thesis_{scene}", view, ERROR_SIZE_PX, (SM,))[SM] for scene in SCENE_TITLES}
            for view in ("close", "overview")
        },
    }


def _view_errors(level: str, view: str, size: tuple[int, int], algorithms: tuple[str, ...] = THESIS_ALGORITHMS) -> Figures:
    """Return the errors of algorithms in a view of a bundled level."""
    scene = bundled_scene(level)
    return algorithm_errors(trace_view_truth(scene, named_view(scene, view, size), "main"), algorithms)


def section(figures: Figures) -> Section:
    views, near, paths = figures["views"], figures["near"], figures["paths"]
    spot = {scene: views[scene] for scene in SCENE_TITLES}
    few = {name: time_ratio(times, SV, SM) for name, times in views.items()}
    cached_ratios = {name: times[SV]["kept"]["ms"] / times[SV]["redrawn"]["ms"] for name, times in views.items()}
    volume_shares = {name: times[SV]["redrawn"]["stages"]["volumes"] / times[SV]["redrawn"]["ms"] for name, times in views.items()}
    worst = max(times[SV]["wrong_cast"] for path in paths.values() for times in path)
    close = {name: time_ratio(times, HYBRID, SV) for name, times in near.items()} | {
        f"boxgrid{sun}, main": time_ratio(views[f"boxgrid{sun}"], HYBRID, SV) for sun in LIGHT_BY_SUFFIX
    }
    ceiling = {f"room{sun}": time_ratio(views[f"room{sun}"], HYBRID, SV) for sun in LIGHT_BY_SUFFIX}
    outdoors = {name: times[PSM]["wrong_cast"] / times[SM]["wrong_cast"] for name, times in figures["outdoors"].items()}
    no_better = "; ".join(
        f"in {name} {format_whole_percent(times[PSM]['on_foliage'])} of what PSM gets wrong lies on trees, and its texels cover "
        f"{times[PSM]['texel_px']:.1f} pixels where it is wrong, SM's {times[SM]['texel_px']:.1f} where that is"
        for name, times in figures["outdoors"].items()
        if outdoors[name] * DRAW_FACTOR >= 1.0
    )
    inside = {scene: path[len(path) // 2] for scene, path in paths.items()} | {
        f"{scene}_sun": times for scene, times in figures["sun"].items()
    }
    gained = {name: times[PSM]["wrong_cast"] / times[SM]["wrong_cast"] for name, times in inside.items()}
    worse = [name for name, value in {**gained, **outdoors}.items() if value > 1.0]
    edges = {view: {scene: times["edge_p95"] for scene, times in by_scene.items()} for view, by_scene in figures["from"].items()}
    fastest = {
        scene: min(THESIS_ALGORITHMS, key=lambda key, times=times: times[key]["redrawn"]["ms"]) for scene, times in spot.items()
    }
    best = [scene for scene, key in fastest.items() if inside[scene][key]["wrong_cast"] <= MAX_ZERO_ERROR_SHARE]
    definite = len(set(fastest.values())) == 1 and len(best) == len(fastest)
    afar = all_of(edges["overview"][scene] <= edges["close"][scene] for scene in SCENE_TITLES)
    outdoor = all_of(at_most(value, 1.0) for value in outdoors.values())
    often_worse = len(worse) >= MIN_WORSE_VIEWS
    few_pay = all_of(
        at_most(few[f"street{sun}"], min(few[f"{scene}{sun}"] for scene in SCENE_TITLES if scene != "street"))
        for sun in LIGHT_BY_SUFFIX
    )
    saves_time = at_most(max(cached_ratios.values()), MAX_CACHED_TIME_RATIO)
    right = at_most(worst, MAX_ZERO_ERROR_SHARE)
    complex_ = all_of((all(value < DRAW_FACTOR for value in close.values()), at_most(float(np.median([*close.values()])), 1.0)))
    room = all_of(at_most(value, 1.0) for value in ceiling.values())
    return Section(
        "The advice (table 1, section 8.2)",
        "Figures of the experiments above. In addition: BoxGrid seen from within the shadow and from close by, and errors in "
        f"{ERROR_SIZE_PX[0]} x {ERROR_SIZE_PX[1]} (outdoors {OUTDOOR_SIZE_PX[0]} x {OUTDOOR_SIZE_PX[1]}) with maps of 1024 for "
        "both SM and "
        "PSM.",
        [],
        [
            Claim(
                f"{THESIS}, 8.2",
                "SM where the camera never gets near a shadow's edge",
                f"`edge_p95`, pixels, from afar: {format_by_scene(edges['overview'])}; from close by: "
                f"{format_by_scene(edges['close'])} (held if "
                "nowhere larger from afar)",
                afar,
                choose_reason(
                    afar,
                    "the same texel is fewer pixels from afar",
                    "what is off is counted in pixels; where casters are thinner than texels whole bars go missing, from afar as "
                    "well",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "PSM for large outdoor scenes under the sun",
                f"`wrong_cast` of PSM, of SM's: {format_by_scene(outdoors)} (held if under 1 in both)",
                outdoor,
                choose_reason(
                    outdoor,
                    "one map for kilometres gives what is near a handful of texels; PSM gives them where the eye is",
                    f"texels near the eye do not help where shadows are fine far away: {no_better}",
                    f"texels near the eye help little where shadows are fine far away: {no_better}",
                ),
            ),
            Claim(
                f"{THESIS}, 8.1 and 8.2",
                "in many cases PSM is worse than SM at the same size",
                f"worse in {len(worse)} of {len(gained) + len(outdoors)} views (held from {MIN_WORSE_VIEWS} on); `wrong_cast` of "
                f"PSM, of SM's: {format_by_scene(gained)}, and those above",
                often_worse,
                choose_reason(
                    often_worse,
                    "its matrix does not suit these views",
                    "the matrix is chosen among several by the texels that it gives to what is seen, a uniform one among them, "
                    "and is fitted to that alone: it is seldom worse than a map that has to cover the light's cone, or what the "
                    "sun sees",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "SV where polygons are few: Street is its best scene",
                f"time of SV, of SM's: {format_by_scene(few)} (held if least in Street under either light)",
                few_pay,
                choose_reason(few_pay, "few faces to draw", "not polygons but how often volumes cover a pixel is what SV costs"),
            ),
            Claim(
                f"{THESIS}, 8.1 and 8.2",
                "SV gets considerably faster where light and objects rest",
                f"time with volumes kept, of that with all redrawn: {format_by_scene(cached_ratios)} (held if at most "
                f"{MAX_CACHED_TIME_RATIO} everywhere)",
                saves_time,
                choose_reason(
                    saves_time,
                    "making the volumes was most of it",
                    f"making the volumes is {format_whole_percent(min(volume_shares.values()))} to "
                    f"{format_whole_percent(max(volume_shares.values()))} of the time, drawing them the rest, and that is to be "
                    "done "
                    "again whenever the camera moves, as the thesis says itself",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "SV where perfect shadows are crucial",
                f"its largest `wrong_cast` in {sum(map(len, paths.values()))} views: {format_percent(worst)} (held if at most "
                f"{format_percent(MAX_ZERO_ERROR_SHARE)})",
                right,
                choose_reason(right, "edges are exact, and no texel is involved", "what is wrong lies within rounding of an edge"),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "the hybrid where shadows are complex and the camera comes close: BoxGrid",
                (
                    f"time of the hybrid, of SV's: {format_by_scene(close)} (held if the median "
                    f"is under 1 and none over {DRAW_FACTOR})"
                ),
                complex_,
                choose_reason(
                    complex_,
                    "what it leaves out would be filled many times over",
                    "seen so close, most of what covers the picture is culled by tiles for SV too, and map and mask are not for "
                    "free",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "the hybrid where light comes through a complex ceiling: Room",
                f"time of the hybrid, of SV's: {format_by_scene(ceiling)} (held if under 1 under either light)",
                room,
                choose_reason(
                    room,
                    "volumes fill the room",
                    "the lattice's fine shadows leave "
                    f"{format_whole_percent(min(views[f'room{sun}'][HYBRID]['marked'] for sun in LIGHT_BY_SUFFIX))} or more of "
                    "the pixels to "
                    "volumes, all over the picture; the thesis grades it below SV in its own room, too",
                    "what the mask saves is about what map and mask cost: the lattice's fine shadows lie all over the picture",
                ),
            ),
            Claim(
                f"{THESIS}, 8.1",
                "there is no definite winner",
                "fastest under the spot: "
                f"{', '.join(f'{SCENE_TITLES[scene]} {ABBREVIATIONS[key]}' for scene, key in fastest.items())}; it is "
                f"also right (at most {format_percent(MAX_ZERO_ERROR_SHARE)} of the cast shadow wrong) in "
                f"{join_scene_names(best)} (held "
                "unless one is both everywhere)",
                not definite,
                choose_reason(
                    not definite,
                    "speed and accuracy are bought from one another: hence the choice by figures",
                    "one is both fastest and right everywhere",
                ),
            ),
        ],
    )
