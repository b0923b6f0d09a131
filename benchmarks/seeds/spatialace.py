"""Replication of the SpatialAce thesis (Chalmers) on the cost of shadow maps.

It measures frames with redrawn and cached maps by map size, and the benefit of 16 bits and 512 texels.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.algorithms import measure_frames_by_map_size
from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.times import interleaved_times
from benchmarks.seeds.verdicts import SPATIALACE, all_of, at_least, at_most, factor, format_largest, percent, reason, whole_percent
from benchmarks.seeds.views import (
    ShadowOverrides,
    ViewWithTruth,
    bundled,
    one_map,
    sees_sun_after_move,
    settings_of,
    view_with_truth,
)
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.metrics import block_shares, coverage_error
from skugga.shadows.truth.truth import coverage_truth
from skugga.terrain.cache import clear_caches

REPEATS = 11
FRAME = (800, 600)
SIZES = (64, 128, 256, 512, 1024)
CHOSEN_SIZE = "512"
"""The size that the thesis chooses."""

THEIR_FPS_WITHOUT = 58.88
THEIR_FPS = {"redrawn": (12.35, 10.21, 6.03, 2.22, 0.83), "kept": (16.68, 16.68, 16.68, 16.41, 16.15)}
"""The thesis's frames a second, without shadows and by map size."""

BLOCK_PX = 16
"""Side of the blocks whose shadow shares are compared."""

HIDDEN_TEXELS = 2.0
"""Distance in texels of the map up to which a point counts as part of the terminator's edge."""

STEEP, FLAT_SCENE, TWICE = 1.5, 1.1, 2.0
"""Ratios of costs and gains. From the smallest map to the largest, a cost grows steeply at the first ratio or more, and hardly
below the second. A gain is large at the third or more."""

MAX_COVERAGE_ERROR = 0.03
"""The engine's default target error (``shadows.max_error``)."""

MAX_DEPTH_CHANGE = 0.1
"""Largest change of the error by the number of depth bits, as a share of the error."""

MIN_LEAK = 0.01
"""Least share of lit points on surfaces that face away from the sun. Below it there is no acne to hide."""


def measure() -> Figures:
    truth_view = view_with_truth(bundled("spatialace"), "main", FRAME)
    rows = measure_frames_by_map_size(REPEATS, SIZES, depth_bits=16)
    true_shares = coverage_truth(truth_view.buffer, truth_view.scene, truth_view.casters, BLOCK_PX)

    def quality(overrides: ShadowOverrides) -> dict[str, float]:
        visibility = truth_view.visibility(truth_view.plan(overrides))
        wrong_cast = truth_view.errors(visibility)["wrong_cast"]
        return {"wrong_cast": wrong_cast, "coverage": coverage_error(block_shares(1.0 - visibility), true_shares)}

    def soft(size: int, bits: int) -> ShadowOverrides:
        return one_map(size, depth_bits=bits, filter="auto")

    return {
        "times": {f"{name} {size}": {"ratio": row["ratio"], "draws": row["map_draws"]} for (name, size), row in rows.items()},
        "passes_ms": _passes_ms(truth_view, {size: truth_view.plan(soft(size, 16)) for size in SIZES}),
        "quality": {str(size): quality(soft(size, 16)) for size in SIZES},
        "deeper": {str(size): quality(soft(size, 24)) for size in SIZES},
        "without": quality({"algorithm": "none"}),
        "hidden": {
            str(size): _hidden(truth_view, truth_view.plan(one_map(size, depth_bits=16, bias="polygon_offset"))) for size in SIZES
        },
    }


def _passes_ms(truth_view: ViewWithTruth, plans: dict[int, Plan]) -> dict[str, dict[str, float]]:
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


