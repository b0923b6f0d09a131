"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005): replication of its times, and of its use of the stencil buffer.

`benchmarks/seeds` runs it as the experiments ``stages`` (figure 47, section 7.1 and the statements on frames in chapter 2) and
``stencil`` (figure 22).
"""

from __future__ import annotations

import numpy as np

from benchmarks.algorithms import COMPARED_VARIANTS
from benchmarks.benchmark_views import benchmark_view, make_plans
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.times import (
    LIGHT_BY_SUFFIX,
    REPEATS,
    SIZE_PX,
    STAGE_NAMES,
    interleaved_times,
    measure_times,
    median_times,
    time_ratio,
)
from benchmarks.seeds.verdicts import (
    ABBREVIATIONS,
    DRAW_FACTOR,
    DRAW_TEXT,
    HYBRID,
    PSM,
    SCENE_TITLES,
    SM,
    SV,
    THESIS,
    THESIS_ALGORITHMS,
    ClaimVerdict,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_by_scene,
    format_percent,
    format_ratio,
    format_whole_percent,
    join_scene_names,
    scene_title,
)
from benchmarks.seeds.views import bundled_scene
from skugga.selector.planner.planner import make_plan
from skugga.shadows.plan import Plan
from skugga.shadows.render import render_frame
from skugga.terrain.cache import clear_caches
from skugga.terrain.describe import describe

HALF_SIZE_PX = 640, 512
STENCIL_REPEATS, FRAME_REPEATS = 7, 4
"""Number of timed turns of the ways of counting, and of whole frames."""
MAP_SIZES = 256, 1024
"""Texels a side of the smaller and the larger shadow map of whole frames."""
THESIS_GROWTH = 260.0 / 200.0
"""Ratio of the thesis's frame times with the larger and the smaller map of ``MAP_SIZES``."""

THESIS_MAP_SHARE_RANGE = 0.25, 0.45
"""Range of the shadow map's share of a frame that counts as about 35 %, the thesis's figure."""

MAX_SLIGHTLY_SLOWER_RATIO = 1.5
"""Largest ratio of two times that counts as "a little slower"."""

MIN_EQUAL_RATIO = 0.8
"""Smallest ratio of two times that count as about equal."""

MAX_INDEPENDENT_RATIO = 1.25
"""A time does not depend on the number of pixels if four times the pixels increase it by at most this ratio."""

STENCIL_LEVELS = "water_tower", "water_tower_sun", "boxgrid"
"""Bundled levels of the experiment ``stencil``, without their prefix ``thesis_``."""


def measure_times_by_picture_size(level: str) -> Figures:
    """Return times in a level's main view by algorithm and picture size: full size, and a quarter of the pixels."""
    runs = {}
    for size in (SIZE_PX, HALF_SIZE_PX):
        timed_view = benchmark_view(level, "main", size)
        plans = make_plans(timed_view, {key: COMPARED_VARIANTS[key] for key in THESIS_ALGORITHMS})
        runs |= {f"{key} {size[0]}": (timed_view, plan) for key, plan in plans.items()}
    return median_times(runs, REPEATS)


def measure_whole_frames(level: str) -> Figures:
    """Return median milliseconds of whole frames, and the share that drawing the shadow map takes.

    Frames are drawn without shadows, and with a redrawn map for each of ``MAP_SIZES``.
    """
    scene = bundled_scene(level)
    view = scene.view("main", size=SIZE_PX)
    descriptor = describe(scene, view, "main")
    variants = {"none": {"algorithm": "none"}} | {str(size): COMPARED_VARIANTS[SM] | {"map_size": size} for size in MAP_SIZES}
    plans = {key: make_plan(descriptor, scene.loaded.level, overrides) for key, overrides in variants.items()}

    def depth_map_ms(plan: Plan) -> float:
        clear_caches("light")
        return sum(record.ms for record in render_frame(scene, view, plan).passes if record.name.endswith("depth map"))

    runs_by_key = interleaved_times({key: lambda plan=plan: depth_map_ms(plan) for key, plan in plans.items()}, FRAME_REPEATS)
    medians_ms = {key: np.median(np.array(runs), axis=0) for key, runs in runs_by_key.items()}
    return {key: {"ms": float(whole_ms), "map": float(map_ms / whole_ms)} for key, (whole_ms, map_ms) in medians_ms.items()}


