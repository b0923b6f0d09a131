"""Counting shadow volumes in the pixels of a view, through the stencil.

**Depth.** Receivers, near caps and sides go through one program, so that a near cap has the very depth of the surface that it lies
on. A surface is held to lie before its cap: it counts as behind the point, and not as before it. In perspective, depth is n over
the distance along the view's axis: what lies infinitely far away has depth 0 and nothing is cut off there. The near plane n is put
half-way to what is nearest of all that is seen, which keeps float32 steps fine. In a map, which has no eye, depths are clamped
instead.

**Counting.** Each caster's volume has a sum of its own in every pixel, either of its faces before the point (z-pass), which is right
while the near plane lies outside of it, or of those behind (z-fail), which is right always but takes near and far caps. So both go
into one stencil. Which it is says whether the caster's bounds reach into what the light would have to pass to shade the near plane's
rectangle (Everitt and Kilgard 2002). A map is seen from infinitely far above: z-pass.

**Samples** of a perspective view's pixels are pixels of a finer view of the same camera, of which only they are marked.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import moderngl
import numpy as np
from moderngl import Framebuffer

from shadows.passes import PassRecord
from shadows.plan import VolumeSettings
from shadows.tiles import culled, depth_bounds, marked_tiles, rectangles
from shadows.volume_layers import may_shade_near
from shadows.volumes import Volumes
from terrain.antialias import finer_view
from terrain.camera import PerspectiveView
from terrain.clip_space import camera_clip, map_clip
from terrain.foliage import THRESHOLD, foliage
from terrain.geometry import GeometryBuffer
from terrain.gl import Device, device
from terrain.grid import MapView
from terrain.light_space import light_bounds
from terrain.scene import Scene
from terrain.stencil import MARK, Counting, Side
from terrain.visible import NEAR_M, set_uniforms, shader

COUNT = ~MARK & 0xFF
"""The bits of the stencil that count."""

TOWARDS_EYE = 1.0 + 2.0**-16
"""How much nearer silhouettes are drawn than the surfaces that they lie on."""


@dataclass(frozen=True, eq=False)
class Drawn:
    """A view as it is rasterised: its clip coordinates (4, 4) from an origin, and the near plane's rectangle (4, 3); ``None`` in a
    map, which has none.
    """

    view: MapView | PerspectiveView
    clip_from_frame: np.ndarray
    origin_frame_m: np.ndarray
    near_frame_m: np.ndarray | None


def count(
    buffer: GeometryBuffer,
    scene: Scene,
    light: np.ndarray,
    volumes: list[Volumes],
    settings: VolumeSettings,
    wanted: np.ndarray,
    marked: bool,
    record: PassRecord,
) -> np.ndarray:
    """How many volumes hold each point of a buffer, uint8 (rows, cols), at most 127; 0 where it is not ``wanted``.

    Volumes are drawn only in rectangles of tiles with a pixel that is wanted. With ``marked`` a bit of the stencil rejects the other
    pixels of a view as well.
    """
    view, counts = buffer.view, np.zeros(wanted.shape, np.uint8)
    near_m = _near_m(buffer)
    pixels = np.nonzero(wanted[: view.rows])
    if len(pixels[0]):
        drawn = _drawn(buffer, scene, view, near_m)
        points = buffer.position_frame_m[: view.rows][pixels]
        counts[pixels] = _counted(buffer, scene, drawn, light, volumes, settings, pixels, points, marked, record)
    if buffer.sample_pixels is not None and wanted[view.rows :].any():
        below = np.nonzero(wanted[view.rows :])
        drawn = _drawn(buffer, scene, finer_view(view), near_m)  # type: ignore[arg-type]
        pixels = tuple(index[below] for index in buffer.sample_pixels)
        points = buffer.position_frame_m[view.rows :][below]
        counts[view.rows :][below] = _counted(buffer, scene, drawn, light, volumes, settings, pixels, points, True, record)
    return counts


def faces_before(buffer: GeometryBuffer, scene: Scene, volumes: list[Volumes]) -> np.ndarray:
    """How many faces of volumes lie before what is seen, uint8 (rows, cols) of a view's own pixels, at most 255."""
    drawn = _drawn(buffer, scene, buffer.view, _near_m(buffer))
    gl = device()
    with _receiving(gl, buffer, scene, drawn) as (target, program):
        for each in volumes:
            with gl.uploaded(program, each.vertices, each.faces) as array, _counting(gl, target, drawn, "faces"):
                array.render(moderngl.TRIANGLES)
        return gl.stencil.read(target)


