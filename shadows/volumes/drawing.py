"""Count the shadow volumes that contain the points of a view, through the stencil.

In each pixel, the volume of a caster adds a signed sum over its faces. Z-pass sums over the faces in front of the pixel's point,
z-fail over those behind it. Z-pass is right while the near plane lies outside of the volume. Z-fail is always right, but needs near
and far caps. Both kinds of sums add up in one stencil. A volume is counted by z-fail if the caster's bounds reach into the region
between the light and the near plane's rectangle (Everitt and Kilgard 2002). A map is seen from infinitely far above and uses
z-pass. Under a lamp, volumes that contain even that viewpoint count in every pixel.

A near cap coincides with the surface of its caster. It counts as behind the points of that surface.

Volumes are drawn in rectangles of tiles that contain points. Each rectangle draws only the faces that matter there
(``skugga.shadows.volumes.tiles``).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from skugga.shadows.passes import PassRecord
from skugga.shadows.volumes.layers import may_shade_near_plane
from skugga.shadows.volumes.settings import StencilSettings
from skugga.shadows.volumes.tiles import all_faces, covering_rectangles, cull_faces, depth_bounds, marked_tiles
from skugga.shadows.volumes.views import (
    VisiblePoints,
    near_plane_distance_m,
    pixel_points,
    points_of_view,
    receiver_stencil,
    sample_points,
)
from skugga.shadows.volumes.volumes import Volumes
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.gl.device import Device, device
from skugga.terrain.gl.stencil import MARK_BIT, CountMode, FaceSide
from skugga.terrain.scene import Scene

if TYPE_CHECKING:
    import moderngl
    from moderngl import Framebuffer

COUNT_BITS = ~MARK_BIT & 0xFF
"""The bits of the stencil that hold the count. The other bit marks pixels."""

MAP_OFFSET_STEPS = 16.0
"""Steps of a float32 depth by which faces are drawn farther away in a map.

Seen from above, the faces of a sun on the horizon are level, and have no slope that a polygon offset could use. Corners, their clip
coordinates and the rasterised depth of a face that extends to infinity are each rounded to a few steps. Truth's rays start as many
units in the last place off their triangles (``skugga.terrain.casters.rays``).
"""

ALIGNMENT_TOLERANCE = 1e-6
"""Upper bound of the tangent of the angle between the sun and an axis or a diagonal along which it counts as aligned."""

SILHOUETTE_DEPTH_FACTOR = 1.0 + 2.0**-10
"""Factor of the depth by which silhouettes are drawn nearer than the surfaces that they lie on."""


def count_volumes(
    buffer: GeometryBuffer,
    scene: Scene,
    light: np.ndarray,
    volumes: list[Volumes],
    settings: StencilSettings,
    receiver_mask: np.ndarray,
    uses_mark_bit: bool,
    record: PassRecord,
) -> np.ndarray:
    """Return the number of volumes that contain each point of a buffer, uint8 (rows, cols), at most 127.

    It is 0 outside of ``receiver_mask``. If ``uses_mark_bit`` is true, a bit of the stencil restricts counting to the receivers'
    pixels. Further samples of a perspective view are drawn in a finer view, which always uses this bit.
    """
    counts = np.zeros(receiver_mask.shape, np.uint8)
    if not any(len(volume_set.faces) for volume_set in volumes):
        return counts
    near_m = near_plane_distance_m(buffer)
    is_sun_aligned = _is_sun_aligned(buffer, scene, light)
    for points in points_of_view(buffer, scene, receiver_mask, near_m):
        point_counts = _count_points(buffer, scene, points, light, volumes, settings, uses_mark_bit, record)
        if is_sun_aligned:
            rotated_counts = _count_points(
                buffer, scene, _rotate_half_turn(points), light, volumes, settings, uses_mark_bit, record
            )
            point_counts = np.maximum(point_counts, rotated_counts)
        counts.ravel()[points.buffer_indices] = point_counts
    for points in sample_points(buffer, scene, receiver_mask, near_m):
        counts.ravel()[points.buffer_indices] = _count_points(buffer, scene, points, light, volumes, settings, True, record)
    return counts


def _is_sun_aligned(buffer: GeometryBuffer, scene: Scene, light: np.ndarray) -> bool:
    """Return whether sides of volumes may pass exactly through pixel centres.

    They may in a flat world's map, under a sun along the axes or the diagonals of its pixels. A rasteriser assigns such a centre to
    one side only, always the same. A point on a side should lie in the volume, as an edge stops a ray that meets it. Such a view is
    therefore counted a second time, rotated by half a turn, where the centre falls to the other side.
    """
    view = buffer.view
    if not isinstance(view, MapView) or light[3] != 0.0 or not scene.world.is_flat:
        return False
    columns = buffer.columns
    steps = (
        (view.row_step * view.grid.y_to_x_step_ratio, view.col_step)
        if columns is None
        else (columns.window.columns.grid.y_to_x_step_ratio, 1.0)
    )
    down, right = -light[1] / steps[0], light[0] / steps[1]
    alignments = np.abs([down, right, down - right, down + right])
    return bool(alignments.min() <= ALIGNMENT_TOLERANCE * alignments.max())


def _rotate_half_turn(points: VisiblePoints) -> VisiblePoints:
    """Return the points in the view rotated by half a turn about its axis."""
    rows, cols = points.size
    clip = points.clip_from_frame * np.array([[-1.0], [-1.0], [1.0], [1.0]])
    return replace(points, row=rows - 1 - points.row, col=cols - 1 - points.col, clip_from_frame=clip)


def count_faces_in_front(buffer: GeometryBuffer, scene: Scene, volumes: list[Volumes]) -> np.ndarray:
    """Return the number of faces of volumes in front of the visible surface, at most 255.

    The result is uint8 (rows, cols) of a view's own pixels.
    """
    return _count_over_surface(buffer, scene, volumes, "faces")


def visible_silhouettes(buffer: GeometryBuffer, scene: Scene, volumes: list[Volumes]) -> np.ndarray:
    """Return where silhouettes are visible, uint8 (rows, cols) of a view's own pixels, 255 or 0."""
    return _count_over_surface(buffer, scene, volumes, "seen")