def measure_stages() -> Figures:
    """Measure the times of the four algorithms by stage, by picture size, and as a share of whole frames."""
    return {
        "views": {
            f"{scene}{sun}": measure_times(f"thesis_{scene}{sun}", "main") for sun in LIGHT_BY_SUFFIX for scene in SCENE_TITLES
        },
        "sizes": measure_times_by_picture_size("thesis_water_tower"),
        "frames": measure_whole_frames("thesis_water_tower"),
    }


def measure_stencil() -> Figures:
    """Measure the times of shadow volumes with one and with two passes of the stencil buffer."""
    methods = SV, "two passes"
    return {"levels": {level: measure_times(f"thesis_{level}", "main", methods, STENCIL_REPEATS) for level in STENCIL_LEVELS}}


def make_stages_section(figures: Figures) -> Section:
    """Format the claims on times, and the tables of stages under both lights."""
    tables, claims = [], []
    for sun, light in LIGHT_BY_SUFFIX.items():
        views = {scene: figures["views"][f"{scene}{sun}"] for scene in SCENE_TITLES}
        rows = [_stage_row(scene, key, times) for scene, times in views.items() for key in THESIS_ALGORITHMS]
        tables.append((f"Under {light}: times of shadow_map, and the shares of the stages", rows))
        claims += _timing_claims(views, light)
    return Section(
        "Times of the four algorithms (figure 47)",
        f"The five scenes in their main views, {SIZE_PX[0]} x {SIZE_PX[1]}, maps of 1024 (the hybrid has its own size), "
        "everything made "
        f"anew for each frame, medians of {REPEATS} turns. Our passes correspond to the thesis's stages like this. *map*: placing "
        "the map and drawing the scene from the light. *look-up*: rendering with the map; in the hybrid, finding the silhouette "
        "pixels. *volumes*: finding silhouettes and building volumes. *counting*: drawing volumes into the stencil. *between*: "
        "time outside of all passes; in the hybrid mainly finding which points lie on lit faces of casters. The thesis's times "
        f"include drawing the scene, ours are the shadow alone. Times within {format_whole_percent(DRAW_FACTOR - 1.0)} count as "
        "the same: "
        "a draw.",
        tables,
        [*claims, *_size_claims(figures["sizes"]), *_frame_claims(figures["frames"])],
    )


def _stage_row(scene: str, key: str, times: Figures) -> dict[str, str]:
    """Return a table row: an algorithm's time relative to ``shadow_map``, and the shares of its stages in its time.

    ``key`` is the algorithm. ``times`` are those of ``measure_times`` in the scene.
    """
    stages = times[key]["redrawn"]["stages"]
    total_ms = sum(stages.values())
    cells = {
        name: format_whole_percent(stages[name] / total_ms) if stages[name] / total_ms >= 0.005 else "" for name in STAGE_NAMES
    }
    return {"scene": SCENE_TITLES[scene], "algorithm": key, "of shadow_map": f"{time_ratio(times, key, SM):.2f}", **cells}


