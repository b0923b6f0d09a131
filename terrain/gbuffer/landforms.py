"""Large landforms around the pixels of a map: generalised normals, and a light that turns where relief runs along it.

Both change shading alone. Shadows, and the choice of the ground that faces away from the sun, use the true normals.

**Generalisation.** Pixels of a small scale show every ridge that the raster has left, and valleys and ranges drown in them. Slopes
for shading are blended with those of smoothed heights, which are exaggerated a little for the height that smoothing takes (the
idea of T. Patterson's *resolution bumping*, 2001, applied to slopes).

**Local light.** A ridge along the light has two flanks of the same brightness. Cartographers turn the light there by up to 30
degrees (E. Imhof, *Cartographic Relief Presentation*, 1965, chapter 9; K. Brassel, *A model for automatic hill-shading*, 1974).
The turn depends on the share of the relief's slopes that face across the light, in a neighbourhood that hangs on the ground and
not on a tile. It is always clockwise, so both flanks of a ridge and all of its length turn alike.

Heights are read at nodes ``NODE_PIXELS`` pixels apart, which count from the grid's origin, so tiles meet without a seam.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.geo.grid import MapView
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import Surface, map_pixel_m
from skugga.terrain.scene import Scene

NODE_PIXELS, ORIENTATION_NODES = 2, 4
"""Pixels from one node to the next, and nodes from one orientation of the relief to the next."""

HEIGHT_PASSES, SLOPE_PASSES = 1, 8
"""Number of binomial filters (1 4 6 4 1)/16 over heights, and over products of slopes. Each adds 1 to the variance, in nodes^2."""

RADIUS_NODES = 2 * HEIGHT_PASSES + 1 + 2 * SLOPE_PASSES
"""Distance in nodes from which ground changes a node: filters and central differences."""

GENERALISED_SLOPE_GAIN = 2.4
"""Factor of smoothed slopes, chosen by eye: ranges gain the contrast that small forms lose (the Alps at zoom 8, the Pamir at 6)."""

MIN_CROSSWISE_SHARE, CROSSWISE_SHARE_RANGE = 0.5, 0.4
"""Share of slopes across the light above which the light turns, and the range from there to the whole turn.

