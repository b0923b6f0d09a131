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
from tests.params import quick
from tests.render import block_at
from tests.shadows.boxes import box, level_of
from tests.shadows.volumes.test_shadow_volume import (
    BEHIND,
    BODIES,
    BUNDLED,
    EYES,
    IN_SECONDS,
    LAMPS,
    LIGHTS,
    OPEN,
    RIDGES,
    Look,
    eye,
    look,
    thesis,
    under_an_omni_light,
)  # fmt: skip

MAX_MARKED = 0.3
"""Upper bound of the marked share of a small picture, which is crowded with edges."""


def stencil_record(log: PassLog) -> PassRecord:
    return next(record for name, record in log.records.items() if name.endswith(": stencil"))


def same(at: Look, real: Truth | None = None, **settings: Any) -> float:
    """Check the conservative hybrid against the volumes and return the share of marked pixels.

    All decidable pixels are equal, and all others but a few.
    """
    log, volumes = PassLog(), at.seen()
    found = at.seen("conservative", log, **settings)
    real = real or at.truth()
    differ = (found != volumes) & at.buffer.valid
    assert not (differ & real.decidable).any(), (
        f"{(differ & real.decidable).sum()} of {real.decidable.sum()} decidable pixels differ"
    )
    assert differ.sum() <= 1e-4 * at.buffer.valid.sum() + 1
    return stencil_record(log).marked / at.buffer.valid[: at.buffer.view.rows].size


# -- conservative


@pytest.mark.parametrize(("name", "view"), quick(BUNDLED, *IN_SECONDS))
def test_hybrid_equals_volumes_in_bundled_scenes(gl, name, view):
    at, real = thesis(name, view)
    marked = same(at, real)
    assert 0.005 < marked < MAX_MARKED, f"{marked:.1%} of the pixels are marked"


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("name", [*OPEN, *BODIES])
def test_hybrid_equals_volumes_for_any_caster(gl, tmp_path, name, light):
    scene = level_of(tmp_path, [(OPEN | BODIES)[name]], 200, 35, **BEHIND, **LIGHTS[light])
    marked = same(look(scene))
    assert 0.0 < marked < 0.1, f"{marked:.1%} of the pixels are marked"


# tests/hard_cases compares the sun and a spot with truth.
@pytest.mark.parametrize("where", EYES)
def test_hybrid_equals_volumes_for_any_eye_under_an_omni_light(gl, tmp_path, where):
    """Inside a body only back faces of a closed body are visible, and none of them casts."""
    same(under_an_omni_light(tmp_path, where))


@pytest.mark.parametrize("where", LAMPS)
def test_hybrid_equals_volumes_for_any_lamp_position(gl, tmp_path, where):
    body, place, view = LAMPS[where]
    lamp = {"kind": "omni", "position": place}
    same(look(level_of(tmp_path, [body], 0, 0, **view, sun="none", lights={"lamp": lamp})))


@pytest.mark.parametrize("map_size", [64, 200, 2048])
def test_hybrid_equals_volumes_for_any_map_size(gl, tmp_path, map_size):
    """A smaller map marks more pixels. The picture does not change."""
    at = look(level_of(tmp_path, [BODIES["one through another"]], 200, 35, **BEHIND))
    marked = same(at, map_size=map_size)
    assert marked < {64: 0.2, 200: 0.08, 2048: 0.03}[map_size], f"{marked:.1%} of the pixels are marked"


@pytest.mark.parametrize("settings", [{"counting": "z_fail"}, {"stencil": "two_pass"}])
def test_hybrid_is_independent_of_counting_settings(gl, settings):
    at, _ = thesis("thesis_room")
    np.testing.assert_array_equal(at.seen("conservative", **settings), at.seen("conservative"))


@pytest.mark.parametrize("altitude", [30.0, 3.0])
def test_hybrid_equals_volumes_over_ground(gl, tmp_path, altitude):
    """The grounds are ridges of a flat world in perspective, and a tile of a curved earth."""
    path = tmp_path / "ridges.yaml"
    keys = {"version": 1, "terrain": RIDGES, "sun": {"azimuth": 113, "altitude": altitude}}
    path.write_text(json.dumps(keys | eye((-600, -650, 150), (0, 0, 50))), encoding="utf-8")
    same(look(build_scene(load_level(path))))
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=67, altitude=altitude))
    same(look(scene, block_at(-84.25, 36.2933, 12).part(273, 300, 80, 80)))


# -- the original mask


@pytest.mark.parametrize("light", LIGHTS)
def test_original_mask_is_near_truth_without_thin_casters(gl, tmp_path, light):
    """Errors occur only where a texel crosses a silhouette that comparisons with its neighbours do not show."""
    at = look(level_of(tmp_path, [box((8, 6, 5))], 200, 35, **BEHIND, **LIGHTS[light]))
    real = at.truth()
    wrong = real.decidable & ((at.seen("original") < 0.5) == real.lit)
    assert wrong.sum() <= 2e-3 * real.decidable.sum()


# -- records


def test_hybrid_records_marked_pixels_and_tiles(gl, tmp_path):
    """The record counts pixels and tiles of the picture. The map is cached as the volumes are."""
    at = look(level_of(tmp_path, [BODIES["one through another"]], 200, 35, **BEHIND))
    log = PassLog(requested_layers=frozenset({"silhouettes", "stencil"}))
    at.seen("conservative", log)
    layers = log.take()
    marks, counts = layers["silhouettes", "sun"][0], layers["stencil", "sun"][0]
    record = stencil_record(log)
    assert set(np.unique(marks)) == {0, 255} and record.marked == (marks == 255).sum() > 50
    rows, cols = np.nonzero(marks)
    assert record.tiles == len(np.unique(rows // 8 * 1000 + cols // 8))
    assert (counts[marks == 0] == 0).all() and (counts > 0).any()
    again = PassLog()
    at.seen("conservative", again)
    kept = {name.split(": ")[1]: each.kept for name, each in again.records.items()}
    assert kept["silhouettes"] > 0 and kept["map"] > 0