def _timing_claims(views: Figures, light: str) -> list[Claim]:
    """Return the claims on times under one light. ``views`` has the times by scene; ``light`` is a value of ``LIGHT_BY_SUFFIX``."""

    def time_ratios(algorithm: str, other: str) -> dict[str, float]:
        return {scene: time_ratio(scene_times, algorithm, other) for scene, scene_times in views.items()}

    def stage_ms(times: Figures, key: str, *stages: str) -> float:
        return sum(times[key]["redrawn"]["stages"][name] for name in stages)

    def median_share(key: str, stage: str) -> str:
        return format_whole_percent(
            float(
                np.median([stage_ms(scene_times, key, stage) / scene_times[key]["redrawn"]["ms"] for scene_times in views.values()])
            )
        )

    def claim(statement: str, finding: str, verdict: ClaimVerdict, reason_text: str) -> Claim:
        return Claim(f"{THESIS}, 7.1, {light}", statement, finding, verdict, reason_text)

    fastest_other = {
        scene: min(time_ratio(scene_times, key, SM) for key in THESIS_ALGORITHMS[1:]) for scene, scene_times in views.items()
    }
    psm_ratios, volume_ratios, hybrid_ratios = time_ratios(PSM, SM), time_ratios(SV, PSM), time_ratios(HYBRID, SV)
    lookup_ratio = float(
        np.median([stage_ms(scene_times, PSM, "look-up") / stage_ms(scene_times, SM, "look-up") for scene_times in views.values()])
    )
    stage_text = (
        f"making the map is {median_share(SM, 'map')} of SM's time (medians) and {median_share(PSM, 'map')} of PSM's; PSM's "
        f"look-up takes {format_ratio(lookup_ratio)} times as long as SM's"
    )
    if light == "the spot" and lookup_ratio * DRAW_FACTOR < 1.0:
        stage_text += (
            ": a spot's map tests the triangle anew for each tap, a perspective map works it out once for each pixel, and it "
            "alone leaves out what is turned away from the light"
        )
    hybrid_volume_ratios = {
        scene: stage_ms(scene_times, HYBRID, "volumes", "counting") / stage_ms(scene_times, SV, "volumes", "counting")
        for scene, scene_times in views.items()
    }
    slower_scenes = [scene for scene in views if hybrid_ratios[scene] > DRAW_FACTOR]
    volume_only_ratios = {
        scene: stage_ms(views[scene], HYBRID, "volumes", "counting") / views[scene][SV]["redrawn"]["ms"] for scene in slower_scenes
    }
    ratios_to_slowest = {
        scene: time_ratio(
            scene_times, HYBRID, max((SM, PSM, SV), key=lambda key, scene_times=scene_times: time_ratio(scene_times, key, SM))
        )
        for scene, scene_times in views.items()
    }
    slowest_by_scene = {
        scene: max(THESIS_ALGORITHMS, key=lambda key, scene_times=scene_times: time_ratio(scene_times, key, SM))
        for scene, scene_times in views.items()
    }
    sm_is_fastest = all_of(at_least(value, 1.0) for value in fastest_other.values())
    psm_is_near = all_of(all_of((at_least(value, 1.0), at_most(value, MAX_SLIGHTLY_SLOWER_RATIO))) for value in psm_ratios.values())
    sv_wins_street_only = all_of(
        at_most(value, 1.0) if scene == "street" else at_least(value, 1.0) for scene, value in volume_ratios.items()
    )
    hybrid_wins_boxgrid_only = all_of(
        at_most(value, 1.0) if scene == "boxgrid" else at_least(value, 1.0) for scene, value in hybrid_ratios.items()
    )
    hybrid_volumes_are_cheaper = all_of(
        at_most(value, 1.0) if scene in ("boxgrid", "water_tower") else MIN_EQUAL_RATIO <= value <= 1.0 / MIN_EQUAL_RATIO
        for scene, value in hybrid_volume_ratios.items()
    )
    map_is_cause = all_of(at_most(value, 1.0) for value in volume_only_ratios.values()) if slower_scenes else None
    hybrid_is_slowest = all_of(at_least(ratios_to_slowest[scene], 1.0) for scene in ("rocks", "street"))
    return [
        claim(
            "SM is the fastest everywhere",
            f"time of the fastest other, of SM's: {format_by_scene(fastest_other)} (held if over 1 everywhere)",
            sm_is_fastest,
            choose_reason(
                sm_is_fastest, "a look-up is one pass over the pixels, whatever casts", stage_text, f"{DRAW_TEXT}: {stage_text}"
            ),
        ),
        claim(
            "PSM is a little behind SM in all scenes",
            f"time of PSM, of SM's: {format_by_scene(psm_ratios)} (held if over 1 and at most {MAX_SLIGHTLY_SLOWER_RATIO:g} "
            "everywhere)",
            psm_is_near,
            choose_reason(psm_is_near, stage_text, stage_text, f"{DRAW_TEXT}: {stage_text}"),
        ),
        claim(
            "SV beats PSM in Street, and only there",
            f"time of SV, of PSM's: {format_by_scene(volume_ratios)} (held if under 1 in Street, over 1 elsewhere)",
            sv_wins_street_only,
            choose_reason(
                sv_wins_street_only,
                "Street's volumes have few faces, which draw in less time than pixels are looked up",
                "beside Street there are scenes in which volumes cover little of the picture"
                if volume_ratios["street"] * DRAW_FACTOR <= 1.0
                else "what SV costs with few faces is the same for all scenes: depths are drawn, the stencil is read back; next to "
                "that PSM's look-up is cheap enough",
            ),
        ),
        claim(
            "SV beats the hybrid in all scenes but BoxGrid",
            f"time of the hybrid, of SV's: {format_by_scene(hybrid_ratios)} (held if under 1 in BoxGrid, over 1 elsewhere)",
            hybrid_wins_boxgrid_only,
            choose_reason(
                hybrid_wins_boxgrid_only,
                "only there volumes cover the picture so often that leaving them out pays for map and mask",
                "what the hybrid leaves out would be filled by the processor here, which fills slowly: that pays for map and "
                f"mask in {join_scene_names([scene for scene, value in hybrid_ratios.items() if value * DRAW_FACTOR <= 1.0])}",
            ),
        ),
        claim(
            "the volumes alone (made and drawn) are cheaper in the hybrid in BoxGrid and Water Tower, about as dear elsewhere",
            f"time of the hybrid's volumes and counting, of SV's: {format_by_scene(hybrid_volume_ratios)} (held if under 1 in "
            "these two, and within a "
            f"factor of {1.0 / MIN_EQUAL_RATIO:g} elsewhere)",
            hybrid_volumes_are_cheaper,
            choose_reason(
                hybrid_volumes_are_cheaper,
                "shadow upon shadow is what the mask saves",
                "they are drawn in rectangles of marked tiles alone, with the faces that matter there: so the hybrid saves in "
                "proportion to what it leaves to its map, in plain scenes too",
            ),
        ),
        claim(
            "where the hybrid is slower, it is for its map and its search for silhouette pixels",
            f"its volumes and counting alone, of SV's whole time, where it is slower: {format_by_scene(volume_only_ratios)} "
            "(held if under 1 everywhere)"
            if slower_scenes
            else "it is slower nowhere",
            map_is_cause,
            choose_reason(
                map_is_cause,
                "with all that makes its map and its mask taken off it would not be slower",
                "what it draws of its volumes is no less than all of them",
                DRAW_TEXT if slower_scenes else "nothing to explain",
            ),
        ),
        claim(
            "the hybrid is the slowest of the four where shadows are plain (Rocks, Street)",
            f"time of the hybrid, of the slowest other's: {format_by_scene(ratios_to_slowest)} (held if over 1 in these two); "
            "slowest: "
            f"{', '.join(f'{SCENE_TITLES[scene]} {ABBREVIATIONS[key]}' for scene, key in slowest_by_scene.items())}",
            hybrid_is_slowest,
            choose_reason(
                hybrid_is_slowest,
                "map and mask come on top of volumes that cost little",
                "where SV is slower, what the hybrid's map decides saves more than map and mask cost; where SM is, its look-up "
                "costs more than few volumes",
            ),
        ),
    ]


