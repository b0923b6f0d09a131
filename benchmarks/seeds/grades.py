"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005): replication of its grades (table 2).

Errors are those against ray-traced truth (``skugga.shadows.truth.metrics``).
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import permutations

import numpy as np
from scipy.stats import spearmanr

from benchmarks.algorithms import COMPARED_VARIANTS
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.times import LIGHT_BY_SUFFIX, measure_times, time_ratio
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
    at_least,
    at_most,
    choose_reason,
    format_percent,
    format_whole_percent,
    negate,
)
from benchmarks.seeds.views import ViewWithTruth, bundled_scene, trace_view_truth
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.geo.camera import PerspectiveView

ERROR_SIZE_PX = (640, 512)

CAMERA_MOVES = (-0.04, -0.02, 0.0, 0.02, 0.04)
"""Small moves of the camera to its right, as a share of the median distance of the visible points."""

MAX_ZERO_ERROR_SHARE = 0.001
"""Errors up to this share of the cast shadow, or of the decidable pixels, count as zero."""

MIN_RANK_CORRELATION = 0.5
"""Minimum rank correlation that counts as agreement."""

GRADES: dict[str, dict[str, tuple[int, int, int]]] = {
    SM: {"boxgrid": (5, 2, 4), "rocks": (5, 3, 5), "street": (5, 2, 5), "room": (5, 4, 4), "water_tower": (5, 1, 5)},
    PSM: {"boxgrid": (4, 3, 2), "rocks": (3, 3, 2), "street": (5, 2, 3), "room": (4, 2, 2), "water_tower": (4, 3, 2)},
    SV: {"boxgrid": (1, 5, 5), "rocks": (2, 5, 5), "street": (5, 5, 5), "room": (3, 5, 5), "water_tower": (3, 5, 5)},
    HYBRID: {"boxgrid": (2, 4, 5), "rocks": (1, 5, 5), "street": (5, 5, 5), "room": (2, 4, 5), "water_tower": (2, 3, 5)},
}
"""The thesis's grades, 1 to 5, in speed, quality and robustness (table 2)."""


def measure_algorithm_errors(truth_view: ViewWithTruth, algorithms: tuple[str, ...] = THESIS_ALGORITHMS) -> Figures:
    """Return errors by algorithm (a key of ``COMPARED_VARIANTS``), with two figures on the wrong pixels.

    ``on_foliage`` is the share of wrong pixels on foliage. ``texel_px`` is the median size of a shadow map texel at wrong pixels.
    """
    result: Figures = {}
    for key in algorithms:
        plan = truth_view.plan(COMPARED_VARIANTS[key])
        visibility, texels_px = truth_view.visibility(plan), truth_view.texels_px(plan)
        figures = truth_view.errors(visibility, texels_px)
        wrong_pixels = (
            truth_view.truth.decidable & ~truth_view.truth.attached_shadow_mask & ((visibility < 0.5) == truth_view.truth.lit)
        )
        result[key] = {name: figures[name] for name in ("wrong_cast", "edge_p95", "interior")}
        result[key]["on_foliage"] = (
            float((truth_view.buffer.surface_kind[wrong_pixels] == FOREST).mean()) if wrong_pixels.any() else 0.0
        )
        result[key]["texel_px"] = float(np.median(texels_px[wrong_pixels])) if wrong_pixels.any() else 0.0
    return result


@cache
def measure_errors_by_camera_move(level: str) -> list[Figures]:
    """Return the errors in a level's main view from several camera positions.

    The camera moves to its right by each of ``CAMERA_MOVES``, shares of the median distance of the visible points.
    """
    scene = bundled_scene(level)
    view = scene.view("main", size=ERROR_SIZE_PX)
    assert isinstance(view, PerspectiveView)
    aside_m = describe(scene, view, "main").pixel_m / view.pixel_tangent * view.earth_from_camera[:, 0]
    moved_views = [replace(view, eye_earth_m=view.eye_earth_m + move * aside_m) for move in CAMERA_MOVES]
    return [measure_algorithm_errors(trace_view_truth(scene, moved_view, "main")) for moved_view in moved_views]


