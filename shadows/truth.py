"""`truth`: the sun's visibility by rays, through the same triangles and from the same points as every algorithm's.

Class of a pixel: lit if its triangle's geometric normal faces the sun and a ray from its visible point, lifted off the
triangle by the offset that ``terrain.rays`` derives, meets nothing. A pixel is *decidable* if the answers at one, two and
four offsets and at S stratified sub-samples of the pixel all agree; else it is boundary, and no error is counted there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from shadows.attached import attached, turned_away
from shadows.passes import PassLog
from shadows.plan import TruthSettings
from terrain.geometry import GeometryBuffer, map_geometry
from terrain.grid import MapView
from terrain.rays import RayScene
from terrain.reach import Casters, caster_sheets, casters_of
from terrain.scene import Scene

RAYS_PASS = "sun/relief: rays"
PASSES = (RAYS_PASS,)

SUN_RADIUS_DEG = 0.265
"""The sun's disc spans 0.53 degrees."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Truth of one buffer under one sun; bool arrays (rows, cols), False off the surface.

    ``lit`` is the class at the visible points, ``attached`` where the normal does not face the sun, ``decidable`` where
    truth can be held against an algorithm, ``there`` where there is a surface.
    """

    lit: np.ndarray
    attached: np.ndarray
    decidable: np.ndarray
    there: np.ndarray

    @property
    def boundary(self) -> float:
        """Share of the surface's pixels that are not decidable; 0 without a surface."""
        return float(1.0 - self.decidable.sum() / self.there.sum()) if self.there.any() else 0.0


def fill(buffer: GeometryBuffer, scene: Scene, casters: Casters, settings: TruthSettings, log: PassLog) -> np.ndarray:
    """Visibility of the sun (rows, cols), float32 in [0, 1]: the common interface of the algorithms.

    With ``sun_samples`` over 1 the sun is a disc of that many stratified directions, and visibility their mean.
    """
    with log.run(RAYS_PASS):
        rays = ray_scene(buffer, scene, casters)
        to_sun = buffer.frame.frame_from_earth @ _sun(scene)
        directions = [to_sun] if settings.sun_samples == 1 else sun_disc(to_sun, settings.sun_samples)
        visibility = np.zeros(buffer.there.shape, np.float32)
        for direction in directions:
            visibility += lit_from(buffer, rays, direction)
        return visibility / np.float32(len(directions))


def truth_of(buffer: GeometryBuffer, scene: Scene, casters: Casters, samples: int = 4, seed: int = 0) -> Truth:
    """The classes of a buffer's points and where they are decidable, with ``samples`` (a square) sub-samples a pixel."""
    dark = np.zeros(buffer.there.shape, bool)
    turned = attached(buffer, scene) & buffer.there
    if scene.sun is None or (scene.highest_sun_deg or 0.0) <= 0.0 or not buffer.there.any():
        return Truth(dark, turned, buffer.there.copy(), buffer.there)
    rays = ray_scene(buffer, scene, casters)
    to_sun = buffer.frame.frame_from_earth @ _sun(scene)
    lit = lit_from(buffer, rays, to_sun)
    decidable = buffer.there.copy()
    for offsets in (2.0, 4.0):
        decidable &= lit_from(buffer, rays, to_sun, offsets) == lit
    for view in sub_views(buffer.view, samples, seed):
        sample = map_geometry(scene.surface(view.grid), view, buffer.frame)
        decidable &= sample.there & (lit_from(sample, rays, to_sun) == lit)
    return Truth(lit, turned, decidable, buffer.there)


def soft_truth(buffer: GeometryBuffer, scene: Scene, casters: Casters, samples: int = 64) -> np.ndarray:
    """Visibility (rows, cols) of the sun's disc at a buffer's points: the reference of filtered variants; NaN off the surface."""
    visibility = fill(buffer, scene, casters, TruthSettings(sun_samples=samples), PassLog())
    return np.where(buffer.there, visibility, np.nan)


