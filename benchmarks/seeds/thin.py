"""J. Sindholt, A comparison of Shadow Algorithms (DTU 2005), replication of figure 56: thin casters and the hybrid's map."""

from __future__ import annotations

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.pictures import CaptionedPicture, CropBox, draw_errors, write_sheet
from benchmarks.seeds.verdicts import THESIS, all_of, at_least, at_most, choose_reason, format_percent
from benchmarks.seeds.views import Variant, bundled_scene, draw_variant, view_with_truth

FRAME_SIZE_PX = (1280, 1024)
"""The thesis's frame size."""

MAP_SIZES = (128, 256, 512, 1024)
"""Texels a side of the hybrid's shadow maps; the pictures show only some of them."""
SHOWN_MAP_SIZES = (128, 512)
HYBRID_MASKS = ("original", "conservative")
"""Values of the setting ``mask`` of ``hybrid``, which selects the pixels that its shadow map leaves to shadow volumes. ``original``
is the rule of the paper (Chan and Durand 2004), which can miss casters thinner than a texel; ``conservative`` misses none."""

MAX_WRONG_SHARE = 0.001
"""Maximum wrong share of the cast shadow of an exact algorithm. The rasteriser snaps edges to 1/256 of a pixel."""

CROP: CropBox = (180, 500, 480, 300)


def measure() -> Figures:
    """Measure the shadow of the water tower's ladder and braces with hybrids, by map size."""
    rows, pictures = [], []
    truth_view = view_with_truth(bundled_scene("thesis_water_tower"), "close", FRAME_SIZE_PX)
    for mask in HYBRID_MASKS:
        for map_size in MAP_SIZES:
            drawn_variant = draw_variant(truth_view, Variant({"algorithm": "hybrid", "mask": mask, "map_size": map_size}))
            rows.append({"mask": mask, "map_size": map_size, **drawn_variant.figures})
            if map_size in SHOWN_MAP_SIZES:
                caption = f"{mask}, map of {map_size}: {format_percent(drawn_variant.figures['wrong_cast'])} wrong"
                pictures.append(CaptionedPicture(draw_errors(truth_view, drawn_variant, CROP), caption))
    write_sheet("seeds-thin.webp", pictures, 2)
    return {"rows": rows}


def make_section(figures: Figures) -> Section:
    """Format the claims on thin casters, and the table of errors by mask and map size."""
    original, conservative = ([row for row in figures["rows"] if row["mask"] == mask] for mask in HYBRID_MASKS)
    coarse_row, fine_row = original[0], original[-1]
    worst = max(row["wrong_cast"] for row in conservative)
    small_map_misses = all_of(
        (at_least(coarse_row["missed_shadow"], fine_row["missed_shadow"]), at_least(coarse_row["wrong_cast"], MAX_WRONG_SHARE))
    )
    conservative_is_exact = at_most(worst, MAX_WRONG_SHARE)
    mask_matters = None if conservative_is_exact is None else not conservative_is_exact
    claims = [
        Claim(
            f"{THESIS}, figure 56",
            "with a small map the hybrid misses thin casters",
            f"the original mask misses {format_percent(coarse_row['missed_shadow'])} of the shadow at {coarse_row['map_size']} "
            "texels, "
            f"{format_percent(fine_row['missed_shadow'])} at {fine_row['map_size']}; connected parts of the picture that are "
            "wrong away "
            f"from edges: {coarse_row['interior_parts']} and {fine_row['interior_parts']} (held if it misses more with the smaller "
            f"map, and over {format_percent(MAX_WRONG_SHARE)} of the cast shadow is wrong there)",
            small_map_misses,
            choose_reason(
                small_map_misses,
                "a bar or a gap between texel centres shows in none of the four texels compared: they agree, nothing is marked "
                "there, and no volume is asked",
                "all bars are as wide as these texels",
            ),
        ),
        Claim(
            f"{THESIS}, 7.2.3",
            "the right map size is all but impossible to tell, and left to the programmer",
            f"the conservative mask gets at most {format_percent(worst)} of the cast shadow wrong at any size from "
            f"{MAP_SIZES[0]} to "
            f"{MAP_SIZES[-1]} (held if over {format_percent(MAX_WRONG_SHARE)}); it leaves "
            f"{format_percent(conservative[0]['marked'])} of the pixels "
            f"to volumes at the smallest, {format_percent(conservative[-1]['marked'])} at the largest",
            mask_matters,
            choose_reason(
                mask_matters,
                "its marks leave out pixels that they should not",
                "its texels hold intervals of depth of all that touches them, and every pixel that these do not decide is "
                "marked: the size is a matter of speed alone",
            ),
        ),
    ]
    keys = ("wrong_cast", "missed_shadow", "false_shadow", "interior")
    table = [
        {
            "mask": row["mask"],
            "map": str(row["map_size"]),
            **{key: format_percent(row[key]) for key in keys},
            "wrong parts": str(row["interior_parts"]),
            "marked": format_percent(row["marked"]),
        }
        for row in figures["rows"]
    ]
    return Section(
        "Thin casters and the hybrid's map (figure 56)",
        f"The water tower's shadow from close by, {FRAME_SIZE_PX[0]} x {FRAME_SIZE_PX[1]} pixels, under its spot: ladder, braces "
        "and railing. "
        "`marked` is the share of pixels that the mask leaves to volumes, `interior` the share that is wrong away from edges.",
        [("Hybrids by mask and map size", table)],
        claims,
        [("seeds-thin.webp", "The original mask above, the conservative one below; false shadow red, missed shadow blue")],
    )
