"""Symmetry: no direction of the compass has better shadows than another."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import minimum_filter

from benchmarks.symmetry import SYMMETRIES, invert_grid, transform_azimuth, transform_grid
from skugga.shadows.attached_shadow import attached_shadow_mask
from skugga.shadows.truth.metrics import MetricCoverage
from skugga.shadows.truth.truth import ALL_CASTER_KINDS, lit_mask, ray_scene
from skugga.terrain.casters.reach import find_casters
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.parts import SunSpec
from tests.hard_cases.cases import SHADOW_ALGORITHMS, Trial, hard_case
from tests.hard_cases.test_sweep_azimuths import hills
from tests.rasters import ENGINEERING

CELL_M = 8.0

SUNS = {"random heights": (90.0, 45.0), "city": (113.0, 30.0), "canopy": (67.0, 20.0), "mountains": (202.0, 10.0)}
"""Suns by kind of ground: along an axis, and off the axes and diagonals."""

MAX_EXACT_SHARE = 1e-5
"""Share of the pixels that may differ at nodes, for algorithms that sample exactly at the nodes."""

MAX_DIFFERING_SHARE = {"random heights": 1e-3, "city": 1e-3, "canopy": 1e-3, "mountains": 2e-4}
"""Share that may differ for maps and volumes, and between nodes."""


def grounds(cells: int) -> dict[str, np.ndarray]:
    """Return heights (cells, cells) float32 of four kinds of ground."""
    rng = np.random.default_rng(7)
    city = np.zeros((cells, cells), np.float32)
    for row, col, deep, wide in rng.integers((0, 0, 3, 3), (cells, cells, 14, 14), (cells, 4)):
        city[row : row + deep, col : col + wide] = rng.uniform(4.0, 40.0)
    canopy = np.where(rng.random((cells, cells)) < 0.7, rng.uniform(8.0, 22.0, (cells, cells)), 0.0)
    return {
        "random heights": rng.uniform(0.0, 40.0, (cells, cells)).astype(np.float32),
        "city": city,
        "canopy": canopy.astype(np.float32),
        "mountains": hills(cells, 900.0, rough_m=3.0),
    }


def raster_shadow(trial: Trial, heights: np.ndarray, sun: tuple[float, float], pixels: int) -> np.ndarray:
    """Return the shadow (pixels, pixels) of a raster in a flat world, all in the view."""
    side_m = len(heights) * CELL_M
    scene = trial.scene(trial.raster(np.ascontiguousarray(heights), ENGINEERING, 0.0, side_m, CELL_M), (0.0, 45.0))
    scene = scene.with_sun(SunSpec(azimuth=sun[0], altitude=sun[1]))
    view = scene.view(bounds=(0.0, 0.0, side_m, side_m), size=(pixels, pixels))
    assert isinstance(view, MapView) and view.is_on_nodes == (pixels == len(heights))
    if trial.algorithm == "truth":
        buffer = geometry_buffer(scene, view)
        rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
        return buffer.valid & (attached_shadow_mask(buffer, scene) | ~lit_mask(buffer, scene, "sun", rays))
    return trial.render_view(scene, view, map_size=4096 if trial.thorough else 512).dark


@hard_case(
    "Y1",
    "Mirrored or turned ground under a sun mirrored or turned alike has the mirrored or turned shadow",
    "random heights, a city, a canopy and mountains, each eight ways, on nodes and between; as a share of what may differ: 0.001 % "
    "by the sweep and rays at nodes, else 0.02 % of mountains and 0.1 % of the others",
    {"at nodes": 1.0, "between nodes": 1.0},
    algorithms=(*SHADOW_ALGORITHMS, "truth"),
)
def test_eight_symmetries(trial: Trial) -> dict[str, float]:
    cells = 80 if trial.thorough else 32
    result = {"at nodes": 0.0, "between nodes": 0.0}
    for ground, heights in grounds(cells).items():
        azimuth, altitude = SUNS[ground]
        for name, pixels in (("at nodes", cells), ("between nodes", cells * 3 // 2)):
            exact = name == "at nodes" and trial.algorithm in ("sweep", "truth")
            shadows = [
                invert_grid(
                    raster_shadow(trial, transform_grid(heights, side), (transform_azimuth(azimuth, side), altitude), pixels), side
                )
                for side in (SYMMETRIES if trial.thorough else (SYMMETRIES[0], SYMMETRIES[1], SYMMETRIES[6]))
            ]
            assert 0.02 < shadows[0].mean() < 0.98
            differ = max(float((other != shadows[0]).mean()) for other in shadows[1:])
            result[name] = max(result[name], differ / (MAX_EXACT_SHARE if exact else MAX_DIFFERING_SHARE[ground]))
    return result


ROOF_NODES = 20
"""Nodes along the roof of the box."""

HEIGHT_CELLS = 10.5


@hard_case(
    "Y2",
    "A flat roof is lit up to its edges from every side, and its box throws the shadow that can be counted",
    "a box of 20 x 20 nodes, 10.5 cells high, under suns from the eight directions of the compass, 1 high per node passed",
    {"dark roof nodes": 0.0, "wrong nodes on the ground": 0.01},
    algorithms=(*SHADOW_ALGORITHMS, "truth"),
    thorough=False,
)
def test_a_box_under_eight_suns(trial: Trial) -> dict[str, float]:
    """Under a sun along the axes ten nodes are dark behind each of the roof's 20 rows: 1 to 10 cells from its edge the ray
    passes below 10.5 cells.

    Along the diagonals ten nodes are dark behind each of the 39 diagonals that meet the roof. The two beside these meet the
    corners' walls half-way down. There the ray is 0.5 to 4.5 high, below 5.25: five nodes are dark behind each. ``wrong nodes on
    the ground`` is a share of the dark nodes.
    """
    cells = 64
    heights = np.zeros((cells, cells), np.float32)
    first = (cells - ROOF_NODES) // 2
    roof = slice(first, first + ROOF_NODES)
    heights[roof, roof] = HEIGHT_CELLS * CELL_M
    dark_roof, wrong_share = 0, 0.0
    for octant in range(8):
        diagonal = octant % 2 == 1
        altitude = np.degrees(np.arctan(0.5**0.5)) if diagonal else 45.0
        dark = raster_shadow(trial, heights, (45.0 * octant, float(altitude)), cells)
        dark_roof += int(dark[roof, roof].sum())
        dark[roof, roof] = False
        expected = 39 * 10 + 2 * 5 if diagonal else ROOF_NODES * 10
        count_error = abs(int(dark.sum()) - expected)
        wrong_share = max(wrong_share, count_error / expected)
        trial.record_coverage(
            "wrong nodes on the ground", MetricCoverage(expected, expected, count_error, max(expected, int(dark.sum())))
        )
    return {"dark roof nodes": dark_roof, "wrong nodes on the ground": wrong_share}


DOME_CELL_M = 30.0
RADIUS_M = 1200.0
"""The dome's radius of curvature at its top."""

