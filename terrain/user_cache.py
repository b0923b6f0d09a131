"""Where what outlives a process is kept for a user."""

from __future__ import annotations

import os
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np


def user_cache(name: str) -> Path:
    """A folder of the user's cache (``XDG_CACHE_HOME``, else ``~/.cache``), which may not be there and not be possible to make."""
    return Path(os.environ.get("XDG_CACHE_HOME") or _home() / ".cache") / "skugga" / name


def arrays_kept_in(path: Path) -> dict[str, np.ndarray] | None:
    """The arrays of an ``.npz`` file by their names; ``None`` where it is absent or damaged."""
    absent_or_damaged = OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile
    with suppress(*absent_or_damaged), path.open("rb") as file, np.load(file) as stored:
        return {name: stored[name] for name in stored.files}
    return None


def _home() -> Path:
    """The user's home. A user that the system does not know, as in a container, has none."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")
