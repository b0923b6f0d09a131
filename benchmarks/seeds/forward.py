"""A study of forward shadow mapping (Zhang 1998), beside looking up the very same maps.

One map per view, uniform or perspective, fitted to the visible points. It is drawn once for each method: the engine looks the
visible points up in it, or its samples are projected into the picture (``benchmarks.seeds.forward_mapping``).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.perspective_maps import THESIS_LEVELS
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.forward_mapping import ForwardMask, eye_picture, splat_samples
from benchmarks.seeds.perspective import without_perspective
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_errors, write_sheet
from benchmarks.seeds.times import interleaved_times
from benchmarks.seeds.verdicts import (
    ClaimVerdict,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_percent,
    format_ratio,
    scene_title,
)
from benchmarks.seeds.views import DrawnVariant, ViewWithTruth, bundled_scene, view_with_truth
from skugga.shadows.maps import perspective_shadow_map
from skugga.shadows.maps.drawing import draw_map
from skugga.shadows.maps.filling import visibility_by_maps
from skugga.shadows.maps.settings import PerspectiveMapSettings
from skugga.shadows.maps.windows import DepthMap
from skugga.shadows.passes import PassLog, PassRecord
from skugga.terrain.cache import clear_caches
from skugga.terrain.gl.device import device
from skugga.terrain.level.level import SUN, CasterKind

PAPER = "Zhang 1998"

SIZE_PX = (640, 512)
MAP_SIZE = 1024
"""Texels a side of the maps."""
REPEATS = 3
"""Number of timed turns."""

VIEW_NAMES = ("main", "close")

MAP_KINDS = {"uniform": without_perspective, "perspective": nullcontext}
"""Kinds of maps, each with the context manager under which its matrix is chosen."""

TOLERANCES_TEXELS = (0.0, 0.5, 2.0)
"""Texels by whose shift a sample may lie off the plane of the pixel's triangle."""

DRAWN_KINDS: tuple[CasterKind, ...] = ("relief", "meshes")
"""What is drawn into the maps. Forward mapping needs all that is lit in them, also ground that casts no shadow."""

LOOK_UP, POINTS, QUADS = "look-up", "points", "quads"

MIN_HOLE_RATIO = 2.0
"""Ratio of holes from which points count as leaving clearly more of them than quads."""

SHOWN_LEVEL, SHOWN_VIEW = "thesis_street_sun", "main"
SHOWN_CROP: CropBox = (120, 230, 400, 240)


def measure() -> Figures:
    """Measure errors, holes, doubles and times of both methods in the main and close views of the thesis's levels."""
    rows = []
    for level in THESIS_LEVELS:
        scene = bundled_scene(level)
        for view in VIEW_NAMES:
            truth_view = view_with_truth(scene, view, SIZE_PX)
            pictures: list[CaptionedPicture] | None = [] if (level, view) == (SHOWN_LEVEL, SHOWN_VIEW) else None
            for kind in MAP_KINDS:
                name = f"{level.removeprefix('thesis_')} {view}"
                rows.append({"view": name, "map": kind, **measure_map(truth_view, kind, pictures)})
            if pictures:
                write_sheet("seeds-forward.webp", pictures, 3)
    return {"rows": rows}


def fitted_map(truth_view: ViewWithTruth, map_kind: str) -> tuple[DepthMap, PerspectiveMapSettings, float]:
    """Return a single map of a kind of ``MAP_KINDS`` that is fitted to a view, its settings, and its texel in pixels."""
    settings = PerspectiveMapSettings(map_size=MAP_SIZE, depth_bits=24 if truth_view.light == SUN else 32, filter=1)
    arguments = truth_view.buffer, truth_view.receivers, truth_view.scene, truth_view.light, settings, None
    with MAP_KINDS[map_kind](), patch.object(perspective_shadow_map, "MAX_DISTANCE_RANGES", 1):
        (fitted,) = perspective_shadow_map.perspective_maps(*arguments)
    return fitted.depth_map, settings, fitted.texel_px


