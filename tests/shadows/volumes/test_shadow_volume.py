"""Shadow volumes: agreement with truth for any caster, eye and light, and between the ways of counting."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from skugga.shadows.algorithm_settings import SettingsRequest
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.hybrid import hybrid
from skugga.shadows.hybrid.settings import resolve_hybrid
from skugga.shadows.passes import PassLog
from skugga.shadows.sweep import sweep
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.truth.metrics import ErrorMetrics, error_metrics
from skugga.shadows.truth.truth import Truth, TruthSettings, trace_truth
from skugga.shadows.truth.truth import fill_visibility as truth_fill
from skugga.shadows.visibility import receivers_of
from skugga.shadows.volumes import shadow_volume
from skugga.shadows.volumes.settings import VolumeSettings
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.caster_types import NO_CASTERS, Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.antialias import multisampled
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene, build_scene
from tests.hard_cases.bodies import (
    EYES,
    SPOT,
    flip_faces,
    half_sphere,
    join_meshes,
    sheet,
    three_walls,
    with_ground_pebble,
    without_triangles,
)
from tests.params import mark_long_except
from tests.rasters import ENGINEERING
from tests.render import block_at
from tests.shadows.boxes import View, box, build_mesh_scene

EQUIVALENT_SETTINGS: list[dict[str, str]] = [{"counting": "z_fail"}, {"stencil": "two_pass"}]
"""Settings that must not change a pixel."""

OMNI = {"kind": "omni", "position": [-6, -12, 18]}
LIGHTS: dict[str, dict[str, Any]] = {
    "sun": {}, "spot": {"lights": {"spot": SPOT}, "sun": "none"}, "omni": {"lights": {"omni": OMNI}, "sun": "none"},
}  # fmt: skip

THESIS_LEVELS = [
    f"thesis_{name}{suffix}" for name in ("boxgrid", "rocks", "street", "room", "water_tower") for suffix in ("", "_sun")
]


@dataclass(frozen=True, eq=False)
class ShadowCase:
    """The visible points of a scene, their casters, and a light."""

    scene: Scene
    buffer: GeometryBuffer
    casters: Casters
    light: str

    def volume_visibility(self, mask: str | None = None, log: PassLog | None = None, **settings: Any) -> np.ndarray:
        """Return visibility by volumes, or with ``mask`` by the hybrid. Attached shadow is dark; NaN marks no surface."""
        buffer = receivers_of(self.buffer, self.scene, self.light)
        kinds, log = tuple(kind for kind in self.scene.objects.caster_kinds if kind != "forest"), log or PassLog()
        if mask is None:
            visibility = shadow_volume.fill_visibility(
                buffer, self.scene, self.light, kinds, self.casters, VolumeSettings(**settings), log
            )
        else:
            shadow_settings = self.scene.loaded.level.shadows.model_copy(update={"mask": mask, **settings})
            hybrid_settings, _ = resolve_hybrid(SettingsRequest(describe(self.scene, buffer.view), self.light, shadow_settings))
            visibility = hybrid.fill_visibility(buffer, self.scene, self.light, kinds, self.casters, hybrid_settings, log)
        assert set(np.unique(visibility)) <= {0.0, 1.0}
        return self.with_attached_shadow(visibility)

    def with_attached_shadow(self, visibility: np.ndarray) -> np.ndarray:
        """Return a visibility (rows, cols) with attached shadow added, and NaN without a surface."""
        with_attached = np.where(attached_shadow_mask(self.buffer, self.scene, self.light), np.float32(0.0), visibility)
        return np.where(self.buffer.valid, with_attached, np.nan)

    def rays(self) -> np.ndarray:
        """Return visibility by rays from the same points, in the form of ``volume_visibility``."""
        kinds, log = self.scene.objects.caster_kinds, PassLog()
        return self.with_attached_shadow(truth_fill(self.buffer, self.scene, self.light, kinds, self.casters, TruthSettings(), log))

    def truth(self) -> Truth:
        """Return ray-traced truth of the view."""
        return trace_truth(self.buffer, self.scene, self.casters, light=self.light)


def shadow_case(scene: Scene, view: View | None = None) -> ShadowCase:
    """Return a view, by default ``eye``, with its casters and its first light."""
    buffer = geometry_buffer(scene, view or scene.view("eye"))
    return ShadowCase(scene, buffer, find_casters(scene, buffer), scene.light_names[0])


def eye_views(position: Any, target: Any, fov: float = 60.0, size: tuple[int, int] = (120, 90)) -> dict[str, Any]:
    """Return the views of a level with one eye."""
    spec = {"kind": "perspective", "eye": list(position), "target": list(target), "fov": fov, "size": list(size)}
    return {"views": {"eye": spec}}


SHADOW_SIDE_VIEWS = eye_views((12, 25, 6), (0, 3, 0.5))
"""A view of the shadows of objects at the middle: the lights are in the south."""


def top_view(scene: Scene, half_m: float = 15.0, px: int = 120) -> View:
    """Return a map of a square with sides of 2 ``half_m`` metres and ``px`` pixels."""
    return scene.view(bounds=(-half_m, -half_m, half_m, half_m), size=(px, px))


def check_volumes(case: ShadowCase, least_dark: float = 0.0, reference: Truth | None = None) -> tuple[np.ndarray, ErrorMetrics]:
    """Check volumes against truth, and that all ways of counting give the same pixels."""
    visibility, reference = case.volume_visibility(), reference or case.truth()
    errors = error_metrics(visibility, reference, 1.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior == 0.0, errors
    assert (reference.valid & ~reference.lit & ~reference.attached_shadow_mask).sum() >= least_dark * reference.valid.sum()
    for settings in EQUIVALENT_SETTINGS:
        np.testing.assert_array_equal(case.volume_visibility(**settings), visibility, err_msg=str(settings))
    return visibility, errors


# -- bodies


def hollow_room(window: bool) -> trimesh.Trimesh:
    """Return a hollow room with walls 0.3 m thick, 10 by 8 by 6 m, optionally with a window in the north."""
    parts = [
        box((10, 8, 0.3)), box((10, 8, 0.3), 5.7), box((0.3, 8, 5.4), 0.3, (-4.85, 0)), box((0.3, 8, 5.4), 0.3, (4.85, 0)),
        box((9.4, 0.3, 5.4), 0.3, (0, -3.85)),
    ]  # fmt: skip
    if not window:
        return join_meshes(*parts, box((9.4, 0.3, 5.4), 0.3, (0, 3.85)))
    sill, lintel = box((9.4, 0.3, 2), 0.3, (0, 3.85)), box((9.4, 0.3, 1.4), 4.3, (0, 3.85))
    return join_meshes(*parts, sill, lintel, box((4, 0.3, 2), 2.3, (-2.7, 3.85)), box((3, 0.3, 2), 2.3, (3.2, 3.85)))


OPEN_MESHES = {
    ("upper half of "
        "a sphere"): with_ground_pebble(half_sphere(False)), "bowl": with_ground_pebble(half_sphere(True)),
    "sheet": with_ground_pebble(sheet()),
    "three walls": three_walls(),
}  # fmt: skip

BODIES = {
    "box": box((8, 6, 5)), "without a triangle": without_triangles(box((8, 6, 5)), 3), "inside out": flip_faces(box((8, 6, 5))),
    "sharing an edge": join_meshes(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), at_m=(2, 2))),
    "sharing a corner": join_meshes(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), 4.0, (2, 2))),
    "one in another": join_meshes(box((8, 8, 6)), box((3, 3, 2), 1.0)),
    "one through another": join_meshes(box((8, 8, 3)), box((3, 3, 9), 1.0, (1, 1))),
    "the same twice": join_meshes(box((8, 6, 5)), box((8, 6, 5))),
}  # fmt: skip


# -- against truth


BUNDLED_VIEWS = [*((name, "main") for name in THESIS_LEVELS), ("thesis_street_sun", "map")]
QUICK_VIEWS = ("thesis_street_sun", "map"), ("thesis_room", "main"), ("thesis_rocks_sun", "main"), ("thesis_street_sun", "main")
"""Bundled scenes that run in every test run: both kinds of light, open and closed meshes, and a map."""


@lru_cache(maxsize=12)
def thesis_case(name: str, view: str = "main") -> tuple[ShadowCase, Truth]:
    """Return a small picture of a bundled scene, and its truth."""
    scene = build_scene(load_level(f"configs/{name}.yaml"))
    case = shadow_case(scene, scene.view(view, size=(320, 256) if view == "main" else (160, 160)))
    return case, case.truth()


@pytest.mark.parametrize(("name", "view"), mark_long_except(BUNDLED_VIEWS, *QUICK_VIEWS))
def test_volumes_match_truth_in_bundled_scenes(gl, name, view):
    """Measured: at most 0.009 % of the decidable pixels differ.

    One of 50,000 may lie in a gap between two shadows that is narrower than the rasteriser's grid.
    """
    case, reference = thesis_case(name, view)
    visibility = case.volume_visibility()
    errors = error_metrics(visibility, reference, 1.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior <= 2e-5 and errors.interior_parts == 0, errors
    assert (~reference.lit & ~reference.attached_shadow_mask & reference.valid).sum() > 0.02 * reference.valid.sum()
    for settings in EQUIVALENT_SETTINGS:
        np.testing.assert_array_equal(case.volume_visibility(**settings), visibility, err_msg=str(settings))


# tests/hard_cases has the sun and a spot, and all algorithms. An omni light stands nearer.
@pytest.mark.parametrize("name", [*OPEN_MESHES, *BODIES])
def test_volumes_of_bodies_under_an_omni_light_match_truth(gl, tmp_path, name):
    """Open meshes cast from both sides, by the multiplicity of their edges.

    Bodies that touch or contain another one cast together.
    """
    scene = build_mesh_scene(tmp_path, [(OPEN_MESHES | BODIES)[name]], 200, 35, **SHADOW_SIDE_VIEWS, **LIGHTS["omni"])
    check_volumes(shadow_case(scene), least_dark=0.01)
    check_volumes(shadow_case(scene, top_view(scene, px=60)), least_dark=0.005)


@pytest.mark.parametrize("where", EYES)
def test_volumes_for_any_eye_under_an_omni_light_match_truth(gl, tmp_path, where):
    """The eye is in a volume, in a caster, or in a cap's plane: z-pass and z-fail together, and z-fail alone."""
    check_volumes(under_an_omni_light(tmp_path, where))


