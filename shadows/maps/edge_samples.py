"""Look samples of a perspective view up in the maps that were fitted to its pixels: nothing is drawn again for them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.maps.windows import MAP_BORDER_TEXELS, DepthMap
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene


def maps_for_samples(maps: Sequence[DepthMap], samples: GeometryBuffer, scene: Scene) -> tuple[list[DepthMap], np.ndarray]:
    """Return the sun's maps of a view's pixels with the indices of the samples that each serves, and which samples none serves.

    The latter is bool (rows, cols). A map serves the samples at its distances from the eye that lie within it, and so far from its
    rim that biases and taps stay within. ``samples`` that face away from the sun need no map.
    """
    assert isinstance(samples.view, PerspectiveView)
    receivers = samples.valid & ~attached_shadow_mask(samples, scene)
    map_numbers = np.full(receivers.shape, -1, np.int8)
    eye, _ = samples.view.in_frame(samples.frame)
    for number, depth_map in enumerate(maps):
        assert depth_map.tree_bounds is not None
        rotation, translation, _, size_m = depth_map.tree_bounds
        border_m = 0.5 * MAP_BORDER_TEXELS * np.array(depth_map.uniforms["texel_m"])
        run_in_chunks(
            len(receivers), _write_map_numbers, receivers, samples.position_frame_m, eye, np.array(depth_map.eye_distances_m),
            rotation, translation, border_m, size_m[:2] - border_m, number, map_numbers,
        )  # fmt: skip
    served = [np.flatnonzero(map_numbers == number) for number in range(len(maps))]
    served_maps = [
        replace(depth_map, point_indices=indices) for depth_map, indices in zip(maps, served, strict=True) if len(indices)
    ]
    return served_maps, receivers & (map_numbers < 0)


@compiled
def _write_map_numbers(first, last, receivers, position, eye, eye_distances, rotation, translation, low, high, number, out):
    """Write ``number`` to ``out`` (rows, cols) where a map serves a receiver, for the rows [``first``, ``last``).

    ``rotation`` (3, 3) and ``translation`` (3,) transform a ``position`` to right, up and depth in the map; ``low`` and ``high``
    (2,) bound right and up, metres. ``eye`` (3,) is the view's, from which ``eye_distances`` (2,), metres, bound the distance.
    """
    for i in range(first, last):
        for j in range(receivers.shape[1]):
            if not receivers[i, j]:
                continue
            x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
            distance = np.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2)
            right = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z + translation[0]
            up = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z + translation[1]
            is_served = eye_distances[0] < distance <= eye_distances[1]
            if is_served and low[0] <= right <= high[0] and low[1] <= up <= high[1]:
                out[i, j] = number
