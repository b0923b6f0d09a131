"""Shadow volumes and their failures: the eye inside, a clipped near plane, an overflow of the stencil's eight bits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skugga.shadows.truth.metrics import metric_coverage
from skugga.shadows.volumes.views import near_plane_distance_m
from skugga.terrain.gbuffer.resolve import RELIEF
from tests.hard_cases.bodies import (
    EYES,
    FLOOR,
    SPOT,
    decidable_coverage,
    differing_pixel_count,
    errors,
    eye,
    interior_coverage,
    join_meshes,
    picture_size,
    stacked_plates,
    truth_of_boxes,
)
from tests.hard_cases.cases import Trial, hard_case
from tests.shadows.boxes import box

HOUSE = box((8, 6, 5))

QUICK_EYES = 4

NEAR_OCCLUDERS = {"leaf": box((0.3, 0.01, 0.3), 5.9, (9.95, 19.9)), "wire": box((0.01, 0.01, 8.0), 0.0, (9.95, 19.9)),
                  "rope": box((0.02, 9.0, 0.02), 5.9, (9.95, 19.9))}  # fmt: skip

LIGHTS: dict[str, dict[str, Any]] = {"sun": {"sun": (200, 35)}, "spot": {"lights": {"spot": SPOT}}}


@hard_case(
    "H13",
    "Whatever volume the eye or the near plane is in, z-pass where it serves and z-fail alone give one picture, and the right one",
    "an eye in shadow, in a house, in a cap's plane, 5 cm behind a wall; a leaf, a wire and a rope 10 cm before it; sun and spot",
    {"pixels that differ": 0, "interior": 0},
)
def test_eye_in_a_volume(trial: Trial) -> dict[str, float]:
    """The quick way leaves out three of the eyes, and draws one eye only under the spot."""
    differ, interior = 0, 0.0
    for light, keys in LIGHTS.items():
        eyes = list(EYES)[: None if trial.thorough else QUICK_EYES if light == "sun" else 1]
        scenes_and_views = [(trial.scene(FLOOR, meshes=[HOUSE], name=light, views=EYES, **keys), eyes)]
        for name, body in list(NEAR_OCCLUDERS.items())[: None if trial.thorough else 1]:
            view = {name: eye((10, 20, 6.05), (0, 2, 0))}
            scenes_and_views.append(
                (trial.scene(FLOOR, meshes=[join_meshes(HOUSE, body)], name=f"{light}_{name}", views=view, **keys), [name])
            )
        for scene, names in scenes_and_views:
            for name in names:
                view = scene.view(name, size=picture_size(trial.thorough))
                rendered = trial.render_view(scene, view)
                assert (rendered.truth.valid & ~rendered.truth.lit).any(), name
                differ += differing_pixel_count(rendered, trial.render_view(scene, view, counting="z_fail"))
                interior = max(interior, errors(rendered).interior)
                trial.record_coverage("interior", interior_coverage(rendered))
    return {"pixels that differ": differ, "interior": interior}


HEIGHT_OFFSETS = ("0", "+1 ulp", "-1 ulp", -0.3, 1e-6, -1e-6, 1e-5, -1e-5, 1e-4, -1e-4, 1e-3, -1e-3)
"""Distance of the caster's bottom above the near-clip volume, metres or float32 steps; 30 cm below, its volume cuts the near
plane.
"""


def _offset_height(height_m: float, offset: str | float) -> float:
    """Return a height moved by a step."""
    if isinstance(offset, float):
        return height_m + offset
    single = np.float32(height_m)
    return float(
        {"0": single, "+1 ulp": np.nextafter(single, np.float32(np.inf)), "-1 ulp": np.nextafter(single, np.float32(0))}[offset]
    )


@hard_case(
    "H14",
    "A caster that touches the near-clip volume to a step of float32 is counted as a whole, as z-fail alone would",
    "a beam whose shadow begins at the upper edge of the near plane, off by 0, 1 ulp of float32, 1 micrometre to 1 mm, and 30 cm",
    {"pixels that differ": 0, "interior": 0},
)
def test_near_plane_touches_a_shadow_volume(trial: Trial) -> dict[str, float]:
    """The eye looks level to the north, the sun stands behind it at 45 degrees.

    The near plane's upper edge lies n before and h above the eye. A beam whose southern lower edge lies at (y, z) casts its shadow
    through that edge if z - h = n - y.
    """
    view = {"eye": eye((0, -20, 4), (0, 0, 4), fov=50)}
    wall = box((30, 1, 32), at_m=(0, 30))  # extends above the picture
    size = picture_size(trial.thorough)
    plain = trial.scene(FLOOR, sun=(180, 45), meshes=[wall], name="plain", views=view)
    first = trial.render_view(plain, plain.view("eye", size=size))
    near_m = near_plane_distance_m(first.buffer)
    upper_m = 4.0 + near_m * np.tan(np.radians(25.0))
    touching_m = upper_m + (-20.0 + near_m) - (-34.0)
    differ, interior, darkened = 0, 0.0, 0
    for number, step in enumerate(HEIGHT_OFFSETS if trial.thorough else HEIGHT_OFFSETS[:4]):
        beam = box((10, 2, 1), _offset_height(touching_m, step), (0, -33))
        scene = trial.scene(FLOOR, sun=(180, 45), meshes=[join_meshes(wall, beam)], name=f"beam_{number}", views=view)
        rendered = trial.render_view(scene, scene.view("eye", size=size))
        assert near_plane_distance_m(rendered.buffer) == near_m
        differ += differing_pixel_count(rendered, trial.render_view(scene, scene.view("eye", size=size), counting="z_fail"))
        interior = max(interior, errors(rendered).interior)
        trial.record_coverage("interior", interior_coverage(rendered))
        darkened = max(darkened, int((rendered.truth.valid & ~rendered.truth.lit & first.truth.lit).sum()))
    assert darkened > 100
    return {"pixels that differ": differ, "interior": interior}


@hard_case(
    "H15",
    "What reaches beyond any far plane casts to its end, and its volume stays closed",
    "a wall 80 km long and a post beside the eye, suns at 0.5, 5 and 40 degrees, against the closed form",
    {"wrong or interior": 0},
)
def test_caster_without_end(trial: Trial) -> dict[str, float]:
    """Compare the pixels of the floor that are decidable in closed form; for maps, only those over two texels from the edge.

    At half a degree a map's bias leaves a gap of metres beside the wall, which case H3 covers; maps skip that sun. Rays are no
    reference here: over 200 km of floor they start 10 cm above it, so that their shadow ends 11 cm too soon.
    """
    world = {"flat": {"size": [200_000, 200_000], "cells": [20, 20]}}
    views = {"along": eye((-6, -40_000, 3), (-3, 0, 0)), "across": eye((-60, -39_000, 25), (40, -38_900, 0))}
    boxes = [box((2, 80_000, 6)), box((1, 1, 9), at_m=(-4, -39_980))]
    worst, classes = 0.0, np.zeros(2)
    has_texels = "map" in trial.algorithm or trial.algorithm == "reconstructed_volume"
    for altitude in (5.0, 40.0) if has_texels else (0.5, 5.0, 40.0):
        scene = trial.scene(world, sun=(80, altitude), meshes=[join_meshes(*boxes)], name=f"wall_{altitude:g}", views=views)
        assert scene.sun is not None
        for name in views:
            rendered = trial.render_view(scene, scene.view(name, size=(512, 384) if trial.thorough else (240, 180)))
            truth = truth_of_boxes(rendered, boxes, scene.sun.to_sun_earth)
            classes += [(truth.decidable & truth.lit).sum(), (truth.decidable & ~truth.lit).sum()]
            metrics = errors(rendered, truth)
            worst = max(worst, metrics.interior if has_texels else metrics.wrong)
            trial.record_coverage("wrong or interior", (interior_coverage if has_texels else decidable_coverage)(rendered, truth))
    assert classes.min() > 1000
    return {"wrong or interior": worst}


PLATE_COUNTS = (127, 128, 129, 255, 256, 257, 512)


@hard_case(
    "H20",
    "However many volumes overlap, shadow stays shadow and light stays light",
    "127, 128, 129, 255, 256, 257 and 512 plates above one another, from beside, from among their volumes and from above",
    {"missed_shadow": 0, "false_shadow": 0},
)
def test_stacks_of_volumes(trial: Trial) -> dict[str, float]:
    """The floor's point (x, y) is in shadow where |x| < 3 and |y - z / tan(60)| < 3 for a plate's height z.

    The case tests the counting of layers. So points within half a metre of the shadow's edge are excluded. No texel is so large.
    """
    views = {
        "beside": eye((9, 9, 1.2), (0, 0, 0.2)), "below": eye((0.3, 0.2, 0.3), (2, 3, 0.2), fov=100),
        "above": {"kind": "map", "bounds": [-12, -12, 12, 12]},
    }  # fmt: skip
    missed, false = 0.0, 0.0
    for count in PLATE_COUNTS if trial.thorough else (128, 256, 257):
        scene = trial.scene(FLOOR, sun=(180, 60), meshes=[stacked_plates(count)], name=f"plates_{count}", views=views)
        for name in views if trial.serves_maps else list(views)[:2]:
            rendered = trial.render_view(scene, scene.view(name, size=picture_size(trial.thorough)))
            floor = (rendered.buffer.surface_kind == RELIEF) & rendered.buffer.valid
            x, y, _ = np.moveaxis(rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m, -1, 0)
            first_m, last_m = np.array([1.0, 1.0 + 0.05 * (count - 1)]) / np.tan(np.radians(60.0))
            inside_m = np.minimum(3.0 - np.abs(x), np.minimum(y - first_m + 3.0, last_m + 3.0 - y))
            dark, lit = floor & (inside_m > 0.5), floor & (inside_m < -0.5)
            assert dark.sum() > 100 and lit.sum() > 100
            missed, false = max(missed, float((~rendered.dark)[dark].mean())), max(false, float(rendered.dark[lit].mean()))
            on_floor = replace(rendered.truth, decidable=rendered.truth.decidable & floor)
            trial.record_coverage("missed_shadow", metric_coverage(rendered.dark, on_floor, dark))
    return {"missed_shadow": missed, "false_shadow": false}
