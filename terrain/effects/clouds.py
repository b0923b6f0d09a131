"""Cloud shadows: clouds drift with time and block a part of the direct sunlight.

The clouds are a layer without thickness at a constant height. A point's ray to the sun meets the layer at one place. The density of
the clouds there determines how much sunlight they block. The density is fractal noise over metres east and north of the level's
anchor, so every tile, view and frame has the same cloud above the same ground. Clouds are not shadow casters: they change the
colours of a picture, but not the visibility of the sun that shadow algorithms compute.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, internal
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict, pixel_size
from skugga.terrain.effects.haze import farthest_mesh_m
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.noise import OCTAVE_GAIN, noise_at
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.ground.visible_cells import CellRange, full_cell_range, visible_cells
from skugga.terrain.interpolation_loops import smoothstep_value
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of, night_sky_share
from skugga.terrain.shading_loops import twilight_sky_share

CLOUD_HEIGHT_M, CLOUD_CLEARANCE_M = 1500.0, 500.0
"""Height of the clouds above the level's mean ground, and their minimum height above its highest ground."""

CLOUD_DRIFT_M_PER_S = (10.0 * np.sin(np.radians(67.5)), 10.0 * np.cos(np.radians(67.5)))
"""East and north components of the clouds' velocity: 10 m/s towards the east-north-east."""

MIN_SUN_ALTITUDE_SINE = np.sin(np.radians(5.0))
"""Lower bound of the sine of the sun's altitude in the projection of points to the layer. Without it shadows would move ever faster
towards sunset.
"""

COARSEST_CLOUD_WAVELENGTH_M, CLOUD_OCTAVES, CLOUD_SEED = 4000.0, 5, 71
"""Wavelength of the coarsest octave, number of octaves, seed. The finest octave has a wavelength of 250 m."""

CLOUD_EDGE_WIDTH = 0.26
"""Difference of the noise between the edge of a cloud and its densest part."""

CLOUD_TRANSMITTANCE = 0.25
"""Transmittance of the densest cloud under a broken sky."""

MAX_NOISE, MAX_NOISE_SLOPE = 0.756, 2.32
"""Upper bounds of the value and of the slope of ``skugga.terrain.ground.noise.noise_at``, over all its gradients."""

MAX_OCTAVE_SUM = MAX_NOISE * (1.0 - OCTAVE_GAIN**CLOUD_OCTAVES) / (1.0 - OCTAVE_GAIN)
"""Upper bound of the sum of all octaves."""

FADE_WAVELENGTH_SHARES = 1 / 16, 1 / 2
"""Pixel sizes, as shares of ``COARSEST_CLOUD_WAVELENGTH_M``, between which clouds fade into their mean density."""

MAX_INVISIBLE_LIGHT_SHARE = 0.008
"""Largest share of a point's light whose loss is not visible.

If light loses the share ``a``, its sRGB code loses the share ``1 - (1 - a)**(1 / 2.4)``, about ``a / 2.4``. The code, without the
offset of the sRGB curve, is at most 1.055. The loss is smaller in the linear part of the curve near black, and where
``skugga.terrain.shading_loops.tone_curve`` compresses bright light. It reaches a step of 1/255 at ``a`` = 0.0089. The smaller value
here allows for the 4096 steps of the encoding table.
"""

MIN_SKY_LIGHT_SHARE = 0.25
"""Lower bound of the share of sky light on a face towards a sun at the horizon.

An upright face receives half of the sky. An overhanging face receives less, but is darker, too.
"""

MAX_DENSITY_EVALUATIONS = 2**17
"""Maximum number of evaluations in the search for the densest cloud. An undecided search counts as full density."""


