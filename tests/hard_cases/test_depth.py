"""Depth maps store depths to within a step, over any range, in any number of bits; and cascades meet at their split distance."""

from __future__ import annotations

import numpy as np
import trimesh

from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.maps.drawing import draw_map
from skugga.shadows.maps.resolve import MAX_DEPTH_SHIFT_PX
from skugga.shadows.maps.settings import ShadowMapSettings
from skugga.shadows.maps.windows import DepthMap, depth_step_count, eye_distances, sun_maps
from skugga.shadows.passes import PassRecord
from skugga.shadows.truth.metrics import MAX_INTERIOR_SHARE
from skugga.terrain.describe import describe
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import MAP_ALGORITHMS, RenderedView, Trial, hard_case
from tests.hard_cases.landscapes import SettingsChange, views_of, with_changed_settings
from tests.hard_cases.reach_of_error import unexplained_coverage, unexplained_errors
from tests.rasters import ENGINEERING
from tests.shadows.boxes import box

AZIMUTH = 77.0
"""Azimuth of the sun, degrees; the cliff faces it."""

CLIFF_EAST_M = -5.0, 5.0
"""East coordinates of the cliff's two edges, metres: one cell apart."""


def cliff(trial: Trial, height_m: float, altitude: float, meshes: list[trimesh.Trimesh] | None = None) -> Scene:
    """Return a plateau in the west and a plain of height 0 in the east, 640 m of both."""
    heights = np.zeros((64, 64), np.float32)
    heights[:, :32] = height_m
    name = f"cliff_{height_m:.0f}_{altitude:.0f}"
    raster = trial.raster(heights, ENGINEERING, -320, 320, 10.0, name=name)
    return trial.scene(raster, (AZIMUTH, altitude), meshes, name=name)


def shadow_map_settings(rendered: RenderedView) -> ShadowMapSettings:
    """Return the settings of the only step of a rendered view."""
    (step,) = rendered.plan.steps
    assert isinstance(step.settings, ShadowMapSettings)
    return step.settings


def depth_error_m(rendered: RenderedView, depth_map: DepthMap, height_m: float) -> float:
    """Return the largest difference between a map's depths and the true depth of plain and plateau at the texels' centres, metres.

    With r, u, a the heights of light space's axes, the ray through its (x, y) meets a plane of height h at z = (h - x r - y u) / a.
    """
    gl, (step,) = device(), rendered.plan.steps
    target = draw_map(gl, depth_map, rendered.buffer, rendered.scene, step.kinds, rendered.casters, step.settings, PassRecord(""))
    depth = gl.read(target, -1, size=depth_map.texture_size)
    offset_m, window_m = np.array(depth_map.uniforms["light_offset_m"]), np.array(depth_map.uniforms["window_m"])
    rotation = np.array(depth_map.uniforms["light_from_frame"]).reshape(3, 3).T
    cols, rows = np.meshgrid(np.arange(depth_map.face_size[0]) + 0.5, np.arange(depth_map.face_size[1]) + 0.5)
    x, y = cols * depth_map.uniforms["texel_m"][0] - offset_m[0], rows * depth_map.uniforms["texel_m"][1] - offset_m[1]
    worst = []
    for height, side in ((0.0, 1.0), (height_m, -1.0)):
        z = (height - x * rotation[0, 2] - y * rotation[1, 2]) / rotation[2, 2]
        point = np.stack([x, y, z], axis=-1) @ rotation
        on_plane = (np.abs(point[..., :2]) < 290.0).all(axis=-1) & (side * point[..., 0] > 20.0)
        assert on_plane.any(), "plain and plateau are in the map"
        worst.append(np.abs(depth * window_m[2] - (z + offset_m[2]))[on_plane].max())
    return float(max(worst))


@hard_case(
    "H22",
    "A map's depths are right to within a step",
    "plain and plateau 1, 10, 50 and 100 km apart in depth; 16, 24 and 32 bits",
    {"error_steps": 1.0, "false_shadow": 0.0},
    ("shadow_map",),
)
def test_depths_are_right_to_within_a_step(trial: Trial) -> dict[str, float]:
    """The bounds are one step of the depth range, as in the table (1.53 m for 100 km in 16 bits), and that of float32 positions.

    ``false_shadow`` is that of plain and plateau beyond a texel's reach from the cliff: a texel on both contains the cliff.
    """
    error, false = 0.0, 0.0
    for altitude in (90.0, 60.0, 30.0) if trial.thorough else (60.0,):
        for range_m in (1e3, 1e4, 5e4, 1e5):
            height_m = range_m / np.sin(np.radians(altitude))
            scene = cliff(trial, height_m, altitude)
            view = scene.view(bounds=(-300, -300, 300, 300), size=(256, 256) if trial.thorough else (64, 64))
            for bits in (16, 24, 32):
                rendered = trial.render_view(scene, view, depth_bits=bits, map_size=2048 if trial.thorough else 512, filter=1)
                (depth_map,) = sun_maps(rendered.buffer, scene, shadow_map_settings(rendered), None)
                allowed_m = range_m / depth_step_count(bits) + depth_map.uniforms["error_m"]
                error = max(error, depth_error_m(rendered, depth_map, height_m) / allowed_m)
                reach_m = depth_map.uniforms["texel_m"][1] / np.sin(np.radians(altitude)) + depth_map.uniforms["texel_m"][0]
                east = rendered.buffer.position_frame_m[..., 0]
                level = (east < CLIFF_EAST_M[0] - reach_m) | (east > CLIFF_EAST_M[1] + reach_m)
                assert level.any(), "there is level ground beside the cliff"
                false = max(false, float((rendered.visibility[level] < 1.0).mean()))
    return {"error_steps": error, "false_shadow": false}


