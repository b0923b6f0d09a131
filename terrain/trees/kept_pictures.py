"""The pictures of trees kept on disk: to paint them takes a process most of a second, to read them a hundredth of that."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import numpy as np

from skugga.terrain.user_cache import arrays_kept_in, user_cache
from skugga.terrain.whole_files import replaced_whole

VERSIONS = np.__version__, version("scipy"), version("numba")
"""Of the packages that paint: others may round otherwise."""


def kept_pictures(
    paint: Callable[[], tuple[np.ndarray, ...]], sources: tuple[Path, ...], folder: Path | None = None
) -> tuple[np.ndarray, ...]:
    """What ``paint`` makes, from disk where it was painted before by the same ``sources``, files of code, and packages.

    A folder that cannot be written, or a file that is damaged, is no error.
    """
    folder = folder or user_cache("foliage")
    digest = hashlib.blake2b(repr(VERSIONS).encode(), digest_size=20)
    for source in (*sources, Path(__file__)):
        digest.update(source.read_bytes())
    path = folder / f"{digest.hexdigest()}.npz"
    kept = arrays_kept_in(path)
    if kept is not None:
        return tuple(kept[f"arr_{number}"] for number in range(len(kept)))
    painted = paint()
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with replaced_whole(path) as part:
            np.savez(part, *painted)
        for other in folder.glob("*.npz"):
            if other != path:
                other.unlink(missing_ok=True)
    return painted
