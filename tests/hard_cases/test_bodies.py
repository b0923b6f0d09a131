"""Bodies that are no solids: open, one-sided, duplicate, edge-on to the sun, without an area."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import trimesh

from skugga.terrain.level.level import SUN
from tests.hard_cases.bodies import (
    FLOOR,
    SPOT,
    errors,
    eye,
    flip_faces,
    half_sphere,
    interior_coverage,
    invalid_pixel_count,
    join_meshes,
    picture_size,
    sheet,
    three_walls,
    triangle_soup,
    with_ground_pebble,
    without_triangles,
)
from tests.hard_cases.cases import Trial, hard_case
from tests.hard_cases.reach_of_error import unexplained_coverage, unexplained_errors
from tests.shadows.boxes import box

HOUSE = box((8, 6, 5))

VIEWS: dict[str, dict[str, Any]] = {
    "eye": eye((22, 42, 26), (0, 2, 0)),
    "map": {"kind": "map", "bounds": [-30, -22.5, 30, 22.5]},
    "low": eye((-21, 30, 2), (4, 0, 3), fov=75),
}


def worst_over_views(
    trial: Trial, bodies: trimesh.Trimesh, name: str, views: Mapping[str, Any] = VIEWS, **keys: Any
) -> dict[str, float]:
    """Return the worst interior error over some views of bodies, and the number of pixels without a valid visibility.

    Algorithms without maps get all views but the map. A shadow map's texels reach round the foot of a sheet and over a face at a
    grazing angle, farther than two of their footprints in the picture. Under the sun all its errors count, inside or at an edge,
    that its reach does not explain. That reach is known for the sun only. Under a lamp interior errors count if 8 px or more are
    connected.
    """
    interior, invalid_count = 0.0, 0
    scene = trial.scene(FLOOR, meshes=[bodies], name=name, views=dict(views), **keys)
    for view, spec in views.items():
        if spec["kind"] == "perspective" or trial.serves_maps:
            rendered = trial.render_view(scene, scene.view(view, size=picture_size(trial.thorough)))
            assert (rendered.truth.valid & ~rendered.truth.lit & ~rendered.truth.attached_shadow_mask).any()
            if "map" in trial.algorithm and rendered.light == SUN:
                interior = max(interior, float(unexplained_errors(rendered).mean()))
                trial.record_coverage("interior", unexplained_coverage(rendered))
            else:
                metrics = errors(rendered)
                trial.record_coverage("interior", interior_coverage(rendered))
                interior = max(interior, metrics.interior if metrics.interior_parts or "map" not in trial.algorithm else 0.0)
            invalid_count += invalid_pixel_count(rendered)
    return {"interior": interior, "pixels that are no number": invalid_count}


def select_views(views: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """Return the views with these names."""
    return {name: views[name] for name in names}


def max_by_figure(figure_sets: list[dict[str, float]]) -> dict[str, float]:
    """Return the largest value of each figure."""
    return {name: max(figures[name] for figures in figure_sets) for name in figure_sets[0]}


def moebius_strip(sections: int = 48) -> trimesh.Trimesh:
    """Return a strip 2.4 m wide round a circle of 3.5 m, 4 m up, with one half twist."""
    angle, side = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False), np.array([-1.2, 1.2])
    radius_m = 3.5 + side * np.cos(angle[:, None] / 2.0)
    strip = np.stack(
        [radius_m * np.cos(angle)[:, None], radius_m * np.sin(angle)[:, None], 4.0 + side * np.sin(angle[:, None] / 2.0)], axis=-1
    )
    ring_indices = np.arange(2 * sections).reshape(-1, 2)
    next_ring = np.roll(ring_indices, -1, axis=0)
    next_ring[-1] = next_ring[-1, ::-1]  # where the strip's ends meet, left becomes right
    triangles = np.concatenate(
        [np.column_stack([ring_indices, next_ring[:, :1]]), np.column_stack([ring_indices[:, 1:], next_ring[:, ::-1]])]
    )
    return trimesh.Trimesh(strip.reshape(-1, 3), triangles, process=False)


PLATE = [[-3, -2, 4], [3, -2, 4], [0, 3, 5]]

UNUSUAL_BODIES = {
    "open sheet": sheet(), "three walls at an edge": three_walls(), "Moebius strip": moebius_strip(),
    "triangle thrice": triangle_soup([PLATE, PLATE[::-1], PLATE]),
    "upper half of a sphere": half_sphere(False), "bowl": half_sphere(True),
    "without a triangle": without_triangles(HOUSE, 3), "inside out": flip_faces(HOUSE), "the same twice": join_meshes(HOUSE, HOUSE),
    "one in another": join_meshes(box((8, 8, 6)), box((3, 3, 2), 1.0)),
    "one through another": join_meshes(box((8, 8, 3)), box((3, 3, 9), 1.0, (1, 1))),
    "sharing an edge": join_meshes(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), at_m=(2, 2))),
}  # fmt: skip


def arrange_in_rows(bodies: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return six bodies on the floor, apart from one another, and a pebble."""
    places = [(x, y, 0.0) for y in (7.0, -9.0) for x in (-16.0, 0.0, 16.0)]
    placed_bodies = [body.copy().apply_translation(place) for body, place in zip(bodies, places, strict=True)]
    return with_ground_pebble(join_meshes(*placed_bodies))