@hard_case(
    "D1",
    "Sixteen bits are enough for mountains under a low sun",
    "ridges of 2000 m, 50 km wide, sun at 1 degree: 16 bits against 32 and against truth",
    {"acne": 0.0, "shift_px": MAX_DEPTH_SHIFT_PX, "interior": MAX_INTERIOR_SHARE},
    MAP_ALGORITHMS,
)
def test_sixteen_bits_are_enough_for_mountains(trial: Trial) -> dict[str, float]:
    """Half a step of bias lights the surface, and rounding takes half a step from it: 16 bits never shade more than 32 bits do.

    They shade less only within a step behind a caster: a strip of at most ``MAX_DEPTH_SHIFT_PX`` along every edge, by the plan's
    choice of bits.
    """
    size, map_size = (384, 2048) if trial.thorough else (128, 1024)
    eye = {"kind": "perspective", "eye": [-20_000, -20_000, 1500], "target": [0, 0, 0], "fov": 60}
    ground = {"generate": {"kind": "ridges", "size": [50_000, 50_000], "cell": 100, "relief": 2000, "seed": 3}}
    scene = trial.scene(ground, (243, 1), views={"eye": eye})
    worst = {"acne": 0.0, "shift_px": 0.0, "interior": 0.0}
    for view in views_of(trial, scene, size):
        few, many = (trial.render_view(scene, view, depth_bits=bits, filter=1, map_size=map_size) for bits in (16, 32))
        assert 0.1 < many.dark.mean() < 0.9, "light and shadow"
        edges = np.count_nonzero(np.diff(many.dark, axis=0)) + np.count_nonzero(np.diff(many.dark, axis=1))
        worst["acne"] = max(worst["acne"], float((few.dark & ~many.dark).mean()))
        worst["shift_px"] = max(worst["shift_px"], np.count_nonzero(many.dark & ~few.dark) / edges)
        worst["interior"] = max(worst["interior"], few.errors.interior)
        trial.record_coverage("interior", few.interior_coverage)
    return worst


@hard_case(
    "D2",
    "More bits are taken where a step of sixteen would shift shadows, and the plan says so",
    "a tower below cliffs of 0.3 to 20 km, pixels of 0.25 m, automatic bits against 32",
    {"shift_px": MAX_DEPTH_SHIFT_PX, "plans that do not say why": 0.0},
    ("shadow_map",),
)
def test_more_bits_are_taken_where_they_are_needed(trial: Trial) -> dict[str, float]:
    """A depth step s loses s cos(a) of a shadow on level ground.

    Maps with fewer depth steps have larger texels in proportion. The loss of 16 bits is therefore smaller than a texel unless light
    space is 30 times as deep as it is wide. So the cliffs are higher than any real cliff.
    """
    altitude, worst, unexplained_count, chosen = 75.0, 0.0, 0, set()
    box((3.0, 6.0, 30.0)).export(trial.folder / "tower.ply")
    for height_m in np.geomspace(300.0, 20_000.0, 9 if trial.thorough else 3):
        scene = cliff(trial, float(height_m), altitude, [{"source": "tower.ply", "at": [40, 0]}])
        view = scene.view(bounds=(20, -15, 50, 15), size=(120, 120))
        rendered, reference = (trial.render_view(scene, view, map_size=1024, filter=1, depth_bits=bits) for bits in ("auto", 32))
        edges = np.count_nonzero(np.diff(reference.dark, axis=0)) + np.count_nonzero(np.diff(reference.dark, axis=1))
        assert edges, "there is a shadow"
        worst = max(worst, np.count_nonzero(reference.dark != rendered.dark) / edges)
        facts, bits = describe(scene, view), shadow_map_settings(rendered).depth_bits
        assert facts.receivers_light_m is not None
        least_px = facts.receivers_light_m[2] / depth_step_count(16) * np.cos(np.radians(altitude)) / facts.pixel_m
        reason = next((item.reason for item in rendered.plan.reasons if item.name == f"depth_bits {bits}"), "")
        is_explained = "a 16-bit step" in reason and ("within the" if bits == 16 else "more than the") in reason
        unexplained_count += (
            not is_explained
            or (bits == 16 and least_px > MAX_DEPTH_SHIFT_PX)
            or (bits > 16 and 1.5 * least_px < MAX_DEPTH_SHIFT_PX)
        )
        chosen.add(bits)
    assert chosen == {16, 24}, "cliffs on both sides of the choice"
    return {"shift_px": worst, "plans that do not say why": unexplained_count}