class CloudLayer(NamedTuple):
    """The clouds of a scene.

    Attributes
    ----------
    cloud_cover
        Share of the sky that clouds cover.
    noise_threshold
        Value of the noise in the middle of a cloud's edge.
    max_opacity
        Share of the direct sunlight that the densest cloud blocks.
    height_m
        Height of the layer, metres.
    to_sun_anchor
        Unit vector to the sun (3,), in the anchor's axes.
    up_origin_anchor_m
        Point (3,) from which "up" points away, in the anchor's axes, metres.
    drift_m
        Drift east and north (2,), metres.
    """

    cloud_cover: float
    noise_threshold: float
    max_opacity: float
    height_m: float
    to_sun_anchor: np.ndarray
    up_origin_anchor_m: np.ndarray
    drift_m: np.ndarray


def cloud_layer_of(scene: Scene) -> CloudLayer:
    """Return the clouds of a scene, which must have a sun.

    The transmittance of the densest cloud falls to 0 as the cover approaches 1, so that the transition to an overcast sky is
    continuous.
    """
    world, cover = scene.world, scene.loaded.level.weather.cloud_cover
    anchor_from_earth = world.earth_from_anchor.T
    assert scene.sun is not None
    centre = np.array([0.0, 0.0, -1e12]) if world.is_flat else -anchor_from_earth @ world.anchor_earth_m
    return CloudLayer(
        cover, noise_threshold_of(cover), 1.0 - CLOUD_TRANSMITTANCE * (1.0 - cover**4),
        max(_mean_height_m(scene.elevation) + CLOUD_HEIGHT_M, scene.height_range_m[1] + CLOUD_CLEARANCE_M),
        anchor_from_earth @ scene.sun.to_sun_earth, centre, scene.clock_seconds * np.array(CLOUD_DRIFT_M_PER_S),
    )  # fmt: skip


@cached("scene", MIB)
def _mean_height_m(elevation: Elevation) -> float:
    """Return the mean height of the level's ground, metres."""
    return float(np.nanmean(elevation.overview.mean_heights_m))


def noise_threshold_of(cloud_cover: float) -> float:
    """Return the value that the noise exceeds on the share ``cloud_cover`` of a plane. For 0 and 1 it lies beyond all values."""
    limit = MAX_OCTAVE_SUM + CLOUD_EDGE_WIDTH / 2.0
    shares, values = _noise_distribution()
    return float(np.interp(cloud_cover, [0.0, *shares, 1.0], [limit, *values, -limit]))


@cached("process", 16 * MIB)
def _noise_distribution() -> tuple[np.ndarray, np.ndarray]:
    """Return shares of a plane (n,), and for each the noise value (n,) that is exceeded on that share of the plane.

    They are measured on a square whose side is 195 of the coarsest wavelengths.
    """
    # Steps of the golden ratio have no common period with the lattice.
    values = np.sort(_noise_on_grid(np.arange(256) * 0.76393202250021))[::-1]
    return (np.arange(values.size)[32::64] + 0.5) / values.size, values[32::64]


@compiled
def _noise_on_grid(x):
    """Return the noise (n * n,) at all pairs of the coordinates ``x`` (n,), in units of ``COARSEST_CLOUD_WAVELENGTH_M``."""
    out = np.empty(x.size * x.size)
    for i in range(x.size):
        for j in range(x.size):
            out[i * x.size + j] = _cloud_noise(
                x[j] * COARSEST_CLOUD_WAVELENGTH_M, x[i] * COARSEST_CLOUD_WAVELENGTH_M, -np.inf, np.inf
            )
    return out


@compiled
def _cloud_noise(x_m, y_m, low, high):
    """Return the sum of the noise's octaves at the place (``x_m``, ``y_m``) in the layer.

    The sum stops early once the remaining octaves cannot change whether it is below ``low`` or above ``high``.
    """
    # The lattice is rotated, and each octave again by the angle of the 3-4-5 triangle, as in ``skugga.terrain.ground.noise``.
    x, y = (0.6 * x_m - 0.8 * y_m) / COARSEST_CLOUD_WAVELENGTH_M, (0.8 * x_m + 0.6 * y_m) / COARSEST_CLOUD_WAVELENGTH_M
    total, amplitude = 0.0, 1.0
    for k in range(CLOUD_OCTAVES):
        total += amplitude * noise_at(x, y, CLOUD_SEED + k)
        amplitude *= OCTAVE_GAIN
        remaining = MAX_OCTAVE_SUM - MAX_NOISE * (1.0 - amplitude) / (1.0 - OCTAVE_GAIN)
        if total + remaining < low or total - remaining > high:
            break
        x, y = 2.0 * (0.8 * x - 0.6 * y) + 17.3, 2.0 * (0.6 * x + 0.8 * y) - 9.1
    return total


