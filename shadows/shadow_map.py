"""`shadow_map`: depth maps as a light sees the casters. The sun's is orthographic and follows what is looked at; a spot's is a
perspective one, an omni light's six of them.

**Window of the sun's map.** In light space (x right, y up, z away from the sun, metres from the level's anchor) the map covers the
block's receivers and a border, its corner on the lattice of texels and depth steps counted from the anchor. Texel size
and depth step are the plan's, one for all blocks of a level, zoom and sun; only the number of texels follows the block.
Depth spans the receivers. Casters before it are clamped to depth 0: they are before every receiver. Casters beyond the
last receiver cannot shade anything.

**Cascades.** In perspective there may be several maps, each for the receivers at some distances from the eye, with texels of
its own. A point belongs to one of them alone.

**Window of a lamp's map.** It covers the spot's cone, or a sixth of the sphere, and a border of texels. Depth lies between the
nearest and the farthest receiver; what is nearer casts as well, clamped to depth 0.

**Comparison.** The map holds depths at texel centres, so a receiver is held against a surface point beside it: half a texel
away along each axis, (n/2) t with n taps a side (t: the texel's side; 1/128 more for the rasteriser's grid of 1/256). Two
ways keep a surface from shading itself:

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

Constants remain: e for float32 positions (8 units in the last place of the coordinates' extent), half a depth step and e for
the map's rounding, and on a known triangle the slope times (t/128 + e) for the rasteriser's grid.

**Filter.** n taps a side are weighted by what of each texel lies in the square of n - 1 texels round the point (n = 2: bilinear),
so that visibility is the lit share of that square, centred on the point. One tap is the texel that holds it.
Beside the known triangles two taps a side are taken at most: a point moved clear of all that more taps would see is moved
past what touches its surface.

**Foliage** is alpha-tested with the mipmap of its footprint in the map, which keeps its coverage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from moderngl import Framebuffer, Program

from shadows.passes import PassLog, PassRecord
from shadows.plan import Cascade, LampMapSettings, ShadowMapSettings
from terrain.casting import caster_meshes, caster_sheets, caster_trees, trees_in_the_way
from terrain.compiled import compiled
from terrain.foliage import THRESHOLD, foliage
from terrain.geometry import GeometryBuffer
from terrain.gl import Device, device
from terrain.grid import MapView
from terrain.level import CasterKind
from terrain.light_space import light_bounds
from terrain.lights import Lamp
from terrain.reach import Casters
from terrain.scene import Scene
from terrain.stand import Stand
from terrain.surface import sheet_triangles
from terrain.visible import set_uniforms, shader

PASSES = ("depth map", "visibility")

BORDER_TEXELS = 12
"""Texels round the receivers: the bias moves lookups by up to 8, taps by up to 2."""

SIZE_STEP = 64
"""Maps are allocated in multiples of this, so that blocks of one level share them."""

LOOK_COLS, LOOK_ROWS = 2048, 384
"""Points of a perspective view that are looked up side by side, and one below the other: 50 MB of textures."""

MAP_UNIT = 4
"""Texture unit of the depth map."""

POSITION_ERROR = 4.0 * float(np.finfo(np.float32).eps)
"""Bound of what float32 makes of positions, as a share of the coordinates' extent: 8 units in the last place."""

NEAREST_SHARE = 1e-4
"""The nearest receiver of a lamp counts as no nearer than this share of the farthest one's distance."""

CUBE = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 0, -1], [0, 1, 0], [1, 0, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], [[1, 0, 0], [0, 0, -1], [0, 1, 0]], [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
], np.float64)  # fmt: skip
"""Rotations from an omni light's axes to those of its six maps: forward, right, left, back, down, up."""


