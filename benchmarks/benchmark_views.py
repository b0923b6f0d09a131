"""Views of bundled levels whose shadows are drawn in turns by several plans, with the times and masks of the shadows."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from skugga.api.catalogue import find_level
from skugga.selector.measure.compare import picture_blocks
from skugga.selector.planner.planner import make_plan
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.visibility import fill_steps
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.antialias import MultisampledBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene

IN_SHADOW_VIEW, IN_SHADOW_OFFSET_M = "in shadow", 23.0
"""Name of a view, and its distance ahead of the box grids' main view along the view axis, metres. Its eye is in the shadow of both
the spot and the sun."""


@dataclass(frozen=True, eq=False)
class BenchmarkView:
    """A view with its visible sample points and its shadow casters, split into horizontal bands of the picture from the top."""

    scene: Scene
    view: PerspectiveView
    name: str
    bands: list[tuple[MultisampledBuffer, Casters]]

    def visibility(self, plan: Plan, log: PassLog) -> list[np.ndarray]:
        """Return the visibility of the scene's only light by the plan's algorithms, an array for each band.

        An array (rows, cols) has the pixels of the band, and below them the further sample points of pixels with edges, in [0, 1].
        """
        return [self._band_visibility(picture, casters, plan, log) for picture, casters in self.bands]

    def shadow_mask(self, visibility: list[np.ndarray]) -> np.ndarray:
        """Return the mask of pixels in cast or attached shadow, bool (rows, cols). Pixels without a surface are False.

        ``visibility`` holds an array for each band.
        """
        rows = [
            picture.pixel_buffer.valid
            & (
                (band_visibility[: picture.picture_rows] < 0.5)
                | attached_shadow_mask(picture.pixel_buffer, self.scene, *self.scene.light_names)
            )
            for band_visibility, (picture, _) in zip(visibility, self.bands, strict=True)
        ]
        return np.concatenate(rows)

    @property
    def valid(self) -> np.ndarray:
        """The mask of pixels with a surface (rows, cols)."""
        return np.concatenate([picture.pixel_buffer.valid for picture, _ in self.bands])

    def _band_visibility(self, picture: MultisampledBuffer, casters: Casters, plan: Plan, log: PassLog) -> np.ndarray:
        """Return the visibility of the scene's only light in one band. The passes are added to ``log``."""
        (light,) = self.scene.light_names
        return fill_steps(plan.steps_of_light(light), picture.buffer, self.scene, casters, plan.effect_names, log)


def benchmark_view(level: str, name: str, size: tuple[int, int]) -> BenchmarkView:
    """Return a perspective view of a bundled level that has a single light."""
    scene = build_scene(load_level(find_level(level)))
    view = scene.view("main" if name == IN_SHADOW_VIEW else name, size=size)
    assert isinstance(view, PerspectiveView)
    if name == IN_SHADOW_VIEW:
        view = replace(view, eye_earth_m=view.eye_earth_m + IN_SHADOW_OFFSET_M * view.earth_from_camera[:, 2])
    return BenchmarkView(scene, view, name, picture_blocks(scene, view))


@dataclass(frozen=True, eq=False)
class InterleavedTimes:
    """Times of interleaved runs (views with plans) in two modes.

    In the mode ``redrawn`` no cache holds data of the light. In the mode ``kept`` the same frame is drawn again with caches.

    Attributes
    ----------
    times_ms
        Milliseconds of each repeat, by run and mode.
    passes_ms
        Milliseconds of each pass in each repeat, by run and mode.
    logs
        Passes of the last repeat in the mode ``redrawn``, by run.
    shadow_masks
        Shadow masks of the last repeat in the mode ``redrawn``, by run.
    """

    times_ms: dict[tuple[str, str], list[float]]
    passes_ms: dict[tuple[str, str], list[dict[str, float]]]
    logs: dict[str, PassLog]
    shadow_masks: dict[str, np.ndarray]


def run_interleaved(
    runs: dict[str, tuple[BenchmarkView, Plan]], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> InterleavedTimes:
    """Draw views with plans in turns, in alternating order, and return their times. The first two turns are not timed."""
    result = InterleavedTimes({}, {}, {}, {})
    for number in range(repeats + 2):
        for key in [*runs][:: 1 if number % 2 else -1]:
            view_shot, plan = runs[key]
            clear_caches("light")
            for mode in ("redrawn", "kept"):
                log, start = PassLog(), clock()
                visibility = view_shot.visibility(plan, log)
                if number >= 2:  # the first turns compile and allocate
                    result.times_ms.setdefault((key, mode), []).append(1000.0 * (clock() - start))
                    passes_ms = {record.name.split(": ")[1]: record.ms for record in log.records.values()}
                    result.passes_ms.setdefault((key, mode), []).append(passes_ms)
                if mode == "redrawn":
                    result.logs[key], result.shadow_masks[key] = log, view_shot.shadow_mask(visibility)
    return result


def make_plans(view: BenchmarkView, overrides_by_name: dict[str, dict[str, Any]]) -> dict[str, Plan]:
    """Return plans by name for a view; ``overrides_by_name`` holds the names and the overrides of the level's ``shadows``."""
    descriptor = describe(view.scene, view.view, "main")
    return {key: make_plan(descriptor, view.scene.loaded.level, overrides) for key, overrides in overrides_by_name.items()}