def measure_map(truth_view: ViewWithTruth, map_kind: str, pictures: list[CaptionedPicture] | None = None) -> dict[str, Any]:
    """Return the figures of a view's map, by method. Pictures of the errors are appended to ``pictures``, if there is a list."""
    depth_map, settings, texel_px = fitted_map(truth_view, map_kind)
    truth = truth_view.truth
    lit = truth.lit & truth.decidable & truth_view.receivers
    figures: dict[str, Any] = {"texel_px": texel_px, LOOK_UP: {}, POINTS: {}, QUADS: {}}
    visibility = look_up(truth_view, depth_map, settings)
    figures[LOOK_UP] = _errors(truth_view, visibility, f"{map_kind}, {LOOK_UP}", pictures)
    tasks: dict[str, Callable[[], Any]] = {LOOK_UP: partial(look_up, truth_view, depth_map, settings)}
    for method in (POINTS, QUADS):
        for tolerance in TOLERANCES_TEXELS:
            mask = forward(truth_view, depth_map, settings, method == QUADS, tolerance)
            lit_count = max(int(mask.is_lit.sum()), 1)
            is_shown = tolerance == 0.5
            errors = _errors(truth_view, mask.is_lit.astype(np.float32), f"{map_kind}, {method}", pictures if is_shown else None)
            figures[method][f"{tolerance:g}"] = errors | {
                "holes": float((lit & ~mask.is_lit).sum() / max(int(lit.sum()), 1)),
                "doubles": float((mask.counts > 1).sum() / lit_count),
                "used": float(mask.counts.sum() / max(mask.samples, 1)),
            }
        tasks[method] = partial(forward, truth_view, depth_map, settings, method == QUADS, 0.5)
    runs = interleaved_times(tasks, REPEATS)
    return figures | {"ms": {name: float(np.median([ms for ms, _ in results])) for name, results in runs.items()}}


def look_up(truth_view: ViewWithTruth, depth_map: DepthMap, settings: PerspectiveMapSettings) -> np.ndarray:
    """Draw a map, and return the visibility (rows, cols) of a view's points by looking them up."""
    clear_caches("light")
    passes = ("depth map", "visibility")
    arguments = truth_view.buffer, truth_view.scene, truth_view.light, DRAWN_KINDS, truth_view.casters
    return visibility_by_maps([depth_map], *arguments, settings, passes, PassLog())


def forward(
    truth_view: ViewWithTruth, depth_map: DepthMap, settings: PerspectiveMapSettings, as_quads: bool, tolerance_texels: float
) -> ForwardMask:
    """Draw a map, and project its samples into a view's picture (``splat_samples``)."""
    clear_caches("light")
    gl, record = device(), PassRecord("depth map")
    arguments = depth_map, truth_view.buffer, truth_view.scene, DRAWN_KINDS, truth_view.casters
    depths = gl.read(draw_map(gl, *arguments, settings, record), -1, size=depth_map.face_size)
    picture = eye_picture(truth_view.buffer, truth_view.receivers)
    matrix = np.reshape(depth_map.uniforms["map_rows"], (4, 4))
    return splat_samples(depths, matrix, picture, as_quads, tolerance_texels, depth_map.uniforms["depth_step"])


def _errors(
    truth_view: ViewWithTruth, visibility: np.ndarray, caption: str, pictures: list[CaptionedPicture] | None
) -> dict[str, float]:
    """Return the errors of a visibility (rows, cols), and append a picture of them to ``pictures``, if there is a list."""
    visibility = truth_view.with_attached_shadow(visibility)
    errors = truth_view.errors(visibility)
    if pictures is not None:
        drawn = DrawnVariant(np.nan_to_num(visibility, nan=1.0) < 0.5, errors, "")
        text = f"{caption}: {format_percent(errors['wrong_cast'])} wrong"
        pictures.append(CaptionedPicture(draw_errors(truth_view, drawn, SHOWN_CROP), text))
    return {name: errors[name] for name in ("wrong_cast", "false_shadow", "missed_shadow")}


