"""Anti-alias edges of shadows in perspective views: a pixel that an edge crosses shows the mean over what it covers.

Where the view grazes the ground, a pixel covers a long strip of it, with many edges. So a pixel's own point decides at random, and
edges break into streaks and single dark pixels. Pixels on an edge get ``SAMPLE_COUNT`` more points, spread over the part of their
own triangle's plane that they cover, and over a texel of the light's maps. Masks and measures of accuracy use each pixel's own
point only. On shadows of thin posts the error against 64 rays a pixel falls from 0.37 to 0.11, for 1.2 to 1.4 times the CPU time
under a moved sun.

Pixels on edges of surfaces have samples already (``skugga.terrain.gbuffer.antialias``), and foliage is too fine for planes. Where
all samples of a pixel lie on the plane of its own point, on ground that the view grazes, they take the pixel's mean. An algorithm
that counts in the view's own pixels (``Algorithm.needs_view_pixels``) gets the four pixels of the finer view that its samples of
edges of surfaces belong to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.block_casters import needed_steps
from skugga.shadows.map_edges import mark_changes
from skugga.shadows.passes import ATTACHED_PASS, PassLog
from skugga.shadows.plan import Plan, Step
from skugga.shadows.registry import ALGORITHMS
from skugga.shadows.visibility import fill_steps
from skugga.terrain.casters.caster_types import Casters
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.gbuffer.antialias import MultisampledBuffer
from skugga.terrain.gbuffer.geometry import GeometryBuffer
from skugga.terrain.gbuffer.map_block import EDGE_SAMPLES_PER_SIDE
from skugga.terrain.gbuffer.resolve import FOREST, RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene

MIN_VISIBILITY_CHANGE = 0.2
"""Threshold of the change of a light's visibility between neighbouring pixels that marks an edge. Filtered maps have soft edges."""

SAMPLE_COUNT = 8
"""Number of samples of a pixel that an edge crosses, beside its own point."""

_SAMPLE_OFFSETS = np.array([
    (-0.4375, -0.0625), (-0.3125, 0.3125), (-0.1875, -0.3125), (-0.0625, 0.1875),
    (0.0625, -0.1875), (0.1875, 0.4375), (0.3125, -0.4375), (0.4375, 0.0625),
])  # fmt: skip
"""Offsets of the samples from the pixel's centre, rows and columns in pixels: one in each of eight rows and eight columns."""

TEXEL_SHARE = 1.0
"""Share of a texel's longer side over which samples are spread. Without it, edges show the stairs of texels wider than pixels."""

GROWTH_PX = (1, 8, 8, 8)
"""Reach of each growth of the samples in pixels. Few pixels are left after the first."""

_FINER_OFFSETS = (np.indices((EDGE_SAMPLES_PER_SIDE,) * 2).reshape(2, -1).T + 0.5) / EDGE_SAMPLES_PER_SIDE - 0.5
"""Offsets of the finer view's pixels from the pixel's centre, rows and columns in pixels."""

_TEXEL_OFFSETS = TEXEL_SHARE * _SAMPLE_OFFSETS[[3, 6, 1, 4, 7, 2, 5, 0]]
"""Offsets of the samples in texels. Samples beside one another in the pixel lie apart in the texel."""

MAX_TEXEL_STRETCH, MIN_AXIS_SINE = 4.0, 1e-3
"""Largest length of a texel on a surface that the light grazes, in texels; and the smallest sine between the rays and the normal
that gives an axis."""

MAX_SHIFT_SHARE = 0.25
"""Largest shift of a sample by its texel, as a share of its distance from the eye: it stays before the eye."""

MAX_DISTANCE_RATIO = 1.5
"""Largest ratio of a sample's distance from the eye and that of its pixel's point. Beyond it, the plane leaves the surface."""

_PIXEL_ARRAYS = ("normal_frame", "shading_normal_frame", "crease", "height_m", "surface_kind", "corners_frame_m", "lift_m")
"""Arrays of a geometry buffer that a sample takes from its pixel."""