Relief without a direction has the share 0.5.
"""

MIN_SLOPE_ENERGY = 1e-4
"""Mean square of slopes that counts as level: the light need not turn for slopes of 1 %."""


@dataclass(frozen=True, eq=False)
class Landforms:
    """Large landforms at nodes around a map's pixels. NaN where no ground is near.

    Attributes
    ----------
    first_pixel
        Row and column of the first node, in pixels of the map.
    normal_frame
        float32 (rows, cols, 3), the unit normals of smoothed ground.
    first_orientation_pixel
        Row and column of the first orientation, in pixels of the map.
    right_frame, down_frame
        float32 (m, n, 3), the horizontal unit vectors along the grid's rows, and across them.
    slope_products
        float32 (m, n, 3), neighbourhood means of products of the slopes to the right and down: r r, r d and d d.
    """

    first_pixel: tuple[float, float]
    normal_frame: np.ndarray
    first_orientation_pixel: tuple[float, float]
    right_frame: np.ndarray
    down_frame: np.ndarray
    slope_products: np.ndarray


def generalised_normals(
    scene: Scene,
    view: MapView,
    frame: LocalFrame,
    normal_frame: np.ndarray,
    up_frame: np.ndarray,
    pixels: tuple[np.ndarray, np.ndarray] | None = None,
    first_pixel: tuple[int, int] = (0, 0),
) -> np.ndarray:
    """Return the normals for shading of points of a map, with the style's generalisation, as float32 (rows, cols, 3).

    Parameters
    ----------
    scene, view, frame
        The scene, the map, and the frame of the directions.
    normal_frame, up_frame
        float32 (rows, cols, 3), the unit normals and the unit vectors up.
    pixels
        Rows and columns (rows, cols) of the map's pixels in which the points lie. ``None``: there is a point for each pixel from
        ``first_pixel`` on.
    first_pixel
        Row and column of the map's pixel in which the first point lies.
    """
    share = scene.style.generalisation_at(map_pixel_m(scene.world, view))
    if share == 0.0:
        return normal_frame
    forms = landforms(scene, view, frame)
    out = np.empty_like(normal_frame)
    run_in_chunks(
        len(out), _write_generalised_normals, forms.normal_frame, tuple(np.subtract(forms.first_pixel, first_pixel)),
        1.0 / NODE_PIXELS, normal_frame, up_frame, share, GENERALISED_SLOPE_GAIN, pixels, out,
    )  # fmt: skip
    return out


def locally_lit_normals(
    scene: Scene,
    view: MapView,
    frame: LocalFrame,
    normal_frame: np.ndarray,
    up_frame: np.ndarray,
    pixels: tuple[np.ndarray, np.ndarray] | None = None,
    first_pixel: tuple[int, int] = (0, 0),
) -> np.ndarray:
    """Return normals that turn against the light, so that direct light falls on them as a local light does on the true ones.

    Parameters and result are those of ``generalised_normals``. The sun itself, and so every shadow, stays where it is.
    """
    turn_deg = local_light_turn_deg(scene)
    if turn_deg == 0.0:
        return normal_frame
    assert scene.sun is not None
    forms = landforms(scene, view, frame)
    crosswise = crosswise_share(forms, scene.sun.in_frame(frame).astype(np.float32))
    share = np.clip((crosswise - MIN_CROSSWISE_SHARE) / CROSSWISE_SHARE_RANGE, 0.0, 1.0)
    half_turn_tangent = np.tan(np.radians(0.5 * turn_deg)) * share * share * (3.0 - 2.0 * share)
    out = np.empty_like(normal_frame)
    run_in_chunks(
        len(out), _write_turned_normals, half_turn_tangent.astype(np.float32),
        tuple(np.subtract(forms.first_orientation_pixel, first_pixel)), 1.0 / (NODE_PIXELS * ORIENTATION_NODES),
        normal_frame, up_frame, pixels, out,
    )  # fmt: skip
    return out


def local_light_turn_deg(scene: Scene) -> float:
    """Return the largest turn of the style's local light in degrees; 0 if nothing turns.

    Under a low sun it is less: the turned light still reaches slopes of 45 degrees that face across the sun. They would look like
    ground in shadow otherwise.
    """
    if scene.sun is None or not scene.sun_is_up or scene.style.local_light == 0.0:
        return 0.0
    limit = np.tan(np.radians(min(scene.sun.altitude_deg, 89.0))) / scene.style.slope_exaggeration
    return float(min(scene.style.local_light, np.degrees(np.arcsin(np.clip(limit, 0.0, 1.0)))))


def crosswise_share(forms: Landforms, to_sun_frame: np.ndarray) -> np.ndarray:
    """Return the share (m, n) of the slopes' mean square that faces across the light, 0 to 1; 0 on level ground."""
    right, down = forms.right_frame @ to_sun_frame, forms.down_frame @ to_sun_frame
    across_right, across_down = -down, right
    length_squared = np.maximum(right * right + down * down, 1e-12)
    products = forms.slope_products
    across = (
        across_right * across_right * products[..., 0]
        + 2.0 * across_right * across_down * products[..., 1]
        + across_down * across_down * products[..., 2]
    )
    share = across / length_squared / (products[..., 0] + products[..., 2] + MIN_SLOPE_ENERGY)
    return np.asarray(np.nan_to_num(share))


def landform_margin_px() -> int:
    """Return how far from a map's pixels the ground changes their landforms, pixels."""
    return NODE_PIXELS * (RADIUS_NODES + ORIENTATION_NODES + 2)


def _cache_key(scene: Scene, view: MapView, frame: LocalFrame) -> tuple[object, ...]:
    """Return the cache key of ``landforms``: its result does not depend on the sun."""
    return scene.world, scene.elevation, view, frame.key


