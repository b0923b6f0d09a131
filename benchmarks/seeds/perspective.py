"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005), replication of figures 54 and 55: perspective maps by light.

Every picture is compared with ray-traced truth (``skugga.shadows.truth.metrics``). Maps have one tap. Some rows are *controls*
(ablations): an algorithm without one of its parts. They show which part causes a difference.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_errors, write_sheet
from benchmarks.seeds.verdicts import THESIS, all_of, at_least, at_most, choose_reason, format_percent, format_ratio
from benchmarks.seeds.views import (
    DrawnVariant,
    Variant,
    ViewWithTruth,
    draw_variant,
    read_bundled_level,
    view_with_truth,
    write_and_build_scene,
)
from skugga.shadows.maps import perspective_shadow_map, post_perspective
from skugga.shadows.maps.post_perspective import PostPerspective
from skugga.terrain.scene import Scene

SIZE_PX = (960, 768)
MAP_SIZE = 512
"""Texels a side of the shadow maps."""

SPOT_DISTANCE_AND_HEIGHT_M = (113.0, 54.0)
"""Horizontal distance and height of the spot light of figure 54 from the middle circle, as in the bundled level."""

SUN_ALTITUDE_DEG = 28.0
FLOOR_SIDE_M = 280.0
"""Side of the floor, metres. The bundled floor of 200 m does not reach a light ahead of the viewer."""

MAX_EQUAL_FACTOR = 1.25
"""Errors that differ by at most this factor count as about equal."""

MIN_WORSE_FACTOR = 1.5
"""Ratio of errors from which a map counts as far worse."""

NEAR_SPOT_DISTANCE_SHARES = (1.5, 0.5, 0.25)
"""Distances of the spot light from the objects in figure 55, as shares of the camera's distance."""

NEAR_SPOT_DIRECTIONS_DEG = ((180.0, 45.0), (45.0, 70.0), (315.0, 70.0))
"""Directions from the objects to the spot light in figure 55: degrees clockwise from the view direction, and altitude."""

NEAR_SPOT_CUTOFF_DEG = 75.0
"""Cut-off angle of the spot light in figure 55."""
SHOWN_CASE = NEAR_SPOT_DIRECTIONS_DEG[0][0], NEAR_SPOT_DISTANCE_SHARES[-1]
"""Direction and distance of the spot light in the pictures of figure 55."""

DIRECTION_CROP: CropBox = (80, 330, 400, 270)
BAD_CASE_CROP: CropBox = (240, 230, 480, 360)

UNIFORM_MAP, PERSPECTIVE_MAP = "shadow_map", "perspective_shadow_map"
FITTED_UNIFORM_MAP, SHORTEST_SLIDE_BACK, BEST_SLIDE_BACK = (
    "fitted, no perspective",
    "perspective, no slide-back",
    "perspective, best slide-back",
)
MAP_VARIANTS = (UNIFORM_MAP, FITTED_UNIFORM_MAP, SHORTEST_SLIDE_BACK, BEST_SLIDE_BACK, PERSPECTIVE_MAP)
"""Names of the compared maps (``map_variants``), in the order of the tables."""

SPOT_RIGHT, WIDE_SPOT_RIGHT, SPOT_FRONT, NEAR_SPOT_FRONT = (
    "spot at the right",
    "wide spot at the right",
    "spot in front",
    "spot in front, near",
)
SPOT_BEHIND, SPOT_AT_EYE = "spot behind", "spot at the eye"
SUN_RIGHT, SUN_FRONT, SUN_BEHIND = "sun at the right", "sun in front", "sun behind"

