"""Foliage: alpha-tested pictures keep the share of light that they block, and no shadow turns with the viewer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from unittest.mock import patch

import numpy as np
import pyogrio
import shapely
from scipy.ndimage import gaussian_filter

from skugga.shadows import planar
from skugga.shadows.maps import drawing as map_drawing
from skugga.shadows.truth.metrics import block_shadow_shares, coverage_error
from skugga.shadows.truth.truth import coverage_truth
from skugga.terrain.casters import rays
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer import id_buffer, tree_instances
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.camera import PerspectiveView, look_at
from skugga.terrain.gl.device import device
from skugga.terrain.scene import Scene
from skugga.terrain.trees.foliage import ALPHA_THRESHOLD, TEXTURE_PX, TREE_VARIANTS, Foliage, coverage_mips
from tests.hard_cases.blocks import UP
from tests.hard_cases.cases import MAP_ALGORITHMS, RenderedView, Trial, hard_case
from tests.metrics import flicker
from tests.rasters import ENGINEERING

FOLIAGE_ALGORITHMS = (*MAP_ALGORITHMS, "planar")


def forest_scene(
    trial: Trial, locations: Sequence, sun: tuple[float, float], terrain: object = None, species: str = "mixed", **keys: object
) -> Scene:
    """Return the scene of trees at points (east, north), or of polygons with a density, on level ground or other terrain."""
    geometries = [shapely.Point(*place) if not isinstance(place, shapely.Geometry) else place for place in locations]
    path, kind = trial.folder / "stand.gpkg", geometries[0].geom_type
    path.unlink(missing_ok=True)
    wkb = shapely.to_wkb(np.array(geometries, object))
    pyogrio.raw.write(path, wkb, [], [], geometry_type=kind, crs=keys.pop("crs", ENGINEERING))
    ground = terrain or trial.raster(np.zeros((41, 41), np.float32), ENGINEERING, -2050.0, 2050.0, 100.0)
    return trial.scene(ground, sun=sun, forest=[{"source": path.name, "species": species, **keys}])


# -- mipmaps


@lru_cache
def cutout_foliage(share: float) -> Foliage:
    """Return pictures of one coverage: nothing from the side, blobs of a few texels from above. They are cached as those of
    trees are.
    """
    field = gaussian_filter(np.random.default_rng(7).random((TEXTURE_PX, TEXTURE_PX)), 3.0, mode="wrap")
    alpha = np.where(field <= np.quantile(field, share), 255, 0).astype(np.uint8)
    clear, blobs = (
        coverage_mips(np.dstack([np.full_like(a, 80)] * 3 + [a]), ALPHA_THRESHOLD) for a in (np.zeros_like(alpha), alpha)
    )
    return Foliage(
        tuple(np.stack([clear_mip, blob_mip] * len(TREE_VARIANTS)) for clear_mip, blob_mip in zip(clear, blobs, strict=True))
    )


@contextmanager
def patched_foliage(pictures: Foliage) -> Iterator[None]:
    """Draw trees with other pictures; cached maps do not know them."""
    device().depth_targets.clear()
    with patch.multiple(map_drawing, foliage=lambda: pictures), patch.multiple(planar, foliage=lambda: pictures), \
         patch.multiple(rays, foliage=lambda: pictures), patch.multiple(id_buffer, foliage=lambda: pictures):  # fmt: skip
        yield


CROWN_M, HEIGHT_M, ALTITUDE = 25.6, 150.0, 60.0
EAST_M, NORTH_M = 42.0, 96.0
"""Distance between trees: seen from far above, no shadow falls on another one or below a crown."""


@hard_case(
    "H29", "The coverage of an alpha billboard's shadow is kept at every mip level",
    "level billboards of coverage 0.1 to 0.9, of 256 down to 8 texels of the map, between levels too", {"coverage": 0.02},
    algorithms=FOLIAGE_ALGORITHMS,
)  # fmt: skip
def test_billboards(trial: Trial) -> dict[str, float]:
    """A row of crowns under a sun at 60 degrees, seen from 20 km above, beside their shadows.

    The figure is the dark share of the crowns' whole shadow minus the opaque share of their picture. Shares of blocks of 16 pixels
    would, with 8 texels a crown, scatter by a few dozen samples. The crowns have 20,000 texels in all (quick: 6,000): that scatter
    is below 0.007 here.
    """
    worst, rng = 0.0, np.random.default_rng(3)
    levels = np.arange(0.0, 5.1, 0.5) if trial.thorough else (0.0, 2.5, 4.5, 5.0)
    for level in levels:
        texel_m = CROWN_M / TEXTURE_PX * 2.0**level
        count = int(np.clip((20_000 if trial.thorough else 6_000) * (texel_m / CROWN_M) ** 2, 4, 400))
        cols = int(np.ceil(np.sqrt(count * NORTH_M / EAST_M)))
        rows = -(-count // cols)
        side_m = max((cols + 1) * EAST_M, (rows + 1) * NORTH_M)
        i, j = np.divmod(np.arange(rows * cols), cols)
        places = np.column_stack([(j - (cols - 1) / 2) * EAST_M, (i - (rows - 1) / 2) * NORTH_M - NORTH_M / 3])
        places += rng.uniform(-1.0, 1.0, places.shape)
        scene = forest_scene(trial, places, (180.0, ALTITUDE), species="broadleaf", height=[HEIGHT_M] * 2, crown=[CROWN_M] * 2)
        px = int(np.clip(side_m / texel_m, 256, 640))
        high_m = 20e3
        view = look_at(np.array([0, 0, high_m]), np.zeros(3), UP, float(np.degrees(2 * np.arctan(0.5 * side_m / high_m))), px, px)
        for share in np.arange(1, 10) / 10 if trial.thorough else (0.1, 0.5, 0.9):
            with patched_foliage(cutout_foliage(float(share))):
                options = {"map_size": round(side_m / texel_m) + 25, "filter": 1, "cascades": 1, "fit": "tight"}
                rendered = trial.render_view(scene, view, **options)
            assert len(rendered.buffer.tree_instances) == len(places)
            area = (rendered.dark & (rendered.buffer.surface_kind == RELIEF)).sum() * (side_m / px) ** 2
            coverage_difference = area / (len(places) * CROWN_M**2) - share
            worst = max(worst, abs(coverage_difference))
    return {"coverage": worst}


# -- moving cameras


def pixels_of(view: PerspectiveView, points_earth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest pixels of points (n, 3) before a camera: rows and columns (n,), some outside the picture."""
    x, y, depth_m = ((points_earth_m - view.eye_earth_m) @ view.earth_from_camera).T
    row, col = (((v / depth_m) * view.focal_px - first) / view.step_px for v, first in ((y, view.row0), (x, view.col0)))
    return np.rint(row).astype(int), np.rint(col).astype(int)