@hard_case(
    "H28",
    "Where cascades part there is no gap and no overlap",
    "three cascades, parted at the very distance of a pixel and one float to either side",
    {"not_in_one_map": 0.0, "wrong beyond its reach": 0.0, "pixels that differ": 1.0},
    ("shadow_map",),
)
def test_cascades_part_on_a_pixel(trial: Trial) -> dict[str, float]:
    """A change of the split distance by one float moves one pixel (or those at exactly that distance) to the other map.

    At full size a dozen pixels lie farther from truth's edge than two pixels and two texels, at any split distance, though truth
    has the other answer within the texels that the map samples for them. So errors are compared with that reach, pixel by pixel.
    """
    blocks = [
        box((8.0, 5.0, 7.0), at_m=(-6.0, 4.0)),
        box((4.0, 4.0, 12.0), at_m=(9.0, 14.0)),
        box((3.0, 30.0, 2.0), at_m=(20.0, 20.0)),
    ]
    eye = {"kind": "perspective", "eye": [-6, -28, 11], "target": [4, 10, 0], "fov": 55}
    scene = trial.scene({"flat": {"size": [200, 200], "cells": [20, 20]}}, (115, 30), blocks, views={"eye": eye})
    view = scene.view("eye", size=(512, 384) if trial.thorough else (128, 96))
    options = {"cascades": 3, "map_size": 1024 if trial.thorough else 512, "filter": 1}
    reference = trial.render_view(scene, view, **options)
    assert len(shadow_map_settings(reference).cascades) == 3
    receivers = reference.buffer.valid & ~reference.truth.attached_shadow_mask
    distance_m = eye_distances(reference.buffer.position_frame_m, view.in_frame(reference.buffer.frame)[0])
    worst = {"not_in_one_map": 0.0, "wrong beyond its reach": 0.0, "pixels that differ": 0.0}
    row = view.rows * 2 // 3
    for col in range(0, view.cols, view.cols // (16 if trial.thorough else 3)):
        if not receivers[row, col]:
            continue
        at_m, before, near_pixels = distance_m[row, col], None, []
        for far_m in (np.nextafter(at_m, np.float32(0)), at_m, np.nextafter(at_m, np.float32(np.inf))):
            rendered = with_changed_settings(reference, split_cascades_at(float(far_m)))
            maps = sun_maps(rendered.buffer, scene, shadow_map_settings(rendered), None)
            near_pixels.append(maps[0].point_indices)
            map_count = np.bincount(
                np.concatenate([cascade_map.point_indices for cascade_map in maps]), minlength=receivers.size
            ).reshape(receivers.shape)
            worst["not_in_one_map"] = max(worst["not_in_one_map"], float((map_count != receivers).mean()))
            worst["wrong beyond its reach"] = max(worst["wrong beyond its reach"], float(unexplained_errors(rendered).mean()))
            trial.record_coverage("wrong beyond its reach", unexplained_coverage(rendered))
            if before is not None:
                expected_count = (
                    np.count_nonzero(receivers & (distance_m == far_m)) + np.count_nonzero(receivers & (distance_m == at_m)) - 1
                )
                worst["pixels that differ"] = max(
                    worst["pixels that differ"], np.count_nonzero(before != rendered.dark) / max(expected_count, 1)
                )
            before = rendered.dark
        assert set(near_pixels[1]) - set(near_pixels[0]) and np.array_equal(near_pixels[1], near_pixels[2]), (
            "the pixel changes from one map to the other"
        )
    return worst


def split_cascades_at(far_m: float) -> SettingsChange:
    """Return a change of settings that ends the first cascade at a distance from the eye."""

    def change(settings: AlgorithmSettings) -> AlgorithmSettings:
        assert isinstance(settings, ShadowMapSettings)
        first, *later_cascades = settings.cascades
        farther_cascades = [cascade for cascade in later_cascades if cascade.far_m is None or cascade.far_m > far_m]
        return settings.model_copy(update={"cascades": (first.model_copy(update={"far_m": far_m}), *farther_cascades)})

    return change
