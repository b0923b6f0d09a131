"""Where what outlives a process is kept for a user."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache(name: str) -> Path:
    """A folder of the user's cache (``XDG_CACHE_HOME``, else ``~/.cache``), which may not be there and not be possible to make."""
    return Path(os.environ.get("XDG_CACHE_HOME") or _home() / ".cache") / "skugga" / name


def _home() -> Path:
    """The user's home. A user that the system does not know, as in a container, has none."""
    try:
        return Path.home()
    except RuntimeError:
        return Path("/nonexistent")
