"""In render processes that are forked for tests: levels that are alike are prepared for once, and not each by itself.

On a first start a render process draws up to ten pictures of each level, so that loops and shaders are compiled; a stamp in the
user's cache says that it has. Tests make new levels in new folders for nearly each service, most of them over the same hills. For
all that have the same keys one stamp will do, which pytest's cache keeps from run to run. It hangs on the engine's files as the
true one does. ``test_preparation.py`` tests the true one, and the services of ``test_serve.py`` go by it.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

from api.workers import preparation
from api.workers.jobs import LevelKey
from terrain.level.level import load_level

STAMPS = "TESTS_STAMPS"
"""Environment variable: the folder of these stamps. No setting of Skugga, which tests would be cleared of."""


def keys_of(value: Any) -> Any:
    """The keys of a level, without what they are set to."""
    if isinstance(value, dict):
        return {key: keys_of(part) for key, part in sorted(value.items())}
    return [keys_of(part) for part in value[:1]] if isinstance(value, list) else None


def _stamp_of(level: LevelKey, engine: str) -> Path:
    keys = keys_of(load_level(level.path).level.model_dump(mode="json", exclude_unset=True))
    return Path(os.environ[STAMPS]) / hashlib.sha256(f"{engine} {keys}".encode()).hexdigest()[:24]


if STAMPS in os.environ:
    preparation._stamp_of = _stamp_of
