"""Compute the light of the whole sky in the pixels of a map: a sky of many suns, each with its own cast shadows.

Horizons are computed once for a map's ground, towards ``AZIMUTHS`` azimuths, at nodes ``NODE_PIXELS`` pixels apart
(``skugga.shadows.horizons``). For a position of the sun, each node sums the light of the sky's sectors above its horizons
(``skugga.shadows.sky_light.luminance``). The sum is a vector, the irradiance on a surface its product with the normal. Vectors vary
slowly and are interpolated between nodes; normals are those of the pixels.

Source: P. Kennelly and J. Stewart 2014, *General sky models for illuminating terrains*. There a sky is some hundred suns, whose
shadows are cast one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skugga.shadows.block_normals import up_and_pixels
from skugga.shadows.horizons.azimuths import evenly_spaced_azimuths_deg
from skugga.shadows.horizons.block_ground import block_grid, block_plane, horizon_blocks
from skugga.shadows.horizons.object_ground import has_objects, object_grids
from skugga.shadows.horizons.scan import horizons_towards
from skugga.shadows.sky_light.luminance import HORIZON_CODES, light_tables
from skugga.terrain.cache import MIB, cached
from skugga.terrain.compiled import compiled, run_in_chunks
from skugga.terrain.effects.effect import ShadingBlock
from skugga.terrain.geo.grid import MapView, PixelWindow
from skugga.terrain.geo.world import LocalFrame
from skugga.terrain.ground.surface import map_pixel_m
from skugga.terrain.scene import Scene

AZIMUTHS = 16
"""Number of azimuths towards which horizons are computed."""

NODE_PIXELS = 2
"""Pixels from one node with horizons to the next."""

MAX_CONVERGENCE_DEG = 3.0
"""Maximum turn of the grid's axes against true north within a part whose horizons are computed together."""

MIN_FACTOR = 0.05
"""Minimum irradiance, on overhanging ground, relative to level, open ground."""


@dataclass(frozen=True, eq=False)
class SkyHorizons:
    """Horizons at nodes over a map's pixels.

    Attributes
    ----------
    code
        uint8 (``AZIMUTHS``, rows, cols): the sine of the horizon's angle, in steps of 1 / (``HORIZON_CODES`` - 1); 0 if level.
    first_pixel
        Row and column of the first node, in pixels of the map.
    parts
        Rows and columns of the parts whose azimuths count from one north, and the rotations (3, 3) of these parts, whose columns
        are earth-fixed directions to the east, to the north and up.
    """

    code: np.ndarray
    first_pixel: tuple[float, float]
    parts: tuple[tuple[PixelWindow, np.ndarray], ...]


def sky_light_factor(
    scene: Scene,
    view: MapView,
    frame: LocalFrame,
    normal_frame: np.ndarray,
    up_frame: np.ndarray,
    pixels: tuple[np.ndarray, np.ndarray] | None = None,
    first_pixel: tuple[int, int] = (0, 0),
) -> np.ndarray:
    """Return the irradiance of the sky at points of a map as float32 (rows, cols).

    It is relative to level ground that sees the whole sky.

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
    style, horizons = scene.style, _sky_horizons(scene, view)
    light = np.zeros((*horizons.code.shape[1:], 3), np.float32)
    for (rows, cols), earth_from_enu in horizons.parts:
        tables = _light_tables_in_frame(scene, earth_from_enu, frame)
        code, part_light = horizons.code[:, rows, cols], light[rows, cols]
        run_in_chunks(len(part_light), _add_sectors, code, tables, part_light)
    out = np.empty(normal_frame.shape[:2], np.float32)
    run_in_chunks(
        len(out), _write_factors, light, tuple(np.subtract(horizons.first_pixel, first_pixel)), 1.0 / NODE_PIXELS, normal_frame,
        up_frame,
        style.slope_exaggeration_at(map_pixel_m(scene.world, view)), style.max_shaded_slope, pixels, out,
    )  # fmt: skip
    return out


def _light_tables_in_frame(scene: Scene, earth_from_enu: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Return ``light_tables`` under a scene's sky, seen from a place with the rotation ``earth_from_enu``, in a local frame."""
    altitude_deg, azimuth_deg, cover = 90.0, 0.0, 1.0
    if scene.sun is not None and scene.style.sky != "overcast":
        east, north, up = scene.sun.to_sun_earth @ earth_from_enu
        altitude_deg = float(np.degrees(np.arcsin(np.clip(up, -1.0, 1.0))))
        azimuth_deg = float(np.degrees(np.arctan2(east, north)))
        cover = scene.loaded.level.weather.cloud_cover
    tables = light_tables(AZIMUTHS, cover, altitude_deg, azimuth_deg)
    return np.asarray(tables @ (frame.frame_from_earth @ earth_from_enu).T, np.float32)


def block_sky_light(block: ShadingBlock) -> np.ndarray:
    """Return ``sky_light_factor`` at the points of a map's block, float32 (rows, cols); undefined where there is no surface."""
    buffer, view = block.buffer, block.view
    assert isinstance(view, MapView)
    up, pixels = up_and_pixels(block)
    return sky_light_factor(block.scene, view, buffer.frame, buffer.shading_normal_frame, up, pixels)


