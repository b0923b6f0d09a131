"""Constants of the error model: the fit recovers known constants, and two ways to compute the sum agree."""

from __future__ import annotations

from typing import Any, get_args

import numpy as np
import pytest

from benchmarks.selection.fit import KINDS, MAP_ALGORITHMS, START, FitCase, _model, _Terms, cases_of, fit_model
from benchmarks.selection.policies import FOLDS, held_out_views, terrains
from skugga.selector.cost.error_model import (
    ERROR_OFFSET,
    INTERIOR_OFFSET,
    MIN_SPREAD,
    ErrorModel,
    HillCurve,
    SharedErrors,
    error_groups,
)
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.shadows.maps.settings import Cascade, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.plan import Step
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import DECIMATED
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand, Casting, LightFacts
from skugga.terrain.level.level import SUN, CasterKind

CAST = 0.4
SIZES = (512, 1024, 2048, 4096)

TRUE = ErrorModel(
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


def described(kind: CasterKind, far_px: float) -> Descriptor:
    """Return a perspective view of 640 x 512 pixels with shadows in two octaves.

    ``far_px`` is the reach in pixels of differing shadow.
    """
    ladder_px = np.array([0.25, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0])
    bands = tuple(
        CastBand(
            near_m=near_m, far_m=2.0 * near_m, share=0.5, cast=CAST, pixel_m=near_m / 400.0, differs=tuple(ladder_px / reach_px)
        )
        for near_m, reach_px in ((32.0, far_px), (64.0, 2.0 * far_px))
    )
    lights = {SUN: LightFacts(cast_share=CAST, casts={kind: Casting(share=CAST, on_bodies=0.1, bands=bands)})}
    return Descriptor(
        view="main", view_kind="perspective", flat_world=True, pixel_m=0.1, pixel=0.0015, rows=512, cols=640, node_m=2.0,
        casters=(kind,), relief_m=20.0, block_relief_m=20.0, sun_azimuth_deg=140.0, sun_altitude_deg=30.0, highest_sun_deg=30.0,
        receivers_light_m=(200.0, 100.0, 100.0), lights=lights,
    )  # fmt: skip


def case(descriptor: Descriptor, step: Step, error: float | None = None, inside: float = 0.0) -> FitCase:
    """Return a row with the error that the model ``TRUE`` expects, or with a given one."""
    view = {"light": SUN, "error": "wrong_cast"}
    if error is None:
        error = FitCase(view, descriptor, (step,), {}).expected(TRUE).wrong_cast
    return FitCase(view, descriptor, (step,), {"wrong_cast": error, "wrong": error * CAST, "interior": inside * error * CAST})


def uniform(kind: CasterKind, texel_m: float) -> Step:
    cascades = (Cascade(far_m=None, texel_m=(texel_m, texel_m), depth_step_m=0.01),)
    return Step(SUN, (kind,), "shadow_map", ShadowMapSettings(map_size=1024, depth_bits=16, filter=3, cascades=cascades))


def made() -> list[FitCase]:
    """Return maps of each kind of casters, from textures far finer than a pixel to far coarser ones."""
    cases = []
    for kind in KINDS:
        for far_px in (80.0, 300.0, 1000.0):
            descriptor = described(kind, far_px)
            cases += [case(descriptor, uniform(kind, texel_m)) for texel_m in 0.02 * 2.0 ** np.arange(0.0, 8.0)]
            warped = (PerspectiveMapSettings(map_size=size, depth_bits=24, filter=3) for size in (128, 256, *SIZES))
            cases += [case(descriptor, Step(SUN, (kind,), "perspective_shadow_map", its)) for its in warped]
    return cases


def test_the_fit_recovers_known_constants():
    found = fit_model(made())
    for kind in get_args(CasterKind):
        its, true = found.counted[kind], TRUE.counted[kind]
        assert (its.most, its.half_px, its.steepness) == pytest.approx((true.most, true.half_px, true.steepness), rel=0.1), kind
    assert found.perspective == pytest.approx(TRUE.perspective, rel=0.05)
    assert found.floor["shadow_map"] == pytest.approx(2e-3, rel=0.1)
    assert found.floor["perspective_shadow_map"] == pytest.approx(1e-3, rel=0.1)
    assert found.spread["shadow_map"] == found.spread["perspective_shadow_map"] == MIN_SPREAD  # no scatter
    again = [(one.expected(found).wrong_cast, one.error) for one in made()]
    assert np.allclose(*np.transpose(again), rtol=0.02, atol=ERROR_OFFSET / 10.0)
    assert np.ptp([error for _, error in again]) > 0.3  # from fine to coarse; otherwise the test would show nothing


def test_unmeasured_constants_keep_their_initial_values():
    found = fit_model([one for one in made() if "meshes" in one.descriptor.casters])
    of_forest = found.counted["forest"]
    assert (of_forest.most, of_forest.half_px, of_forest.steepness) == pytest.approx(START[6:9], rel=1e-3)
    assert found.counted["meshes"].half_px == pytest.approx(6.0, rel=0.1)


def test_the_fit_recovers_floors_spreads_and_interior_errors():
    """Errors of volumes lie around 2 %. Their logarithms have a logistic distribution of scale 0.3, and a quarter of each
    error is interior. Errors of a sweep are always 0.4 %.
    """
    chances = (np.arange(200) + 0.5) / 200.0
    errors = (0.02 + ERROR_OFFSET) * (chances / (1.0 - chances)) ** 0.3 - ERROR_OFFSET
    descriptor, bare = described("meshes", 100.0), described("relief", 100.0)
    volumes = Step(SUN, ("meshes",), "shadow_volume", VolumeSettings())
    swept = Step(SUN, ("relief",), "sweep", SweepSettings())
    rows = [case(descriptor, volumes, float(error), 0.25) for error in errors]
    rows += [case(bare, swept, 0.004, 0.1) for _ in range(5)]
    found = fit_model([*made(), *rows])
    assert found.floor["shadow_volume"] == pytest.approx(0.02, rel=0.01)
    assert found.spread["shadow_volume"] == pytest.approx(0.3, rel=0.03)
    assert found.floor["sweep"] == pytest.approx(0.004, rel=1e-6) and found.spread["sweep"] == MIN_SPREAD
    assert found.floor["hybrid"] == found.floor[DECIMATED] == 0.0  # no row has these
    its = 0.004 * CAST
    assert found.interior["sweep"] == pytest.approx((0.1 * its + INTERIOR_OFFSET) / (its + INTERIOR_OFFSET))
    assert found.interior["hybrid"] == 0.0
    # Interior errors scatter like errors; expected errors do not.
    assert found.interior["shadow_volume"] == pytest.approx(0.25, rel=0.05)
    assert found.interior_spread["shadow_volume"] == pytest.approx(0.3, rel=0.1)


@pytest.mark.parametrize(
    "perspective",
    [
        START[-3],
        3.0,
        0.4,
    ],
)
def test_the_vectorized_terms_equal_the_error_model(kept, perspective):
    """The test takes rows of views of every kind, and random constants around the initial values of the fit."""
    views, _ = kept
    some = [*{view["family"]: view for view in views}.values(), *views[::10]]
    cases = [
        one for view in some for one in cases_of(view) if one.algorithms & set(MAP_ALGORITHMS) and "planar" not in one.algorithms
    ]
    assert {kind for one in cases for step in one.steps for kind in step.kinds} == set(KINDS)
    assert {one.descriptor.view_kind for one in cases} == {"map", "perspective"} and {one.light for one in cases} > {SUN}
    terms, random = _Terms(cases), np.random.default_rng(0)
    for _ in range(3):
        constants = np.array(START) * np.exp(random.normal(0.0, 1.0, len(START)))
        constants[-3] = perspective
        expected = np.array([one.expected(_model(constants)).wrong_cast for one in cases])
        assert np.allclose(terms.expected(constants), expected, rtol=1e-9, atol=1e-12)
        assert np.ptp(expected) > 0.05


def test_views_without_cast_shadow_give_no_cases(kept):
    views, _ = kept
    without = [view for view in views if view["error"] == "wrong"]
    assert without and not any(cases_of(view) for view in without)
    first = next(view for view in views if view["error"] == "wrong_cast")
    assert {one.error for one in cases_of(first)} <= {row["wrong_cast"] for row in first["rows"].values()}
    assert len(cases_of(first)) == len({name for choice, name in first["picks"].items() if not choice.startswith("rules ")})


def test_held_out_parts_share_no_terrain_with_the_fit(kept):
    views: list[dict[str, Any]] = kept[0]
    held_out, apart = held_out_views(views), terrains(views)
    for parts in (held_out, apart):
        names = [view["name"] for part in parts for view in part]
        assert sorted(names) == sorted(view["name"] for view in views) and len(set(names)) == len(names)
    assert len(held_out) == FOLDS and all(len({view["terrain"] for view in part}) == 1 for part in apart)
    places = [{view["terrain"] for view in part} for part in apart]
    assert sum(map(len, places)) == len(set.union(*places))  # no terrain is in two parts
    many = {name for name in set.union(*places) if sum(view["terrain"] == name for view in views) >= FOLDS}
    assert many and all(many <= {view["terrain"] for view in part} for part in held_out)
