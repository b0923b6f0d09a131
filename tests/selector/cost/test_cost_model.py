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
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Band, CasterFacts, LampFacts, LightFacts
from skugga.terrain.level.level import SUN, Shadows

BODIES = CasterFacts(kind="meshes", count=10, triangles=1000, closed_share=1.0, height_m=4.0, width_m=5.0)
GROUND = CasterFacts(kind="relief", triangles=20_000, outside_triangles=0)
TREES = CasterFacts(kind="forest", count=500, triangles=3000, alpha_share=1.0, height_m=10.0, width_m=4.0)


def described(**changes) -> Descriptor:
    """Return the descriptor of a perspective view: 640 x 512 pixels, two octaves deep, three quarters facing the sun."""
    bands = tuple(
        Band(near_m=near, far_m=2 * near, share=0.5, low_light_m=(-near, 0.0, -near), high_light_m=(near, near, near))
        for near in (32.0, 64.0)
    )
    given = {
        "view": "main", "view_kind": "perspective", "flat_world": True, "pixel_m": 0.1, "pixel": 0.0015, "rows": 512, "cols": 640,
        "node_m": 2.0, "casters": ("relief", "meshes"), "stands": (GROUND, BODIES), "relief_m": 20.0, "block_relief_m": 20.0,
        "sun_azimuth_deg": 140.0, "sun_altitude_deg": 30.0, "highest_sun_deg": 30.0, "receivers_light_m": (128.0, 64.0, 128.0),
        "bands": bands, "lights": {SUN: LightFacts(facing_share=0.75, silhouette_edges=200, volume_layers=1.5)},
    }  # fmt: skip
    return Descriptor(**(given | changes))


def in_map(**changes) -> Descriptor:
    return described(view_kind="map", pixel=None, rows=256, cols=256, pixel_m=4.0, bands=(), **changes)


def profile(rates_ns: dict[str, dict[str, float]]) -> DeviceProfile:
    return DeviceProfile(
        renderer="a device",
        version="1",
        cpus=2,
        engine="0",
        measured=datetime(2025, 1, 1, tzinfo=UTC),
        took_s=1.0,
        rates_ns=rates_ns,
    )


def all_at(rate_ns: float, descriptor: Descriptor, *step) -> DeviceProfile:
    """Return a profile with the same rate for everything that a step does."""
    work = step_work(descriptor, *step)
    return profile({part: dict.fromkeys(counts, rate_ns) for part, counts in work.items()})


def one_map(size: int, texel_m: float, count: int = 1, **more) -> ShadowMapSettings:
    far = [64.0, None] if count == 2 else [None]
    cascades = tuple(Cascade(far_m=each, texel_m=(texel_m, texel_m), depth_step_m=0.01) for each in far)
    return ShadowMapSettings(map_size=size, depth_bits=16, filter=more.pop("filter", 3), cascades=cascades, **more)


def test_sun_windows_cover_receivers_and_border_in_whole_steps():
    ((texels, area_m2),) = sun_windows(described(), one_map(1024, 0.25))
    # 128 m and 64 m of quarter-metre texels, a border of 12 texels at either end, rounded up to a multiple of 64
    assert texels == 576 * 320 and area_m2 == 128.0 * 64.0
    near, far = sun_windows(described(), one_map(1024, 0.25, count=2))
    assert near == (320 * 192, 64.0 * 32.0) and far == (576 * 320, 128.0 * 64.0)
    assert sun_windows(described(), one_map(1024, 0.25, fit="tight"))[0][0] == 1024**2
    assert sun_windows(in_map(), one_map(1024, 0.25))[0] == (576 * 320, 128.0 * 64.0)


def test_step_work_of_a_shadow_map_counts_its_passes():
    ((name, counts),) = step_work(described(), SUN, ("relief", "meshes"), "shadow_map", one_map(1024, 0.25, count=2)).items()
    assert name == "shadow_map, perspective"
    assert counts["maps"] == 2 and counts["fitted pixels"] == 2 * 640 * 512
    assert counts["look-ups, filter 3"] == 0.75 * 640 * 512
    assert counts["triangles"] == 2000 and counts["ground"] == 40_000 and counts["trees"] == 0
    assert counts["texels of ground"] == counts["texels"] == 320 * 192 + 576 * 320
    alone = step_work(described(), SUN, ("meshes",), "shadow_map", one_map(1024, 0.25))["shadow_map, perspective"]
    assert alone["texels of ground"] == alone["ground"] == 0


