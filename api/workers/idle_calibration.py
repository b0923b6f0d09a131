"""The calibration of a service's device: loaded from a file, or measured in idle time if missing.

A calibration has the measured costs of the shadow algorithms on a device (graphics card, or software rasteriser) and its driver.
Plans predict times with it. The file lies in the user's cache folder, and the service reloads the file when it changes.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from skugga.api.resource_exhaustion import exhausted_error
from skugga.api.workers.idle_work import IdleJob, IdleWork
from skugga.selector.cost.device_profile import load_profile, profile_digest, profile_path, save_profile

if TYPE_CHECKING:
    from skugga.selector.cost.device_profile import DeviceProfile

CHECK_INTERVAL_S = 2.0
"""Seconds between two checks of the calibration's file for changes."""

CalibrationState = Literal["calibrated", "waiting", "running", "paused", "failed", "off", "none"]

ProfileStamp = tuple[int, int, int]
"""Modification time in nanoseconds, inode number and size in bytes of a calibration's file."""

log = logging.getLogger("skugga")


def measure_profile() -> DeviceProfile:
    """Measure and return the calibration of this process's device. Raises ``GraphicsError``."""
    from skugga.selector.cost.calibration import calibrate

    return calibrate()


class IdleCalibration:
    """Watches the file of the device's calibration, and has a missing calibration measured once, as idle work.

    Parameters
    ----------
    is_enabled
        Whether a device without a calibration is calibrated.
    idle_work
        The queue of idle work.
    current_device
        Returns the calibration that the service's plans use; ``None`` without one.
    set_profile
        Sets the calibration that the service's plans use.
    measure_device
        Measures and returns the calibration of the device, in a process of its own.
    """

    def __init__(
        self,
        is_enabled: bool,
        idle_work: IdleWork,
        current_device: Callable[[], DeviceProfile | None],
        set_profile: Callable[[DeviceProfile], None],
        measure_device: Callable[[], DeviceProfile] = measure_profile,
    ) -> None:
        self._is_enabled, self._idle_work, self._current_device, self._set_profile, self._measure = (
            is_enabled,
            idle_work,
            current_device,
            set_profile,
            measure_device,
        )
        self._renderer, self._version = "", ""
        self._is_expected, self._failed = is_enabled, False
        self._watch_task: asyncio.Task[None] | None = None

    @property
    def state(self) -> CalibrationState:
        """The state of the calibration.

        It is ``calibrated``; ``waiting`` for idle time, ``running`` or ``paused``; ``failed``; ``off`` if calibration in idle time
        is disabled; ``none`` if there is no OpenGL device to calibrate.
        """
        if self._is_calibrated:
            return "calibrated"
        if self._is_expected:
            return "waiting" if self._idle_work.pid is None else "paused" if self._idle_work.is_paused else "running"
        return "failed" if self._failed else "off" if self._version else "none"

    @property
    def is_expected(self) -> bool:
        """Whether the device will be calibrated in idle time. Plans may change then."""
        return self._is_expected and not self._is_calibrated

    @property
    def _is_calibrated(self) -> bool:
        """Whether the plans' rates were measured, and not estimated."""
        device = self._current_device()
        return device is not None and not device.is_estimate

    def start_watching(self, renderer: str, version: str) -> None:
        """Load the calibration of a device, or request its measurement, and watch its file. Later calls do nothing.

        ``renderer`` and ``version`` are OpenGL's names of the device and the driver in the render processes. An empty ``version``
        means that there is no OpenGL, so nothing is calibrated.
        """
        if self._version:
            return
        self._renderer, self._version, self._is_expected = renderer, version, self._is_enabled and bool(version)
        if version:
            self._watch_task = asyncio.create_task(self._watch())

    async def close(self) -> None:
        """Stop watching the file."""
        if self._watch_task is not None:
            self._watch_task.cancel()
            await asyncio.gather(self._watch_task, return_exceptions=True)

    @property
    def _consequence(self) -> str:
        """How algorithms are chosen without a calibration, in words."""
        return "fixed rules choose the algorithms" if self._current_device() is None else "plans use estimated times"

    def _request_calibration(self) -> None:
        """Queue the measurement of the calibration as idle work, or log that it must be measured by a command."""
        if not self._is_enabled:
            log.info(
                "%s is not calibrated, so %s. Run skugga calibrate to measure it (SKUGGA_CALIBRATE_WHEN_IDLE is false)",
                self._renderer, self._consequence,
            )  # fmt: skip
            return
        log.info(
            "%s is not calibrated, so %s until it is. The calibration takes a minute or two and runs while nothing is drawn",
            self._renderer, self._consequence,
        )  # fmt: skip
        self._idle_work.add(IdleJob(self._measure, (), self._save_result, self._note_failure, lambda: self.is_expected))

    async def _save_result(self, profile: DeviceProfile) -> None:
        """Use a measured calibration for plans from now on, and save it to its file.

        A calibration of another device is a failure.
        """
        if (profile.renderer, profile.version) != (self._renderer, self._version):
            self._note_failure(f"the calibration is of another device, {profile.renderer}")
            return
        self._is_expected = False
        self._set_profile(profile)
        message = f"{self._renderer} was calibrated in {profile.took_s:.0f} s, and plans use predictions from now on"
        try:
            path = await asyncio.to_thread(save_profile, profile)
        except OSError as error:
            path = profile_path(self._renderer, self._version)
            log.warning("%s, but only until this service ends: %s cannot be written (%s)", message, path, error.strerror or error)
        else:
            log.info("%s; saved to %s", message, path)

    def _note_failure(self, reason: str) -> None:
        """Record and log that the device cannot be calibrated. It is not tried again."""
        self._is_expected, self._failed = False, True
        log.warning("%s could not be calibrated, so %s: %s", self._renderer, self._consequence, reason)

    async def _watch(self) -> None:
        """Load the calibration, or request its measurement. Then reload the file whenever ``skugga calibrate`` writes it."""
        path = profile_path(self._renderer, self._version)
        last_stamp = await self._read(path, None)
        if not self._is_calibrated:
            self._request_calibration()
        while True:
            await asyncio.sleep(CHECK_INTERVAL_S)
            try:
                last_stamp = await self._read(path, last_stamp)
            except (OSError, RuntimeError, MemoryError) as error:
                if exhausted_error(error) is None:
                    raise
                log.warning("the calibration file could not be read: %s. It is read again later.", exhausted_error(error))

    async def _read(self, path: Path, last_stamp: ProfileStamp | None) -> ProfileStamp | None:
        """Load the file if its stamp (time, inode, size) differs from ``last_stamp``.

        Return the new stamp; ``last_stamp`` if the file is unchanged or missing.
        """
        stamp = await asyncio.to_thread(_file_stamp, path)
        if stamp is None or stamp == last_stamp:
            return last_stamp
        profile = await asyncio.to_thread(load_profile, self._renderer, self._version)
        is_worse = profile is not None and profile.is_estimate and self._is_calibrated
        if profile is not None and not is_worse and profile_digest(profile) != profile_digest(self._current_device()):
            self._set_profile(profile)
            kind = "estimate" if profile.is_estimate else "calibration"
            log.info("the %s %s was loaded, and plans use it from now on", kind, path)
        return stamp


def _file_stamp(path: Path) -> ProfileStamp | None:
    """Return the stamp of a calibration's file; ``None`` if it does not exist."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_ino, status.st_size
