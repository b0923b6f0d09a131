"""The hybrid: its conservative mask leaves the picture of shadow volumes and marks few pixels; the original one loses wires."""

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
"""Share of the pixels of a small picture that a map leaves to volumes, at most: most are crowded with edges."""


def stencil_record(log: PassLog) -> PassRecord:
    return next(record for name, record in log.records.items() if name.endswith(": stencil"))


def same(at: Look, real: Truth | None = None, **settings: Any) -> float:
    """The conservative hybrid's picture is that of the volumes in every decidable pixel, and in all but a few others; gives the
    share of marked pixels.
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
def test_the_bundled_scenes_are_those_of_the_volumes(gl, name, view):
    at, real = thesis(name, view)
    marked = same(at, real)
    assert 0.005 < marked < MAX_MARKED, f"{marked:.1%} of the pixels are marked"


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("name", [*OPEN, *BODIES])
def test_whatever_casts(gl, tmp_path, name, light):
    scene = level_of(tmp_path, [(OPEN | BODIES)[name]], 200, 35, **BEHIND, **LIGHTS[light])
    marked = same(look(scene))
    assert 0.0 < marked < 0.1, f"{marked:.1%} of the pixels are marked"


# Under the sun and a spot, against truth: tests/hard_cases.
@pytest.mark.parametrize("where", EYES)
def test_wherever_the_eye_is_under_an_omni_light(gl, tmp_path, where):
    """In a body all that is seen are backs of a closed body's faces: none of them casts."""
    same(under_an_omni_light(tmp_path, where))


@pytest.mark.parametrize("where", LAMPS)
def test_wherever_the_lamp_is(gl, tmp_path, where):
    body, place, view = LAMPS[where]
    lamp = {"kind": "omni", "position": place}
    same(look(level_of(tmp_path, [body], 0, 0, **view, sun="none", lights={"lamp": lamp})))


@pytest.mark.parametrize("map_size", [64, 200, 2048])
def test_whatever_the_map_s_size(gl, tmp_path, map_size):
    """The smaller the map the more is marked; the picture stays."""
    at = look(level_of(tmp_path, [BODIES["one through another"]], 200, 35, **BEHIND))
    marked = same(at, map_size=map_size)
    assert marked < {64: 0.2, 200: 0.08, 2048: 0.03}[map_size], f"{marked:.1%} of the pixels are marked"


@pytest.mark.parametrize("settings", [{"counting": "z_fail"}, {"stencil": "two_pass"}])
def test_ways_of_counting_change_nothing(gl, settings):
    at, _ = thesis("thesis_room")
    np.testing.assert_array_equal(at.seen("conservative", **settings), at.seen("conservative"))


@pytest.mark.parametrize("altitude", [30.0, 3.0])
def test_ground(gl, tmp_path, altitude):
    """Ridges of a flat world in perspective, and a tile of a curved earth."""
    path = tmp_path / "ridges.yaml"
    keys = {"version": 1, "terrain": RIDGES, "sun": {"azimuth": 113, "altitude": altitude}}
    path.write_text(json.dumps(keys | eye((-600, -650, 150), (0, 0, 50))), encoding="utf-8")
    same(look(build_scene(load_level(path))))
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=67, altitude=altitude))
    same(look(scene, block_at(-84.25, 36.2933, 12).part(273, 300, 80, 80)))


# -- the original mask


@pytest.mark.parametrize("light", LIGHTS)
def test_the_original_mask_is_near_truth_where_nothing_is_thin(gl, tmp_path, light):
    """Wrong only where a texel lies across a silhouette that its neighbours' comparisons do not show."""
    at = look(level_of(tmp_path, [box((8, 6, 5))], 200, 35, **BEHIND, **LIGHTS[light]))
    real = at.truth()
    wrong = real.decidable & ((at.seen("original") < 0.5) == real.lit)
    assert wrong.sum() <= 2e-3 * real.decidable.sum()


# -- records


def test_what_is_marked_is_put_on_record(gl, tmp_path):
    """Pixels and tiles of the picture; the map is kept as the volumes are."""
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
