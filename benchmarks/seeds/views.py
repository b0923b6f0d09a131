"""Views with their ray-traced truth, for the experiments."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from skugga.api.catalogue import find_level
from skugga.selector.measure.footprint import texel_footprint_px
from skugga.selector.planner.planner import make_plan
from skugga.shadows.algorithm_settings import AlgorithmSettings
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.plan import Plan
from skugga.shadows.truth.cache import cached_truth
from skugga.shadows.truth.metrics import edge_distances, error_metrics
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, Truth, lit_mask, ray_scene
from skugga.shadows.visibility import fill_steps
from skugga.terrain.cache import clear_caches
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.describe import describe
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN, load_level
from skugga.terrain.scene import Scene, build_scene

TRUTH_SAMPLES_PER_PIXEL = 4
"""Sub-pixel samples of truth. A pixel is decidable if all its samples agree."""

ShadowOverrides = dict[str, Any]
"""Overrides of a level's ``shadows``, by key."""
LevelDocument = dict[str, Any]
"""Content of a level file."""


@dataclass(frozen=True, eq=False)
class ViewWithTruth:
    """A view of a scene with its first light: its visible points, its shadow casters, and the ray-traced truth.

    Attributes
    ----------
    scene, view
        The scene and the view.
    light
        Name of the light.
    descriptor
        Description of the view for plans.
    buffer
        The visible points, one for each pixel (rows, cols).
    casters
        Objects that can cast shadow on the visible points.
    truth
        Visibility of the light by rays, with ``TRUTH_SAMPLES_PER_PIXEL`` samples per pixel.
    """

    scene: Scene
    view: MapView | PerspectiveView
    light: str
    descriptor: Descriptor
    buffer: GeometryBuffer
    casters: Casters
    truth: Truth

    @cached_property
    def receivers(self) -> np.ndarray:
        """The mask of pixels that can have cast shadow (rows, cols): surface that faces the light and lies within its cone."""
        return self.buffer.valid & ~attached_shadow_mask(self.buffer, self.scene, self.light)

    @property
    def faces_away(self) -> np.ndarray:
        """The mask of surface that faces away from the light or lies outside its cone (rows, cols)."""
        return self.buffer.valid & ~self.receivers

    @property
    def perspective(self) -> PerspectiveView:
        """The view, which must be a perspective view."""
        assert isinstance(self.view, PerspectiveView)
        return self.view

    @property
    def view_depth_m(self) -> np.ndarray:
        """Distances of the visible points from the eye along the view axis (rows, cols), metres."""
        eye, camera_from_frame = self.perspective.in_frame(self.buffer.frame)
        return (self.buffer.position_frame_m - eye) @ camera_from_frame[2]

    def plan(self, overrides: ShadowOverrides) -> Plan:
        """Return a plan for the view. ``overrides`` are values by field of ``Shadows``."""
        return make_plan(self.descriptor, self.scene.loaded.level, dict(overrides))

    def visibility(self, plan: Plan, log: PassLog | None = None) -> np.ndarray:
        """Return the light's visibility by a plan (rows, cols), with attached shadow; NaN without a surface."""
        steps = plan.steps_of_light(self.light)
        return self.with_attached_shadow(
            fill_steps(steps, self.buffer, self.scene, self.casters, plan.effect_names, log or PassLog())
        )

    def with_attached_shadow(self, visibility: np.ndarray) -> np.ndarray:
        """Return a visibility (rows, cols) with attached shadow added, and NaN without a surface."""
        return np.where(self.buffer.valid, np.where(self.receivers, visibility, np.float32(0.0)), np.float32(np.nan))

    def texels_px(self, plan: Plan) -> np.ndarray:
        """Return the pixels per texel of a plan's shadow maps on level ground (rows, cols); 0 without maps."""
        out = np.zeros(self.buffer.valid.shape)
        for step in plan.steps_of_light(self.light):
            out = np.maximum(out, texel_footprint_px(self.scene, step, self.buffer, self.descriptor.pixel_m))
        return out

    def errors(self, visibility: np.ndarray, texels_px: float | np.ndarray = 0.0) -> dict[str, float]:
        """Return the errors of a visibility (rows, cols) by name (``skugga.shadows.truth.metrics.ErrorMetrics``).

        ``texels_px`` is the number of pixels per shadow map texel, for all pixels or for each (rows, cols).
        """
        return asdict(error_metrics(visibility, self.truth, self.descriptor.pixel_m, texels_px))


