"""Sky-view factor: surrounding ground hides a part of the sky, so that valleys receive less sky light.

**Rendering.** The sky light of each point is multiplied by the sky-view factor of the ground below it
(``skugga.terrain.ground.sky_view_factor``). This is exact on the ground itself. Meshes and trees get the factor of the ground that
they stand on, at any height above it. Distant ground uses means over the area of a pixel.

**Predicate.** The colour of a surface in sky light is ``albedo * sky * share``, where ``share`` is the visible share of the sky. If
the share ``h`` of the sky is hidden, the linear colour falls by at most ``albedo * sky * h``. The sRGB code of a linear colour
``L`` is about ``L^(1/2.4)``, and falls by ``h L^(1/2.4) / 2.4``. So among surfaces that only the sky lights, brighter ones change
more. Further light reduces the change, since the curve is flatter for brighter colours. The brightest ground in shadow therefore
changes most. The predicate compares the codes of all shades up to that of this ground, with and without the hidden sky.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.color_ramp import ColorRamp
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict, pixel_size
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.sky_view_factor import SkyView, mip_pair, sky_occlusion_at, sky_view, sky_view_nodes
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.ground.visible_cells import block_slices, visible_cells
from skugga.terrain.scene import Scene
from skugga.terrain.shading import (
    daylight_of,
    encode_srgb,
    max_slope_sky_factor,
    night_sky_share,
    shading_parameters,
    sky_lit_albedo,
)
from skugga.terrain.shading_loops import twilight_sky_share
from skugga.terrain.style import has_directional_sky, tint_table

COMPARED_SHADE_COUNT = 4096
"""Number of shades, from black to the brightest ground in shadow, that are compared. The table that encodes sRGB has as many
entries.
"""


INTERPOLATION_MARGIN_NODES = 4
"""Number of nodes beyond a map's edge that interpolation may read, also at the next coarser level of the pyramid."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: ground hides so much of the sky from visible surfaces that the brightest ground in shadow gets darker by more than a
    step of 255.

    Left out: level ground, shallow valleys, a dark night.
    """
    facts = descriptor.facts["sky_view"]
    if facts.get("is_in_sky_light"):
        return Verdict(False, "sky_light already accounts for it")
    if not facts:
        return Verdict(False, "the level is not on the earth, so the light of its sky is unknown")
    hidden_share, darkening_steps = facts["hidden"], facts["steps"]
    assert isinstance(hidden_share, float) and isinstance(darkening_steps, float)
    if hidden_share == 0.0:
        return Verdict(False, "open sky: no ground rises above the ground in view")
    text = f"ground hides up to {100.0 * hidden_share:.2g} % of the sky and darkens surfaces lit by the sky alone by "
    return (
        Verdict(True, f"{text}{darkening_steps:.0f} steps of 255")
        if darkening_steps > 1
        else Verdict(False, f"{text}at most one step of 255")
    )


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of the sky view. The result is empty for other celestial bodies than the Earth.

    - ``hidden``: maximum share of the sky that ground hides from any visible ground. A map uses means over its pixels.
    - ``steps``: number of steps of 1/255 by which this hidden share darkens the brightest ground in shadow.
    - ``is_in_sky_light``: present if the style's own sky accounts for the hidden share.
    """
    if isinstance(view, MapView) and has_directional_sky(scene.style):
        return {"hidden": 0.0, "steps": 0.0, "is_in_sky_light": True}
    if not scene.world.is_on_earth:
        return {}
    low, high = scene.height_range_m
    if high <= low:
        return {"hidden": 0.0, "steps": 0.0}
    hidden_sky = sky_view(scene.elevation, scene.world)
    if isinstance(view, MapView):
        hidden = _max_hidden_in_map(scene, view, hidden_sky)
    else:
        hidden = 0.0 if coarse_view is None else _max_hidden_in_view(hidden_sky, coarse_view)
    return {"hidden": hidden, "steps": float(max_darkening_steps(max_sky_lit_color(scene, view), hidden))}


