"""Disk cache of the ray-traced reference (truth).

The cache key is a digest of the content: points, triangles, light and number of sub-samples.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from skugga.shadows.truth.truth import ALL_CASTER_KINDS, Truth, trace_truth
from skugga.terrain.atomic_files import atomic_path
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.casters.casting import caster_meshes, caster_sheets, caster_trees
from skugga.terrain.casters.rays import RAY_OFFSET_ULPS
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.sun import SUN_RADIUS_DEG
from skugga.terrain.level.level import SUN
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import foliage
from skugga.terrain.user_cache import load_arrays, user_cache_folder

TRUTH_CACHE_BYTES = 512 * 2**20
"""Size limit of the folder. Beyond it the least recently used files are deleted."""

_FIELD_OF_KEY = {"lit": "lit", "attached": "attached_shadow_mask", "decidable": "decidable", "valid": "valid"}
"""Keys of the arrays in a file, in the order of the fields of ``Truth``, each with its field."""


DEFINITION_VERSION = 4
"""Version of the definition of truth (part of the cache key)."""


def cached_truth(
    buffer: GeometryBuffer,
    scene: Scene,
    casters: Casters,
    sample_count: int,
    light: str = SUN,
    folder: Path | None = None,
    compute: Callable[..., Truth] = trace_truth,
) -> Truth:
    """Return the result of ``trace_truth``, from the disk cache if possible.

    A folder that cannot be written raises no error. ``compute`` computes a truth that is not cached. ``sample_count`` is the number
    of sub-samples of a pixel. ``folder`` is the cache's folder; ``None``: that of the user.
    """
    folder = folder or user_cache_folder("truth")
    path = folder / f"{content_key(buffer, scene, casters, sample_count, light)}.npz"
    shape = buffer.valid.shape
    cached_arrays = load_arrays(path)
    if cached_arrays is not None:
        with suppress(KeyError, ValueError):  # replace a file of another format
            loaded = Truth(
                *(np.unpackbits(cached_arrays[name])[: shape[0] * shape[1]].reshape(shape).astype(bool) for name in _FIELD_OF_KEY)
            )
            with suppress(OSError):  # the file may be read-only
                path.touch()
            return loaded
    truth = compute(buffer, scene, casters, sample_count, light=light)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        packed: dict[str, Any] = {name: np.packbits(getattr(truth, field)) for name, field in _FIELD_OF_KEY.items()}
        with atomic_path(path) as part:
            np.savez_compressed(part, **packed)
        _evict_oldest(folder)
    except OSError:
        pass
    return truth


def content_key(buffer: GeometryBuffer, scene: Scene, casters: Casters, sample_count: int, light: str = SUN) -> str:
    """Return a digest of everything that truth depends on.

    ``sample_count`` is the number of sub-samples of a pixel.
    """
    digest = hashlib.blake2b(digest_size=20)
    to_light = np.zeros(3)
    if light != SUN:
        lamp = scene.lamps[light]
        to_light = np.array([*lamp.position_earth_m, *lamp.earth_from_lamp[:, 2], lamp.cutoff_deg, lamp.radius_m])
    elif scene.sun is not None:
        to_light = scene.sun.in_frame(buffer.frame)
    numbers = (
        DEFINITION_VERSION,
        _view_numbers(buffer.view),
        sample_count,
        RAY_OFFSET_ULPS,
        SUN_RADIUS_DEG,
        scene.highest_sun_deg,
        light,
    )
    digest.update(repr(numbers).encode())
    trees = caster_trees(buffer, ALL_CASTER_KINDS)
    parts = (
        [] if trees is None else [trees.base_frame_m, trees.quad_sizes_m, trees.yaw_cos_sin, trees.variant, foliage().mip_levels[0]]
    )
    for vertices, triangles in caster_meshes(scene, buffer, ALL_CASTER_KINDS):
        parts += [vertices, triangles]
    for sheet in caster_sheets(scene, buffer, casters, ALL_CASTER_KINDS):
        parts += [sheet.position_frame_m, sheet.is_cut_nw_se]
    for array in (to_light, buffer.valid, buffer.position_frame_m, *parts):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _view_numbers(view: MapView | PerspectiveView) -> tuple[float, ...]:
    """Return the numbers that determine which points a view shows."""
    if isinstance(view, PerspectiveView):
        return (view.focal_px, view.row0, view.col0, view.step_px, *view.eye_earth_m, *view.earth_from_camera.ravel())
    return view.row0, view.col0, view.row_step, view.col_step, view.grid.step, view.grid.y_to_x_step_ratio


def _evict_oldest(folder: Path) -> None:
    """Delete the least recently used files beyond ``TRUTH_CACHE_BYTES``."""
    files = sorted(((path.stat().st_mtime, path.stat().st_size, path) for path in folder.glob("*.npz")), reverse=True)
    total = 0
    for _, size, path in files:
        total += size
        if total > TRUTH_CACHE_BYTES:
            path.unlink(missing_ok=True)