def _count_over_surface(buffer: GeometryBuffer, scene: Scene, volumes: list[Volumes], counting: CountMode) -> np.ndarray:
    """Return the stencil's counts over the visible surface, uint8 (rows, cols), by one counting method."""
    import moderngl

    gl, out = device(), np.zeros(buffer.valid.shape, np.uint8)
    draws_edges = counting == "seen"
    for points in pixel_points(buffer, scene, buffer.valid, near_plane_distance_m(buffer)):
        full_rectangle = np.array([[0, 0, points.size[1], points.size[0]]])
        with receiver_stencil(gl, buffer, scene, points, full_rectangle, False) as (target, program):
            if draws_edges:
                nearer_clip = points.clip_from_frame * np.array([[1.0], [1.0], [SILHOUETTE_DEPTH_FACTOR], [1.0]])
                program["clip_from_frame"] = tuple(nearer_clip.T.ravel())
            for volume_set in volumes:
                indices = volume_set.silhouette_edges if draws_edges else volume_set.faces
                if not len(indices):
                    continue
                with (
                    gl.uploaded_mesh(program, volume_set.vertices, indices) as array,
                    gl.stencil.count_pass(target, counting),
                ):
                    gl.render(array, moderngl.LINES if draws_edges else moderngl.TRIANGLES)
            top, left = divmod(int(points.buffer_indices[0]), buffer.view.cols)
            top, left = top - int(points.row[0]), left - int(points.col[0])
            out[top : top + points.size[0], left : left + points.size[1]] = gl.stencil.read(target)
    return out


def _count_points(
    buffer: GeometryBuffer,
    scene: Scene,
    points: VisiblePoints,
    light: np.ndarray,
    volumes: list[Volumes],
    settings: StencilSettings,
    uses_mark_bit: bool,
    record: PassRecord,
) -> np.ndarray:
    """Return the number of volumes that contain each of some points, uint8 (n,).

    ``light`` (4,) is homogeneous, in the buffer's frame. ``uses_mark_bit`` is that of ``count_volumes``.
    """
    gl, size = device(), points.size
    from_above = points.near_plane_frame_m is None
    clamped, offset_steps = from_above and light[3] != 0.0, MAP_OFFSET_STEPS if from_above else 0.0
    max_faces = max((len(volume_set.faces) for volume_set in volumes if not volume_set.draws_all_faces), default=0)
    parts = covering_rectangles(marked_tiles(points.row, points.col, size), size, max_faces)
    depths = depth_bounds(points.row, points.col, points.depth, parts, size)
    total = np.zeros(len(points.buffer_indices), np.uint8)
    sides: tuple[FaceSide, ...] = ("both",) if settings.stencil == "one_pass" else ("front", "back")
    with receiver_stencil(gl, buffer, scene, points, parts, uses_mark_bit) as (target, program):
        for number, volume_set in enumerate(volumes):
            if number:
                gl.stencil.clear(target, COUNT_BITS if uses_mark_bit else 0xFF)
            clip = points.to_clip(volume_set.vertices.astype(np.float64))
            added = np.full(len(parts), _layers_around_viewer(volume_set, points, light) if clamped else 0)
            for counting, faces in _counting_methods(volume_set, points, light, settings):
                visible_faces = (
                    all_faces(len(faces), len(parts))
                    if volume_set.draws_all_faces
                    else cull_faces(clip, faces, counting == "z_fail", parts, depths, size, clamped)
                )
                added += visible_faces.added_layers
                if not len(visible_faces.face_numbers):
                    continue
                with gl.uploaded_mesh(program, volume_set.vertices, faces[visible_faces.face_numbers]) as array:
                    for side in sides:
                        with gl.stencil.count_pass(target, counting, side, uses_mark_bit, clamped, offset_steps):
                            _render_in_rectangles(gl, target, array, parts, visible_faces.rectangle_starts)
                        record.triangles += len(visible_faces.face_numbers)
                record.bytes = max(
                    record.bytes, volume_set.vertices.nbytes + 12 * len(visible_faces.face_numbers) + 9 * size[0] * size[1]
                )
            counts = gl.stencil.read(target)
            for (col, row, width, height), added_layers in zip(parts.tolist(), added.tolist(), strict=True):
                counts[row : row + height, col : col + width] += np.uint8(added_layers & COUNT_BITS)
            total = np.maximum(total, counts[points.row, points.col] & COUNT_BITS)
    gl.check("counting shadow volumes")
    return total