def best_tolerance(figures: Figures, method: str) -> str:
    """Return the tolerance with which the method ``method`` has the least median error over all maps."""
    return min(
        (f"{tolerance:g}" for tolerance in TOLERANCES_TEXELS),
        key=lambda tolerance: float(np.median([row[method][tolerance]["wrong_cast"] for row in figures["rows"]])),
    )


def median_error_ratio(figures: Figures, method: str, map_kind: str) -> float:
    """Return the median error of a method with its best tolerance, relative to the look-up's in the same map."""
    tolerance = best_tolerance(figures, method)
    rows = [row for row in figures["rows"] if row["map"] == map_kind]
    return float(np.median([row[method][tolerance]["wrong_cast"] / max(row[LOOK_UP]["wrong_cast"], 1e-6) for row in rows]))


def median_time_ratio(figures: Figures, method: str) -> float:
    """Return the median time of a method relative to the look-up's in the same map."""
    return float(np.median([row["ms"][method] / row["ms"][LOOK_UP] for row in figures["rows"]]))


def promotion_verdict(figures: Figures) -> ClaimVerdict:
    """Return whether forward mapping should become an algorithm; ``None`` for a draw.

    The rule: some way of splatting has no larger median error than the look-up in either kind of map, and takes no longer.
    """
    verdicts = []
    for method in (POINTS, QUADS):
        errors = (at_most(median_error_ratio(figures, method, kind), 1.0) for kind in MAP_KINDS)
        verdicts.append(all_of((*errors, at_most(median_time_ratio(figures, method), 1.0))))
    return True if True in verdicts else None if None in verdicts else False