LIGHTS: dict[str, tuple[float, float | None, float, dict[str, float]]] = {
    SPOT_RIGHT: (90.0, *SPOT_DISTANCE_AND_HEIGHT_M, {}),
    WIDE_SPOT_RIGHT: (90.0, *SPOT_DISTANCE_AND_HEIGHT_M, {"cutoff": 62.0}),
    SPOT_FRONT: (0.0, *SPOT_DISTANCE_AND_HEIGHT_M, {}),
    NEAR_SPOT_FRONT: (0.0, 30.0, 15.0, {}),
    SPOT_BEHIND: (180.0, *SPOT_DISTANCE_AND_HEIGHT_M, {}),
    SPOT_AT_EYE: (180.0, 34.0, 11.0, {}),
    SUN_RIGHT: (90.0, None, SUN_ALTITUDE_DEG, {}),
    SUN_FRONT: (0.0, None, SUN_ALTITUDE_DEG, {}),
    SUN_BEHIND: (180.0, None, SUN_ALTITUDE_DEG, {}),
}
"""Lights of figure 54: degrees clockwise from the view direction, horizontal distance in metres, height in metres, and keys that
differ from the bundled level. A light without a distance is a sun, with its altitude in degrees instead of a height.
"""


@contextmanager
def without_perspective() -> Iterator[None]:
    """Replace perspective maps by uniform ones that are fitted to the same receivers, while the context manager is active."""
    with patch.object(post_perspective, "UNIFORM_MAP_CONE_DEG", 90.0):
        yield


@contextmanager
def without_uniform_maps() -> Iterator[None]:
    """Use uniform maps only if no slide-back is possible, even where they would have smaller texels.

    Slide-back moves the eye of the map's perspective back, which weakens the perspective.
    """

    def penalized_uniform(*arguments: Any) -> PostPerspective:
        fit = PostPerspective(*arguments)
        return replace(fit, texel_size=np.inf) if fit.kind is None else fit

    with patch.object(post_perspective, "PostPerspective", penalized_uniform):
        yield


@contextmanager
def without_slide_back() -> Iterator[None]:
    """Use the camera's own perspective, or the shortest slide-back with which the map contains everything."""
    ranked = perspective_shadow_map.post_perspectives

    def shortest_first(*args: Any) -> list[PostPerspective]:
        return sorted(ranked(*args), key=lambda candidate: candidate.slide_back_m)

    with without_uniform_maps(), patch.object(perspective_shadow_map, "post_perspectives", shortest_first):
        yield


def map_variants() -> dict[str, Variant]:
    """Return the variants of shadow maps to compare, by name.

    One map covers everything that the light reaches. Four maps cover only visible points, without and with the camera's
    perspective.
    """
    overrides = {"map_size": MAP_SIZE, "filter": 1}
    perspective = {**overrides, "algorithm": "perspective_shadow_map"}
    return {
        UNIFORM_MAP: Variant({**overrides, "algorithm": "shadow_map", "cascades": 1}),
        FITTED_UNIFORM_MAP: Variant(perspective, without_perspective),
        SHORTEST_SLIDE_BACK: Variant(perspective, without_slide_back),
        BEST_SLIDE_BACK: Variant(perspective, without_uniform_maps),
        PERSPECTIVE_MAP: Variant(perspective),
    }


def wrong_shares_of_thirds(truth_view: ViewWithTruth, dark: np.ndarray) -> dict[str, float]:
    """Return the wrong pixels in the nearest and in the farthest third of true cast shadow, as shares of that third.

    The keys are ``near`` and ``far``. ``dark`` is the shadow mask to compare with truth (rows, cols). Each third has the same
    number of pixels in cast shadow.
    """
    truth, ahead_m = truth_view.truth, truth_view.view_depth_m
    cast = truth.decidable & ~truth.lit & truth_view.receivers
    wrong_pixels = truth.decidable & (dark == truth.lit) & truth_view.buffer.valid
    first_m, last_m = np.quantile(ahead_m[cast], [1 / 3, 2 / 3])
    parts = {"near": ahead_m <= first_m, "far": ahead_m > last_m}
    return {name: float((wrong_pixels & part).sum() / max(int((cast & part).sum()), 1)) for name, part in parts.items()}


