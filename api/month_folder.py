"""A folder that keeps the finished months of a long computation, so that the same command continues after it was stopped."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skugga.api.file_stamps import file_stamps, level_version, watched_files
from skugga.terrain.atomic_files import atomic_path
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import LoadedLevel

DIGEST_CHARACTERS = 20


@dataclass(frozen=True)
class MonthFolder:
    """The months of one block of a request.

    Attributes
    ----------
    folder
        The folder; it is made on first use.
    digest
        Digest of the level's version, the block and the options. Months of other requests do not count.
    """

    folder: Path
    digest: str

    @classmethod
    def of_request(cls, folder: Path, loaded: LoadedLevel, view: MapView, options: str) -> MonthFolder:
        """Return the months of a block of a level's map. ``options`` is a text that tells requests apart."""
        version = level_version(loaded, file_stamps(watched_files(loaded)))
        block = view.grid.crs.to_wkt(), view.grid.x0, view.grid.y0, view.grid.step, view.row0, view.col0, view.rows, view.cols
        text = repr((version, block, options))
        return cls(folder, hashlib.sha256(text.encode()).hexdigest()[:DIGEST_CHARACTERS])

    def load(self, month: str) -> np.ndarray | None:
        """Return the array of a month; ``None`` if it is not there."""
        path = self._path(month)
        if not path.is_file():
            return None
        array: np.ndarray = np.load(path, allow_pickle=False)
        return array

    def save(self, month: str, array: np.ndarray) -> None:
        """Keep the array of a month. Raises ``OSError``."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_path(self._path(month)) as path:
            np.save(path, array)

    def _path(self, month: str) -> Path:
        """Return the file of a month."""
        return self.folder / f"{self.digest}-{month}.npy"
