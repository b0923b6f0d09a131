"""Reconstructed volumes: shadows of known geometry within a texel, and truth in bundled scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skugga.api.catalogue import find_level
from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.select import plan_of_view
from skugga.shadows.passes import PassLog
from skugga.shadows.reconstruction import light_volumes, reconstructed_volume
from skugga.shadows.truth.metrics import ErrorMetrics, error_metrics
from skugga.shadows.truth.truth import max_pixel_m
from skugga.shadows.visibility import receivers_of
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene
from tests.params import mark_long_except
from tests.render import plan_of
from tests.shadows.boxes import box, build_mesh_scene
from tests.shadows.test_known_geometry import distance_outside_hull
from tests.shadows.volumes.test_shadow_volume import (
    BODIES,
    EYES,
    LIGHTS,
    OPEN_MESHES,
    SHADOW_SIDE_VIEWS,
    THESIS_LEVELS,
    ShadowCase,
    eye_views,
    join_meshes,
    shadow_case,
    thesis_case,
)

AZIMUTH_DEG, ALTITUDE_DEG = 200.0, 35.0
TOWARDS_SHADOW = -np.array([np.sin(np.radians(AZIMUTH_DEG)), np.cos(np.radians(AZIMUTH_DEG))])
LENGTH_PER_M = 1.0 / np.tan(np.radians(ALTITUDE_DEG))

SMALL_MAP: dict[str, Any] = {"map_size": 256, "cascades": 1}
"""Settings whose volumes have few polygons."""


def visibility(case: ShadowCase, **overrides: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return visibility with attached shadow, NaN off the surface, and the side of a texel in pixels (rows, cols)."""
    plan = plan_of(case.scene, case.buffer.view, algorithm="reconstructed_volume", **overrides)
    (step,) = plan.steps_of_light(case.light)
    receivers = receivers_of(case.buffer, case.scene, case.light)
    filled = reconstructed_volume.fill_visibility(
        receivers, case.scene, case.light, step.kinds, case.casters, step.settings, PassLog()
    )
    texel_px = texel_footprint_px(case.scene, step, case.buffer, max_pixel_m(case.buffer))
    return case.with_attached_shadow(filled), texel_px


def check(case: ShadowCase, max_wrong_cast: float) -> ErrorMetrics:
    """Check that nothing is wrong farther than a texel from edges, and bound the wrong share of the cast shadow."""
    dark, texel_px = visibility(case)
    errors = error_metrics(dark, case.truth(), 1.0, texel_px)
    assert errors.interior <= 2e-4 and errors.wrong_cast <= max_wrong_cast, errors
    return errors


@pytest.mark.parametrize("map_size", [256, 1024])
def test_shadow_of_a_box_ends_within_a_texel(gl, tmp_path, map_size):
    """The ground is dark within the hull of the box's foot and of its roof, moved along the rays."""
    case = shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], AZIMUTH_DEG, ALTITUDE_DEG, **SHADOW_SIDE_VIEWS))
    plan = plan_of(case.scene, case.buffer.view, algorithm="reconstructed_volume", map_size=map_size, cascades=1)
    dark, _ = visibility(case, map_size=map_size, cascades=1)
    texels_m = plan.settings["sun"]["relief"].map.cascades[0].texel_m
    texel_m = max(texels_m[0], texels_m[1] / np.sin(np.radians(ALTITUDE_DEG)))
    foot = np.array([[-4.0, -3.0], [4.0, -3.0], [4.0, 3.0], [-4.0, 3.0]])
    outline = np.concatenate([foot, foot + 5.0 * LENGTH_PER_M * TOWARDS_SHADOW])
    outside = distance_outside_hull(case.buffer.position_frame_m[..., :2], outline)
    ground = case.buffer.surface_kind == RELIEF
    beyond, within = ground & (outside > texel_m), ground & (outside < -texel_m)
    assert min(beyond.sum(), within.sum()) > 150
    assert (dark[beyond] == 1.0).all() and (dark[within] == 0.0).all()


def test_contact_shadow_begins_at_the_foot(gl, tmp_path):
    """The box's foot lies in the plane of the ground: no strip of light is left between them."""
    case = shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], AZIMUTH_DEG, ALTITUDE_DEG, **eye_views((0, 9, 3), (0, 3, 0))))
    dark, _ = visibility(case)
    x, y = case.buffer.position_frame_m[..., 0], case.buffer.position_frame_m[..., 1]
    foot = (case.buffer.surface_kind == RELIEF) & (np.abs(x) < 3.5) & (y > 3.0) & (y < 3.3)
    assert foot.sum() > 50 and (dark[foot] == 0.0).all()


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("where", mark_long_except([*EYES], "in the shadow", "in the body"))
def test_any_eye_sees_the_same_shadow(gl, tmp_path, where, light):
    """The eye is before the shadow, in it, in its caster, or in the plane of its cap."""
    spec = {**EYES[where], "size": [120, 90]}
    check(shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, views={"eye": spec}, **LIGHTS[light])), 0.08)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("where", ["in the shadow", "in the body", "before the shadow"])
