"""The bias ``slope_clamped``: move points towards the light by ``b tan(theta)``, with theta between their normal and the light.

It is the bias of many textbooks' shaders, a share of the map's depth that is clamped. It knows neither texels nor taps. It is here
to be compared with, so it moves the points before the look-up, and the loops and shaders stay as they are.
"""

from __future__ import annotations

import numpy as np

from skugga.shadows.maps.settings import SLOPE_BIAS, SLOPE_BIAS_LIMIT
from skugga.shadows.maps.windows import DepthMap
from skugga.terrain.lights import LightPosition

MIN_COSINE = 1e-6
"""Lower bound of the cosine between normal and light, whose tangent is clamped anyway."""


def move_by_slope_bias(
    depth_map: DepthMap, position: np.ndarray, normal: np.ndarray, light_in_frame: LightPosition, bias_scale: float
) -> np.ndarray:
    """Return points (..., 3), metres, moved towards a light by the bias, in their own type.

    Parameters
    ----------
    depth_map
        The map in which they are looked up.
    position, normal
        (..., 3): the points and their unit normals in the frame.
    light_in_frame
        The map's light.
    bias_scale
        Factor of the clamped bias.
    """
    light = np.array(light_in_frame)
    to_light = light[:3] - light[3] * position.astype(np.float64)
    distance = np.linalg.norm(to_light, axis=-1, keepdims=True)
    cosine = np.abs((normal * to_light).sum(axis=-1, keepdims=True)) / distance
    tangent = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / np.maximum(cosine, MIN_COSINE)
    bias = bias_scale * np.minimum(SLOPE_BIAS * tangent, SLOPE_BIAS_LIMIT)
    uniforms = depth_map.uniforms
    if not uniforms["lamp"]:
        return (position + bias * uniforms["window_m"][2] * to_light / distance).astype(position.dtype)
    near, far = uniforms["near_far_m"]
    lamp_from_frame = np.array(uniforms["light_from_frame"]).reshape(3, 3).T
    axes = np.stack([face[2] @ lamp_from_frame for face in depth_map.face_rotations])
    along_m = (-to_light @ axes.T).max(axis=-1, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        clip_depth = ((far + near) - 2.0 * far * near / along_m) / (far - near) - 2.0 * bias
        moved_m = 2.0 * far * near / ((far + near) - clip_depth * (far - near))
        moved = light[:3] - to_light * moved_m / along_m
    return np.where(along_m > 0.0, moved, position).astype(position.dtype)