def _hidden(truth_view: ViewWithTruth, plan: Plan) -> dict[str, float]:
    """Measure what a shadow map alone decides on surfaces that face away from the sun, with the former bias.

    Their normals are flipped, so that the map treats them as receivers. ``polygon_offset`` does not use normals. The figures are:

    * ``lit``: the share of such surfaces that the map leaves lit.
    * ``near``: the share that lies within ``HIDDEN_TEXELS`` texels, along the rays, behind the first hit from the sun.
    * ``lit_near``: the same share among the surfaces that are left lit.
    """
    turned = truth_view.faces_away
    flipped = replace(
        truth_view.buffer, normal_frame=np.where(turned[..., None], -1.0, 1.0).astype(np.float32) * truth_view.buffer.normal_frame
    )
    leaks = turned & (replace(truth_view, buffer=flipped).visibility(plan) >= 0.5)
    settings = settings_of(truth_view, plan)
    assert isinstance(settings, ShadowMapSettings)
    texel_m = max(settings.cascades[0].texel_m)
    near = sees_sun_after_move(truth_view, flipped, HIDDEN_TEXELS * texel_m) & turned
    return {
        "texel_m": texel_m,
        "turned": float(turned.sum() / truth_view.buffer.valid.sum()),
        "lit": float(leaks.sum() / turned.sum()),
        "near": float(near.sum() / turned.sum()),
        "lit_near": float((leaks & near).sum() / max(leaks.sum(), 1)),
    }