@dataclass(frozen=True, eq=False)
class _Map:
    """A depth map to be drawn: its uniforms, the texels of a face, its faces' rotations, and trees, and in
    perspective the points that it is for (flat indices).
    """

    uniforms: dict
    size: tuple[int, int]
    faces: tuple[np.ndarray, ...]
    depth_bits: int
    near_trees: Stand | None
    pixels: np.ndarray | None

    @property
    def texels(self) -> int:
        return self.size[0] * self.size[1] * len(self.faces)

    @property
    def nbytes(self) -> int:
        return self.texels * (2 if self.depth_bits == 16 else 4)


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

    Where there is no surface the value means nothing. Raises ``GraphicsError``.
    """
    depth_pass, visibility_pass = log.named(light, kinds, PASSES)
    trees = caster_trees(buffer, kinds)
    maps: list[_Map] = []
    if isinstance(settings, ShadowMapSettings):
        maps = _sun_maps(buffer, scene, settings, trees)
    elif (lit := _lamp_map(buffer, scene.lamps[light], settings, trees)) is not None:
        maps = [lit]
    if not maps:  # no receivers
        with log.run(depth_pass), log.run(visibility_pass):
            return np.ones(buffer.there.shape, np.float32)
    gl = device()
    visibility = np.ones(buffer.there.shape, np.float32)
    for drawn in maps:
        with log.run(depth_pass) as record:
            target = _draw(gl, drawn, buffer, scene, kinds, casters, record)
        with log.run(visibility_pass) as record:
            _look_up(gl, drawn, target, buffer, settings, visibility, record)
    return visibility


def _sun_maps(buffer: GeometryBuffer, scene: Scene, settings: ShadowMapSettings, trees: Stand | None) -> list[_Map]:
    """The maps of the cascades that have receivers."""
    extent_m = _extent_m(buffer)
    if len(settings.cascades) == 1 or isinstance(buffer.view, MapView):
        if not buffer.there.any():
            return []
        return [_sun_map(buffer, buffer.there, scene, settings.cascades[0], settings, trees, extent_m)]
    eye, _ = buffer.view.in_frame(buffer.frame)
    away_m = distances(buffer.position_frame_m, eye)
    maps, near_m = [], -1.0
    for cascade in settings.cascades:
        far_m = np.inf if cascade.far_m is None else cascade.far_m
        here = (away_m > near_m) & (away_m <= far_m)
        if here.any():
            maps.append(_sun_map(buffer, here, scene, cascade, settings, trees, extent_m))
        near_m = far_m
    return maps


def _sun_map(
    buffer: GeometryBuffer,
    here: np.ndarray,
    scene: Scene,
    cascade: Cascade,
    settings: ShadowMapSettings,
    trees: Stand | None,
    extent_m: float,
) -> _Map:
    """The map of a cascade, whose receivers are ``here``; ``extent_m`` is the largest coordinate of the buffer's points."""
    assert scene.light is not None
    rotation, translation = scene.light.from_frame(buffer.frame)
    low, high = light_bounds(buffer.position_frame_m, here, rotation, translation)
    texel = np.array(cascade.texel_m)
    first, size = _window(low, high, texel)
    for axis in (0, 1):  # a block wider than the plan foresaw gets coarser texels, not a map that no device holds
        while size[axis] > min(device().max_size, 2 * settings.map_size + 4 * BORDER_TEXELS + SIZE_STEP):
            texel[axis] *= 2.0
            first, size = _window(low, high, texel)
    error_m = POSITION_ERROR * (extent_m + float(np.abs(high - low).max()))
    step_m = cascade.depth_step_m
    before_m = 4.0 * (error_m + step_m) + BORDER_TEXELS * float(texel.max())  # keeps receivers clear of depth 0
    steps = _steps(settings.depth_bits)
    near = np.floor((low[2] - before_m) / (step_m * 256)) * 256 * step_m
    while near + steps * step_m < high[2]:  # a block deeper than the plan foresaw keeps its depths, more coarsely
        step_m *= 2.0
        near = np.floor((low[2] - before_m) / (step_m * 256)) * 256 * step_m
    uniforms = {
        "lamp": False,
        "light_from_frame": tuple(rotation.T.ravel()),  # GLSL matrices are column by column
        "light_offset_m": tuple(translation - np.array([*(first * texel), near])),
        "window_m": (*(size * texel), steps * step_m),
        "texel_m": tuple(texel),
        "error_m": error_m,
        "depth_step": 1.0 / steps,
    }
    pixels = None if isinstance(buffer.view, MapView) else np.flatnonzero(here)
    reached = None if trees is None else trees_in_the_way(trees, rotation, translation, low, high)
    return _Map(uniforms, (int(size[0]), int(size[1])), (np.eye(3),), settings.depth_bits, reached, pixels)


