"""Replication of the bachelor's report of Copenhagen: bias, culling and filter taps of shadow maps."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.seeds.claims import Claim, Figures, Section
from benchmarks.seeds.verdicts import (
    COPENHAGEN_REPORT,
    all_of,
    at_least,
    at_most,
    choose_reason,
    format_by_scene,
    format_percent,
    format_ratio,
    negate,
)
from benchmarks.seeds.views import (
    ShadowOverrides,
    ViewWithTruth,
    bundled_scene,
    shared_settings,
    single_map_overrides,
    view_with_truth,
)
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import sun_maps
from skugga.shadows.passes import PassLog
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.level.level import SUN

VIEWS = {
    "street": ("thesis_street_sun", "main"),
    "rocks": ("thesis_rocks_sun", "main"),
    "alpine": ("jacksboro_alpine", "map"),
}
CLOSED_SCENES = ("street", "rocks")
"""Scenes in which only closed meshes cast shadows. In the other scene the ground casts shadows on itself."""

SIZE_PX, MAP_SIZE = (512, 512), 1024
COARSE_MAP_SIZE = 256
"""Size of a coarser map, on which the formulas of the bias are compared too."""

TAPS_PER_SIDE = (1, 2, 3)
"""Taps a side of the compared filters."""
BIAS_SCALES = (0.0, 0.25, 1.0, 4.0, 16.0)
"""Multiples of the engine's amount of bias that are compared."""
MAX_SLOPE_BIAS = 0.005
"""The report's upper bound of the bias, in depths from 0 to 1."""

BIAS_CONSTANTS = tuple(float(b) for b in np.geomspace(1e-6, 3e-2, 16))
"""Constants b of the report's formula that are compared."""

BIAS_FORMULAS = ("constant", "slope", "clamped")
"""Names of the compared formulas of the bias (``_wrong_cast_by_formula``)."""
MIN_ACNE_RATIO, MIN_PETER_PANNING_RATIO, MAX_EQUAL_RATIO = 10.0, 2.0, 1.5
"""Ratios of two errors. From the first on, false shadow counts as acne. From the second on, missed shadow counts as peter-panning.
Up to the last, two errors count as equal."""

NO_BIAS_ROW, SLOPE_BIAS_ROW, EXCESSIVE_BIAS_ROW = (f"polygon_offset x {scale:g}" for scale in (0.0, 1.0, 16.0))
MESHES_BIASED_ROW, MESHES_UNBIASED_ROW, FRONT_CULLED_ROW = "bodies x 1", "bodies x 0", "bodies, front culled x 0"


def measure() -> Figures:
    """Measure the errors of a shadow map with several kinds and amounts of bias, numbers of taps, and sides of culled faces."""
    figures: Figures = {}
    for scene, (level, view_name) in VIEWS.items():
        truth_view = view_with_truth(bundled_scene(level), view_name, SIZE_PX)
        rows: dict[str, ShadowOverrides] = {
            f"{bias}, {taps}": {"bias": bias, "filter": taps}
            for bias in ("receiver_plane", "polygon_offset")
            for taps in TAPS_PER_SIDE
        }
        rows |= {f"polygon_offset x {scale:g}": {"bias": "polygon_offset", "bias_scale": scale} for scale in BIAS_SCALES}
        rows |= {f"normal_offset x {scale:g}": {"bias": "normal_offset", "bias_scale": scale} for scale in (1.0, 4.0)}
        if scene in CLOSED_SCENES:
            mesh_overrides = {"algorithm": {"meshes": "shadow_map"}, "bias": "polygon_offset"}
            rows |= {
                MESHES_UNBIASED_ROW: {**mesh_overrides, "bias_scale": 0.0},
                MESHES_BIASED_ROW: {**mesh_overrides, "bias_scale": 1.0},
            }
            rows |= {FRONT_CULLED_ROW: {**mesh_overrides, "bias_scale": 0.0, "culling": "front"}}
        figures[scene] = {
            "rows": {
                row: _errors_with_bias(truth_view, single_map_overrides(MAP_SIZE, **overrides)) for row, overrides in rows.items()
            },
            "formulas": {str(size): _wrong_cast_by_formula(truth_view, size) for size in (COARSE_MAP_SIZE, MAP_SIZE)},
        }
    return figures