def section(figures: Figures) -> Section:
    frame, ms, quality = figures["times"], figures["passes_ms"], figures["quality"]
    first, last = str(SIZES[0]), str(SIZES[-1])
    growth = {mode: frame[f"{mode} {last}"]["ratio"] / frame[f"{mode} {first}"]["ratio"] for mode in THEIR_FPS}
    thesis_gain = {mode: fps[0] / fps[-1] for mode, fps in THEIR_FPS.items()}
    cached_ratio, redrawn_ratio = (frame[f"{mode} {CHOSEN_SIZE}"]["ratio"] for mode in ("kept", "redrawn"))
    place = SIZES.index(int(CHOSEN_SIZE))
    their_gain = THEIR_FPS["kept"][place] / THEIR_FPS["redrawn"][place]
    map_share = {size: pass_ms["depth map"] / (pass_ms["depth map"] + pass_ms["visibility"]) for size, pass_ms in ms.items()}
    steep, flat, pays = (
        at_least(growth["redrawn"], STEEP),
        at_most(growth["kept"], FLAT_SCENE),
        at_least(redrawn_ratio / cached_ratio, TWICE),
    )
    coverage, coverage_without = quality[CHOSEN_SIZE]["coverage"], figures["without"]["coverage"]
    deeper = max(abs(pass_ms["coverage"] - figures["deeper"][size]["coverage"]) for size, pass_ms in quality.items())
    suffices = all_of(
        (
            at_most(coverage, MAX_COVERAGE_ERROR),
            at_least(coverage_without, TWICE * coverage),
            at_most(deeper, MAX_DEPTH_CHANGE * coverage),
        ),
    )
    hidden_figures = figures["hidden"][CHOSEN_SIZE]
    hides = all_of(
        (at_least(hidden_figures["lit"], MIN_LEAK), at_least(hidden_figures["lit_near"], TWICE * hidden_figures["near"]))
    )
    claims = [
        Claim(
            SPATIALACE,
            f"redrawing the map for each frame costs the more the larger it is: {factor(thesis_gain['redrawn'])} times as much at "
            f"{last} as at {first}",
            f"{factor(growth['redrawn'])} times as much (held from {STEEP:g} on)",
            steep,
            f"making the map is {whole_percent(map_share[first])} of the shadow's time at {first} texels a side and "
            f"{whole_percent(map_share[last])} at {last}"
            + reason(
                steep,
                ", so its texels are what a frame pays for",
                "; the rest is looking it up at each pixel, of which there are as many whatever its size. By the thesis's own "
                "account much of its time went into making the depth buffer and storing it away as a texture, and better drivers "
                "halved that; here a map is looked up where it was drawn",
                "; what a larger map costs is as much as it takes to count as steep",
            ),
        ),
        Claim(
            SPATIALACE,
            f"while nothing moves a kept map costs hardly more the larger it is: {factor(thesis_gain['kept'])} "
            f"times as much at {last} "
            f"as at {first}",
            f"{factor(growth['kept'])} times as much (held up to {FLAT_SCENE:g})",
            flat,
            reason(
                flat,
                "a pixel looks up the same number of texels whatever the size",
                f"looking it up takes {factor(ms[last]['visibility'] / ms[first]['visibility'])} times as long at {last} as at "
                f"{first}",
            ),
        ),
        Claim(
            SPATIALACE,
            f"keeping the map is what makes a map of {CHOSEN_SIZE} bearable: redrawn frames take {factor(their_gain)} times as "
            f"long",
            f"{factor(redrawn_ratio / cached_ratio)} times as long (held from {TWICE:g} on)",
            pays,
            reason(
                pays,
                "drawing is most of what the shadow costs",
                f"the look-up is paid either way: a kept frame takes {factor(cached_ratio)} times as long as one without shadows, "
                f"a redrawn one {factor(redrawn_ratio)} times",
            ),
        ),
        Claim(
            SPATIALACE,
            f"16 bits of depth and {CHOSEN_SIZE} texels a side suffice: a little coarse, but far better than none",
            f"blocks' shadow shares are off by {percent(coverage)}, without shadows by {percent(coverage_without)}; 24 bits change "
            f"that by {format_largest(deeper)} at any size (held if off by at most {percent(MAX_COVERAGE_ERROR)}, by at most half "
            f"of that without, and if bits change at most {whole_percent(MAX_DEPTH_CHANGE)} of it)",
            suffices,
            f"a texel is {hidden_figures['texel_m']:.1f} m wide, "
            + reason(
                suffices,
                "next to which a step of 16 bits is small",
                "and edges are off by as much",
                "and what edges are off by is about what is allowed",
            ),
        ),
        Claim(
            SPATIALACE,
            "a map's self-shadow does not reach the edges; giving what is turned away from the sun the shadow's shade hides that",
            f"of the surface turned away a biased map of {CHOSEN_SIZE} alone leaves {percent(hidden_figures['lit'])} lit, and "
            f"{whole_percent(hidden_figures['lit_near'])} of that lies within {HIDDEN_TEXELS:g} texels, along the rays, of what "
            f"the sun meets first, where {whole_percent(hidden_figures['near'])} of all that is turned away lies; decided by the "
            f"normal, none of it is lit (held if at least {percent(MIN_LEAK)} is lit, near there at least {TWICE:g} times as often "
            f"as elsewhere)",
            hides,
            reason(
                hides,
                "where a surface has just turned away the map holds its own lit side, less than the bias before it; that is why "
                "attached shadow is decided before any algorithm here",
                "what the map leaves lit does not gather where surfaces turn away",
            ),
        ),
    ]
    table = [
        {
            "map": size,
            "redrawn": factor(frame[f"redrawn {size}"]["ratio"]),
            "kept": factor(frame[f"kept {size}"]["ratio"]),
            "theirs redrawn": factor(THEIR_FPS_WITHOUT / THEIR_FPS["redrawn"][k]),
            "theirs kept": factor(THEIR_FPS_WITHOUT / THEIR_FPS["kept"][k]),
            "map made": whole_percent(map_share[size]),
            "wrong_cast": percent(quality[size]["wrong_cast"]),
            "coverage": percent(quality[size]["coverage"]),
            "turned away, lit by the map": percent(figures["hidden"][size]["lit"]),
        }
        for k, size in enumerate(map(str, SIZES))
    ]
    return Section(
        "SpatialAce: maps redrawn and kept",
        f"`spatialace --view main`, {FRAME[0]} x {FRAME[1]}, one map of 16 bits. Times are those of whole frames, taken in turns, "
        f"medians of {REPEATS}, as ratios to frames without shadows (the thesis's: {THEIR_FPS_WITHOUT} frames a second over those "
        "with the map). `map made` is the share of fitting and drawing the map in the shadow time; `coverage` is the error of "
        "shadow shares in blocks.",
        [("Frames against frames without shadows, and errors", table)],
        claims,
    )
