"""Shadow volumes beside truth, whatever casts, wherever the eye and the light are; and each way of counting like the others."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from skugga.shadows.algorithm import SettingsRequest
from skugga.shadows.attached import attached
from skugga.shadows.hybrid import hybrid
from skugga.shadows.hybrid.settings import resolve_hybrid
from skugga.shadows.passes import PassLog
from skugga.shadows.sweep import sweep
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.truth.metrics import ErrorMetrics, error_metrics
from skugga.shadows.truth.truth import Truth, TruthSettings, trace_truth
from skugga.shadows.truth.truth import fill as truth_fill
from skugga.shadows.visibility import receivers_of
from skugga.shadows.volumes import shadow_volume
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.reach import NO_CASTERS, Casters, find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.antialias import multisampled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.hard_cases.bodies import EYES, SPOT, grounded, half_sphere, inside_out, joined, sheet, three_walls, without
from tests.params import quick
from tests.rasters import ENGINEERING
from tests.render import block_at
from tests.shadows.boxes import View, box, level_of

WAYS: list[dict[str, str]] = [{"counting": "z_fail"}, {"stencil": "two_pass"}]
"""Settings that must not change a pixel."""

OMNI = {"kind": "omni", "position": [-6, -12, 18]}
LIGHTS: dict[str, dict[str, Any]] = {
    "sun": {}, "spot": {"lights": {"spot": SPOT}, "sun": "none"}, "omni": {"lights": {"omni": OMNI}, "sun": "none"},
}  # fmt: skip

THESIS = [f"thesis_{name}{suffix}" for name in ("boxgrid", "rocks", "street", "room", "water_tower") for suffix in ("", "_sun")]


@dataclass(frozen=True, eq=False)
class Look:
    """What is seen of a scene, what may cast on it, and a light."""

    scene: Scene
    buffer: GeometryBuffer
    casters: Casters
    light: str

    def seen(self, mask: str | None = None, log: PassLog | None = None, **settings: Any) -> np.ndarray:
        """Visibility by volumes, or with ``mask`` by the hybrid: attached shadow is dark, NaN where there is no surface."""
        buffer = receivers_of(self.buffer, self.scene, self.light)
        kinds, log = tuple(k for k in self.scene.objects.kinds if k != "forest"), log or PassLog()
        if mask is None:
            found = shadow_volume.fill(buffer, self.scene, self.light, kinds, self.casters, VolumeSettings(**settings), log)
        else:
            asked = self.scene.loaded.level.shadows.model_copy(update={"mask": mask, **settings})
            ways, _ = resolve_hybrid(SettingsRequest(describe(self.scene, buffer.view), self.light, asked))
            found = hybrid.fill(buffer, self.scene, self.light, kinds, self.casters, ways, log)
        assert set(np.unique(found)) <= {0.0, 1.0}
        return self.finished(found)

    def finished(self, visibility: np.ndarray) -> np.ndarray:
        out = np.where(attached(self.buffer, self.scene, self.light), np.float32(0.0), visibility)
        return np.where(self.buffer.valid, out, np.nan)

    def rays(self) -> np.ndarray:
        """Visibility by rays from the very points, as ``seen``."""
        kinds, log = self.scene.objects.kinds, PassLog()
        return self.finished(truth_fill(self.buffer, self.scene, self.light, kinds, self.casters, TruthSettings(), log))

    def truth(self) -> Truth:
        return trace_truth(self.buffer, self.scene, self.casters, light=self.light)


def look(scene: Scene, view: View | None = None) -> Look:
    buffer = geometry_buffer(scene, view or scene.view("eye"))
    return Look(scene, buffer, find_casters(scene, buffer), scene.light_names[0])


def eye(at: Any, target: Any, fov: float = 60.0, size: tuple[int, int] = (120, 90)) -> dict[str, Any]:
    """The views of a level that is seen by one eye."""
    spec = {"kind": "perspective", "eye": list(at), "target": list(target), "fov": fov, "size": list(size)}
    return {"views": {"eye": spec}}


BEHIND = eye((12, 25, 6), (0, 3, 0.5))
"""Where the shadows of things at the middle fall: the lights are in the south."""


def above(scene: Scene, half_m: float = 15.0, px: int = 120) -> View:
    return scene.view(bounds=(-half_m, -half_m, half_m, half_m), size=(px, px))


def check(at: Look, least_dark: float = 0.0, real: Truth | None = None) -> tuple[np.ndarray, ErrorMetrics]:
    """Volumes beside truth, and each way of counting beside the others: not a pixel differs."""
    found, real = at.seen(), real or at.truth()
    errors = error_metrics(found, real, 1.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior == 0.0, errors
    assert (real.valid & ~real.lit & ~real.attached).sum() >= least_dark * real.valid.sum()
    for way in WAYS:
        np.testing.assert_array_equal(at.seen(**way), found, err_msg=str(way))
    return found, errors


# -- bodies


def slabs(window: bool) -> trimesh.Trimesh:
    """A hollow room of walls 0.3 m thick, 10 by 8 by 6 m, with a window in the north if it has one."""
    parts = [
        box((10, 8, 0.3)), box((10, 8, 0.3), 5.7), box((0.3, 8, 5.4), 0.3, (-4.85, 0)), box((0.3, 8, 5.4), 0.3, (4.85, 0)),
        box((9.4, 0.3, 5.4), 0.3, (0, -3.85)),
    ]  # fmt: skip
    if not window:
        return joined(*parts, box((9.4, 0.3, 5.4), 0.3, (0, 3.85)))
    sill, lintel = box((9.4, 0.3, 2), 0.3, (0, 3.85)), box((9.4, 0.3, 1.4), 4.3, (0, 3.85))
    return joined(*parts, sill, lintel, box((4, 0.3, 2), 2.3, (-2.7, 3.85)), box((3, 0.3, 2), 2.3, (3.2, 3.85)))


OPEN = {
    "upper half of a sphere": grounded(half_sphere(False)), "bowl": grounded(half_sphere(True)), "sheet": grounded(sheet()),
    "three walls": three_walls(),
}  # fmt: skip

BODIES = {
    "box": box((8, 6, 5)), "without a triangle": without(box((8, 6, 5)), 3), "inside out": inside_out(box((8, 6, 5))),
    "sharing an edge": joined(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), at_m=(2, 2))),
    "sharing a corner": joined(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), 4.0, (2, 2))),
    "one in another": joined(box((8, 8, 6)), box((3, 3, 2), 1.0)),
    "one through another": joined(box((8, 8, 3)), box((3, 3, 9), 1.0, (1, 1))),
    "the same twice": joined(box((8, 6, 5)), box((8, 6, 5))),
}  # fmt: skip


# -- beside truth


BUNDLED = [*((name, "main") for name in THESIS), ("thesis_street_sun", "map")]
IN_SECONDS = ("thesis_street_sun", "map"), ("thesis_room", "main"), ("thesis_rocks_sun", "main"), ("thesis_street_sun", "main")
"""Of the bundled scenes these are looked at wherever tests run: both kinds of light, open and closed meshes, a map."""


@lru_cache(maxsize=12)
def thesis(name: str, view: str = "main") -> tuple[Look, Truth]:
    """A bundled scene, small, and its truth."""
    scene = build_scene(load_level(f"configs/{name}.yaml"))
    at = look(scene, scene.view(view, size=(320, 256) if view == "main" else (160, 160)))
    return at, at.truth()


@pytest.mark.parametrize(("name", "view"), quick(BUNDLED, *IN_SECONDS))
def test_the_bundled_scenes_are_as_rays_see_them(gl, name, view):
    """Measured: at most 0.009 % of the decidable pixels. One of 50,000 may lie in a gap between two shadows that is narrower than
    the rasteriser's grid."""
    at, real = thesis(name, view)
    found = at.seen()
    errors = error_metrics(found, real, 1.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior <= 2e-5 and errors.interior_parts == 0, errors
    assert (~real.lit & ~real.attached & real.valid).sum() > 0.02 * real.valid.sum()
    for way in WAYS:
        np.testing.assert_array_equal(at.seen(**way), found, err_msg=str(way))


# Under the sun and a spot, and for every algorithm: tests/hard_cases. An omni light stands nearer.
@pytest.mark.parametrize("name", [*OPEN, *BODIES])
def test_bodies_round_an_omni_light(gl, tmp_path, name):
    """What is open casts from both sides, by the multiplicity of its edges; what touches or holds another casts with it."""
    scene = level_of(tmp_path, [(OPEN | BODIES)[name]], 200, 35, **BEHIND, **LIGHTS["omni"])
    check(look(scene), least_dark=0.01)
    check(look(scene, above(scene, px=60)), least_dark=0.005)


@pytest.mark.parametrize("where", EYES)
def test_wherever_the_eye_is_under_an_omni_light(gl, tmp_path, where):
    """In a volume, in what casts, in a cap's plane: z-pass and z-fail together, and z-fail alone."""
    check(under_an_omni_light(tmp_path, where))


def under_an_omni_light(tmp_path: Path, where: str) -> Look:
    """What an eye sees of a house."""
    spec = {**EYES[where], "size": [120, 90]}
    return look(level_of(tmp_path, [box((8, 6, 5))], 200, 35, views={"eye": spec}, **LIGHTS["omni"]))


# The eye is in the plate's shadow, but the near plane, half-way to what is nearest, is not.
@pytest.mark.parametrize("light", ["spot", "omni"])
def test_an_eye_in_a_shadow_that_does_not_reach_the_near_plane(gl, tmp_path, light):
    body = joined(box((8, 6, 5)), box((0.3, 0.3, 0.01), 6.1, (10, 20)))
    scene = level_of(tmp_path, [body], 200, 35, **eye((10, 20, 6.05), (0, 2, 0)), **LIGHTS[light])
    check(look(scene), least_dark=0.01)


@pytest.mark.parametrize("light", LIGHTS)
def test_a_room_whose_faces_are_turned_inwards_is_dark(gl, tmp_path, light):
    scene = level_of(tmp_path, [inside_out(box((8, 6, 5)))], 200, 35, **eye((0.3, 0.2, 2), (1, 5, 1), fov=100), **LIGHTS[light])
    check(look(scene), least_dark=0.5)


# -- suns and lamps


@pytest.mark.parametrize("altitude", [0.5, 2.0, 60.0, 89.999, 90.0])
@pytest.mark.parametrize("azimuth", [180.0, 205.0])
def test_suns_from_the_horizon_to_the_zenith(gl, tmp_path, azimuth, altitude):
    """Long volumes; and faces that the sun exactly grazes: of the box, of the plane through its roof."""
    scene = level_of(tmp_path, [box((8, 6, 5))], azimuth, altitude, **BEHIND)
    check(look(scene), least_dark=0.03 if altitude <= 2.0 else 0.0)


@pytest.mark.parametrize("way", [20.0, -20.0])
def test_the_sun_in_the_view_s_axis(gl, tmp_path, way):
    """Exactly behind the eye, where nothing in shadow is seen, and exactly ahead."""
    turn, rise = np.radians([200.0, 35.0])
    to_sun = np.array([np.sin(turn) * np.cos(rise), np.cos(turn) * np.cos(rise), np.sin(rise)])
    start = np.array([0.0, 0.0, 2.0]) + way * to_sun if way > 0 else np.array([0.0, 6.0, 1.0])
    scene = level_of(tmp_path, [box((8, 6, 5))], 200, 35, **eye(start, start - way * to_sun, fov=90))
    found, _ = check(look(scene))
    assert (found[np.isfinite(found)] == 0.0).any() == (way < 0)


@pytest.mark.parametrize("altitude", [2.0, 35.0])
def test_far_casters_behind_the_eye(gl, tmp_path, altitude):
    towers = joined(box((2, 2, 25), at_m=(-5, -40)), box((3, 3, 9), at_m=(-22, -90)), box((0.2, 0.2, 6), at_m=(0, 4)))
    scene = level_of(tmp_path, [towers], 195, altitude, **eye((2, -10, 3), (3, 20, 0)))
    check(look(scene), least_dark=0.03)


def shell(height_m: float) -> trimesh.Trimesh:
    """The open mantle of a cylinder round (0, 0)."""
    tube = trimesh.creation.cylinder(1.5, 2.0, sections=24)
    tube.apply_translation([0.0, 0.0, height_m])
    return without(tube, np.flatnonzero(np.abs(tube.face_normals[:, 2]) > 0.5))


def ring(height_m: float) -> trimesh.Trimesh:
    """The same with a thickness: a closed body."""
    tube = trimesh.creation.annulus(1.3, 1.5, 2.0, sections=24)
    tube.apply_translation([0.0, 0.0, height_m])
    return tube


SIDE = eye((22, 35, 16), (0, 4, 0))
THINGS = joined(box((0.3, 0.3, 8), at_m=(5, 5)), box((3, 2, 2), at_m=(-4, 3)))
ROOF = joined(box((8, 8, 0.3), 8.0), *(box((0.4, 0.4, 8.5), at_m=(x, y)) for x in (-3.5, 3.5) for y in (-3.5, 3.5)))
LAMPS: dict[str, tuple[trimesh.Trimesh, tuple[float, float, float], dict[str, Any]]] = {
    "in a closed room, from outside": (slabs(False), (1, 0.5, 3), SIDE),
    "in a closed room, from inside": (slabs(False), (1, 0.5, 3), eye((-4, -3, 1), (2, 2, 3), fov=90)),
    "in a room with a window, from outside": (slabs(True), (1, 0.5, 3), eye((22, 35, 16), (0, 8, 0))),
    "in a room with a window, from inside": (slabs(True), (1, 0.5, 3), eye((-4, -3, 1), (2, 2, 3), fov=90)),
    "in a solid box": (joined(box((8, 6, 5)), THINGS), (1, 0.5, 3), SIDE),
    "in a shade": (joined(shell(9.0), THINGS), (0.1, 0.05, 9), SIDE),
    "in a shade that is a body": (joined(ring(9.0), THINGS), (0.1, 0.05, 9), SIDE),
    "under a roof": (ROOF, (0.3, 0.2, 4), BEHIND),
    "lower than what casts": (box((8, 6, 5)), (-8, -9, 2), BEHIND),
}


@pytest.mark.parametrize("where", LAMPS)
@pytest.mark.parametrize("kind", ["omni", "spot"])
def test_wherever_the_lamp_is(gl, tmp_path, where, kind):
    body, place, view = LAMPS[where]
    lamp = {"kind": kind, "position": place} | ({"target": [0, 9, 0], "cutoff": 80} if kind == "spot" else {})
    scene = level_of(tmp_path, [body], 0, 0, **view, sun="none", lights={"lamp": lamp})
    check(look(scene))


@pytest.mark.parametrize("where", ["under a roof", "lower than what casts", "in a closed room, from outside", "in a shade"])
def test_a_map_of_what_reaches_above_the_lamp(gl, tmp_path, where):
    body, place, _ = LAMPS[where]
    scene = level_of(tmp_path, [body], 0, 0, sun="none", lights={"lamp": {"kind": "omni", "position": place}})
    check(look(scene, above(scene, 20.0, 60)), least_dark=0.1)


# Rays end in the very wall, so that truth knows nothing of what lies before it.
def test_a_lamp_on_a_body_s_surface(gl, tmp_path):
    """A wall lamp whose place is the wall's plane: what is behind the wall is dark."""
    wall = box((8, 0.5, 5), at_m=(0, 3.25))  # its southern side is y = 3
    scene = level_of(tmp_path, [wall], 0, 0, **BEHIND, sun="none", lights={"lamp": {"kind": "omni", "position": [0.4, 3.0, 4.0]}})
    at = look(scene)
    y = at.buffer.position_frame_m[..., 1]
    ground = at.buffer.valid & (at.buffer.kind == RELIEF)
    seen = at.seen()
    assert (ground & (y > 3.6)).mean() > 0.2 and (ground & (y < 2.9)).any()
    assert (seen[ground & (y > 3.6)] == 0.0).all() and (seen[ground & (y < 2.9)] == 1.0).all()


# -- many layers


def test_a_stack_of_bodies_is_counted_either_way(gl, tmp_path):
    """Plates with a thickness, each a body of its own, so that some are counted by z-pass and some by z-fail."""
    body = joined(*(box((6, 6, 0.02), 1.0 + 0.05 * n) for n in range(150)))
    scene = level_of(tmp_path, [body], 180, 75, **eye((4, 6, 1.2), (0, 0, 0.2)))
    at = look(scene)
    found = at.seen()
    assert error_metrics(found, at.truth(), 1.0).interior == 0.0
    np.testing.assert_array_equal(at.seen(counting="z_fail"), found)


# -- heightfields


RIDGES = {"generate": {"kind": "ridges", "size": [1400, 1400], "cell": 20, "relief": 350, "seed": 3}}


def by_sweep(at: Look) -> np.ndarray:
    return at.finished(
        sweep.fill(receivers_of(at.buffer, at.scene, "sun"), at.scene, "sun", ("relief",), at.casters, SweepSettings(), PassLog())
    )


def check_ground(at: Look) -> None:
    """Volumes beside truth, and beside the sweep."""
    found, real = at.seen(), at.truth()
    errors = error_metrics(found, real, 20.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior == 0.0, errors
    assert ((found < 0.5) != (by_sweep(at) < 0.5))[real.decidable].mean() <= 3e-3


@pytest.mark.parametrize("altitude", [30.0, 10.0, 3.0])
def test_ridges_are_as_the_sweep_sees_them(gl, tmp_path, altitude):
    """In perspective and in a map of a flat world; measured: the same in every decidable pixel."""
    path = tmp_path / "ridges.yaml"
    keys = {"version": 1, "terrain": RIDGES, "sun": {"azimuth": 113, "altitude": altitude}}
    path.write_text(json.dumps(keys | eye((-600, -650, 150), (0, 0, 50))), encoding="utf-8")
    scene = build_scene(load_level(path))
    for at in (look(scene), look(scene, above(scene, 350.0, 50))):
        check_ground(at)
        found = at.seen()
        assert 0.05 < (found[at.buffer.valid] == 0.0).mean() < 0.99
        np.testing.assert_array_equal(at.seen(counting="z_fail"), found)


@pytest.mark.parametrize("altitude", [30.0, 10.0, 3.0])
def test_a_tile_of_a_curved_earth_is_as_the_sweep_sees_it(gl, altitude):
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=67, altitude=altitude))
    check_ground(look(scene, block_at(-84.25, 36.2933, 12).part(273, 300, 80, 80)))