def under_an_omni_light(tmp_path: Path, eye_name: str) -> ShadowCase:
    """Return the view of a house from an eye position."""
    spec = {**EYES[eye_name], "size": [120, 90]}
    return shadow_case(build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, views={"eye": spec}, **LIGHTS["omni"]))


# The eye is in the plate's shadow. The near plane, half-way to the nearest surface, is not.
@pytest.mark.parametrize("light", ["spot", "omni"])
def test_volumes_for_an_eye_in_a_small_shadow_match_truth(gl, tmp_path, light):
    body = join_meshes(box((8, 6, 5)), box((0.3, 0.3, 0.01), 6.1, (10, 20)))
    scene = build_mesh_scene(tmp_path, [body], 200, 35, **eye_views((10, 20, 6.05), (0, 2, 0)), **LIGHTS[light])
    check_volumes(shadow_case(scene), least_dark=0.01)


@pytest.mark.parametrize("light", LIGHTS)
def test_volumes_of_a_room_with_inward_faces_are_dark(gl, tmp_path, light):
    scene = build_mesh_scene(
        tmp_path, [flip_faces(box((8, 6, 5)))], 200, 35, **eye_views((0.3, 0.2, 2), (1, 5, 1), fov=100), **LIGHTS[light]
    )
    check_volumes(shadow_case(scene), least_dark=0.5)