def flicker_between(first: RenderedView, second: RenderedView) -> tuple[float, int]:
    """Return the share of one picture's ground points whose class changes in another although truth does not.

    The second result is the number of these points in shadow.
    """
    row, col = np.nonzero(first.truth.decidable & (first.buffer.surface_kind == RELIEF))
    frame = first.buffer.frame
    i, j = pixels_of(second.view, first.buffer.position_frame_m[row, col] @ frame.frame_from_earth + frame.origin_earth_m)  # type: ignore[arg-type]
    rows, cols = second.dark.shape
    inside = (i >= 0) & (i < rows) & (j >= 0) & (j < cols)
    row, col, i, j = row[inside], col[inside], i[inside], j[inside]
    comparable = second.truth.decidable[i, j] & (second.buffer.surface_kind[i, j] == RELIEF)
    changed = flicker(first.dark[row, col], second.dark[i, j], ~first.truth.lit[row, col], ~second.truth.lit[i, j], comparable)
    return changed, int((comparable & ~first.truth.lit[row, col]).sum())


@hard_case(
    "H30", "A billboard tree's shadow does not turn with the camera",
    "a camera that goes 180 degrees round a tree, and one overhead that turns", {"flicker": 1e-3}, algorithms=FOLIAGE_ALGORITHMS,
)  # fmt: skip
def test_camera_round_a_tree(trial: Trial) -> dict[str, float]:
    """The points of the first picture are looked up in the others. They must be decidable in both: leaf edges are excluded."""
    scene = forest_scene(trial, [(0.0, 0.0)], (110.0, 35.0), height=[20.0] * 2, crown=[9.0] * 2, species="conifer")
    px, target = (640 if trial.thorough else 224), np.array([-12.0, 4.0, 0.0])
    orbit_views, overhead_views = [], []
    for azimuth_rad in np.radians(np.linspace(0.0, 180.0, 7 if trial.thorough else 3)):
        direction = np.array([np.sin(azimuth_rad), np.cos(azimuth_rad), 0.0])
        orbit_views.append(look_at(target + 60.0 * direction + [0, 0, 70.0], target, UP, 26.0, px, px))
        above = target + [3.0, 0.0, 110.0]
        overhead_views.append(look_at(above, above - [0, 0, 100.0] + 1e-7 * direction, UP, 30.0, px, px))
    worst = 0.0
    for views in (orbit_views, overhead_views):
        first_view, *later_views = [
            trial.render_view(scene, view, map_size=4096 if trial.thorough else 2048, filter=1) for view in views
        ]
        for other in later_views:
            changed, shadow = flicker_between(first_view, other)
            assert shadow > 100, f"{shadow} points of shadow are compared"
            worst = max(worst, changed)
    return {"flicker": worst}


