"""How far off an algorithm may look: a wrong pixel is within its error bound if truth has the other answer within that reach.

A map answers for the centres of the texels round the point, on the plane that is seen there, and holds positions in float32 and
depths in steps. A volume answers for the point itself, but for the rasteriser's grid of 1/256 pixel and float32. The line sweep
answers for lines that pass a node's width beside the point. Rays from all over that reach say what truth is there.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from shadows.attached import attached
from shadows.map_windows import POSITION_ERROR
from shadows.perspective_shadow_map import perspective_map
from shadows.plan import PerspectiveMapSettings, ShadowMapSettings, Step
from shadows.render import FILLS
from shadows.truth import ALL_KINDS, ray_scene
from terrain.camera import PerspectiveView
from terrain.casting import caster_trees
from terrain.descriptor import describe
from tests.hard_cases.cases import Seen

STENCIL_PX = 2.0 / 256.0
"""What a stencil's faces may be off by in the picture: half a step of the grid for a corner, one for what they are drawn behind,
and another half for the rounding of either.
"""

FLOAT_ULPS = 32.0 * 2.0**-24
"""What positions, their transformations and the start of truth's rays may be off by, as a share of the coordinates."""


def beyond(seen: Seen) -> np.ndarray:
    """Wrong decidable pixels (rows, cols) under the sun that nothing within the algorithm's reach explains."""
    real, buffer = seen.truth, seen.buffer
    wrong = real.decidable & (seen.dark == real.lit) & ~real.attached
    left = np.flatnonzero(wrong)
    if len(left):
        assert seen.scene.sun is not None
        towards = buffer.frame.frame_from_earth @ seen.scene.sun.to_sun_earth
        rays = ray_scene(buffer, seen.scene, seen.casters, ALL_KINDS)
        (step,) = (step for step in seen.plan.steps if step.light == seen.light and step.algorithm in FILLS)
        points, normals = (a.reshape(-1, 3).astype(np.float64) for a in (buffer.position_frame_m, buffer.normal_frame))
        for moves in _moves(seen, step, towards, points[left], normals[left], buffer.crease.ravel()[left]):
            lit = ~rays.blocked(points[left] + moves + rays.offset_m * normals[left], towards)
            wrong.ravel()[left[lit != seen.dark.ravel()[left]]] = False
    return wrong


def _moves(
    seen: Seen, step: Step, towards: np.ndarray, points: np.ndarray, normals: np.ndarray, crease: np.ndarray
) -> Iterator[np.ndarray]:
    """Moves (n, 3) in the frame, metres, within the reach of an algorithm's error."""
    extent_m = float(np.nanmax(np.abs(seen.buffer.position_frame_m)))
    float_m = np.full(len(points), FLOAT_ULPS * extent_m)
    if isinstance(step.settings, ShadowMapSettings | PerspectiveMapSettings):
        yield from _map_moves(seen, step, towards, points, normals, crease, POSITION_ERROR * extent_m)
        return
    if step.algorithm == "sweep":
        node_m = describe(seen.scene, seen.view).node_m
        for i, j in product(np.linspace(-node_m, node_m, 9), repeat=2):
            flat = np.array([i, j, 0.0])
            yield flat - (normals @ flat / normals[:, 2])[:, None] * [0.0, 0.0, 1.0]
        return
    reach_m = float_m + STENCIL_PX * _pixel_m(seen, points)
    for direction in product((-1.0, 0.0, 1.0), repeat=3):
        yield reach_m[:, None] * direction


def _pixel_m(seen: Seen, points: np.ndarray) -> np.ndarray:
    """The side of a pixel at points (n, 3), metres."""
    if isinstance(seen.view, PerspectiveView):
        eye, _ = seen.view.in_frame(seen.buffer.frame)
        return np.linalg.norm(points - eye, axis=1) * seen.view.pixel
    position = seen.buffer.position_frame_m
    steps = (np.linalg.norm(np.diff(position, axis=axis), axis=-1) for axis in (0, 1))
    return np.full(len(points), max(float(np.nanmax(step, initial=0.0)) for step in steps))


def _map_moves(
    seen: Seen, step: Step, towards: np.ndarray, points: np.ndarray, normals: np.ndarray, crease: np.ndarray, error_m: float
) -> Iterator[np.ndarray]:
    """Moves to the centres of the texels that a map looks at beside its point, on the point's plane and as far off it as the bias.

    A move of a texel right or up on the plane with normal n solves [J_x; J_y; n] d = (1, 0, 0) or (0, 1, 0), where J is the
    derivative of the map's coordinates in texels.
    """
    assert isinstance(step.settings, ShadowMapSettings | PerspectiveMapSettings)
    jacobian, depth_m = _jacobian(seen, step, points)
    system = np.concatenate([jacobian, normals[:, None, :]], axis=1)
    right, up = (np.linalg.solve(system, np.broadcast_to(np.eye(3)[k], points.shape)[..., None])[..., 0] for k in (0, 1))
    aside = np.linalg.pinv(jacobian)  # (n, 3, 2): a texel right and up, at right angles to the light
    slack = np.abs(np.einsum("nk,nkj->nj", normals, aside)).sum(axis=1)
    corner = np.maximum(*(np.linalg.norm(aside[..., 0] + sign * aside[..., 1], axis=1) for sign in (1.0, -1.0)))
    bias_m = 1.01 * (slack + crease * corner) / np.maximum(1.0 - crease**2 / 2.0, 0.25) + error_m
    taps = 2.0 if step.settings.filter == "sun" else float(step.settings.filter)
    reach = np.arange(-(taps + 2) / 2, (taps + 2) / 2 + 0.25, 0.5)
    along_m = 2.0 * depth_m + error_m
    for lift in (0.0, 1.0):
        off = lift * (bias_m[:, None] * normals + along_m[:, None] * towards)
        for i, j in product(reach, repeat=2):
            yield i * right + j * up + off


def _jacobian(seen: Seen, step: Step, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivative (n, 2, 3) of a map's coordinates in texels at points (n, 3) of the frame, and a step of depth there in metres."""
    buffer, scene, settings = seen.buffer, seen.scene, step.settings
    if isinstance(settings, ShadowMapSettings):
        assert scene.light is not None
        rotation, _ = scene.light.from_frame(buffer.frame)
        which = np.zeros(len(points), int)
        if isinstance(seen.view, PerspectiveView):
            eye, _ = seen.view.in_frame(buffer.frame)
            far = [cascade.far_m for cascade in settings.cascades[:-1]]
            which = np.searchsorted(far, np.linalg.norm(points - eye, axis=1))
        texel = np.array([cascade.texel_m for cascade in settings.cascades])[which]
        depth = np.array([cascade.depth_step_m for cascade in settings.cascades])[which]
        return rotation[None, :2] / texel[:, :, None], depth
    assert isinstance(settings, PerspectiveMapSettings)
    receivers = buffer.there & ~attached(buffer, scene, seen.light)
    drawn, _ = perspective_map(buffer, receivers, scene, seen.light, settings, caster_trees(buffer, step.kinds))
    matrix = np.reshape(drawn.uniforms["map_rows"], (4, 4))
    homogeneous = points @ matrix[:, :3].T + matrix[:, 3]
    w = homogeneous[:, 3]
    at = homogeneous[:, :3] / w[:, None]
    jacobian = (matrix[None, :3, :3] - at[:, :, None] * matrix[None, 3, None, :3]) / w[:, None, None]
    assert scene.sun is not None
    towards = buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
    return jacobian[:, :2], drawn.uniforms["depth_step"] / np.abs(jacobian[:, 2] @ towards)
