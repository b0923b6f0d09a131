"""Error model: texel sizes from settings, error sums and probabilities derived by hand, and properties of all views."""

from __future__ import annotations

from math import exp, log, radians, tan

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.cost.error_model import (
    ASSUMED_CASTING,
    ERROR_OFFSET,
    INTERIOR_OFFSET,
    MIN_SPREAD,
    CoverageError,
    ErrorModel,
    ExpectedErrors,
    HillCurve,
    SharedErrors,
    error_group_of,
    error_groups,
    expected_errors,
    packaged_model,
    smoothed_differing_shares,
    step_castings,
    texel_px_of,
)
from skugga.selector.gaussian_estimate import SharedVariance
from skugga.shadows.hybrid.settings import HybridSettings
from skugga.shadows.maps.settings import Cascade, LampMapSettings, PerspectiveMapSettings, ShadowMapSettings
from skugga.shadows.plan import Step
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import DECIMATED_GROUP
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX, CastBand, CasterFacts, Casting, LampFacts, LightFacts
from skugga.terrain.facts.probes import MIN_CAST_SHADOW_SHARE
from skugga.terrain.gbuffer.ground_mesh import MAX_UNDECIMATED_TRIANGLES
from skugga.terrain.level.level import SUN

PROPORTIONAL_SHARES = tuple(px / 320.0 for px in TEXEL_SIZES_PX)
"""The edge spacing is a few hundred pixels: the share of differing pixels grows in proportion to the texel."""

MODEL = ErrorModel(
    counted={
        "relief": HillCurve(most=1.0, half_px=4.0, steepness=1.0),
        "meshes": HillCurve(most=2.0, half_px=4.0, steepness=2.0),
        "forest": HillCurve(most=0.5, half_px=1.0, steepness=1.0),
    },
    perspective=2.0,
    floor={name: 0.001 * number for number, name in enumerate(error_groups())},
    interior=dict.fromkeys(error_groups(), 0.25),
    spread={name: 0.1 * (1 + number) for number, name in enumerate(error_groups())},
    interior_spread=dict.fromkeys(error_groups(), 0.5),
    time_spread=0.2,
    shared=SharedErrors(**dict.fromkeys(("error", "interior", "time"), SharedVariance(view=0.0, family=0.0))),
)


def band(near_m: float = 32.0, share: float = 1.0, pixel_m: float = 0.1, light_m: float | None = None, **other_fields) -> CastBand:
    """Return a band of distances from ``near_m`` to twice that. ``share`` is its share of the points."""
    differs = other_fields.pop("differs", PROPORTIONAL_SHARES)
    return CastBand(
        near_m=near_m, far_m=2.0 * near_m, share=share, cast=0.2, pixel_m=pixel_m, light_m=light_m, differs=differs
    )  # fmt: skip


def make_descriptor(**changes) -> Descriptor:
    """Return a perspective view of 640 x 360 pixels (geometric mean side 480). The sun's map would cover 400 m by 100 m."""
    casts = {"meshes": Casting(share=0.2, on_bodies=0.05, bands=(band(share=0.75), band(64.0, share=0.25, pixel_m=0.2)))}
    fields = {
        "view": "main", "view_kind": "perspective", "flat_world": True, "pixel_m": 0.1, "pixel": 0.0015, "rows": 360, "cols": 640,
        "node_m": 2.0, "casters": ("relief", "meshes", "forest"), "relief_m": 20.0, "block_relief_m": 20.0,
        "sun_azimuth_deg": 140.0, "sun_altitude_deg": 30.0, "highest_sun_deg": 30.0, "receivers_light_m": (400.0, 100.0, 100.0),
        "lights": {SUN: LightFacts(cast_share=0.2, casts=casts)},
    }  # fmt: skip
    return Descriptor(**(fields | changes))