def coverage_truth(
    buffer: GeometryBuffer, scene: Scene, casters: Casters, block_px: int, blocks: int = 256, samples: int = 64, seed: int = 0
) -> np.ndarray:
    """True shadow shares of blocks of ``block_px`` pixels: (rows // block_px, cols // block_px), NaN where none was taken.

    At most ``blocks`` of those with a surface are taken, stratified over the picture; a pixel has ``samples`` (a square)
    regular sub-samples.
    """
    shape = tuple(size // block_px for size in buffer.there.shape)
    out = np.full(shape, np.nan)
    has_surface = buffer.there[: shape[0] * block_px, : shape[1] * block_px]
    has_surface = has_surface.reshape(shape[0], block_px, shape[1], block_px).any(axis=(1, 3))
    candidates = np.flatnonzero(has_surface)
    if not len(candidates) or scene.sun is None:
        return out
    bounds = np.linspace(0, len(candidates), min(blocks, len(candidates)) + 1).astype(int)
    rng = np.random.default_rng(seed)
    rays = ray_scene(buffer, scene, casters)
    to_sun = buffer.frame.frame_from_earth @ _sun(scene)
    surface, view, side = scene.surface(buffer.view.grid), buffer.view, int(round(samples**0.5))
    dark_everywhere = (scene.highest_sun_deg or 0.0) <= 0.0
    for first, last in zip(bounds[:-1], bounds[1:], strict=True):
        i, j = np.unravel_index(candidates[rng.integers(first, last)], shape)
        if dark_everywhere:
            out[i, j] = 1.0
            continue
        start = (np.arange(side) + 0.5) / side - 0.5
        fine = replace(
            view,
            row0=view.row0 + (i * block_px + start[0]) * view.row_step,
            col0=view.col0 + (j * block_px + start[0]) * view.col_step,
            row_step=view.row_step / side,
            col_step=view.col_step / side,
            rows=block_px * side,
            cols=block_px * side,
        )
        sample = map_geometry(surface, fine, buffer.frame)
        if sample.there.any():
            out[i, j] = 1.0 - lit_from(sample, rays, to_sun)[sample.there].mean()
    return out


def surface_error(buffer: GeometryBuffer, scene: Scene, casters: Casters, size_px: int = 256) -> float:
    """Simplification: share of pixels whose truth differs between the drawn surface and the full raster's.

    The full surface is the raster's bilinear one on a grid of half its cells (or half the drawn step, if that is finer).
    Taken on ``size_px`` pixels a side round the middle of what is there; both truths at the pixels' own points.
    """
    view = buffer.view
    if not buffer.there.any():
        return 0.0
    rows, cols = min(size_px, view.rows), min(size_px, view.cols)
    middle = [int(np.median(index)) for index in np.nonzero(buffer.there)]
    row, col = (
        int(np.clip(m - side // 2, 0, size - side))
        for m, side, size in zip(middle, (rows, cols), (view.rows, view.cols), strict=True)
    )
    part = view.part(row, col, rows, cols)
    surface = scene.surface(view.grid)
    cell_m = scene.elevation.cell_size_m(scene.world.metres_per_unit)
    finer = max(int(np.ceil(np.log2(2.0 * surface.step_m / min(cell_m, surface.step_m)))), 1)
    grid = view.grid.finer(finer)
    fine = MapView(grid, part.row0 * 2**finer, part.col0 * 2**finer, part.row_step * 2**finer, part.col_step * 2**finer, rows, cols)
    classes = []
    for its_view in (part, fine):
        its = map_geometry(scene.surface(its_view.grid), its_view, buffer.frame)
        if not its.there.any() or scene.sun is None or (scene.highest_sun_deg or 0.0) <= 0.0:
            return 0.0
        rays = ray_scene(its, scene, casters_of(scene, its))
        classes.append((lit_from(its, rays, its.frame.frame_from_earth @ _sun(scene)), its.there))
    both = classes[0][1] & classes[1][1]
    return float((classes[0][0] != classes[1][0])[both].mean()) if both.any() else 0.0


@lru_cache(maxsize=1)
def ray_scene(buffer: GeometryBuffer, scene: Scene, casters: Casters) -> RayScene:
    """Everything that can shade a buffer's points, for rays; the last one is kept, since building it costs most."""
    return RayScene(caster_sheets(scene, buffer, casters))


def lit_from(buffer: GeometryBuffer, rays: RayScene, direction: np.ndarray, offsets: float = 1.0) -> np.ndarray:
    """Where a buffer's points see a direction (3,) of its frame: bool (rows, cols), False off the surface."""
    facing = buffer.there & ~turned_away(buffer.normal_frame, np.asarray(direction, np.float64))
    start = buffer.position_frame_m[facing] + offsets * rays.offset_m * buffer.normal_frame[facing]
    out = np.zeros(buffer.there.shape, bool)
    out[facing] = ~rays.blocked(start, direction)
    return out


def sub_views(view: MapView, samples: int, seed: int = 0) -> list[MapView]:
    """Views shifted within a pixel: one place in each of ``samples`` (a square number) strata, drawn by a seed."""
    side = int(round(samples**0.5))
    if side * side != samples:
        raise ValueError(f"samples: {samples} is not a square")
    rng = np.random.default_rng(seed)
    places = [((i + rng.random()) / side - 0.5, (j + rng.random()) / side - 0.5) for i in range(side) for j in range(side)]
    return [replace(view, row0=view.row0 + row * view.row_step, col0=view.col0 + col * view.col_step) for row, col in places]


def sun_disc(to_sun: np.ndarray, samples: int, radius_deg: float = SUN_RADIUS_DEG) -> np.ndarray:
    """Unit directions (samples, 3) over the sun's disc, equal areas: Vogel's spiral (1979)."""
    across = np.cross(to_sun, [0.0, 0.0, 1.0] if abs(to_sun[2]) < 0.9 else [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    aside = np.cross(across, to_sun)
    number = np.arange(samples)
    angle, distance = number * np.pi * (3.0 - 5.0**0.5), np.tan(np.radians(radius_deg)) * np.sqrt((number + 0.5) / samples)
    directions = to_sun + distance[:, None] * (np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * aside)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _sun(scene: Scene) -> np.ndarray:
    assert scene.sun is not None
    return scene.sun.to_sun_earth