def test_step_work_counts_edge_samples_like_pixels():
    """An edge pixel takes four samples, or two where edge pixels are many (``skugga.terrain.gbuffer.antialias``)."""
    plain = step_work(described(), SUN, ("meshes",), "shadow_map", one_map(1024, 0.25))["shadow_map, perspective"]
    for share, more in ((0.1, 0.4), (0.3, 0.6)):
        edged = described(edge_share=share)
        counts = step_work(edged, SUN, ("meshes",), "shadow_map", one_map(1024, 0.25))["shadow_map, perspective"]
        of_pixels = {name for name in counts if name.startswith(("fitted", "look-ups"))}
        assert all(counts[name] == pytest.approx((1.0 + more) * plain[name]) for name in of_pixels)
        assert all(counts[name] == plain[name] for name in counts.keys() - of_pixels)
    # Planar shadows are drawn into the whole picture, and again into one of four times as many pixels.
    level, edged = (step_work(described(edge_share=share), SUN, ("meshes",), "planar", None)["planar"] for share in (0.0, 0.1))
    assert edged == {"blocks": 1.0, "pixels": 5.0 * level["pixels"], "triangles": 2.0 * level["triangles"], "trees": 0.0}


def test_step_work_of_trees_scales_with_the_covered_share():
    lights = {SUN: LightFacts(area_share=0.25)}
    wooded = described(casters=("relief", "forest"), stands=(GROUND, TREES), lights=lights)
    counts = step_work(wooded, SUN, ("forest",), "shadow_map", one_map(1024, 0.25))["shadow_map, perspective"]
    assert counts["trees"] == 500 and counts["trees drawn"] == pytest.approx(125.0)
    tree_m2 = 4.0 * (10.0 * np.cos(np.radians(30.0)) + 4.0 * 0.5)
    assert counts["texels of leaves"] == pytest.approx(counts["texels"] * 500 * tree_m2 / (128.0 * 64.0 / 0.25))
    # Leaves stop the light of half of the visible ground, so the wood around it is that dense.
    dense = LightFacts(area_share=0.25, casts={"forest": {"share": 0.5, "bands": ()}})
    counts = step_work(described(casters=("relief", "forest"), stands=(GROUND, TREES), lights={SUN: dense}), SUN, ("forest",),
                     "shadow_map", one_map(1024, 0.25))["shadow_map, perspective"]  # fmt: skip
    assert counts["texels of leaves"] == pytest.approx(counts["texels"] * np.log(2.0))
    assert counts["trees drawn"] == pytest.approx(min(np.log(2.0) * 128.0 * 64.0 / tree_m2, 500.0))


def test_step_work_of_volumes_grows_with_edges_and_layers():
    few = step_work(described(), SUN, ("meshes",), "shadow_volume", VolumeSettings())
    assert few["silhouettes, perspective"]["edges"] == 200 and few["silhouettes, perspective"]["ground"] == 0
    counting = few["counting, perspective"]
    assert counting["faces drawn"] == 200 + 500 and counting["layers"] == pytest.approx(np.log(2.5) ** 0.5 * counting["facing"])
    twice = step_work(described(), SUN, ("meshes",), "shadow_volume", VolumeSettings(stencil="two_pass"))["counting, perspective"]
    assert twice["layers"] == pytest.approx(np.log(4.0) ** 0.5 * counting["facing"])
    assert twice["faces drawn"] == 2 * counting["faces drawn"]
    both = step_work(described(), SUN, ("relief", "meshes"), "shadow_volume", VolumeSettings())["counting, perspective"]
    # these faces are drawn in rectangles of 16 x 16 tiles: 20 rectangles, and each side crosses the square root of 20
    assert both["faces drawn"] == pytest.approx(200 * 20**0.5 + 500 + 0.25 * 20_000)