def _size_claims(sizes: Figures) -> list[Claim]:
    """Return the claims on the number of pixels. ``sizes`` is the result of ``measure_times_by_picture_size``."""
    size_ratios = {
        key: sizes[f"{key} {SIZE_PX[0]}"]["redrawn"]["ms"] / sizes[f"{key} {HALF_SIZE_PX[0]}"]["redrawn"]["ms"]
        for key in THESIS_ALGORITHMS
    }
    ratios_text = ", ".join(f"{ABBREVIATIONS[key]} {value:.1f}" for key, value in size_ratios.items())
    finding = f"times with four times the pixels, of those before (Water Tower, the spot): {ratios_text}"
    maps_are_independent, hybrid_grows_less = (
        at_most(max(size_ratios[SM], size_ratios[PSM]), MAX_INDEPENDENT_RATIO),
        at_most(size_ratios[HYBRID], size_ratios[SV]),
    )
    return [
        Claim(
            f"{THESIS}, 7.1",
            "SM and PSM do not depend on the screen's resolution",
            f"{finding} (held if at most {MAX_INDEPENDENT_RATIO:g} for both)",
            maps_are_independent,
            choose_reason(
                maps_are_independent,
                "the map costs most",
                "every pixel is looked up, and on a processor pixels are what costs; only the map itself does not depend on them",
            ),
        ),
        Claim(
            f"{THESIS}, 7.1",
            "a higher resolution hits the hybrid less than SV",
            f"{finding} (held if less for the hybrid)",
            hybrid_grows_less,
            choose_reason(
                hybrid_grows_less,
                "its map stays as it is, and marked pixels grow with the length of edges",
                "what is common to both, depths and the read-back of the stencil, grows with the pixels and outweighs what is "
                "left out",
            ),
        ),
    ]


