"""The measurements that plans (choices of shadow algorithms) use, and their version for each level.

Entity tags and keys of picture caches include the version, since other plans may give other pictures.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

from skugga.api.workers.jobs import LevelKey
from skugga.selector.cost.device_profile import profile_digest
from skugga.terrain.cache import MIB, cached

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile
    from skugga.selector.map_probes import MapProbes


@dataclass(frozen=True)
class PlanMeasurements:
    """The measurements that plans use. Immutable: a change creates a new object.

    Attributes
    ----------
    device : DeviceProfile or None
        Calibration of the device (measured costs of algorithms); ``None`` without one.
    probes_json_by_version : Mapping
        Probes (observed errors and times) of levels, by the level's version, as JSON of
        ``skugga.selector.map_probes.MapProbes``.
    """

    device: DeviceProfile | None = None
    probes_json_by_version: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def calibration(self) -> str:
        """Digest of the calibration; empty without one."""
        return profile_digest(self.device)

    def version_of(self, level: LevelKey | None) -> str:
        """Return the version of a level's plans, a digest; ``None`` stands for plans without a level.

        The version changes with the calibration and with the level's probes. It is empty if there are neither.
        """
        probes_json = None if level is None else self.probes_json_by_version.get(level.version)
        if probes_json is None:
            return self.calibration
        return hashlib.sha256(f"{self.calibration}\n{probes_json}".encode()).hexdigest()[:16]

    def probes_of(self, level: LevelKey) -> MapProbes:
        """Return the probes of a level; they are empty if it was not probed."""
        return _parse_probes(self.probes_json_by_version.get(level.version, "{}"))

    def with_probes(self, probes_by_version: Mapping[str, str]) -> PlanMeasurements:
        """Return a copy with further probes, as JSON by the version of their level."""
        return replace(self, probes_json_by_version={**self.probes_json_by_version, **probes_by_version})


@cached("process", 4 * MIB)
def _parse_probes(text: str) -> MapProbes:
    """Return the probes that a JSON text describes."""
    from skugga.selector.map_probes import MapProbes

    return MapProbes.model_validate_json(text)
