"""`shadow_map`: depth maps as a light sees the casters. The sun's is orthographic and follows what is looked at; a spot's is a
perspective one, an omni light's six of them.

**Window of the sun's map.** In light space (x right, y up, z away from the sun, metres from the level's anchor) the map covers the
block's receivers and a border, its corner on the lattice of texels and depth steps counted from the anchor. Texel size
and depth step are the plan's, one for all blocks of a level, zoom and sun; only the number of texels follows the block.
Depth spans the receivers. Casters before it are clamped to depth 0: they are before every receiver. Casters beyond the
last receiver cannot shade anything.

That is the fit ``stable``: whole-pixel shifts of a view change no texel. With ``tight`` the window and the depths are the bounds
of this block's receivers, as finely as the map's size allows (never more coarsely than the stable ones), and move with the view.

**Kept maps.** A perspective view's map that was drawn from the very same geometry, light, window and settings is looked up again
(``terrain.gl.depth_targets`` says how many are held). Map views' are not: their blocks' pictures are kept instead.

**Cascades.** In perspective there may be several maps, each for the receivers at some distances from the eye, with texels of
its own. A point belongs to one of them alone.

**Window of a lamp's map.** It covers the spot's cone, or a sixth of the sphere, and a border of texels. Depth lies between the
nearest and the farthest receiver; what is nearer casts as well, clamped to depth 0.

**Comparison.** The map holds depths at texel centres, so a receiver is held against a surface point beside it: half a texel
away along each axis, (n/2) t with n taps a side (t: the texel's side; 1/128 more for the rasteriser's grid of 1/256). Two
ways keep a surface from shading itself (bias ``receiver_plane``; with ``normal_offset`` the second is the only one, and takes all
n taps):

1. *On a triangle that is known.* If the texel's centre falls, as the light sees it, into one of the six triangles round the
   receiver's nearest node that face the sun (a map's ground) or into the receiver's own triangle (everything else), the depth
   of that very triangle there is what the map holds unless something else is nearer. It is compared as it is: no bias at all,
   at any slope. Taps whose centre falls beside these triangles do not count, unless all of them do.
2. *Beside them* (coarse maps, surfaces that the light grazes) the receiver is moved along its normal instead. With unit
   normal (nx, ny, nz) in light space, depth on its plane changes by |nx/nz| and |ny/nz| per metre, so the texel's centre lies
   up to (dx |nx| + dy |ny|) / |nz| nearer. Moving by b gains a clearance of b / |nz| along the ray, so b = dx |nx| + dy |ny|
   is exactly enough at every slope, and never more than d times the root of 2, where a bias in depth would grow without
   bound. (For t = tx = ty this is the k t sin(theta) of the tables of slope-scaled offsets.)
   The centre may lie on a neighbouring triangle of unit normal m, with |m - n| at most the buffer's ``crease`` c. For it
   dx |mx| + dy |my| <= dx |nx| + dy |ny| + |d| c, and n.m >= 1 - c^2 / 2, hence

       b = (dx |nx| + dy |ny| + |d| c) / (1 - c^2 / 2),

   the divisor held above 1/4, so that b stays below 8 texels even on a knife edge. For a lamp dx and dy are the texel's
   sides at the receiver's distance: a step (dx, dy, 0) aside leaves a plane by at most the same sum.

A third way, ``polygon_offset``, is there to show what it costs: depths are drawn glPolygonOffset(1.1, 4) farther and points
looked up as they are. A slope's texel centres lie up to (n/2) t (|dz/dx| + |dz/dy|), at most n times t max(|dz/dx|, |dz/dy|),
nearer than the point: the factor has to be n, and 1.1 is enough for one tap alone. ``bias_scale`` multiplies whichever it is.

Constants remain: e for float32 positions (8 units in the last place of the coordinates' extent), half a depth step and e for
the map's rounding, and on a known triangle the slope times (t/128 + e) for the rasteriser's grid.

**Filter.** n taps a side are weighted by what of each texel lies in the square of n - 1 texels round the point (n = 2: bilinear),
so that visibility is the lit share of that square, centred on the point. One tap is the texel that holds it.
Beside the known triangles two taps a side are taken at most: a point moved clear of all that more taps would see is moved
past what touches its surface.

**The sun's disc** (filter ``sun``). Each texel that holds something before the receiver is seen from there as a rectangle, at the
distance that it holds (Guennebaud, Barthe and Paulin 2006, "Real-time soft shadow mapping by backprojection"), and covers those of
128 samples of the disc that lie in it, which a bit each remembers, so that nothing is counted twice (Schwarz and Stamminger 2007,
"Bitmask soft shadows"). With r the disc's radius, something s metres before the receiver matters up to s tan r beside it in the
map. That bounds the search; blocks of texels whose least depth is known bound it more tightly. Cells of several texels are
taken where the disc would be wider than 16 of them, and it is never taken for wider than 128 texels. A texel reaches to its
neighbours, where those cover something too, so that no light falls between the depths of one surface.

    A surface does not shade itself: a plane with slope m in depth has s = m d at d beside the receiver and covers a part of the
    disc if m tan r > 1 alone, where it really does hide that part; those samples are found by the normal instead. But a
    texel is half a texel wide to either side, hence this holds from s tan r = t/2 on. Nearer things, across which the disc is
    narrower than a texel, are compared as above with three taps, the samples spread over a texel's radius, so that edges have no
    stairs. Between t/2 and t both are done.

The map knows the nearest caster alone: what lies behind it and would show beside it is not seen.

**Culling.** With ``front`` the faces towards the light of bodies that are closed, facing outwards, are not drawn: their back faces
throw the same shadow, and lie a whole body behind the lit ones. Everything else is drawn as it is.

**Foliage** is alpha-tested with the mipmap of its footprint in the map, which keeps its coverage.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from shadows.algorithm import Accuracy, Algorithm, AlgorithmSettings, Cost, Mark, Search, SettingsRequest
from shadows.maps.drawing import depths, draw_map
from shadows.maps.lookup import look_up
from shadows.maps.resolve import TUNED_SIZES, calibrated_maps, resolve_shadow_map
from shadows.maps.settings import LampMapSettings, ShadowMapSettings
from shadows.maps.sun_disc import nearest_caster_m
from shadows.maps.texels import shadow_map_texel_m, shadow_map_texel_px
from shadows.maps.windows import DepthMap, lamp_map, sun_maps
from shadows.maps.work import shadow_map_work
from shadows.passes import PassLog
from terrain.casters.casting import anything_casts, caster_trees
from terrain.casters.reach import Casters
from terrain.facts.descriptor import Descriptor
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gl.device import device
from terrain.level.level import SUN, CasterKind, Shadows
from terrain.scene import Scene

PASSES = ("depth map", "visibility")


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: ShadowMapSettings | LampMapSettings,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32 in [0, 1], for a buffer's points past some kinds of casters.

    Where there is no surface, or one that is turned away from the light, the value means nothing. Raises ``GraphicsError``.
    """
    depth_pass, visibility_pass = log.named(light, kinds, PASSES)
    trees = caster_trees(buffer, kinds)
    maps: list[DepthMap] = []
    with log.run(depth_pass):  # fitting a map is part of making it
        if not anything_casts(scene, buffer, kinds):
            pass
        elif isinstance(settings, ShadowMapSettings):
            nearest_m = nearest_caster_m(scene, buffer, kinds, casters, trees) if settings.filter == "sun" else np.inf
            maps = sun_maps(buffer, scene, settings, trees, nearest_m)
        elif (lit := lamp_map(buffer, scene.lamps[light], settings, trees)) is not None:
            maps = [lit]
    if not maps:  # no casters, or no receivers
        with log.run(visibility_pass):
            return np.ones(buffer.there.shape, np.float32)
    gl = device()
    visibility = np.ones(buffer.there.shape, np.float32)
    for drawn in maps:
        with log.run(depth_pass) as record:
            target = draw_map(gl, drawn, buffer, scene, kinds, casters, settings, record)
        log.keep("shadow-map", light, depths, gl, drawn, target)
        with log.run(visibility_pass) as record:
            look_up(gl, drawn, target, buffer, settings, visibility, record)
    return visibility