def view_with_truth(scene: Scene, name: str, size: tuple[int, int]) -> ViewWithTruth:
    """Return a scene's view by name, with its truth. ``size`` is (cols, rows) in pixels."""
    return trace_view_truth(scene, scene.view(name, size=size), name)


def trace_view_truth(scene: Scene, view: MapView | PerspectiveView, name: str) -> ViewWithTruth:
    """Trace the truth of a view. ``name`` is the level's view whose settings apply."""
    buffer, light = geometry_buffer(scene, view), scene.light_names[0]
    casters = find_casters(scene, buffer)
    truth = cached_truth(buffer, scene, casters, TRUTH_SAMPLES_PER_PIXEL, light)
    return ViewWithTruth(scene, view, light, describe(scene, view, name), buffer, casters, truth)


def bundled_scene(name: str) -> Scene:
    """Return the scene of a bundled level."""
    return build_scene(load_level(find_level(name)))


def read_bundled_level(name: str) -> LevelDocument:
    """Read the document of a bundled level."""
    return YAML(typ="safe").load(find_level(name))


def write_and_build_scene(level: LevelDocument, folder: Path) -> Scene:
    """Write a level into the folder of its files, and build its scene."""
    path = folder / "level.yaml"
    path.write_text(json.dumps(level), encoding="utf-8")
    return build_scene(load_level(path))


def single_map_overrides(size: int, **overrides: Any) -> ShadowOverrides:
    """Return overrides for one hard-edged shadow map of 24 bits and ``size`` texels a side, with further overrides."""
    return {"algorithm": "shadow_map", "map_size": size, "cascades": 1, "filter": 1, "depth_bits": 24, **overrides}


def shared_settings(truth_view: ViewWithTruth, plan: Plan) -> AlgorithmSettings:
    """Return the settings of a plan that has the same settings for all caster kinds."""
    return next(iter(plan.settings[truth_view.light].values()))


@dataclass(frozen=True)
class Variant:
    """A variant of an algorithm: overrides, and a context manager that disables a part of the algorithm (for controls)."""

    overrides: ShadowOverrides
    disable_part: Callable[[], AbstractContextManager[Any]] = nullcontext


@dataclass(frozen=True, eq=False)
class DrawnVariant:
    """An algorithm's result in a view: its shadow mask (rows, cols), figures by name, and the notes of its passes."""

    is_dark: np.ndarray
    figures: dict[str, float]
    note: str


def draw_variant(truth_view: ViewWithTruth, variant: Variant) -> DrawnVariant:
    """Draw a variant's result in a view, without cached data of the light.

    The figures are the errors, ``cast_edge_mean`` and ``marked``. ``cast_edge_mean`` is the mean displacement of the edges of cast
    shadow, pixels. ``marked`` is the share of the surface's pixels that a hybrid leaves to its volumes.
    """
    log = PassLog()
    clear_caches("light")
    with variant.disable_part():
        plan = truth_view.plan(variant.overrides)
        visibility, texels_px = truth_view.visibility(plan, log), truth_view.texels_px(plan)
    clear_caches("light")
    dark = np.nan_to_num(visibility, nan=1.0) < 0.5
    edges_px = edge_distances(dark & truth_view.receivers, ~truth_view.truth.lit & truth_view.receivers, truth_view.receivers)
    records = log.records.values()
    figures = truth_view.errors(visibility, texels_px) | {
        "cast_edge_mean": float(edges_px.mean()) if edges_px.size else 0.0,
        "marked": sum(record.marked for record in records) / max(int(truth_view.buffer.valid.sum()), 1),
    }
    return DrawnVariant(dark, figures, " ".join(record.note for record in records if record.note))


def sees_sun_when_moved(truth_view: ViewWithTruth, buffer: GeometryBuffer, depth_m: float) -> np.ndarray:
    """Return which points see the sun after a move by ``depth_m`` metres towards it, bool (rows, cols).

    These are the points less than ``depth_m`` behind the first hit of a ray from the sun.
    """
    assert truth_view.scene.sun is not None
    to_sun = truth_view.scene.sun.in_frame(buffer.frame)
    moved_buffer = replace(buffer, position_frame_m=buffer.position_frame_m + depth_m * to_sun)
    return lit_mask(
        moved_buffer, truth_view.scene, SUN, ray_scene(truth_view.buffer, truth_view.scene, truth_view.casters, ALL_CASTER_KINDS)
    )