def silhouettes_seen(buffer: GeometryBuffer, scene: Scene, volumes: list[Volumes]) -> np.ndarray:
    """Where silhouettes are seen, uint8 (rows, cols) of a view's own pixels, 255 or 0."""
    drawn = _drawn(buffer, scene, buffer.view, _near_m(buffer))
    gl = device()
    with _receiving(gl, buffer, scene, drawn) as (target, program):
        nearer = drawn.clip_from_frame * np.array([[1.0], [1.0], [TOWARDS_EYE], [1.0]])
        program["clip_from_frame"] = tuple(nearer.T.ravel())
        for each in volumes:
            with gl.uploaded(program, each.vertices, each.edges) as array, _counting(gl, target, drawn, "seen"):
                array.render(moderngl.LINES)
        return gl.stencil.read(target)


def _near_m(buffer: GeometryBuffer) -> float:
    """A distance along the view's axis that all that is seen lies beyond; 0 in a map."""
    if isinstance(buffer.view, MapView):
        return 0.0
    eye, camera_from_frame = buffer.view.in_frame(buffer.frame)
    low, _ = light_bounds(buffer.position_frame_m, buffer.there, camera_from_frame, -camera_from_frame @ eye)
    return max(0.5 * float(low[2]), NEAR_M) if np.isfinite(low[2]) else NEAR_M


def _drawn(buffer: GeometryBuffer, scene: Scene, view: MapView | PerspectiveView, near_m: float) -> Drawn:
    frame = buffer.frame
    if isinstance(view, PerspectiveView):
        eye, camera_from_frame = view.in_frame(frame)
        ends = [[(first + (size * k - 0.5) * view.step) / view.focal_px for k in (0, 1)] for first, size in
                ((view.col0, view.cols), (view.row0, view.rows))]  # fmt: skip
        (left, right), (top, bottom) = ends
        corners = np.array([[left, top, 1.0], [right, top, 1.0], [right, bottom, 1.0], [left, bottom, 1.0]])
        return Drawn(view, camera_clip(view, frame, eye, near_m), eye, eye + near_m * corners @ camera_from_frame)
    low, high = light_bounds(buffer.position_frame_m, buffer.there, np.eye(3), np.zeros(3))
    if not np.isfinite(low[2]):
        low, high = np.zeros(3), np.ones(3)
    middle = np.append((low[:2] + high[:2]) / 2.0, low[2])
    margin_m = 1.0 + 0.01 * (high[2] - low[2])
    return Drawn(view, map_clip(scene.world, frame, view, middle, (low[2] - margin_m, high[2] + margin_m)), middle, None)


def _counted(
    buffer: GeometryBuffer,
    scene: Scene,
    drawn: Drawn,
    light: np.ndarray,
    volumes: list[Volumes],
    settings: VolumeSettings,
    pixels: tuple[np.ndarray, np.ndarray],
    points: np.ndarray,
    marked: bool,
    record: PassRecord,
) -> np.ndarray:
    """The counts (n,) uint8 of some of a drawn view's pixels, rows and columns (n,), that show frame points (n, 3)."""
    gl, size = device(), (drawn.view.rows, drawn.view.cols)
    parts = rectangles(marked_tiles(*pixels, size), size)
    depths = depth_bounds(*pixels, _depths(points, drawn), parts, size)
    total = np.zeros(len(pixels[0]), np.uint8)
    with _receiving(gl, buffer, scene, drawn) as (target, program):
        if marked:
            _mark(gl, target, *pixels)
        for number, each in enumerate(volumes):
            if number:
                gl.stencil.clear(target, COUNT if marked else 0xFF)
            clip = _clip_of(each, drawn)
            added = np.zeros(len(parts), np.int64)
            for counting, faces in _ways(each, drawn, light, settings):
                some = culled(clip, faces, counting == "z_fail", parts, depths, size)
                added += some.added
                if not len(some.faces):
                    continue
                with gl.uploaded(program, each.vertices, faces[some.faces]) as array:
                    for side in ("both",) if settings.stencil == "one_pass" else ("front", "back"):
                        with _counting(gl, target, drawn, counting, side, marked):
                            _render(target, array, parts, some.starts)
                        record.triangles += len(some.faces)
                        record.draws += len(parts)
                record.bytes = max(record.bytes, each.vertices.nbytes + 12 * len(some.faces) + 9 * size[0] * size[1])
            counts = gl.stencil.read(target)
            for (col, row, width, height), more in zip(parts.tolist(), added.tolist(), strict=True):
                counts[row : row + height, col : col + width] += np.uint8(more & COUNT)
            total = np.maximum(total, counts[pixels] & COUNT)
    gl.check("counting shadow volumes")
    return total