DOME_SUN_DEG = 9.0


@hard_case(
    "Y3",
    "Where light grazes a slope, light and shadow part where they do on the smooth ground: near by",
    "a paraboloid of coarse cells, whose terminator is a straight line in plan, in perspective under suns from four sides",
    {"wrong pixels": 0.0},
    algorithms=(*SHADOW_ALGORITHMS, "truth"),
)
def test_no_teeth_at_the_terminator(trial: Trial) -> dict[str, float]:
    """Heights are -(x^2 + y^2) / 2R, so the normal is proportional to (x, y, R).

    The normal is perpendicular to the sun's direction (sin A cos h, cos A cos h, sin h) where x sin A + y cos A = -R tan h: that
    line is the terminator. A dome shadows no part of itself that faces the sun. Wrong pixels are those on the wrong side of that
    line and more than a pixel from it.
    """
    wrong_count = 0.0
    trial.record_coverage("wrong pixels")  # a dome casts no shadow
    for azimuth, terminator_point, to_sun in _terminators(trial.thorough):
        along_terminator = np.array([-to_sun[1], to_sun[0]])
        eye, target = terminator_point + 260.0 * along_terminator + 60.0 * to_sun, terminator_point - 40.0 * along_terminator
        wrong_count = max(wrong_count, _wrong_beyond_a_pixel(trial, azimuth, {
            "kind": "perspective", "eye": [*eye.tolist(), 90.0], "target": [*target.tolist(), 0.0], "fov": 50, "size": [96, 72],
        }))  # fmt: skip
    return {"wrong pixels": wrong_count}