def _lamp_map(buffer: GeometryBuffer, lamp: Lamp, settings: LampMapSettings, trees: Stand | None) -> _Map | None:
    """The map of a lamp; ``None`` where it shines on nothing."""
    rotation = lamp.earth_from_lamp.T @ buffer.frame.frame_from_earth.T
    position = buffer.frame.frame_from_earth @ (lamp.position_earth_m - buffer.frame.origin_earth_m)
    size = settings.map_size
    faces = tuple(CUBE) if lamp.kind == "omni" else (np.eye(3),)
    half = 1.0 if lamp.kind == "omni" else float(np.tan(np.radians(lamp.cutoff_deg)))
    tangent = half * size / (size - 2 * BORDER_TEXELS)
    seen = (buffer.position_frame_m[buffer.there] - position) @ rotation.T
    near_far = [np.inf, 0.0]
    for turned in faces:
        at = seen @ turned.T
        ahead = at[(at[:, 2] > 0.0) & (np.abs(at[:, :2]).max(axis=1) <= tangent * at[:, 2]), 2]
        if len(ahead):
            near_far = [min(near_far[0], float(ahead.min())), max(near_far[1], float(ahead.max()))]
    if not near_far[1] > 0.0:
        return None
    near, far = max(0.98 * near_far[0], NEAREST_SHARE * near_far[1]), 1.02 * near_far[1]
    uniforms = {
        "lamp": True,
        "light_from_frame": tuple(rotation.T.ravel()),
        "light_offset_m": tuple(-rotation @ position),
        "tangent": tangent,
        "near_far_m": (near, far),
        "error_m": POSITION_ERROR * (_extent_m(buffer) + float(np.abs(position).max())),
        "depth_step": 1.0 / _steps(settings.depth_bits),
    }
    pixels = None if isinstance(buffer.view, MapView) else np.flatnonzero(buffer.there)
    return _Map(uniforms, (size, size), faces, settings.depth_bits, trees, pixels)


