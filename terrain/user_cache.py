"""The user's cache folder on disk."""

from __future__ import annotations

import os
import zipfile
from contextlib import suppress
from pathlib import Path

import numpy as np


def user_cache_folder(name: str) -> Path:
    """Return a folder of the user's cache (``XDG_CACHE_HOME``, else ``~/.cache``).

    The folder may not exist, and may be impossible to create.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or _home_folder() / ".cache") / "skugga" / name


def load_arrays(path: Path) -> dict[str, np.ndarray] | None:
    """Return the arrays of an ``.npz`` file by name; ``None`` if the file is missing or damaged."""
    absent_or_damaged = OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile
    with suppress(*absent_or_damaged), path.open("rb") as file, np.load(file) as stored:
        return {name: stored[name] for name in stored.files}
    return None


def _home_folder() -> Path:
    """Return the user's home folder; ``/nonexistent`` for a user whom the system does not know, as in a container."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")
