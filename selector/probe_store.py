"""Store probes (observed times and errors of drawn choices) of levels' maps in the user's cache folder.

There is one file for each device, driver and version of a level.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from skugga.selector.cost.device_profile import profile_path
from skugga.selector.map_probes import MapProbes
from skugga.terrain.atomic_files import write_atomically
from skugga.terrain.user_cache import user_cache_folder

MAX_FILES = 200
"""Maximum number of files for a device. The oldest ones are deleted, because earlier versions of a level are not needed again."""


def probes_folder(renderer: str, version: str) -> Path:
    """Return the folder with the probes of a device and its driver version."""
    return user_cache_folder("probes") / profile_path(renderer, version).stem


def save_probes(renderer: str, version: str, level_version: str, probes: MapProbes) -> Path:
    """Add probes of a version of a level to its file by an atomic write, and return the path of the file.

    Raises ``OSError`` if the folder cannot be written. ``level_version`` identifies the version of the level, and ``renderer`` and
    ``version`` are OpenGL's strings of the device.
    """
    folder = probes_folder(renderer, version)
    path = folder / f"{level_version}.json"
    folder.mkdir(parents=True, exist_ok=True)
    write_atomically(path, load_probes(path).merged_with(probes).model_dump_json(indent=1))
    files = sorted(folder.glob("*.json"), key=lambda file: file.stat().st_mtime_ns, reverse=True)
    for old in files[MAX_FILES:]:
        with suppress(OSError):
            old.unlink()
    return path


def load_probes(path: Path) -> MapProbes:
    """Return the probes in a file: errors and times of algorithms that were measured on a level's maps.

    The result is empty for a missing or broken file, and for one of another version of Skugga. The level is then probed again.
    """
    try:
        return MapProbes.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # pydantic raises a ValueError for a broken file
        return MapProbes()
