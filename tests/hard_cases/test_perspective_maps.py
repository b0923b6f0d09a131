"""Perspective maps near their singularities: the sun in the view's axis, behind the eye, across it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import trimesh

from skugga.shadows.truth.metrics import metric_coverage
from skugga.terrain.geo.camera import PerspectiveView
from skugga.terrain.scene import Scene
from tests.hard_cases.blocks import (
    GroundErrorMetrics,
    axis_at_angle,
    block,
    camera,
    closed_form_truth,
    flat_terrain,
    ground_error_metrics,
    shadow_polygons,
    unit_direction,
)
from tests.hard_cases.cases import MAP_ALGORITHMS, PERSPECTIVE_MAP_ALGORITHMS, RenderedView, Trial, hard_case

UNIFORM_MAP_CONE_DEG = 3.0
"""Within this angle of the view's axis a perspective map reports that it is uniform."""

DISPLACED = "wrong, of what texels displace"
"""Wrong pixels, as a share of the pixels over which a map's texels displace the shadow's edges: 1 is fully explained."""

UP = np.array([0.0, 0.0, 1.0])

TOWERS = [
    block((5, 5, 25), (45 * np.sin(a), 45 * np.cos(a)), turn_deg=20 * n) for n, a in enumerate(np.radians(range(15, 375, 45)))
]
BODIES = [*TOWERS, block((2, 2, 2), (-3, -8)), block((4, 3, 5), (5, 4)), block((5, 5, 0.3), (-8, 6), 6), block((30, 1, 4), (0, 40))]
"""Towers all round and bodies of all sizes in between, 90 m across: some behind any eye, some beside it, some in view."""


def level(
    trial: Trial, blocks: Sequence[trimesh.Trimesh], sun: tuple[float, float], side_m: float = 200.0, cells: int = 20
) -> Scene:
    """Return blocks on level ground."""
    return trial.scene(flat_terrain(side_m, cells), sun=sun, meshes=[trimesh.util.concatenate(blocks)])


def picture_and_map_size(trial: Trial) -> tuple[int, int]:
    """Return pixels and texels a side.

    Both are small, since the truth of a frame takes a second at 1024 pixels.
    """
    return (288, 2048) if trial.thorough else (160, 1024)


def render_and_measure(
    trial: Trial, scene: Scene, blocks: Sequence[trimesh.Trimesh], view: PerspectiveView, **options: object
) -> tuple[RenderedView, dict[str, float], GroundErrorMetrics]:
    """Draw blocks under the level's sun; return errors, the share of pixels without a valid visibility, and that of shadow on
    the ground.

    The trial records the coverage of the shadow by the errors.
    """
    sun = scene.loaded.level.sun
    rendered = trial.render_view(scene, view, **{"map_size": picture_and_map_size(trial)[1], **options})
    hulls = shadow_polygons(blocks, (sun.azimuth, sun.altitude))
    truth = closed_form_truth(rendered, hulls)
    metrics = ground_error_metrics(rendered, truth, hulls)
    trial.record_coverage("interior", metrics.interior_coverage)
    trial.record_coverage(DISPLACED, metric_coverage(rendered.dark, truth, truth.decidable))
    shadow = float((truth.valid & ~truth.lit).sum() / max(truth.valid.sum(), 1))
    not_finite = float((~np.isfinite(rendered.visibility) & rendered.buffer.valid).mean())
    return rendered, {
        "interior": metrics.interior, "edge_p95_px": metrics.edge_p95_px, DISPLACED: metrics.displaced, "not finite": not_finite,
        "shadow": shadow,
    }, metrics  # fmt: skip


