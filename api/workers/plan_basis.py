"""What render processes make plans by, and a version of it for each level, which entity tags and caches of pictures know."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from skugga.api.workers.jobs import LevelKey
from skugga.selector.cost.device_profile import digest_of
from skugga.terrain.cache import MIB, cached

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile
    from skugga.selector.map_probes import MapProbes


@dataclass(frozen=True)
class PlanBasis:
    """The device's calibration, and by versions of levels what was ``probed`` for each alone, as JSON of
    ``skugga.selector.map_probes.MapProbes``. A value: another one takes its place.
    """

    device: DeviceProfile | None = None
    probed: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def calibration(self) -> str:
        """The digest of the calibration; empty where there is none."""
        return digest_of(self.device)

    def version_of(self, level: LevelKey | None) -> str:
        """The version of a level's plans (``None``: of what no level has): it changes with the calibration, and with what was
        probed for the level. Empty where neither is there.
        """
        found = None if level is None else self.probed.get(level.version)
        if found is None:
            return self.calibration
        return hashlib.sha256(f"{self.calibration}\n{found}".encode()).hexdigest()[:16]

    def probes_of(self, level: LevelKey) -> MapProbes:
        """What was probed for a level."""
        return _probes(self.probed.get(level.version, "{}"))

    def with_probed(self, found: Mapping[str, str]) -> PlanBasis:
        """The same with what was probed for versions of levels."""
        return replace(self, probed={**self.probed, **found})


@cached("process", 4 * MIB)
def _probes(text: str) -> MapProbes:
    from skugga.selector.map_probes import MapProbes

    return MapProbes.model_validate_json(text)