def stone_circle_scene(
    folder: Path, view: str, clockwise_deg: float, distance_m: float | None, height_m_or_altitude_deg: float, **lamp: Any
) -> Scene:
    """Return the scene of the stone circles under a light whose direction is ``clockwise_deg`` degrees clockwise from a view's.

    The light is a spot light at a distance and a height, metres, from the target of the bundled level's view ``view``. Without a
    distance it is the sun at an altitude in degrees. ``lamp`` are keys of the spot light. The level file is written into
    ``folder``.
    """
    level = read_bundled_level("thesis_rocks_sun" if distance_m is None else "thesis_rocks")
    level["terrain"]["flat"]["size"] = [FLOOR_SIDE_M, FLOOR_SIDE_M]
    (x, y, _), (eye_x, eye_y, _) = level["views"][view]["target"], level["views"][view]["eye"]
    azimuth = np.arctan2(x - eye_x, y - eye_y) + np.radians(clockwise_deg)
    if distance_m is None:
        level["sun"] = {"azimuth": float(np.degrees(azimuth)) % 360.0, "altitude": height_m_or_altitude_deg}
    else:
        position = [float(x + distance_m * np.sin(azimuth)), float(y + distance_m * np.cos(azimuth)), height_m_or_altitude_deg]
        level["lights"]["lamp"] |= {"position": position, "target": [x, y, 0.0], **lamp}
    return write_and_build_scene(level, folder)


def _draw_row(truth_view: ViewWithTruth, name: str, variant: Variant, case: dict[str, Any]) -> tuple[DrawnVariant, dict[str, Any]]:
    """Draw a variant of shadow maps. Return its result, and its row of figures with the keys of ``case`` and the map's name."""
    drawn_variant = draw_variant(truth_view, variant)
    return drawn_variant, {**case, "map": name, **drawn_variant.figures, "note": drawn_variant.note}


def measure_light_direction() -> Figures:
    """Measure the stone circles with the light at several directions around the viewer.

    Rows are uniform and perspective maps of one size, and controls.
    """
    rows, pictures = [], []
    with TemporaryDirectory() as folder:
        for light, (turn_deg, distance_m, height_or_altitude, lamp) in LIGHTS.items():
            truth_view = view_with_truth(
                stone_circle_scene(Path(folder), "main", turn_deg, distance_m, height_or_altitude, **lamp), "main", SIZE_PX
            )
            farthest_m = float(truth_view.view_depth_m[truth_view.receivers].max())
            for name, variant in map_variants().items():
                drawn_variant, row = _draw_row(truth_view, name, variant, {"light": light, "farthest_m": farthest_m})
                rows.append({**row, **wrong_shares_of_thirds(truth_view, drawn_variant.is_dark)})
                if light in (SPOT_RIGHT, SPOT_FRONT, SPOT_AT_EYE) and name in (UNIFORM_MAP, PERSPECTIVE_MAP):
                    text = f"{light}, {name}: {format_percent(row['wrong_cast'])} wrong"
                    pictures.append(CaptionedPicture(draw_errors(truth_view, drawn_variant, DIRECTION_CROP), text))
    write_sheet("seeds-light-direction.webp", pictures, 2)
    return {"rows": rows}


def measure_bad_case() -> Figures:
    """Measure the stone circles from afar, with a spot light nearer to them than the camera."""
    view_spec, rows, pictures = read_bundled_level("thesis_rocks")["views"]["overview"], [], []
    distance_m = float(np.linalg.norm(np.subtract(view_spec["eye"], [*view_spec["target"][:2], 0.0])))
    with TemporaryDirectory() as folder:
        for turn_deg, altitude_deg in NEAR_SPOT_DIRECTIONS_DEG:
            for share in NEAR_SPOT_DISTANCE_SHARES:
                horizontal_m, height_m = (
                    share * distance_m * np.cos(np.radians(altitude_deg)),
                    share * distance_m * np.sin(np.radians(altitude_deg)),
                )
                scene = stone_circle_scene(
                    Path(folder), "overview", turn_deg, float(horizontal_m), float(height_m), cutoff=NEAR_SPOT_CUTOFF_DEG
                )
                truth_view = view_with_truth(scene, "overview", SIZE_PX)
                for name, variant in map_variants().items():
                    drawn_variant, row = _draw_row(
                        truth_view, name, variant, {"turn_deg": turn_deg, "high_deg": altitude_deg, "share": share}
                    )
                    rows.append(row)
                    if (turn_deg, share) == SHOWN_CASE and name != SHORTEST_SLIDE_BACK:
                        pictures.append(
                            CaptionedPicture(
                                draw_errors(truth_view, drawn_variant, BAD_CASE_CROP),
                                f"{name}: {format_percent(row['wrong_cast'])} wrong",
                            )
                        )
    write_sheet("seeds-bad-case.webp", pictures, 2)
    return {"rows": rows}