def smooth_shadow_edges(
    scene: Scene, plan: Plan, picture: MultisampledBuffer, visibilities: dict[str, np.ndarray], casters: Casters, log: PassLog
) -> dict[str, np.ndarray]:
    """Return each light's visibility at a perspective view's points, with means in pixels that an edge of a shadow crosses.

    ``visibilities`` (rows, cols) are those of the points themselves. Raises the errors of the algorithms.
    """
    lights = [light for light in plan.lights if plan.steps_of_light(light)]
    on_plane = _samples_on_planes(picture)
    is_smooth = _smooth_surface_mask(picture, on_plane)
    pixel_mask = _edge_mask(is_smooth, [visibilities[light][: picture.picture_rows] for light in lights])
    sampled_pixel = np.full(pixel_mask.shape, -1)
    sampled_pixel[picture.sampled_pixels] = np.arange(len(on_plane))
    # In pictures full of edges, such as woods, half of the samples: they then are at most four times as many as pixels.
    chosen = slice(None) if pixel_mask.sum() * SAMPLE_COUNT <= pixel_mask.size else slice(None, None, 2)
    kept_layers, requested_layers, log.requested_layers = log.take_layers(), log.requested_layers, frozenset()
    smooth = dict(visibilities)
    is_sampled = np.zeros(pixel_mask.shape, np.bool_)
    counts_in_pixels = any(ALGORITHMS[step.algorithm].needs_view_pixels for light in lights for step in plan.steps_of_light(light))
    row, col = np.nonzero(pixel_mask)
    for growth_px in (0,) if counts_in_pixels else (*GROWTH_PX, 0):
        if not len(row):
            break
        is_sampled[row, col] = True
        is_mixed = np.zeros(len(row), np.bool_)
        shared = sampled_pixel[row, col]  # the places of pixels with samples, all of them on planes
        for light in lights:
            values = _sampled_visibility(scene, plan, light, picture.buffer, (row, col), chosen, casters, log)
            own = visibilities[light][row, col]
            values = np.where(np.isnan(values), own[:, None], values)  # NaN: outside of the maps
            means = (own + values.sum(axis=1)) / np.float32(1 + values.shape[1])
            is_mixed |= np.maximum(values.max(axis=1), own) - np.minimum(values.min(axis=1), own) > MIN_VISIBILITY_CHANGE
            if smooth[light] is visibilities[light]:
                smooth[light] = visibilities[light].copy()
            smooth[light][row, col] = means
            own_samples = smooth[light][picture.picture_rows :].reshape(-1)
            for number in range(picture.sample_count):
                own_samples[shared[shared >= 0] * picture.sample_count + number] = means[shared >= 0]
        row, col = _neighbours(row[is_mixed], col[is_mixed], growth_px, is_smooth & ~is_sampled)
    log.layers, log.requested_layers = kept_layers, requested_layers
    return smooth


def _sampled_visibility(
    scene: Scene, plan: Plan, light: str, buffer: GeometryBuffer, pixels: tuple[np.ndarray, np.ndarray], chosen: slice,
    casters: Casters, log: PassLog,
) -> np.ndarray:  # fmt: skip
    """Return the visibility of a light at the samples of some pixels, rows (n,) and columns (n,): float32 (n, k).

    ``chosen`` are the samples in use. Samples outside of the light's maps are NaN.
    """
    steps = plan.steps_of_light(light)
    if any(ALGORITHMS[step.algorithm].needs_view_pixels for step in steps):
        samples, count = _pixels_of_finer_view(buffer, *pixels), len(_FINER_OFFSETS)
    else:
        points = _samples_of_pixels(buffer, *pixels, _SAMPLE_OFFSETS[chosen])
        samples, count = _spread_over_texels(points, scene, light, steps, _TEXEL_OFFSETS[chosen]), len(_SAMPLE_OFFSETS[chosen])
    steps = needed_steps(scene, steps, samples, casters, log)
    sampled = fill_steps(steps, samples, scene, casters, plan.effect_names, log)
    with log.record_pass(ATTACHED_PASS):
        sampled[attached_shadow_mask(samples, scene, light)] = 0.0
    return sampled[samples.first_sample_row :].reshape(-1)[: len(pixels[0]) * count].reshape(-1, count)


