"""Probes of levels' maps, kept in files of the user's cache folder: one of each device, driver and version of a level."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from skugga.selector.cost.device_profile import profile_path
from skugga.selector.map_probes import MapProbes
from skugga.terrain.user_cache import user_cache
from skugga.terrain.whole_files import write_whole

MOST_KEPT = 200
"""Files of a device: of more the oldest are deleted. Levels change, and nobody asks for their older versions."""


def probes_folder(renderer: str, version: str) -> Path:
    """Where a device's probes lie."""
    return user_cache("probes") / profile_path(renderer, version).stem


def save_probes(renderer: str, version: str, level_version: str, probes: MapProbes) -> Path:
    """Add what was probed for a version of a level to its file, whole or not at all. Raises ``OSError`` where the folder cannot be
    written.
    """
    folder = probes_folder(renderer, version)
    path = folder / f"{level_version}.json"
    folder.mkdir(parents=True, exist_ok=True)
    write_whole(path, load_probes(path).with_(probes).model_dump_json(indent=1))
    kept = sorted(folder.glob("*.json"), key=lambda file: file.stat().st_mtime_ns, reverse=True)
    for old in kept[MOST_KEPT:]:
        with suppress(OSError):
            old.unlink()
    return path


def load_probes(path: Path) -> MapProbes:
    """What a file holds; nothing where it is not there, or of another version of Skugga, or broken: it is probed anew."""
    try:
        return MapProbes.model_validate_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):  # a broken file's error is one of values
        return MapProbes()