# -- suns and lamps


@pytest.mark.parametrize("altitude", [0.5, 2.0, 60.0, 89.999, 90.0])
@pytest.mark.parametrize("azimuth", [180.0, 205.0])
def test_volumes_under_suns_of_all_altitudes_match_truth(gl, tmp_path, azimuth, altitude):
    """Low suns cast long volumes. Some suns exactly graze faces of the box, or of the plane through its roof."""
    scene = build_mesh_scene(tmp_path, [box((8, 6, 5))], azimuth, altitude, **SHADOW_SIDE_VIEWS)
    check_volumes(shadow_case(scene), least_dark=0.03 if altitude <= 2.0 else 0.0)


@pytest.mark.parametrize("distance_m", [20.0, -20.0])
def test_volumes_with_the_sun_in_the_view_axis_match_truth(gl, tmp_path, distance_m):
    """The sun is exactly behind the eye, where no shadow is visible, or exactly ahead."""
    azimuth_rad, altitude_rad = np.radians([200.0, 35.0])
    to_sun = np.array(
        [np.sin(azimuth_rad) * np.cos(altitude_rad), np.cos(azimuth_rad) * np.cos(altitude_rad), np.sin(altitude_rad)]
    )
    start = np.array([0.0, 0.0, 2.0]) + distance_m * to_sun if distance_m > 0 else np.array([0.0, 6.0, 1.0])
    scene = build_mesh_scene(tmp_path, [box((8, 6, 5))], 200, 35, **eye_views(start, start - distance_m * to_sun, fov=90))
    visibility, _ = check_volumes(shadow_case(scene))
    assert (visibility[np.isfinite(visibility)] == 0.0).any() == (distance_m < 0)