@compiled
def density_at(x_m, y_m, noise_threshold):
    """Return the relative cloud density at the place (``x_m``, ``y_m``) in the layer: 0 in gaps, 1 inside clouds.

    ``noise_threshold`` is that of the ``CloudLayer``.
    """
    return _density_of_noise(
        _cloud_noise(x_m, y_m, noise_threshold - CLOUD_EDGE_WIDTH / 2.0, noise_threshold + CLOUD_EDGE_WIDTH / 2.0), noise_threshold
    )


@compiled
def _density_of_noise(noise, noise_threshold):
    """Return the relative cloud density, in [0, 1], for a value of the noise. It is 0.5 at ``noise_threshold``."""
    return smoothstep_value((noise - noise_threshold) / CLOUD_EDGE_WIDTH + 0.5)


@internal
def _layer_position(x, y, z, height, layer_height_m, to_sun, up_origin, drift_m):
    """Return the intersection (x, y) of a point's ray to the sun with the layer, in metres of the noise.

    These are metres east and north of the anchor, minus the clouds' drift. ``height`` is the point's height, ``layer_height_m``
    that of the layer. ``to_sun``, ``up_origin`` and ``drift_m`` are fields of the ``CloudLayer``. All coordinates are in the
    anchor's axes.
    """
    ux, uy, uz = x - up_origin[0], y - up_origin[1], z - up_origin[2]
    sine = (ux * to_sun[0] + uy * to_sun[1] + uz * to_sun[2]) / np.sqrt(ux * ux + uy * uy + uz * uz)
    distance_m = (layer_height_m - height) / max(sine, MIN_SUN_ALTITUDE_SINE)
    return x + distance_m * to_sun[0] - drift_m[0], y + distance_m * to_sun[1] - drift_m[1]


@compiled
def _fade_share(pixel_m):
    """Return the share, in [0, 1], of the mean density in the density that pixels ``pixel_m`` metres wide show."""
    return min(
        max(
            (pixel_m / COARSEST_CLOUD_WAVELENGTH_M - FADE_WAVELENGTH_SHARES[0])
            / (FADE_WAVELENGTH_SHARES[1] - FADE_WAVELENGTH_SHARES[0]),
            0.0,
        ),
        1.0,
    )