def holed(write_raster, make_scene, azimuth: float, rows: slice) -> Scene:
    """Waves without data in some rows of a strip through the middle."""
    row, col = np.mgrid[:60, :60]
    heights = (60.0 * np.sin(row / 7.0) * np.cos(col / 6.0) + 60.0).astype(np.float32)
    heights[rows, 26:32] = -9999.0
    raster = write_raster(heights, ENGINEERING, -300.0, 300.0, 10.0, nodata=-9999.0)
    return make_scene(raster, azimuth, 12.0, **eye((-260, -280, 120), (0, -100, 30)))


INNER, TO_THE_RIM = slice(24, 34), slice(0, 34)


@pytest.mark.parametrize("azimuth", [100.0, 280.0])
@pytest.mark.parametrize("gap", [INNER, TO_THE_RIM], ids=["inner", "to the rim"])
def test_a_map_of_ground_with_a_gap(gl, write_raster, make_scene, azimuth, gap):
    """What has no data is no wall and no pit; in a map the ground that casts goes on below it."""
    scene = holed(write_raster, make_scene, azimuth, gap)
    at = look(scene, above(scene, 200.0, 50))
    check(at, least_dark=0.05)
    assert not at.buffer.valid.all()


@pytest.mark.parametrize("gap", [INNER, TO_THE_RIM], ids=["inner", "to the rim"])
def test_a_perspective_view_of_ground_with_a_gap(gl, write_raster, make_scene, gap):
    """Through a bay of the rim the underside of the ground is seen: it is in the volume, and dark. Rays begin above it."""
    at = look(holed(write_raster, make_scene, 280.0, gap))
    below, real = from_below(at.buffer), at.truth()
    found, _ = check(at, least_dark=0.05, real=replace(real, decidable=real.decidable & ~below))
    assert below.any() == (gap == TO_THE_RIM) and not found[below].any()


