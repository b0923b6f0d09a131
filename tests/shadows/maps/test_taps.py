"""Taps of a sun's map: three where texels are finer than penumbrae, one where they would only blur."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.selector.planner.planner import make_plan
from skugga.shadows.maps.settings import Cascade
from skugga.shadows.maps.taps import MAX_FINE_TEXEL_SHARE, PENUMBRA_WIDTH_SHARE, fine_texel_share, sun_taps
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import CastBand, Casting, LightFacts
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.render import plan_of
from tests.shadows.boxes import box, build_mesh_scene, visibility


def make_descriptor(**casts: Casting) -> Descriptor:
    """Return the descriptor of a map under a sun with the given shadows."""
    return Descriptor(
        view="map", view_kind="map", flat_world=True, pixel_m=1.0, node_m=1.0, casters=tuple(casts), relief_m=0.0,
        block_relief_m=0.0,
        sun_azimuth_deg=200.0, sun_altitude_deg=30.0, highest_sun_deg=30.0, receivers_light_m=(100.0, 100.0, 100.0),
        lights={"sun": LightFacts(casts=casts)},
    )  # fmt: skip


def casting(thrown_m: float | None, *cast: float) -> Casting:
    """Return shadows in bands of a quarter of the view each, from 1, 2, 4 m ... on."""
    bands = tuple(
        CastBand(near_m=2.0**k, far_m=2.0 ** (k + 1), share=0.25, cast=share, pixel_m=0.1, differs=(0.1,) * 8)
        for k, share in enumerate(cast)
    )
    return Casting(share=0.1, bands=bands, thrown_m=thrown_m)


def cascade(texel_m: float, far_m: float | None = None) -> Cascade:
    """Return a cascade with square texels that ends at ``far_m`` metres; ``None`` for no end."""
    return Cascade(far_m=far_m, texel_m=(texel_m, texel_m), depth_step_m=0.01)


THROW_DISTANCE_M = 50.0
MAX_FINE_TEXEL_M = MAX_FINE_TEXEL_SHARE * PENUMBRA_WIDTH_SHARE * THROW_DISTANCE_M


@pytest.mark.parametrize(("texel_m", "taps"), [(0.9 * MAX_FINE_TEXEL_M, 3), (1.1 * MAX_FINE_TEXEL_M, 1)])
def test_sun_taps_follow_texel_and_penumbra_widths(texel_m, taps):
    tap_count, reason = sun_taps(make_descriptor(meshes=casting(THROW_DISTANCE_M, 0.5)), [cascade(texel_m)])
    assert tap_count == taps and reason.startswith("for the least soft error: texels are finer than penumbrae in ")


def test_fine_share_weights_cascades_by_their_shadow():
    fine_near = [cascade(0.5 * MAX_FINE_TEXEL_M, far_m=2.0), cascade(2.0 * MAX_FINE_TEXEL_M)]
    assert fine_texel_share(make_descriptor(meshes=casting(THROW_DISTANCE_M, 0.6, 0.2)), fine_near) == pytest.approx(0.75)
    assert fine_texel_share(make_descriptor(meshes=casting(THROW_DISTANCE_M, 0.2, 0.6)), fine_near) == pytest.approx(0.25)


def test_fine_share_counts_foliage_as_coarse_and_skips_relief():
    cascades = [cascade(0.1 * MAX_FINE_TEXEL_M)]
    assert fine_texel_share(
        make_descriptor(meshes=casting(THROW_DISTANCE_M, 0.2), forest=casting(THROW_DISTANCE_M, 0.6)), cascades
    ) == pytest.approx(0.25)
    assert (
        fine_texel_share(make_descriptor(relief=casting(None, 0.9)), cascades) is None
        and sun_taps(make_descriptor(relief=casting(None, 0.9)), cascades)[0] == 3
    )
    assert fine_texel_share(make_descriptor(meshes=casting(THROW_DISTANCE_M, 0.2), relief=casting(None, 0.9)), cascades) == 1.0


@pytest.mark.parametrize(("level", "view", "map_size", "taps"), [
    ("jacksboro_wooded", "village", 4096, 1), ("thesis_boxgrid_sun", "close", 1024, 3), ("thesis_rocks_sun", "main", 1024, 1),
    ("thesis_street_sun", "main", 4096, 3),
])  # fmt: skip
def test_sun_taps_of_bundled_levels_are_nearest_to_the_disc(level, view, map_size, taps):
    """``docs/reports/accuracy.md`` has the measurements."""
    scene = build_scene(load_level(find_level(level)))
    scene_view = scene.view(view, size=(480, 384))
    overrides = {"algorithm": "shadow_map", "map_size": map_size}
    plan = make_plan(describe(scene, scene_view, view), scene.loaded.level, overrides)
    assert {settings.filter for settings in plan.settings["sun"].values()} == {taps}
    assert any(reason.name == f"filter {taps}" and "soft error" in reason.reason for reason in plan.reasons)


@pytest.mark.parametrize("taps", [1, 2, 3, 5])
def test_taps_show_the_lit_share_of_their_square(gl, tmp_path, taps):
    """The edge of a plate's shadow runs along the map's columns of texels.

    Visibility rises across it as the lit share of a square of ``taps`` - 1 texels does: linearly, with one tap in a single step.
    ``receiver_plane`` would take two taps, since texels are wider than the triangles of these small pixels.
    """
    scene = build_mesh_scene(tmp_path, [box((30, 40, 0.05), 3.0, (-15, -54.2))], 180, 50)
    view = scene.view(bounds=(-4, -34, 4, -33.5), size=(640, 8))
    overrides = {"filter": taps, "map_size": 128, "bias": "normal_offset"}
    (step,) = plan_of(scene, view, algorithm="shadow_map", **overrides).steps
    texel_px = step.settings.cascades[0].texel_m[0] / (8.0 / 640)
    rendered, _ = visibility(scene, view, **overrides)
    edge_px = (1.0 - rendered.mean()) * 640
    distance_px = np.arange(640) + 0.5 - edge_px
    expected = np.clip(distance_px / max((taps - 1) * texel_px, 1.0) + 0.5, 0.0, 1.0)
    assert texel_px > 4.0 and (taps - 1) * texel_px < 320
    assert np.abs(rendered - expected).max() <= (0.5 if taps == 1 else 0.02)
    if taps == 1:
        assert set(np.unique(rendered)) == {0.0, 1.0}