@pytest.mark.parametrize("altitude", [2.0, 35.0])
def test_volumes_of_far_casters_behind_the_eye_match_truth(gl, tmp_path, altitude):
    towers = join_meshes(box((2, 2, 25), at_m=(-5, -40)), box((3, 3, 9), at_m=(-22, -90)), box((0.2, 0.2, 6), at_m=(0, 4)))
    scene = build_mesh_scene(tmp_path, [towers], 195, altitude, **eye_views((2, -10, 3), (3, 20, 0)))
    check_volumes(shadow_case(scene), least_dark=0.03)


def shell(height_m: float) -> trimesh.Trimesh:
    """Return the open lateral surface of a cylinder around (0, 0)."""
    tube = trimesh.creation.cylinder(1.5, 2.0, sections=24)
    tube.apply_translation([0.0, 0.0, height_m])
    return without_triangles(tube, np.flatnonzero(np.abs(tube.face_normals[:, 2]) > 0.5))


def thick_shell(height_m: float) -> trimesh.Trimesh:
    """Return the same surface with a thickness: a closed body."""
    tube = trimesh.creation.annulus(1.3, 1.5, 2.0, sections=24)
    tube.apply_translation([0.0, 0.0, height_m])
    return tube


OBLIQUE_VIEWS = eye_views((22, 35, 16), (0, 4, 0))
NEARBY_OBJECTS = join_meshes(box((0.3, 0.3, 8), at_m=(5, 5)), box((3, 2, 2), at_m=(-4, 3)))
ROOF_ON_POSTS = join_meshes(box((8, 8, 0.3), 8.0), *(box((0.4, 0.4, 8.5), at_m=(x, y)) for x in (-3.5, 3.5) for y in (-3.5, 3.5)))
LAMPS: dict[str, tuple[trimesh.Trimesh, tuple[float, float, float], dict[str, Any]]] = {
    "in a closed room, from outside": (hollow_room(False), (1, 0.5, 3), OBLIQUE_VIEWS),
    "in a closed room, from inside": (hollow_room(False), (1, 0.5, 3), eye_views((-4, -3, 1), (2, 2, 3), fov=90)),
    "in a room with a window, from outside": (hollow_room(True), (1, 0.5, 3), eye_views((22, 35, 16), (0, 8, 0))),
    "in a room with a window, from inside": (hollow_room(True), (1, 0.5, 3), eye_views((-4, -3, 1), (2, 2, 3), fov=90)),
    "in a solid box": (join_meshes(box((8, 6, 5)), NEARBY_OBJECTS), (1, 0.5, 3), OBLIQUE_VIEWS),
    "in a shade": (join_meshes(shell(9.0), NEARBY_OBJECTS), (0.1, 0.05, 9), OBLIQUE_VIEWS),
    "in a shade that is a body": (join_meshes(thick_shell(9.0), NEARBY_OBJECTS), (0.1, 0.05, 9), OBLIQUE_VIEWS),
    "under a roof": (ROOF_ON_POSTS, (0.3, 0.2, 4), SHADOW_SIDE_VIEWS),
    "lower than what casts": (box((8, 6, 5)), (-8, -9, 2), SHADOW_SIDE_VIEWS),
}


