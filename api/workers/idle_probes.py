"""Probes of the levels that a service draws maps of: loaded from the user's cache folder, or made in idle time if missing.

A probe draws sample blocks of a level's maps with several shadow algorithms, and observes errors and times. The observations
correct the predictions of plans. They are grouped by scale and by class of suns (suns of similar altitude). The service also loads
probes that a command writes while it runs.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from skugga.api.resource_exhaustion import exhausted_error
from skugga.api.workers.idle_work import IdleJob, IdleWork
from skugga.api.workers.jobs import LevelKey
from skugga.selector.map_probes import MapClass, MapProbes
from skugga.selector.probe_store import load_probes, probes_folder, save_probes
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

PROBE_BUDGET_S = 10.0
"""Seconds that a probe may spend on one scale. No request waits for it."""

READ_INTERVAL_S = 2.0
"""Seconds between two checks for new probes in the user's cache folder."""

Probe = Callable[[LevelKey, int, "DeviceProfile"], MapProbes]
"""Type of a function that probes a level's maps under a class of suns (``MapClass.sun``), with a device's calibration."""

log = logging.getLogger("skugga")


def probe_level(level: LevelKey, sun_class: int, device: DeviceProfile) -> MapProbes:
    """Probe a level's maps at all scales under a representative sun of the class ``sun_class``. Raises ``SkuggaError``."""
    from skugga.api.map_probing import probe_maps, with_class_sun

    scene = build_scene(load_level(level))
    try:
        return probe_maps(with_class_sun(scene, sun_class), device, budget_s=PROBE_BUDGET_S)
    finally:
        scene.close()


class IdleProbes:
    """Loads the probes of levels, and has missing ones made as idle work, once for each version of a level and class of suns.

    Parameters
    ----------
    is_enabled
        Whether missing probes are made.
    idle_work
        The queue of idle work.
    current_device
        Returns the calibration that the service's plans use; ``None`` without one.
    probes_in_use
        Returns the probes that the service's plans use, as JSON by the version of their level.
    add_probes
        Adds such probes to those that plans use.
    probe
        Probes a level, in a process of its own.
    """

    def __init__(
        self,
        is_enabled: bool,
        idle_work: IdleWork,
        current_device: Callable[[], DeviceProfile | None],
        probes_in_use: Callable[[], Mapping[str, str]],
        add_probes: Callable[[Mapping[str, str]], None],
        probe: Probe = probe_level,
    ) -> None:
        self._is_enabled, self._idle_work, self._current_device, self._probes_in_use, self._add_probes = (
            is_enabled,
            idle_work,
            current_device,
            probes_in_use,
            add_probes,
        )
        self._probe = probe
        self._requested: set[tuple[str, int]] = set()
        self._failed: set[tuple[str, int]] = set()
        self._folder: Path | None = None
        self._read_mtime_ns: dict[str, int] = {}
        self._watch_task: asyncio.Task[None] | None = None
        self._is_unsaved = False

    @property
    def requested_count(self) -> int:
        """Number of requested probes that are not made yet. Each is of one level under one class of suns."""
        return len(self._requested)

    def start_watching(self, renderer: str, version: str) -> None:
        """Load the stored probes of a device, and watch their folder for new ones. Later calls do nothing.

        ``renderer`` and ``version`` are OpenGL's names of the device and the driver in the render processes. An empty ``version``
        means that there is no OpenGL, so nothing is probed.
        """
        if self._folder is None and version:
            self._folder = probes_folder(renderer, version)
            self._add_new_probes(
                self._read_changed_files()
            )  # before the first picture, so that saved probes do not change its plan later
            self._watch_task = asyncio.create_task(self._watch())

    async def close(self) -> None:
        """Stop watching the files."""
        if self._watch_task is not None:
            self._watch_task.cancel()
            await asyncio.gather(self._watch_task, return_exceptions=True)

    def request_probe(self, level: LevelKey, unprobed_class: MapClass) -> None:
        """Request the probe of a level for a map whose plan had none. ``unprobed_class`` is its class: scale and sun.

        Nothing is requested without a calibration, or if such a probe exists, is requested already or has failed.
        """
        device, key = self._current_device(), (level.version, unprobed_class.sun)
        if not self._is_enabled or self._folder is None or device is None or key in self._requested | self._failed:
            return
        if any(
            probed_class.sun == unprobed_class.sun
            for probed_class in MapProbes.model_validate_json(self._probes_in_use().get(level.version, "{}")).classes
        ):
            return  # the level was probed under such a sun; the map has a scale that tiles do not have
        self._requested.add(key)
        name = f"{level.path.stem} under a sun about {unprobed_class.sun_altitude_deg:.0f} degrees high"

        async def on_result(probes: MapProbes) -> None:
            await self._save_result(level, device, probes, name)
            self._requested.discard(key)

        def on_failure(reason: str) -> None:
            self._failed.add(key)
            self._requested.discard(key)
            log.warning("maps of %s could not be probed, so their plans rely on predictions alone: %s", name, reason)

        self._idle_work.add(IdleJob(self._probe, (level, unprobed_class.sun, device), on_result, on_failure))

    async def _save_result(self, level: LevelKey, device: DeviceProfile, probes: MapProbes, name: str) -> None:
        """Use new probes of a level for plans from now on, and save them to the user's cache folder.

        ``device`` is the calibration with which they were made, and ``name`` is the level's name, for the log.
        """
        known_probes = MapProbes.model_validate_json(self._probes_in_use().get(level.version, "{}"))
        self._add_probes({level.version: known_probes.merged_with(probes).model_dump_json()})
        text = f"maps of {name} were probed at {len(probes.classes)} scales, and their plans use the probes from now on"
        try:
            path = await asyncio.to_thread(save_probes, device.renderer, device.version, level.version, probes)
        except OSError as error:
            log.log(
                logging.INFO if self._is_unsaved else logging.WARNING,
                "%s, but only until this service ends: %s cannot be written (%s)",
                text, error.filename or self._folder, error.strerror or error,
            )  # fmt: skip
            self._is_unsaved = True
        else:
            log.info("%s; saved to %s", text, path)

    async def _watch(self) -> None:
        """Read probes that another process has written, every ``READ_INTERVAL_S`` seconds, for ever."""
        while True:
            await asyncio.sleep(READ_INTERVAL_S)
            try:
                self._add_new_probes(await asyncio.to_thread(self._read_changed_files))
            except (OSError, RuntimeError, MemoryError) as error:
                if exhausted_error(error) is None:
                    raise
                log.warning("stored probes could not be read: %s. They are read again later.", exhausted_error(error))

    def _read_changed_files(self) -> dict[str, MapProbes]:
        """Return the probes in files that were written since they were last read, by the version of their level."""
        changed_probes: dict[str, MapProbes] = {}
        assert self._folder is not None
        for path in self._folder.glob("*.json"):
            try:
                stamp_ns = path.stat().st_mtime_ns
            except OSError:
                continue
            if self._read_mtime_ns.get(path.stem) != stamp_ns:
                self._read_mtime_ns[path.stem] = stamp_ns
                if (probes := load_probes(path)).classes:
                    changed_probes[path.stem] = probes
        return changed_probes

    def _add_new_probes(self, probes_by_version: Mapping[str, MapProbes]) -> None:
        """Use probes for plans, unless plans use equal ones already.

        ``probes_by_version`` has them by the version of their level.
        """
        new = {version: probes.model_dump_json() for version, probes in probes_by_version.items()}
        probes_in_use = self._probes_in_use()
        if new := {version: text for version, text in new.items() if probes_in_use.get(version) != text}:
            self._add_probes(new)
