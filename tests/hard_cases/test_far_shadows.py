"""Distant casters: the shadow's length on a plane and on the curved earth, suns at the horizon, casters outside the view."""

from __future__ import annotations

import numpy as np
import pytest

from skugga.shadows.maps.windows import eye_distances
from skugga.shadows.truth.metrics import metric_coverage
from skugga.terrain.casters.reach import longest_shadow_m
from skugga.terrain.gbuffer.light_facing import facing_normals
from skugga.terrain.gbuffer.resolve import MESHES
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.lights import light_position
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import Trial, hard_case
from tests.hard_cases.landscapes import FarPeak, far_peak, views_of
from tests.render import render
from tests.shadows.boxes import box

PEAK_M = 1500.0


def worst_length_error(trial: Trial, peak: FarPeak) -> float:
    """Return the largest relative error of the length of a peak's shadow, from above and from a camera."""
    size = 320 if trial.thorough else 96
    return max(
        peak.length_error(trial.render_view(peak.scene, view)) for view in views_of(trial, peak.scene, size, bounds=peak.map_bounds)
    )


@hard_case(
    "H23",
    "A peak shades what lies 40 km away",
    "a peak of 1500 m, sun at 2 degrees, UTM map of a raster in degrees",
    {"length": 0.01},
)
def test_a_peak_shades_what_lies_far_away(trial: Trial) -> dict[str, float]:
    """The shadow's end on WGS 84 is solved numerically. The formula for a sphere gives a length of 39.46 km."""
    peak = far_peak(trial, PEAK_M, 2.0, view_radius_m=2000.0, curved=True)
    assert peak.length_m == pytest.approx(longest_shadow_m(PEAK_M, 2.0), rel=0.001)
    return {"length": worst_length_error(trial, peak)}


@hard_case(
    "H24",
    "The earth's curvature shortens long shadows as it should",
    "a peak of 1500 m, sun at 0.5 degrees: 172 km in an engineering CRS, 93.4 km on the earth",
    {"flat": 0.005, "curved": 0.005},
)
def test_curvature_shortens_long_shadows(trial: Trial) -> dict[str, float]:
    """The sun's altitude applies where the shadow ends: seen from the peak it stands 0.84 degrees higher."""
    flat, curved = (far_peak(trial, PEAK_M, 0.5, view_radius_m=4000.0, curved=curved) for curved in (False, True))
    assert flat.length_m == pytest.approx(171_890, rel=0.001)
    assert curved.length_m == pytest.approx(longest_shadow_m(PEAK_M, 0.5), rel=0.001) == pytest.approx(93_400, rel=0.001)
    return {"flat": worst_length_error(trial, flat), "curved": worst_length_error(trial, curved)}


@hard_case(
    "H26",
    "Nothing breaks while the sun crosses the horizon",
    "hills of 200 m, altitudes from +0.01 to -0.01 degrees",
    {"not_a_number": 0.0, "lit_though_turned_away": 0.0, "change": 0.01},
)
def test_the_sun_crosses_the_horizon(trial: Trial) -> dict[str, float]:
    """Colours change smoothly from frame to frame, as a share of their mean; visibility itself may end at once.

    Algorithms for level ground get level ground with a tower.
    """
    scene = horizon_scene(trial)
    size, steps = (256, 21) if trial.thorough else (64, 5)
    worst = {"not_a_number": 0.0, "lit_though_turned_away": 0.0, "change": 0.0}
    for view in views_of(trial, scene, size):
        before = None
        buffer = geometry_buffer(scene, view)
        for altitude in np.linspace(0.01, -0.01, steps):
            sunlit_scene = scene.with_sun(SunSpec(azimuth=250.0, altitude=float(altitude)))
            frame = render(sunlit_scene, view, algorithm=trial.algorithm)
            to_sun = buffer.frame.frame_from_earth @ sunlit_scene.sun.to_sun_earth
            facing = facing_normals(buffer, light_position(to_sun, 0.0))
            turned_away = frame.valid & ~(facing.normal_frame @ to_sun > 0.0)
            color = frame.color[frame.valid].astype(float)
            worst["not_a_number"] = max(worst["not_a_number"], float((~np.isfinite(frame.visibility[frame.valid])).mean()))
            worst["lit_though_turned_away"] = max(
                worst["lit_though_turned_away"], float(np.count_nonzero(frame.visibility[turned_away] > 0.0) / turned_away.size)
            )
            if before is None:
                assert (frame.visibility[frame.valid] > 0.0).any(), "the sun is up at first"
            else:
                worst["change"] = max(worst["change"], float(np.abs(color - before).mean() / before.mean()))
            before = color
        assert before is not None and before.mean() > 0.0, "dusk is not black"
    return worst