def lamp_descriptor(kind: str, **lamp) -> Descriptor:
    """Return the view under a lamp, with all the facts that the lamp tests use."""
    facts = LampFacts(name="lamp", kind=kind, reference_m=50.0, **lamp)
    return make_descriptor(lamps=(facts,), lights={"lamp": LightFacts(cast_share=0.2)})


def cascades(*texels_m: tuple[float, float], far_m: float = 64.0) -> ShadowMapSettings:
    """Return settings of cascades with these texels (sides in metres). The first ends at ``far_m``, each further at twice that."""
    ends = [*(far_m * 2**k for k in range(len(texels_m) - 1)), None]
    splits = tuple(Cascade(far_m=end, texel_m=texel_m, depth_step_m=0.01) for end, texel_m in zip(ends, texels_m, strict=True))
    return ShadowMapSettings(map_size=1024, depth_bits=16, filter=3, cascades=splits)


def lamp_map_settings(size: int) -> LampMapSettings:
    """Return settings of a lamp's shadow map of ``size`` texels a side."""
    return LampMapSettings(map_size=size, depth_bits=32, filter=3)


def perspective_map_settings(size: int) -> PerspectiveMapSettings:
    """Return settings of a perspective shadow map of ``size`` texels a side."""
    return PerspectiveMapSettings(map_size=size, depth_bits=24, filter=3)


def step(name: str, settings=None, light: str = SUN, kinds=("meshes",)) -> Step:
    """Return a step of a plan with the algorithm ``name``."""
    return Step(light, kinds, name, settings)


def test_texel_px_of_a_sun_map_uses_the_cascade_of_the_band():
    """Texels of 0.1 m by 0.4 m are 0.2 m in the geometric mean: two pixels of 0.1 m. The next cascade has ten pixels of 0.2 m."""
    map_step = step("shadow_map", cascades((0.1, 0.4), (2.0, 2.0), (6.4, 6.4)))
    near, middle, last = band(32.0), band(64.0, pixel_m=0.2), band(256.0, pixel_m=0.8)
    texels_px = [texel_px_of(make_descriptor(), SUN, map_step, cast_band, 2.0) for cast_band in (near, middle, last)]
    assert texels_px == pytest.approx([2.0, 10.0, 8.0])
    one_cascade_step = step("shadow_map", cascades((0.1, 0.4)))
    assert texel_px_of(make_descriptor(), SUN, one_cascade_step, last, 2.0) == pytest.approx(0.25)


def test_texel_px_of_a_spot_is_cone_width_over_map_size():
    spot = lamp_descriptor("spot", cutoff_deg=30.0)
    map_step = step("shadow_map", lamp_map_settings(512), "lamp")
    across_m = 2.0 * 40.0 * tan(radians(30.0))
    found_px = texel_px_of(spot, "lamp", map_step, band(light_m=40.0), 2.0)
    assert found_px == pytest.approx(across_m / 512 / 0.1)
    # Without a distance in the band, the lamp's own distance counts; doubling the map size halves the texel.
    assert texel_px_of(spot, "lamp", map_step, band(), 2.0) == pytest.approx(found_px * 50.0 / 40.0)
    assert texel_px_of(spot, "lamp", step("shadow_map", lamp_map_settings(1024), "lamp"), band(light_m=40.0), 2.0) == pytest.approx(
        found_px / 2.0
    )
    # Each of an omni light's six maps spans a right angle.
    omni = lamp_descriptor("omni", cutoff_deg=180.0)
    assert texel_px_of(omni, "lamp", map_step, band(light_m=40.0), 2.0) == pytest.approx(80.0 / 512 / 0.1)


