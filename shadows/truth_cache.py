"""Truth kept on disk, by content: the same points, triangles, sun and sub-samples give the same file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from shadows.truth import SUN_RADIUS_DEG, Truth, truth_of
from terrain.geometry import GeometryBuffer
from terrain.rays import OFFSET_ULPS
from terrain.reach import Casters, caster_sheets
from terrain.scene import Scene

LIMIT_BYTES = 512 * 2**20
"""Size of the folder above which the files used longest ago go."""

_FIELDS = ("lit", "attached", "decidable", "there")


def cache_folder() -> Path:
    """The user's cache folder for truth (``XDG_CACHE_HOME``, else ``~/.cache``)."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "skugga" / "truth"


def cached_truth(
    buffer: GeometryBuffer,
    scene: Scene,
    casters: Casters,
    samples: int,
    folder: Path | None = None,
    make: Callable[..., Truth] = truth_of,
) -> Truth:
    """``truth_of``, from disk where it has been made before. A folder that cannot be written is no error."""
    folder = folder or cache_folder()
    path = folder / f"{content_key(buffer, scene, casters, samples)}.npz"
    shape = buffer.there.shape
    try:
        with np.load(path) as stored:
            arrays = [np.unpackbits(stored[name])[: shape[0] * shape[1]].reshape(shape).astype(bool) for name in _FIELDS]
        path.touch()
        return Truth(*arrays)
    except (OSError, ValueError, KeyError, EOFError):  # absent or damaged
        pass
    truth = make(buffer, scene, casters, samples)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(f".{os.getpid()}.npz")
        np.savez_compressed(part, **{name: np.packbits(getattr(truth, name)) for name in _FIELDS})
        part.replace(path)
        _trim(folder)
    except OSError:
        pass
    return truth


def content_key(buffer: GeometryBuffer, scene: Scene, casters: Casters, samples: int) -> str:
    """A digest of all that truth depends on."""
    digest = hashlib.blake2b(digest_size=20)
    to_sun = np.zeros(3) if scene.sun is None else buffer.frame.frame_from_earth @ scene.sun.to_sun_earth
    view = buffer.view
    steps = (view.row0, view.col0, view.row_step, view.col_step, view.grid.step, samples, OFFSET_ULPS, SUN_RADIUS_DEG)
    digest.update(repr((steps, scene.highest_sun_deg)).encode())
    for array in (to_sun, buffer.there, buffer.position_frame_m, *caster_sheets(scene, buffer, casters)):
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _trim(folder: Path) -> None:
    files = sorted(((path.stat().st_mtime, path.stat().st_size, path) for path in folder.glob("*.npz")), reverse=True)
    total = 0
    for _, size, path in files:
        total += size
        if total > LIMIT_BYTES:
            path.unlink(missing_ok=True)
