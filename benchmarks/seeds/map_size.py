"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005), replication of figures 52 and 53: map size and cut-off angle.

Every picture is compared with ray-traced truth (``skugga.shadows.truth.metrics``). Maps have one tap, so that the errors are those
of texels, not of filters.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_crop, write_sheet
from benchmarks.seeds.verdicts import (
    DRAW_FACTOR,
    THESIS,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_percent,
    format_whole_percent,
)
from benchmarks.seeds.views import Variant, ViewWithTruth, draw_variant, read_bundled_level, view_with_truth, write_and_build_scene
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS
from skugga.shadows.truth.metrics import shadow_boundary_mask

FRAME_SIZE_PX = (1280, 1024)
"""The thesis's frame size."""

MAP_SIZES = (256, 512, 1024, 2048, 4096)
"""Texels a side of the measured shadow maps."""
THESIS_MAP_SIZE = 2048
"""The map size in the thesis's text."""

WIDE_CUTOFF_DEG = 58.0
"""The cut-off angle of the thesis's water tower, by its own listing."""

MAX_SHARP_EDGE_PX = 1.0
"""A shadow is sharp if the 95th percentile of its edge displacement is at most this, the smallest nonzero value."""

MAX_PREDICTION_RATIO = 1.35
"""Maximum ratio of measured and predicted mean edge displacement, where texels are larger than pixels."""

CROP: CropBox = (440, 520, 200, 160)