@pytest.mark.parametrize("where", LAMPS)
@pytest.mark.parametrize("kind", ["omni", "spot"])
def test_volumes_for_any_lamp_position_match_truth(gl, tmp_path, where, kind):
    body, position, view = LAMPS[where]
    lamp = {"kind": kind, "position": position} | ({"target": [0, 9, 0], "cutoff": 80} if kind == "spot" else {})
    scene = build_mesh_scene(tmp_path, [body], 0, 0, **view, sun="none", lights={"lamp": lamp})
    check_volumes(shadow_case(scene))


@pytest.mark.parametrize("where", ["under a roof", "lower than what casts", "in a closed room, from outside", "in a shade"])
def test_volumes_of_casters_above_the_lamp_in_a_map(gl, tmp_path, where):
    body, position, _ = LAMPS[where]
    scene = build_mesh_scene(tmp_path, [body], 0, 0, sun="none", lights={"lamp": {"kind": "omni", "position": position}})
    check_volumes(shadow_case(scene, top_view(scene, 20.0, 60)), least_dark=0.1)


# Rays end in the wall itself, so truth cannot decide the points before it.
def test_volumes_of_a_lamp_on_a_wall(gl, tmp_path):
    """The lamp lies in the wall's plane, and points behind the wall are dark."""
    wall = box((8, 0.5, 5), at_m=(0, 3.25))  # the southern side is y = 3
    scene = build_mesh_scene(
        tmp_path, [wall], 0, 0, **SHADOW_SIDE_VIEWS, sun="none", lights={"lamp": {"kind": "omni", "position": [0.4, 3.0, 4.0]}}
    )
    case = shadow_case(scene)
    y = case.buffer.position_frame_m[..., 1]
    ground = case.buffer.valid & (case.buffer.surface_kind == RELIEF)
    visibility = case.volume_visibility()
    assert (ground & (y > 3.6)).mean() > 0.2 and (ground & (y < 2.9)).any()
    assert (visibility[ground & (y > 3.6)] == 0.0).all() and (visibility[ground & (y < 2.9)] == 1.0).all()


# -- many layers


def test_volumes_of_a_stack_are_counted_by_either_way(gl, tmp_path):
    """Each plate has a thickness and is a separate body, so z-pass counts some and z-fail others."""
    body = join_meshes(*(box((6, 6, 0.02), 1.0 + 0.05 * n) for n in range(150)))
    scene = build_mesh_scene(tmp_path, [body], 180, 75, **eye_views((4, 6, 1.2), (0, 0, 0.2)))
    case = shadow_case(scene)
    visibility = case.volume_visibility()
    assert error_metrics(visibility, case.truth(), 1.0).interior == 0.0
    np.testing.assert_array_equal(case.volume_visibility(counting="z_fail"), visibility)


# -- heightfields


RIDGES = {"generate": {"kind": "ridges", "size": [1400, 1400], "cell": 20, "relief": 350, "seed": 3}}


def by_sweep(case: ShadowCase) -> np.ndarray:
    """Return the sun's visibility (rows, cols) by the sweep."""
    return case.with_attached_shadow(
        sweep.fill_visibility(
            receivers_of(case.buffer, case.scene, "sun"), case.scene, "sun", ("relief",), case.casters, SweepSettings(), PassLog()
        )
    )


def check_ground(case: ShadowCase) -> None:
    """Check volumes against truth and against the sweep."""
    visibility, reference = case.volume_visibility(), case.truth()
    errors = error_metrics(visibility, reference, 20.0)
    assert errors.wrong <= 5e-4 and errors.wrong_cast <= 3e-3 and errors.interior == 0.0, errors
    assert ((visibility < 0.5) != (by_sweep(case) < 0.5))[reference.decidable].mean() <= 3e-3


@pytest.mark.parametrize("altitude", [30.0, 10.0, 3.0])
def test_volumes_of_ridges_match_truth_and_sweep(gl, tmp_path, altitude):
    """The views are a perspective view and a map of a flat world. Measured: the same in every decidable pixel."""
    path = tmp_path / "ridges.yaml"
    keys = {"version": 1, "terrain": RIDGES, "sun": {"azimuth": 113, "altitude": altitude}}
    path.write_text(json.dumps(keys | eye_views((-600, -650, 150), (0, 0, 50))), encoding="utf-8")
    scene = build_scene(load_level(path))
    for case in (shadow_case(scene), shadow_case(scene, top_view(scene, 350.0, 50))):
        check_ground(case)
        visibility = case.volume_visibility()
        assert 0.05 < (visibility[case.buffer.valid] == 0.0).mean() < 0.99
        np.testing.assert_array_equal(case.volume_visibility(counting="z_fail"), visibility)


