"""Hybrid: the conservative mask reproduces shadow volumes and marks few pixels; the original mask loses wires."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from skugga.shadows.passes import PassLog, PassRecord
from skugga.shadows.truth.truth import Truth
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import build_scene
from tests.params import mark_long_except
from tests.render import block_at
from tests.shadows.boxes import box, build_mesh_scene
from tests.shadows.volumes.test_shadow_volume import (
    BODIES,
    BUNDLED_VIEWS,
    EYES,
    LAMPS,
    LIGHTS,
    OPEN_MESHES,
    QUICK_VIEWS,
    RIDGES,
    SHADOW_SIDE_VIEWS,
    ShadowCase,
    eye_views,
    shadow_case,
    thesis_case,
    under_an_omni_light,
)  # fmt: skip

MAX_MARKED = 0.3
"""Upper bound of the marked share of a small picture, which is crowded with edges."""


def stencil_record(log: PassLog) -> PassRecord:
    """Return the record of the stencil pass."""
    return next(record for name, record in log.records.items() if name.endswith(": stencil"))


def check_equals_volumes(view_points: ShadowCase, truth: Truth | None = None, **settings: Any) -> float:
    """Check the conservative hybrid against the volumes and return the share of marked pixels.

    All decidable pixels are equal, and all others but a few.
    """
    log, volumes = PassLog(), view_points.volume_visibility()
    hybrid_visibility = view_points.volume_visibility("conservative", log, **settings)
    truth = truth or view_points.truth()
    differ = (hybrid_visibility != volumes) & view_points.buffer.valid
    assert not (differ & truth.decidable).any(), (
        f"{(differ & truth.decidable).sum()} of {truth.decidable.sum()} decidable pixels differ"
    )
    assert differ.sum() <= 1e-4 * view_points.buffer.valid.sum() + 1
    return stencil_record(log).marked / view_points.buffer.valid[: view_points.buffer.view.rows].size


# -- conservative


@pytest.mark.parametrize(("name", "view"), mark_long_except(BUNDLED_VIEWS, *QUICK_VIEWS))
def test_hybrid_equals_volumes_in_bundled_scenes(gl, name, view):
    view_points, truth = thesis_case(name, view)
    marked_share = check_equals_volumes(view_points, truth)
    assert 0.005 < marked_share < MAX_MARKED, f"{marked_share:.1%} of the pixels are marked"


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("name", [*OPEN_MESHES, *BODIES])
def test_hybrid_equals_volumes_for_any_caster(gl, tmp_path, name, light):
    scene = build_mesh_scene(tmp_path, [(OPEN_MESHES | BODIES)[name]], 200, 35, **SHADOW_SIDE_VIEWS, **LIGHTS[light])
    marked_share = check_equals_volumes(shadow_case(scene))
    assert 0.0 < marked_share < 0.1, f"{marked_share:.1%} of the pixels are marked"


# tests/hard_cases compares the sun and a spot with truth.
@pytest.mark.parametrize("where", EYES)
def test_hybrid_equals_volumes_for_any_eye_under_an_omni_light(gl, tmp_path, where):
    """Inside a body only back faces of a closed body are visible, and none of them casts."""
    check_equals_volumes(under_an_omni_light(tmp_path, where))


@pytest.mark.parametrize("where", LAMPS)
def test_hybrid_equals_volumes_for_any_lamp_position(gl, tmp_path, where):
    body, place, view = LAMPS[where]
    lamp = {"kind": "omni", "position": place}
    check_equals_volumes(shadow_case(build_mesh_scene(tmp_path, [body], 0, 0, **view, sun="none", lights={"lamp": lamp})))


@pytest.mark.parametrize("map_size", [64, 200, 2048])
def test_hybrid_equals_volumes_for_any_map_size(gl, tmp_path, map_size):
    """A smaller map marks more pixels. The picture does not change."""
    view_points = shadow_case(build_mesh_scene(tmp_path, [BODIES["one through another"]], 200, 35, **SHADOW_SIDE_VIEWS))
    marked_share = check_equals_volumes(view_points, map_size=map_size)
    assert marked_share < {64: 0.2, 200: 0.08, 2048: 0.03}[map_size], f"{marked_share:.1%} of the pixels are marked"


@pytest.mark.parametrize("settings", [{"counting": "z_fail"}, {"stencil": "two_pass"}])
def test_hybrid_is_independent_of_counting_settings(gl, settings):
    view_points, _ = thesis_case("thesis_room")
    np.testing.assert_array_equal(
        view_points.volume_visibility("conservative", **settings), view_points.volume_visibility("conservative")
    )


@pytest.mark.parametrize("altitude", [30.0, 3.0])
def test_hybrid_equals_volumes_over_ground(gl, tmp_path, altitude):
    """The grounds are ridges of a flat world in perspective, and a tile of a curved earth."""
    path = tmp_path / "ridges.yaml"
    keys = {"version": 1, "terrain": RIDGES, "sun": {"azimuth": 113, "altitude": altitude}}
    path.write_text(json.dumps(keys | eye_views((-600, -650, 150), (0, 0, 50))), encoding="utf-8")
    check_equals_volumes(shadow_case(build_scene(load_level(path))))
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=67, altitude=altitude))
    check_equals_volumes(shadow_case(scene, block_at(-84.25, 36.2933, 12).part(273, 300, 80, 80)))


# -- the original mask


@pytest.mark.parametrize("light", LIGHTS)
def test_original_mask_is_near_truth_without_thin_casters(gl, tmp_path, light):
    """Errors occur only where a texel crosses a silhouette that comparisons with its neighbours do not show."""
    view_points = shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, **SHADOW_SIDE_VIEWS, **LIGHTS[light]))
    truth = view_points.truth()
    wrong_pixels = truth.decidable & ((view_points.volume_visibility("original") < 0.5) == truth.lit)
    assert wrong_pixels.sum() <= 2e-3 * truth.decidable.sum()


# -- records


def test_hybrid_records_marked_pixels_and_tiles(gl, tmp_path):
    """The record counts pixels and tiles of the picture. The map is cached as the volumes are."""
    view_points = shadow_case(build_mesh_scene(tmp_path, [BODIES["one through another"]], 200, 35, **SHADOW_SIDE_VIEWS))
    log = PassLog(requested_layers=frozenset({"silhouettes", "stencil"}))
    view_points.volume_visibility("conservative", log)
    layers = log.take_layers()
    marks, counts = layers["silhouettes", "sun"][0], layers["stencil", "sun"][0]
    record = stencil_record(log)
    assert set(np.unique(marks)) == {0, 255} and record.marked == (marks == 255).sum() > 50
    rows, cols = np.nonzero(marks)
    assert record.tiles == len(np.unique(rows // 8 * 1000 + cols // 8))
    assert (counts[marks == 0] == 0).all() and (counts > 0).any()
    second_log = PassLog()
    view_points.volume_visibility("conservative", second_log)
    cache_hits = {name.split(": ")[1]: pass_record.kept for name, pass_record in second_log.records.items()}
    assert cache_hits["silhouettes"] > 0 and cache_hits["map"] > 0
