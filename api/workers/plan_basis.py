"""What render processes make plans by, and a version of it for each level, which entity tags and caches of pictures know."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from api.device_calibration import digest_of
from api.workers.jobs import LevelKey

if TYPE_CHECKING:
    from selector.cost.device_profile import DeviceProfile


@dataclass(frozen=True)
class PlanBasis:
    """The device's calibration, and by level what was ``probed`` for it alone, as text. A value: another one takes its place."""

    device: DeviceProfile | None = None
    probed: Mapping[LevelKey, str] = field(default_factory=dict)

    @cached_property
    def calibration(self) -> str:
        """The digest of the calibration; empty where there is none."""
        return digest_of(self.device)

    def version_of(self, level: LevelKey | None) -> str:
        """The version of a level's plans (``None``: of what no level has): it changes with the calibration, and with what was
        probed for the level. Empty where neither is there.
        """
        found = None if level is None or not self.probed else self.probed.get(level)
        if found is None:
            return self.calibration
        return hashlib.sha256(f"{self.calibration}\n{found}".encode()).hexdigest()[:16]

    def with_probed(self, level: LevelKey, found: str) -> PlanBasis:
        """The same with what was probed for a level; what was for other versions of its files is forgotten."""
        others = {key: text for key, text in self.probed.items() if key.path != level.path or key.version == level.version}
        return replace(self, probed={**others, level: found})
