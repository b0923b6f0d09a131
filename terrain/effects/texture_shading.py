"""Texture shading: in maps, ridges receive more of the sky's light and valleys less, so that relief inside shadow stays readable.

**Rendering.** The sky light of ground in a map is multiplied by ``1 + strength * tanh(GAIN * texture / pixel)``. The texture is the
fractional Laplacian of the heights at the map's pixels, or at the raster's cells if these are larger
(``skugga.terrain.ground.texture``). It has no direction, so it also shows
ridges that run along the sun's rays. Shadows and direct light do not change. Buildings and trees keep their light.

**Predicate.** The texture of a pixel is at most a constant times the steepest slope, by the triangle inequality. The effect is not
needed if that bound darkens no surface that only the sky lights by more than a step of 255.
"""

from __future__ import annotations

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.effects.effect import Effect, ShadingBlock, Verdict
from skugga.terrain.effects.sky_view import max_darkening_steps, max_sky_lit_color
from skugga.terrain.facts.coarse_view import CoarseView
from skugga.terrain.facts.descriptor import Descriptor
from skugga.terrain.facts.fact_types import Fact
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.geo.grid import MapView
from skugga.terrain.ground.surface import Surface, map_pixel_m
from skugga.terrain.ground.texture import RADIUS_NODES, max_texture_per_slope, relief_texture
from skugga.terrain.scene import Scene

HEIGHT_STEP_SHARE = 1.0 / 128.0
"""Step to which heights are rounded, as a share of the distance between nodes: it changes light by at most 1 %."""

MAX_PIXELS_PER_NODE = 1024
"""Largest number of pixels from one node of the texture to the next: nothing is seen of cells that are larger."""

GAIN = 5.0
"""Factor of the texture per pixel. Natural relief, with a root mean square of 0.05 to 0.15, reaches 0.2 to 0.6 of the strength."""


def judge(descriptor: Descriptor) -> Verdict:
    """Return whether the effect is needed, with the reason.

    Needed: a map in the styles ``natural``, ``swiss`` and ``grey``, unless the steepest slope is so gentle that the change is at
    most a step of 255.

    Left out: perspective views; other styles; plains.
    """
    if descriptor.view_kind != "map":
        return Verdict(False, "a perspective view, not a map")
    strength, exaggeration, brightest = (
        descriptor.facts["texture_shading"][key] for key in ("strength", "exaggeration", "sky_lit")
    )
    assert isinstance(strength, float) and isinstance(exaggeration, float) and isinstance(brightest, float)
    if strength == 0.0:
        return Verdict(False, "the style has no texture shading")
    slope = float(np.tan(np.radians(descriptor.highest_slope_deg)))
    change = strength * float(np.tanh(GAIN * exaggeration * max_texture_per_slope() * slope))
    steps = max_darkening_steps(brightest, change)
    text = f"ridges and valleys change the sky's light by up to {100.0 * change:.2g} %: "
    return Verdict(True, f"{text}{steps} steps of 255") if steps > 1 else Verdict(False, f"{text}at most one step of 255")


def facts(scene: Scene, view: MapView | PerspectiveView, coarse_view: CoarseView | None) -> dict[str, Fact]:
    """Return the facts of texture shading.

    - ``strength``: maximum share by which the style changes the sky's light.
    - ``exaggeration``: the style's factor of slopes in this map; 1 in a perspective view.
    - ``sky_lit``: the brightest linear colour of ground that only the sky lights.
    """
    exaggeration = scene.style.slope_exaggeration_at(map_pixel_m(scene.world, view)) if isinstance(view, MapView) else 1.0
    return {
        "strength": float(scene.style.texture_strength),
        "exaggeration": exaggeration,
        "sky_lit": max_sky_lit_color(scene, view),
    }


def apply_texture_shading(skylight: np.ndarray, block: ShadingBlock) -> None:
    """Multiply the sky light of a map's ground by its texture factor. Samples of a pixel get the factor of the pixel.

    A perspective view does not change.
    """
    if not isinstance(block.view, MapView):
        return
    factor = texture_factor(block.scene, block.view)
    is_ground = block.buffer.surface_kind == RELIEF
    own_rows = slice(0, block.view.rows)
    np.multiply(skylight[own_rows], factor, out=skylight[own_rows], where=is_ground[own_rows])
    if len(skylight) > block.view.rows:
        row, col = np.nonzero(is_ground[block.view.rows :])
        row += block.view.rows
        skylight[row, col] *= factor[block.pixels_of_points(row, col)]


def _cache_key(scene: Scene, view: MapView) -> tuple[object, ...]:
    """Return the cache key of ``texture_factor``: its result does not depend on the sun."""
    return scene.world, scene.elevation, view, scene.style.texture_strength, scene.style.slope_exaggeration


@cached("scene", 96 * MIB, key=_cache_key)
def texture_factor(scene: Scene, view: MapView) -> np.ndarray:
    """Return the factor of sky light in each pixel of a map, float32 (rows, cols); 1 without ground."""
    style, pixel_m = scene.style, map_pixel_m(scene.world, view)
    pixels_per_node = _pixels_per_node(scene, pixel_m)
    lattice, first_pixel = (view, (0.0, 0.0)) if pixels_per_node == 1 else view.coarser_nodes(pixels_per_node, margin=1)
    nodes = lattice.with_pixels_as_nodes()
    heights = Surface(scene.world, scene.elevation, nodes.grid).height_window(
        int(nodes.row0) - RADIUS_NODES, int(nodes.col0) - RADIUS_NODES, nodes.rows + 2 * RADIUS_NODES,
        nodes.cols + 2 * RADIUS_NODES,
    )  # fmt: skip
    node_m = pixel_m * pixels_per_node
    texture = relief_texture(heights.height_m, HEIGHT_STEP_SHARE * node_m)
    if pixels_per_node > 1:
        from scipy.ndimage import affine_transform

        scale, start = 1.0 / pixels_per_node, [-first / pixels_per_node for first in first_pixel]
        texture = affine_transform(texture, [scale, scale], start, (view.rows, view.cols), order=2, mode="nearest", prefilter=False)
    texture *= np.float32(GAIN * style.slope_exaggeration_at(pixel_m) / node_m)
    return np.float32(1.0) + np.float32(style.texture_strength) * np.tanh(texture, out=texture)


def texture_margin_px(scene: Scene, view: MapView) -> int:
    """Return how far from a map's pixels the ground changes their texture, pixels."""
    return (RADIUS_NODES + 3) * _pixels_per_node(scene, map_pixel_m(scene.world, view))


def _pixels_per_node(scene: Scene, pixel_m: float) -> int:
    """Return how many pixels lie between two nodes of the texture, a power of two: 1 unless pixels are smaller than cells.

    Between the cells of a raster the ground is interpolated. The texture of its pixels would show the bends at the cells' edges.
    """
    elevation = scene.elevation
    cell_m = max(elevation.cell_size_m(scene.world.metres_per_unit), elevation.resolution_m or 0.0)
    return int(2 ** np.clip(np.rint(np.log2(cell_m / pixel_m)), 0.0, np.log2(MAX_PIXELS_PER_NODE)))


EFFECT = Effect(
    "texture shading: in maps, more sky light on ridges, less in valleys", judge, facts, "skylight", apply_texture_shading
)
