"""`perspective_shadow_map`: a depth map in the post-perspective space of the camera, fine near the eye and coarse far away.

``shadows.maps.post_perspective`` makes the map's matrix. Here it is fitted to the receivers, drawn, and looked up;
``docs/perspective-shadow-maps.md`` derives the window, the comparison and the bias. Taps, their weights, kept maps and foliage are
as in ``docs/shadow-maps.md``. A uniform map is put on record with the reason.
"""

from __future__ import annotations

import numpy as np

from shadows.attached import attached
from shadows.maps.drawing import draw_map
from shadows.maps.lookup import look_up
from shadows.maps.post_perspective import Camera, Light, fitted, horizon_m, is_clear, post_perspectives, projected, uniform_matrix
from shadows.maps.shadow_map import depths
from shadows.maps.windows import BORDER_TEXELS, NEAREST_SHARE, POSITION_ERROR, DepthMap, steps_of
from shadows.passes import PassLog
from shadows.plan import PerspectiveMapSettings
from terrain.casters.casting import anything_casts, caster_trees
from terrain.casters.reach import Casters
from terrain.compiled import compiled
from terrain.gbuffer.geometry import GeometryBuffer
from terrain.gbuffer.stand import Stand
from terrain.geo.camera import PerspectiveView
from terrain.geo.light_space import light_bounds
from terrain.gl.device import device
from terrain.level.level import SUN, CasterKind
from terrain.scene import Scene

PASSES = ("depth map", "visibility")

SAMPLE = 1024
"""Receivers that a map's matrix is chosen by; it is fitted to all of them."""

ROUNDS = 8
"""Times that the outermost of all receivers may join the sample, before the map is widened to hold them."""

TOLERANCE = 1.125
"""How far a receiver outside of the sample may lie beyond the map that is chosen by it, as a share of its half width."""

ERROR = 2.0 * POSITION_ERROR
"""Bound of what float32 makes of positions, as a share of their coordinates."""

BEFORE = 0.01
"""Share of the map's depths that lies before the nearest receiver."""


def fill(
    buffer: GeometryBuffer,
    scene: Scene,
    light: str,
    kinds: tuple[CasterKind, ...],
    casters: Casters,
    settings: PerspectiveMapSettings,
    log: PassLog,
) -> np.ndarray:
    """Visibility of a light (rows, cols), float32 in [0, 1], for a buffer's points past some kinds of casters.

    Where there is no surface, or one that is turned away from the light, the value means nothing. Raises ``GraphicsError``.
    """
    depth_pass, visibility_pass = log.named(light, kinds, PASSES)
    visibility = np.ones(buffer.there.shape, np.float32)
    with log.run(depth_pass) as record:
        receivers = buffer.there & ~attached(buffer, scene, light)
        shaded = receivers.any() and anything_casts(scene, buffer, kinds)
        if shaded:
            drawn, note = perspective_map(buffer, receivers, scene, light, settings, caster_trees(buffer, kinds))
            record.note = record.note or note  # of any part of a view
            gl = device()
            target = draw_map(gl, drawn, buffer, scene, kinds, casters, settings, record)
            log.keep("shadow-map", light, depths, gl, drawn, target)
    with log.run(visibility_pass) as record:
        if shaded:
            look_up(gl, drawn, target, buffer, settings, visibility, record)
    return visibility