# -- stands


SAMPLES_PER_SIDE = 2
"""Samples a side that a pixel's visibility is the mean of, as in a finished picture."""


def shadow_shares(rendered: RenderedView) -> np.ndarray:
    """Return shares of shadow over blocks of 16 pixels with ``SAMPLES_PER_SIDE`` x ``SAMPLES_PER_SIDE`` samples."""
    rows, cols = (n // SAMPLES_PER_SIDE for n in rendered.visibility.shape)
    return block_shadow_shares(1.0 - rendered.visibility.reshape(rows, SAMPLES_PER_SIDE, cols, SAMPLES_PER_SIDE).mean(axis=(1, 3)))


def shadow_coverage_error(rendered: RenderedView, blocks: int) -> tuple[float, float]:
    """Return the error of the shadow's coverage over blocks, and truth's mean share of shadow there."""
    true = coverage_truth(rendered.buffer, rendered.scene, rendered.casters, 16 * SAMPLES_PER_SIDE, blocks, 4)
    return coverage_error(shadow_shares(rendered), true), float(np.nanmean(true))


@contextmanager
def undecimated_stands() -> Iterator[None]:
    """Draw whole stands: no stand is decimated, however small its trees are."""
    cache_clearers = tree_instances.tree_instances_in_perspective.cache.clear, tree_instances.tree_instances_in_map.cache.clear
    [clear_cache() for clear_cache in cache_clearers]
    try:
        with patch.object(tree_instances, "MIN_DRAWN_TREE_SHARE", 1.0):
            yield
    finally:
        [clear_cache() for clear_cache in cache_clearers]


def cliff(trial: Trial) -> tuple[Scene, PerspectiveView]:
    """Return trees along the upper edge of a cliff of 100 m; their shadows fall on the plain below it."""
    heights = np.where(np.arange(100)[None, :] < 50, 100.0, 0.0) * np.ones((100, 1))
    ground = trial.raster(heights.astype(np.float32), ENGINEERING, -250.0, 250.0, 5.0, name="cliff")
    places = [(-4.5 + 0.4 * (n % 3), -120.0 + 6.0 * n) for n in range(41)]
    scene = forest_scene(trial, places, (265.0, 60.0), ground, height=[18.0, 24.0], crown=[6.0, 9.0])
    eye = np.array([190.0, -60.0, 120.0])
    return scene, look_at(eye, np.array([60.0, 0.0, 0.0]), UP, 50.0, *_size(trial))


def border(trial: Trial) -> tuple[Scene, PerspectiveView]:
    """Return trees 30 m high a few metres from the edge of the data, towards the sun: crowns extend beyond the rim."""
    ground = trial.raster(np.zeros((41, 41), np.float32), ENGINEERING, -102.5, 102.5, 5.0, name="end")
    places = [(-90.0 + 12.0 * n, -98.0 + 2.0 * (n % 3)) for n in range(16)] + [(97.0, -80.0 + 20.0 * n) for n in range(9)]
    scene = forest_scene(trial, places, (150.0, 30.0), ground, height=[30.0, 30.0], crown=[8.0, 9.0])
    eye = np.array([-20.0, 20.0, 140.0])
    return scene, look_at(eye, np.array([10.0, -45.0, 0.0]), UP, 55.0, *_size(trial))


def _size(trial: Trial) -> tuple[int, int]:
    """Return rows and columns of a picture."""
    return (320, 512) if trial.thorough else (128, 192)


@hard_case(
    "G10", "Coverage is kept with a million trees in view, on a cliff's edge, and at the border of the data",
    "1,000,000 trees (quick: 20,000); a cliff of 100 m; trees higher than their distance from the border",
    {"coverage": 0.02, "coverage against all trees": 0.02}, algorithms=MAP_ALGORITHMS,
)  # fmt: skip
def test_stands(trial: Trial) -> dict[str, float]:
    """Blocks are compared with truth over the drawn trees. The picture's mean is compared with truth over all trees, since
    distant stands are decimated and the remaining trees drawn larger: single trees differ.

    With one sample a pixel half of the bound would be chance: 256 samples a block scatter by 0.015 in the mean. A decimated block
    differs by 0.04 from the whole one by chance: 96 blocks (all of the quick picture) reduce that to 0.004, 24 would reduce it to
    0.009.

    Not for `planar`, which casts no shadow of trees on trees.
    """
    side_m, blocks = (3200.0, 160) if trial.thorough else (450.0, 96)
    half, texels = side_m / 2.0, 4096 if trial.thorough else 2048
    area, small = [shapely.box(-half, -half, half, half)], {"height": [3.0, 5.0], "crown": [1.8, 2.6]}
    scene = forest_scene(trial, area, (240.0, 40.0), density=1000.0, **small)
    eye = np.array([0.0, -0.75 * side_m, 0.3 * side_m])
    view = look_at(eye, np.array([0.0, -0.1 * side_m, 0.0]), UP, 40.0, *_size(trial))
    assert scene.objects.trees is not None
    count = len(scene.objects.trees.thinning_rank)
    assert count > (990_000 if trial.thorough else 19_000)
    rendered = trial.render_view(scene, view.finer(SAMPLES_PER_SIDE), map_size=texels)
    error, shadow = shadow_coverage_error(rendered, blocks)
    assert rendered.buffer.tree_instances is not None and len(rendered.buffer.tree_instances) < 0.7 * count and 0.1 < shadow < 0.9
    errors = [error]
    with undecimated_stands():
        full_buffer = geometry_buffer(scene, view.finer(SAMPLES_PER_SIDE))
        true = coverage_truth(full_buffer, scene, find_casters(scene, full_buffer), 16 * SAMPLES_PER_SIDE, blocks, 4)
    shares = shadow_shares(rendered)
    valid = np.isfinite(true) & np.isfinite(shares)
    for scene, view in (cliff(trial), border(trial)):
        error, shadow = shadow_coverage_error(trial.render_view(scene, view.finer(SAMPLES_PER_SIDE), map_size=texels), blocks)
        assert 0.02 < shadow < 0.9, f"{shadow:.1%} of what is seen is in shadow"
        errors.append(error)
    return {"coverage": max(errors), "coverage against all trees": abs(float(shares[valid].mean() - true[valid].mean()))}
