"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005): replication of its advice (table 1, section 8.2)."""

from __future__ import annotations

import numpy as np

from benchmarks.benchmark_views import IN_SHADOW_VIEW
from benchmarks.contact_sheet import named_view
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.grades import ERROR_SIZE_PX, MAX_ZERO_ERROR_SHARE, measure_algorithm_errors, measure_errors_by_camera_move
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
    """Measure the figures that decide on the thesis's advice: times in main and close views, and errors of maps and volumes."""
    near_times = {
        f"boxgrid{sun}, {view}": measure_times(f"thesis_boxgrid{sun}", view, (SV, HYBRID))
        for sun in LIGHT_BY_SUFFIX
        for view in (IN_SHADOW_VIEW, "close")
    }
    return {
        "views": {
            f"{scene}{sun}": measure_times(f"thesis_{scene}{sun}", "main") for sun in LIGHT_BY_SUFFIX for scene in SCENE_TITLES
        },
        "near": near_times,
        "paths": {scene: measure_errors_by_camera_move(f"thesis_{scene}") for scene in SCENE_TITLES},
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
    """Return the errors of algorithms in a view of a bundled level, by algorithm. ``size`` is (width, height) in pixels."""
    scene = bundled_scene(level)
    return measure_algorithm_errors(trace_view_truth(scene, named_view(scene, view, size), "main"), algorithms)


def make_section(figures: Figures) -> Section:
    """Format the claims of the thesis's advice with our figures."""
    views, near_times, paths = figures["views"], figures["near"], figures["paths"]
    times_under_spot = {scene: views[scene] for scene in SCENE_TITLES}
    volume_time_ratios = {name: time_ratio(times, SV, SM) for name, times in views.items()}
    cached_ratios = {name: times[SV]["kept"]["ms"] / times[SV]["redrawn"]["ms"] for name, times in views.items()}
    volume_shares = {name: times[SV]["redrawn"]["stages"]["volumes"] / times[SV]["redrawn"]["ms"] for name, times in views.items()}
    worst_volume_error = max(errors[SV]["wrong_cast"] for path in paths.values() for errors in path)
    boxgrid_hybrid_ratios = {name: time_ratio(times, HYBRID, SV) for name, times in near_times.items()} | {
        f"boxgrid{sun}, main": time_ratio(views[f"boxgrid{sun}"], HYBRID, SV) for sun in LIGHT_BY_SUFFIX
    }
    room_hybrid_ratios = {f"room{sun}": time_ratio(views[f"room{sun}"], HYBRID, SV) for sun in LIGHT_BY_SUFFIX}
    outdoor_error_ratios = {
        name: errors[PSM]["wrong_cast"] / errors[SM]["wrong_cast"] for name, errors in figures["outdoors"].items()
    }
    outdoor_reason = "; ".join(
        f"in {name} {format_whole_percent(errors[PSM]['on_foliage'])} of what PSM gets wrong lies on trees, and its texels cover "
        f"{errors[PSM]['texel_px']:.1f} pixels where it is wrong, SM's {errors[SM]['texel_px']:.1f} where that is"
        for name, errors in figures["outdoors"].items()
        if outdoor_error_ratios[name] * DRAW_FACTOR >= 1.0
    )
    errors_by_scene = {scene: path[len(path) // 2] for scene, path in paths.items()} | {
        f"{scene}_sun": errors for scene, errors in figures["sun"].items()
    }
    psm_error_ratios = {name: errors[PSM]["wrong_cast"] / errors[SM]["wrong_cast"] for name, errors in errors_by_scene.items()}
    worse_views = [name for name, value in {**psm_error_ratios, **outdoor_error_ratios}.items() if value > 1.0]
    edge_errors_px = {
        view: {scene: errors["edge_p95"] for scene, errors in by_scene.items()} for view, by_scene in figures["from"].items()
    }
    fastest = {
        scene: min(THESIS_ALGORITHMS, key=lambda key, times=times: times[key]["redrawn"]["ms"])
        for scene, times in times_under_spot.items()
    }
    fast_and_right_scenes = [
        scene for scene, key in fastest.items() if errors_by_scene[scene][key]["wrong_cast"] <= MAX_ZERO_ERROR_SHARE
    ]
    has_winner = len(set(fastest.values())) == 1 and len(fast_and_right_scenes) == len(fastest)
    smaller_from_afar = all_of(edge_errors_px["overview"][scene] <= edge_errors_px["close"][scene] for scene in SCENE_TITLES)
    psm_suits_outdoors = all_of(at_most(value, 1.0) for value in outdoor_error_ratios.values())
    psm_often_worse = len(worse_views) >= MIN_WORSE_VIEWS
    volumes_suit_street = all_of(
        at_most(
            volume_time_ratios[f"street{sun}"],
            min(volume_time_ratios[f"{scene}{sun}"] for scene in SCENE_TITLES if scene != "street"),
        )
        for sun in LIGHT_BY_SUFFIX
    )
    caching_saves_time = at_most(max(cached_ratios.values()), MAX_CACHED_TIME_RATIO)
    volumes_are_exact = at_most(worst_volume_error, MAX_ZERO_ERROR_SHARE)
    hybrid_suits_boxgrid = all_of(
        (
            all(value < DRAW_FACTOR for value in boxgrid_hybrid_ratios.values()),
            at_most(float(np.median([*boxgrid_hybrid_ratios.values()])), 1.0),
        )
    )
    hybrid_suits_room = all_of(at_most(value, 1.0) for value in room_hybrid_ratios.values())
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
                f"`edge_p95`, pixels, from afar: {format_by_scene(edge_errors_px['overview'])}; from close by: "
                f"{format_by_scene(edge_errors_px['close'])} (held if "
                "nowhere larger from afar)",
                smaller_from_afar,
                choose_reason(
                    smaller_from_afar,
                    "the same texel is fewer pixels from afar",
                    "what is off is counted in pixels; where casters are thinner than texels whole bars go missing, from afar as "
                    "well",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "PSM for large outdoor scenes under the sun",
                f"`wrong_cast` of PSM, of SM's: {format_by_scene(outdoor_error_ratios)} (held if under 1 in both)",
                psm_suits_outdoors,
                choose_reason(
                    psm_suits_outdoors,
                    "one map for kilometres gives what is near a handful of texels; PSM gives them where the eye is",
                    f"texels near the eye do not help where shadows are fine far away: {outdoor_reason}",
                    f"texels near the eye help little where shadows are fine far away: {outdoor_reason}",
                ),
            ),
            Claim(
                f"{THESIS}, 8.1 and 8.2",
                "in many cases PSM is worse than SM at the same size",
                f"worse in {len(worse_views)} of {len(psm_error_ratios) + len(outdoor_error_ratios)} views (held from "
                f"{MIN_WORSE_VIEWS} on); `wrong_cast` of "
                f"PSM, of SM's: {format_by_scene(psm_error_ratios)}, and those above",
                psm_often_worse,
                choose_reason(
                    psm_often_worse,
                    "its matrix does not suit these views",
                    "the matrix is chosen among several by the texels that it gives to what is seen, a uniform one among them, "
                    "and is fitted to that alone: it is seldom worse than a map that has to cover the light's cone, or what the "
                    "sun sees",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "SV where polygons are few: Street is its best scene",
                f"time of SV, of SM's: {format_by_scene(volume_time_ratios)} (held if least in Street under either light)",
                volumes_suit_street,
                choose_reason(
                    volumes_suit_street, "few faces to draw", "not polygons but how often volumes cover a pixel is what SV costs"
                ),
            ),
            Claim(
                f"{THESIS}, 8.1 and 8.2",
                "SV gets considerably faster where light and objects rest",
                f"time with volumes kept, of that with all redrawn: {format_by_scene(cached_ratios)} (held if at most "
                f"{MAX_CACHED_TIME_RATIO} everywhere)",
                caching_saves_time,
                choose_reason(
                    caching_saves_time,
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
                f"its largest `wrong_cast` in {sum(map(len, paths.values()))} views: {format_percent(worst_volume_error)} (held if "
                "at most "
                f"{format_percent(MAX_ZERO_ERROR_SHARE)})",
                volumes_are_exact,
                choose_reason(
                    volumes_are_exact, "edges are exact, and no texel is involved", "what is wrong lies within rounding of an edge"
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "the hybrid where shadows are complex and the camera comes close: BoxGrid",
                (
                    f"time of the hybrid, of SV's: {format_by_scene(boxgrid_hybrid_ratios)} (held if the median "
                    f"is under 1 and none over {DRAW_FACTOR})"
                ),
                hybrid_suits_boxgrid,
                choose_reason(
                    hybrid_suits_boxgrid,
                    "what it leaves out would be filled many times over",
                    "seen so close, most of what covers the picture is culled by tiles for SV too, and map and mask are not for "
                    "free",
                ),
            ),
            Claim(
                f"{THESIS}, 8.2",
                "the hybrid where light comes through a complex ceiling: Room",
                f"time of the hybrid, of SV's: {format_by_scene(room_hybrid_ratios)} (held if under 1 under either light)",
                hybrid_suits_room,
                choose_reason(
                    hybrid_suits_room,
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
                f"{join_scene_names(fast_and_right_scenes)} (held "
                "unless one is both everywhere)",
                not has_winner,
                choose_reason(
                    not has_winner,
                    "speed and accuracy are bought from one another: hence the choice by figures",
                    "one is both fastest and right everywhere",
                ),
            ),
        ],
    )