def make_section(figures: Figures) -> Section:
    """Format the claims on forward shadow mapping, and the tables of errors, holes and times."""
    rows = figures["rows"]
    best = {method: best_tolerance(figures, method) for method in (POINTS, QUADS)}
    holes = {method: float(np.median([row[method][best[method]]["holes"] for row in rows])) for method in best}
    doubles = {method: float(np.median([row[method][best[method]]["doubles"] for row in rows])) for method in best}
    holes_by_map = {
        kind: float(np.median([row[POINTS][best[POINTS]]["holes"] for row in rows if row["map"] == kind])) for kind in MAP_KINDS
    }
    texels_px = {kind: float(np.median([row["texel_px"] for row in rows if row["map"] == kind])) for kind in MAP_KINDS}
    ratios = {(method, kind): median_error_ratio(figures, method, kind) for method in best for kind in MAP_KINDS}
    times = {method: median_time_ratio(figures, method) for method in best}
    exact = float(np.median([row[QUADS]["0"]["wrong_cast"] / max(row[QUADS][best[QUADS]]["wrong_cast"], 1e-6) for row in rows]))
    points_have_holes = at_least(holes[POINTS], MIN_HOLE_RATIO * max(holes[QUADS], 1e-6))
    no_bias, promotes = at_most(exact, 1.0), promotion_verdict(figures)
    as_accurate = all_of(at_most(ratios[QUADS, kind], 1.0) for kind in MAP_KINDS)
    claims = [
        Claim(
            "derived here",
            "a sample for each texel leaves holes where texels are larger than pixels, and several samples to a pixel elsewhere",
            f"lit pixels without a sample: {format_percent(holes[POINTS])} by points, {format_percent(holes[QUADS])} by quads; lit "
            f"by several: {format_percent(doubles[POINTS])} and {format_percent(doubles[QUADS])} (medians; held if points leave at "
            f"least {MIN_HOLE_RATIO:g} times the holes)",
            points_have_holes,
            f"a texel is {texels_px['uniform']:.1f} px wide in uniform maps and {texels_px['perspective']:.1f} px in perspective "
            f"maps, which leave {format_percent(holes_by_map['uniform'])} and {format_percent(holes_by_map['perspective'])} of the "
            "lit pixels without a sample by points",
        ),
        Claim(
            PAPER,
            "a comparison in the eye's view needs no bias",
            f"wrong_cast of quads with the tolerance of rounding alone, over that with {best[QUADS]} texels: "
            f"{format_ratio(exact)}, "
            "the median (held if at most 1)",
            no_bias,
            choose_reason(
                no_bias,
                "a sample lies on the surface that the light reaches",
                "a sample lies on a surface, but four of them span a plane only where that surface is plane. Facets narrower "
                "than a "
                "texel, edges and creases need a tolerance, as a look-up needs a bias",
            ),
        ),
        Claim(
            "derived here",
            "quads are as accurate as looking up the same map",
            "wrong_cast over the look-up's: "
            + ", ".join(f"{format_ratio(ratios[QUADS, kind])} in {kind} maps" for kind in MAP_KINDS)
            + "; by points "
            + ", ".join(format_ratio(ratios[POINTS, kind]) for kind in MAP_KINDS)
            + " (held if at most 1 for quads)",
            as_accurate,
            choose_reason(
                as_accurate,
                "both see the same texels",
                "the look-up extends a texel's depth along the receiver's own triangle, up to the texel's edges. A quad ends at "
                "the "
                "last lit texel's centre: along each shadow half a texel stays dark, and surfaces narrower than two texels are "
                "lost",
            ),
        ),
        Claim(
            "rule of this page",
            "forward mapping deserves to be an algorithm: no larger errors than the look-up in either kind of map, and no slower",
            "errors as above; times over the look-up's: "
            + ", ".join(f"{method} {format_ratio(ratio)}" for method, ratio in times.items()),
            promotes,
            choose_reason(
                promotes,
                "it becomes one",
                "it does not become one. A look-up asks once for each visible point and always has an answer. Forward mapping "
                "works on "
                "all texels, also those that the eye does not see, and pixels between samples get no answer",
                "the figures do not decide, so it does not become one",
            ),
        ),
    ]
    error_table, count_table = [], []
    for row in rows:
        view = {"view": scene_title(row["view"]), "map": row["map"]}
        error_table.append(
            view
            | {"texel": f"{row['texel_px']:.1f} px", LOOK_UP: format_percent(row[LOOK_UP]["wrong_cast"])}
            | {
                f"{method}, {tolerance:g}": format_percent(row[method][f"{tolerance:g}"]["wrong_cast"])
                for method in best
                for tolerance in TOLERANCES_TEXELS
            }
        )
        count_table.append(
            view
            | {f"holes, {method}": format_percent(row[method][best[method]]["holes"]) for method in best}
            | {f"doubles, {method}": format_percent(row[method][best[method]]["doubles"]) for method in best}
            | {"samples used, points": format_percent(row[POINTS][best[POINTS]]["used"])}
            | {f"time, {method}": format_ratio(row["ms"][method] / row["ms"][LOOK_UP]) for method in best}
        )
    return Section(
        "Forward shadow mapping (a study)",
        f"Zhang 1998, *Forward shadow mapping*: the light's depth samples are projected into the picture, instead of looking the "
        f"picture's points up in the light's map. Main and close views of the thesis's scenes, {SIZE_PX[0]} x {SIZE_PX[1]} pixels, "
        f"one map of {MAP_SIZE}, one tap. *points*: a sample lights the pixel in which it falls. *quads*: four samples span two "
        "triangles. Numbers after them are the tolerance: texels by whose shift a sample may lie off the plane of the pixel's "
        "triangle. *holes* are the lit pixels, by rays, that no sample reaches; *doubles* the share of the lit pixels that several "
        "reach; both with the best tolerance. *samples used* counts hits, as a share of the map's samples. Times are those of "
        f"drawing the map and either method, over the look-up's, medians of {REPEATS} turns; forward mapping runs on one core.",
        [("wrong_cast", error_table), ("Holes, doubles and times", count_table)],
        claims,
        [
            (
                "seeds-forward.webp",
                "The street under the sun: uniform map above, perspective map below; false shadow red, missed blue",
            )
        ],
    )