def _neighbours(row: np.ndarray, col: np.ndarray, reach_px: int, allowed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of the neighbours of some pixels at ``row`` and ``col`` (n,), among those ``allowed`` (rows, cols).

    Neighbours are up to ``reach_px`` columns away in the same row, or in the row above or below.
    """
    steps = [(0, step) for step in range(-reach_px, reach_px + 1) if step] + [(-1, 0), (1, 0)]
    is_neighbour = np.zeros(allowed.shape, np.bool_)
    for row_step, col_step in steps:
        is_neighbour[np.clip(row + row_step, 0, len(allowed) - 1), np.clip(col + col_step, 0, allowed.shape[1] - 1)] = True
    rows, cols = np.nonzero(is_neighbour & allowed)
    return rows, cols


def _samples_on_planes(picture: MultisampledBuffer) -> np.ndarray:
    """Return for the pixels with samples whether all these lie on the plane of the pixel's own point on the ground, bool (n,).

    A sample may be off the plane by the width of a pixel.
    """
    buffer, (row, col) = picture.buffer, picture.sampled_pixels
    out = np.zeros(len(row), np.bool_)
    assert isinstance(buffer.view, PerspectiveView)
    if len(row):
        run_in_chunks(
            len(row), _write_samples_on_planes, row, col, picture.picture_rows, picture.sample_count, buffer.position_frame_m,
            buffer.normal_frame, buffer.surface_kind, buffer.view.in_frame(buffer.frame)[0], buffer.view.pixel_tangent, out,
        )  # fmt: skip
    return out


@compiled
def _write_samples_on_planes(first, last, row, col, first_sample_row, count, position, normal, kind, eye, pixel_tangent, out):
    """Write the result of ``_samples_on_planes`` for the pixels [``first``, ``last``) at ``row`` and ``col`` to ``out``.

    ``count`` is the number of samples of a pixel. Samples lie in rows from ``first_sample_row`` on.
    """
    cols = kind.shape[1]
    for n in range(first, last):
        i, j = row[n], col[n]
        is_on_plane = kind[i, j] == RELIEF
        x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
        distance = np.sqrt((x - eye[0]) ** 2 + (y - eye[1]) ** 2 + (z - eye[2]) ** 2)
        for k in range(n * count, (n + 1) * count):
            r, c = first_sample_row + k // cols, k % cols
            height = (
                (position[r, c, 0] - x) * normal[i, j, 0] + (position[r, c, 1] - y) * normal[i, j, 1]
                + (position[r, c, 2] - z) * normal[i, j, 2]
            )  # fmt: skip
            is_on_plane = is_on_plane and kind[r, c] == RELIEF and abs(height) <= pixel_tangent * distance
        out[n] = is_on_plane


def _smooth_surface_mask(picture: MultisampledBuffer, on_plane: np.ndarray) -> np.ndarray:
    """Return which pixels (rows, cols) of a picture show a surface whose samples lie on a plane, bool.

    Of the pixels with samples only those count whose samples are ``on_plane`` (n,).
    """
    rows, buffer = picture.picture_rows, picture.buffer
    is_smooth = buffer.valid[:rows] & (buffer.surface_kind[:rows] != FOREST)
    is_smooth[picture.sampled_pixels] &= on_plane
    return is_smooth


def _edge_mask(is_smooth: np.ndarray, visibilities: Sequence[np.ndarray]) -> np.ndarray:
    """Return which pixels (rows, cols) of ``is_smooth`` lie on either side of an edge of a shadow, bool."""
    edges = np.zeros(is_smooth.shape, np.bool_)
    for visibility in visibilities:  # NaN differs from no neighbour
        mark_changes(np.where(is_smooth, visibility, np.float32(np.nan)), MIN_VISIBILITY_CHANGE, edges)
    return edges


def _samples_of_pixels(buffer: GeometryBuffer, row: np.ndarray, col: np.ndarray, offsets: np.ndarray) -> GeometryBuffer:
    """Return a buffer with a point at each of ``offsets`` (k, 2) from each of some pixels' centres; the last row is padded."""
    view = buffer.view
    assert isinstance(view, PerspectiveView)
    count, cols = len(row) * len(offsets), view.cols
    shape = -(-count // cols), cols
    pixel = np.minimum(np.arange(shape[0] * cols) // len(offsets), len(row) - 1)
    arrays: dict[str, Any] = {}
    for name in _PIXEL_ARRAYS:
        value = getattr(buffer, name)
        if value is not None:
            arrays[name] = value[row, col][pixel].reshape(*shape, *value.shape[2:])
    position = np.empty((*shape, 3))
    eye, camera_from_frame = view.in_frame(buffer.frame)
    run_in_chunks(
        len(row), _write_samples, row, col, buffer.position_frame_m, buffer.normal_frame, eye, camera_from_frame,
        np.array([view.row0, view.col0, view.step_px, view.focal_px]), offsets, position.reshape(-1, 3),
    )  # fmt: skip
    position.reshape(-1, 3)[count:] = position.reshape(-1, 3)[count - 1]
    return replace(
        buffer, valid=np.ones(shape, np.bool_), position_frame_m=position, albedo=None, is_lifted=None, first_sample_row=0,
        sample_pixels=None, mesh_triangle=None, **arrays,
    )  # fmt: skip


def _pixels_of_finer_view(buffer: GeometryBuffer, row: np.ndarray, col: np.ndarray) -> GeometryBuffer:
    """Return a buffer whose samples are the pixels of the finer view within some pixels, on the planes of these.

    Its own pixels, which algorithms that count in pixels expect above the samples, show nothing.
    """
    samples, view = _samples_of_pixels(buffer, row, col, _FINER_OFFSETS), buffer.view
    shape, count = samples.valid.shape, len(_FINER_OFFSETS)
    index = np.minimum(np.arange(shape[0] * shape[1]), len(row) * count - 1)
    pixels = tuple(
        (start[index // count] * EDGE_SAMPLES_PER_SIDE + np.indices((EDGE_SAMPLES_PER_SIDE,) * 2)[axis].reshape(-1)[index % count])
        .reshape(shape)
        for axis, start in enumerate((row, col))
    )  # fmt: skip
    arrays: dict[str, Any] = {}
    for name in (*_PIXEL_ARRAYS, "position_frame_m", "valid"):
        value = getattr(samples, name)
        if value is not None:
            arrays[name] = np.concatenate([np.zeros((view.rows, *value.shape[1:]), value.dtype), value])
    return replace(samples, first_sample_row=view.rows, sample_pixels=pixels, **arrays)


def _spread_over_texels(
    samples: GeometryBuffer, scene: Scene, light: str, steps: Sequence[Step], offsets: np.ndarray
) -> GeometryBuffer:
    """Return samples that are also spread over a texel of a light's maps, by ``offsets`` (k, 2), if there are any."""
    texel_m: np.ndarray | None = None
    assert isinstance(samples.view, PerspectiveView)
    for step in steps:
        find_texels = ALGORITHMS[step.algorithm].accuracy.texel_m
        if find_texels is not None:
            of_step = np.broadcast_to(find_texels(scene, light, step.kinds, step.settings, samples), samples.valid.shape)
            texel_m = of_step if texel_m is None else np.maximum(texel_m, of_step)
    if texel_m is None:
        return samples
    position = np.empty_like(samples.position_frame_m)
    run_in_chunks(
        len(position), _write_spread_samples, samples.position_frame_m, samples.normal_frame, np.ascontiguousarray(texel_m),
        np.array(scene.light_position(light, samples.frame)), samples.view.in_frame(samples.frame)[0], offsets, position,
    )  # fmt: skip
    return replace(samples, position_frame_m=position)


@compiled
def _write_spread_samples(first, last, position, normal, texel, light, eye, offsets, out):
    """Write the samples of rows [``first``, ``last``), moved by ``offsets`` (k, 2) texels within their planes, to ``out``.

    ``light`` (4,) is the homogeneous position of the light. A step of a texel across the light's rays becomes the step in the plane
    that the rays project it on, at most ``MAX_TEXEL_STRETCH`` texels long and ``MAX_SHIFT_SHARE`` of the distance from the ``eye``.
    """
    cols = position.shape[1]
    for i in range(first, last):
        for j in range(cols):
            px, py, pz = position[i, j, 0], position[i, j, 1], position[i, j, 2]
            nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
            lx, ly, lz = light[0] - light[3] * px, light[1] - light[3] * py, light[2] - light[3] * pz
            length = np.sqrt(lx * lx + ly * ly + lz * lz)
            lx, ly, lz = lx / length, ly / length, lz / length
            # Two axes in the plane: across the rays, and along their projection.
            ax, ay, az = ly * nz - lz * ny, lz * nx - lx * nz, lx * ny - ly * nx
            across = np.sqrt(ax * ax + ay * ay + az * az)
            if across < MIN_AXIS_SINE:  # the rays hit the plane at right angles: any axis serves
                ax, ay, az = (1.0 - nx * nx, -nx * ny, -nx * nz) if abs(nx) < 0.9 else (-nx * ny, 1.0 - ny * ny, -ny * nz)
                across = np.sqrt(ax * ax + ay * ay + az * az)
            ax, ay, az = ax / across, ay / across, az / across
            bx, by, bz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
            stretch = min(1.0 / max(abs(lx * nx + ly * ny + lz * nz), 1e-6), MAX_TEXEL_STRETCH)
            k = (i * cols + j) % len(offsets)
            along = texel[i, j] * offsets[k, 0]
            beside = texel[i, j] * offsets[k, 1] * stretch
            distance = np.sqrt((px - eye[0]) ** 2 + (py - eye[1]) ** 2 + (pz - eye[2]) ** 2)
            shift = np.sqrt(along * along + beside * beside)
            scale = min(MAX_SHIFT_SHARE * distance / max(shift, 1e-12), 1.0)
            along, beside = scale * along, scale * beside
            out[i, j, 0], out[i, j, 1] = px + along * ax + beside * bx, py + along * ay + beside * by
            out[i, j, 2] = pz + along * az + beside * bz


@compiled
def _write_samples(first, last, row, col, position, normal, eye, camera_from_frame, camera, offsets, out):
    """Write the samples of the pixels [``first``, ``last``) at ``row`` and ``col`` to ``out`` (n, 3), in the frame, metres.

    A sample is the point of a pixel's plane, through ``position`` with the normal ``normal``, that the eye sees ``offsets`` (k, 2)
    pixels below and to the right of the pixel's centre. Where the view grazes the plane, its distance is limited. ``camera`` holds
    ``row0``, ``col0``, ``step_px`` and ``focal_px`` of the view.
    """
    row0, col0, step_px, focal_px = camera[0], camera[1], camera[2], camera[3]
    m = camera_from_frame
    for n in range(first, last):
        i, j = row[n], col[n]
        px, py, pz = position[i, j, 0] - eye[0], position[i, j, 1] - eye[1], position[i, j, 2] - eye[2]
        nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
        height = px * nx + py * ny + pz * nz
        depth = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz
        for k in range(len(offsets)):
            x = (col0 + (j + offsets[k, 1]) * step_px) / focal_px
            y = (row0 + (i + offsets[k, 0]) * step_px) / focal_px
            rx, ry = x * m[0, 0] + y * m[1, 0] + m[2, 0], x * m[0, 1] + y * m[1, 1] + m[2, 1]
            rz = x * m[0, 2] + y * m[1, 2] + m[2, 2]
            slope = rx * nx + ry * ny + rz * nz
            sample_depth = height / slope if slope * height > 0.0 else MAX_DISTANCE_RATIO * depth
            sample_depth = min(max(sample_depth, depth / MAX_DISTANCE_RATIO), MAX_DISTANCE_RATIO * depth)
            at = n * len(offsets) + k
            out[at, 0], out[at, 1], out[at, 2] = eye[0] + rx * sample_depth, eye[1] + ry * sample_depth, eye[2] + rz * sample_depth