def _draw(
    gl: Device,
    drawn: _Map,
    buffer: GeometryBuffer,
    scene: Scene,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    record: PassRecord,
):  # type: ignore[no-untyped-def]
    width, height = drawn.size
    across, down = (3, 2) if len(drawn.faces) == 6 else (1, 1)
    target = gl.depth_target(width * across, height * down, drawn.depth_bits)
    solid = gl.program(shader("shadows/light", "shadows/depth.vert"), shader("shadows/depth.frag"))
    set_uniforms(solid, drawn.uniforms)
    meshes = caster_meshes(scene, buffer, kinds)
    if drawn.near_trees is not None:
        vertex = shader("shadows/light", "terrain/tree", "shadows/depth_tree.vert")
        leaves = gl.program(vertex, shader("shadows/depth_tree.frag"))
        set_uniforms(leaves, {**drawn.uniforms, "foliage": 0, "threshold": THRESHOLD, "curvature": drawn.near_trees.curvature})
    largest = 0
    with gl.depth_pass(target):
        for number, face in enumerate(drawn.faces):
            gl.ctx.viewport = (number % 3 * width, number // 3 * height, width, height)
            if len(drawn.faces) > 1:
                turned = _turned(drawn.uniforms, face)
                set_uniforms(solid, turned)
                if drawn.near_trees is not None:
                    set_uniforms(leaves, turned)
            for sheet in caster_sheets(scene, buffer, casters, kinds):
                record.triangles += gl.draw_sheet(solid, sheet)
                record.draws += 1
                largest = max(largest, sheet[..., 0].size * 12 + sheet_triangles(*sheet.shape[:2]).nbytes)
            for vertices, triangles in meshes:
                record.triangles += gl.draw_triangles(solid, vertices, triangles)
                record.draws += 1
                largest = max(largest, len(vertices) * 12 + triangles.nbytes)
            if drawn.near_trees is not None:
                stand = drawn.near_trees
                gl.layers(foliage().levels).use(0)
                look = np.concatenate([stand.turn, stand.look[:, None]], axis=1)
                instances = [("base", stand.base_frame_m), ("shape", stand.shape), ("look", look)]
                record.triangles += gl.draw_instances(leaves, 18, instances)
                record.draws += 1
                largest = max(largest, len(stand) * 40)
    record.map_texels += drawn.texels
    record.bytes = max(record.bytes, drawn.nbytes + largest)
    gl.check("depth map")
    return target


def _look_up(
    gl: Device,
    drawn: _Map,
    target: Framebuffer,
    buffer: GeometryBuffer,
    settings: ShadowMapSettings | LampMapSettings,
    visibility: np.ndarray,
    record: PassRecord,
) -> None:
    """Fill in the visibility (rows, cols) of the points that are a map's."""
    program = gl.program(shader("shadows/pixels.vert"), shader("shadows/shadow_map.frag"))
    set_uniforms(program, {
        **drawn.uniforms, "map_size": drawn.size, "faces": len(drawn.faces), "taps": settings.filter,
        "bias_scale": settings.bias_scale, "position_frame_m": 0, "normal_frame": 1, "depth_map": MAP_UNIT,
    })  # fmt: skip
    if "face_from_lamp" in program:
        turns = [*drawn.faces, *([np.eye(3)] * (6 - len(drawn.faces)))]
        program["face_from_lamp"] = [tuple(face.T.ravel()) for face in turns]
    arrays = [buffer.position_frame_m, np.concatenate([buffer.normal_frame, buffer.crease[..., None]], axis=-1)]
    view, window, corners = buffer.view, buffer.surface, buffer.corners_frame_m
    if isinstance(view, MapView) and window is not None:
        rows, cols = buffer.there.shape
        first = (view.col0 - window.col0, view.row0 - window.row0)
        nodes = {"node_frame_m": 2, "first_node": first, "node_step": (view.col_step, view.row_step), "on_nodes": True}
        set_uniforms(program, nodes)
        arrays.append(window.position_frame_m)
        if corners is not None:
            arrays.append(corners.reshape(rows, cols * 3, 3))
        set_uniforms(program, {"has_corners": corners is not None, "corner_frame_m": len(arrays) - 1})
        visibility[:] = _drawn_pixels(gl, program, arrays, target, drawn, record)
        return
    assert corners is not None and drawn.pixels is not None
    set_uniforms(program, {"on_nodes": False, "has_corners": True, "corner_frame_m": 2})
    flat = [array.reshape(visibility.size, -1) for array in (*arrays, corners)]
    own = visibility.size if buffer.samples_from is None else buffer.samples_from * visibility.shape[1]
    split = int(np.searchsorted(drawn.pixels, own))
    for part, taps in ((drawn.pixels[:split], settings.filter), (drawn.pixels[split:], 1)):  # samples are averaged as it is
        for start in range(0, len(part), LOOK_COLS * LOOK_ROWS):
            chosen = part[start : start + LOOK_COLS * LOOK_ROWS]
            rows = -(-len(chosen) // LOOK_COLS)
            some = [_rows_of(values, chosen, rows) for values in flat]
            some[-1] = some[-1].reshape(rows, LOOK_COLS * 3, 3)
            set_uniforms(program, {"taps": taps})
            visibility.ravel()[chosen] = _drawn_pixels(gl, program, some, target, drawn, record).ravel()[: len(chosen)]


def _drawn_pixels(
    gl: Device, program: Program, arrays: list[np.ndarray], target: Framebuffer, drawn: _Map, record: PassRecord
) -> np.ndarray:
    """Run the look-up for points (rows, cols, 3), facings, and what else there is of them."""
    rows, cols = arrays[0].shape[:2]
    textures = [gl.texture(array) for array in arrays]
    for unit, texture in enumerate(textures):
        texture.use(unit)
    target.depth_attachment.use(MAP_UNIT)
    visible = gl.float_target(cols, rows)
    gl.draw_pixels(program, visible)
    found = gl.read(visible)
    record.draws += 1
    held = sum(texture.width * texture.height * texture.components * 4 for texture in textures)
    record.bytes = max(record.bytes, drawn.nbytes + held + found.nbytes)
    for texture in textures:
        texture.release()
    return found


def _rows_of(values: np.ndarray, chosen: np.ndarray, rows: int) -> np.ndarray:
    """Some of values (n, k) as float32 (rows, LOOK_COLS, k), filled up with zeros."""
    out = np.zeros((rows * LOOK_COLS, values.shape[1]), np.float32)
    out[: len(chosen)] = values[chosen]
    return out.reshape(rows, LOOK_COLS, -1)


@compiled
def distances(points, eye):  # type: ignore[no-untyped-def]
    """Distances (rows, cols) float32 of points (rows, cols, 3) from an eye; NaN where there is no point."""
    out = np.empty(points.shape[:2], np.float32)
    for i in range(points.shape[0]):
        for j in range(points.shape[1]):
            p = points[i, j]
            out[i, j] = np.sqrt((p[0] - eye[0]) ** 2 + (p[1] - eye[1]) ** 2 + (p[2] - eye[2]) ** 2)
    return out


def _turned(uniforms: dict, face: np.ndarray) -> dict:
    """A lamp's rotation and offset, turned to one of its faces."""
    rotation = face @ np.array(uniforms["light_from_frame"]).reshape(3, 3).T
    return {"light_from_frame": tuple(rotation.T.ravel()), "light_offset_m": tuple(face @ np.array(uniforms["light_offset_m"]))}


def _extent_m(buffer: GeometryBuffer) -> float:
    """The largest coordinate of a buffer's points."""
    return float(np.abs(light_bounds(buffer.position_frame_m, buffer.there, np.eye(3), np.zeros(3))).max())


def _steps(depth_bits: int) -> int:
    return 2**16 - 1 if depth_bits == 16 else 2**24 - 1


def _window(low: np.ndarray, high: np.ndarray, texel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First texel and size in texels of the map over light bounds, on the lattice counted from the anchor."""
    first = np.floor(low[:2] / texel).astype(np.int64) - BORDER_TEXELS
    size = np.floor(high[:2] / texel).astype(np.int64) + 1 + BORDER_TEXELS - first
    return first, -(-size // SIZE_STEP) * SIZE_STEP