def _cache_key(scene: Scene, view: MapView) -> tuple[object, ...]:
    """Return the cache key of ``_sky_horizons``: its result does not depend on the sun."""
    return scene.world, scene.elevation, scene.objects, view


@cached("scene", 192 * MIB, key=_cache_key)
def _sky_horizons(scene: Scene, view: MapView) -> SkyHorizons:
    """Return the horizons at nodes over a map's pixels."""
    nodes, first_pixel = view.coarser_nodes(NODE_PIXELS)
    code = np.zeros((AZIMUTHS, nodes.rows, nodes.cols), np.uint8)
    parts: list[tuple[PixelWindow, np.ndarray]] = []
    for part, row, col in horizon_blocks(scene, nodes, max_convergence_deg=MAX_CONVERGENCE_DEG):
        rows, cols = slice(row, row + part.rows), slice(col, col + part.cols)
        window = code[:, rows, cols]
        parts.append(((rows, cols), block_plane(scene.world, part, *part.centre_node).earth_from_enu))
        grid = object_grids(scene, part)[0] if has_objects(scene) else block_grid(scene, part)
        for horizons in horizons_towards(grid, evenly_spaced_azimuths_deg(AZIMUTHS)):
            tangent = horizons.orientation.grid_order_view(horizons.tangent)
            run_in_chunks(part.rows, _encode_horizons, tangent, window[horizons.number])
    return SkyHorizons(code, first_pixel, tuple(parts))


@compiled
def _encode_horizons(first, last, tangent, out):
    """Write the codes of horizons of rows [first, last) to ``out`` uint8 (rows, cols), given the tangents of their angles."""
    steps = np.float32(HORIZON_CODES - 1)
    for row in range(first, last):
        for col in range(out.shape[1]):
            rise = max(tangent[row, col], np.float32(0.0))
            out[row, col] = np.uint8(steps * rise / np.sqrt(np.float32(1.0) + rise * rise) + np.float32(0.5))


@compiled
def _add_sectors(first, last, code, tables, out):
    """Add the light of all sectors above the horizons of rows [first, last) to ``out`` (rows, cols, 3)."""
    for row in range(first, last):
        for sector in range(len(code)):
            for col in range(out.shape[1]):
                horizon = code[sector, row, col]
                out[row, col, 0] += tables[sector, horizon, 0]
                out[row, col, 1] += tables[sector, horizon, 1]
                out[row, col, 2] += tables[sector, horizon, 2]


@compiled
def _write_factors(first, last, light, first_pixel, nodes_per_pixel, normal, up, exaggeration, max_slope, pixels, out):
    """Write the irradiance on rows [first, last) of points to ``out`` (rows, cols).

    ``light`` (n, m, 3) holds vectors in the frame at nodes, of which the first lies at ``first_pixel``. ``pixels`` are rows
    and columns of the points' pixels, or ``None``. Slopes are exaggerated as for direct light.
    """
    rows, cols = light.shape[:2]
    for i in range(first, last):
        for j in range(out.shape[1]):
            pixel_row, pixel_col = (i, j) if pixels is None else (pixels[0][i, j], pixels[1][i, j])
            y, x = (pixel_row - first_pixel[0]) * nodes_per_pixel, (pixel_col - first_pixel[1]) * nodes_per_pixel
            r, c = min(int(y), rows - 2), min(int(x), cols - 2)
            down, right = y - r, x - c
            a, b, d, e = (1.0 - down) * (1.0 - right), (1.0 - down) * right, down * (1.0 - right), down * right
            x_light = a * light[r, c, 0] + b * light[r, c + 1, 0] + d * light[r + 1, c, 0] + e * light[r + 1, c + 1, 0]
            y_light = a * light[r, c, 1] + b * light[r, c + 1, 1] + d * light[r + 1, c, 1] + e * light[r + 1, c + 1, 1]
            z_light = a * light[r, c, 2] + b * light[r, c + 1, 2] + d * light[r + 1, c, 2] + e * light[r + 1, c + 1, 2]
            ux, uy, uz = np.float64(up[i, j, 0]), np.float64(up[i, j, 1]), np.float64(up[i, j, 2])
            nx, ny, nz = np.float64(normal[i, j, 0]), np.float64(normal[i, j, 1]), np.float64(normal[i, j, 2])
            rise = nx * ux + ny * uy + nz * uz
            if rise > 0.0:
                hx, hy, hz = nx - rise * ux, ny - rise * uy, nz - rise * uz  # the horizontal part
                slope = exaggeration * np.sqrt(hx * hx + hy * hy + hz * hz) / rise
                factor = exaggeration / np.sqrt(1.0 + slope * slope / (max_slope * max_slope))
                nx, ny, nz = rise * ux + factor * hx, rise * uy + factor * hy, rise * uz + factor * hz
                length = np.sqrt(nx * nx + ny * ny + nz * nz)
                nx, ny, nz = nx / length, ny / length, nz / length
            out[i, j] = max(nx * x_light + ny * y_light + nz * z_light, MIN_FACTOR)
