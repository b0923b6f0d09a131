"""Seams and azimuths: two windows of the same ground meet, and sweep lines run in all directions."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from skugga.shadows.truth.metrics import edge_metric_coverage, error_metrics, interior_region, metric_coverage
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, ray_scene
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, View, hard_case
from tests.hard_cases.ground import CORNER_M, UTM, share_of_mask, view_from_above

CELL_M = 32.0

SEAM_PX = 2

MOUNTAIN_PX = 64
"""Side of H32's picture; its mountains have twice as many cells."""

NEIGHBOURS = ((-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1))
"""Rows and columns of the nodes round a node, in their order."""


def hills(cells: int, height_m: float, seed: int = 4, rough_m: float = 0.0) -> np.ndarray:
    """Return rolling ground (cells, cells) float32 of a few waves up to about ``height_m``, with noise ``rough_m`` per cell."""
    rng = np.random.default_rng(seed)
    row, col = np.mgrid[:cells, :cells]
    waves = sum(np.sin((a * row + b * col) / 9.0 + c) for a, b, c in rng.uniform(-1.0, 1.0, (5, 3)) * (1.0, 1.0, np.pi))
    return (height_m * (0.5 + 0.1 * waves) + rough_m * rng.uniform(-1.0, 1.0, (cells, cells))).astype(np.float32)


def seam_windows(trial: Trial, scene: Scene, pixels: int) -> tuple[View, View, View]:
    """Return the west half, the east half and the whole of a view of the level's middle."""
    view = view_from_above(trial, scene, pixels)
    if isinstance(view, MapView):
        west, south, east, north = scene.elevation.bounds
        quarter = (east - west) / 4
        view = scene.view(bounds=(west + quarter, south + quarter, east - quarter, north - quarter), size=(pixels, pixels))
    half = pixels // 2
    return view.part(0, 0, pixels, half), view.part(0, half, pixels, half), view


def near_seam(pixels: int) -> np.ndarray:
    """Return the pixels of the whole within ``SEAM_PX`` of the seam between the halves, (1, cols)."""
    return np.abs(np.arange(pixels) + 0.5 - pixels / 2)[None] < SEAM_PX


@hard_case(
    "H19",
    "Seams of blocks and tiles throw no shadow, for nothing hangs down from them",
    "level ground and hills under a sun at 0.5 to 5 degrees, drawn in two windows; within 2 px of where they meet",
    {"false_shadow": 0.0, "false_shadow of level ground": 0.0, "surface lost": 0.0},
)
def test_seams_throw_nothing(trial: Trial) -> dict[str, float]:
    cells, pixels = (512, 256) if trial.thorough else (128, 64)
    worst = dict.fromkeys(("false_shadow", "false_shadow of level ground", "surface lost"), 0.0)
    suns = [(90.0, 0.5), (270.0, 1.0), (253.0, 2.0), (17.0, 3.0), (135.0, 5.0)]
    for ground, heights in (("hills", hills(cells, 300.0)), ("level", np.full((cells, cells), 200.0, np.float32))):
        path = trial.raster(heights, UTM, *CORNER_M, CELL_M, name=ground)
        scene = trial.scene(path, (0, 45), name=ground, effects={"cast_shadows": "on"})
        for azimuth, altitude in suns if trial.thorough else suns[:: 3 if ground == "level" else 5]:
            sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
            west, east, full_picture = (
                trial.render_view(sunlit_scene, view, map_size=2048) for view in seam_windows(trial, sunlit_scene, pixels)
            )
            dark = np.hstack([west.dark, east.dark])
            valid = np.hstack([west.buffer.valid, east.buffer.valid])
            seam = near_seam(pixels) & full_picture.buffer.valid
            worst["surface lost"] = max(worst["surface lost"], share_of_mask(~valid, seam))
            if ground == "level":
                worst["false_shadow of level ground"] = max(worst["false_shadow of level ground"], share_of_mask(dark, seam))
            else:
                truth = full_picture.truth
                worst["false_shadow"] = max(worst["false_shadow"], share_of_mask(dark, seam & truth.lit & truth.decidable))
    return worst


def _mountains(trial: Trial) -> Scene:
    cells = 2 * MOUNTAIN_PX
    return trial.scene(trial.raster(hills(cells, 1200.0, seed=11, rough_m=6.0), UTM, *CORNER_M, CELL_M), (0, 10))