def _max_hidden_in_map(scene: Scene, view: MapView, hidden_sky: SkyView) -> float:
    """Return the maximum share of the sky that ground hides from a map's ground.

    It is the maximum over all nodes that the map's pixels are interpolated from. ``hidden_sky`` holds the hidden shares at nodes.
    """
    cells, (means, table) = visible_cells(scene.elevation, view), hidden_sky.mean_pyramid
    if cells is None:
        return 0.0
    fractional_level = _pyramid_level(scene, view, hidden_sky)
    number = min(int(fractional_level), len(table) - 1)
    level_values, margin = _pyramid_values(means, table, number), INTERPOLATION_MARGIN_NODES if fractional_level > 0.0 else 1
    return float(level_values[block_slices(cells, 2 ** (hidden_sky.lod + number), level_values.shape, margin)].max())


def max_darkening_steps(max_light: float, hidden_share: float) -> int:
    """Return the maximum number of steps of 1/255 by which a colour darkens if the share ``hidden_share`` of its light is lost.

    The colours are all linear values up to ``max_light``.
    """
    shades = np.linspace(0.0, max_light, COMPARED_SHADE_COUNT)
    return int((encode_srgb(shades).astype(int) - encode_srgb(shades * (1.0 - hidden_share))).max())


def max_sky_lit_color(scene: Scene, view: MapView | PerspectiveView) -> float:
    """Return the maximum linear colour, over all channels, of a surface that only sky light reaches, from the whole sky.

    The surface has the brightest tint of the ground, or is white if the level has objects, imagery or snow.
    """
    level = scene.loaded.level
    plain = scene.objects.caster_kinds == ("relief",) and level.terrain.imagery is None and not level.weather.snow
    style, desaturation = scene.style, shading_parameters(scene, view).sky_light_desaturation
    albedo = _max_sky_lit_albedo(style.ramp, style.has_latitude_tints, desaturation) if plain else np.ones(3)
    night = night_sky_share(scene)
    day = 0.0 if scene.highest_sun_deg is None else float(twilight_sky_share(np.sin(np.radians(scene.highest_sun_deg))))
    return float((albedo * daylight_of(scene).sky_irradiance).max()) * max_slope_sky_factor(scene) * (night + (1.0 - night) * day)


@cached("process", MIB)
def _max_sky_lit_albedo(ramp: ColorRamp, has_latitude_tints: bool, desaturation: float) -> np.ndarray:
    """Return the largest linear albedo (3,) of a ramp's tints as they appear in sky light (``sky_lit_albedo``), by channel."""
    return np.asarray(sky_lit_albedo(tint_table(ramp, has_latitude_tints).reshape(-1, 3), desaturation).max(axis=0))


def _pyramid_level(scene: Scene, view: MapView, hidden_sky: SkyView) -> float:
    """Return the fractional level of the pyramid of hidden shares at which nodes are as far apart as a map's pixels; 0 or more."""
    return max(float(np.log2(map_pixel_m(scene.world, view) / hidden_sky.node_spacing_m)), 0.0)


def _pyramid_values(values: np.ndarray, table: np.ndarray, number: int) -> np.ndarray:
    """Return the level ``number`` (rows, cols) of a pyramid, or its last level if it has fewer.

    ``values`` holds all levels, ``table`` the first index, rows and columns of each.
    """
    begin, rows, cols = table[min(number, len(table) - 1)]
    return values[begin : begin + rows * cols].reshape(rows, cols)