@hard_case(
    "Y5",
    "Where light grazes a slope, light and shadow part where they do on the smooth ground: in maps",
    "the same dome in maps of 6 pixels a cell, and of 1.5",
    {"magnified": 0.0, "between nodes": 0.0},
    algorithms=(*SHADOW_ALGORITHMS, "truth"),
)
def test_no_teeth_in_maps(trial: Trial) -> dict[str, float]:
    result = {"magnified": 0.0, "between nodes": 0.0}
    for azimuth, terminator_point, _ in _terminators(trial.thorough):
        for name, half_m, pixels in (("magnified", 150.0, 60), ("between nodes", 400.0, 40)):
            bounds = [*(terminator_point - half_m).tolist(), *(terminator_point + half_m).tolist()]
            wrong_count = _wrong_beyond_a_pixel(trial, azimuth, {"kind": "map", "bounds": bounds, "size": [pixels, pixels]})
            result[name] = max(result[name], wrong_count)
    return result


def _terminators(thorough: bool) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return for each azimuth the terminator's point nearest to the dome's top, and the horizontal direction to the sun."""
    result = []
    for azimuth in (237.0, 90.0, 18.0, 315.0) if thorough else (237.0, 90.0):
        to_sun = np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        result.append((azimuth, -RADIUS_M * np.tan(np.radians(DOME_SUN_DEG)) * to_sun, to_sun))
    return result


def _wrong_beyond_a_pixel(trial: Trial, azimuth: float, view: dict[str, Any]) -> float:
    """Return pixels of a view of the dome that are on the wrong side of its terminator, with all their neighbours."""
    cells = 48
    side_m = cells * DOME_CELL_M
    at_m = (np.arange(cells) + 0.5) * DOME_CELL_M - side_m / 2.0
    heights = (-(at_m[:, None] ** 2 + at_m**2) / (2.0 * RADIUS_M)).astype(np.float32)
    path = trial.raster(heights, ENGINEERING, -side_m / 2.0, side_m / 2.0, DOME_CELL_M)
    scene = trial.scene(path, (azimuth, DOME_SUN_DEG), views={"main": view})
    if trial.algorithm == "truth":
        buffer = geometry_buffer(scene, scene.view("main"))
        rays = ray_scene(buffer, scene, find_casters(scene, buffer), ALL_CASTER_KINDS)
        dark = attached_shadow_mask(buffer, scene) | ~lit_mask(buffer, scene, "sun", rays)
    else:
        rendered = trial.render_view(scene, scene.view("main"))
        buffer, dark = rendered.buffer, rendered.dark
    east, north, _ = scene.world.map_position(scene.map_crs, buffer.frame.points_to_earth(buffer.position_frame_m))
    line_m = RADIUS_M * np.tan(np.radians(DOME_SUN_DEG))
    turned_away = east * np.sin(np.radians(azimuth)) + north * np.cos(np.radians(azimuth)) < -line_m
    expected = turned_away & buffer.valid
    assert 0.1 < expected[buffer.valid].mean() < 0.9, "light and shadow"
    reach_px = 5 if trial.algorithm == "reconstructed_volume" else 1  # texels along the terminator are larger than pixels
    size = 2 * reach_px + 1
    comparable = minimum_filter(expected, size) | minimum_filter(~turned_away & buffer.valid, size)
    return float(((dark != expected) & comparable).sum())
