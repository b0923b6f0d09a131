"""Shadow volumes and their failures: the eye inside, a clipped near plane, an overflow of the stencil's eight bits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from skugga.shadows.truth.metrics import metric_coverage
from skugga.shadows.volumes.views import near_plane_m
from skugga.terrain.gbuffer.resolve import RELIEF
from tests.hard_cases.bodies import (
    EYES,
    FLOOR,
    SPOT,
    differing,
    errors,
    eye,
    interior_sight,
    joined,
    plates,
    size_of,
    truth_of_boxes,
    whole_sight,
)
from tests.hard_cases.cases import Trial, hard_case
from tests.shadows.boxes import box

HOUSE = box((8, 6, 5))

QUICK_EYES = 4

BEFORE_THE_EYE = {"leaf": box((0.3, 0.01, 0.3), 5.9, (9.95, 19.9)), "wire": box((0.01, 0.01, 8.0), 0.0, (9.95, 19.9)),
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
        looks = [(trial.scene(FLOOR, meshes=[HOUSE], name=light, views=EYES, **keys), eyes)]
        for name, body in list(BEFORE_THE_EYE.items())[: None if trial.thorough else 1]:
            view = {name: eye((10, 20, 6.05), (0, 2, 0))}
            looks.append((trial.scene(FLOOR, meshes=[joined(HOUSE, body)], name=f"{light}_{name}", views=view, **keys), [name]))
        for scene, names in looks:
            for name in names:
                view = scene.view(name, size=size_of(trial.thorough))
                seen = trial.see(scene, view)
                assert (seen.truth.valid & ~seen.truth.lit).any(), name
                differ += differing(seen, trial.see(scene, view, counting="z_fail"))
                interior = max(interior, errors(seen).interior)
                trial.saw("interior", interior_sight(seen))
    return {"pixels that differ": differ, "interior": interior}


STEPS = ("0", "+1 ulp", "-1 ulp", -0.3, 1e-6, -1e-6, 1e-5, -1e-5, 1e-4, -1e-4, 1e-3, -1e-3)
"""Distance of the caster's bottom above the near-clip volume, metres or float32 steps; 30 cm below, its volume cuts the near
plane.
"""


def _moved(height_m: float, step: str | float) -> float:
    """Return a height moved by a step."""
    if isinstance(step, float):
        return height_m + step
    single = np.float32(height_m)
    return float(
        {"0": single, "+1 ulp": np.nextafter(single, np.float32(np.inf)), "-1 ulp": np.nextafter(single, np.float32(0))}[step]
    )


@hard_case(
    "H14",
    "A caster that touches the near-clip volume to a step of float32 is counted as a whole, as z-fail alone would",
    "a beam whose shadow begins at the upper edge of the near plane, off by 0, 1 ulp of float32, 1 micrometre to 1 mm, and 30 cm",
    {"pixels that differ": 0, "interior": 0},
)
def test_near_plane_touches_a_caster(trial: Trial) -> dict[str, float]:
    """The eye looks level to the north, the sun stands behind it at 45 degrees.

    The near plane's upper edge lies n before and h above the eye. A beam whose southern lower edge lies at (y, z) casts its shadow
    through that edge if z - h = n - y.
    """
    view = {"eye": eye((0, -20, 4), (0, 0, 4), fov=50)}
    wall = box((30, 1, 32), at_m=(0, 30))  # extends above the picture
    size = size_of(trial.thorough)
    plain = trial.scene(FLOOR, sun=(180, 45), meshes=[wall], name="plain", views=view)
    first = trial.see(plain, plain.view("eye", size=size))
    near_m = near_plane_m(first.buffer)
    upper_m = 4.0 + near_m * np.tan(np.radians(25.0))
    touching_m = upper_m + (-20.0 + near_m) - (-34.0)
    differ, interior, darkened = 0, 0.0, 0
    for number, step in enumerate(STEPS if trial.thorough else STEPS[:4]):
        beam = box((10, 2, 1), _moved(touching_m, step), (0, -33))
        scene = trial.scene(FLOOR, sun=(180, 45), meshes=[joined(wall, beam)], name=f"beam_{number}", views=view)
        seen = trial.see(scene, scene.view("eye", size=size))
        assert near_plane_m(seen.buffer) == near_m
        differ += differing(seen, trial.see(scene, scene.view("eye", size=size), counting="z_fail"))
        interior = max(interior, errors(seen).interior)
        trial.saw("interior", interior_sight(seen))
        darkened = max(darkened, int((seen.truth.valid & ~seen.truth.lit & first.truth.lit).sum()))
    assert darkened > 100
    return {"pixels that differ": differ, "interior": interior}


@hard_case(
    "H15",
    "What reaches beyond any far plane casts to its end, and its volume stays closed",
    "a wall 80 km long and a post beside the eye, suns at 0.5, 5 and 40 degrees, against the closed form",
    {"wrong or interior": 0},
)
def test_caster_without_end(trial: Trial) -> dict[str, float]:
    """Every pixel of the floor that is decidable in closed form counts; for maps those farther than two texels from the edge.

    At half a degree a map's bias leaves a gap of metres beside the wall, which case H3 covers; maps skip that sun. Rays are no
    reference here: over 200 km of floor they start 10 cm above it, so that their shadow ends 11 cm too soon.
    """
    world = {"flat": {"size": [200_000, 200_000], "cells": [20, 20]}}
    views = {"along": eye((-6, -40_000, 3), (-3, 0, 0)), "across": eye((-60, -39_000, 25), (40, -38_900, 0))}
    boxes = [box((2, 80_000, 6)), box((1, 1, 9), at_m=(-4, -39_980))]
    worst, classes = 0.0, np.zeros(2)
    for altitude in (5.0, 40.0) if "map" in trial.algorithm else (0.5, 5.0, 40.0):
        scene = trial.scene(world, sun=(80, altitude), meshes=[joined(*boxes)], name=f"wall_{altitude:g}", views=views)
        assert scene.sun is not None
        for name in views:
            seen = trial.see(scene, scene.view(name, size=(512, 384) if trial.thorough else (240, 180)))
            truth = truth_of_boxes(seen, boxes, scene.sun.to_sun_earth)
            classes += [(truth.decidable & truth.lit).sum(), (truth.decidable & ~truth.lit).sum()]
            found = errors(seen, truth)
            worst = max(worst, found.interior if "map" in trial.algorithm else found.wrong)
            trial.saw("wrong or interior", (interior_sight if "map" in trial.algorithm else whole_sight)(seen, truth))
    assert classes.min() > 1000
    return {"wrong or interior": worst}


COUNTS = (127, 128, 129, 255, 256, 257, 512)


@hard_case(
    "H20",
    "However many volumes overlap, shadow stays shadow and light stays light",
    "127, 128, 129, 255, 256, 257 and 512 plates above one another, from beside, from among their volumes and from above",
    {"missed_shadow": 0, "false_shadow": 0},
)
def test_stacks_of_volumes(trial: Trial) -> dict[str, float]:
    """The floor's point (x, y) is in shadow where |x| < 3 and |y - z / tan(60)| < 3 for a plate's height z.

    The case tests counting: points within half a metre of the shadow's edge are excluded, which no algorithm's texels reach.
    """
    views = {
        "beside": eye((9, 9, 1.2), (0, 0, 0.2)), "below": eye((0.3, 0.2, 0.3), (2, 3, 0.2), fov=100),
        "above": {"kind": "map", "bounds": [-12, -12, 12, 12]},
    }  # fmt: skip
    missed, false = 0.0, 0.0
    for count in COUNTS if trial.thorough else (128, 256, 257):
        scene = trial.scene(FLOOR, sun=(180, 60), meshes=[plates(count)], name=f"plates_{count}", views=views)
        for name in views if trial.algorithm != "perspective_shadow_map" else list(views)[:2]:
            seen = trial.see(scene, scene.view(name, size=size_of(trial.thorough)))
            floor = (seen.buffer.kind == RELIEF) & seen.buffer.valid
            x, y, _ = np.moveaxis(seen.buffer.position_frame_m + seen.buffer.frame.origin_earth_m, -1, 0)
            first_m, last_m = np.array([1.0, 1.0 + 0.05 * (count - 1)]) / np.tan(np.radians(60.0))
            inside_m = np.minimum(3.0 - np.abs(x), np.minimum(y - first_m + 3.0, last_m + 3.0 - y))
            dark, lit = floor & (inside_m > 0.5), floor & (inside_m < -0.5)
            assert dark.sum() > 100 and lit.sum() > 100
            missed, false = max(missed, float((~seen.dark)[dark].mean())), max(false, float(seen.dark[lit].mean()))
            on_floor = replace(seen.truth, decidable=seen.truth.decidable & floor)
            trial.saw("missed_shadow", metric_coverage(seen.dark, on_floor, dark))
    return {"missed_shadow": missed, "false_shadow": false}