def test_z_pass_is_refused_or_right(gl, tmp_path, where, light):
    """Z-pass alone counts too few faces where the eye is in a volume."""
    spec = {**EYES[where], "size": [120, 90]} if where in EYES else {**SHADOW_SIDE_VIEWS["views"]["eye"], "size": [120, 90]}
    scene = build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, views={"eye": spec}, **LIGHTS[light])
    case = shadow_case(scene)
    try:
        counted = visibility(case, counting="z_pass")[0]
    except UnsupportedError as error:
        assert "counting: 'z_pass'" in str(error) and "the near plane" in str(error) and where != "before the shadow"
    else:
        assert where != "in the body"
        np.testing.assert_array_equal(counted, visibility(case, counting="z_fail")[0])


def test_large_maps_are_limited_with_a_reason(tmp_path):
    case = shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, **SHADOW_SIDE_VIEWS))
    plan = plan_of(case.scene, case.buffer.view, algorithm="reconstructed_volume", map_size=4096)
    assert plan.settings["sun"]["relief"].map.map_size == 2048
    assert "4096 texels a side are too many" in plan.model_dump_json()


def test_a_policy_plans_it_where_it_is_named():
    """Policies try maps of 4096 texels for other algorithms; a request for this one is served all the same."""
    scene = build_scene(load_level(find_level("thesis_rocks_sun")))
    view = scene.view("main", size=(160, 128))
    plan = plan_of_view(scene, view, "main", {"algorithm": "reconstructed_volume"})
    assert plan.settings["sun"]["meshes"].map.map_size <= 2048


@pytest.mark.parametrize("name", mark_long_except([*OPEN_MESHES, *BODIES], "one through another"))
@pytest.mark.parametrize("light", LIGHTS)
def test_any_caster_casts(gl, tmp_path, name, light):
    """A depth map needs neither closed nor well oriented meshes. Several faces of a cube serve an omni light."""
    check(
        shadow_case(build_mesh_scene(tmp_path, [(OPEN_MESHES | BODIES)[name]], 200, 35, **SHADOW_SIDE_VIEWS, **LIGHTS[light])), 0.08
    )


@pytest.mark.parametrize("light", LIGHTS)
def test_caster_between_eye_and_receiver(gl, tmp_path, light):
    """A plate hovers before the eye, whose shadow lies behind another body, and a court is open to the light."""
    court = join_meshes(box((8, 0.5, 4), at_m=(0, -4)), box((8, 0.5, 4), at_m=(0, 4)), box((0.5, 8, 4), at_m=(4, 0)))
    body = join_meshes(court, box((2, 2, 0.1), 5.0, (3, 9)))
    check(shadow_case(build_mesh_scene(tmp_path, [body], 200, 35, **eye_views((6, 22, 9), (0, 2, 0)), **LIGHTS[light])), 0.08)


@pytest.mark.parametrize(("settings", "max_count"), [({"counting": "z_fail"}, 0), ({"stencil": "two_pass"}, 3)])
def test_counting_changes_next_to_no_pixel(gl, settings, max_count):
    """A rasteriser may cull a clipped polygon seen edge-on that it draws without culling: one of 82,000 pixels here."""
    case, truth = thesis_case("thesis_street_sun")
    counted, expected = (visibility(case, **SMALL_MAP, **options)[0] for options in (settings, {}))
    assert ((counted != expected) & truth.valid).sum() <= max_count


@pytest.mark.parametrize("name", mark_long_except(THESIS_LEVELS, "thesis_street_sun"))
def test_bundled_scenes_match_truth(gl, name):
    case, truth = thesis_case(name)
    dark, texel_px = visibility(case)
    errors = error_metrics(dark, truth, 1.0, texel_px)
    assert errors.wrong_cast <= 0.08, errors


def test_squares_change_no_shadow(gl, monkeypatch):
    """Plane texels are merged for speed alone."""
    case, truth = thesis_case("thesis_street_sun")
    merged, _ = visibility(case, **SMALL_MAP)
    drawn = []

    def keep_texels(*arguments: Any) -> Any:
        drawn.append(light_volumes.rebuild_volume(*arguments, 1))
        return drawn[-1]

    monkeypatch.setattr(reconstructed_volume, "rebuild_volume", keep_texels)
    single, _ = visibility(case, **SMALL_MAP)
    assert drawn and ((merged != single) & truth.decidable).sum() <= 1e-4 * truth.decidable.sum()


def test_area_lights_are_refused(gl, tmp_path: Path):
    scene = build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, **SHADOW_SIDE_VIEWS)
    with pytest.raises(UnsupportedError, match="its edges are hard"):
        plan_of(scene, scene.view("eye"), algorithm="reconstructed_volume", filter="sun")