@pytest.mark.parametrize("altitude", [30.0, 10.0, 3.0])
def test_volumes_of_a_curved_earth_match_truth_and_sweep(gl, altitude):
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=67, altitude=altitude))
    check_ground(shadow_case(scene, block_at(-84.25, 36.2933, 12).part(273, 300, 80, 80)))


def test_volumes_see_lifted_points_alike_in_two_tiles(gl):
    """A tile's affine camera is off by up to 0.05 pixels. A point above the ground has to be as far above the ground as drawn.

    With their own heights 13 of 317 such points, on steep ground, differed between tiles that overlap by half.
    """
    scene = build_scene(load_level("configs/jacksboro.yaml")).with_sun(SunSpec(azimuth=237, altitude=20.0))
    tile = block_at(-84.27, 36.2933, 12).part(313, 200, 320, 320)
    west, east = (shadow_case(scene, view) for view in (tile, tile.part(0, 160, 320, 320)))
    is_lifted = receivers_of(west.buffer, scene, "sun").is_lifted
    assert is_lifted is not None
    differs = west.volume_visibility()[:, 160:] != east.volume_visibility()[:, :160]
    assert is_lifted[:, 160:].sum() > 300 and (differs & is_lifted[:, 160:]).sum() <= 2


def ground_with_gap(write_raster, make_scene, azimuth: float, rows: slice) -> Scene:
    """Return waves without data in some rows of a strip through the middle."""
    row, col = np.mgrid[:60, :60]
    heights = (60.0 * np.sin(row / 7.0) * np.cos(col / 6.0) + 60.0).astype(np.float32)
    heights[rows, 26:32] = -9999.0
    raster = write_raster(heights, ENGINEERING, -300.0, 300.0, 10.0, nodata=-9999.0)
    return make_scene(raster, azimuth, 12.0, **eye_views((-260, -280, 120), (0, -100, 30)))


INNER_GAP, RIM_GAP = slice(24, 34), slice(0, 34)


@pytest.mark.parametrize("azimuth", [100.0, 280.0])
@pytest.mark.parametrize("gap", [INNER_GAP, RIM_GAP], ids=["inner", "to the rim"])
def test_volumes_of_ground_with_a_gap_in_a_map(gl, write_raster, make_scene, azimuth, gap):
    """A hole is neither a wall nor a pit. In a map, the casting ground continues below it."""
    scene = ground_with_gap(write_raster, make_scene, azimuth, gap)
    case = shadow_case(scene, top_view(scene, 200.0, 50))
    check_volumes(case, least_dark=0.05)
    assert not case.buffer.valid.all()


@pytest.mark.parametrize("gap", [INNER_GAP, RIM_GAP], ids=["inner", "to the rim"])
def test_volumes_of_ground_with_a_gap_in_perspective(gl, write_raster, make_scene, gap):
    """Through a bay of the rim the underside of the ground is visible. It is inside the volume, and dark; rays start above it."""
    case = shadow_case(ground_with_gap(write_raster, make_scene, 280.0, gap))
    shows_back_face, reference = from_below(case.buffer), case.truth()
    visibility, _ = check_volumes(
        case, least_dark=0.05, reference=replace(reference, decidable=reference.decidable & ~shows_back_face)
    )
    assert shows_back_face.any() == (gap == RIM_GAP) and not visibility[shows_back_face].any()


def from_below(buffer: GeometryBuffer) -> np.ndarray:
    """Return where a camera sees back faces of triangles that are counter-clockwise from above, bool (rows, cols).

    Nearly edge-on triangles are excluded: along a ridge's outline the rasteriser's rounding sometimes shows one of the far side.
    """
    assert isinstance(buffer.view, PerspectiveView) and buffer.corners_frame_m is not None
    a, b, c = np.moveaxis(buffer.corners_frame_m.reshape(*buffer.valid.shape, 3, 3), 2, 0)
    view_rays = buffer.position_frame_m - buffer.view.in_frame(buffer.frame)[0]
    normal = np.cross(b - a, c - a)
    sine = (normal * view_rays).sum(axis=-1) / (np.linalg.norm(normal, axis=-1) * np.linalg.norm(view_rays, axis=-1))
    return buffer.valid & (sine > 0.1)


