"""`shadow_map` for the sun: an orthographic depth map that follows what is looked at.

**Window.** In light space (x right, y up, z away from the sun, metres from the level's anchor) the map covers the
block's receivers and a border, its corner on the lattice of texels and depth steps counted from the anchor. Texel size
and depth step are the plan's, one for all blocks of a level, zoom and sun; only the number of texels follows the block.
Depth spans the receivers. Casters before it are clamped to depth 0: they are before every receiver. Casters beyond the
last receiver cannot shade anything.

**Comparison.** The map holds depths at texel centres, so a receiver is held against a surface point beside it: half a texel
away along each axis, (n/2) t with n taps a side (t: the texel's side; 1/128 more for the rasteriser's grid of 1/256). Two
ways keep a surface from shading itself:

1. *In the ring.* If the texel's centre falls, as the sun sees it, into one of the six triangles round the receiver's nearest
   node that face the sun, the depth of that very triangle there is what the map holds unless something else is nearer. It is
   compared as it is: no bias at all, at any slope.
   Taps whose centre falls beside the ring do not count, unless all of them do.
2. *Beside the ring* (coarse maps, surfaces that the sun grazes) the receiver is moved along its normal instead. With unit
   normal (nx, ny, nz) in light space, depth on its plane changes by |nx/nz| and |ny/nz| per metre, so the texel's centre lies
   up to (dx |nx| + dy |ny|) / |nz| nearer. Moving by b gains a clearance of b / |nz| along the ray, so b = dx |nx| + dy |ny|
   is exactly enough at every slope, and never more than d times the root of 2, where a bias in depth would grow without
   bound. (For t = tx = ty this is the k t sin(theta) of the tables of slope-scaled offsets.)
   The centre may lie on a neighbouring triangle of unit normal m, with |m - n| at most the buffer's ``crease`` c. For it
   dx |mx| + dy |my| <= dx |nx| + dy |ny| + |d| c, and n.m >= 1 - c^2 / 2, hence

       b = (dx |nx| + dy |ny| + |d| c) / (1 - c^2 / 2),

   the divisor held above 1/4, so that b stays below 8 texels even on a knife edge.

Constants remain: e for float32 positions (8 units in the last place of the coordinates' extent), half a depth step and e for
the map's rounding, and in the ring the slope times (t/128 + e) for the rasteriser's grid.
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from shadows.passes import PassLog
from shadows.plan import ShadowMapSettings
from terrain.geometry import GeometryBuffer
from terrain.gl import device
from terrain.light_space import light_bounds
from terrain.reach import Casters, caster_sheets
from terrain.scene import Scene
from terrain.surface import sheet_triangles

DEPTH_PASS = "sun/relief: depth map"
VISIBILITY_PASS = "sun/relief: visibility"
PASSES = (DEPTH_PASS, VISIBILITY_PASS)

BORDER_TEXELS = 12
"""Texels round the receivers: the bias moves lookups by up to 8, taps by up to 2."""

SIZE_STEP = 64
"""Maps are allocated in multiples of this, so that blocks of one level share them."""


def fill(buffer: GeometryBuffer, scene: Scene, casters: Casters, settings: ShadowMapSettings, log: PassLog) -> np.ndarray:
    """Visibility of the sun (rows, cols), float32 in [0, 1], for a buffer's points past the relief.

    Where there is no surface the value means nothing. Raises ``GraphicsError``.
    """
    assert scene.light is not None
    rows, cols = buffer.there.shape
    if not buffer.there.any():
        with log.run(DEPTH_PASS), log.run(VISIBILITY_PASS):
            return np.ones((rows, cols), np.float32)
    rotation, translation = scene.light.from_frame(buffer.frame)
    low, high = light_bounds(buffer.position_frame_m, buffer.there, rotation, translation)
    texel = np.array(settings.texel_m)
    gl = device()
    first, size = _window(low, high, texel)
    for axis in (0, 1):  # a block wider than the plan foresaw gets coarser texels, not a map that no device holds
        while size[axis] > min(gl.max_size, 2 * settings.map_size + 4 * BORDER_TEXELS + SIZE_STEP):
            texel[axis] *= 2.0
            first, size = _window(low, high, texel)
    extent_m = float(np.abs(buffer.position_frame_m[buffer.there]).max() + np.abs(high - low).max())
    error_m = 8.0 * np.finfo(np.float32).eps / 2 * extent_m
    step_m = settings.depth_step_m
    before_m = 4.0 * (error_m + step_m) + BORDER_TEXELS * float(texel.max())  # keeps receivers clear of depth 0
    steps = 2**16 - 1 if settings.depth_bits == 16 else 2**24 - 1
    near = np.floor((low[2] - before_m) / (step_m * 256)) * 256 * step_m
    while near + steps * step_m < high[2]:  # a block deeper than the plan foresaw keeps its depths, more coarsely
        step_m *= 2.0
        near = np.floor((low[2] - before_m) / (step_m * 256)) * 256 * step_m
    window_m = np.array([*(size * texel), steps * step_m])
    uniforms = {
        "light_from_frame": tuple(rotation.T.ravel()),  # GLSL matrices are column by column
        "light_offset_m": tuple(translation - np.array([*(first * texel), near])),
        "window_m": tuple(window_m),
    }

    with log.run(DEPTH_PASS) as record:
        target = gl.depth_target(int(size[0]), int(size[1]), settings.depth_bits)
        program = gl.program(_shader("depth.vert"), _shader("depth.frag"))
        _set(program, uniforms)
        with gl.depth_pass(target):
            largest = 0
            for sheet in caster_sheets(scene, buffer, casters):
                record.triangles += gl.draw_sheet(program, sheet)
                record.draws += 1
                largest = max(largest, sheet[..., 0].size * 12 + sheet_triangles(*sheet.shape[:2]).nbytes)
        record.map_texels += int(size[0] * size[1])
        map_bytes = int(size[0] * size[1]) * (2 if settings.depth_bits == 16 else 4)
        record.bytes = max(record.bytes, map_bytes + largest)
        gl.check(DEPTH_PASS)

    with log.run(VISIBILITY_PASS) as record:
        program = gl.program(_shader("pixels.vert"), _shader("shadow_map.frag"))
        _set(program, uniforms)
        view, window = buffer.view, buffer.surface
        _set(program, {
            "position_frame_m": 0, "normal_frame": 1, "node_frame_m": 2, "depth_map": 3, "texel_m": tuple(texel),
            "map_size": tuple(int(v) for v in size), "taps": settings.filter, "bias_scale": settings.bias_scale,
            "first_node": (view.col0 - window.col0, view.row0 - window.row0), "node_step": (view.col_step, view.row_step),
            "error_m": error_m, "step_m": step_m,
        })  # fmt: skip
        facing = np.concatenate([buffer.normal_frame, buffer.crease[..., None]], axis=-1)
        textures = [gl.texture(array) for array in (buffer.position_frame_m, facing, window.position_frame_m)]
        for unit, texture in enumerate((*textures, target.depth_attachment)):
            texture.use(unit)
        visible = gl.float_target(cols, rows)
        gl.draw_pixels(program, visible)
        record.draws += 1
        visibility = gl.read(visible)
        held = sum(texture.width * texture.height * texture.components * 4 for texture in textures)
        record.bytes = max(record.bytes, map_bytes + held + visibility.nbytes)
        for texture in textures:
            texture.release()
    return visibility


def _window(low: np.ndarray, high: np.ndarray, texel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First texel and size in texels of the map over light bounds, on the lattice counted from the anchor."""
    first = np.floor(low[:2] / texel).astype(np.int64) - BORDER_TEXELS
    size = np.floor(high[:2] / texel).astype(np.int64) + 1 + BORDER_TEXELS - first
    return first, -(-size // SIZE_STEP) * SIZE_STEP


def _set(program, values: dict) -> None:  # type: ignore[no-untyped-def]
    for name, value in values.items():
        program[name] = value


def _shader(name: str) -> str:
    return files("shadows").joinpath("shaders", f"{name}.glsl").read_text(encoding="utf-8")
