"""Scenes without casters or receivers, and with a single point of either."""

from __future__ import annotations

from typing import Any

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Step
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.scene import Scene
from tests.hard_cases.bodies import FLOOR, SPOT, eye, invalid_pixel_count, join_meshes, triangle_soup
from tests.hard_cases.cases import Trial, View, hard_case
from tests.shadows.boxes import box

VIEWS: dict[str, dict[str, Any]] = {
    "eye": eye((12, 25, 6), (0, 3, 0.5)),
    "sky": eye((0, 25, 6), (0, 26, 60)),
    "map": {"kind": "map", "bounds": [-20, -20, 20, 20]},
    "off": {"kind": "map", "bounds": [500, 500, 540, 540]},
}
"""The views ``sky`` and ``off`` the data show no surface."""

LIGHTS: dict[str, dict[str, Any]] = {"sun": {"sun": (200, 35)}, "spot": {"lights": {"spot": SPOT}}}

POINT = join_meshes(box((0.02, 0.02, 0.02), at_m=(14, 14)), triangle_soup([[[0, 0, 2], [1e-6, 0, 2], [0, 1e-6, 2]]]))
"""A triangle of a micrometre, and a pebble on the ground below it."""


FORCED_EFFECTS = {"cast_shadows": "on", "lamps": "on"}
"""Ensures that there is a step even if no surface is visible."""


def fill_visibility(trial: Trial, full: Scene, scene: Scene, view: str, size: tuple[int, int]) -> tuple[np.ndarray, bool, int]:
    """Return the visibility (n,) of points of a view of ``scene`` that face the light, with the settings for a view of ``full``.

    The other results tell whether there is any surface, and give the number of draws.
    """
    full_view: View = full.view(view if trial.serves_maps else "eye", size=size)
    step = trial.render_view(full, full_view).plan.steps[0]
    # level ground, which nothing rises above, or absent meshes
    kinds = ("relief",) if trial.algorithm == "sweep" else ("meshes",)
    buffer, log = geometry_buffer(scene, scene.view(view, size=size)), PassLog()
    forced = Step(step.light, kinds, step.algorithm, step.settings)
    visibility = fill_steps([forced], buffer, scene, find_casters(scene, buffer), (), log)
    receivers = buffer.valid & ~attached_shadow_mask(buffer, scene, step.light)
    return visibility[receivers], bool(buffer.valid.any()), sum(record.draws for record in log.records.values())


@hard_case(
    "H33",
    "Where nothing casts or nothing receives, nothing is drawn and nothing is dark; a single point makes no NaN",
    "a floor without meshes, a view of the sky, a map off the data, views of one pixel, a triangle of a micrometre; sun and spot",
    {"draws": 0, "false_shadow": 0, "pixels that are no number": 0},
    thorough=False,
)
def test_nothing_and_single_points(trial: Trial) -> dict[str, float]:
    """Plans list no step for absent casters: the test calls the algorithms as if one did."""
    draws, dark, invalid_count = 0, 0.0, 0
    views = list(VIEWS)[: None if trial.serves_maps else 2]
    for light, keys in list(LIGHTS.items())[: 1 if trial.algorithm == "sweep" else None]:
        empty = trial.scene(FLOOR, name=f"{light}_empty", views=VIEWS, **keys)
        meshes = [] if trial.algorithm == "sweep" else [box((8, 6, 5))]
        full = trial.scene(FLOOR, meshes=meshes, name=f"{light}_full", views=VIEWS, effects=FORCED_EFFECTS, **keys)
        for view in views:
            visibility, valid, count = fill_visibility(trial, full, empty, view, (96, 72))
            assert valid == (view in ("eye", "map"))
            draws, invalid_count = draws + count, invalid_count + int((~np.isfinite(visibility)).sum())
            dark = max(dark, float((visibility < 1.0).mean()) if valid else 0.0)
            if not valid:
                draws += fill_visibility(trial, full, full, view, (96, 72))[2]
        if meshes:
            point = trial.scene(FLOOR, meshes=[POINT], name=f"{light}_point", views=VIEWS, **keys)
            invalid_count += sum(invalid_pixel_count(trial.render_view(point, point.view(view, size=(96, 72)))) for view in views)
        invalid_count += sum(invalid_pixel_count(trial.render_view(full, full.view(view, size=(1, 1)))) for view in views)
    return {"draws": draws, "false_shadow": dark, "pixels that are no number": invalid_count}