def test_texel_px_of_a_perspective_map_caps_at_a_uniform_map():
    """Twice the 480 pixels of a side are 960. A uniform map would be 200 m wide: 2000 pixels near, 200 pixels far away."""
    map_step = step("perspective_shadow_map", perspective_map_settings(512))
    near, far = band(pixel_m=0.1), band(256.0, pixel_m=1.0)
    assert texel_px_of(make_descriptor(), SUN, map_step, near, 2.0) == pytest.approx(960.0 / 512)
    assert texel_px_of(make_descriptor(), SUN, map_step, far, 2.0) == pytest.approx(200.0 / 512)
    assert texel_px_of(make_descriptor(), SUN, map_step, near, 1e6) == pytest.approx(2000.0 / 512)


@pytest.mark.parametrize("name", ["shadow_volume", "hybrid", "sweep"])
def test_expected_errors_of_exact_algorithms_are_their_floor(name):
    uniform = cascades((0.5, 0.5))
    settings = {"shadow_volume": VolumeSettings(), "sweep": SweepSettings(), "hybrid": HybridSettings(map=uniform)}[name]
    errors = expected_errors(make_descriptor(), SUN, [step(name, settings)], MODEL)
    floor = MODEL.floor[name]
    assert floor > 0.0 and errors.wrong_cast == pytest.approx(floor) and errors.wrong == pytest.approx(0.2 * floor)
    assert errors.interior == pytest.approx(0.25 * errors.wrong)
    assert (errors.spread, errors.interior_spread) == pytest.approx((MODEL.spread[name], 0.5))


def test_expected_errors_of_planar_are_the_shadow_on_bodies():
    """A quarter of the cast shadow lies on bodies. An unknown share counts as all; a share without hits counts as half a probe."""
    floor = MODEL.floor["planar"]

    def wrong_cast(on_bodies: float | None) -> float:
        casts = {"meshes": Casting(share=0.2, on_bodies=on_bodies)}
        descriptor = make_descriptor(lights={SUN: LightFacts(cast_share=0.2, casts=casts)})
        return expected_errors(descriptor, SUN, [step("planar")], MODEL).wrong_cast

    assert wrong_cast(0.05) == pytest.approx(0.25 + floor)
    assert wrong_cast(None) == pytest.approx(1.0)
    assert wrong_cast(0.0) == pytest.approx(MIN_CAST_SHADOW_SHARE / 0.2 + floor)


def test_expected_errors_of_a_map_sum_its_bands():
    """Texels of 0.4 m are 4 and 2 pixels, so 4 / 320 and 2 / 320 differ.

    Weights are 2 / (1 + (4 / 4) ** 2) = 1 and 2 / (1 + 4) = 0.4.
    """
    map_step = step("shadow_map", cascades((0.4, 0.4)))
    by_hand = 0.75 * (4.0 / 320.0) * 1.0 + 0.25 * (2.0 / 320.0) * 0.4
    errors = expected_errors(make_descriptor(), SUN, [map_step], MODEL)
    assert errors.wrong_cast == pytest.approx(by_hand / 0.2 + MODEL.floor["shadow_map"])
    assert errors.wrong == pytest.approx(0.2 * errors.wrong_cast)


@pytest.mark.parametrize(
    ("texel_px", "differs"),
    [
        (4.0, 4.0 / 320.0),
        (2.0 * 2.0**0.5, 3.0 / 320.0),  # half an octave above 2 pixels: the mean of the values at 2 and 4 pixels
        (0.1, 0.1 / 320.0),  # proportional below the smallest texel
        (100.0, 32.0 / 320.0),  # constant above the largest texel
    ],
)
def test_expected_errors_interpolate_the_texel_ladder(texel_px, differs):
    model = MODEL.model_copy(update={"counted": dict.fromkeys(MODEL.counted, HillCurve(most=1.0, half_px=1e-6, steepness=1.0))})
    casts = {"meshes": Casting(share=0.2, bands=(band(),))}
    view = make_descriptor(lights={SUN: LightFacts(cast_share=0.2, casts=casts)})
    map_step = step("shadow_map", cascades((0.1 * texel_px, 0.1 * texel_px)))
    wrong_share = expected_errors(view, SUN, [map_step], model).wrong - 0.2 * model.floor["shadow_map"]
    assert wrong_share == pytest.approx(differs, rel=1e-4)


