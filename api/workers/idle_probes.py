"""Probes of the levels that a service draws maps of: found in the user's cache, made while the service is idle where there are
none, and taken up where a command has made some beside it.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from skugga.api.workers.idle_work import IdleJob, IdleWork
from skugga.api.workers.jobs import LevelKey
from skugga.selector.kept_probes import load_probes, probes_folder, save_probes
from skugga.selector.map_probes import MapClass, MapProbes
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

BUDGET_S = 10.0
"""Time of a probe of one scale: nobody waits for it."""

READ_EVERY_S = 2.0
"""How often it is looked whether there are others in the user's cache."""

Probe = Callable[[LevelKey, int, "DeviceProfile"], MapProbes]
"""Probes a level's maps under a class of suns by a device's calibration."""

log = logging.getLogger("skugga")


def probed_level(level: LevelKey, sun: int, device: DeviceProfile) -> MapProbes:
    """Probe a level's maps of all scales under the sun of a class. Raises ``SkuggaError``."""
    from skugga.api.map_probing import probe_maps, under_class_sun

    scene = build_scene(load_level(level))
    try:
        return probe_maps(under_class_sun(scene, sun), device, budget_s=BUDGET_S)
    finally:
        scene.close()


class IdleProbes:
    """Keeps what was probed for levels: ``device`` gives the calibration that plans go by, ``probed`` what they go by of each
    version of a level, and ``use`` lets them go by more.

    Where ``enabled``, what maps lacked is made by ``probe``, as idle work: once for each version of a level and class of suns.
    """

    def __init__(
        self,
        enabled: bool,
        idle: IdleWork,
        device: Callable[[], DeviceProfile | None],
        probed: Callable[[], Mapping[str, str]],
        use: Callable[[Mapping[str, str]], None],
        probe: Probe = probed_level,
    ) -> None:
        self._enabled, self._idle, self._device, self._probed, self._use = enabled, idle, device, probed, use
        self._probe = probe
        self._wanted: set[tuple[str, int]] = set()
        self._failed: set[tuple[str, int]] = set()
        self._folder: Path | None = None
        self._read_ns: dict[str, int] = {}
        self._watching: asyncio.Task[None] | None = None
        self._unkept = False

    @property
    def waiting(self) -> int:
        """How many probes are wanted and not made yet, each of a level under a class of suns."""
        return len(self._wanted)

    def begin(self, renderer: str, version: str) -> None:
        """It is known what render processes draw with; without a version there is nothing to probe."""
        if self._folder is None and version:
            self._folder = probes_folder(renderer, version)
            self._take_up(self._changed())  # before the first picture: its plan shall not change for what is there
            self._watching = asyncio.create_task(self._watch())

    async def close(self) -> None:
        """Look at the files no more."""
        if self._watching is not None:
            self._watching.cancel()
            await asyncio.gather(self._watching, return_exceptions=True)

    def lacking(self, level: LevelKey, unprobed: MapClass) -> None:
        """A map was planned without a probe of its class."""
        device, key = self._device(), (level.version, unprobed.sun)
        if not self._enabled or self._folder is None or device is None or key in self._wanted | self._failed:
            return
        if any(each.sun == unprobed.sun for each in MapProbes.model_validate_json(self._probed().get(level.version, "{}")).classes):
            return  # of a scale that tiles do not have
        self._wanted.add(key)
        name = f"{level.path.stem} under a sun about {unprobed.sun_altitude_deg:.0f} degrees high"

        async def done(found: MapProbes) -> None:
            await self._done(level, device, found, name)
            self._wanted.discard(key)

        def failed(reason: str) -> None:
            self._failed.add(key)
            self._wanted.discard(key)
            log.warning("maps of %s could not be probed, so their plans stay predictions: %s", name, reason)

        self._idle.add(IdleJob(self._probe, (level, unprobed.sun, device), done, failed))

    async def _done(self, level: LevelKey, device: DeviceProfile, found: MapProbes, name: str) -> None:
        before = MapProbes.model_validate_json(self._probed().get(level.version, "{}"))
        self._use({level.version: before.with_(found).model_dump_json()})
        text = f"maps of {name} were probed at {len(found.classes)} scales, and their plans go by it from now on"
        try:
            path = await asyncio.to_thread(save_probes, device.renderer, device.version, level.version, found)
        except OSError as error:
            log.log(
                logging.INFO if self._unkept else logging.WARNING, "%s, but until this service ends: %s cannot be written (%s)",
                text, error.filename or self._folder, error.strerror or error,
            )  # fmt: skip
            self._unkept = True
        else:
            log.info("%s; kept in %s", text, path)

    async def _watch(self) -> None:
        while True:
            await asyncio.sleep(READ_EVERY_S)
            self._take_up(await asyncio.to_thread(self._changed))

    def _changed(self) -> dict[str, MapProbes]:
        """What lies in the files that have changed since they were read, by the version of its level."""
        found: dict[str, MapProbes] = {}
        assert self._folder is not None
        for path in self._folder.glob("*.json"):
            try:
                stamp_ns = path.stat().st_mtime_ns
            except OSError:
                continue
            if self._read_ns.get(path.stem) != stamp_ns:
                self._read_ns[path.stem] = stamp_ns
                if (probes := load_probes(path)).classes:
                    found[path.stem] = probes
        return found

    def _take_up(self, found: Mapping[str, MapProbes]) -> None:
        new = {version: probes.model_dump_json() for version, probes in found.items()}
        probed = self._probed()
        if new := {version: text for version, text in new.items() if probed.get(version) != text}:
            self._use(new)