@cached("scene", 64 * MIB, key=_cache_key)
def landforms(scene: Scene, view: MapView, frame: LocalFrame) -> Landforms:
    """Return the large landforms around a map's pixels, in a frame."""
    lattice, first_pixel = view.coarser_nodes(NODE_PIXELS, margin=ORIENTATION_NODES)
    nodes = lattice.with_pixels_as_nodes()
    surface = Surface(scene.world, scene.elevation, nodes.grid)
    row0, col0, extra = int(nodes.row0), int(nodes.col0), 2 * RADIUS_NODES
    heights = surface.height_window(row0 - RADIUS_NODES, col0 - RADIUS_NODES, nodes.rows + extra, nodes.cols + extra).height_m
    known = np.isfinite(heights)
    weight = _smooth(known.astype(np.float64), HEIGHT_PASSES)
    with np.errstate(invalid="ignore"):
        smooth = _smooth(np.where(known, heights, 0.0).astype(np.float64), HEIGHT_PASSES) / np.where(weight > 0.0, weight, np.nan)
    margin = RADIUS_NODES - 2 * HEIGHT_PASSES
    point = surface.window_positions(row0 - margin, col0 - margin, smooth, frame)
    right, down = point[1:-1, 2:] - point[1:-1, :-2], point[2:, 1:-1] - point[:-2, 1:-1]
    normal = _unit(np.cross(down, right))
    up = _unit(point[1:-1, 1:-1] - scene.world.up_origin(frame))
    right = _unit(right - np.sum(right * up, axis=-1, keepdims=True) * up)
    down = np.cross(right, up)
    steepness = np.sum(normal * up, axis=-1, keepdims=True)
    slopes = [np.nan_to_num(-np.sum(normal * axis, axis=-1) / steepness[..., 0]) for axis in (right, down)]
    products = [_smooth(slopes[i] * slopes[j], SLOPE_PASSES) for i, j in ((0, 0), (0, 1), (1, 1))]
    inside = slice(2 * SLOPE_PASSES, -2 * SLOPE_PASSES), slice(2 * SLOPE_PASSES, -2 * SLOPE_PASSES)
    skipped = -row0 % ORIENTATION_NODES, -col0 % ORIENTATION_NODES  # orientations count from the grid's origin
    coarse = slice(skipped[0], None, ORIENTATION_NODES), slice(skipped[1], None, ORIENTATION_NODES)
    first_row, first_col = (first + NODE_PIXELS * skip for first, skip in zip(first_pixel, skipped, strict=True))
    orientation = (array[coarse] for array in (right[inside], down[inside], np.stack(products, axis=-1)))
    return Landforms(
        first_pixel, np.ascontiguousarray(normal[inside], np.float32), (first_row, first_col),
        *(np.ascontiguousarray(array, np.float32) for array in orientation),
    )  # fmt: skip


def _smooth(values: np.ndarray, passes: int) -> np.ndarray:
    """Return values (rows - 4 ``passes``, cols - 4 ``passes``) float64, filtered by (1 4 6 4 1)/16 along both axes."""
    for _ in range(passes):
        for _ in range(2):
            values = (values[:-4] + values[4:] + 4.0 * (values[1:-3] + values[3:-1]) + 6.0 * values[2:-2]) / 16.0
            values = values.T
    return values