@hard_case(
    "H16",
    "What is open, one-sided, joined three at an edge or there twice casts as rays say, and leaks nowhere",
    "a sheet, three walls at one edge, a Moebius strip, a triangle three times, half-spheres, boxes in one another; sun and spot",
    {"interior": 0, "pixels that are no number": 0},
)
def test_bodies_that_are_none(trial: Trial) -> dict[str, float]:
    """A picture shows six bodies. The quick way draws the first six under the spot, without the low eyes."""
    lamp = {**SPOT, "position": [-25, -40, 60], "target": [0, 0, 0], "cutoff": 45}
    bodies, results = list(UNUSUAL_BODIES.values()), []
    for first in (0, 6):
        row = arrange_in_rows(bodies[first : first + 6])
        sun_views = VIEWS if trial.thorough else select_views(VIEWS, "eye", "map")
        results.append(worst_over_views(trial, row, f"sun_{first}", sun_views, sun=(200, 35)))
        if trial.thorough or not first:
            spot_views = VIEWS if trial.thorough else select_views(VIEWS, "eye")
            results.append(worst_over_views(trial, row, f"spot_{first}", spot_views, lights={"spot": lamp}))
    return max_by_figure(results)


EDGE_ON_TRIANGLES = triangle_soup([[[-3, 0, 1], [3, 0, 1], [0, 0, 6]], [[-3, 0, 0], [-3, 2, 0], [-5, 1, 4]]])
"""A triangle in the plane y = 0, and another one."""


def house_with_moved_corner(steps: int) -> trimesh.Trimesh:
    """Return a house with one corner of its roof moved north by a number of float32 steps."""
    house = box((5, 4, 4), at_m=(9, -4))
    vertices = np.asarray(house.vertices, np.float32)
    corner = int(np.argmax(vertices @ [1.0, -1.0, 1.0]))
    vertices[corner, 1] = np.nextafter(vertices[corner, 1], np.float32(np.sign(steps) * np.inf)) if steps else vertices[corner, 1]
    return trimesh.Trimesh(vertices, house.faces, process=False)