@hard_case(
    "H32",
    "Lines along the sun's azimuth agree with rays at every azimuth, and leave no seam",
    "mountains under a sun at 10 degrees at all whole azimuths (quick: 12 of them), drawn in two windows",
    {"edge_p95_px": 1.0, "interior": 2e-4, "wrong at the seam": 0.01},
    algorithms=("sweep",),
)
def test_every_azimuth(trial: Trial) -> dict[str, float]:
    """A pixel is a cell. Off the axes and diagonals lines run between nodes, so that the octants differ."""
    scene, pixels = _mountains(trial), MOUNTAIN_PX
    edge_px = interior = at_the_seam = 0.0
    for azimuth in range(360) if trial.thorough else (1, 46, 180, 254):
        sunlit_scene = scene.with_sun(SunSpec(azimuth=float(azimuth), altitude=10.0))
        west, east, full_picture = (trial.render_view(sunlit_scene, view) for view in seam_windows(trial, sunlit_scene, pixels))
        truth, visibility = full_picture.truth, np.hstack([west.visibility, east.visibility])
        metrics = error_metrics(visibility, truth, CELL_M)
        assert 0.05 < (visibility < 0.5).mean() < 0.95
        edge_px, interior, dark = max(edge_px, metrics.edge_p95), max(interior, metrics.interior), visibility < 0.5
        trial.record_coverage("edge_p95_px", edge_metric_coverage(dark, truth))
        trial.record_coverage("interior", metric_coverage(dark, truth, interior_region(truth)))
        is_wrong, is_near_seam = truth.decidable & ((visibility < 0.5) == truth.lit), near_seam(pixels)
        at_the_seam = max(at_the_seam, share_of_mask(is_wrong, truth.decidable & is_near_seam))
        seam_truth = replace(truth, decidable=truth.decidable & is_near_seam)
        trial.record_coverage("wrong at the seam", metric_coverage(dark, seam_truth, is_near_seam))
    return {"edge_p95_px": edge_px, "interior": interior, "wrong at the seam": at_the_seam}


@pytest.mark.parametrize(("azimuth", "pixel"), [(27, (11, 12)), (61, (55, 57)), (74, (61, 30)), (180, (53, 24))])
def test_a_grazed_pixel_is_dark_and_boundary(tmp_path, azimuth, pixel):
    """A facet at the pixel rises above its ray to the sun, in exact arithmetic, by less than the lift of truth's ray.

    Rays alone would see the sun at one, two and four offsets. At all azimuths of H32 there are 32 such pixels of 1.3 million.
    """
    trial = Trial("sweep", True, tmp_path)
    scene = _mountains(trial).with_sun(SunSpec(azimuth=float(azimuth), altitude=10.0))
    picture = trial.render_view(scene, seam_windows(trial, scene, MOUNTAIN_PX)[2])
    truth, buffer = picture.truth, picture.buffer
    lift_frame = facing_normals(buffer, scene.light_position("sun", buffer.frame), with_lifts=True).lift_frame
    assert lift_frame is not None
    lift_m = ray_scene(buffer, scene, picture.casters, ALL_CASTER_KINDS).offset_m * lift_frame[pixel]
    assert 0 < _rise_above_ray(picture, *pixel) < lift_m[2]
    assert not truth.attached_shadow_mask[pixel] and picture.dark[pixel]
    assert not truth.lit[pixel] and not truth.decidable[pixel]


def _rise_above_ray(picture: RenderedView, row: int, col: int) -> Fraction:
    """Return by how many metres the facet at a pixel on a node rises above the pixel's ray to the sun, at the facet's far side.

    Rational numbers make it exact, for the nodes' positions and the sun's direction as they are in float64.
    """
    surface, view, sun = picture.buffer.surface, picture.view, picture.scene.sun
    assert surface is not None and sun is not None and isinstance(view, MapView)
    row, col = int(view.row0) - surface.row0 + row, int(view.col0) - surface.col0 + col
    nodes, is_cut_nw_se = surface.position_frame_m, surface.sheet.is_cut_nw_se
    east, north, up = (Fraction(float(value)) for value in sun.in_frame(picture.buffer.frame))
    # Of the eight neighbours, those on diagonals that are not cut through the node are no corners of its facets.
    corners = [
        [Fraction(float(b)) - Fraction(float(a)) for a, b in zip(nodes[row, col], nodes[row + i, col + j], strict=True)]
        for i, j in NEIGHBOURS
        if i == 0 or j == 0 or is_cut_nw_se[row + min(i, 0), col + min(j, 0)] == (i == j)
    ]
    for a, b in pairwise([*corners, corners[0]]):
        area = a[0] * b[1] - a[1] * b[0]
        share_a, share_b = (east * b[1] - north * b[0]) / area, (a[0] * north - a[1] * east) / area
        if share_a >= 0 and share_b >= 0:
            return (share_a * a[2] + share_b * b[2] - up) / (share_a + share_b)
    raise AssertionError("the ray crosses one of the facets")