def _tunes(descriptor: Descriptor, light: str, key: str, value: int) -> bool:
    """Whether there are as many cascades: under the sun, in a perspective view of as many bands of distance."""
    return key != "cascades" or (light == SUN and value <= len(descriptor.bands))


def _calibrated(descriptor: Descriptor, light: str, grid: str) -> Iterator[AlgorithmSettings | None]:
    """Sizes, cascades and taps, as far as the grid goes."""
    asked = calibrated_maps(descriptor, light, grid)
    for overrides in [*asked.sizes, *(CALIBRATED_CASCADES if descriptor.bands and light == SUN else ()), *asked.filters]:
        yield resolve_shadow_map(SettingsRequest(descriptor, light, Shadows(**{"filter": 3, "cascades": 1} | overrides)))[0]


CALIBRATED_CASCADES: tuple[dict[str, Any], ...] = (
    {"map_size": 1024, "cascades": 2}, {"map_size": 1024, "cascades": 4}, {"map_size": 2048, "cascades": 4},
)  # fmt: skip

MIDDLE = {"map_size": 1024, "filter": 1}
VARIANTS: tuple[dict[str, Any], ...] = tuple(MIDDLE | change for change in (
    {"cascades": 1}, {"cascades": 2}, {"cascades": 4}, {"filter": "sun"}, {"filter": 5}, {"depth_bits": 16}, {"depth_bits": 24},
    {"depth_bits": 32}, {"bias": "normal_offset"}, {"bias": "polygon_offset"}, {"fit": "tight"}, {"culling": "front"},
))  # fmt: skip
"""What the report turns one at a time, from a map of the middle's settings."""

ALGORITHM = Algorithm(
    name="shadow_map",
    about="depth map from the light, which follows what is looked at",
    plural="shadow maps",
    fill=fill,
    passes=PASSES,
    layers=("shadow-map",),
    settings=(ShadowMapSettings, LampMapSettings),
    resolve=resolve_shadow_map,
    keeps=("terrain.gl.depth_targets", "shadows.maps.sun_disc.samples_before_edges"),
    search=Search(
        tuned={"map_size": TUNED_SIZES, "cascades": (1, 2, 4)},
        tunes=_tunes,
        compared=tuple({"map_size": size, "filter": taps} for size, taps in product((2048, 1024, 4096, 512), (1, 3))),
        variants=VARIANTS,
    ),
    cost=Cost(shadow_map_work, calibrated=_calibrated),
    accuracy=Accuracy(texel_px=shadow_map_texel_px, texel_m=shadow_map_texel_m),
    mark=Mark("circle", "blue"),
)
