"""Area lights: the sun is a disc, and a lamp with a radius is a ball.

An algorithm with hard edges shows their penumbrae as the mean of its pictures for points of the light (P. Heckbert and M. Herf,
Simulating Soft Shadows with Graphics Hardware, CMU-CS-97-104, 1997).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from skugga.shadows.algorithm import FillVisibility
from skugga.shadows.algorithm_settings import AreaLightSettings
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.passes import PassLog
from skugga.shadows.work import Work
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.sun import SUN_RADIUS_DEG, azimuth_and_altitude
from skugga.terrain.level.level import SUN, CasterKind
from skugga.terrain.scene import Scene

GOLDEN_ANGLE_RAD = float(np.pi * (3.0 - 5.0**0.5))
"""Angle, in radians, between consecutive points of a spiral."""


def disc_points(sample_count: int) -> np.ndarray:
    """Return points (samples, 2) of the unit disc, each for an equal area: Vogel's spiral (1979).

    ``sample_count`` is the number of points.
    """
    number = np.arange(sample_count)
    angle, radius = number * GOLDEN_ANGLE_RAD, np.sqrt((number + 0.5) / sample_count)
    return radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def sun_disc_directions(to_sun: np.ndarray, sample_count: int, radius_deg: float = SUN_RADIUS_DEG) -> np.ndarray:
    """Return unit directions (samples, 3) to points of the sun's disc, each for an equal area of it.

    ``to_sun`` (3,) is the unit direction to the disc's centre. ``sample_count`` is their number, and ``radius_deg`` the disc's
    angular radius.
    """
    right = np.cross(to_sun, [0.0, 0.0, 1.0] if abs(to_sun[2]) < 0.9 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    places = np.tan(np.radians(radius_deg)) * disc_points(sample_count)
    directions = to_sun + places @ np.stack([right, np.cross(right, to_sun)])
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def ball_points(sample_count: int) -> np.ndarray:
    """Return points (samples, 3) in the unit ball that cover its visible disc evenly from every direction.

    The points' directions from the centre are spread evenly along a spiral. The density at radius r is 1 / sqrt(1 - r^2): its
    integrals along parallel lines are all equal. With r = sin t, the share of points within radius r is (2 t - sin 2t) / pi.
    Consecutive points of the spiral have radii that lie far apart. ``sample_count`` is the number of points.
    """
    number = np.arange(sample_count)
    up, angle = 1.0 - (2.0 * number + 1.0) / sample_count, number * GOLDEN_ANGLE_RAD
    t = np.linspace(0.0, np.pi / 2.0, 4096)
    rank = np.argsort(np.argsort((number * 0.7548776662466927) % 1.0))
    radius = np.sin(np.interp((rank + 0.5) / sample_count, (2.0 * t - np.sin(2.0 * t)) / np.pi, t))
    flat = np.sqrt(1.0 - up**2)
    return radius[:, None] * np.stack([flat * np.cos(angle), flat * np.sin(angle), up], axis=1)


def point_light_scenes(scene: Scene, light: str, sample_count: int) -> Iterator[Scene]:
    """Yield copies of a scene with a point light in place of an area light, one for each of its ``sample_count`` points.

    The sun gets a direction of its disc, a lamp a position in its ball.
    """
    if light == SUN:
        assert scene.sun is not None
        for direction in sun_disc_directions(scene.sun.to_sun_earth, sample_count):
            azimuth_deg, altitude_deg = azimuth_and_altitude(direction, scene.world.earth_from_anchor)
            sun = replace(scene.sun, azimuth_deg=azimuth_deg, altitude_deg=altitude_deg, to_sun_earth=direction)
            yield replace(scene, sun=sun)
        return
    lamp = scene.lamps[light]
    for place_m in lamp.radius_m * ball_points(sample_count):
        yield scene.with_lamp(replace(lamp, position_earth_m=lamp.position_earth_m + place_m))


def scale_work(work: Work, point_count: int) -> Work:
    """Return the work for all ``point_count`` of an area light, given the work for one."""
    return {part: {name: point_count * count for name, count in counts.items()} for part, counts in work.items()}


def mean_visibility_of_area_light(
    fill: FillVisibility,
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: AreaLightSettings,
    log: PassLog,
    masks_attached_shadow: bool = True,
    **changes: Any,
) -> np.ndarray:
    """Return the mean visibility (rows, cols) float32 over the points of an area light.

    ``settings.light_points`` is the number of points. For each of them ``fill`` (a ``FillVisibility``) runs with the settings
    updated by ``changes``. With ``masks_attached_shadow``, a surface that faces away from a point of the light gets 0 from that
    point; without, ``fill`` finds this itself. Intermediate pictures are kept for the first point alone.
    """
    passes = log.pass_names(light, kinds, ("",))[0]
    visibility, of_point = np.zeros(buffer.valid.shape, np.float32), settings.model_copy(update=changes)
    for point_scene in point_light_scenes(scene, light, settings.light_points):
        point_visibility = fill(buffer, point_scene, light, kinds, casters, of_point, log)
        if masks_attached_shadow:
            point_visibility[attached_shadow_mask(buffer, point_scene, light)] = 0.0
        visibility += point_visibility
        log = replace(log, requested_layers=frozenset())
    for record in log.records.values():
        if record.name.startswith(passes):
            record.light_points = settings.light_points
    return visibility / np.float32(settings.light_points)
