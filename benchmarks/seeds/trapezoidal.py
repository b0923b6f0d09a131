"""A study of trapezoidal shadow maps (Martin and Tan 2004), beside the maps that Skugga has.

All four kinds of maps have the same fit to the receivers, ranges of distance, look-up and taps. Only their matrices differ
(``benchmarks.seeds.trapezoidal_matrix``). So the figures compare the warps alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np

from benchmarks.perspective_maps import THESIS_LEVELS
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_errors, write_sheet
from benchmarks.seeds.times import interleaved_times
from benchmarks.seeds.trapezoidal_matrix import FOCUS_SHARE, trapezoidal_maps
from benchmarks.seeds.verdicts import (
    DRAW_TEXT,
    ClaimVerdict,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_percent,
    format_ratio,
    scene_title,
)
from benchmarks.seeds.views import Variant, ViewWithTruth, bundled_scene, draw_variant, view_with_truth
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps import light_space_perspective_map, perspective_shadow_map
from skugga.shadows.maps.light_space_perspective import light_space_perspectives
from skugga.shadows.maps.perspective_shadow_map import MapCandidates, perspective_maps
from skugga.shadows.maps.post_perspective import post_perspectives
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.cache import clear_caches
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.level import SUN
from skugga.terrain.level.parts import SunSpec

PAPER = "Martin and Tan 2004"

SIZE_PX = (640, 512)
MAP_SIZE = 1024
"""Texels a side of the maps."""
REPEATS = 5
"""Number of timed turns."""

VIEW_NAMES = ("main", "close")

FOCUS_SHARES = (0.05, 0.1, 0.2, 0.4, 0.6)
"""Places of the focus, as shares of the receivers' range of depths. The paper leaves the focus to the user."""

SM, PSM, LSPM, TSM = "shadow_map", "perspective_shadow_map", light_space_perspective_map.NAME, "trapezoidal"
MAP_NAMES = (SM, PSM, LSPM, TSM)
"""Names of the compared maps, in the order of the tables."""

MIN_PROMOTION_GAIN = 1.1
"""Factor by which a map must lower the median error of the better one of the two warped maps to become an algorithm."""

SUN_ALTITUDE_DEG, SUN_TURN_DEG = 28.0, 3.0
"""Altitude of the sun that goes round the view, and its turn from picture to picture."""

SHOWN_LEVEL, SHOWN_VIEW = "thesis_rocks_sun", "main"
SHOWN_CROP: CropBox = (120, 230, 400, 240)


@contextmanager
def with_matrices(find_candidates: MapCandidates) -> Iterator[None]:
    """Draw light-space perspective maps with other matrices, while the context manager is active."""
    fill = partial(perspective_shadow_map.fill_visibility, find_candidates=find_candidates)
    with patch.dict(ALGORITHMS, {LSPM: replace(ALGORITHMS[LSPM], fill_visibility=fill)}):
        yield


def trapezoidal_variant(focus_share: float, map_size: int = MAP_SIZE) -> Variant:
    """Return the variant of trapezoidal maps with the focus at a share of the receivers' range of depths."""
    matrices = partial(trapezoidal_maps, focus_share=focus_share)
    return Variant({"algorithm": LSPM, "map_size": map_size, "filter": 3}, partial(with_matrices, matrices))


def map_variants(map_size: int = MAP_SIZE) -> dict[str, Variant]:
    """Return the variants of Skugga's own maps by name."""
    overrides = {"map_size": map_size, "filter": 3}
    return {
        SM: Variant({**overrides, "algorithm": SM, "cascades": 1, "fit": "tight"}),
        PSM: Variant({**overrides, "algorithm": PSM}),
        LSPM: Variant({**overrides, "algorithm": LSPM}),
    }


def measure() -> Figures:
    """Measure errors and times of all maps in the main and close views of the thesis's levels."""
    rows = []
    for level in THESIS_LEVELS:
        scene = bundled_scene(level)
        for view in VIEW_NAMES:
            truth_view = view_with_truth(scene, view, SIZE_PX)
            variants = map_variants() | {f"{TSM} {share:g}": trapezoidal_variant(share) for share in FOCUS_SHARES}
            drawn = {name: draw_variant(truth_view, variant) for name, variant in variants.items()}
            errors = {name: result.figures["wrong_cast"] for name, result in drawn.items()}
            uniform = [name for name, result in drawn.items() if result.note.startswith("a uniform map")]
            timed = map_variants() | {TSM: trapezoidal_variant(FOCUS_SHARE)}
            row = {"view": f"{level.removeprefix('thesis_')} {view}", "wrong_cast": errors, "uniform": uniform}
            rows.append({**row, "ms": _median_ms(truth_view, timed)})
            if (level, view) == (SHOWN_LEVEL, SHOWN_VIEW):
                _write_pictures(truth_view)
    return {"rows": rows, "turns": measure_turning_sun()}