def _frame_claims(frames: Figures) -> list[Claim]:
    """Return the claims on whole frames. ``frames`` is the result of ``measure_whole_frames``."""
    small, large = (frames[str(size)] for size in MAP_SIZES)
    frame_ratio = large["ms"] / small["ms"]
    half_as_steep = 1.0 + (THESIS_GROWTH - 1.0) / 2.0
    map_share_agrees = all_of((at_least(large["map"], THESIS_MAP_SHARE_RANGE[0]), at_most(large["map"], THESIS_MAP_SHARE_RANGE[1])))
    grows_enough = at_least(frame_ratio, half_as_steep)
    return [
        Claim(
            f"{THESIS}, 2.1 and 2.2.10",
            "making the map takes 45 % of a frame by copying, 35 % when drawn into a texture",
            f"drawn into a texture {format_percent(large['map'])} of a finished frame (Water Tower, the spot, a map of "
            f"{MAP_SIZES[1]}; "
            f"held from {format_whole_percent(THESIS_MAP_SHARE_RANGE[0])} to {format_whole_percent(THESIS_MAP_SHARE_RANGE[1])})",
            map_share_agrees,
            choose_reason(
                map_share_agrees,
                "the share is much the same",
                "depths alone are drawn, with no pixel of the picture shaded; a frame's time goes with its pixels, on which a "
                "processor works where a graphics card of 2005 hardly felt them",
            ),
        ),
        Claim(
            f"{THESIS}, 2.2",
            f"a map of {MAP_SIZES[1]} instead of {MAP_SIZES[0]} makes a frame {format_ratio(THESIS_GROWTH)} times as long (260 "
            "against "
            "200 frames a second)",
            f"{format_ratio(frame_ratio)} times as long (held from half that growth on, {format_ratio(half_as_steep)}); a frame "
            "with "
            "the smaller "
            f"one takes {format_ratio(small['ms'] / frames['none']['ms'])} times one without shadows",
            grows_enough,
            choose_reason(
                grows_enough,
                "texels cost",
                "texels are a small part of the frame: there are as many pixels to look up, whatever the map",
            ),
        ),
    ]


def make_stencil_section(figures: Figures) -> Section:
    """Format the claim on one and two passes of the stencil buffer, and the table of time ratios."""
    rows = [
        {
            "scene": scene_title(level),
            **{mode: f"{time_ratio(level_times, 'two passes', SV, mode):.2f}" for mode in ("redrawn", "kept")},
            "counting alone": f"{_counting_ms(level_times, 'two passes') / _counting_ms(level_times, SV):.2f}",
        }
        for level, level_times in ((level, figures["levels"][level]) for level in STENCIL_LEVELS)
    ]
    tower = figures["levels"]["water_tower"]
    one_pass_is_faster = all_of(at_least(time_ratio(tower, "two passes", SV, mode), 1.0) for mode in ("redrawn", "kept"))
    saved_text = "each face is sent, transformed and clipped once instead of twice"
    times_text = (
        "two passes draw the same pixels in all: each face is filled once, and dropped once before it is filled. What is saved "
        "is transforming corners a second time, which is little beside filling and reading the stencil back"
    )
    return Section(
        "One- and two-sided stencil (figure 22)",
        f"Time of shadow volumes with `stencil: two_pass`, relative to `one_pass`; main views, {SIZE_PX[0]} x {SIZE_PX[1]}, "
        "medians of "
        f"{STENCIL_REPEATS} turns. The thesis's scene is its water tower.",
        [("Two passes, of one", rows)],
        [
            Claim(
                f"{THESIS}, 3.2.6",
                "counting both sides in one pass is noticeably faster than in two",
                f"two passes take {format_ratio(time_ratio(tower, 'two passes', SV))} times as long in the water tower, "
                f"{format_ratio(time_ratio(tower, 'two passes', SV, 'kept'))} with the volumes kept (held if over 1, both times)",
                one_pass_is_faster,
                choose_reason(one_pass_is_faster, saved_text, times_text, f"{DRAW_TEXT}: {times_text}"),
            )
        ],
    )


def _counting_ms(times: Figures, key: str) -> float:
    """Return the milliseconds of the stage ``counting`` of the algorithm ``key``, with everything redrawn."""
    return times[key]["redrawn"]["stages"]["counting"]