def make_light_direction_section(figures: Figures) -> Section:
    """Format the claims on the light's direction, and the table of errors."""
    row_by_key = {(row["light"], row["map"]): row for row in figures["rows"]}

    def ratio(light: str, map_name: str, other: str, key: str = "wrong_cast") -> float:
        return row_by_key[light, map_name][key] / max(row_by_key[light, other][key], 1e-9)

    def share_at_right(name: str, part: str) -> str:
        return format_percent(row_by_key[SPOT_RIGHT, name][part])

    nearest, farthest = (ratio(SPOT_RIGHT, BEST_SLIDE_BACK, FITTED_UNIFORM_MAP, part) for part in ("near", "far"))
    near_is_better = all_of((at_most(nearest, 1.0), at_most(ratio(SPOT_RIGHT, PERSPECTIVE_MAP, UNIFORM_MAP, "near"), 1.0)))
    far_is_worse = at_least(farthest, 1.0)
    front_ratios = {light: ratio(light, BEST_SLIDE_BACK, FITTED_UNIFORM_MAP) for light in (SPOT_FRONT, NEAR_SPOT_FRONT, SUN_FRONT)}
    front_is_equal = all_of(
        (at_most(front_ratios[SPOT_FRONT], MAX_EQUAL_FACTOR), at_least(front_ratios[SPOT_FRONT], 1.0 / MAX_EQUAL_FACTOR))
    )
    edge_error_px = {
        light: row_by_key[light, UNIFORM_MAP]["cast_edge_mean"] for light in (SPOT_RIGHT, SPOT_FRONT, NEAR_SPOT_FRONT, SPOT_BEHIND)
    }
    edge_error_at_eye_px, ratio_at_eye = (
        row_by_key[SPOT_AT_EYE, UNIFORM_MAP]["cast_edge_mean"],
        ratio(SPOT_AT_EYE, BEST_SLIDE_BACK, FITTED_UNIFORM_MAP),
    )
    uniform_suits_lamp_at_eye = all_of(
        (at_least(ratio_at_eye, 1.0 / MAX_EQUAL_FACTOR), at_most(edge_error_at_eye_px, min(edge_error_px.values())))
    )
    perspective_gains = {
        light: ratio(light, FITTED_UNIFORM_MAP, BEST_SLIDE_BACK) for light in (SPOT_RIGHT, WIDE_SPOT_RIGHT, SUN_RIGHT)
    }
    farthest_m = {light: row_by_key[light, PERSPECTIVE_MAP]["farthest_m"] for light in perspective_gains}
    sun_gains_most = at_least(perspective_gains[SUN_RIGHT], max(perspective_gains[SPOT_RIGHT], perspective_gains[WIDE_SPOT_RIGHT]))
    claims = [
        Claim(
            f"{THESIS}, figure 54",
            "with the light at the right perspective maps make near shadows better",
            f"wrong in the nearest third of the shadows: {share_at_right(PERSPECTIVE_MAP, 'near')}, beside "
            f"{share_at_right(FITTED_UNIFORM_MAP, 'near')} of a map fitted to "
            f"what is seen without perspective and {share_at_right(UNIFORM_MAP, 'near')} of one for the whole cone (held if less "
            "than both)",
            near_is_better,
            f"the perspective alone multiplies near errors by {format_ratio(nearest)}, the fit to what is seen does the rest",
        ),
        Claim(
            f"{THESIS}, figure 54",
            "at the cost of shadows far away",
            f"wrong in the farthest third: {share_at_right(PERSPECTIVE_MAP, 'far')}, beside "
            f"{share_at_right(FITTED_UNIFORM_MAP, 'far')} fitted "
            "without perspective (and "
            f"{share_at_right(UNIFORM_MAP, 'far')} for the whole cone; held if more than the former)",
            far_is_worse,
            f"the perspective alone multiplies far errors by {format_ratio(farthest)}; beside a map of the whole cone the fit "
            "hides that",
        ),
        Claim(
            f"{THESIS}, 7.2.2",
            "with the light in front both are about equal: near objects are far from a spot, and the two perspectives cancel",
            f"wrong with perspective over without, both fitted: {format_ratio(front_ratios[SPOT_FRONT])} under a spot "
            f"{LIGHTS[SPOT_FRONT][1]:.0f} m "
            f"ahead (held if within a factor of {MAX_EQUAL_FACTOR}), {format_ratio(front_ratios[NEAR_SPOT_FRONT])} under one "
            f"{LIGHTS[NEAR_SPOT_FRONT][1]:.0f} m ahead, "
            f"{format_ratio(front_ratios[SUN_FRONT])} under the sun",
            front_is_equal,
            choose_reason(
                front_is_equal,
                "the two perspectives cancel",
                "a spot as far away as in the bundled level sees near and far objects at much the same distance, so there is "
                "little to cancel"
                + (
                    "; one that stands nearer takes some of the gain away"
                    if front_ratios[NEAR_SPOT_FRONT] > front_ratios[SPOT_FRONT]
                    else ""
                ),
            ),
        ),
        Claim(
            f"{THESIS}, 7.2.2",
            "with the light behind, a miner's lamp, uniform maps are nearly perfect and perspective adds nothing",
            f"with the spot just behind the eye uniform edges are off by {edge_error_at_eye_px:.2f} px in the mean, from elsewhere "
            "by "
            f"{min(edge_error_px.values()):.2f} to {max(edge_error_px.values()):.2f} px; wrong with perspective over without: "
            f"{format_ratio(ratio_at_eye)} "
            f"(held if off by the least, and perspective lowers errors by at most a factor of {MAX_EQUAL_FACTOR})",
            uniform_suits_lamp_at_eye,
            choose_reason(
                uniform_suits_lamp_at_eye,
                "lamp and eye see distances alike, so texels are as even in the picture as pixels are; what shadow is seen at "
                "all lies along outlines, so that few pixels are wrong, though a large share of it",
                "the lamp stands near the eye, not in it: what is left of the perspective still counts",
            ),
        ),
        Claim(
            f"{THESIS}, 7.2.2",
            "directional light suits perspective maps better than spots",
            f"with the light at the right perspective divides errors by {format_ratio(perspective_gains[SUN_RIGHT])} under the "
            "sun, by "
            f"{format_ratio(perspective_gains[SPOT_RIGHT])} under the spot, and by "
            f"{format_ratio(perspective_gains[WIDE_SPOT_RIGHT])} under that spot "
            "opened to "
            f"{LIGHTS[WIDE_SPOT_RIGHT][3]['cutoff']:.0f}° (held if by most under the sun)",
            sun_gains_most,
            choose_reason(
                sun_gains_most,
                "even where a spot lights as much ground, its rays spread against the camera's perspective",
                "what counts is how far the light reaches from near to far in what is seen: under the sun up to "
                f"{farthest_m[SUN_RIGHT]:.0f} m, under the spot {farthest_m[SPOT_RIGHT]:.0f} m, opened "
                f"{farthest_m[WIDE_SPOT_RIGHT]:.0f} m",
            ),
        ),
    ]
    table = [
        {"light": light}
        | {
            name: " / ".join(format_percent(row_by_key[light, name][key]) for key in ("wrong_cast", "near", "far"))
            for name in MAP_VARIANTS
        }
        for light in LIGHTS
    ]
    return Section(
        "Perspective maps by the light's direction (figure 54)",
        f"The stone circles in their main view, {SIZE_PX[0]} x {SIZE_PX[1]} pixels, maps of {MAP_SIZE} texels a side, one tap. "
        "Three "
        f"controls lie between the algorithms; each leaves one idea out. *{FITTED_UNIFORM_MAP}* is the same fit without the "
        "camera's "
        f"perspective. *{SHORTEST_SLIDE_BACK}* is the camera's own perspective, or the shortest slide-back that is possible. "
        f"*{BEST_SLIDE_BACK}* takes a "
        "slide-back even where a uniform map has the smaller texels. Statements about the perspective alone compare the last "
        "control with the first.",
        [("wrong_cast / wrong share of the nearest third of the shadows / of the farthest third", table)],
        claims,
        [
            (
                "seeds-light-direction.webp",
                "Left the map of the whole cone, right the perspective map; false shadow red, missed shadow blue",
            )
        ],
    )


