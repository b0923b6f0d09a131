"""A sun that moves: from frame to frame an edge moves as far as the sun moves it, and no farther."""

from __future__ import annotations

import numpy as np
import shapely

from skugga.shadows.truth.metrics import MetricCoverage
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.bodies import FLOOR, eye
from tests.hard_cases.cases import RenderedView, Trial, hard_case
from tests.hard_cases.reach_of_error import GRID_TEXELS, STENCIL_PX
from tests.rasters import ENGINEERING
from tests.shadows.boxes import box

TOWER_M = np.array([6.0, 5.0, 12.0])
"""Sides of the tower in metres east and north, and its height."""

CELL_M = 1.0

SUN_STEP_DEG = 0.25
"""The sun moves so far in a minute."""


def tower_scene(trial: Trial) -> tuple[Scene, np.ndarray]:
    """Return a tower on a floor, and the corners (n, 3) of its convex hull in metres; the sweep gets a raster with steep sides."""
    view = eye((13.0, 26.0, 22.0), (3.0, 9.0, 0.0), fov=55.0)
    low, high = np.append(-TOWER_M[:2] / 2.0, 0.0), np.append(TOWER_M[:2] / 2.0, TOWER_M[2])
    if trial.algorithm != "sweep":
        corners = np.array(np.meshgrid(*np.stack([low, high], axis=-1))).reshape(3, -1).T
        return trial.scene(FLOOR, (200.0, 40.0), meshes=[box(tuple(TOWER_M))], views={"main": view}), corners
    cells = 100
    nodes_m = (np.arange(cells) + 0.5) * CELL_M - cells * CELL_M / 2.0
    inside = (np.abs(nodes_m[::-1, None]) < TOWER_M[1] / 2.0) & (np.abs(nodes_m) < TOWER_M[0] / 2.0)
    raster = trial.raster(
        np.where(inside, TOWER_M[2], 0.0).astype(np.float32), ENGINEERING, nodes_m[0] - 0.5, nodes_m[-1] + 0.5, CELL_M
    )
    top = [np.abs(nodes_m[np.abs(nodes_m) < side / 2.0]).max() for side in TOWER_M[:2]]
    corners = np.array(
        [
            [x * (top[0] + foot), y * (top[1] + foot), z]
            for foot, z in ((0.0, TOWER_M[2]), (CELL_M, 0.0))
            for x in (-1, 1)
            for y in (-1, 1)
        ]
    )
    return trial.scene(raster, (200.0, 40.0), views={"main": view}), corners


def direction_to_sun(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Return the unit vector (3,) to a sun in a flat world: east, north and up."""
    azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def shadow_outline(corners: np.ndarray, to_sun: np.ndarray) -> shapely.Polygon:
    """Return the shadow of a convex body with some corners (n, 3) on level ground at height 0."""
    return shapely.MultiPoint(corners[:, :2] - corners[:, 2:] * to_sun[:2] / to_sun[2]).convex_hull


def error_m(rendered: RenderedView, points: np.ndarray) -> np.ndarray:
    """Return how far off an edge may be at points (n, 3) on the ground, metres.

    It is half a texel's diagonal for a map's nearest texel, and its raster's grid; a node for the sweep, as in
    ``reach_of_error``; else the stencil's grid. Texels are measured on level ground, and pixels along the ground, which stretches
    them by the sine of the view's angle.
    """
    assert isinstance(rendered.view, PerspectiveView)
    if rendered.plan.steps_of_light("sun")[0].algorithm == "sweep":
        return np.full(len(points), describe(rendered.scene, rendered.view).node_m)
    ray = points - rendered.view.eye_earth_m
    distance_m = np.linalg.norm(ray, axis=1)
    pixel_m = distance_m * rendered.view.pixel_tangent
    texel_m = float(rendered.texels_px.max()) * rendered.pixel_m
    return (0.5 * 2.0**0.5 + GRID_TEXELS) * texel_m + STENCIL_PX * pixel_m / np.abs(ray[:, 2] / distance_m)


@hard_case(
    "T6",
    "A sun that moves moves edges as far as it must, and none jumps",
    "a tower of 12 m under a sun that moves by 0.25 degrees a frame, as in a minute; how far beyond the ground that its "
    "shadow's outline sweeps pixels change, as a share of an edge's error: half a texel's diagonal, a node, or 1/128 pixel",
    {"edge jump": 1.0},
)
def test_edges_follow_the_sun(trial: Trial) -> dict[str, float]:
    """The true shadow is a polygon. Between two frames the ground changes that one of the two polygons has and the other lacks.

    The step d of the sun moves an edge thrown over the distance t by t d on the ground across the light, which the polygons say
    exactly. A pixel that changes may lie beyond that ground by the error of an edge: every class is right beyond it.
    """
    scene, corners = tower_scene(trial)
    view = scene.view("main", size=(240, 200) if trial.thorough else (96, 80))
    before, worst = None, 0.0
    for frame in range(60 if trial.thorough else 8):
        azimuth, altitude = 200.0 + SUN_STEP_DEG * frame, 40.0 - 0.1 * frame
        sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        rendered = trial.render_view(sunlit_scene, view, map_size=2048 if trial.thorough else 1024, cascades=1, filter=1)
        outline = shadow_outline(corners, direction_to_sun(azimuth, altitude))
        points = (rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m).astype(np.float64)
        ground = rendered.buffer.valid & (rendered.buffer.surface_kind == RELIEF) & (np.abs(points[..., 2]) < 1e-6)
        ground &= ~shapely.contains_xy(shapely.MultiPoint(corners[:, :2]).convex_hull, points[..., 0], points[..., 1])
        true_dark = ground & shapely.contains_xy(outline, points[..., 0], points[..., 1])
        assert 0.02 < true_dark[ground].mean() < 0.9
        dark = rendered.dark & ground
        if before is not None:
            changed = (dark != before[0]) & ground
            swept = outline.symmetric_difference(before[1])
            at = points[changed]
            beyond_m = shapely.distance(swept, shapely.points(at[:, :2]))
            worst = max(worst, float((beyond_m / error_m(rendered, at)).max(initial=0.0)))
            visible = shapely.distance(swept, shapely.points(points[true_dark][:, :2])) > error_m(rendered, points[true_dark])
            trial.record_coverage(
                "edge jump",
                MetricCoverage(
                    int(true_dark.sum()),
                    int(visible.sum()),
                    int((dark != true_dark)[ground].sum()),
                    int((dark | true_dark)[ground].sum()),
                ),
            )
        before = dark, outline
    return {"edge jump": worst}