def _errors_with_bias(truth_view: ViewWithTruth, overrides: ShadowOverrides) -> dict[str, float]:
    """Return the errors of a shadow map with some overrides, such as its bias, as shares in [0, 1].

    Two further figures describe the visibility of points that face the sun. ``partial`` is the share of points with a visibility
    strictly between 0 and 1. ``off`` is the mean absolute error of the visibility. ``missed_cast``, ``missed_ground`` and
    ``missed_bodies`` are the lit shares of all points in cast shadow, of those on the ground and of those on meshes.
    """
    visibility, decided = truth_view.visibility(truth_view.plan(overrides)), truth_view.truth.decidable & truth_view.receivers
    partial = (visibility > 0.0) & (visibility < 1.0) & truth_view.receivers
    shaded, ground = decided & ~truth_view.truth.lit, truth_view.buffer.surface_kind == RELIEF
    figures = truth_view.errors(visibility)
    return {
        **{key: figures[key] for key in ("wrong_cast", "false_shadow", "missed_shadow")},
        **{
            f"missed_{name}": float((visibility >= 0.5)[shaded & part].sum() / max((shaded & part).sum(), 1))
            for name, part in (("ground", ground), ("bodies", ~ground))
        },
        "missed_cast": float((visibility >= 0.5)[shaded].sum() / max(shaded.sum(), 1)),
        "partial": float(partial.sum() / truth_view.receivers.sum()),
        "off": float(np.abs(visibility - truth_view.truth.lit)[decided].mean()),
    }


def _wrong_cast_by_formula(truth_view: ViewWithTruth, size: int) -> dict[str, Any]:
    """Return the share of wrong pixels (``wrong_cast``) for three formulas of the depth bias, with each constant b.

    The formulas are b itself, b tan(acos(n.l)), and the latter clamped to the report's bound. All use the same drawn map of
    ``size`` texels a side, with one tap per point. ``texel`` is the side of a texel as a share of the map's range of depths.
    """
    plan, log = (
        truth_view.plan(single_map_overrides(size, bias="polygon_offset", bias_scale=0.0)),
        PassLog(requested_layers=frozenset({"shadow-map"})),
    )
    truth_view.visibility(plan, log)
    (depths,) = log.layers["shadow-map", SUN]
    settings = shared_settings(truth_view, plan)
    assert isinstance(settings, ShadowMapSettings)
    (shadow_map,) = sun_maps(truth_view.buffer, truth_view.scene, settings, None)
    rotation = np.reshape(shadow_map.uniforms["light_from_frame"], (3, 3)).T
    receivers = truth_view.receivers
    in_light = truth_view.buffer.position_frame_m[receivers] @ rotation.T + shadow_map.uniforms["light_offset_m"]
    col, row = np.floor(in_light[:, :2] / shadow_map.uniforms["texel_m"]).astype(int).T
    depth, stored = in_light[:, 2] / shadow_map.uniforms["window_m"][2], depths[::-1][row, col]
    tangent = np.tan(np.arccos(np.clip(-(truth_view.buffer.normal_frame[receivers] @ rotation.T)[:, 2], 1e-6, 1.0)))
    wrong_shares: dict[str, list[float]] = {"constant": [], "slope": [], "clamped": []}
    for b in BIAS_CONSTANTS:
        for name, bias in (("constant", b), ("slope", b * tangent), ("clamped", np.minimum(b * tangent, MAX_SLOPE_BIAS))):
            dark = np.zeros(receivers.shape, bool)
            dark[receivers] = depth - bias > stored
            wrong_shares[name].append(_wrong_cast(truth_view, dark))
    return {**wrong_shares, "texel": float(max(shadow_map.uniforms["texel_m"]) / shadow_map.uniforms["window_m"][2])}