def test_step_work_of_a_hybrid_counts_undecided_pixels():
    def casting(differs: float) -> Descriptor:
        band = {"near_m": 32.0, "far_m": 128.0, "share": 0.75, "cast": 0.2, "pixel_m": 0.1, "differs": (differs,) * 8}
        light = LightFacts(facing_share=0.75, volume_layers=1.5, casts={"meshes": {"share": 0.1, "bands": (band,)}})
        return described(lights={SUN: light})

    settings = HybridSettings(map=one_map(768, 0.25, filter=2))
    few, many = (step_work(casting(share), SUN, ("meshes",), "hybrid", settings) for share in (0.1, 0.5))
    part = "counting, perspective"
    assert few[part]["layers beside marks"] == pytest.approx(0.75 * 640 * 512 * np.log1p(50 * 1.5 * 0.75 * 0.1))
    assert many[part]["layers beside marks"] == pytest.approx(0.75 * 640 * 512 * np.log1p(50 * 1.5 * 0.75 * 0.5))
    assert many[part]["faces beside marks"] == pytest.approx(5**0.25 * few[part]["faces beside marks"])
    assert few["conservative map, perspective"] == many["conservative map, perspective"]
    original = step_work(casting(0.1), SUN, ("meshes",), "hybrid", HybridSettings(map=settings.map, mask="original"))
    assert "shadow_map, perspective" in original and "mask" not in original


def test_step_work_of_a_sweep_counts_nodes_lines_and_sun_strips():
    plain, fine, soft = (
        step_work(described(), SUN, ("relief",), "sweep", settings)["sweep, perspective"]
        for settings in (SweepSettings(), SweepSettings(lines=16), SweepSettings(filter="sun"))
    )
    assert plain["nodes"] == 10_000 and plain["steps"] == 80_000 and fine["steps"] == 160_000 and soft["steps"] == 16 * 80_000
    block = step_work(in_map(), SUN, ("relief",), "sweep", SweepSettings())["sweep, map"]
    assert block["nodes"] == 256 * 256 * 4


def test_step_work_of_an_omni_light_counts_six_faces():
    lamps = (LampFacts(name="lamp", kind="omni", cutoff_deg=180.0, reference_m=20.0),)
    lit = described(lamps=lamps, lights={})
    counts = step_work(lit, "lamp", ("meshes",), "shadow_map", LampMapSettings(map_size=512, depth_bits=32, filter=3))
    assert counts["shadow_map, omni"]["texels"] == 6 * 512**2 and counts["shadow_map, omni"]["triangles"] == 6000


def test_predicted_ms_multiplies_counts_by_rates():
    step = (SUN, ("meshes",), "shadow_map", one_map(1024, 0.25))
    its = profile({"shadow_map, perspective": {"texels": 2.0, "triangles": 100.0}})
    assert predicted_ms(its, described(), *step) == pytest.approx((576 * 320 * 2.0 + 1000 * 100.0) * 1e-6)
    assert predicted_parts_ms(its, described(), *step).keys() == {"shadow_map, perspective"}
    assert predicted_ms(its, described(), SUN, ("meshes",), "none", None) == 0.0


def test_predicted_ms_names_a_part_without_rates():
    with pytest.raises(UnmeasuredError, match="shadow_volume: .* no rates for silhouettes, perspective"):
        predicted_ms(profile({"planar": {"blocks": 1.0}}), described(), SUN, ("meshes",), "shadow_volume", VolumeSettings())


def test_predicted_ms_scales_with_the_calibration():
    descriptor, factor = described(), 2.5
    for choice in portfolio(descriptor, SUN, descriptor.casters):
        plan = make_plan(descriptor, StandaloneRequest(Shadows(), (SUN,)), choices={SUN: choice})
        for step in plan.steps:
            about = step.light, step.kinds, step.algorithm, step.settings
            one = predicted_ms(all_at(1.0, descriptor, *about), descriptor, *about)
            other = predicted_ms(all_at(factor, descriptor, *about), descriptor, *about)
            assert one > 0.0 and other == pytest.approx(factor * one)


@given(st.integers(1, 10_000), st.integers(1, 10_000))
def test_predicted_ms_never_falls_with_more_triangles(some, more):
    settings, _ = sun_map_settings(described(), Shadows(map_size=1024))
    low, high = sorted((some, more))
    for step in ((SUN, ("meshes",), "shadow_map", settings), (SUN, ("meshes",), "shadow_volume", VolumeSettings())):
        fewer, greater = (described(stands=(GROUND, BODIES.model_copy(update={"triangles": count}))) for count in (low, high))
        rates = all_at(10.0, fewer, *step)
        assert predicted_ms(rates, fewer, *step) <= predicted_ms(rates, greater, *step)
