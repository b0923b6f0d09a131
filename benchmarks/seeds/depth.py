"""Depth bits of shadow maps: shadows in mountains with 16, 24 and 32 bits, and the errors due to the quantisation of depths."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.spatialace import MAX_COVERAGE_ERROR
from benchmarks.seeds.verdicts import SPATIALACE, at_most, choose_reason, format_percent, format_whole_percent
from benchmarks.seeds.views import (
    ViewWithTruth,
    sees_sun_when_moved,
    shared_settings,
    single_map_overrides,
    view_with_truth,
    write_and_build_scene,
)
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import sun_maps
from skugga.shadows.truth.metrics import shadow_boundary_mask
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene

DEPTH_BITS = (16, 24, 32)
SUN_BY_ALTITUDE = {3: SunSpec(azimuth=205, altitude=3), 30: SunSpec(azimuth=205, altitude=30)}
"""Suns by their altitude in degrees."""
MAP_SIZE = 4096
"""Texels a side of the shadow map."""
SIZE_PX = (320, 320)
RELIEF_M, SIDE_M, MAP_SIDE_M = 2000, 12_000, 6000
"""Height of the mountains, side of the ground, and side of the map view."""
EYE_XY_M, FORWARD_XY = (0.0, 0.0), (0.6, 0.8)
"""Position of the eye, metres east and north of the ground's middle, and the unit vector of its view."""
RECEIVER_PLANE, POLYGON_OFFSET = "receiver_plane", "polygon_offset"
MAX_ERROR_STEPS = {RECEIVER_PLANE: 1.0, POLYGON_OFFSET: 4.5}
"""Maximum error of a depth, in quantisation steps of the map, by kind of bias. Half a step comes from rounding. The rest comes from
the bias: half a step, or the four units of polygon offset."""


def mountain_scene(folder: Path) -> Scene:
    """Return a scene of mountains 2,000 m high, with thin walls on a slope."""
    trimesh.creation.box(extents=(6.0, 0.2, 3.0)).export(folder / "wall.obj")
    rng = np.random.default_rng(2)
    eye, forward = np.array(EYE_XY_M), np.array(FORWARD_XY)
    distance_m, aside_m = rng.uniform(20.0, 600.0, 150), rng.uniform(-0.4, 0.4, 150)
    base = eye + distance_m[:, None] * (forward + aside_m[:, None] * np.array([-forward[1], forward[0]]))
    target = [*(eye + 300.0 * forward).tolist(), 0.0]
    ground = {"kind": "ridges", "size": [SIDE_M] * 2, "cell": 30, "relief": RELIEF_M, "seed": 5}
    level = {
        "version": 1,
        "terrain": {"generate": ground},
        "meshes": [{"source": "wall.obj", "at": base.round(1).tolist(), "turn": 30}],
        "views": {
            "perspective": {"kind": "perspective", "eye": [*eye.tolist(), 40], "target": target, "fov": 50},
            "map": {"kind": "map", "bounds": [-MAP_SIDE_M / 2, -MAP_SIDE_M / 2, MAP_SIDE_M / 2, MAP_SIDE_M / 2]},
        },
    }  # fmt: skip
    return write_and_build_scene(level, folder)