def horizon_scene(trial: Trial) -> Scene:
    """Return hills of 200 m, on the globe where the algorithm allows it; level ground with a tower for ``planar``."""
    eye = {"kind": "perspective", "fov": 50}
    if trial.algorithm == "planar":
        views = {"eye": {**eye, "eye": [-700, -700, 300], "target": [0, 0, 0]}}
        return trial.scene({"flat": {"size": [1920, 1920], "cells": [48, 48]}}, (250, 1), [box((40, 40, 200))], views=views)
    axis = np.arange(64)
    heights = 100.0 * (1.0 + np.sin(axis / 7.0) * np.cos(axis / 9.0)[:, None]) + axis % 3
    raster = trial.raster(heights.astype(np.float32), "EPSG:32633", 499_040, 4_990_960, 30.0)
    views = {"eye": {**eye, "eye": [14.990, 45.056, 300], "target": [15.0, 45.062, 0]}}
    return trial.scene(raster, (250, 1), views=views)


@hard_case(
    "H27",
    "A beam outside of the view shades it from the nearest ground to the farthest",
    "a beam 10 km long beside and above a view along it, four cascades, sun at 30 degrees",
    {"missed_shadow": 0.0, "false_shadow": 0.0},
)
def test_a_beam_outside_of_the_view(trial: Trial) -> dict[str, float]:
    """The shadow is a strip along the view. Points within a texel (else a pixel) of its outline do not count."""
    height_m, thick_m, altitude = 200.0, 20.0, 30.0
    distance_m = (height_m + thick_m / 2) / np.tan(np.radians(altitude))
    beam = box((thick_m, 10_000.0, thick_m), height_m, (distance_m, 0.0))
    eye = {"kind": "perspective", "eye": [0, -4500, 100], "target": [0, -3500, 100 - 1000 * np.tan(np.radians(20.6))], "fov": 40}
    ground = {"flat": {"size": [24_000, 24_000], "cells": [24, 24]}}
    scene = trial.scene(ground, (90, altitude), [beam], views={"eye": eye})
    size, map_size = (512, 2048) if trial.thorough else (256, 1024)
    options = {"cascades": 4} if trial.algorithm == "shadow_map" else {}
    rendered = trial.render_view(scene, scene.view("eye", size=(size, size)), map_size=map_size, **options)
    assert not (rendered.buffer.surface_kind == MESHES).any(), "the beam is not in the view"
    point = rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m
    half_m = thick_m / 2 + thick_m / 2 / np.tan(np.radians(altitude))
    beyond_m = np.abs(point[..., 0]) - half_m  # from the strip's edge
    distance_m = eye_distances(rendered.buffer.position_frame_m, rendered.view.in_frame(rendered.buffer.frame)[0])
    margin_m = distance_m * rendered.view.pixel_tangent
    if trial.algorithm == "shadow_map":
        cascades = rendered.plan.steps[0].settings.cascades
        number = np.searchsorted([cascade.far_m for cascade in cascades[:-1]], distance_m)
        margin_m = np.array([cascade.texel_m[1] for cascade in cascades])[number] / np.sin(np.radians(altitude))
        assert set(number[beyond_m < -margin_m]) == {0, 1, 2, 3}, "the strip lies in all cascades"
    elif trial.algorithm == "light_space_perspective_map":  # by the published rule, near texels are wider than pixels
        margin_m *= np.maximum(rendered.texels_px, 1.0)
    inside, outside = beyond_m < -margin_m, beyond_m > margin_m
    trial.record_coverage("missed_shadow", metric_coverage(rendered.dark, rendered.truth, inside))
    return {"missed_shadow": float((~rendered.dark)[inside].mean()), "false_shadow": float(rendered.dark[outside].mean())}