def _layers_around_viewer(volumes: Volumes, points: VisiblePoints, lamp: np.ndarray) -> int:
    """Return the number of volumes under a lamp that contain the viewer of a map, infinitely far away.

    ``lamp`` (4,) is the homogeneous light. The volumes are the casting triangles on the line from the lamp to the viewer. The
    intersection is that of T. Moller and B. Trumbore, Fast, Minimum Storage Ray-Triangle Intersection, 1997.
    """
    clip = points.clip_from_frame
    towards = np.cross(clip[0, :3], clip[1, :3])
    towards *= np.sign(towards @ clip[2, :3])
    a, b, c = volumes.vertices[volumes.caps, :3].astype(np.float64).transpose(1, 0, 2)
    side, other_side, to_lamp = b - a, c - a, lamp[:3] - a
    p_vector = np.cross(towards, other_side)
    determinant = (side * p_vector).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, q_vector = (to_lamp * p_vector).sum(axis=1) / determinant, np.cross(to_lamp, side)
        v, distance = (q_vector @ towards) / determinant, (q_vector * other_side).sum(axis=1) / determinant
        return int(((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (distance > 0.0)).sum())


def _counting_methods(
    volumes: Volumes, points: VisiblePoints, light: np.ndarray, settings: StencilSettings
) -> list[tuple[CountMode, np.ndarray]]:
    """Return the counting methods (z-pass, z-fail) of some volumes, each with the faces (m, 3) that it counts."""
    if points.near_plane_frame_m is None:
        return [("z_pass", volumes.faces)]
    if settings.counting == "z_fail":
        return [("z_fail", volumes.faces)]
    reaches_near_plane = may_shade_near_plane(volumes.caster_low_m, volumes.caster_high_m, points.near_plane_frame_m, light)
    if settings.counting == "z_pass":
        _check_z_pass(volumes, reaches_near_plane, points.near_plane_frame_m, light)
        return [("z_pass", volumes.faces)]
    uses_z_fail = reaches_near_plane[volumes.caster_of_face]
    return [("z_pass", volumes.faces[~uses_z_fail]), ("z_fail", volumes.faces[uses_z_fail])]


def _check_z_pass(volumes: Volumes, reaches_near_plane: np.ndarray, near_plane_frame_m: np.ndarray, light: np.ndarray) -> None:
    """Raise ``UnsupportedError`` if a shadow volume may reach the near plane, where z-pass counts wrongly.

    ``reaches_near_plane`` (casters,) tells which casters' bounds may cast on the near plane's rectangle (4, 3). Of these, the
    bounds of each casting triangle are tested. Volumes without marked caps cast from all faces that do not reach infinity.
    """
    if volumes.cap_count:
        suspects = volumes.caps[reaches_near_plane[volumes.caster_of_face[volumes.first_cap :][: volumes.cap_count]]]
    else:
        faces = volumes.faces[reaches_near_plane[volumes.caster_of_face]]
        suspects = faces[(volumes.vertices[faces, 3] > 0.0).all(axis=1)]
    corners = volumes.vertices[suspects, :3].astype(np.float64)
    count = int(may_shade_near_plane(corners.min(axis=1), corners.max(axis=1), near_plane_frame_m, light).sum())
    if count:
        triangles = "a casting triangle may shade" if count == 1 else f"{count} casting triangles may shade"
        reason = f"{triangles} the near plane, so the eye may be inside a shadow volume, where z-pass counts too few (use z_fail)"
        raise UnsupportedError("counting", "z_pass", reason)


def _render_in_rectangles(
    gl: Device, target: Framebuffer, array: moderngl.VertexArray, clip_rectangles: np.ndarray, face_starts: np.ndarray
) -> None:
    """Draw the faces of each rectangle in ``clip_rectangles`` (k, 4) of a framebuffer, clipped to the rectangle.

    ``face_starts`` (k + 1,) are the indices of the rectangles' first faces. ``array`` is the vertex array of all faces, rectangle
    by rectangle.
    """
    for part, first, end in zip(clip_rectangles.tolist(), face_starts[:-1].tolist(), face_starts[1:].tolist(), strict=True):
        if end > first:
            target.scissor = tuple(part)
            gl.render(array, vertices=3 * (end - first), first=3 * first)
    target.scissor = None  # type: ignore[assignment]  # the stubs do not allow None, which ends clipping