def _max_hidden_in_view(hidden_sky: SkyView, coarse_view: CoarseView) -> float:
    """Return the maximum share of the sky that ground hides from the visible ground of a perspective view.

    Round each point of the coarse view the maximum is searched within the distance to the neighbouring points.
    """
    buffer = coarse_view.buffer
    if not buffer.valid.any():
        return 0.0
    nodes = sky_view_nodes(hidden_sky, buffer.frame, buffer.position_frame_m, buffer.height_m)
    radius = np.zeros(buffer.valid.shape)
    for axis in (0, 1):
        spacing = np.linalg.norm(np.diff(nodes, axis=axis), axis=-1)
        previous_spacing, next_spacing = (np.insert(spacing, position, np.nan, axis=axis) for position in (0, spacing.shape[axis]))
        # Use the nearer of two neighbours, since the other one may lie beyond a skyline, in another valley.
        radius = np.fmax(radius, np.fmin(previous_spacing, next_spacing))
    highest, table = hidden_sky.max_pyramid
    has_node = buffer.valid & np.isfinite(nodes[..., 0])
    return float(_max_around_nodes(highest, table, nodes[has_node], radius[has_node]))


@compiled
def _max_around_nodes(values, table, nodes, radius):
    """Return the maximum of the values within the radius ``radius`` (n,) round any of the positions ``nodes`` (n, 2).

    ``values`` and ``table`` are a pyramid of maxima. A circle is covered by 3 x 3 cells of the level whose cells are at least as
    wide as its radius. Both arguments are in nodes of the finest level.
    """
    largest = 0.0
    for n in range(len(nodes)):
        number = min(max(int(np.ceil(np.log2(max(radius[n], 1.0)))), 0), len(table) - 1)
        begin, rows, cols = table[number]
        side = 2.0**number
        row, col = int(np.floor((nodes[n, 0] + 0.5) / side)), int(np.floor((nodes[n, 1] + 0.5) / side))
        for r in range(max(row - 1, 0), min(row + 2, rows)):
            for c in range(max(col - 1, 0), min(col + 2, cols)):
                largest = max(largest, values[begin + r * cols + c])
    return largest


def apply_sky_view(skylight: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the sky light of each point by its sky-view factor."""
    skylight *= _sky_view_factors(block)


def _cache_key(block: ShadingBlock) -> tuple[object, ...]:
    """Return the cache key of ``_sky_view_factors``: the buffer's points and the level's ground."""
    return block.buffer.position_frame_m, block.scene.elevation


@cached("scene", 64 * MIB, key=_cache_key, max_entries=1)
def _sky_view_factors(block: ShadingBlock) -> np.ndarray:
    """Return the sky-view factor of each pixel (rows, cols), float64. It does not depend on the sun."""
    buffer, scene = block.buffer, block.scene
    hidden_sky = sky_view(scene.elevation, scene.world)
    eye, tangent, width_m = pixel_size(block)
    nodes = sky_view_nodes(hidden_sky, buffer.frame, buffer.position_frame_m, buffer.height_m)
    out = np.ones(buffer.valid.shape)
    run_in_chunks(
        len(out), _write_factors, out, nodes, buffer.position_frame_m, *hidden_sky.mean_pyramid, eye,
        tangent / hidden_sky.node_spacing_m,
        width_m / hidden_sky.node_spacing_m
    )  # fmt: skip
    return out


@compiled
def _write_factors(first, last, out, nodes, position, values, table, eye, tangent, width):
    """Write the sky-view factors of the rows from ``first`` to ``last`` (exclusive) to ``out``.

    In perspective a pixel is ``tangent`` nodes wide per metre of distance from the eye. In a map it is ``width`` nodes wide.
    """
    mip_level = finest_level = mip_pair(table, width)
    for i in range(first, last):
        for j in range(out.shape[1]):
            row, col = nodes[i, j, 0], nodes[i, j, 1]
            if not (np.isfinite(row) and np.isfinite(col)):
                continue
            if tangent > 0.0:
                x, y, z = position[i, j, 0] - eye[0], position[i, j, 1] - eye[1], position[i, j, 2] - eye[2]
                pixel_nodes = tangent * np.sqrt(x * x + y * y + z * z)
                mip_level = finest_level if pixel_nodes <= 1.0 else mip_pair(table, pixel_nodes)  # in perspective ``width`` is 0
            out[i, j] = 1.0 - sky_occlusion_at(values, mip_level, row, col)


EFFECT = Effect("sky-view factor: less sky light in valleys", judge, facts, "skylight", apply_sky_view)