def _unit(vector: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) scaled to length 1."""
    return np.asarray(vector / np.linalg.norm(vector, axis=-1, keepdims=True))


@compiled
def _write_generalised_normals(first, last, coarse, first_pixel, nodes_per_pixel, normal, up, share, gain, pixels, out):
    """Write the blended normals of rows [first, last) of points to ``out`` (rows, cols, 3).

    ``coarse`` (n, m, 3) are normals at nodes, of which the first lies at ``first_pixel``. ``share`` is the part of their slopes,
    times ``gain``, in the blend. ``pixels`` are rows and columns of the points' pixels, or ``None``.
    """
    rows, cols = coarse.shape[:2]
    for i in range(first, last):
        for j in range(out.shape[1]):
            pixel_row, pixel_col = (i, j) if pixels is None else (pixels[0][i, j], pixels[1][i, j])
            y, x = (pixel_row - first_pixel[0]) * nodes_per_pixel, (pixel_col - first_pixel[1]) * nodes_per_pixel
            r, c = min(int(y), rows - 2), min(int(x), cols - 2)
            down, right = y - r, x - c
            a, b, d, e = (1.0 - down) * (1.0 - right), (1.0 - down) * right, down * (1.0 - right), down * right
            mx = a * coarse[r, c, 0] + b * coarse[r, c + 1, 0] + d * coarse[r + 1, c, 0] + e * coarse[r + 1, c + 1, 0]
            my = a * coarse[r, c, 1] + b * coarse[r, c + 1, 1] + d * coarse[r + 1, c, 1] + e * coarse[r + 1, c + 1, 1]
            mz = a * coarse[r, c, 2] + b * coarse[r, c + 1, 2] + d * coarse[r + 1, c, 2] + e * coarse[r + 1, c + 1, 2]
            ux, uy, uz = np.float64(up[i, j, 0]), np.float64(up[i, j, 1]), np.float64(up[i, j, 2])
            nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
            rise, coarse_rise = nx * ux + ny * uy + nz * uz, mx * ux + my * uy + mz * uz
            if rise > 0.0 and coarse_rise > 0.0:  # not on overhangs, nor where no ground is near
                own, blended = (1.0 - share) / rise, share * gain / coarse_rise
                vertical = 1.0 - (1.0 - share) - share * gain
                nx = own * nx + blended * mx + vertical * ux
                ny = own * ny + blended * my + vertical * uy
                nz = own * nz + blended * mz + vertical * uz
                length = np.sqrt(nx * nx + ny * ny + nz * nz)
                nx, ny, nz = nx / length, ny / length, nz / length
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = nx, ny, nz


@compiled
def _write_turned_normals(first, last, half_turn_tangent, first_pixel, nodes_per_pixel, normal, up, pixels, out):
    """Write the normals of rows [first, last) of points, turned counterclockwise about the vertical, to ``out`` (rows, cols, 3).

    ``half_turn_tangent`` (n, m) is the tangent of half the turn at nodes, of which the first lies at ``first_pixel``. ``pixels``
    are rows and columns of the points' pixels, or ``None``.
    """
    rows, cols = half_turn_tangent.shape
    for i in range(first, last):
        for j in range(out.shape[1]):
            pixel_row, pixel_col = (i, j) if pixels is None else (pixels[0][i, j], pixels[1][i, j])
            y, x = (pixel_row - first_pixel[0]) * nodes_per_pixel, (pixel_col - first_pixel[1]) * nodes_per_pixel
            r, c = min(int(y), rows - 2), min(int(x), cols - 2)
            down, right = y - r, x - c
            upper = half_turn_tangent[r, c] + (half_turn_tangent[r, c + 1] - half_turn_tangent[r, c]) * right
            lower = half_turn_tangent[r + 1, c] + (half_turn_tangent[r + 1, c + 1] - half_turn_tangent[r + 1, c]) * right
            tangent = upper + (lower - upper) * down
            nx, ny, nz = normal[i, j, 0], normal[i, j, 1], normal[i, j, 2]
            if tangent > 0.0:
                ux, uy, uz = up[i, j, 0], up[i, j, 1], up[i, j, 2]
                scale = np.float32(1.0) / (np.float32(1.0) + np.float32(tangent * tangent))
                sine = np.float32(2.0 * tangent) * scale
                versine = np.float32(tangent) * sine  # 1 - cosine
                cosine, lift = np.float32(1.0) - versine, versine * (nx * ux + ny * uy + nz * uz)
                nx, ny, nz = (
                    cosine * nx + sine * (uy * nz - uz * ny) + lift * ux,
                    cosine * ny + sine * (uz * nx - ux * nz) + lift * uy,
                    cosine * nz + sine * (ux * ny - uy * nx) + lift * uz,
                )
            out[i, j, 0], out[i, j, 1], out[i, j, 2] = nx, ny, nz