@hard_case(
    "H17",
    "A triangle that the sun sees edge-on leaves its volume closed, whichever way rounding turns it",
    "upright faces in the sun's plane, the sun off by 0, 1 ulp, 1e-12 to 1e-3 degrees, a corner off by 1 ulp of float32; zenith",
    {"interior": 0, "pixels that are no number": 0},
)
def test_edge_on_to_the_sun(trial: Trial) -> dict[str, float]:
    ulps = [float(np.nextafter(90.0, end)) for end in (0.0, 180.0)]
    azimuths = [90.0 + offset_deg for offset_deg in (0.0, 1e-12, -1e-12, 1e-7, -1e-7, 1e-3, -1e-3)]
    sun_and_corner_cases = [(azimuth, 30.0, corner) for azimuth in [*ulps, *azimuths] for corner in (0, 1, -1)] + [
        (90.0, 90.0, c) for c in (0, 1, -1)
    ]
    if not trial.thorough:
        sun_and_corner_cases = [
            (90.0, 30.0, 0),
            (90.0, 30.0, 1),
            (90.0, 30.0, -1),
            (ulps[0], 30.0, 0),
            (ulps[1], 30.0, 0),
            (90.0, 90.0, 1),
        ]
    views = {"eye": eye((5, 8, 9), (1, -2, 0), fov=60)}
    return max_by_figure([
        worst_over_views(trial, join_meshes(EDGE_ON_TRIANGLES, house_with_moved_corner(corner)),
            f"way_{number}", views, sun=(azimuth, altitude))
        for number, (azimuth, altitude, corner) in enumerate(sun_and_corner_cases)
    ])  # fmt: skip


def slivers(aspect: float) -> trimesh.Trimesh:
    """Return a house whose roof and southern wall consist of slivers.

    The slivers are fans round points that lie ``aspect`` times nearer to one another than the house is long. The house stays
    closed.
    """
    a, b, c, d = [-4, -3], [4, -3], [4, 3], [-4, 3]
    close_points = [[-4.0 + 8.0 * k / aspect, -3.0] for k in range(1, 6)]
    rim = [a, *close_points, b, c, d]
    top, floor = [[*p, 5.0] for p in rim], [[*p, 0.0] for p in rim]
    points = np.array([*top, *floor], float)
    n = len(rim)
    roof = [[n - 2, k, k + 1] for k in range(n - 3)] + [[n - 2, n - 1, 0]]
    walls = [t for k in range(n) for t in ([n + k, n + (k + 1) % n, (k + 1) % n], [n + k, (k + 1) % n, k])]
    below = [[n + i for i in reversed(t)] for t in roof]
    return trimesh.Trimesh(points, np.array([*roof, *walls, *below]), process=False)


def degenerate_triangles() -> trimesh.Trimesh:
    """Return triangles that are a line or a point, alone and on a house; and needles."""
    flat = [[[9, 9, 0], [9, 9, 4], [9, 9, 2]], [[-9, 9, 3], [-9, 9, 3], [-9, 9, 3]], [[-9, -3, 1], [-5, -3, 1], [-5, -3, 1]]]
    needles = [[[x, 8, 3], [x + 1e-5, 8, 3], [x, -2, 3.5]] for x in np.linspace(-12, 12, 9)]
    return join_meshes(
        box((8, 6, 5)), triangle_soup(flat), triangle_soup(needles), triangle_soup([[[-4, -3, 5], [4, -3, 5], [0, -3, 5]]])
    )


@hard_case(
    "H18",
    "Triangles without an area and slivers make no NaN and no leak",
    "a house of slivers of aspect 1e3 to 1e6, lines and points for triangles, needles 10 m long and 10 microns thick; sun and spot",
    {"interior": 0, "pixels that are no number": 0},
)
def test_slivers(trial: Trial) -> dict[str, float]:
    views = {"eye": eye((14, 26, 12), (0, 3, 0)), "map": {"kind": "map", "bounds": [-16, -12, 16, 12]}}
    results = [worst_over_views(trial, join_meshes(slivers(1e6), degenerate_triangles()), "sun", views, sun=(180, 35))]
    results.append(
        worst_over_views(
            trial, join_meshes(slivers(1e6), degenerate_triangles()), "spot", select_views(views, "eye"), lights={"spot": SPOT}
        )
    )
    aspects = (1e3, 1e4, 1e5, 1e6) if trial.thorough else ()
    return max_by_figure(
        [*results, *(worst_over_views(trial, slivers(a), f"slivers_{a:g}", views, sun=(200, 35)) for a in aspects)]
    )
