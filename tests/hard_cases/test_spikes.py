"""The steepest ground that a raster can hold: needles, cliffs and saw-teeth of single cells."""

from __future__ import annotations

import numpy as np

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.shadows.truth.metrics import metric_coverage
from skugga.terrain.describe import describe
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import RenderedView, Trial, hard_case
from tests.hard_cases.ground import close_view, map_positions, share_of_mask, view_from_above
from tests.rasters import ENGINEERING

CELL_M = 32.0
"""A power of two, so that nodes are the centres of cells."""


def on_plain(trial: Trial, heights: np.ndarray) -> Scene:
    """Return the scene of a raster in a flat world whose north-west corner is (0, 0)."""
    return trial.scene(trial.raster(heights.astype(np.float32), ENGINEERING, 0.0, 0.0, CELL_M), (270, 45))


def texel_m(rendered: RenderedView) -> float:
    """Return the largest texel on the ground of the maps that were used; 0 without maps."""
    pixel_m = describe(rendered.scene, rendered.view).pixel_m
    steps = rendered.plan.steps_of_light(rendered.light)
    return pixel_m * max(float(np.max(texel_footprint_px(rendered.scene, step, rendered.buffer, pixel_m))) for step in steps)


@hard_case(
    "G6",
    "A needle throws its whole length, and light leaks nowhere",
    "one cell of 3000 m on a plain in cells of 32 m, sun at 45, 30 and 25 degrees",
    {"length": 0.01, "interior": 0.0, "not finite": 0.0},
)
def test_a_needle(trial: Trial) -> dict[str, float]:
    """The needle is a pyramid two cells wide: its shadow narrows to a point.

    No map can hold it where it is narrower than a texel. No pixel shows it where it is narrower than the gap between the pixels and
    its axis. ``length`` is the excess or deficit beyond that. At a pixel per cell its shadow has no interior: the close view has
    one.
    """
    cells = 256 if trial.thorough else 128
    heights = np.zeros((cells, cells))
    at = cells // 2, cells // 8
    heights[at] = 3000.0
    top_m = (at[1] + 0.5) * CELL_M, -(at[0] + 0.5) * CELL_M
    scene = on_plain(trial, heights)
    length = interior = not_finite = 0.0
    for altitude in (45.0, 30.0, 25.0) if trial.thorough else (45.0,):
        sunlit_scene = scene.with_sun(SunSpec(azimuth=270, altitude=altitude))
        rendered = trial.render_view(sunlit_scene, view_from_above(trial, sunlit_scene, cells), map_size=2048)
        x, y = map_positions(rendered)
        expected_m = 3000.0 / np.tan(np.radians(altitude))
        cast = rendered.dark & (np.abs(y - top_m[1]) < 1.5 * CELL_M) & (x > top_m[0] + CELL_M)
        assert cast.any()
        pixel_m = describe(sunlit_scene, rendered.view).pixel_m
        beside_m = float(np.nanmedian(np.fmin.reduce(np.abs(y - top_m[1]), axis=0)))
        hidden_m = (texel_m(rendered) + 2 * beside_m) / (2 * CELL_M) * expected_m + pixel_m
        length = max(length, max(abs(x[cast].max() - top_m[0] - expected_m) - hidden_m, 0.0) / expected_m)
        near = trial.render_view(
            sunlit_scene, close_view(trial, sunlit_scene, (top_m[0] + 9 * CELL_M, top_m[1]), 0.0, 16 * CELL_M, 160), map_size=2048
        )
        interior = max(interior, rendered.errors.interior, near.errors.interior)
        trial.record_coverage("interior", near.interior_coverage)
        not_finite = max(not_finite, share_of_mask(~np.isfinite(rendered.visibility), rendered.buffer.valid))
    return {"length": length, "interior": interior, "not finite": not_finite}