def _wrong_cast(truth_view: ViewWithTruth, dark: np.ndarray) -> float:
    """Return ``wrong_cast`` of ``skugga.shadows.truth.metrics.ErrorMetrics`` without computing the slower edge distances.

    ``dark`` is the mask of pixels in shadow (rows, cols).
    """
    truth = truth_view.truth
    cast = truth.decidable & ~truth.attached_shadow_mask & (dark | ~truth.lit)
    return float((cast & (dark == truth.lit)).sum() / max(cast.sum(), 1))


def make_section(figures: Figures) -> Section:
    """Format the claims on bias, culling and filter taps, and the tables of errors."""

    def format_shares(values: dict[str, float]) -> str:
        return format_by_scene(values, format_percent)

    def values_of(row: str, metric: str, scenes: tuple[str, ...] = tuple(VIEWS)) -> dict[str, float]:
        return {scene: figures[scene]["rows"][row][metric] for scene in scenes}

    def at_least_times(scene_values: dict[str, float], ratio: float, reference_values: dict[str, float]) -> bool | None:
        return all_of(at_least(scene_values[scene], ratio * reference_values[scene]) for scene in scene_values)

    def at_most_times(scene_values: dict[str, float], ratio: float, reference_values: dict[str, float]) -> bool | None:
        return all_of(at_most(scene_values[scene], ratio * reference_values[scene]) for scene in scene_values)

    acne, panning = values_of(NO_BIAS_ROW, "false_shadow"), values_of(EXCESSIVE_BIAS_ROW, "missed_shadow")
    worst_regrets = {name: _min_worst_regret(figures, name) for name in BIAS_FORMULAS}
    mean_best_shares = {name: _mean_best_wrong_share(figures, name) for name in BIAS_FORMULAS}
    texels = [case["texel"] for case in _formula_cases(figures)]
    shows_acne = at_least_times(acne, MIN_ACNE_RATIO, values_of(SLOPE_BIAS_ROW, "false_shadow"))
    shows_panning = at_least_times(panning, MIN_PETER_PANNING_RATIO, values_of(SLOPE_BIAS_ROW, "missed_shadow"))
    none_fits = negate(at_most(worst_regrets["constant"], MAX_EQUAL_RATIO))
    slope_helps = at_most(worst_regrets["slope"], worst_regrets["constant"])
    clamp_helps = at_most(mean_best_shares["clamped"], mean_best_shares["slope"])
    culled, biased, unbiased = (
        values_of(row, "wrong_cast", CLOSED_SCENES) for row in (FRONT_CULLED_ROW, MESHES_BIASED_ROW, MESHES_UNBIASED_ROW)
    )
    culling_replaces_bias = at_most_times(culled, MAX_EQUAL_RATIO, biased)
    missed_cast, missed_ground, missed_bodies = (
        [values_of(row, f"missed_{part}", CLOSED_SCENES) for row in (FRONT_CULLED_ROW, MESHES_BIASED_ROW)]
        for part in ("cast", "ground", "bodies")
    )
    no_panning = at_most_times(missed_cast[0], MAX_EQUAL_RATIO, missed_cast[1])
    cull_reason = (
        f"on the ground {format_shares(missed_ground[0])} is missed, with the slope's bias {format_shares(missed_ground[1])}; on "
        "the bodies "
        f"{format_shares(missed_bodies[0])}, and {format_shares(missed_bodies[1])}"
    )
    partial_shares = {taps: values_of(f"receiver_plane, {taps}", "partial") for taps in TAPS_PER_SIDE}
    taps_soften_edges = all_of(
        all_of(
            (
                partial_shares[1][scene] == 0.0,
                partial_shares[2][scene] > 0.0,
                at_least(partial_shares[3][scene], partial_shares[2][scene]),
            )
        )
        for scene in VIEWS
    )
    claims = [
        Claim(
            COPENHAGEN_REPORT,
            "with too little bias there is acne",
            f"false shadow without bias: {format_shares(acne)}; with the slope's: "
            f"{format_shares(values_of(SLOPE_BIAS_ROW, 'false_shadow'))} "
            "(held if "
            "at least "
            f"{MIN_ACNE_RATIO:g} times that)",
            shows_acne,
            choose_reason(
                shows_acne,
                "a texel's depth is that of its centre, which lies nearer to the sun than about half of the points in the texel",
                "something else keeps surfaces from shading themselves",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "with too much there is peter-panning: shadow begins away from what throws it",
            f"missed shadow at {BIAS_SCALES[-1]:g} times the slope's bias: {format_shares(panning)}; at the slope's own: "
            f"{format_shares(values_of(SLOPE_BIAS_ROW, 'missed_shadow'))} (held if at least {MIN_PETER_PANNING_RATIO:g} times "
            "that)",
            shows_panning,
            choose_reason(
                shows_panning,
                "what lies less behind its caster than the bias counts as lit",
                "few points lie so little behind their casters",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "no one bias is right: it depends on the scene and on the map's resolution",
            f"the constant that serves all scenes and both maps ({COARSE_MAP_SIZE} and {MAP_SIZE}) best has up to "
            f"{format_ratio(worst_regrets['constant'])} times the wrong share of each one's own best (held if over "
            f"{MAX_EQUAL_RATIO:g})",
            none_fits,
            f"what is needed goes with the texel, as a share of the range of depths {format_percent(min(texels))} to "
            f"{format_percent(max(texels))} here"
            + choose_reason(
                none_fits,
                "",
                f", but too much costs little: in each case the constants within {MAX_EQUAL_RATIO:g} times of its best span a "
                "factor of "
                f"{format_ratio(_min_tolerated_range(figures))} or more apart, and these ranges overlap",
                f", and the constant that serves all is about {MAX_EQUAL_RATIO:g} times as wrong as the best",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "the bias has to follow the slope: b tan(acos(n.l))",
            f"the b that serves all best has up to {format_ratio(worst_regrets['slope'])} times the wrong share of each one's own "
            "best, a "
            f"constant {format_ratio(worst_regrets['constant'])} times (held if less); each with its own best, the mean wrong "
            "share is "
            f"{format_percent(mean_best_shares['slope'])} and {format_percent(mean_best_shares['constant'])}",
            slope_helps,
            choose_reason(
                slope_helps,
                "a plane's depth changes by the tangent over a texel, so one b is right on all slopes of a scene; the texel is "
                "still in it",
                "the tangent takes care of slopes, but not of the texel's size, which a b still has to be found for, and it "
                "grows without bound where light grazes",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            f"held to at most {MAX_SLOPE_BIAS} of the depths it is best",
            f"mean wrong share, each with its own best b: {format_percent(mean_best_shares['clamped'])} with the bound, "
            f"{format_percent(mean_best_shares['slope'])} "
            "without (held if less)",
            clamp_helps,
            choose_reason(
                clamp_helps,
                "without a bound grazing surfaces are moved past all that touches them",
                "the bound belongs to the report's own maps: where texels are larger it cuts off bias that is needed, and acne "
                "comes back",
                "the bound hardly matters for the best b",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "in a map of the back faces of closed meshes alone, with the normals asked, no bias is needed",
            f"wrong of the cast shadow, front faces culled and no bias: {format_shares(culled)}; with the slope's bias and no "
            "culling: "
            f"{format_shares(biased)}; neither: {format_shares(unbiased)} (held if at most {MAX_EQUAL_RATIO:g} times the second)",
            culling_replaces_bias,
            choose_reason(
                culling_replaces_bias,
                "what is lit lies a body's thickness before what the map holds",
                "bodies touch and pass into one another: where a lit face lies on a back face or just behind one, the two fight",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "and there is no peter-panning then",
            f"cast shadow that is missed, front faces culled and no bias: {format_shares(missed_cast[0])}; with the slope's bias: "
            f"{format_shares(missed_cast[1])} (held if at most {MAX_EQUAL_RATIO:g} times that)",
            no_panning,
            choose_reason(
                no_panning,
                f"nothing is moved, so shadow begins where the back face does: {cull_reason}",
                f"{cull_reason}. Nothing is moved, so on the ground shadow begins where it should; but bodies that touch or pass "
                "into one another have back faces on the very faces that they shade, or behind them, and those are lit",
            ),
        ),
        Claim(
            COPENHAGEN_REPORT,
            "2 x 2 and 3 x 3 taps make edges ever softer",
            f"points in half shadow, by taps a side: "
            f"{'; '.join(f'{taps}: {format_shares(tap_values)}' for taps, tap_values in partial_shares.items())} "
            "(held if none with one, and the more with more)",
            taps_soften_edges,
            "a point at an edge is lit by the share of its taps that are; a bias made for one tap does not do for more: at 3 x 3 "
            f"visibility is off by {format_shares(values_of('polygon_offset, 3', 'off'))} with `polygon_offset`, with "
            "`receiver_plane` by "
            f"{format_shares(values_of('receiver_plane, 3', 'off'))}",
        ),
    ]
    keys = ("wrong_cast", "false_shadow", "missed_shadow", "partial", "off")
    tables = [
        (
            f"`{level} --view {name}`",
            [
                {"map": row, **{key: format_percent(row_figures[key]) for key in keys}}
                for row, row_figures in figures[scene]["rows"].items()
            ],
        )
        for scene, (level, name) in VIEWS.items()
    ]
    return Section(
        "Bias, culling and taps",
        f"{SIZE_PX[0]} x {SIZE_PX[1]} pixels, one map of {MAP_SIZE} and 24 bits, one tap or as many a side as named. `x` is the "
        "scale of "
        "the bias (0: none). `bodies` are maps of the meshes alone, without the level ground. `partial` is the share of points "
        "facing the sun that are neither lit nor in shadow; `off` is the error of their visibility. The report's formulas use "
        f"the same maps as drawn, for {len(BIAS_CONSTANTS)} values of b from {BIAS_CONSTANTS[0]:g} to {BIAS_CONSTANTS[-1]:g} of "
        f"the map's depths.",
        tables,
        claims,
    )


def _formula_cases(figures: Figures) -> list[dict[str, Any]]:
    """Return the results of ``_wrong_cast_by_formula``, one for each scene and map size."""
    return [case for scene in VIEWS for case in figures[scene]["formulas"].values()]


def _min_worst_regret(figures: Figures, formula: str) -> float:
    """Return the worst regret of the single constant whose worst regret is least.

    The regret of a constant in a case is the ratio of its wrong share to that of the case's own best constant.
    """
    wrong_shares = np.array([case[formula] for case in _formula_cases(figures)])
    return float((wrong_shares / wrong_shares.min(axis=1, keepdims=True)).max(axis=0).min())


def _min_tolerated_range(figures: Figures) -> float:
    """Return the ratio of the largest to the smallest good constant bias, the minimum over the cases.

    A constant is good if its wrong share is at most ``MAX_EQUAL_RATIO`` times the least wrong share of the case.
    """
    wrong_shares = (np.array(case["constant"]) for case in _formula_cases(figures))
    near_best = [np.flatnonzero(row <= MAX_EQUAL_RATIO * row.min()) for row in wrong_shares]
    return min(BIAS_CONSTANTS[good_indices[-1]] / BIAS_CONSTANTS[good_indices[0]] for good_indices in near_best)


def _mean_best_wrong_share(figures: Figures, formula: str) -> float:
    """Return the mean wrong share of a formula over the cases, each with its own best constant."""
    return float(np.mean([min(case[formula]) for case in _formula_cases(figures)]))