def _median_ms(truth_view: ViewWithTruth, variants: dict[str, Variant]) -> dict[str, float]:
    """Return the median milliseconds of a view's shadow by each variant. The variants take turns, without cached maps."""
    plans = {name: truth_view.plan(variant.overrides) for name, variant in variants.items()}

    def fill(name: str) -> None:
        clear_caches("light")
        with variants[name].disable_part():
            truth_view.visibility(plans[name])

    runs = interleaved_times({name: partial(fill, name) for name in variants}, REPEATS)
    return {name: float(np.median([ms for ms, _ in results])) for name, results in runs.items()}


def _write_pictures(truth_view: ViewWithTruth) -> None:
    """Write the contact sheet of all maps in a view, with their errors in colour."""
    variants = map_variants(512) | {TSM: trapezoidal_variant(FOCUS_SHARE, 512)}
    pictures = []
    for name, variant in variants.items():
        drawn = draw_variant(truth_view, variant)
        caption = f"{name}: {format_percent(drawn.figures['wrong_cast'])} wrong"
        pictures.append(CaptionedPicture(draw_errors(truth_view, drawn, SHOWN_CROP), caption))
    write_sheet("seeds-trapezoidal.webp", pictures, 2)


def measure_turning_sun() -> dict[str, list[float]]:
    """Return the texel sizes in pixels of each warped map, while the sun goes round the stone circles' main view.

    Sizes are the root mean square over the receivers. Each map is a single one: the receivers are not split.
    """
    base = bundled_scene("thesis_rocks_sun")
    view = base.view("main", size=SIZE_PX)
    buffer = geometry_buffer(base, view)
    settings = PerspectiveMapSettings(map_size=MAP_SIZE, depth_bits=24, filter=3)
    matrices: dict[str, MapCandidates] = {
        PSM: post_perspectives, LSPM: light_space_perspectives,
        TSM: partial(trapezoidal_maps, focus_share=FOCUS_SHARE),
    }  # fmt: skip
    sizes_px: dict[str, list[float]] = {name: [] for name in matrices}
    with patch.object(perspective_shadow_map, "MAX_DISTANCE_RANGES", 1):
        for azimuth_deg in np.arange(0.0, 360.0, SUN_TURN_DEG):
            scene = base.with_sun(SunSpec(azimuth=float(azimuth_deg), altitude=SUN_ALTITUDE_DEG))
            receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, SUN)
            for name, find_candidates in matrices.items():
                (fitted,) = perspective_maps(buffer, receivers, scene, SUN, settings, None, find_candidates)
                sizes_px[name].append(fitted.texel_px)
    return sizes_px


def median_ratios(figures: Figures, reference: str) -> dict[str, float]:
    """Return the median over all views of each map's error relative to that of the map ``reference``."""
    rows = figures["rows"]
    return {
        name: float(np.median([row["wrong_cast"][name] / max(row["wrong_cast"][reference], 1e-6) for row in rows]))
        for name in rows[0]["wrong_cast"]
    }


def best_focus_share(figures: Figures) -> float:
    """Return the focus whose maps have the least median error relative to perspective shadow maps."""
    ratios = median_ratios(figures, PSM)
    return min(FOCUS_SHARES, key=lambda share: ratios[f"{TSM} {share:g}"])


def largest_change(sizes: list[float]) -> float:
    """Return the largest factor between successive values of a closed sequence of sizes."""
    logarithms = np.log(np.asarray(sizes))
    return float(np.exp(np.abs(np.diff(np.append(logarithms, logarithms[0]))).max()))


def promotion_verdict(figures: Figures) -> ClaimVerdict:
    """Return whether the trapezoidal map should become an algorithm; ``None`` for a draw.

    The rule: with its best focus its median error is lower than that of either warped map by a factor of ``MIN_PROMOTION_GAIN``,
    and its median time is no longer than that of the slower one.
    """
    name = f"{TSM} {best_focus_share(figures):g}"
    gains = (at_least(1.0 / median_ratios(figures, other)[name], MIN_PROMOTION_GAIN) for other in (PSM, LSPM))
    time_ratio = min(_median_time_ratio(figures, TSM, other) for other in (PSM, LSPM))
    return all_of((*gains, at_most(time_ratio, 1.0) if time_ratio > 1.0 else True))


def _median_time_ratio(figures: Figures, name: str, other: str) -> float:
    """Return the median over all views of one map's time relative to another's."""
    return float(np.median([row["ms"][name] / row["ms"][other] for row in figures["rows"]]))