def perspective_map(
    buffer: GeometryBuffer, receivers: np.ndarray, scene: Scene, light: str, settings: PerspectiveMapSettings, trees: Stand | None
) -> tuple[DepthMap, str]:
    """The map of a light for a perspective view's receivers (rows, cols), at least one, and what there is to say of it."""
    chosen = np.flatnonzero(receivers)
    some = chosen[:: max(len(chosen) // SAMPLE, 1)]
    position, corners = buffer.position_frame_m.reshape(-1, 3), buffer.corners_frame_m
    assert corners is not None
    sample, triangles = position[some], corners.reshape(-1, 3, 3)[some]
    source = light_of(buffer, scene, light)
    inner = 1.0 - 2.0 * BORDER_TEXELS / settings.map_size
    plain = uniform_matrix(source, sample)[3]
    nearest = NEAREST_SHARE * float((sample @ plain[:3] + plain[3]).max()) if light != SUN else 0.0
    rim = sample[:0]
    for _ in range(ROUNDS):
        found, *others = post_perspectives(camera_of(buffer), source, sample, inner, rim)
        low, high, outermost = _bounds(found.clip_from_frame, plain, nearest, position, chosen)
        if is_clear(np.array([low[3], high[3]])) and max(-low[:2].min(), high[:2].max()) <= TOLERANCE * inner:
            break
        rim = np.concatenate([rim, position[outermost]])
    while not is_clear(np.array([low[3], high[3]])):
        found, *others = others
        low, high, _ = _bounds(found.clip_from_frame, plain, nearest, position, chosen)
    error_m = ERROR * np.linalg.norm(triangles, axis=-1).max(axis=1)
    narrow = np.maximum(_least_sides(found.clip_from_frame, sample, error_m, settings.map_size) - (high - low)[:2], 0.0)
    low[:2], high[:2] = low[:2] - narrow / 2.0, high[:2] + narrow / 2.0
    half_texels = np.array([settings.map_size / 2, settings.map_size / 2, 1.0, 1.0])[:, None]
    flat = half_texels * fitted(found.clip_from_frame, np.array([*low[:2], -1.0]), np.array([*high[:2], 1.0]), inner)
    low[2] = min(low[2], float(_clear_depths(flat, sample, triangles, error_m, settings.filter / 2.0).min()))
    clip = fitted(found.clip_from_frame, low[:3], high[:3], inner, BEFORE)
    size = settings.map_size
    to_texels = np.array([[size / 2, 0, 0, size / 2], [0, size / 2, 0, size / 2], [0, 0, 0.5, 0.5], [0, 0, 0, 1.0]])
    uniforms = {
        "lamp": False,
        "clip_rows": tuple(clip.ravel()),  # GLSL's matrices are column by column: these columns are the rows
        "map_rows": tuple((to_texels @ clip).ravel()),
        "position_error": ERROR,
        "depth_step": 1.0 / steps_of(settings.depth_bits),
    }
    reach = None
    if trees is not None and light == SUN:
        assert scene.light is not None
        turned = scene.light.from_frame(buffer.frame)
        first, last = light_bounds(buffer.position_frame_m, receivers, *turned)
        reach = *turned, first, last
    shaders = "shadows/maps/perspective_light", "shadows/maps/perspective_receiver"
    return DepthMap(uniforms, (size, size), (np.eye(3),), settings.depth_bits, trees, chosen, reach, shaders), found.note


def _least_sides(matrix: np.ndarray, points: np.ndarray, error_m: np.ndarray, map_size: int) -> np.ndarray:
    """The ranges (2,) of a map's x and y of which a texel is four times the error (n,) of the positions (n, 3): of a few receivers
    that lie in one place, or of a single one, finer texels would hold nothing but rounding.
    """
    w = horizon_m(matrix, points)[:, None]
    at = projected(matrix, points)[:, :2]
    per_m = np.linalg.norm(matrix[None, :2, :3] - at[..., None] * matrix[3, :3], axis=-1) / w
    return 4.0 * map_size * (error_m[:, None] * per_m).max(axis=0)


def _clear_depths(matrix: np.ndarray, points: np.ndarray, corners: np.ndarray, error_m: np.ndarray, reach: float) -> np.ndarray:
    """How early depths must begin for points (n, 3) on triangles (n, 3, 3), as z (n,) of a matrix to texels and z.

    What casts before the first depth is held there. It shades a point if that is deeper by all that is taken off it, and if the
    point's triangle begins no earlier at the texels up to ``reach`` beside. Twice what is taken off, as in the shader, but for
    its share of the whole range.
    """
    w = horizon_m(matrix, points)[:, None]
    at = projected(matrix, points)
    per_m = np.linalg.norm(matrix[None, :3, :3] - at[..., None] * matrix[3, :3], axis=-1) / w
    sides = corners - points[:, None]
    beyond = sides @ matrix[3, :3]
    x, y, z = np.moveaxis(sides @ matrix[:3, :3].T - at[:, None] * beyond[..., None], -1, 0)
    ahead = w + beyond
    share, right, up = np.cross(x, y), np.cross(y, ahead), np.cross(ahead, x)
    area = (share * ahead).sum(axis=1)
    area = np.where(area == 0.0, np.inf, area)
    slope = np.abs(np.stack([(z * right).sum(axis=1), (z * up).sum(axis=1)], axis=1) / area[:, None])
    own = np.where((ahead > 0.0).all(axis=1, keepdims=True), z / np.where(ahead > 0.0, ahead, 1.0), [[-np.inf, np.inf, 0.0]])
    grid = 1.0 / 128.0 + error_m[:, None] * per_m[:, :2]
    slack = np.minimum((slope * grid).sum(axis=1), np.ptp(own, axis=1)) + error_m * per_m[:, 2]
    nearer = 1.0 + 3.0 * w[:, 0] * (np.abs(right.sum(axis=1)) + np.abs(up.sum(axis=1))) / np.abs(area)
    return at[:, 2] - 2.0 * slack * nearer**2 - np.minimum(reach * slope.sum(axis=1), -own.min(axis=1))


def camera_of(buffer: GeometryBuffer) -> Camera:
    """The camera of a perspective view in the buffer's frame."""
    assert isinstance(buffer.view, PerspectiveView)
    return Camera(*buffer.view.in_frame(buffer.frame))


def light_of(buffer: GeometryBuffer, scene: Scene, light: str) -> Light:
    """The sun or a lamp as a homogeneous point in the buffer's frame."""
    if light == SUN:
        assert scene.sun is not None
        return Light(np.array([*(buffer.frame.frame_from_earth @ scene.sun.to_sun_earth), 0.0]), np.zeros(3))
    lamp = scene.lamps[light]
    position = buffer.frame.frame_from_earth @ (lamp.position_earth_m - buffer.frame.origin_earth_m)
    axis = buffer.frame.frame_from_earth @ lamp.earth_from_lamp[:, 2]
    return Light(np.array([*position, 1.0]), position + lamp.reference_m * axis)


@compiled
def _bounds(matrix, plain, nearest, position, chosen):
    """Least and largest (4,) of x, y and z in a map, and of w as a share of another plane's (4,), of the chosen of some points
    (m, 3); and which points (5,) are outermost: in x, in y, and nearest to the map's horizon.

    Those nearer than ``nearest`` to that plane do not count in z.
    """
    low, high, outermost = np.full(4, np.inf), np.full(4, -np.inf), np.full(5, chosen[0])
    v = np.empty(4)
    for i in chosen:
        p = position[i]
        w = matrix[3, 0] * p[0] + matrix[3, 1] * p[1] + matrix[3, 2] * p[2] + matrix[3, 3]
        share = 1.0 / w
        ahead = plain[0] * p[0] + plain[1] * p[1] + plain[2] * p[2] + plain[3]
        for k in range(3):
            v[k] = (matrix[k, 0] * p[0] + matrix[k, 1] * p[1] + matrix[k, 2] * p[2] + matrix[k, 3]) * share
        v[3] = w / ahead
        for k in range(4):
            if k == 2 and ahead < nearest:
                continue
            if v[k] < low[k]:
                low[k] = v[k]
                if k != 2:
                    outermost[2 * k if k < 2 else 4] = i
            if v[k] > high[k]:
                high[k] = v[k]
                if k < 2:
                    outermost[2 * k + 1] = i
    return low, high, outermost