def smallest_cone(apex_m: np.ndarray, points_m: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the smallest cone from an apex round points (n, 3): its unit axis (3,) and its half angle in degrees.

    The angle is accurate to a thousandth. The axis passes through the centre of the smallest ball round the unit directions to the
    points. M. Badoiu and K. Clarkson 2003, Smaller core-sets for balls: each step moves the centre a share of the way to the
    farthest point.
    """
    directions = points_m - apex_m
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    axis = directions.mean(axis=0)
    for step in range(2, 4000):
        axis = axis + (directions[np.argmin(directions @ axis / np.linalg.norm(axis))] - axis) / step
    axis /= np.linalg.norm(axis)
    return axis, float(np.degrees(np.arccos((directions @ axis).min())))


def texel_sizes_at_edges_px(truth_view: ViewWithTruth, map_size: int) -> np.ndarray:
    """Return the pixels per texel of a spot light's map at the n pixels on true shadow edges. ``map_size`` is in texels a side.

    The formula is d = d_s (r_s / r_i) (cos b / cos a). d_s is a texel's side at distance 1 from the light. r_s and r_i are the
    distances to the light and to the eye. a and b are the angles between the surface's normal and the directions to the light and
    to the eye. (M. Stamminger and G. Drettakis 2002; the thesis's equation 1)
    """
    buffer, lamp, receivers = truth_view.buffer, truth_view.scene.lamps[truth_view.light], truth_view.receivers
    edge = shadow_boundary_mask(~truth_view.truth.lit & receivers, receivers)
    points, normals = buffer.position_frame_m[edge].astype(np.float64), buffer.normal_frame[edge].astype(np.float64)
    source, axis, _ = lamp.in_frame(buffer.frame)
    to_light, to_eye = source - points, truth_view.perspective.in_frame(buffer.frame)[0] - points
    cosines = [np.abs((direction * normals).sum(axis=1)) / np.linalg.norm(direction, axis=1) for direction in (to_eye, to_light)]
    texel = 2.0 * np.tan(np.radians(lamp.cutoff_deg)) / (map_size - 2 * MAP_BORDER_TEXELS)
    return (
        texel
        * -(to_light @ axis)
        / (truth_view.view_depth_m[edge] * truth_view.perspective.pixel_tangent)
        * cosines[0]
        / cosines[1]
    )


def measure() -> Figures:
    """Measure the water tower's shadow by map size, under the narrowest spot light that contains it and under a wide one."""
    level, rows, pictures = read_bundled_level("thesis_water_tower"), [], []
    lamp = level["lights"]["lamp"]
    with TemporaryDirectory() as name:
        folder = Path(name)
        tower = write_and_build_scene(level, folder).objects.solids
        assert tower is not None
        apex_m = np.array(lamp["position"], np.float64)
        axis, least_deg = smallest_cone(apex_m, tower.vertices_earth_m)
        lamp["target"] = (apex_m + 0.9 * apex_m[2] / -axis[2] * axis).tolist()
        for cutoff_deg in (1.001 * least_deg, WIDE_CUTOFF_DEG):
            lamp["cutoff"] = cutoff_deg
            truth_view = view_with_truth(write_and_build_scene(level, folder), "close", FRAME_SIZE_PX)
            for map_size in MAP_SIZES:
                variant = Variant({"algorithm": "shadow_map", "map_size": map_size, "filter": 1})
                figures, texel_px = draw_variant(truth_view, variant).figures, texel_sizes_at_edges_px(truth_view, map_size)
                rows.append({"cutoff_deg": cutoff_deg, "map_size": map_size, "texel_px": float(texel_px.mean()), **figures})
                caption = f"{map_size}, {cutoff_deg:.1f}°: {format_percent(figures['wrong_cast'])} wrong"
                pictures.append(CaptionedPicture(draw_crop(truth_view, variant, CROP), caption))
    write_sheet("seeds-map-size.webp", pictures, len(MAP_SIZES))
    return {"rows": rows}


def make_section(figures: Figures) -> Section:
    """Format the claims on map size and cut-off angle, and the table of errors."""
    rows = figures["rows"]
    least_deg, wide_deg = (min(row["cutoff_deg"] for row in rows), max(row["cutoff_deg"] for row in rows))
    narrow_rows, wide_rows = ([row for row in rows if row["cutoff_deg"] == angle] for angle in (least_deg, wide_deg))
    fine_row, fine_wide = (next(row for row in part if row["map_size"] == THESIS_MAP_SIZE) for part in (narrow_rows, wide_rows))
    predicted = [row for row in rows if row["texel_px"] >= 1.0]
    ratios = [row["cast_edge_mean"] / (row["texel_px"] / 4.0) for row in predicted]
    is_decreasing = all_of(
        at_least(a["wrong_cast"], b["wrong_cast"])
        for part in (narrow_rows, wide_rows)
        for a, b in zip(part, part[1:], strict=False)
    )
    sharp = fine_row["edge_p95"] <= MAX_SHARP_EDGE_PX  # both are whole pixels, or nearly: no draws
    edges_become_sharp = all_of((is_decreasing, sharp))
    wide_is_worse = all_of(at_least(b["wrong_cast"], a["wrong_cast"]) for a, b in zip(narrow_rows, wide_rows, strict=True))
    wide_stays_jagged = all_of((wide_is_worse, fine_wide["edge_p95"] > MAX_SHARP_EDGE_PX))
    prediction_holds = at_most(max(*ratios, *(1.0 / ratio for ratio in ratios)), MAX_PREDICTION_RATIO)
    displacement_text = f"95 % of the edges are off by at most {fine_row['edge_p95']:.1f} px"
    claims = [
        Claim(
            f"{THESIS}, figure 52",
            f"jaggedness falls with the map's size, to very nice edges at {THESIS_MAP_SIZE} under the smallest cut-off",
            f"from {format_percent(narrow_rows[0]['wrong_cast'])} wrong at {narrow_rows[0]['map_size']} to "
            f"{format_percent(fine_row['wrong_cast'])} at "
            f"{THESIS_MAP_SIZE}, where {displacement_text} (held if each size is better than the one before, and `edge_p95` at "
            "most "
            f"{MAX_SHARP_EDGE_PX:g} px there)",
            edges_become_sharp,
            choose_reason(
                edges_become_sharp,
                f"a texel covers {fine_row['texel_px']:.2f} px at {THESIS_MAP_SIZE}: an edge can hardly leave its pixel",
                f"a texel still covers {fine_row['texel_px']:.2f} px at {THESIS_MAP_SIZE}"
                if not sharp
                else "where texels are smaller than pixels a larger map has nothing left to mend",
            ),
        ),
        Claim(
            f"{THESIS}, figure 53",
            f"a larger cut-off is worse at every size, and not even {THESIS_MAP_SIZE} removes its stairs",
            f"{format_percent(fine_wide['wrong_cast'])} wrong at {THESIS_MAP_SIZE} under {wide_deg:.0f}°, beside "
            f"{format_percent(fine_row['wrong_cast'])} under {least_deg:.1f}°; `edge_p95` {fine_wide['edge_p95']:.1f} px (held "
            "if worse "
            f"at every size, and over {MAX_SHARP_EDGE_PX:g} px)",
            wide_stays_jagged,
            choose_reason(
                wide_stays_jagged,
                f"texels grow with the tangent of the cut-off: they are {fine_wide['texel_px'] / fine_row['texel_px']:.1f} times "
                f"as large, {fine_wide['texel_px']:.1f} px at {THESIS_MAP_SIZE}",
                f"a texel of the wide cone covers {fine_wide['texel_px']:.1f} px at {THESIS_MAP_SIZE}",
            ),
        ),
        Claim(
            f"{THESIS}, equation 1",
            "aliasing goes by texel size times distances and angles; so a nearest look-up is off by a quarter of that in the mean",
            f"where a texel is larger than a pixel ({len(predicted)} rows), the mean displacement is {min(ratios):.2f} to "
            f"{max(ratios):.2f} of the predicted one (held if within a factor of {MAX_PREDICTION_RATIO})",
            prediction_holds,
            choose_reason(
                prediction_holds,
                "a point is taken for its texel's centre, which lies up to half a texel off, evenly: a quarter in the mean",
                "a quarter of a texel is the mean of one straight edge that runs along texels: bars thinner than a texel and "
                "edges askew to texels are left out",
            ),
        ),
    ]
    table = [
        {
            "cut-off": f"{row['cutoff_deg']:.1f}°",
            "map": str(row["map_size"]),
            "wrong_cast": format_percent(row["wrong_cast"]),
            "edge_p95": f"{row['edge_p95']:.1f} px",
            "texel": f"{row['texel_px']:.2f} px",
            "mean displacement": f"{row['cast_edge_mean']:.2f} px",
            "predicted: texel / 4": f"{row['texel_px'] / 4:.2f} px",
        }
        for row in rows
    ]
    return Section(
        "Map size and cut-off angle (figures 52 and 53)",
        f"The water tower's shadow from close by, {FRAME_SIZE_PX[0]} x {FRAME_SIZE_PX[1]} pixels, one tap. The spot's cone is "
        "first the smallest "
        f"that holds the tower ({least_deg:.1f}°), then opened to {wide_deg:.0f}°, as in the thesis's listing. `texel` is the "
        "size of a texel in the picture that the thesis's equation 1 predicts, the mean over the shadow's edges. Errors within "
        f"{format_whole_percent(DRAW_FACTOR - 1.0)} of one another count as the same.",
        [("Shadow maps by size", table)],
        claims,
        [
            (
                "seeds-map-size.webp",
                f"The same {CROP[2]} x {CROP[3]} pixels with maps of {', '.join(map(str, MAP_SIZES))} texels a side, under "
                f"{least_deg:.1f}° above and {wide_deg:.0f}° below; what is wrong is counted in the whole picture",
            )
        ],
    )