def test_expected_errors_weight_each_caster_kind():
    casts = {kind: Casting(share=0.2, bands=(band(),)) for kind in ("relief", "meshes", "forest")}
    descriptor = make_descriptor(lights={SUN: LightFacts(cast_share=0.2, casts=casts)})
    map_settings = cascades((0.4, 0.4))

    def wrong(*kinds: str) -> float:
        wrong_share = expected_errors(descriptor, SUN, [step("shadow_map", map_settings, kinds=kinds)], MODEL).wrong
        return wrong_share - 0.2 * MODEL.floor["shadow_map"]

    differs = 4.0 / 320.0
    assert (wrong("relief"), wrong("meshes")) == pytest.approx((differs * 0.5, differs * 1.0))
    assert wrong("forest") == pytest.approx(differs * 0.5 * 4.0 / 5.0)
    assert wrong("relief", "meshes", "forest") == pytest.approx(wrong("relief") + wrong("meshes") + wrong("forest"))


def wood_descriptor(differing_share: float) -> Descriptor:
    """Return a view in which leaves make that share of the look-ups within half a pixel differ."""
    bands = (band(share=0.5, differs=(differing_share,) * 8), band(64.0, share=0.5, differs=(differing_share,) * 8))
    casts = {"forest": Casting(share=0.2, bands=bands)}
    return make_descriptor(lights={SUN: LightFacts(cast_share=0.2, casts=casts)})


def test_expected_errors_of_dense_woods_are_those_of_coverage():
    coverage = CoverageError(share=0.3, floor=0.04, spread=0.1, interior=0.5, interior_spread=0.9)
    model = MODEL.model_copy(update={"coverage": coverage})
    map_step = step("shadow_map", cascades((0.1, 0.1)), kinds=("forest",))
    pixels, blocks = (expected_errors(wood_descriptor(0.12), SUN, [map_step], each) for each in (MODEL, model))
    assert pixels.wrong_cast > 0.05 and pixels.interior > 0.0 and not pixels.is_coverage
    assert blocks.wrong_cast == pytest.approx(((0.3 * pixels.wrong_cast) ** 2 + 0.04**2) ** 0.5)
    assert (blocks.interior, blocks.wrong) == pytest.approx((0.5 * pixels.interior, pixels.wrong))
    assert (blocks.spread, blocks.interior_spread, blocks.is_coverage) == (0.1, 0.9, True)
    sparse = wood_descriptor(0.115)
    assert expected_errors(sparse, SUN, [map_step], model) == expected_errors(sparse, SUN, [map_step], MODEL)
    meshes = make_descriptor()
    assert expected_errors(meshes, SUN, [step("shadow_map", cascades((0.1, 0.1)))], model).is_coverage is False


def test_expected_errors_of_steps_add_up_with_weighted_spread():
    sweep_step, map_step = step("sweep", SweepSettings(), kinds=("relief",)), step("shadow_map", cascades((0.4, 0.4)))
    sweep_errors, map_errors, total_errors = (
        expected_errors(make_descriptor(), SUN, steps, MODEL) for steps in ([sweep_step], [map_step], [sweep_step, map_step])
    )
    assert total_errors.wrong == pytest.approx(sweep_errors.wrong + map_errors.wrong)
    assert total_errors.wrong_cast == pytest.approx(sweep_errors.wrong_cast + map_errors.wrong_cast)
    assert total_errors.spread == pytest.approx(
        (sweep_errors.wrong * sweep_errors.spread + map_errors.wrong * map_errors.spread) / total_errors.wrong
    )
    assert min(sweep_errors.spread, map_errors.spread) < total_errors.spread < max(sweep_errors.spread, map_errors.spread)


