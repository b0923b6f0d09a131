"""Cost model: work counted from hand-written descriptors, and times predicted from it with rates."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.selector.choices import StandaloneRequest
from skugga.selector.cost.cost_model import predicted_ms, predicted_parts_ms, step_work
from skugga.selector.cost.device_profile import DeviceProfile
from skugga.selector.cost.unmeasured import UnmeasuredError
from skugga.selector.planner.planner import make_plan
from skugga.selector.portfolio import portfolio
from skugga.shadows.hybrid.settings import HybridSettings
from skugga.shadows.maps.resolve import sun_map_settings
from skugga.shadows.maps.settings import Cascade, LampMapSettings, ShadowMapSettings
from skugga.shadows.maps.work import sun_windows
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.shadows.volumes.work import FACES_THAT_HALVE_LAYERS, GROUND_SIDES_PER_TRIANGLE
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, CasterFacts, LampFacts, LightFacts
from skugga.terrain.level.level import SUN, Shadows

BODIES = CasterFacts(kind="meshes", count=10, triangles=1000, closed_share=1.0, height_m=4.0, width_m=5.0)
GROUND = CasterFacts(kind="relief", triangles=20_000, outside_triangles=0)
TREES = CasterFacts(kind="forest", count=500, triangles=3000, alpha_share=1.0, height_m=10.0, width_m=4.0)


def make_descriptor(**changes) -> Descriptor:
    """Return the descriptor of a perspective view: 640 x 512 pixels, two octaves deep, three quarters facing the sun."""
    bands = tuple(
        Band(near_m=near, far_m=2 * near, share=0.5, low_light_m=(-near, 0.0, -near), high_light_m=(near, near, near))
        for near in (32.0, 64.0)
    )
    fields = {
        "view": "main", "view_kind": "perspective", "flat_world": True, "pixel_m": 0.1, "pixel": 0.0015, "rows": 512, "cols": 640,
        "node_m": 2.0, "casters": ("relief", "meshes"), "stands": (GROUND, BODIES), "relief_m": 20.0, "block_relief_m": 20.0,
        "sun_azimuth_deg": 140.0, "sun_altitude_deg": 30.0, "highest_sun_deg": 30.0, "receivers_light_m": (128.0, 64.0, 128.0),
        "bands": bands, "lights": {SUN: LightFacts(facing_share=0.75, silhouette_edges=200, volume_layers=1.5)},
    }  # fmt: skip
    return Descriptor(**(fields | changes))


def make_map_descriptor(**changes) -> Descriptor:
    """Return the descriptor of a map of 256 x 256 pixels. ``changes`` replace fields."""
    return make_descriptor(view_kind="map", pixel=None, rows=256, cols=256, pixel_m=4.0, bands=(), **changes)


def profile(rates_ns: dict[str, dict[str, float]]) -> DeviceProfile:
    """Return a calibration with rates in nanoseconds by part and unit of work."""
    return DeviceProfile(
        renderer="a device",
        version="1",
        cpus=2,
        engine="0",
        measured=datetime(2025, 1, 1, tzinfo=UTC),
        took_s=1.0,
        rates_ns=rates_ns,
    )


def uniform_profile(rate_ns: float, descriptor: Descriptor, *step) -> DeviceProfile:
    """Return a profile with the same rate for everything that a step does."""
    work = step_work(descriptor, *step)
    return profile({part: dict.fromkeys(counts, rate_ns) for part, counts in work.items()})


def map_settings(size: int, texel_m: float, count: int = 1, **other_settings) -> ShadowMapSettings:
    """Return settings of a shadow map with ``size`` texels a side, sides of texels of ``texel_m``, and 1 or 2 cascades."""
    ends_m = [64.0, None] if count == 2 else [None]
    cascades = tuple(Cascade(far_m=end_m, texel_m=(texel_m, texel_m), depth_step_m=0.01) for end_m in ends_m)
    return ShadowMapSettings(
        map_size=size, depth_bits=16, filter=other_settings.pop("filter", 3), cascades=cascades, **other_settings
    )


def test_sun_windows_cover_receivers_and_border_in_whole_steps():
    ((texels, area_m2),) = sun_windows(make_descriptor(), map_settings(1024, 0.25))
    # 128 m and 64 m of quarter-metre texels, a border of 12 texels at either end, rounded up to a multiple of 64
    assert texels == 576 * 320 and area_m2 == 128.0 * 64.0
    near, far = sun_windows(make_descriptor(), map_settings(1024, 0.25, count=2))
    assert near == (320 * 192, 64.0 * 32.0) and far == (576 * 320, 128.0 * 64.0)
    assert sun_windows(make_descriptor(), map_settings(1024, 0.25, fit="tight"))[0][0] == 1024**2
    assert sun_windows(make_map_descriptor(), map_settings(1024, 0.25))[0] == (576 * 320, 128.0 * 64.0)


def test_step_work_of_a_shadow_map_counts_its_passes():
    ((name, counts),) = step_work(
        make_descriptor(), SUN, ("relief", "meshes"), "shadow_map", map_settings(1024, 0.25, count=2)
    ).items()
    assert name == "shadow_map, perspective"
    assert counts["maps"] == 2 and counts["fitted pixels"] == 2 * 640 * 512
    assert counts["look-ups, filter 3"] == 0.75 * 640 * 512
    assert counts["triangles"] == 2000 and counts["ground"] == 40_000 and counts["trees"] == 0
    assert counts["texels of ground"] == counts["texels"] == 320 * 192 + 576 * 320
    meshes_only = step_work(make_descriptor(), SUN, ("meshes",), "shadow_map", map_settings(1024, 0.25))["shadow_map, perspective"]
    assert meshes_only["texels of ground"] == meshes_only["ground"] == 0


def test_step_work_counts_edge_samples_like_pixels():
    """An edge pixel takes four samples, or two where edge pixels are many (``skugga.terrain.gbuffer.antialias``)."""
    base_counts = step_work(make_descriptor(), SUN, ("meshes",), "shadow_map", map_settings(1024, 0.25))["shadow_map, perspective"]
    for share, extra_share in ((0.1, 0.4), (0.3, 0.6)):
        edged = make_descriptor(edge_share=share)
        counts = step_work(edged, SUN, ("meshes",), "shadow_map", map_settings(1024, 0.25))["shadow_map, perspective"]
        pixel_counters = {name for name in counts if name.startswith(("fitted", "look-ups"))}
        assert all(counts[name] == pytest.approx((1.0 + extra_share) * base_counts[name]) for name in pixel_counters)
        assert all(counts[name] == base_counts[name] for name in counts.keys() - pixel_counters)
    # Planar shadows are drawn into the whole picture, and again into one of four times as many pixels.
    planar_base, edged = (
        step_work(make_descriptor(edge_share=share), SUN, ("meshes",), "planar", None)["planar"] for share in (0.0, 0.1)
    )
    assert edged == {
        "blocks": 1.0,
        "pixels": 5.0 * planar_base["pixels"],
        "triangles": 2.0 * planar_base["triangles"],
        "trees": 0.0,
    }


def test_step_work_of_trees_scales_with_the_covered_share():
    lights = {SUN: LightFacts(area_share=0.25)}
    wooded = make_descriptor(casters=("relief", "forest"), stands=(GROUND, TREES), lights=lights)
    counts = step_work(wooded, SUN, ("forest",), "shadow_map", map_settings(1024, 0.25))["shadow_map, perspective"]
    assert counts["trees"] == 500 and counts["trees drawn"] == pytest.approx(125.0)
    tree_m2 = 4.0 * (10.0 * np.cos(np.radians(30.0)) + 4.0 * 0.5)
    assert counts["texels of leaves"] == pytest.approx(counts["texels"] * 500 * tree_m2 / (128.0 * 64.0 / 0.25))
    # Leaves stop the light of half of the visible ground, so the wood around it is that dense.
    dense_wood = LightFacts(area_share=0.25, casts={"forest": {"share": 0.5, "bands": ()}})
    counts = step_work(make_descriptor(casters=("relief", "forest"), stands=(GROUND, TREES),
                     lights={SUN: dense_wood}), SUN, ("forest",),
                     "shadow_map", map_settings(1024, 0.25))["shadow_map, perspective"]  # fmt: skip
    assert counts["texels of leaves"] == pytest.approx(counts["texels"] * np.log(2.0))
    assert counts["trees drawn"] == pytest.approx(min(np.log(2.0) * 128.0 * 64.0 / tree_m2, 500.0))


def test_step_work_of_volumes_grows_with_edges_and_layers():
    one_pass = step_work(make_descriptor(), SUN, ("meshes",), "shadow_volume", VolumeSettings())
    assert one_pass["silhouettes, perspective"]["edges"] == 200 and one_pass["silhouettes, perspective"]["ground"] == 0
    counting = one_pass["counting, perspective"]
    assert counting["faces drawn"] == 200 + 500
    few_faces = 700 / (700 + FACES_THAT_HALVE_LAYERS)
    assert counting["layers"] == pytest.approx(few_faces * np.log(2.5) ** 0.5 * counting["facing"])
    two_pass = step_work(make_descriptor(), SUN, ("meshes",), "shadow_volume", VolumeSettings(stencil="two_pass"))[
        "counting, perspective"
    ]
    assert two_pass["layers"] == pytest.approx(few_faces * np.log(4.0) ** 0.5 * counting["facing"])
    assert two_pass["faces drawn"] == 2 * counting["faces drawn"]
    with_relief = step_work(make_descriptor(), SUN, ("relief", "meshes"), "shadow_volume", VolumeSettings())[
        "counting, perspective"
    ]
    # These faces are drawn in rectangles of 16 x 16 tiles: 20 rectangles, and each side crosses the square root of 20. A quarter of
    # the 20,000 triangles of the ground casts.
    assert with_relief["faces drawn"] == pytest.approx((200 + GROUND_SIDES_PER_TRIANGLE * 5000) * 20**0.5 + 500 + 5000)


def test_step_work_of_volumes_takes_the_ground_casting_share():
    """The share of the visible ground that faces the light is no bound of it."""

    def faces_drawn(ground_casting_share: float | None) -> float:
        light = LightFacts(facing_share=1.0, ground_casting_share=ground_casting_share)
        work = step_work(make_descriptor(lights={SUN: light}), SUN, ("relief",), "shadow_volume", VolumeSettings())
        return work["counting, perspective"]["faces drawn"]

    assert faces_drawn(0.0) == 0.0 < faces_drawn(0.1) < faces_drawn(1.0)
    assert faces_drawn(1.0) == pytest.approx(20_000 * (1 + GROUND_SIDES_PER_TRIANGLE * 20**0.5))


def test_step_work_of_a_hybrid_counts_undecided_pixels():
    def casting(differs: float) -> Descriptor:
        band = {"near_m": 32.0, "far_m": 128.0, "share": 0.75, "cast": 0.2, "pixel_m": 0.1, "differs": (differs,) * 8}
        light = LightFacts(facing_share=0.75, volume_layers=1.5, casts={"meshes": {"share": 0.1, "bands": (band,)}})
        return make_descriptor(lights={SUN: light})

    settings = HybridSettings(map=map_settings(768, 0.25, filter=2))
    few, many = (step_work(casting(share), SUN, ("meshes",), "hybrid", settings) for share in (0.1, 0.5))
    part = "counting, perspective"
    assert few[part]["layers beside marks"] == pytest.approx(0.75 * 640 * 512 * np.log1p(50 * 1.5 * 0.75 * 0.1))
    assert many[part]["layers beside marks"] == pytest.approx(0.75 * 640 * 512 * np.log1p(50 * 1.5 * 0.75 * 0.5))
    assert many[part]["faces beside marks"] == pytest.approx(5**0.25 * few[part]["faces beside marks"])
    assert few["conservative map, perspective"] == many["conservative map, perspective"]
    original = step_work(casting(0.1), SUN, ("meshes",), "hybrid", HybridSettings(map=settings.map, mask="original"))
    assert "shadow_map, perspective" in original and "mask" not in original


def test_step_work_of_a_sweep_counts_nodes_lines_and_points():
    default_counts, sixteen_lines, disc_counts = (
        step_work(make_descriptor(), SUN, ("relief",), "sweep", settings)["sweep, perspective"]
        for settings in (SweepSettings(), SweepSettings(lines=16), SweepSettings(filter="sun"))
    )
    assert (
        default_counts["nodes"] == 10_000
        and default_counts["steps"] == 80_000
        and sixteen_lines["steps"] == 160_000
        and disc_counts["steps"] == SweepSettings().light_points * 80_000
    )
    block = step_work(make_map_descriptor(), SUN, ("relief",), "sweep", SweepSettings())["sweep, map"]
    assert block["nodes"] == 256 * 256 * 4


def test_step_work_of_an_omni_light_counts_six_faces():
    lamps = (LampFacts(name="lamp", kind="omni", cutoff_deg=180.0, reference_m=20.0),)
    descriptor = make_descriptor(lamps=lamps, lights={})
    counts = step_work(descriptor, "lamp", ("meshes",), "shadow_map", LampMapSettings(map_size=512, depth_bits=32, filter=3))
    assert counts["shadow_map, omni"]["texels"] == 6 * 512**2 and counts["shadow_map, omni"]["triangles"] == 6000


def test_predicted_ms_multiplies_counts_by_rates():
    step = (SUN, ("meshes",), "shadow_map", map_settings(1024, 0.25))
    device = profile({"shadow_map, perspective": {"texels": 2.0, "triangles": 100.0}})
    assert predicted_ms(device, make_descriptor(), *step) == pytest.approx((576 * 320 * 2.0 + 1000 * 100.0) * 1e-6)
    assert predicted_parts_ms(device, make_descriptor(), *step).keys() == {"shadow_map, perspective"}
    assert predicted_ms(device, make_descriptor(), SUN, ("meshes",), "none", None) == 0.0


def test_predicted_ms_names_a_part_without_rates():
    with pytest.raises(UnmeasuredError, match="shadow_volume: .* no rates for silhouettes, perspective"):
        predicted_ms(profile({"planar": {"blocks": 1.0}}), make_descriptor(), SUN, ("meshes",), "shadow_volume", VolumeSettings())


def test_predicted_ms_scales_with_the_calibration():
    descriptor, factor = make_descriptor(), 2.5
    for choice in portfolio(descriptor, SUN, descriptor.casters):
        plan = make_plan(descriptor, StandaloneRequest(Shadows(), (SUN,)), choices={SUN: choice})
        for step in plan.steps:
            step_arguments = step.light, step.kinds, step.algorithm, step.settings
            base_ms = predicted_ms(uniform_profile(1.0, descriptor, *step_arguments), descriptor, *step_arguments)
            scaled_ms = predicted_ms(uniform_profile(factor, descriptor, *step_arguments), descriptor, *step_arguments)
            assert base_ms > 0.0 and scaled_ms == pytest.approx(factor * base_ms)


@given(st.integers(1, 10_000), st.integers(1, 10_000))
def test_predicted_ms_never_falls_with_more_triangles(first_count, second_count):
    settings, _ = sun_map_settings(make_descriptor(), Shadows(map_size=1024))
    low, high = sorted((first_count, second_count))
    for step in ((SUN, ("meshes",), "shadow_map", settings), (SUN, ("meshes",), "shadow_volume", VolumeSettings())):
        low_descriptor, high_descriptor = (
            make_descriptor(stands=(GROUND, BODIES.model_copy(update={"triangles": count}))) for count in (low, high)
        )
        rates = uniform_profile(10.0, low_descriptor, *step)
        assert predicted_ms(rates, low_descriptor, *step) <= predicted_ms(rates, high_descriptor, *step)
