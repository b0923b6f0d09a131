"""Surfaces must not shadow themselves, and shadows must touch their casters."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh

from skugga.selector.measure.footprint import texel_footprint_px
from skugga.terrain.describe import describe
from skugga.terrain.gbuffer.resolve import RELIEF
from skugga.terrain.level.parts import SunSpec
from skugga.terrain.scene import Scene
from tests.hard_cases.cases import MAP_ALGORITHMS, RenderedView, Trial, hard_case
from tests.hard_cases.landscapes import SettingsChange, plane_normal, tilted_plane, views_of, with_changed_settings
from tests.rasters import ENGINEERING
from tests.shadows.boxes import box


def share_not_lit(rendered: RenderedView) -> float:
    """Return the share of the surface that is not fully lit."""
    return float((rendered.visibility[rendered.buffer.valid] < 1.0).mean())


@hard_case(
    "H1",
    "Level ground without casters is lit",
    "a level plane, sun at 90 to 0.5 degrees, from above and from a camera",
    {"false_shadow": 0.0},
)
def test_level_ground_is_lit(trial: Trial) -> dict[str, float]:
    """Visibility is 1 everywhere, also where it is filtered. Texel steps crowd where the sun is low."""
    eye = {"kind": "perspective", "eye": [-420, -450, 120], "target": [0, 0, 0]}
    ground = {"flat": {"size": [1000, 1000], "cells": [40, 40]}}
    scene = trial.scene(ground, (200, 45), views={"eye": eye}, effects={"cast_shadows": "on"})
    all_altitudes = np.append(np.arange(90.0, 20.0, -2.5), np.arange(20.0, 0.0, -0.5))
    altitudes = all_altitudes if trial.thorough else np.array([90.0, 45.0, 10.0, 2.0, 0.5])
    size = 192 if trial.thorough else 128
    worst = 0.0
    for altitude in altitudes:
        sunlit_scene = scene.with_sun(SunSpec(azimuth=200.0, altitude=float(altitude)))
        for view in views_of(trial, sunlit_scene, size):
            rendered = trial.render_view(sunlit_scene, view, map_size=1024)
            assert [step.algorithm for step in rendered.plan.steps] == [trial.algorithm], "the ground is a caster"
            worst = max(worst, share_not_lit(rendered))
    return {"false_shadow": worst}


PLANES = ((30.0, 0.0), (60.0, 45.0), (85.0, 225.0), (89.5, 310.0))
"""Slopes and the azimuths that they face, degrees, for quick runs."""


def planes(trial: Trial) -> Iterator[tuple[Scene, float]]:
    """Yield tilted planes under suns at the zenith and aslant, if these reach them; and the sun's angle from their normals.

    In a thorough run each plane has one of the suns in turn, so that every slope is tested with all suns.
    """
    all_planes = [
        (slope, 22.5 + aspect_deg) for slope in (0, 15, 30, 45, 60, 70, 80, 85, 88, 89.5) for aspect_deg in range(0, 360, 45)
    ]
    for number, (slope, aspect_deg) in enumerate(all_planes if trial.thorough else PLANES):
        normal = plane_normal(slope, aspect_deg)
        contour_angles = np.radians(aspect_deg) + np.array([0.0, 0.5 * np.pi])
        east, north = 280.0 * normal[:2] + 250.0 * np.cos(contour_angles)  # aslant: along the contour
        eye = {"kind": "perspective", "eye": [east, north, 280.0 / normal[2]], "target": [0, 0, 0], "fov": 30}
        raster = tilted_plane(trial, slope, aspect_deg)
        suns = ((203.0, 90.0), (aspect_deg - 80.0, 20.0), (aspect_deg + 50.0, 55.0))
        for azimuth, altitude in suns[number % 3 :][:1] if trial.thorough else suns[:2]:
            to_sun = plane_normal(90.0 - altitude, azimuth)
            if normal @ to_sun > 0.008:
                scene = trial.scene(raster, (azimuth, altitude), views={"eye": eye}, effects={"cast_shadows": "on"})
                yield scene, float(np.degrees(np.arccos(min(normal @ to_sun, 1.0))))


@hard_case(
    "H2",
    "Planes that face the sun are lit whatever their slope",
    "planes of 0 to 89.5 degrees facing all ways, suns at 90, 55 and 20 degrees",
    {"false_shadow": 0.0},
)
def test_tilted_planes_are_lit(trial: Trial) -> dict[str, float]:
    """Each plane is drawn with one combination of taps and derived bias in turn; in a thorough run with two.

    The camera sees the plane's middle. At the raster's rim heights continue level for half a cell, and a steep plane's texels are
    hundreds of metres high.
    """
    taps, biases = (1, 2, 3, 5), ("receiver_plane", "normal_offset") if trial.algorithm == "shadow_map" else ("auto",)
    option_sets = (
        [{"filter": count, "bias": bias} for count in taps for bias in biases] if trial.algorithm in MAP_ALGORITHMS else [{}]
    )
    worst = 0.0
    for number, (scene, _) in enumerate(planes(trial)):
        for view in views_of(trial, scene, 192 if trial.thorough else 96, bounds=(-150, -150, 150, 150)):
            for repetition in range(2 if trial.thorough else 1):
                options = option_sets[(number + 3 * repetition) % len(option_sets)]
                worst = max(worst, share_not_lit(trial.render_view(scene, view, map_size=512, **options)))
    return {"false_shadow": worst}


def scale_bias(scale: float) -> SettingsChange:
    """Return a change that multiplies the bias."""
    return lambda settings: settings.model_copy(update={"bias_scale": scale})


@hard_case(
    "B1",
    "The bias is no more than planes need",
    "planes that the sun meets at over 60 degrees from their normals, with all of the bias and with 0.7 of it",
    {"false_shadow": 0.0, "planes without acne at 0.7": 0.0},
    MAP_ALGORITHMS,
)
def test_less_bias_shows_acne(trial: Trial) -> dict[str, float]:
    """``receiver_plane`` has no bias that could be less on a plane that it knows. The scale applies to how far it uses the
    triangle instead of the point.

    ``polygon_offset`` is no part of this: its customary factor is not derived, and is sufficient for one tap only.
    """
    acne, unchanged_count, count = 0.0, 0, 0
    for scene, angle_deg in planes(trial):
        if angle_deg <= 60.0:
            continue
        (view, *_) = views_of(trial, scene, 256 if trial.thorough else 128, bounds=(-150, -150, 150, 150))
        for bias in ("receiver_plane", "normal_offset") if trial.algorithm == "shadow_map" else ("receiver_plane",):
            options = {"filter": 1, "map_size": 512, "bias": bias}
            rendered = trial.render_view(scene, view, **options)
            acne = max(acne, share_not_lit(rendered))
            unchanged_count += share_not_lit(with_changed_settings(rendered, scale_bias(0.7))) == 0.0
            count += 1
    assert count >= 4, "planes that the sun grazes"
    return {"false_shadow": acne, "planes without acne at 0.7": unchanged_count / count}


@hard_case(
    "H3",
    "A cube's shadow begins at its foot",
    "a cube of 1 m on level ground, sun at 10 to 80 degrees: lit ground behind it",
    {"gap_texels": 1.0},
)
def test_a_cube_touches_its_shadow(trial: Trial) -> dict[str, float]:
    """Maps are also tested with the bias ``normal_offset``.

    Its bound 0.71 t sin(theta) / tan(a) is smaller than the t / sin(a) of a texel.
    """
    azimuth, size = 211.0, 256 if trial.thorough else 128
    from_sun = -plane_normal(90.0, azimuth)[:2]
    cube = box((1.0, 1.0, 1.0))
    cube.apply_transform(trimesh.transformations.rotation_matrix(np.radians(-azimuth), [0, 0, 1]))
    eye = {
        "kind": "perspective",
        "eye": [*(4.0 * from_sun + 3.0 * from_sun[::-1] * [1, -1]), 5.0],
        "target": [*(0.8 * from_sun), 0],
        "fov": 50,
    }
    scene = trial.scene({"flat": {"size": [12, 12], "cells": [4, 4]}}, (azimuth, 45), [cube], views={"eye": eye})
    worst = 0.0
    for altitude in range(10, 85, 5) if trial.thorough else (10, 45, 80):
        sunlit_scene = scene.with_sun(SunSpec(azimuth=azimuth, altitude=float(altitude)))
        for view in views_of(trial, sunlit_scene, size, bounds=(-6, -6, 6, 6)):
            option_sets = [{}] if trial.algorithm != "shadow_map" else [{}, {"filter": 1}, {"filter": 1, "bias": "normal_offset"}]
            for options in option_sets:
                rendered = trial.render_view(sunlit_scene, view, map_size=96, **options)
                assert altitude > 10 or (rendered.dark & (rendered.buffer.surface_kind == RELIEF)).any(), "there is a shadow"
                worst = max(worst, gap_texels(rendered, from_sun, 0.5, 1.0 / np.tan(np.radians(altitude))))
    return {"gap_texels": worst}


def gap_texels(rendered: RenderedView, from_sun: np.ndarray, foot_m: float, length_m: float) -> float:
    """Return how far lit ground reaches from a wall's foot into its shadow, in texels or pixels.

    ``from_sun`` (2,) is the horizontal direction away from the sun.
    """
    point = rendered.buffer.position_frame_m + rendered.buffer.frame.origin_earth_m
    distance_m, lateral_m = point[..., :2] @ from_sun - foot_m, point[..., :2] @ (from_sun[::-1] * [1, -1])
    pixel_m = describe(rendered.scene, rendered.view).pixel_m
    texel_px = texel_footprint_px(rendered.scene, rendered.plan.steps[0], rendered.buffer, pixel_m)
    unit_m = pixel_m * np.broadcast_to(np.maximum(texel_px, 1.0), distance_m.shape)
    behind_wall = (
        (rendered.buffer.surface_kind == RELIEF) & (distance_m > 0.0) & (distance_m < 0.6 * length_m) & (np.abs(lateral_m) < 0.3)
    )
    return float((distance_m / unit_m)[behind_wall & ~rendered.dark].max(initial=0.0))


@hard_case(
    "H31",
    "A footprint that lies in the ground casts nothing",
    "a building's footprint drawn into level and sloping ground, sun at 85 to 3 degrees",
    {"false_shadow": 0.0},
)
def test_a_footprint_in_the_ground(trial: Trial) -> dict[str, float]:
    """Ties go to the light: a caster at the same distance from the sun as the point does not shadow it.

    It does not matter which of the two surfaces is visible; both are lit.
    """
    worst = 0.0
    eye = {"kind": "perspective", "eye": [-30, -40, 45], "target": [6, 4, 0], "fov": 35}
    for slope in (0.0, 0.25):
        corners = [[0, 0, 0], [16, 0, 16 * slope], [16, 9, 16 * slope], [7, 9, 7 * slope], [7, 14, 7 * slope], [0, 14, 0]]
        sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]], process=False)
        ground: object = {"flat": {"size": [80, 80], "cells": [16, 16]}}
        if slope:
            heights = np.broadcast_to(slope * (np.arange(40) * 2.0 - 39.0), (40, 40)).astype(np.float32)
            ground = trial.raster(heights, ENGINEERING, -40, 40, 2.0)
        for altitude in (85.0, 60.0, 30.0, 10.0, 3.0) if trial.thorough else (60.0, 3.0):
            scene = trial.scene(ground, (251.0, altitude), [sheet], views={"eye": eye})
            for view in views_of(trial, scene, 256 if trial.thorough else 128, bounds=(-10, -10, 26, 26)):
                rendered = trial.render_view(scene, view)
                worst = max(worst, share_not_lit(rendered))
    return {"false_shadow": worst}