def from_below(buffer: GeometryBuffer) -> np.ndarray:
    """Where a camera sees triangles from behind, counter-clockwise as they are from above, bool (rows, cols).

    Not those that it sees nearly edge-on: along a ridge's outline the rasteriser's rounding shows one of the far side now and then.
    """
    assert isinstance(buffer.view, PerspectiveView) and buffer.corners_frame_m is not None
    a, b, c = np.moveaxis(buffer.corners_frame_m.reshape(*buffer.valid.shape, 3, 3), 2, 0)
    away = buffer.position_frame_m - buffer.view.in_frame(buffer.frame)[0]
    normal = np.cross(b - a, c - a)
    sine = (normal * away).sum(axis=-1) / (np.linalg.norm(normal, axis=-1) * np.linalg.norm(away, axis=-1))
    return buffer.valid & (sine > 0.1)


# -- kept


def kept(at: Look, mask: str | None = None) -> tuple[int, int]:
    """How many volumes a frame found, and the edges of all of its silhouettes."""
    log = PassLog()
    at.seen(mask, log)
    record = next(record for name, record in log.records.items() if name.endswith("silhouettes"))
    return record.kept, record.edges


@pytest.mark.parametrize("mask", [None, "conservative"])
def test_volumes_are_kept_while_sun_and_casters_rest(gl, tmp_path, mask):
    """Whatever the eye does; they are made anew when the sun or a caster moves, for another frame, and once forgotten."""
    views = {
        name: eye((x, 25, 6), (x - 12, 3, 0.5), size=(60, 40))["views"]["eye"]
        for name, x in (("eye", 12), ("near", 14), ("far", 90_000))
    }
    path = tmp_path / "level.yaml"
    meshes = [{"generate": "tetrahedra", "at": [0, 0], "motion": {"spin": 30}}]
    keys = {"version": 1, "terrain": {"flat": {"size": [2e5, 2e5], "cells": [20, 20]}}, "meshes": meshes, "views": views}
    path.write_text(json.dumps(keys | {"sun": {"azimuth": 200, "altitude": 35}}), encoding="utf-8")
    scene = build_scene(load_level(path))
    clear_caches("light")
    first, edges = kept(look(scene), mask)
    assert first == 0 and edges > 0
    assert kept(look(scene), mask)[0] > 0 and kept(look(scene, scene.view("near")), mask)[0] > 0
    near, far = look(scene), look(scene, scene.view("far"))
    assert (near.buffer.frame.origin_earth_m != far.buffer.frame.origin_earth_m).any()
    assert kept(far, mask)[0] == 0
    assert kept(look(scene.with_sun(SunSpec(azimuth=200.01, altitude=35))), mask)[0] == 0
    moved = look(scene.at_second(1.0))
    assert kept(moved, mask)[0] == 0 and kept(look(scene), mask)[0] > 0
    later = moved.seen(mask)
    clear_caches("light")
    assert kept(look(scene), mask)[0] == 0
    np.testing.assert_array_equal(moved.seen(mask), later)
    assert (later != look(scene).seen(mask))[moved.buffer.valid].any()


# -- samples


@pytest.mark.parametrize("mask", [None, "conservative", "original"])
@pytest.mark.parametrize("light", LIGHTS)
def test_samples_of_a_pixel_are_counted_where_they_lie(gl, tmp_path, light, mask):
    """The rows of samples below the picture's own, against rays from their own points."""
    posts = joined(*(box((2, 2, 5), at_m=(x, y)) for x in (-9, -3, 3, 9) for y in (-6, 0, 6)))
    scene = level_of(tmp_path, [posts], 200, 35, **BEHIND, **LIGHTS[light])
    buffer = multisampled(scene, scene.view("eye")).buffer
    own = scene.view("eye").rows
    assert len(buffer.valid) > own
    at = Look(scene, buffer, NO_CASTERS, scene.light_names[0])
    found, real = at.seen(mask), at.rays()
    samples = buffer.valid & ~attached(buffer, scene, at.light)
    samples[:own] = False
    dark = (real[samples] < 0.5).sum()
    assert dark > 200 and dark < 0.95 * samples.sum()
    # rays and rasteriser differ by 1/256 pixel, at points that all lie where something ends
    assert (found != real)[samples].sum() <= 0.01 * dark