def make_section(figures: Figures) -> Section:
    """Format the claims on trapezoidal maps, and the tables of errors and times."""
    share = best_focus_share(figures)
    best = f"{TSM} {share:g}"
    to_map, to_perspective, to_light_space = (median_ratios(figures, name)[best] for name in (SM, PSM, LSPM))
    changes = {name: largest_change(sizes) for name, sizes in figures["turns"].items()}
    means_px = {name: float(np.exp(np.mean(np.log(sizes)))) for name, sizes in figures["turns"].items()}
    is_finer, is_smoother = at_most(to_map, 1.0), at_most(changes[TSM], changes[PSM])
    matches, promotes = at_most(to_perspective, 1.0), promotion_verdict(figures)
    sweep = ", ".join(f"{s:g}: {format_ratio(median_ratios(figures, PSM)[f'{TSM} {s:g}'])}" for s in FOCUS_SHARES)
    sizes_text = "mean texels on the way: " + ", ".join(f"{name} {value:.2f} px" for name, value in means_px.items())
    time_text = ", ".join(f"{format_ratio(_median_time_ratio(figures, TSM, name))} of {name}'s" for name in (PSM, LSPM))
    worst = max(figures["rows"], key=lambda row: row["wrong_cast"][best] / max(row["wrong_cast"][LSPM], 1e-6))
    claims = [
        Claim(
            PAPER,
            "trapezoidal maps have less aliasing than uniform ones",
            f"wrong_cast over that of `{SM}`, tightly fitted: {format_ratio(to_map)}, the median of {len(figures['rows'])} views "
            "(held if under 1)",
            is_finer,
            "the trapezoid leaves out what the camera does not see, and its warp gives the foreground more texels",
        ),
        Claim(
            PAPER,
            "they have less aliasing than perspective shadow maps",
            f"wrong_cast over that of `{PSM}`: {format_ratio(to_perspective)}, the median (held if under 1); by the focus's place "
            f"{sweep}",
            matches,
            choose_reason(
                matches,
                "a perspective map is chosen by its mean texel, the trapezoid's focus by the share of the map",
                "the trapezoid has one warp for its focus, whatever is seen where; a perspective map's slide-back is the best of "
                "some fifteen for the visible points. A focus nearer to the eye takes texels from all else",
            ),
        ),
        Claim(
            PAPER,
            "their resolution changes continuously as view and light move, unlike that of perspective shadow maps",
            f"largest change of the mean texel from one picture to the next, the sun {SUN_TURN_DEG:g} degrees on: "
            + ", ".join(f"{name} {format_ratio(change)}" for name, change in changes.items())
            + f" (held if less than {PSM}'s)",
            is_smoother,
            choose_reason(is_smoother, sizes_text, sizes_text, f"{DRAW_TEXT}; {sizes_text}"),
        ),
        Claim(
            "rule of this page",
            f"trapezoidal maps deserve to be an algorithm: errors lower by a factor of {MIN_PROMOTION_GAIN:g} than those of both "
            "warped maps, no slower than the slower one",
            f"errors {format_ratio(to_perspective)} of {PSM}'s and {format_ratio(to_light_space)} of {LSPM}'s; times {time_text}",
            promotes,
            choose_reason(
                promotes,
                "it becomes one",
                f"it does not become one. Both warp the light's own space along the view. The rule of {LSPM} places the warp's "
                "centre by the depths that are seen, that of the trapezoid by a focus that a user has to choose. Where that "
                "matters "
                "most, in "
                f"{scene_title(worst['view'])}, {format_percent(worst['wrong_cast'][best])} is wrong beside "
                f"{format_percent(worst['wrong_cast'][LSPM])}",
                "the figures do not decide, so it does not become one",
            ),
        ),
    ]
    table = [
        {"view": scene_title(row["view"])}
        | {name: format_percent(row["wrong_cast"][name]) for name in (SM, PSM, LSPM)}
        | {
            f"{TSM}, focus {s:g}": format_percent(row["wrong_cast"][f"{TSM} {s:g}"])
            + (" (uniform)" if f"{TSM} {s:g}" in row["uniform"] else "")
            for s in FOCUS_SHARES
        }
        | {"time over light-space": format_ratio(row["ms"][TSM] / row["ms"][LSPM])}
        for row in figures["rows"]
    ]
    return Section(
        "Trapezoidal shadow maps (a study)",
        f"Martin and Tan 2004, *Anti-aliasing and continuity with trapezoidal shadow maps*. Main and close views of the thesis's "
        f"scenes, {SIZE_PX[0]} x {SIZE_PX[1]} pixels, maps of {MAP_SIZE}, 3 x 3 taps. The matrix takes the place of that of "
        f"`{LSPM}`: fit to the visible points, ranges of distance and look-up are the same. The focus lies at a share of the "
        "depths from the nearest visible point to the farthest; 80 % of the map lie before it. Verdicts take the best share for "
        "all "
        f"views, {share:g}. Where the warp has no smaller texels in the picture, the map is uniform. Times are those of the "
        "shadow alone, "
        f"maps drawn anew, medians of {REPEATS} turns.",
        [("wrong_cast", table)],
        claims,
        [("seeds-trapezoidal.webp", "Rocks under the sun, maps of 512; false shadow red, missed shadow blue")],
    )