def _ways(volumes: Volumes, drawn: Drawn, light: np.ndarray, settings: VolumeSettings) -> list[tuple[Counting, np.ndarray]]:
    """The ways to count and the faces (m, 3) that are counted so."""
    if drawn.near_frame_m is None:
        return [("z_pass", volumes.faces)]
    if settings.counting == "z_fail":
        return [("z_fail", volumes.faces)]
    by_fail = may_shade_near(volumes.low_m, volumes.high_m, drawn.near_frame_m, light)[volumes.part]
    return [("z_pass", volumes.faces[~by_fail]), ("z_fail", volumes.faces[by_fail])]


def _depths(points: np.ndarray, drawn: Drawn) -> np.ndarray:
    """Depths (n,) of frame points (n, 3)."""
    rows = drawn.clip_from_frame[2:]
    z, w = rows[:, :3] @ (points - drawn.origin_frame_m).T + rows[:, 3:]
    return z / w


def _clip_of(volumes: Volumes, drawn: Drawn) -> np.ndarray:
    """Clip coordinates (n, 4) float64 of volumes' vertices."""
    points = volumes.vertices.astype(np.float64)
    points[:, :3] -= points[:, 3:] * drawn.origin_frame_m
    return points @ drawn.clip_from_frame.T


def _render(target: Framebuffer, array: moderngl.VertexArray, parts: np.ndarray, starts: np.ndarray) -> None:
    """Draw the triangles of each rectangle of a framebuffer, and none of them outside of it."""
    for part, first, end in zip(parts.tolist(), starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        if end > first:
            target.scissor = tuple(part)
            array.render(moderngl.TRIANGLES, vertices=3 * (end - first), first=3 * first)
    target.scissor = None


def _mark(gl: Device, target: Framebuffer, row: np.ndarray, col: np.ndarray) -> None:
    program = gl.program(shader("shadows/marks.vert"), shader("shadows/depth.frag"))
    program["size_px"] = target.size
    with gl.stencil.mark_pass(target):
        gl.draw_points(program, np.column_stack([col, row]))


def _counting(gl: Device, target: Framebuffer, drawn: Drawn, counting: Counting, side: Side = "both", marked: bool = False):  # type: ignore[no-untyped-def]
    return gl.stencil.count_pass(target, counting, side, marked, clamped=drawn.near_frame_m is None)


@contextmanager
def _receiving(gl: Device, buffer: GeometryBuffer, scene: Scene, drawn: Drawn) -> Iterator[tuple[Framebuffer, moderngl.Program]]:
    """A stencil with the depths of all that is seen, and the program that draws volumes against them."""
    target = gl.stencil.target(drawn.view.cols, drawn.view.rows)
    uniforms = {"clip_from_frame": tuple(drawn.clip_from_frame.T.ravel()), "origin_frame_m": tuple(drawn.origin_frame_m)}
    program = gl.program(shader("shadows/volume.vert"), shader("shadows/depth.frag"))
    set_uniforms(program, uniforms)
    with gl.stencil.depth_pass(target):
        if buffer.ground is not None:
            gl.draw_triangles(program, _homogeneous(buffer.ground.position_frame_m), buffer.ground.triangles)
        elif buffer.surface is not None:
            gl.draw_sheet(program, _homogeneous(buffer.surface.position_frame_m))
        if buffer.solids_frame_m is not None and scene.population.solids is not None:
            gl.draw_triangles(program, _homogeneous(buffer.solids_frame_m), scene.population.solids.triangles)
        if buffer.stand is not None:
            _draw_trees(gl, buffer, drawn, uniforms)
    yield target, program


def _homogeneous(points: np.ndarray) -> np.ndarray:
    """Points (..., 3) as float32 (..., 4)."""
    out = np.ones((*points.shape[:-1], 4), np.float32)
    out[..., :3] = points
    return out


def _draw_trees(gl: Device, buffer: GeometryBuffer, drawn: Drawn, uniforms: dict) -> None:
    stand = buffer.stand
    assert stand is not None
    program = gl.program(shader("terrain/tree", "shadows/volume_tree.vert"), shader("shadows/depth_tree.frag"))
    set_uniforms(program, {**uniforms, "foliage": 0, "threshold": THRESHOLD, "curvature": stand.curvature})
    gl.layers(foliage().levels).use(0)
    look = np.concatenate([stand.turn, stand.look[:, None]], axis=1)
    gl.draw_instances(program, 18, [("base", stand.base_frame_m), ("shape", stand.shape), ("look", look)])
