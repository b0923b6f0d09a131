"""Disk cache of the pictures of trees. Painting takes a process almost a second, and reading a hundredth of that."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import numpy as np

from skugga.terrain.atomic_files import atomic_path
from skugga.terrain.user_cache import load_arrays, user_cache_folder

PACKAGE_VERSIONS = np.__version__, version("scipy"), version("numba")
"""Versions of the packages that the painter uses, a part of the cache key. Other versions may round differently."""


def cached_pictures(
    paint: Callable[[], tuple[np.ndarray, ...]], sources: tuple[Path, ...], folder: Path | None = None
) -> tuple[np.ndarray, ...]:
    """Return the arrays that ``paint`` returns, from the disk cache if possible.

    The cache key consists of the content of ``sources`` (code files) and the package versions. Files with other keys are deleted. A
    read-only folder or a damaged file is no error.
    """
    folder = folder or user_cache_folder("foliage")
    digest = hashlib.blake2b(repr(PACKAGE_VERSIONS).encode(), digest_size=20)
    for source in (*sources, Path(__file__)):
        digest.update(source.read_bytes())
    path = folder / f"{digest.hexdigest()}.npz"
    stored_arrays = load_arrays(path)
    if stored_arrays is not None:
        return tuple(stored_arrays[f"arr_{number}"] for number in range(len(stored_arrays)))
    painted = paint()
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as part:
            np.savez(part, *painted)
        for old_path in folder.glob("*.npz"):
            if old_path != path:
                old_path.unlink(missing_ok=True)
    return painted