def make_bad_case_section(figures: Figures) -> Section:
    """Format the claims on spot lights nearer than the camera, and the table of errors."""
    row_by_key = {(row["turn_deg"], row["high_deg"], row["share"], row["map"]): row for row in figures["rows"]}
    places = list(dict.fromkeys(key[:3] for key in row_by_key))
    near_places = [place for place in places if place[2] < 1.0]

    def ratios_to_uniform(variant: str) -> list[float]:
        return [
            row_by_key[*place, variant]["wrong_cast"] / max(row_by_key[*place, UNIFORM_MAP]["wrong_cast"], 1e-9)
            for place in near_places
        ]

    worst = {variant: max(ratios_to_uniform(variant)) for variant in MAP_VARIANTS}
    is_bad = at_least(worst[PERSPECTIVE_MAP], MIN_WORSE_FACTOR)
    stretching_is_cause = all_of(
        (at_least(worst[SHORTEST_SLIDE_BACK], MIN_WORSE_FACTOR), at_most(worst[FITTED_UNIFORM_MAP], MIN_WORSE_FACTOR))
    )
    uniform_fallback_count = sum(row_by_key[*place, PERSPECTIVE_MAP]["note"].startswith("a uniform map") for place in near_places)
    claims = [
        Claim(
            f"{THESIS}, figure 55",
            "where the light is nearer to the objects than the camera is, perspective maps are often far worse",
            f"in {sum(ratio > MIN_WORSE_FACTOR for ratio in ratios_to_uniform(PERSPECTIVE_MAP))} of {len(near_places)} such places "
            "over "
            f"{MIN_WORSE_FACTOR:g} "
            f"times the errors of the uniform map; at worst {format_ratio(worst[PERSPECTIVE_MAP])} times (held if over "
            f"{MIN_WORSE_FACTOR:g} anywhere)",
            is_bad,
            choose_reason(
                is_bad,
                "the slide-back with the smallest texels in the mean has large ones where the shadows lie",
                "a uniform map, fitted to what is seen, is among those that are chosen from, and is taken in "
                f"{uniform_fallback_count} of "
                f"these places; were the best slide-back taken always, the worst would be {format_ratio(worst[BEST_SLIDE_BACK])} "
                "times",
            ),
        ),
        Claim(
            f"{THESIS}, 7.2.2",
            "because the camera's transformation stretches the objects until they are small in the map",
            f"the camera's perspective with the shortest slide-back has up to {format_ratio(worst[SHORTEST_SLIDE_BACK])} times "
            "the errors of the "
            f"uniform map; the same receivers without perspective up to {format_ratio(worst[FITTED_UNIFORM_MAP])} times (held if "
            "the former is "
            f"over, the latter at most {MIN_WORSE_FACTOR:g})",
            stretching_is_cause,
            choose_reason(
                stretching_is_cause,
                "with all else alike, taking the perspective out takes the errors away",
                "in these places the fit to what is seen makes up for the stretching",
            ),
        ),
    ]
    table = [
        {"spot": f"{turn_deg:.0f}° off, {high:.0f}° high, {share:g} of the camera's distance"}
        | {name: format_percent(row_by_key[turn_deg, high, share, name]["wrong_cast"]) for name in MAP_VARIANTS}
        for turn_deg, high, share in places
    ]
    return Section(
        "A bad case for perspective maps (figure 55)",
        f"The stone circles from afar, {SIZE_PX[0]} x {SIZE_PX[1]} pixels, maps of {MAP_SIZE}, under a spot of "
        f"{NEAR_SPOT_CUTOFF_DEG:.0f}° that "
        "comes nearer and nearer to the middle circle. The thesis does not say where its light stood; these places have strong "
        "stretching. Controls as above.",
        [("wrong_cast", table)],
        claims,
        [
            (
                "seeds-bad-case.webp",
                f"The spot {SHOWN_CASE[0]:.0f}° off the view's direction at {SHOWN_CASE[1]:g} of the camera's distance; false "
                "shadow red, missed shadow blue",
            )
        ],
    )