def measure() -> Figures:
    """Measure the errors by number of depth bits, in a map and in perspective, under a low and a high sun."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as folder:
        base_scene = mountain_scene(Path(folder))
        for altitude, sun in SUN_BY_ALTITUDE.items():
            scene = base_scene.with_sun(sun)
            for name in ("map", "perspective"):
                truth_view = view_with_truth(scene, name, SIZE_PX)
                figures[f"{name}, {altitude} degrees"] = {
                    bias: _errors_by_bits(truth_view, bias, altitude) for bias in MAX_ERROR_STEPS
                }
    return figures


def _errors_by_bits(truth_view: ViewWithTruth, bias: str, altitude_deg: float) -> dict[str, Any]:
    """Return errors of shadow maps by the number of depth bits.

    ``changed`` is the number of pixels whose class (shadow or lit) differs from that with 32 bits, as a share of the cast shadow.
    ``bound`` is an upper bound of ``changed``. ``healed`` is the part of ``changed`` that is lit in truth.
    """
    plans = {bits: truth_view.plan(single_map_overrides(MAP_SIZE, bias=bias, depth_bits=bits)) for bits in DEPTH_BITS}
    dark = {bits: np.nan_to_num(truth_view.visibility(plan), nan=1.0) < 0.5 for bits, plan in plans.items()}
    shaded = ~truth_view.truth.lit & truth_view.truth.valid & ~truth_view.truth.attached_shadow_mask
    result: dict[str, Any] = {"shadow": float(shaded.sum() / truth_view.truth.valid.sum())}
    for bits, plan in plans.items():
        settings = shared_settings(truth_view, plan)
        assert isinstance(settings, ShadowMapSettings)
        (shadow_map,) = sun_maps(truth_view.buffer, truth_view.scene, settings, None)
        step_m = shadow_map.uniforms["window_m"][2] * shadow_map.uniforms["depth_step"]
        max_error_m = MAX_ERROR_STEPS[bias] * step_m
        shift_px = max_error_m * np.cos(np.radians(altitude_deg)) / _pixel_m(truth_view)
        edge = shadow_boundary_mask(shaded, truth_view.truth.valid)
        result[str(bits)] = {
            "wrong_cast": truth_view.errors(np.where(truth_view.buffer.valid, 1.0 - dark[bits], np.nan))["wrong_cast"],
            "step_m": step_m, "texels": step_m / max(shadow_map.uniforms["texel_m"]),
            "shift_px": float(np.median(shift_px[edge])), "bound": float(2.0**0.5 * shift_px[edge].sum() / shaded.sum()),
            "near": float((shaded & sees_sun_when_moved(truth_view, truth_view.buffer, max_error_m)).sum() / shaded.sum()),
            "changed": float((dark[bits] != dark[DEPTH_BITS[-1]]).sum() / shaded.sum()),
            "healed": float(((dark[bits] != dark[DEPTH_BITS[-1]]) & truth_view.truth.lit).sum() / shaded.sum()),
        }  # fmt: skip
    return result


def _pixel_m(truth_view: ViewWithTruth) -> np.ndarray:
    """Return the side of each pixel (rows, cols) on a surface that faces the viewer, metres."""
    if isinstance(truth_view.view, MapView):
        return np.full(truth_view.buffer.valid.shape, truth_view.descriptor.pixel_m)
    return truth_view.view_depth_m * truth_view.view.pixel_tangent


MAX_CHANGED_SHARE = 1e-4
"""Largest share of the cast shadow that may differ between two numbers of bits with equal accuracy."""


def make_section(figures: Figures) -> Section:
    """Format the claims on depth bits, and the tables of errors."""
    cases = {(name, bias): case for name, by_bias in figures.items() if isinstance(by_bias, dict) for bias, case in by_bias.items()}
    rows_with_fewer_bits = [(key, bits, case[bits]) for key, case in cases.items() for bits in map(str, DEPTH_BITS[:-1])]
    rows_over_bound = [(key, bits, row) for key, bits, row in rows_with_fewer_bits if row["changed"] > row["bound"]]
    changed = {
        (bits, bias): max(
            row["changed"] for (_, row_bias), row_bits, row in rows_with_fewer_bits if (row_bias, row_bits) == (bias, bits)
        )
        for bits in map(str, DEPTH_BITS[:-1])
        for bias in MAX_ERROR_STEPS
    }
    max_error_increase = {
        bias: max(abs(_error_increase(case)) for (_, key_bias), case in cases.items() if key_bias == bias)
        for bias in MAX_ERROR_STEPS
    }
    worst_case = max(cases, key=lambda key: abs(_error_increase(cases[key])))
    in_texels = max(case["16"]["texels"] for case in cases.values())
    lit_shares = {
        bits: _lit_share([row for (_, bias), row_bits, row in rows_with_fewer_bits if (bias, row_bits) == (POLYGON_OFFSET, bits)])
        for bits in ("16", "24")
    }
    within_bound = not rows_over_bound
    bits_suffice = at_most(max(max_error_increase.values()), MAX_COVERAGE_ERROR)
    is_no_finer = at_most(max(changed["24", bias] for bias in MAX_ERROR_STEPS), MAX_CHANGED_SHARE)
    cases_text = "; ".join(f"{name} with `{bias}` of {bits} bits" for (name, bias), bits, _ in rows_over_bound)
    acne_reason = (
        f"with `{POLYGON_OFFSET}` {format_whole_percent(lit_shares['24'])} of what changes are lit points: acne, which is no edge "
        "of a "
        "shadow. Its four "
        "units are steps of 24 bits in the one map, and of the float's own exponent in the other, smaller where depths are below "
        "1/2"
    )
    claims = [
        Claim(
            "derived here",
            "a depth that is off by e shifts the start of a shadow on level ground by e cos(altitude), so that no more of it "
            "changes than its edge is long times that",
            f"at 16 bits at most {format_percent(changed['16', RECEIVER_PLANE])} of the cast shadow changes with "
            f"`{RECEIVER_PLANE}`, "
            f"{format_percent(changed['16', POLYGON_OFFSET])} with `{POLYGON_OFFSET}`; over the bound: {len(rows_over_bound)} of "
            f"{len(rows_with_fewer_bits)} cases (held if none)",
            within_bound,
            choose_reason(
                within_bound,
                "of the edge only the part where shadow begins can move, not the one that a far crest throws, and walls and "
                f"slopes are thicker than a step; with `{POLYGON_OFFSET}` {format_whole_percent(lit_shares['16'])} of what changes "
                "at "
                "16 bits are lit "
                "points: acne that the larger units hide",
                f"it is over in: {cases_text}; {format_whole_percent(_lit_share([row for _, _, row in rows_over_bound]))} of what "
                "changes "
                "there are "
                "lit points: acne, which is no edge of a shadow and comes and goes with the offset's unit",
            ),
        ),
        Claim(
            SPATIALACE,
            "16 bits suffice for a landscape under the sun (the thesis calls its shadows a little coarse: so the bits have to "
            f"cost no more than {format_percent(MAX_COVERAGE_ERROR)} of the cast shadow, the error that the engine allows unless "
            "asked "
            f"for less)",
            f"16 bits change the wrong share of the cast shadow by at most {format_percent(max_error_increase[RECEIVER_PLANE])} "
            "with "
            f"`{RECEIVER_PLANE}`, by "
            f"{format_percent(max_error_increase[POLYGON_OFFSET])} with `{POLYGON_OFFSET}`, up or down, beside 32 bits, over "
            f"{RELIEF_M} m of "
            "relief (held if at most "
            f"{format_percent(MAX_COVERAGE_ERROR)})",
            bits_suffice,
            f"a step of 16 bits is up to {in_texels:.2f} of a texel"
            + choose_reason(
                bits_suffice,
                f", since a map of {MAP_SIZE} texels has fewer of them than 65,535: texels are what an edge is off by. Most "
                f"changes in {worst_case[0]} with `{worst_case[1]}`, where 16 bits are "
                f"{'worse' if _error_increase(cases[worst_case]) > 0.0 else 'better'}"
                + (
                    f": their larger units hide acne ({format_whole_percent(lit_shares['16'])} of what changes are lit points)"
                    if worst_case[1] == POLYGON_OFFSET and _error_increase(cases[worst_case]) < 0.0
                    else ""
                ),
                "",
            ),
        ),
        Claim(
            "shadows/maps/shadow_map.py",
            "the sun's map of 32 bits is no finer than that of 24",
            f"at most {format_percent(changed['24', RECEIVER_PLANE])} of the cast shadow changes with `{RECEIVER_PLANE}`, "
            f"{format_percent(changed['24', POLYGON_OFFSET])} "
            f"with `{POLYGON_OFFSET}` (held if at most {format_percent(MAX_CHANGED_SHARE)} with either)",
            is_no_finer,
            choose_reason(
                is_no_finer,
                "a float's steps near 1 are those of 24 bits, and both are far below what float32 makes of positions",
                acne_reason
                if changed["24", RECEIVER_PLANE] <= MAX_CHANGED_SHARE
                else "a float's steps are finer than those of 24 bits wherever depths are below 1/2",
            ),
        ),
    ]
    table = [
        {
            "view, sun": name,
            "bias": bias,
            "bits": bits,
            "step": f"{row['step_m']:.2f} m" if row["step_m"] >= 0.01 else f"{1000.0 * row['step_m']:.2g} mm",
            "shift": f"{row['shift_px']:.2f} px" if row["shift_px"] >= 0.005 else "under 0.01 px",
            "changed": format_percent(row["changed"]),
            "may change": format_percent(row["near"]),
            "bound": format_percent(row["bound"]),
            "wrong_cast (32 bits)": (
                f"{format_percent(row['wrong_cast'])} ({format_percent(cases[name, bias]['32']['wrong_cast'])})"
            ),
        }
        for (name, bias), bits, row in rows_with_fewer_bits
    ]
    return Section(
        "The bits of a depth",
        f"Generated mountains of {RELIEF_M} m over {SIDE_M // 1000} km, with thin walls on a slope; the map shows the middle half "
        f"a side. {SIZE_PX[0]} x {SIZE_PX[1]} pixels, one map of {MAP_SIZE}, one tap. A point that is e behind its caster, along "
        "the "
        f"ray, lies e cos(altitude) from the foot of an upright caster on level ground. `{RECEIVER_PLANE}` may be off by one "
        "step (half for "
        f"the rounding of drawn depths, half for the bias), `{POLYGON_OFFSET}` by four units and a half. `shift` is the median "
        "over edge "
        "pixels. `bound` is the length of the edges (times the root of 2, for slanting ones) times the shift at each, over the "
        "cast shadow. `changed` is the difference from 32 bits. `may change` is the share of the cast shadow, by rays, that lies "
        "so little behind the first caster that the sun meets (without acne).",
        [("Depth's bits", table)],
        claims,
    )


def _error_increase(case_figures: Figures) -> float:
    """Return the increase of the share of wrong pixels from 32 to 16 bits."""
    return case_figures["16"]["wrong_cast"] - case_figures["32"]["wrong_cast"]


def _lit_share(rows: list[Figures]) -> float:
    """Return the share of lit pixels in truth, among the pixels that change with the number of bits."""
    return sum(row["healed"] for row in rows) / max(sum(row["changed"] for row in rows), 1e-30)
