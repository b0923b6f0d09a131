"""Clouds: they drift with time, block a part of the direct sunlight, and are seen in the sky of perspective views.

A point's ray to the sun meets the layer (``cloud_layer``) at one place. The density of the clouds there determines how much
sunlight they block. Every tile, view and frame has the same cloud above the same ground. Clouds are not shadow casters: they change
the colours of a picture, but not the visibility of the sun that shadow algorithms compute. ``sky_clouds`` draws the sky.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled
from skugga.terrain.effects.cloud_layer import (
    CLOUD_EDGE_WIDTH,
    CLOUD_OCTAVES,
    COARSEST_CLOUD_WAVELENGTH_M,
    MAX_NOISE,
    MAX_NOISE_SLOPE,
    MIN_SUN_ALTITUDE_SINE,
    CloudLayer,
    cloud_layer_of,
    cloud_noise,
    density_at,
    density_of_noise,
    fade_share,
    layer_position,
)
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict, pixel_size
from skugga.terrain.effects.haze import farthest_mesh_m
from skugga.terrain.effects.sky_clouds import sky_colors_with_clouds
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact, numeric_fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.noise import OCTAVE_GAIN
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.ground.visible_cells import CellRange, full_cell_range, visible_cells
from skugga.terrain.scene import Scene
from skugga.terrain.shading import daylight_of, night_sky_share
from skugga.terrain.shading_loops import twilight_sky_share

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
    fade = fade_share(pixel_m)
    for i in range(valid.shape[0]):
        for j in range(valid.shape[1]):
            if not valid[i, j] or sunlight[i, j] == 0.0:
                continue
            p = position[i, j]
            if tangent > 0.0:
                x, y, z = p[0] - eye[0], p[1] - eye[1], p[2] - eye[2]
                fade = fade_share(tangent * np.sqrt(x * x + y * y + z * z))
            x = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2] + origin[0]
            y = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2] + origin[1]
            z = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2] + origin[2]
            density = cover * fade
            if fade < 1.0:
                x, y = layer_position(x, y, z, height[i, j], layer_m, to_sun, centre, drift, MIN_SUN_ALTITUDE_SINE)
                density += (1.0 - fade) * density_at(x, y, threshold)
            sunlight[i, j] *= 1.0 - max_opacity * density


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: ``cloud_cover`` between 0 and 1, the sun is up, and the densest cloud over visible surfaces takes more than 0.8 % of its
    light, or a perspective view shows sky.

    Left out: a clear or a covered sky; night; no cloud near, and no sky in view.
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
        if facts.get("in_sky"):
            return Verdict(True, f"cloud cover {cover:.3g}: clouds are seen in the sky")
        return Verdict(
            False, f"cloud cover {cover:.3g}: clouds block at most {blocked_share:.1%} of the light on any visible surface"
        )
    return Verdict(True, f"cloud cover {cover:.3g}: clouds block up to {blocked_share:.0%} of the light")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of clouds.

    - ``cover``: share of the sky that clouds cover.
    - ``taken``: upper bound of the share of a point's light that clouds block, over all visible points. In a map all visible ground
      counts, lit or not.
    - ``in_sky``: whether a perspective view shows clouds in the sky.
    """
    cover = scene.loaded.level.weather.cloud_cover
    if not 0.0 < cover < 1.0 or not scene.sun_is_up:
        return {"cover": cover, "taken": 0.0, "in_sky": False}
    layer, direct = cloud_layer_of(scene), _direct_share(scene)
    if coarse_view is None:
        assert isinstance(view, MapView)
        cells = visible_cells(scene.elevation, view)
        boxes = [] if cells is None else [_box_of_cells(scene, layer, cells)]
        nearest = farthest = fade_share(map_pixel_m(scene.world, view))
    else:
        assert isinstance(view, PerspectiveView)
        distance_m = coarse_view.distance_m if len(coarse_view.distance_m) else np.zeros(1)
        boxes = _boxes_of_coarse_view(scene, layer, coarse_view)
        nearest, farthest = (fade_share(view.pixel_tangent * float(m)) for m in (distance_m.min(), distance_m.max()))
    densest = max((_max_density(*box, layer.noise_threshold) for box in boxes), default=0.0)
    density = max((1.0 - fade) * densest + fade * cover for fade in (nearest, farthest)) if boxes else 0.0
    in_sky = coarse_view is not None and not coarse_view.buffer.valid.all()
    return {"cover": cover, "taken": float(direct * layer.max_opacity * density), "in_sky": in_sky}


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
    """Return the places (n, 2), metres, where rays from points (n, 3) to the sun meet the cloud layer (``layer_position``)."""
    return _positions_of_points(
        points_anchor_m, height_m, layer.height_m, layer.to_sun_anchor, layer.up_origin_anchor_m, layer.drift_m
    )


@compiled
def _positions_of_points(points, height, layer_height_m, to_sun, up_origin, drift_m):
    """Return the places (n, 2), metres, where rays from ``points`` (n, 3) to the sun meet the cloud layer.

    The parameters are those of ``layer_position``; ``height`` is (n,).
    """
    out = np.empty((len(points), 2))
    for n in range(len(points)):
        p = points[n]
        out[n, 0], out[n, 1] = layer_position(
            p[0], p[1], p[2], height[n], layer_height_m, to_sun, up_origin, drift_m, MIN_SUN_ALTITUDE_SINE
        )
    return out


@cached("process", MIB)
def _max_density(west: float, east: float, south: float, north: float, noise_threshold: float) -> float:
    """Return an upper bound of the cloud density in a box."""
    return float(
        density_of_noise(
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
                value = cloud_noise(x, y, -np.inf, np.inf)
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


EFFECT = Effect(
    "drifting clouds and their shadows",
    judge,
    facts,
    stage="sunlight",
    apply=apply_clouds,
    sky_colors=sky_colors_with_clouds,
)
