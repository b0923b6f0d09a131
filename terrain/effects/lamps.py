"""The light of lamps (spots and omni lights). The effect is needed if the light of any lamp is visible in the view.

``_add_lamp_light`` computes their light at a point. ``visible_lamps`` and the glints on water (``skugga.terrain.effects.water``)
use the same formula.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.effects.effect import SRGB_CHANNEL_STEP, Effect, ShadingBlock, Verdict
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.gbuffer.resolve import FOREST
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.visible_cells import CellRange, block_slices, visible_cells
from skugga.terrain.lights import CONE_EDGE_FADE_SHARE, Lamp
from skugga.terrain.scene import Scene
from skugga.terrain.shading import LEAF_TRANSLUCENCY, daylight_of, exposure_of, night_sky_share
from skugga.terrain.shading_loops import MIN_SLOPE_SKY_FACTOR, twilight_sky_share
from skugga.terrain.srgb import srgb_of_linear

MAX_NAMED_LAMPS = 8
"""Maximum number of lamps that the text of a verdict names."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: the light of lamps changes white ground in the picture by three quarters of a step of 255: the dimmest are left out as
    long as what they come to together does not.

    Left out: no lamps; all too far away, too weak, or turned away.
    """
    if not descriptor.lamps:
        return Verdict(False, "the level has no lamps")
    reaching_lamps = [lamp.name for lamp in descriptor.lamps if lamp.reaches]
    if not reaching_lamps:
        return Verdict(False, f"no light from {_join_names([lamp.name for lamp in descriptor.lamps])} reaches the view")
    return Verdict(True, f"light from {_join_names(reaching_lamps)} reaches the view")


def _join_names(names: list[str]) -> str:
    """Return names joined with commas, shortened to the first ``MAX_NAMED_LAMPS`` and the number of the others."""
    rest_count = len(names) - MAX_NAMED_LAMPS
    return ", ".join(names if rest_count <= 1 else [*names[:MAX_NAMED_LAMPS], f"{rest_count} others"])


def visible_lamps(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> set[str]:
    """Return the names of the lamps whose light can be visible in a view.

    The light is computed for white surfaces that face the lamp, on all visible ground of a map or round the points of the coarse
    view. All omitted lamps together change no 8-bit channel by more than three quarters of a step.
    """
    light = {name: _max_irradiance(scene, lamp, view, coarse_view) for name, lamp in scene.lamps.items()}
    return set(light) - negligible_lamps(light, _min_visible_irradiance(scene))


def negligible_lamps(light: Mapping[str, np.ndarray | float], min_visible: float) -> set[str]:
    """Return the names of the dimmest lamps whose light is invisible even together.

    Lamps are added in the order of their maximum irradiance, as long as their sum is at most ``min_visible`` at every point.
    Equally bright lamps keep their order. ``light`` is the irradiance of each lamp at the same points (n,), or at one point.
    ``min_visible`` is the smallest visible irradiance, in the same unit. All values are 0 or more.
    """
    negligible, total = set(), np.zeros(1)
    for name in sorted(light, key=lambda name: float(np.max(light[name], initial=0.0))):
        total = total + light[name]
        if np.max(total, initial=0.0) > min_visible:
            break
        negligible.add(name)
    return negligible


def _max_irradiance(scene: Scene, lamp: Lamp, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> np.ndarray:
    """Return an upper bound of a lamp's irradiance on visible surfaces around some points (n,), in units of the sun's irradiance.

    The points are the same for all lamps: in a map the highest ground of the overview's visible cells, else the points of the
    coarse view. The distance to the lamp is reduced by the spacing of the points and by the maximum height of objects. On flat
    ground without objects the bound includes the cosine of incidence. The result is 0 where the lamp does not shine.
    """
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    strength = max(lamp.color) * lamp.intensity * lamp.reference_distance_m**2 * exposure
    if coarse_view is None:
        assert isinstance(view, MapView)
        cells = visible_cells(scene.elevation, view)
        if cells is None:
            return np.zeros(1)
        points, slack_m = _highest_points_of_cells(scene, cells)
    else:
        points = coarse_view.buffer.frame.points_to_earth(coarse_view.points_frame_m)
        slack_m = coarse_view.distance_m * coarse_view.spacing_tangent
    to_points = points - lamp.position_earth_m
    slack_m = slack_m + scene.objects.tallest_object_m
    distance_m = np.linalg.norm(to_points, axis=-1)
    near_m = np.maximum(distance_m - slack_m, 1e-3)
    light = strength / near_m**2
    if scene.world.is_flat and np.ptp(scene.height_range_m) <= 0.0 and scene.objects.caster_kinds == ("relief",):
        light *= np.minimum(np.abs(to_points[:, 2]) / near_m, 1.0)
    shines = light > 0.0  # False for NaN points
    if lamp.kind == "spot":
        off_deg = np.degrees(np.arccos(np.clip(to_points @ lamp.earth_from_lamp[:, 2] / np.maximum(distance_m, 1e-9), -1.0, 1.0)))
        shines &= off_deg - np.degrees(np.arctan2(slack_m, near_m)) <= lamp.cutoff_deg
    return np.where(shines, light, 0.0).ravel()


def _min_visible_irradiance(scene: Scene) -> float:
    """Return the smallest irradiance on white that can change an 8-bit channel by more than three quarters of a step.

    Light is most visible where other light is weakest. Ground receives at least a quarter of the sky light even in a gorge, and
    less on the side away from the sun. The undersides of meshes may receive none. Light is most visible on white, since a light
    changes the code of a colour c in proportion to c to the power of 0.42.
    """
    sine = -1.0 if scene.sun is None else np.sin(np.radians(scene.sun.altitude_deg))
    night = night_sky_share(scene)
    sky = float(daylight_of(scene).sky_irradiance.min()) * (night + (1.0 - night) * twilight_sky_share(sine))
    ground_light = (
        0.25 * (1.0 if scene.sun is None else MIN_SLOPE_SKY_FACTOR) * sky if "meshes" not in scene.objects.caster_kinds else 0.0
    )
    increments = np.geomspace(1e-6, 1.0, 256)
    return float(
        increments[
            np.argmax(srgb_of_linear(ground_light + increments) - srgb_of_linear(np.array(ground_light)) > 0.75 * SRGB_CHANNEL_STEP)
        ]
    )


@cached("scene", 16 * MIB)
def _highest_points_of_cells(scene: Scene, cells: CellRange) -> tuple[np.ndarray, np.ndarray]:
    """Return the highest point (n, 3) of each of some cells of the overview, and the radius (n,) of each cell's ground, metres.

    The points are earth-fixed, above the cells' centres. Cells without ground are left out.
    """
    overview, elevation = scene.elevation.overview, scene.elevation
    factor = 2**overview.lod
    cell_mask = np.zeros(overview.max_heights_m.shape, bool)
    cell_mask[block_slices(cells, factor, overview.max_heights_m.shape)] = True
    row, col = np.nonzero(cell_mask & np.isfinite(overview.max_heights_m))
    high, mean = overview.max_heights_m[row, col], overview.mean_heights_m[row, col]
    point, up = scene.world.points_at_zero_height(
        elevation.crs, *elevation.xy((row + 0.5) * factor - 0.5, (col + 0.5) * factor - 0.5)
    )
    cell_width_m = elevation.cell_size_m(scene.world.metres_per_unit) * factor
    return point + up * high[:, None], cell_width_m + 2.0 * np.nan_to_num(high - mean)


def apply_lamps(lamplight: np.ndarray, block: ShadingBlock) -> None:
    """Add the light of the lamps to ``lamplight`` (rows, cols, 3), in place.

    It falls off with the square of the distance. The edge of a spot's cone is smooth.
    """
    buffer, scene = block.buffer, block.scene
    exposure = exposure_of(None if scene.sun is None else scene.sun.altitude_deg)
    for name, visibility in block.visibilities.items():
        if name not in scene.lamps:
            continue
        lamp = scene.lamps[name]
        position, axis, _ = lamp.in_frame(buffer.frame)
        color = np.array(lamp.color) * lamp.intensity * lamp.reference_distance_m**2 * exposure
        outer, inner = (
            np.cos(np.radians([lamp.cutoff_deg, lamp.cutoff_deg * (1.0 - CONE_EDGE_FADE_SHARE)]))
            if lamp.kind == "spot"
            else (-2.0, -1.5)
        )
        _add_lamp_light(lamplight, buffer.shading_inputs, visibility, position, axis, color, outer, inner, LEAF_TRANSLUCENCY)


@compiled
def _add_lamp_light(out, shading_inputs, visibility, lamp, axis, color, outer_cosine, inner_cosine, translucency):
    """Add the light of one lamp to ``out`` (rows, cols, 3), in the stage ``lamplight``.

    ``visibility`` (rows, cols) is the visible share of the lamp. ``lamp`` (3,) is its position and ``axis`` (3,) the unit vector
    along its cone, in the local frame. ``color`` (3,) is the irradiance at a distance of 1 m. The light fades out between the
    cosines ``inner_cosine`` and ``outer_cosine`` of the angle from the axis. ``translucency`` is the share of light on leaves that
    does not depend on the angle of incidence.
    """
    valid, kind, position, _, normal = shading_inputs
    for i in range(valid.shape[0]):
        for j in range(valid.shape[1]):
            n, p = normal[i, j], position[i, j]
            x, y, z = lamp[0] - p[0], lamp[1] - p[1], lamp[2] - p[2]
            distance = np.sqrt(x * x + y * y + z * z)
            if not valid[i, j] or distance == 0.0 or visibility[i, j] == 0.0:
                continue
            translucent_share = translucency if kind[i, j] == FOREST else 0.0
            incidence_cosine = max(n[0] * x + n[1] * y + n[2] * z, 0.0) / distance
            cosine = -(axis[0] * x + axis[1] * y + axis[2] * z) / distance
            rim = min(max((cosine - outer_cosine) / (inner_cosine - outer_cosine), 0.0), 1.0)
            share = (
                (translucent_share + (1.0 - translucent_share) * incidence_cosine) * rim * visibility[i, j] / (distance * distance)
            )
            for k in range(3):
                out[i, j, k] += color[k] * share


EFFECT = Effect("light of spots and omni lights", judge, stage="lamplight", apply=apply_lamps)