def max_by_figure(figure_sets: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the largest of each figure."""
    assert np.mean([0.01 < figures["shadow"] < 0.99 for figures in figure_sets]) > 0.5, f"there is light and shadow: {figure_sets}"
    return {name: float(np.max([figures[name] for figures in figure_sets])) for name in figure_sets[0]}


def pass_notes(rendered: RenderedView) -> str:
    """Return the notes of all passes of a rendered view."""
    return " ".join(record.note for record in rendered.log.records.values())


@hard_case(
    "H9", "With the sun in the view's axis the map is finite and right, and uniform within a stated cone alone",
    "the sun 0, 1e-8 to 10 degrees off the view's axis", {"interior": 0.0, "not finite": 0.0, "uniform beyond the cone": 0.0},
    algorithms=MAP_ALGORITHMS,
)  # fmt: skip
def test_sun_in_the_axis(trial: Trial) -> dict[str, float]:
    """The eye looks at a low sun. The view's axis is turned away from the sun in both directions, upwards and sideways.

    A light-space map may also be uniform beyond the cone, with the reason that its warp gains nothing there: the warp's centre lies
    at a distance that grows without bound towards the axis.
    """
    sun, eye = (0.0, 12.0), (0, -20, 5)
    scene, results, uniform_count = level(trial, BODIES, sun), [], 0
    offsets_deg = [0.0, 1e-8, 1e-4, 1.0, 2.9, 3.1, 10.0]
    if trial.thorough:
        offsets_deg += [1e-7, 1e-6, 1e-5, 1e-3, 1e-2, 0.1, 0.5, 2.0, 5.0]
    for number, angle in enumerate(offsets_deg):
        other_direction = UP if number % 2 else np.array([1.0, 0.0, -0.2])
        rendered, figures, _ = render_and_measure(
            trial,
            scene,
            BODIES,
            camera(eye, axis_at_angle(unit_direction(*sun), other_direction, angle), 70.0, picture_and_map_size(trial)[0]),
        )
        results.append(figures)
        if trial.algorithm in PERSPECTIVE_MAP_ALGORITHMS:
            notes = pass_notes(rendered)
            uniform = "a uniform map" in notes and "no larger texels than the light-space" not in notes
            assert uniform or angle > UNIFORM_MAP_CONE_DEG, "within the cone a map says that it is uniform"
            uniform_count += uniform and angle > UNIFORM_MAP_CONE_DEG
    figures = max_by_figure(results)
    return {"interior": figures["interior"], "not finite": figures["not finite"], "uniform beyond the cone": uniform_count}


@hard_case(
    "H10", "With the sun behind the viewer a perspective map is as right as a shadow map",
    "the sun 180 degrees off the view's axis, +-1e-6 to 10 degrees",
    {"interior": 0.0, "not finite": 0.0, "edge p95 beyond a shadow map's, px": 1.0}, algorithms=PERSPECTIVE_MAP_ALGORITHMS,
)  # fmt: skip
def test_sun_behind_the_viewer(trial: Trial) -> dict[str, float]:
    """The perspective map is compared with a single shadow map of the same size, fitted tightly to the visible ground."""
    sun, eye = (180.0, 30.0), (0, -25, 14)
    scene, map_trial, results = level(trial, BODIES, sun), replace(trial, algorithm="shadow_map"), []
    offsets_deg = [0.0, 1e-6, -1e-6, 3.1, -3.1] + (
        [1e-8, -1e-8, 1e-4, -1e-4, 1.0, -1.0, 2.9, -2.9, 5.0, -5.0] if trial.thorough else []
    )
    for angle in offsets_deg:
        view = camera(eye, axis_at_angle(unit_direction(*sun), UP, 180.0 + angle), 60.0, picture_and_map_size(trial)[0])
        _, figures, metrics = render_and_measure(trial, scene, BODIES, view)
        other = map_trial.render_view(scene, view, map_size=picture_and_map_size(trial)[1], cascades=1, fit="tight", filter=1)
        hulls = shadow_polygons(BODIES, sun)
        reference_metrics = ground_error_metrics(other, closed_form_truth(other, hulls), hulls)
        trial.record_coverage("edge p95 beyond a shadow map's, px", metrics.edge_metric_coverage)
        results.append({**figures, "beyond": figures["edge_p95_px"] - reference_metrics.edge_p95_px})
    figures = max_by_figure(results)
    return {
        "interior": figures["interior"], "not finite": figures["not finite"],
        "edge p95 beyond a shadow map's, px": figures["beyond"],
    }  # fmt: skip


@hard_case(
    "H11", "While the sun crosses the eye's plane no frame is wrong and edges do not jump",
    "the angle between sun and view swept through 90 degrees by steps of 1e-4 degrees",
    {"interior": 0.0, "not finite": 0.0, "jump of edge_p95_px": 1.0},
)  # fmt: skip
def test_sun_across_the_view(trial: Trial) -> dict[str, float]:
    """The angle changes in steps of 1e-4 degrees near the singular angle, and in wider steps farther away.

    The figure ``jump of edge_p95_px`` is the largest difference between two successive frames.
    """
    sun, eye, bodies = (80.0, 35.0), (2, -14, 9), [*BODIES, block((9, 9, 0.3), (8, 0), 5)]
    scene, results = level(trial, bodies, sun), []
    steps = 1e-4 * np.arange(-10, 11) if trial.thorough else 1e-4 * np.arange(-2, 3)
    for angle in (-2.0, -0.1, -0.01, *steps, 0.01, 0.1, 2.0) if trial.thorough else (-1.0, *steps, 1.0):
        axis = axis_at_angle(unit_direction(*sun), np.array([0.0, 1.0, -0.5]), 90.0 + angle)
        _, figures, metrics = render_and_measure(trial, scene, bodies, camera(eye, axis, 60.0, picture_and_map_size(trial)[0]))
        trial.record_coverage("jump of edge_p95_px", metrics.edge_metric_coverage)
        results.append(figures)
    edges = [item["edge_p95_px"] for item in results]
    figures = max_by_figure(results)
    jump = float(np.abs(np.diff(edges)).max())
    return {"interior": figures["interior"], "not finite": figures["not finite"], "jump of edge_p95_px": jump}


@hard_case(
    "H12", "What stands behind the eye, or in its very plane, throws its shadow into the view",
    "a tower behind the eye, walls and a roof that end in the eye's plane, at 0 and +-1e-6 m",
    {"missed_shadow": 0.0, "interior": 0.0, "not finite": 0.0},
)  # fmt: skip
def test_casters_in_the_plane_of_the_eye(trial: Trial) -> dict[str, float]:
    """The eye looks north from y = 0, the sun stands behind it. Missed shadow is counted three pixels inside the outline."""
    sun, results = (170.0, 40.0), []
    for end_m in (0.0, 1e-6, -1e-6):
        walls = [
            block((4, 2, 30), (0, -8)),  # behind the eye
            block((2, 3, 9), (-9, end_m - 1.5)), block((2, 3, 9), (9, end_m + 1.5)),  # end and begin in that plane
            block((3, 6, 0.5), (4, end_m), 8),  # half behind the eye
        ]  # fmt: skip
        for tilt_deg in (0.0, -15.0):
            axis = unit_direction(0.0, tilt_deg)
            scene = level(trial, walls, sun)
            rendered, figures, _ = render_and_measure(
                trial, scene, walls, camera((0, 0, 3), axis, 75.0, picture_and_map_size(trial)[0])
            )
            truth = closed_form_truth(rendered, shadow_polygons(walls, sun))
            shadow_interior = truth.decidable & ~truth.lit
            for shift in (-3, 3):
                for side in (0, 1):
                    shadow_interior &= np.roll(truth.decidable & ~truth.lit, shift, axis=side)
            trial.record_coverage("missed_shadow", metric_coverage(rendered.dark, truth, shadow_interior))
            assert shadow_interior.sum() > 300 * (picture_and_map_size(trial)[0] / 160) ** 2
            results.append({**figures, "missed_shadow": float((shadow_interior & ~rendered.dark).sum() / shadow_interior.sum())})
    figures = max_by_figure(results)
    return {name: figures[name] for name in ("missed_shadow", "interior", "not finite")}


@hard_case(
    "P1", "The sun may stand in the picture's corner, on its rim or just beyond",
    "low suns at three places of the picture's rim, 0.999, 1 and 1.001 of the way", {"interior": 0.0, "not finite": 0.0},
)  # fmt: skip
def test_sun_on_the_rim_of_the_picture(trial: Trial) -> dict[str, float]:
    """The light's image in post-perspective space lies at the corner of the unit cube, at its far plane."""
    results, px = [], picture_and_map_size(trial)[0]
    view = camera((1, -30, 6), unit_direction(0.0, -12.0), 60.0, px, 1.25)
    half = np.array([view.cols, view.rows]) / 2.0 / view.focal_px
    for corner in ((-1.0, -1.0), (1.0, -1.0), (0.0, -1.0)):
        for share in (0.999, 1.0, 1.001) if trial.thorough else (1.0,):
            direction = view.earth_from_camera @ np.array([*(share * np.array(corner) * half), 1.0])
            direction /= np.linalg.norm(direction)
            sun = float(np.degrees(np.arctan2(direction[0], direction[1]))) % 360.0, float(np.degrees(np.arcsin(direction[2])))
            results.append(render_and_measure(trial, level(trial, BODIES, sun), BODIES, view)[1])
    figures = max_by_figure(results)
    return {name: figures[name] for name in ("interior", "not finite")}


ROOF = block((14, 12, 0.3), (2, -16), 6)
"""A roof over an eye: its shadow is large wherever it falls."""


@hard_case(
    "P2", "Shadows are right through a telescope and through the widest lens",
    "fields of view of 1 degree, 1 km away, and of 150 degrees", {"interior": 0.0, DISPLACED: 1.0, "not finite": 0.0},
)  # fmt: skip
def test_fields_of_view(trial: Trial) -> dict[str, float]:
    results = []
    bodies = [*BODIES, ROOF, block((6, 5, 0.3), (10, 2), 6)]
    for sun in ((75.0, 40.0), (200.0, 25.0), (300.0, 30.0)):
        scene = level(trial, bodies, sun, 4000.0, 80)
        far_eye = np.array([60.0, -900.0, 450.0])
        for eye, target, fov_deg in ((far_eye, (5, 0, 2), 1.0), ((2, -18, 5), (0, 10, 1), 150.0)):
            axis = np.subtract(target, eye)
            view = camera(eye, axis / np.linalg.norm(axis), fov_deg, picture_and_map_size(trial)[0])
            results.append(render_and_measure(trial, scene, bodies, view)[1])
    figures = max_by_figure(results)
    if trial.algorithm == "reconstructed_volume" and figures["interior"] < 1e-4:
        figures["interior"] = 0.0  # one pixel, between a texel's two triangles
    return {name: figures[name] for name in ("interior", DISPLACED, "not finite")}


@hard_case(
    "P3", "Receivers at 0.2 m and at 100 km are right in one picture",
    "an eye 0.2 m above level ground of 200 km, pebbles before it, mountains at 30 and 80 km",
    {"interior": 0.0, DISPLACED: 1.0, "not finite": 0.0},
)  # fmt: skip
def test_from_a_pebble_to_a_mountain(trial: Trial) -> dict[str, float]:
    """Mountains are 4 km high, so that their shadows cover some rows of pixels below the horizon. A boulder is behind the eye."""
    results = []
    for sun in ((60.0, 8.0), (300.0, 20.0), (190.0, 30.0)):
        bodies = [
            block((0.1, 0.1, 0.1), (0.1, 0.5)), block((0.3, 0.3, 0.6), (-0.6, 1.2)), block((2, 1, 3), (3, 9)),
            block((0.6, 0.2, 0.9), (0.2, -0.7)), block((3e3, 3e3, 4e3), (-8e3, 3e4)), block((8e3, 4e3, 4e3), (9e3, 8e4)),
        ]  # fmt: skip
        scene = level(trial, bodies, sun, 200e3, 400)
        results.append(
            render_and_measure(
                trial, scene, bodies, camera((0, 0, 0.2), unit_direction(0.0, -16.0), 70.0, picture_and_map_size(trial)[0])
            )[1]
        )
    figures = max_by_figure(results)
    return {name: figures[name] for name in ("interior", DISPLACED, "not finite")}


@hard_case(
    "P4", "The sun may graze the ground or stand in the zenith",
    "the sun 0.5, 2, 89.9 and 90 degrees high, along the view and across it", {"interior": 0.0, DISPLACED: 1.0, "not finite": 0.0},
)  # fmt: skip
def test_grazing_and_upright_suns(trial: Trial) -> dict[str, float]:
    """Walls outside the view shadow half of the visible ground; at noon a roof shadows a part of it.

    A texel on the ground is as long as the sun is low: by 115 times at half a degree. These maps therefore have 4096 texels a side.
    """
    results = []
    walls = [block((60, 1, 6), (-30, -60)), block((1, 44, 6), (60, -4)), block((60, 1, 6), (-30, 60))]
    bodies = [*BODIES, *walls, block((14, 10, 0.3), (1, 2), 7)]
    for azimuth in (90.0, 180.0, 0.0) if trial.thorough else (90.0, 180.0):
        for altitude in (0.5, 2.0, 89.9, 90.0):
            scene, options = level(trial, bodies, (azimuth, altitude), 400.0), {"map_size": 4096} if altitude < 5.0 else {}
            view = camera((0, -12, 4), unit_direction(0.0, -12.0), 60.0, picture_and_map_size(trial)[0])
            results.append(render_and_measure(trial, scene, bodies, view, **options)[1])
    figures = max_by_figure(results)
    return {name: figures[name] for name in ("interior", DISPLACED, "not finite")}


@hard_case(
    "P5", "A triangle of tens of kilometres does not shade itself",
    "level ground of 60 km in 1 x 1 and 3 x 3 quads, looked down at from 200 m and 20 km", {"interior": 0.0, "not finite": 0.0},
    thorough=False,
)  # fmt: skip
def test_huge_triangles(trial: Trial) -> dict[str, float]:
    """The view shows 200 m of the middle: corners lie a hundred times as far away as any point that is looked up.

    The shadow map's texels are fitted tightly: wider ones would hide the error.
    """
    results, tight_options = [], {"map_size": 2048, "depth_bits": 24, "fit": "tight", "cascades": 1, "filter": 1}
    for cells in (1, 3):
        scene = level(trial, BODIES, (180.0, 60.0), 60e3, cells)
        for high_m, fov_deg in ((200.0, 50.0), (20e3, 0.55)):
            results.append(render_and_measure(trial, scene, BODIES, camera((0, 0, high_m), -UP, fov_deg, 400), **tight_options)[1])
    figures = max_by_figure(results)
    return {name: figures[name] for name in ("interior", "not finite")}