# -- cache


def cached_and_edge_counts(case: ShadowCase, mask: str | None = None) -> tuple[int, int]:
    """Return the number of cached volumes of a frame, and the number of edges of all its silhouettes."""
    log = PassLog()
    case.volume_visibility(mask, log)
    record = next(record for name, record in log.records.items() if name.endswith("silhouettes"))
    return record.kept, record.edges


@pytest.mark.parametrize("mask", [None, "conservative"])
def test_volumes_are_cached_while_sun_and_casters_rest(gl, tmp_path, mask):
    """Moving the eye keeps them. They are built again if the sun or a caster moves, for another frame, and with empty caches."""
    views = {
        name: eye_views((x, 25, 6), (x - 12, 3, 0.5), size=(60, 40))["views"]["eye"]
        for name, x in (("eye", 12), ("near", 14), ("far", 90_000))
    }
    path = tmp_path / "level.yaml"
    meshes = [{"generate": "tetrahedra", "at": [0, 0], "motion": {"spin": 30}}]
    keys = {"version": 1, "terrain": {"flat": {"size": [2e5, 2e5], "cells": [20, 20]}}, "meshes": meshes, "views": views}
    path.write_text(json.dumps(keys | {"sun": {"azimuth": 200, "altitude": 35}}), encoding="utf-8")
    scene = build_scene(load_level(path))
    clear_caches("light")
    cached_count, edges = cached_and_edge_counts(shadow_case(scene), mask)
    assert cached_count == 0 and edges > 0
    assert cached_and_edge_counts(shadow_case(scene), mask)[0] > 0
    assert cached_and_edge_counts(shadow_case(scene, scene.view("near")), mask)[0] > 0
    near_case, far_case = shadow_case(scene), shadow_case(scene, scene.view("far"))
    assert (near_case.buffer.frame.origin_earth_m != far_case.buffer.frame.origin_earth_m).any()
    assert cached_and_edge_counts(far_case, mask)[0] == 0
    assert cached_and_edge_counts(shadow_case(scene.with_sun(SunSpec(azimuth=200.01, altitude=35))), mask)[0] == 0
    moved_case = shadow_case(scene.at_second(1.0))
    assert cached_and_edge_counts(moved_case, mask)[0] == 0 and cached_and_edge_counts(shadow_case(scene), mask)[0] > 0
    moved_visibility = moved_case.volume_visibility(mask)
    clear_caches("light")
    assert cached_and_edge_counts(shadow_case(scene), mask)[0] == 0
    np.testing.assert_array_equal(moved_case.volume_visibility(mask), moved_visibility)
    assert (moved_visibility != shadow_case(scene).volume_visibility(mask))[moved_case.buffer.valid].any()


# -- samples


@pytest.mark.parametrize("mask", [None, "conservative", "original"])
@pytest.mark.parametrize("light", LIGHTS)
def test_volumes_at_samples_match_rays_from_their_points(gl, tmp_path, light, mask):
    """The rows of samples lie below the picture's own rows."""
    posts = join_meshes(*(box((2, 2, 5), at_m=(x, y)) for x in (-9, -3, 3, 9) for y in (-6, 0, 6)))
    scene = build_mesh_scene(tmp_path, [posts], 200, 35, **SHADOW_SIDE_VIEWS, **LIGHTS[light])
    buffer = multisampled(scene, scene.view("eye")).buffer
    picture_rows = scene.view("eye").rows
    assert len(buffer.valid) > picture_rows
    case = ShadowCase(scene, buffer, NO_CASTERS, scene.light_names[0])
    visibility, reference = case.volume_visibility(mask), case.rays()
    samples = buffer.valid & ~attached_shadow_mask(buffer, scene, case.light)
    samples[:picture_rows] = False
    dark_count = (reference[samples] < 0.5).sum()
    assert dark_count > 200 and dark_count < 0.95 * samples.sum()
    # rays and rasteriser differ by 1/256 pixel, and all samples lie at edges
    assert (visibility != reference)[samples].sum() <= 0.01 * dark_count
