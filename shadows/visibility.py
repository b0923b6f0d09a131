"""Fill a light's visibility. Pictures, comparisons, measurements and benchmarks all run a plan's steps through this module."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import replace

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.block_casters import needed_steps
from skugga.shadows.passes import ATTACHED_PASS, PassLog
from skugga.shadows.plan import Plan, Step
from skugga.shadows.registry import ALGORITHMS
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.haze import shadow_hiding_distance_m
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.smooth_ground import move_to_smooth_ground
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene


def fill_steps(
    steps: Iterable[Step], buffer: GeometryBuffer, scene: Scene, casters: Casters, effects: Collection[str], log: PassLog
) -> np.ndarray:
    """Return a light's visibility (rows, cols) float32 in [0, 1] at a buffer's points: the product of its steps.

    ``steps`` belong to one light (``Plan.steps_of_light``). ``effects`` are those that run (``Plan.effect_names``). The visibility
    is 1 at hidden points (``without_hidden_points``). It has no meaning off the surface and where the surface faces away. Raises
    the errors of the algorithms.
    """
    steps = list(steps)
    visibility = np.ones(buffer.valid.shape, np.float32)
    if steps:
        light = steps[0].light
        receivers = receivers_of(without_hidden_points(buffer, scene, light, effects), scene, light)
        for step in steps:
            fill = ALGORITHMS[step.algorithm].fill_visibility
            assert fill is not None, step.algorithm
            visibility *= fill(receivers, scene, step.light, step.kinds, casters, step.settings, log)
    return visibility


def receivers_of(buffer: GeometryBuffer, scene: Scene, light: str) -> GeometryBuffer:
    """Return a buffer whose points are the receivers: the points at which algorithms fill a light's visibility.

    They lie on the smooth ground where only this, and not its triangle, faces the light (``move_to_smooth_ground``).
    """
    if light == SUN and not scene.sun_is_up:
        return buffer
    return move_to_smooth_ground(buffer, scene.light_position(light, buffer.frame))


def visibilities_at(scene: Scene, plan: Plan, buffer: GeometryBuffer, casters: Casters, log: PassLog) -> dict[str, np.ndarray]:
    """Return each light's visibility (rows, cols) float32 at a buffer's points, with attached shadow."""
    visibilities = {}
    for light in plan.lights:
        steps = needed_steps(scene, plan.steps_of_light(light), buffer, casters, log)
        visibilities[light] = fill_steps(steps, buffer, scene, casters, plan.effect_names, log)
    with log.record_pass(ATTACHED_PASS):
        for light, visibility in visibilities.items():
            visibility[attached_shadow_mask(buffer, scene, light)] = 0.0
    return visibilities


def without_hidden_points(buffer: GeometryBuffer, scene: Scene, light: str, effects: Collection[str]) -> GeometryBuffer:
    """Return a buffer without the points whose visibility cannot be seen in the picture.

    In a perspective view, haze hides at far points whether the sun shines on them. Plans of data (masks, visibilities) are without
    haze, so that they have all points.
    """
    if "haze" not in effects or light != SUN or isinstance(buffer.view, MapView):
        return buffer
    limit_m = shadow_hiding_distance_m(scene, buffer.view)
    if np.isinf(limit_m):
        return buffer
    near = np.empty(buffer.valid.shape, np.bool_)
    run_in_chunks(
        len(near), _write_nearer_mask, buffer.valid, buffer.position_frame_m, buffer.view.in_frame(buffer.frame)[0], limit_m, near
    )
    return buffer if np.array_equal(near, buffer.valid) else replace(buffer, valid=near)


@compiled
def _write_nearer_mask(first, last, valid, position, eye, limit_m, out):
    """Write to ``out`` (rows, cols) which valid points are nearer to an eye (3,) than ``limit_m`` metres.

    ``valid`` (rows, cols) and ``position`` (rows, cols, 3), metres, are those of the buffer, ``eye`` is in its frame. The rows are
    those in [``first``, ``last``).
    """
    for i in range(first, last):
        for j in range(valid.shape[1]):
            p = position[i, j]
            x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
            out[i, j] = valid[i, j] and np.sqrt(x * x + y * y + z * z) < limit_m


def with_apparent_sun(scene: Scene, effects: Collection[str]) -> Scene:
    """Return the scene with the sun at its apparent position, or, without refraction, at its true one."""
    return scene if "refraction" in effects else scene.without_refraction
