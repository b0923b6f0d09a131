"""A camera's way through key positions: smooth, without swinging past them, and at rest between two keys at one place.

Places, heights and fields of view run along curves of ``skugga.terrain.geo.keyed_curve``, as what moves in a level does: the way is
the same whichever way north lies, and a camera whose keys lie high stays high. Heights run in metres above the datum, not above the
ground: a camera that followed every knoll under it would shake.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import numpy as np

from skugga.terrain.errors import InputError
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.geo.keyed_curve import KeyedCurve
from skugga.terrain.ground.geolocate import Geolocator
from skugga.terrain.level.camera_file import CameraPathSpec


@dataclass(frozen=True, eq=False)
class CameraPath:
    """A camera's way over a level's ground.

    ``times_s`` (n,) are the keys' times; ``eyes`` and ``targets`` float64 (n, 3) are places as written (``Geolocator``), longitudes
    without jumps, and heights in metres above the datum; ``fov_deg`` (n,).
    """

    place: Geolocator
    times_s: np.ndarray
    eyes: np.ndarray
    targets: np.ndarray
    fov_deg: np.ndarray

    def view_at(self, time_s: float, rows: int, cols: int) -> PerspectiveView:
        """The view at a time in seconds; before the first key and after the last one the camera rests.

        Raises ``InputError`` where the eye is off the ground's data or not above it, or where it meets the target.
        """
        eye, target = (np.concatenate([places.at(time_s), heights.at(time_s)]) for places, heights in self._curves)
        point, up = self.place.at_height((eye[0], eye[1]), eye[2])
        ground_m = self.place.ground_m((eye[0], eye[1]))
        if not np.isfinite(ground_m):
            raise InputError("eye", f"{eye[0]:.6g}, {eye[1]:.6g}", "a camera over the terrain's data")
        if not eye[2] > ground_m:
            raise InputError(
                "eye", f"{eye[2] - ground_m:.3g} m above the ground", "more than 0 m: the camera goes under the ground"
            )
        target_point, _ = self.place.at_height((target[0], target[1]), target[2])
        return look_at(point, target_point, up, float(self._fov.at(time_s)[0]), rows, cols)

    @cached_property
    def _curves(self) -> tuple[tuple[KeyedCurve, KeyedCurve], ...]:
        """Place and height of the eye, and of the target."""
        return tuple(
            (KeyedCurve(self.times_s, places[:, :2]), KeyedCurve(self.times_s, places[:, 2:]))
            for places in (self.eyes, self.targets)
        )

    @cached_property
    def _fov(self) -> KeyedCurve:
        return KeyedCurve(self.times_s, self.fov_deg[:, None])


def camera_path(spec: CameraPathSpec, place: Geolocator, start: datetime | None) -> CameraPath:
    """The way of a camera over a ground, for a film that begins at a date, if it has one.

    Raises ``InputError`` for keys off the ground's data, which names them, and for dates without a ``start``.
    """
    try:
        times_s = spec.times_s(start)
    except ValueError:
        raise InputError("keys", spec.keys[0].at, "times since the first frame, as 0s: the film has no date") from None
    eyes, targets = np.empty((len(times_s), 3)), np.empty((len(times_s), 3))
    for number, key in enumerate(spec.keys):
        for name, out, position in (("eye", eyes, key.eye), ("target", targets, key.target)):
            ground_m = place.ground_m(position[:2])
            if not np.isfinite(ground_m):
                raise InputError(f"keys.{number}.{name}", position, "a position on the terrain's data")
            out[number] = *position[:2], ground_m + position[2]
    if not place.world.flat:  # the short way round the earth, between keys and from the eye to what it sees
        eyes[:, 0] = np.unwrap(eyes[:, 0], period=360.0)
        targets[:, 0] = np.unwrap(targets[:, 0], period=360.0)
    return CameraPath(place, np.array(times_s), eyes, targets, np.array([key.fov for key in spec.keys]))