def measure() -> Figures:
    """Measure times and errors of the four algorithms in all scenes, for comparison with the thesis's grades."""
    return {
        "paths": {scene: measure_errors_by_camera_move(f"thesis_{scene}") for scene in SCENE_TITLES},
        "times": {
            f"{scene}{sun}": measure_times(f"thesis_{scene}{sun}", "main") for sun in LIGHT_BY_SUFFIX for scene in SCENE_TITLES
        },
    }


def _figures_by_column(figures: Figures) -> dict[str, dict[tuple[str, str], float]]:
    """Return for each column of the thesis's grades the figures to compare it with, by scene and algorithm. Smaller is better."""
    paths, pairs = figures["paths"], [(scene, key) for scene in SCENE_TITLES for key in THESIS_ALGORITHMS]

    def errors_of(scene: str, key: str, name: str) -> list[float]:
        return [move_errors[key][name] for move_errors in paths[scene]]

    return {
        "speed": {(scene, key): time_ratio(figures["times"][scene], key, SM) for scene, key in pairs},
        "speed_sun": {(scene, key): time_ratio(figures["times"][f"{scene}_sun"], key, SM) for scene, key in pairs},
        "wrong_cast": {(scene, key): float(np.mean(errors_of(scene, key, "wrong_cast"))) for scene, key in pairs},
        "edge_p95": {(scene, key): float(np.mean(errors_of(scene, key, "edge_p95"))) for scene, key in pairs},
        "robustness": {
            (scene, key): max(errors_of(scene, key, "interior")) + float(np.ptp(errors_of(scene, key, "wrong_cast")))
            for scene, key in pairs
        },
    }


GRADE_INDEX_BY_COLUMN = {"speed": 0, "speed_sun": 0, "wrong_cast": 1, "edge_p95": 1, "robustness": 2}
"""Index of the grade with which each measured figure is compared."""


SAME_ORDER_REASON = "the order of the grades is that of the figures, by and large"
CLOSE_RANKS_REASON = "edges are within a pixel or two for all of them, so that ranks go by little"
HYBRID_SAVES_REASON = "the hybrid saves more of its volumes than it did then"
COARSE_PSM_REASON = "texels of PSM are coarse far away"

REASONS_BY_COLUMN: dict[str, dict[str, str]] = {
    "speed": {
        "SM": "SM's map costs less to make than PSM's",
        "PSM": "SM's look-up tests the triangle anew for each tap of a spot's map, PSM works it out once for each pixel",
        "SV": "few volumes cost less than SM's look-up",
        "hybrid": HYBRID_SAVES_REASON,
    },
    "speed_sun": {
        "SM": "SM's map costs less to make than PSM's",
        "PSM": "under the sun the look-ups of SM and PSM cost much the same",
        "SV": "few volumes cost less than a look-up",
        "hybrid": HYBRID_SAVES_REASON,
    },
    "wrong_cast": {
        "SM": COARSE_PSM_REASON,
        "PSM": "PSM, fitted to all that is seen, is finer than SM",
        "SV": "volumes are exact",
        "hybrid": "the hybrid is as right as SV, since its mask marks what its map does not prove",
    },
    "edge_p95": dict.fromkeys(ABBREVIATIONS.values(), CLOSE_RANKS_REASON),
    "robustness": {
        "SM": COARSE_PSM_REASON,
        "PSM": "PSM errs and changes about as little as SM",
        "SV": "volumes hardly change with the camera",
        "hybrid": "the hybrid is as right as SV",
    },
}
"""Reasons for differences, by column and by the algorithm that is better here than its grade."""


def rank_correlation(column: str, measured: dict[tuple[str, str], float]) -> float:
    """Return Spearman's rank correlation of grades and figures: 1 if better grades always have smaller figures.

    ``column`` is a key of ``GRADE_INDEX_BY_COLUMN``. Keys of ``measured`` are scene and algorithm.
    """
    grades = [GRADES[key][scene][GRADE_INDEX_BY_COLUMN[column]] for scene, key in measured]
    return float(spearmanr(grades, np.round([-value for value in measured.values()], 4)).statistic)