def test_step_castings_skip_kinds_without_visible_shadow():
    map_step = step("shadow_map", cascades((0.4, 0.4)), kinds=("meshes", "forest"))
    assert [kind for kind, _ in step_castings(make_descriptor(), SUN, map_step)] == ["meshes"]
    unknown = make_descriptor(lights={})
    assert step_castings(unknown, SUN, map_step) == [("meshes", ASSUMED_CASTING), ("forest", ASSUMED_CASTING)]
    assert expected_errors(unknown, SUN, [map_step], MODEL).wrong_cast > MODEL.floor["shadow_map"]
    assert expected_errors(make_descriptor(), SUN, [], MODEL) == ExpectedErrors(0.0, 0.0, 0.0, MIN_SPREAD, MIN_SPREAD)


def test_error_group_of_a_sweep_over_decimated_ground():
    sweep_step = step("sweep", SweepSettings(), kinds=("relief",))

    def on_ground(nodes: int | None) -> Descriptor:
        return make_descriptor(stands=(CasterFacts(kind="relief", triangles=1000, nodes=nodes),))

    full_ground, decimated_ground = on_ground(MAX_UNDECIMATED_TRIANGLES // 2), on_ground(MAX_UNDECIMATED_TRIANGLES // 2 + 1)
    assert [error_group_of(ground, sweep_step) for ground in (full_ground, decimated_ground, on_ground(None))] == [
        "sweep",
        DECIMATED_GROUP,
        "sweep",
    ]
    assert expected_errors(full_ground, SUN, [sweep_step], MODEL).wrong_cast == pytest.approx(MODEL.floor["sweep"])
    assert expected_errors(decimated_ground, SUN, [sweep_step], MODEL).wrong_cast == pytest.approx(MODEL.floor[DECIMATED_GROUP])
    map_step = step("shadow_map", cascades((0.4, 0.4)), kinds=("relief",))
    assert error_group_of(decimated_ground, map_step) == "shadow_map"  # a shadow map draws the ground that is shown
    assert packaged_model().floor[DECIMATED_GROUP] > packaged_model().floor["sweep"]


def test_smoothed_differing_shares_spreads_one_sample():
    assert smoothed_differing_shares(PROPORTIONAL_SHARES) == pytest.approx(PROPORTIONAL_SHARES)
    one_hit = smoothed_differing_shares((0.0, 0.0, 0.0, 0.028, 0.0, 0.0, 0.0, 0.0))
    # Texels of 0.5, 1 and 2 pixels sum to 3.5 pixels, which share 0.028: 0.008 a pixel. The smallest texel takes these three, too,
    # since no probe differs at the first three sizes.
    assert one_hit == pytest.approx((0.25 * 0.028 / 3.75, 0.004, 0.004, 0.004, 0.0, 0.0, 0.0, 0.0))


def test_smoothed_shares_use_large_texels_if_few_probes_differ():
    """Of 1000 probes 3 differ at 4 pixels, 5 at 8 and 11 at 16. The small texels alone would be free of errors."""
    smoothed = smoothed_differing_shares((0.0, 0.0, 0.0, 0.0, 0.003, 0.005, 0.011, 0.016))
    pooled = {k: 0.019 / sum(TEXEL_SIZES_PX[k:7]) for k in range(4)} | {4: 0.019 / 28.0}
    for k, share_per_px in pooled.items():
        assert smoothed[k] == pytest.approx(share_per_px * TEXEL_SIZES_PX[k])


SHARES = st.integers(0, 10**9).map(lambda count: count / 1e9)
"""Shares as they are measured: counts among a billion pixels at most, and no numbers below the smallest normal one."""


@given(st.lists(SHARES, min_size=len(TEXEL_SIZES_PX), max_size=len(TEXEL_SIZES_PX)))
def test_smoothed_differing_shares_stays_between_pooled_shares(differs):
    smoothed = smoothed_differing_shares(tuple(differs))
    assert all(0.0 <= value <= 1.0 for value in smoothed) and smoothed[-1] == pytest.approx(differs[-1])
    shares_per_pixel = [share / px for share, px in zip(differs, TEXEL_SIZES_PX, strict=True)]
    for k, (share, px) in enumerate(zip(smoothed, TEXEL_SIZES_PX, strict=True)):
        low, high = min(shares_per_pixel[k:]), max(shares_per_pixel[k:])
        assert min(low * px, 1.0) * (1 - 1e-9) <= share <= high * px * (1 + 1e-9)


@given(st.floats(0.01, 100.0), st.floats(1.0, 4.0))
def test_expected_errors_never_fall_with_larger_texels(texel_m, factor):
    few, many = (
        expected_errors(make_descriptor(), SUN, [step("shadow_map", cascades((side_m, side_m)))], MODEL).wrong_cast
        for side_m in (texel_m, texel_m * factor)
    )
    assert 0.0 <= few <= many * (1 + 1e-12) and many <= 1.0


def errors(wrong_cast: float, interior: float = 0.0, spread: float = 0.5) -> ExpectedErrors:
    """Return expected errors: shares of the cast shadow and of the picture."""
    return ExpectedErrors(0.2 * wrong_cast, wrong_cast, interior, spread, 0.4)


def test_probability_over_is_one_half_at_the_expected_error():
    estimate = errors(0.02)
    assert estimate.probability_over(0.02) == pytest.approx(0.5)
    assert estimate.probability_over(1.0) < 1e-3 and estimate.probability_over(1e-6) > 0.99
    # Three times the expected error, with a thousandth added to both: odds of (21 / 61) ** (1 / 0.5).
    odds = ((0.02 + ERROR_OFFSET) / (0.06 + ERROR_OFFSET)) ** 2
    assert estimate.probability_over(0.06) == pytest.approx(odds / (1.0 + odds))
    assert errors(0.9, spread=MIN_SPREAD).probability_over(1e-9) <= 1.0  # and does not overflow


def test_probability_over_counts_the_interior_error():
    assert errors(0.001, interior=MAX_INTERIOR_SHARE).probability_over(1.0) == pytest.approx(0.5)
    probability = errors(0.001, interior=10.0 * MAX_INTERIOR_SHARE).probability_over(1.0)
    ratio = (10.0 * MAX_INTERIOR_SHARE + INTERIOR_OFFSET) / (MAX_INTERIOR_SHARE + INTERIOR_OFFSET)
    assert probability == pytest.approx(1.0 / (1.0 + exp(-log(ratio) / 0.4)))


@given(st.floats(0.0, 1.0), st.floats(1e-4, 1.0), st.floats(1.0, 10.0), st.floats(MIN_SPREAD, 2.0), st.floats(0.0, 0.01))
def test_probability_over_is_monotonic(expected, allowed, factor, spread, interior):
    estimate = errors(expected, interior, spread)
    assert 0.0 <= estimate.probability_over(allowed * factor) <= estimate.probability_over(allowed) <= 1.0
    assert errors(min(expected * factor, 1.0), interior, spread).probability_over(allowed) >= estimate.probability_over(allowed)
    is_within_target = expected <= allowed and interior <= MAX_INTERIOR_SHARE
    assert (estimate.probability_over(allowed) <= 0.5) == is_within_target or abs(estimate.probability_over(allowed) - 0.5) < 1e-9


UNMEASURED_GROUPS = {"light_space_perspective_map", "reconstructed_volume"}
"""Groups whose errors ``benchmarks.selection`` has not fitted yet. Policies reject these algorithms with that reason."""


def test_packaged_model_has_constants_for_every_error_group():
    model = packaged_model()
    for constants in (model.floor, model.interior, model.spread, model.interior_spread):
        assert set(constants) == set(error_groups()) - UNMEASURED_GROUPS and min(constants.values()) >= 0.0
    assert min(model.spread.values()) >= MIN_SPREAD and set(model.counted) == {"relief", "meshes", "forest"}