@hard_case(
    "S1",
    "A cliff throws its shadow to its length, its brink is lit, and lit from the front it is lit all over",
    "a step of 2000 m from one cell of 32 m to the next, sun behind it at 60 and 40 degrees and before it at 40 and 5",
    {"end_px": 1.0, "false_shadow": 0.0, "missed_shadow": 0.0},
)
def test_a_cliff(trial: Trial) -> dict[str, float]:
    """The shadow's end is the last dark pixel: it may miss by a pixel, and in maps by a texel."""
    cells = 256 if trial.thorough else 128
    heights = np.zeros((cells, cells))
    edge = cells // 8
    heights[:, :edge] = 2000.0
    scene = on_plain(trial, heights)
    brink_m = (edge - 0.5) * CELL_M
    end_px = false_shadow = missed_shadow = 0.0
    suns = ((270.0, 40.0), (90.0, 5.0), (270.0, 60.0), (90.0, 40.0))
    for azimuth, altitude in suns if trial.thorough else suns[:2]:
        sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        rendered = trial.render_view(sunlit_scene, view_from_above(trial, sunlit_scene, cells), map_size=2048)
        x, y = map_positions(rendered)
        pixel_m = describe(sunlit_scene, rendered.view).pixel_m
        inside = np.abs(y + cells / 2 * CELL_M) < (cells / 2 - 4) * CELL_M
        if azimuth == 90.0:
            false_shadow = max(false_shadow, share_of_mask(rendered.dark, rendered.buffer.valid))
            continue
        end_m = brink_m + 2000.0 / np.tan(np.radians(altitude))
        cast = inside & rendered.dark
        end_px = max(end_px, (abs(x[cast].max() - end_m) - texel_m(rendered)) / pixel_m)
        deep = inside & (x > brink_m + CELL_M) & (x < end_m - 2 * pixel_m)
        missed_shadow = max(missed_shadow, share_of_mask(~rendered.dark, deep))
        trial.record_coverage("missed_shadow", metric_coverage(rendered.dark, rendered.truth, deep))
        false_shadow = max(false_shadow, share_of_mask(rendered.dark, inside & ((x < brink_m - 1.0) | (x > end_m + 2 * pixel_m))))
    return {"end_px": end_px, "false_shadow": false_shadow, "missed_shadow": missed_shadow}


@hard_case(
    "S2",
    "Ground that rises and falls with every cell is lit and dark as in closed form",
    "crests of 40 m every second cell of 32 m, sun across, aslant and along them",
    {"wrong": 0.0, "not finite": 0.0},
)
def test_saw_teeth(trial: Trial) -> dict[str, float]:
    """In closed form: a point is dark if its slope faces away or if the next crest towards the sun rises above its ray.

    Points within two texels of the boundary do not count: a nearest lookup and its bias reach as far.
    """
    cells, height_m = (256, 40.0) if trial.thorough else (96, 40.0)
    heights = np.zeros((cells, cells))
    heights[:, ::2] = height_m
    scene = on_plain(trial, heights)
    wrong = not_finite = 0.0
    suns = [(270.0, 20.0), (300.0, 45.0), (80.0, 35.0), (200.0, 12.0), (270.0, 60.0)]
    for azimuth, altitude in suns if trial.thorough else suns[:2]:
        sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=altitude))
        rendered = trial.render_view(sunlit_scene, view_from_above(trial, sunlit_scene, cells - 7), map_size=2048, filter=1)
        x, y = map_positions(rendered)
        rise = np.tan(np.radians(altitude)) / abs(np.sin(np.radians(azimuth)))  # metres up per metre east or west
        sun_side = np.sign(np.sin(np.radians(azimuth)))
        phase = (x / CELL_M - 0.5) * sun_side % 2.0  # cells towards the sun from a crest
        z = height_m * np.abs(phase - 1.0)
        ahead_m = (2.0 - phase) * CELL_M
        clear_m = z + rise * ahead_m - height_m
        dark = clear_m < 0.0
        margin_m = 2.0 * texel_m(rendered) * (rise + height_m / CELL_M) + 0.5
        inside = (x > 6 * CELL_M) & (x < (cells - 6) * CELL_M) & (np.abs(y + cells / 2 * CELL_M) < (cells / 2 - 8) * CELL_M)
        comparable = inside & (np.abs(clear_m) > margin_m) & (np.abs(phase - 1.0) < 0.98)
        # The margin is two texels, and near texels of a light-space map are wider.
        assert comparable.mean() > (0.08 if trial.algorithm == "light_space_perspective_map" else 0.1)
        wrong = max(wrong, share_of_mask(rendered.dark != dark, comparable))
        trial.record_coverage("wrong", metric_coverage(rendered.dark, rendered.truth, comparable))
        not_finite = max(not_finite, share_of_mask(~np.isfinite(rendered.visibility), rendered.buffer.valid))
    return {"wrong": wrong, "not finite": not_finite}