def contradicted_pairs(column: str, measured: dict[tuple[str, str], float]) -> dict[str, list[str]]:
    """Return by scene the pairs of algorithms that grades and figures rank differently.

    ``column`` is a key of ``GRADE_INDEX_BY_COLUMN``. Keys of ``measured`` are scene and algorithm.
    """
    result: dict[str, list[str]] = {}
    for scene in SCENE_TITLES:
        for algorithm, other in permutations(THESIS_ALGORITHMS, 2):
            better = GRADES[algorithm][scene][GRADE_INDEX_BY_COLUMN[column]] > GRADES[other][scene][GRADE_INDEX_BY_COLUMN[column]]
            if better and measured[scene, algorithm] > measured[scene, other] * DRAW_FACTOR + (
                0.0 if GRADE_INDEX_BY_COLUMN[column] == 0 else MAX_ZERO_ERROR_SHARE
            ):
                result.setdefault(scene, []).append(f"{ABBREVIATIONS[algorithm]} before {ABBREVIATIONS[other]}")
    return result


def make_section(figures: Figures) -> Section:
    """Format the claims on the order of grades, and the tables of figures."""
    measured = _figures_by_column(figures)
    rows = []
    for scene in SCENE_TITLES:
        for key in THESIS_ALGORITHMS:
            grade = GRADES[key][scene]
            rows.append(
                {
                    "scene": SCENE_TITLES[scene],
                    "algorithm": key,
                    "grades": " / ".join(map(str, grade)),
                    "time of SM's": f"{measured['speed'][scene, key]:.2f}",
                    "under the sun": f"{measured['speed_sun'][scene, key]:.2f}",
                    "wrong_cast": format_percent(measured["wrong_cast"][scene, key]),
                    "edge_p95": f"{measured['edge_p95'][scene, key]:.1f} px",
                    "interior and change": format_percent(measured["robustness"][scene, key]),
                }
            )
    texts = {
        "speed": "grades of speed, under the spot",
        "speed_sun": "grades of speed, held against times under the sun",
        "wrong_cast": "grades of quality, held against `wrong_cast`",
        "edge_p95": "grades of quality, held against `edge_p95`",
        "robustness": "grades of robustness",
    }
    claims = []
    for column, values in measured.items():
        rho, contradictions = rank_correlation(column, values), contradicted_pairs(column, values)
        contradictions_text = (
            "; ".join(f"{SCENE_TITLES[scene]}: {', '.join(pairs)}" for scene, pairs in contradictions.items()) or "nowhere"
        )
        verdict = at_least(rho, MIN_RANK_CORRELATION)
        better_algorithms = {pair.split(" before ")[1] for pairs in contradictions.values() for pair in pairs}
        reasons = "; ".join(REASONS_BY_COLUMN[column][key] for key in ABBREVIATIONS.values() if key in better_algorithms)
        reason_text = choose_reason(
            verdict,
            SAME_ORDER_REASON,
            reasons or "the figures differ by too little to be ranked",
            f"{DRAW_TEXT}; {reasons}" if reasons else DRAW_TEXT,
        )
        if verdict and reasons:
            reason_text += f"; where it is not: {reasons}"
        finding = (
            f"rank correlation {rho:.2f} (held if at least {MIN_RANK_CORRELATION}); graded "
            f"the other way round: {contradictions_text}"
        )
        claims.append(Claim(f"{THESIS}, table 2", texts[column], finding, verdict, reason_text))
    mean = {
        key: {column: float(np.mean([values[scene, key] for scene in SCENE_TITLES])) for column, values in measured.items()}
        for key in THESIS_ALGORITHMS
    }
    least_robust_algorithm = max(THESIS_ALGORITHMS, key=lambda key: mean[key]["robustness"])
    worst_other = max(mean[key]["robustness"] for key in (SM, SV, HYBRID))
    psm_is_least_robust = at_least(mean[PSM]["robustness"], worst_other)
    quality_correlation = rank_correlation("wrong_cast", measured["wrong_cast"])
    is_untestable = negate(at_least(quality_correlation, MIN_RANK_CORRELATION))
    volumes_are_better = at_most(
        max(mean[SV]["wrong_cast"], mean[HYBRID]["wrong_cast"]), min(mean[SM]["wrong_cast"], mean[PSM]["wrong_cast"])
    )
    quality_text, robustness_text = (
        ", ".join(f"{ABBREVIATIONS[key]} {format_percent(mean[key][column])}" for key in THESIS_ALGORITHMS)
        for column in ("wrong_cast", "robustness")
    )
    hybrid_excess_error = measured["wrong_cast"]["water_tower", HYBRID] - measured["wrong_cast"]["water_tower", SV]
    hybrid_loses_thin_casters = at_least(hybrid_excess_error, MAX_ZERO_ERROR_SHARE)
    claims += [
        Claim(
            f"{THESIS}, 7.4",
            "SV and the hybrid are high in quality, SM and PSM low",
            f"mean `wrong_cast`: {quality_text} (held if both of the former are less than both of the latter)",
            volumes_are_better,
            choose_reason(
                volumes_are_better,
                "volumes decide at edges, where maps are wrong",
                "what volumes decide is no better than what maps do",
            ),
        ),
        Claim(
            f"{THESIS}, 7.4",
            "PSM is the least robust of the four",
            f"mean of interior error and change: {robustness_text} (held if PSM's is the largest)",
            psm_is_least_robust,
            choose_reason(
                psm_is_least_robust,
                "its map is another one for every place of the camera, and its texels far away are coarse",
                f"{ABBREVIATIONS[least_robust_algorithm]} is: its texels stay coarse wherever the camera is, and what they get "
                "wrong is more to "
                "begin with",
            ),
        ),
        Claim(
            f"{THESIS}, 7.2.3",
            "the hybrid loses thin casters (Water Tower) and is worse than SV there",
            f"`wrong_cast` of the hybrid less that of SV: {format_percent(hybrid_excess_error)} (held if at least "
            f"{format_percent(MAX_ZERO_ERROR_SHARE)})",
            hybrid_loses_thin_casters,
            choose_reason(
                hybrid_loses_thin_casters,
                "its map misses what is thinner than a texel",
                "the mask is conservative: what its map does not prove is left to volumes, however thin (`mask: original` misses "
                "as the thesis's does)",
            ),
        ),
        Claim(
            f"{THESIS}, 7.4",
            "an objective test of quality and robustness is almost impossible",
            f"`wrong_cast` orders the pictures as the author's eye does with a rank correlation of {quality_correlation:.2f} (held "
            "if under "
            f"{MIN_RANK_CORRELATION})",
            is_untestable,
            choose_reason(
                is_untestable,
                "the figure does not say what an eye says",
                "truth can be traced now: what is right is known for each pixel",
            ),
        ),
    ]
    return Section(
        "The grades (table 2)",
        "The thesis's subjective grades (speed / quality / robustness, 5 is best) beside figures under the same kind of light, "
        f"the spot. Speed: times as above. Quality: errors against ray-traced truth in {ERROR_SIZE_PX[0]} x {ERROR_SIZE_PX[1]}, "
        "means "
        f"over {len(CAMERA_MOVES)} places of the camera within {format_whole_percent(max(CAMERA_MOVES))} of its distance to "
        "either side. "
        "Robustness: the sum of the largest interior error on the way and the change of `wrong_cast` (largest less least). "
        f"Correlations are Spearman's over the {len(SCENE_TITLES) * len(THESIS_ALGORITHMS)} pairs of scene and algorithm; "
        f"{MIN_RANK_CORRELATION} "
        f"counts as agreement.",
        [("Grades and figures", rows)],
        claims,
    )
