"""Constants of the error model: the fit recovers known constants, and two ways to compute the sum agree."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from benchmarks.selection.fit import INITIAL_CONSTANTS, KINDS, MAP_ALGORITHMS, FitCase, _model, _Terms, cases_of, fit_model
from benchmarks.selection.policies import FOLDS, held_out_views, terrains
from skugga.selector.cost.error_model import (
    ERROR_OFFSET,
    INTERIOR_OFFSET,
    MIN_SPREAD,
    CoverageError,
    ErrorModel,
    HillCurve,
    SharedErrors,
    error_groups,
)
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.shadows.maps.settings import Cascade, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.plan import Step
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import DECIMATED_GROUP
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand, Casting, LightFacts
from skugga.terrain.level.level import SUN, CasterKind

CAST_SHARE = 0.4
SIZES = (512, 1024, 2048, 4096)

TRUE_MODEL = ErrorModel(
    counted={
        "relief": HillCurve(most=0.8, half_px=2.0, steepness=1.5),
        "meshes": HillCurve(most=1.4, half_px=6.0, steepness=0.9),
        "forest": HillCurve(most=0.9, half_px=0.8, steepness=1.1),
    },
    perspective=1.7,
    floor=dict.fromkeys(error_groups(), 0.0) | {"shadow_map": 2e-3, "perspective_shadow_map": 1e-3},
    interior=dict.fromkeys(error_groups(), 0.0),
    spread=dict.fromkeys(error_groups(), 0.0),
    interior_spread=dict.fromkeys(error_groups(), 0.0),
    time_spread=0.2,
    shared=SharedErrors(**dict.fromkeys(("error", "interior", "time"), SharedVariance(view=0.0, family=0.0))),
)


def make_descriptor(kind: CasterKind, far_px: float, most: float = 1.0) -> Descriptor:
    """Return a perspective view of 640 x 512 pixels with shadows in two octaves.

    ``far_px`` is the reach in pixels of differing shadow, of which there is at most ``most``.
    """
    ladder_px = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    bands = tuple(
        CastBand(
            near_m=near_m,
            far_m=2.0 * near_m,
            share=0.5,
            cast=CAST_SHARE,
            pixel_m=near_m / 400.0,
            differs=tuple(np.minimum(ladder_px / margin_px, most)),
        )
        for near_m, margin_px in ((32.0, far_px), (64.0, 2.0 * far_px))
    )
    lights = {SUN: LightFacts(cast_share=CAST_SHARE, casts={kind: Casting(share=CAST_SHARE, on_bodies=0.1, bands=bands)})}
    return Descriptor(
        view="main", view_kind="perspective", flat_world=True, pixel_m=0.1, pixel=0.0015, rows=512, cols=640, node_m=2.0,
        casters=(kind,), relief_m=20.0, block_relief_m=20.0, sun_azimuth_deg=140.0, sun_altitude_deg=30.0, highest_sun_deg=30.0,
        receivers_light_m=(200.0, 100.0, 100.0), lights=lights,
    )  # fmt: skip


def make_fit_case(descriptor: Descriptor, step: Step, error: float | None = None, inside: float = 0.0) -> FitCase:
    """Return a row with the error that the model ``TRUE_MODEL`` expects, or with a given one."""
    view = {"light": SUN, "error": "wrong_cast"}
    if error is None:
        error = FitCase(view, descriptor, (step,), {}).expected(TRUE_MODEL).wrong_cast
    return FitCase(
        view, descriptor, (step,), {"wrong_cast": error, "wrong": error * CAST_SHARE, "interior": inside * error * CAST_SHARE}
    )


def shadow_map_step(kind: CasterKind, texel_m: float) -> Step:
    """Return a step that draws shadows of a kind of casters with one shadow map. ``texel_m`` is the side of its texels."""
    cascades = (Cascade(far_m=None, texel_m=(texel_m, texel_m), depth_step_m=0.01),)
    return Step(SUN, (kind,), "shadow_map", ShadowMapSettings(map_size=1024, depth_bits=16, filter=3, cascades=cascades))


def map_cases(inside: float = 0.0) -> list[FitCase]:
    """Return maps of each kind of casters, from textures far finer than a pixel to far coarser ones.

    ``inside`` is the share of interior errors.
    """
    cases = []
    for kind in KINDS:
        for far_px in (80.0, 300.0, 1000.0):
            descriptor = make_descriptor(kind, far_px)
            cases += [
                make_fit_case(descriptor, shadow_map_step(kind, texel_m), inside=inside)
                for texel_m in 0.02 * 2.0 ** np.arange(0.0, 8.0)
            ]
            warped = (PerspectiveMapSettings(map_size=size, depth_bits=24, filter=3) for size in (128, 256, *SIZES))
            cases += [make_fit_case(descriptor, Step(SUN, (kind,), "perspective_shadow_map", settings)) for settings in warped]
    return cases


def test_the_fit_recovers_known_constants():
    model = fit_model(map_cases())
    for kind in get_args(CasterKind):
        fitted, expected = model.counted[kind], TRUE_MODEL.counted[kind]
        assert (fitted.most, fitted.half_px, fitted.steepness) == pytest.approx(
            (expected.most, expected.half_px, expected.steepness), rel=0.1
        ), kind
    assert model.perspective == pytest.approx(TRUE_MODEL.perspective, rel=0.05)
    assert model.floor["shadow_map"] == pytest.approx(2e-3, rel=0.1)
    assert model.floor["perspective_shadow_map"] == pytest.approx(1e-3, rel=0.1)
    assert model.spread["shadow_map"] == model.spread["perspective_shadow_map"] == MIN_SPREAD  # no scatter
    error_pairs = [(fit_case.expected(model).wrong_cast, fit_case.error) for fit_case in map_cases()]
    assert np.allclose(*np.transpose(error_pairs), rtol=0.02, atol=ERROR_OFFSET / 10.0)
    assert np.ptp([error for _, error in error_pairs]) > 0.3  # from fine to coarse; otherwise the test would show nothing


def test_unmeasured_constants_keep_their_initial_values():
    model = fit_model([fit_case for fit_case in map_cases() if "meshes" in fit_case.descriptor.casters])
    of_forest = model.counted["forest"]
    assert (of_forest.most, of_forest.half_px, of_forest.steepness) == pytest.approx(INITIAL_CONSTANTS[6:9], rel=1e-3)
    assert model.counted["meshes"].half_px == pytest.approx(6.0, rel=0.1)


def test_the_fit_recovers_floors_spreads_and_interior_errors():
    """Errors of volumes lie around 2 %. Their logarithms have a logistic distribution of scale 0.3, and a quarter of each
    error is interior. Errors of a sweep are always 0.4 %.
    """
    chances = (np.arange(200) + 0.5) / 200.0
    errors = (0.02 + ERROR_OFFSET) * (chances / (1.0 - chances)) ** 0.3 - ERROR_OFFSET
    descriptor, bare = make_descriptor("meshes", 100.0), make_descriptor("relief", 100.0)
    volumes = Step(SUN, ("meshes",), "shadow_volume", VolumeSettings())
    swept = Step(SUN, ("relief",), "sweep", SweepSettings())
    rows = [make_fit_case(descriptor, volumes, float(error), 0.25) for error in errors]
    rows += [make_fit_case(bare, swept, 0.004, 0.1) for _ in range(5)]
    model = fit_model([*map_cases(), *rows])
    assert model.floor["shadow_volume"] == pytest.approx(0.02, rel=0.01)
    assert model.spread["shadow_volume"] == pytest.approx(0.3, rel=0.03)
    assert model.floor["sweep"] == pytest.approx(0.004, rel=1e-6) and model.spread["sweep"] == MIN_SPREAD
    assert not {"hybrid", DECIMATED_GROUP} & set(model.floor)  # no row has these
    wrong_share = 0.004 * CAST_SHARE
    assert model.interior["sweep"] == pytest.approx((0.1 * wrong_share + INTERIOR_OFFSET) / (wrong_share + INTERIOR_OFFSET))
    assert "hybrid" not in model.interior
    # Interior errors scatter like errors; expected errors do not.
    assert model.interior["shadow_volume"] == pytest.approx(0.25, rel=0.05)
    assert model.interior_spread["shadow_volume"] == pytest.approx(0.3, rel=0.1)


def test_the_fit_recovers_the_errors_of_dense_woods():
    dense = make_descriptor("forest", 3.0, most=0.45)
    truth = CoverageError(share=0.3, floor=0.03, spread=MIN_SPREAD, interior=0.2, interior_spread=MIN_SPREAD)
    model = fit_model(map_cases(inside=0.5))
    steps = [shadow_map_step("forest", texel_m) for texel_m in 0.01 * 2.0 ** np.arange(0.0, 8.0)]
    cases = []
    for each in steps:
        pixels = FitCase({"light": SUN}, dense, (each,), {}).expected(model)
        errors = FitCase({"light": SUN}, dense, (each,), {}).expected(model.model_copy(update={"coverage": truth}))
        assert errors.is_coverage and errors.wrong_cast != pixels.wrong_cast
        row = {"coverage": errors.wrong_cast, "wrong": pixels.wrong, "interior": errors.interior}
        cases.append(FitCase({"light": SUN, "error": "coverage"}, dense, (each,), row))
    with_wood = fit_model([*map_cases(inside=0.5), *cases])
    assert with_wood.coverage is not None
    assert (with_wood.coverage.share, with_wood.coverage.floor) == pytest.approx((0.3, 0.03), rel=0.02)
    assert with_wood.coverage.interior == pytest.approx(0.2, rel=0.1)
    assert with_wood.model_copy(update={"coverage": None}) == model, "dense woods change no other constant"


@pytest.mark.parametrize(
    "perspective",
    [
        INITIAL_CONSTANTS[-3],
        3.0,
        0.4,
    ],
)
def test_the_vectorized_terms_equal_the_error_model(stored_table, perspective):
    """The test takes rows of views of every kind, and random constants around the initial values of the fit."""
    views, _ = stored_table
    sampled_views = [*{view["family"]: view for view in views}.values(), *views[::10]]
    cases = [
        fit_case
        for view in sampled_views
        for fit_case in cases_of(view)
        if fit_case.algorithms & set(MAP_ALGORITHMS) and "planar" not in fit_case.algorithms
    ]
    assert {kind for fit_case in cases for step in fit_case.steps for kind in step.kinds} == set(KINDS)
    assert {fit_case.descriptor.view_kind for fit_case in cases} == {"map", "perspective"} and {
        fit_case.light for fit_case in cases
    } > {SUN}
    terms, random = _Terms(cases), np.random.default_rng(0)
    for _ in range(3):
        constants = np.array(INITIAL_CONSTANTS) * np.exp(random.normal(0.0, 1.0, len(INITIAL_CONSTANTS)))
        constants[-3] = perspective
        expected = np.array([fit_case.expected(_model(constants)).wrong_cast for fit_case in cases])
        assert np.allclose(terms.expected(constants), expected, rtol=1e-9, atol=1e-12)
        assert np.ptp(expected) > 0.05


def test_views_without_cast_shadow_give_no_cases(stored_table):
    views, _ = stored_table
    shadowless_views = [view for view in views if view["error"] == "wrong"]
    assert shadowless_views and not any(cases_of(view) for view in shadowless_views)
    first = next(view for view in views if view["error"] == "wrong_cast")
    assert {fit_case.error for fit_case in cases_of(first)} <= {row["wrong_cast"] for row in first["rows"].values()}
    assert len(cases_of(first)) == len({name for choice, name in first["picks"].items() if not choice.startswith("rules ")})


def test_held_out_parts_share_no_terrain_with_the_fit(stored_table):
    views: list[dict[str, Any]] = stored_table[0]
    held_out, terrain_folds = held_out_views(views), terrains(views)
    for parts in (held_out, terrain_folds):
        names = [view["name"] for part in parts for view in part]
        assert sorted(names) == sorted(view["name"] for view in views) and len(set(names)) == len(names)
    assert len(held_out) == FOLDS and all(len({view["terrain"] for view in part}) == 1 for part in terrain_folds)
    places = [{view["terrain"] for view in part} for part in terrain_folds]
    assert sum(map(len, places)) == len(set.union(*places))  # no terrain is in two parts
    many = {name for name in set.union(*places) if sum(view["terrain"] == name for view in views) >= FOLDS}
    assert many and all(many <= {view["terrain"] for view in part} for part in held_out)
