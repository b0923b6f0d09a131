"""Number of sample points of a lamp's ball: as many as its penumbrae have pixels for."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows import algorithm_settings, penumbra, requirements
from skugga.shadows.penumbra import MAX_LIGHT_POINTS, light_point_count, penumbra_px
from skugga.shadows.requirements import is_area_light
from skugga.terrain.describe import describe
from skugga.terrain.facts.fact_types import TEXEL_SIZES_PX, CastBand, Casting, LampFacts, LightFacts
from skugga.terrain.level.level import Shadows
from tests.render import plan_of
from tests.shadows.test_area_light import LAMPS, MAX_SOFT_ERROR, area_light_scene, rendered_visibility

SIDE_M = 28.0


def view_descriptor(scene, view, radius_m: float, light_m: float, thrown_m: float | None, pixel_m: float):
    """Return a perspective view with known distances of the lamp and of its shadows."""
    band = CastBand(near_m=1.0, share=0.5, cast=0.5, pixel_m=pixel_m, light_m=light_m, differs=(0.0,) * len(TEXEL_SIZES_PX))
    lamp = LampFacts(name="spot", kind="spot", cutoff_deg=40, reference_m=15, radius_m=radius_m)
    lit = LightFacts(casts={"meshes": Casting(share=0.2, bands=(band,), thrown_m=thrown_m)})
    return describe(scene, view, "eye").model_copy(update={"lamps": (lamp,), "lights": {"spot": lit}})


def test_penumbra_px_is_the_ball_seen_past_an_edge(tmp_path):
    """The width is 2 R t / (d - t), for casters twice as far away as the median."""
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"]})
    view = scene.view("eye")
    assert penumbra_px(view_descriptor(scene, view, 0.2, 20.0, 5.0, 0.1), "spot") == pytest.approx(2 * 0.2 * 10 / 10 / 0.1)
    assert penumbra_px(view_descriptor(scene, view, 0.2, 20.0, 0.0, 0.1), "spot") == 0.0, "a shadow at the foot of its caster"
    assert penumbra_px(view_descriptor(scene, view, 0.2, 20.0, None, 0.1), "spot") == pytest.approx(2 * 0.2 * 4 / 0.1)
    assert light_point_count(view_descriptor(scene, view, 0.2, 20.0, 5.0, 0.1), "spot") == 16
    assert light_point_count(view_descriptor(scene, view, 0.2, 20.0, 5.0, 0.01), "spot") == MAX_LIGHT_POINTS
    coarse_pixel_descriptor = view_descriptor(scene, view, 0.2, 20.0, 5.0, 30.0)
    assert light_point_count(coarse_pixel_descriptor, "spot") == 1
    assert not is_area_light(coarse_pixel_descriptor, "spot", Shadows()) and is_area_light(
        coarse_pixel_descriptor, "spot", Shadows(filter="sun")
    )


@pytest.mark.parametrize(("pixels", "points"), [(8, 5), (12, 7)])
def test_light_points_suffice_for_the_picture(gl, tmp_path, monkeypatch, pixels, points):
    """Map pixels are 3.5 and 2.3 m wide, under a lamp whose penumbrae are up to 4 m wide."""
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"]}, sun="none")
    view = scene.view(bounds=(-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2), size=(pixels, pixels))
    few_points_visibility = rendered_visibility(scene, view, "spot", algorithm="shadow_map", map_size=512)
    assert light_point_count(describe(scene, view, "map"), "spot") == points
    for module in (algorithm_settings, requirements, penumbra):
        monkeypatch.setattr(module, "light_point_count", lambda descriptor, light: MAX_LIGHT_POINTS)
    max_points_visibility = rendered_visibility(scene, view, "spot", algorithm="shadow_map", map_size=512)
    assert np.nanmean(np.abs(few_points_visibility - max_points_visibility)) <= MAX_SOFT_ERROR


def test_light_points_are_one_for_penumbrae_below_a_pixel(gl, tmp_path):
    scene = area_light_scene(tmp_path, lights={"spot": LAMPS["spot"] | {"radius": 0.2}})
    view = scene.view(bounds=(-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2), size=(4, 4))
    plan = plan_of(scene, view, algorithm={"sun": "shadow_volume", "spot": "shadow_map"})
    assert plan.settings["spot"]["meshes"].filter == 3
    reasons = {reason.name: reason.reason for reason in plan.reasons}
    assert "narrower than a pixel" in reasons["spot: filter 3"]