def apply_clouds(sunlight: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the sunlight (rows, cols) of a block's pixels by the transmittance of the clouds, in place."""
    buffer, scene = block.buffer, block.scene
    if scene.sun is None:
        return
    _shade_clouds(
        sunlight, buffer.shading_inputs, scene.world.anchor_from_frame(buffer.frame), cloud_layer_of(scene), pixel_size(block)
    )


@compiled
def _shade_clouds(sunlight, shading_inputs, anchor_from_frame, layer, size):
    """Multiply the sunlight of each pixel by the transmittance of the clouds, in place.

    ``sunlight`` (rows, cols) is the share of the direct sunlight that reaches each pixel. ``layer`` is a ``CloudLayer``, ``size`` a
    ``PixelSize``. ``anchor_from_frame`` is the rotation (3, 3) and the translation (3,) from the local frame to the anchor's axes.
    """
    valid, _, position, height, _ = shading_inputs
    rotation, origin = anchor_from_frame
    cover, threshold, max_opacity, layer_m, to_sun, centre, drift = layer
    eye, tangent, pixel_m = size
    fade = _fade_share(pixel_m)
    for i in range(valid.shape[0]):
        for j in range(valid.shape[1]):
            if not valid[i, j] or sunlight[i, j] == 0.0:
                continue
            p = position[i, j]
            if tangent > 0.0:
                x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                fade = _fade_share(tangent * np.sqrt(x * x + y * y + z * z))
            x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
            y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
            z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + origin[2]
            density = cover * fade
            if fade < 1.0:
                x, y = _layer_position(x, y, z, height[i, j], layer_m, to_sun, centre, drift)
                density += (1.0 - fade) * density_at(x, y, threshold)
            sunlight[i, j] *= 1.0 - max_opacity * density


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    It is not needed under a clear or overcast sky, without a sun, at night, and if clouds block no visible share of the light.
    """
    facts = descriptor.facts["clouds"]
    cover = facts["cover"]
    if cover == 0.0:
        return Verdict(False, "the level sets no clouds")
    if cover == 1.0:
        return Verdict(False, "overcast: no direct sunlight for single clouds to block")
    if descriptor.highest_sun_deg is None:
        return Verdict(False, "the level has no sun")
    if descriptor.highest_sun_deg <= 0.0:
        return Verdict(False, f"night: the sun is at most {descriptor.highest_sun_deg:.1f} degrees high anywhere in the level")
    blocked_share = numeric_fact(facts["taken"])
    if blocked_share is None:
        return Verdict(True, f"cloud cover {cover:.3g}")
    if blocked_share <= MAX_INVISIBLE_LIGHT_SHARE:
        return Verdict(
            False, f"cloud cover {cover:.3g}: clouds block at most {blocked_share:.1%} of the light on any visible surface"
        )
    return Verdict(True, f"cloud cover {cover:.3g}: clouds block up to {blocked_share:.0%} of the light")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of clouds.

    - ``cover``: share of the sky that clouds cover.
    - ``taken``: upper bound of the share of a point's light that clouds block, over all visible points. In a map all visible ground
      counts, lit or not.
    """
    cover = scene.loaded.level.weather.cloud_cover
    if not 0.0 < cover < 1.0 or not scene.sun_is_up:
        return {"cover": cover, "taken": 0.0}
    layer, direct = cloud_layer_of(scene), _direct_share(scene)
    if coarse_view is None:
        assert isinstance(view, MapView)
        cells = visible_cells(scene.elevation, view)
        boxes = [] if cells is None else [_box_of_cells(scene, layer, cells)]
        nearest = farthest = _fade_share(map_pixel_m(scene.world, view))
    else:
        assert isinstance(view, PerspectiveView)
        distance_m = coarse_view.distance_m if len(coarse_view.distance_m) else np.zeros(1)
        boxes = _boxes_of_coarse_view(scene, layer, coarse_view)
        nearest, farthest = (_fade_share(view.pixel_tangent * float(m)) for m in (distance_m.min(), distance_m.max()))
    densest = max((_max_density(*box, layer.noise_threshold) for box in boxes), default=0.0)
    density = max((1.0 - fade) * densest + fade * cover for fade in (nearest, farthest)) if boxes else 0.0
    return {"cover": cover, "taken": float(direct * layer.max_opacity * density)}


def _direct_share(scene: Scene) -> float:
    """Return the maximum share of direct sunlight in the light of any point, in any colour channel.

    Sunlight fades in over the first degree of the sun's altitude (``skugga.terrain.shading_loops``). The light is assumed to fall
    on a surface that faces the sun, unless the scene is level ground without objects.
    """
    light, sine = daylight_of(scene), float(np.sin(np.radians(scene.highest_sun_deg or 0.0)))
    night = night_sky_share(scene)
    low, high = scene.height_range_m
    bare = low == high and scene.objects.caster_kinds == ("relief",)
    direct = light.sun_irradiance * min(scene.highest_sun_deg or 0.0, 1.0) * (sine if bare else 1.0)
    sky = light.sky_irradiance * (night + (1.0 - night) * float(twilight_sky_share(sine))) * (1.0 if bare else MIN_SKY_LIGHT_SHARE)
    sky = sky * (1.0 - scene.style.sky_light_desaturation)  # greying takes this share from a pure red, green or blue
    return float((direct / (direct + sky)).max())


CloudBounds = tuple[float, float, float, float]
"""Bounds of places in the cloud layer, metres of the noise: west, east, south and north."""


def _box_of_cells(scene: Scene, layer: CloudLayer, cells: CellRange) -> CloudBounds:
    """Return the bounds, in the cloud layer, of the rays from the ground of some cells and the objects on it to the sun."""
    row, col = np.meshgrid(*(np.linspace(first, last, 17) for first, last in cells))
    x, y = scene.elevation.xy(row, col)
    point, up = (values.reshape(-1, 3) for values in scene.world.points_at_zero_height(scene.elevation.crs, x, y))
    low, high = scene.height_range_m
    heights = np.repeat([low, high + scene.objects.tallest_object_m], len(point))
    points = np.tile(point, (2, 1)) + heights[:, None] * np.tile(up, (2, 1)) - scene.world.anchor_earth_m
    positions = _layer_positions(points @ scene.world.earth_from_anchor, heights, layer)
    # The margin allows for meridians that curve between the points.
    return _position_bounds(positions, 0.001 * np.ptp(positions[np.isfinite(positions).all(axis=1)], axis=0).max())


def _boxes_of_coarse_view(scene: Scene, layer: CloudLayer, coarse_view: CoarseView) -> list[CloudBounds]:
    """Return boxes in the cloud layer that contain all rays from the visible points of a perspective view to the sun.

    Each box covers two neighbouring octaves of distance from the eye, so that the boxes also cover the surfaces between the samples
    of the coarse view. If the sky is visible, the boxes extend to 1.25 times the distance of the farthest points.
    """
    rotation, origin_m = scene.world.anchor_from_frame(coarse_view.buffer.frame)
    points, distance_m, height_m = coarse_view.points_frame_m, coarse_view.distance_m, coarse_view.height_m
    if not coarse_view.buffer.valid.all():
        far = distance_m > distance_m.max(initial=0.0) / 1.25
        points = np.concatenate([points, 1.25 * points[far] - 0.25 * coarse_view.eye_frame_m])
        distance_m, height_m = np.concatenate([distance_m, 1.25 * distance_m[far]]), np.concatenate([height_m, height_m[far]])
    positions = _layer_positions(points @ rotation.T + origin_m, height_m.astype(np.float64), layer)
    octave = np.ceil(np.log2(np.maximum(distance_m, 1.0)))
    rise_m = _missed_object_height_m(scene, coarse_view) / max(layer.to_sun_anchor[2], MIN_SUN_ALTITUDE_SINE)
    octaves, bounds, boxes = np.unique(octave), _box_of_cells(scene, layer, full_cell_range(scene.elevation)), []
    for near, far in pairwise(octaves) if len(octaves) > 1 else zip(octaves, octaves, strict=True):
        west, east, south, north = _position_bounds(
            positions[(octave == near) | (octave == far)], coarse_view.spacing_tangent * 2.0**far + rise_m
        )
        box = max(west, bounds[0]), min(east, bounds[1]), max(south, bounds[2]), min(north, bounds[3])
        if box[0] <= box[1] and box[2] <= box[3]:
            boxes.append(box)
    return boxes


def _missed_object_height_m(scene: Scene, coarse_view: CoarseView) -> float:
    """Return the maximum height, metres, of visible objects above the points of a coarse view, which may miss them.

    Trees count always, meshes if they are in view.
    """
    view, trees = coarse_view.buffer.view, scene.objects.trees
    if isinstance(view, PerspectiveView) and farthest_mesh_m(scene, view, coarse_view.buffer.frame) > 0.0:
        return scene.objects.tallest_object_m
    return 0.0 if trees is None else float(trees.height_m.max())


def _position_bounds(positions: np.ndarray, margin_m: float) -> CloudBounds:
    """Return the bounds of the positions (n, 2) in the cloud layer, widened by ``margin_m`` metres. NaN positions do not count."""
    low, high = np.nanmin(positions, axis=0) - margin_m, np.nanmax(positions, axis=0) + margin_m
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


def _layer_positions(points_anchor_m: np.ndarray, height_m: np.ndarray, layer: CloudLayer) -> np.ndarray:
    """Return the places (n, 2), metres, where rays from points (n, 3) to the sun meet the cloud layer (``_layer_position``)."""
    return _positions_of_points(
        points_anchor_m, height_m, layer.height_m, layer.to_sun_anchor, layer.up_origin_anchor_m, layer.drift_m
    )


@compiled
def _positions_of_points(points, height, layer_height_m, to_sun, up_origin, drift_m):
    """Return the places (n, 2), metres, where rays from ``points`` (n, 3) to the sun meet the cloud layer.

    The parameters are those of ``_layer_position``; ``height`` is (n,).
    """
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        p = points[n]
        out[n, 0], out[n, 1] = _layer_position(p[0], p[1], p[2], height[n], layer_height_m, to_sun, up_origin, drift_m)
    return out


@cached("process", MIB)
def _max_density(west: float, east: float, south: float, north: float, noise_threshold: float) -> float:
    """Return an upper bound of the cloud density in a box."""
    return float(
        _density_of_noise(
            _max_noise(
                west, east, south, north, noise_threshold - CLOUD_EDGE_WIDTH / 2.0, noise_threshold + CLOUD_EDGE_WIDTH / 2.0
            ),
            noise_threshold,
        )
    )


@compiled
def _max_noise(west, east, south, north, low, high):
    """Return an upper bound of the noise in a box, clamped to ``low`` and ``high``, by branch and bound.

    The box is divided into cells. A cell's upper bound is the noise at its centre plus the maximum rise up to its corners. The cell
    is discarded if this bound is not above the maximum found so far. Other cells are split into four, down to a radius of one
    metre.
    """
    rows, cols = (
        int((north - south) / (COARSEST_CLOUD_WAVELENGTH_M / 8.0)) + 1,
        int((east - west) / (COARSEST_CLOUD_WAVELENGTH_M / 8.0)) + 1,
    )
    cells = np.empty((256, 4))
    best, evaluations = low, 0
    for i in range(rows):
        for j in range(cols):
            half_x, half_y = (east - west) / cols / 2.0, (north - south) / rows / 2.0
            cells[0, 0], cells[0, 1] = west + (2 * j + 1) * half_x, south + (2 * i + 1) * half_y
            cells[0, 2], cells[0, 3] = half_x, half_y
            count = 1
            while count > 0:
                count -= 1
                x, y, half_x, half_y = cells[count, 0], cells[count, 1], cells[count, 2], cells[count, 3]
                value = _cloud_noise(x, y, -np.inf, np.inf)
                radius = np.sqrt(half_x * half_x + half_y * half_y)
                max_rise, amplitude, wave_m = 0.0, 1.0, COARSEST_CLOUD_WAVELENGTH_M
                for _ in range(CLOUD_OCTAVES):
                    max_rise += amplitude * min(MAX_NOISE_SLOPE * radius / wave_m, 2.0 * MAX_NOISE)
                    amplitude, wave_m = amplitude * OCTAVE_GAIN, wave_m / 2.0
                best, evaluations = max(best, value), evaluations + 1
                if best >= high or evaluations > MAX_DENSITY_EVALUATIONS:
                    return high
                if value + max_rise <= best:
                    continue
                if radius < 1.0:
                    best = value + max_rise
                    continue
                for quarter in range(4):
                    cells[count, 0] = x + (quarter % 2 - 0.5) * half_x
                    cells[count, 1] = y + (quarter // 2 - 0.5) * half_y
                    cells[count, 2], cells[count, 3] = half_x / 2.0, half_y / 2.0
                    count += 1
    return best


EFFECT = Effect("drifting clouds that shade the ground", judge, facts, stage="sunlight", apply=apply_clouds)
