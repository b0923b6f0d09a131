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
    grounded,
    half_sphere,
    inside_out,
    interior_sight,
    joined,
    not_a_number,
    sheet,
    size_of,
    soup,
    three_walls,
    without,
)
from tests.hard_cases.cases import Trial, hard_case
from tests.hard_cases.reach_of_error import beyond, beyond_sight
from tests.shadows.boxes import box

HALL = box((8, 6, 5))

VIEWS: dict[str, dict[str, Any]] = {
    "eye": eye((22, 42, 26), (0, 2, 0)),
    "map": {"kind": "map", "bounds": [-30, -22.5, 30, 22.5]},
    "low": eye((-21, 30, 2), (4, 0, 3), fov=75),
}


def worst_of(trial: Trial, bodies: trimesh.Trimesh, name: str, views: Mapping[str, Any] = VIEWS, **keys: Any) -> dict[str, float]:
    """Return the worst interior error over some views of bodies, and the number of pixels without a valid visibility.

    Algorithms without maps get all views but the map. A shadow map's texels reach round the foot of a sheet and over a face at a
    grazing angle, farther than two of their footprints in the picture. Under the sun all its errors count, inside or at an edge,
    that its reach does not explain. That reach is known for the sun only. Under a lamp interior errors count if 8 px or more are
    connected.
    """
    interior, nothing = 0.0, 0
    scene = trial.scene(FLOOR, meshes=[bodies], name=name, views=dict(views), **keys)
    for view, spec in views.items():
        if spec["kind"] == "perspective" or trial.algorithm != "perspective_shadow_map":
            seen = trial.see(scene, scene.view(view, size=size_of(trial.thorough)))
            assert (seen.truth.valid & ~seen.truth.lit & ~seen.truth.attached).any()
            if "map" in trial.algorithm and seen.light == SUN:
                interior = max(interior, float(beyond(seen).mean()))
                trial.saw("interior", beyond_sight(seen))
            else:
                found = errors(seen)
                trial.saw("interior", interior_sight(seen))
                interior = max(interior, found.interior if found.interior_parts or "map" not in trial.algorithm else 0.0)
            nothing += not_a_number(seen)
    return {"interior": interior, "pixels that are no number": nothing}


def some(views: Mapping[str, Any], *names: str) -> dict[str, Any]:
    return {name: views[name] for name in names}


def worst(found: list[dict[str, float]]) -> dict[str, float]:
    return {name: max(each[name] for each in found) for name in found[0]}


def moebius_strip(sections: int = 48) -> trimesh.Trimesh:
    """Return a strip 2.4 m wide round a circle of 3.5 m, 4 m up, with one half twist."""
    turn, side = np.linspace(0.0, 2.0 * np.pi, sections, endpoint=False), np.array([-1.2, 1.2])
    away = 3.5 + side * np.cos(turn[:, None] / 2.0)
    strip = np.stack(
        [away * np.cos(turn)[:, None], away * np.sin(turn)[:, None], 4.0 + side * np.sin(turn[:, None] / 2.0)], axis=-1
    )
    here = np.arange(2 * sections).reshape(-1, 2)
    next_ring = np.roll(here, -1, axis=0)
    next_ring[-1] = next_ring[-1, ::-1]  # where the strip's ends meet, left becomes right
    triangles = np.concatenate([np.column_stack([here, next_ring[:, :1]]), np.column_stack([here[:, 1:], next_ring[:, ::-1]])])
    return trimesh.Trimesh(strip.reshape(-1, 3), triangles, process=False)


PLATE = [[-3, -2, 4], [3, -2, 4], [0, 3, 5]]

HOSTILE = {
    "open sheet": sheet(), "three walls at an edge": three_walls(), "Moebius strip": moebius_strip(),
    "triangle thrice": soup([PLATE, PLATE[::-1], PLATE]),
    "upper half of a sphere": half_sphere(False), "bowl": half_sphere(True),
    "without a triangle": without(HALL, 3), "inside out": inside_out(HALL), "the same twice": joined(HALL, HALL),
    "one in another": joined(box((8, 8, 6)), box((3, 3, 2), 1.0)),
    "one through another": joined(box((8, 8, 3)), box((3, 3, 9), 1.0, (1, 1))),
    "sharing an edge": joined(box((4, 4, 4), at_m=(-2, -2)), box((4, 4, 4), at_m=(2, 2))),
}  # fmt: skip


def in_rows(bodies: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """Return six bodies on the floor, apart from one another, and a pebble."""
    places = [(x, y, 0.0) for y in (7.0, -9.0) for x in (-16.0, 0.0, 16.0)]
    moved = [body.copy().apply_translation(place) for body, place in zip(bodies, places, strict=True)]
    return grounded(joined(*moved))


@hard_case(
    "H16",
    "What is open, one-sided, joined three at an edge or there twice casts as rays say, and leaks nowhere",
    "a sheet, three walls at one edge, a Moebius strip, a triangle three times, half-spheres, boxes in one another; sun and spot",
    {"interior": 0, "pixels that are no number": 0},
)
def test_bodies_that_are_none(trial: Trial) -> dict[str, float]:
    """A picture shows six bodies. The quick way draws the first six under the spot, without the low eyes."""
    lamp = {**SPOT, "position": [-25, -40, 60], "target": [0, 0, 0], "cutoff": 45}
    bodies, found = list(HOSTILE.values()), []
    for first in (0, 6):
        these = in_rows(bodies[first : first + 6])
        in_sun = VIEWS if trial.thorough else some(VIEWS, "eye", "map")
        found.append(worst_of(trial, these, f"sun_{first}", in_sun, sun=(200, 35)))
        if trial.thorough or not first:
            under_spot = VIEWS if trial.thorough else some(VIEWS, "eye")
            found.append(worst_of(trial, these, f"spot_{first}", under_spot, lights={"spot": lamp}))
    return worst(found)


EDGE_ON = soup([[[-3, 0, 1], [3, 0, 1], [0, 0, 6]], [[-3, 0, 0], [-3, 2, 0], [-5, 1, 4]]])
"""A triangle in the plane y = 0, and another one."""


def with_corner_moved(steps: int) -> trimesh.Trimesh:
    """Return a house beside them, with one corner of its roof moved north by steps of float32."""
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
    offs = [90.0 + off for off in (0.0, 1e-12, -1e-12, 1e-7, -1e-7, 1e-3, -1e-3)]
    ways = [(azimuth, 30.0, corner) for azimuth in [*ulps, *offs] for corner in (0, 1, -1)] + [(90.0, 90.0, c) for c in (0, 1, -1)]
    if not trial.thorough:
        ways = [(90.0, 30.0, 0), (90.0, 30.0, 1), (90.0, 30.0, -1), (ulps[0], 30.0, 0), (ulps[1], 30.0, 0), (90.0, 90.0, 1)]
    views = {"eye": eye((5, 8, 9), (1, -2, 0), fov=60)}
    return worst([
        worst_of(trial, joined(EDGE_ON, with_corner_moved(corner)), f"way_{number}", views, sun=(azimuth, altitude))
        for number, (azimuth, altitude, corner) in enumerate(ways)
    ])  # fmt: skip


def slivers(aspect: float) -> trimesh.Trimesh:
    """Return a house whose roof and southern wall consist of slivers.

    The slivers are fans round points that lie ``aspect`` times nearer to one another than the house is long. The house stays
    closed.
    """
    a, b, c, d = [-4, -3], [4, -3], [4, 3], [-4, 3]
    beside = [[-4.0 + 8.0 * k / aspect, -3.0] for k in range(1, 6)]
    rim = [a, *beside, b, c, d]
    top, floor = [[*p, 5.0] for p in rim], [[*p, 0.0] for p in rim]
    points = np.array([*top, *floor], float)
    n = len(rim)
    roof = [[n - 2, k, k + 1] for k in range(n - 3)] + [[n - 2, n - 1, 0]]
    walls = [t for k in range(n) for t in ([n + k, n + (k + 1) % n, (k + 1) % n], [n + k, (k + 1) % n, k])]
    below = [[n + i for i in reversed(t)] for t in roof]
    return trimesh.Trimesh(points, np.array([*roof, *walls, *below]), process=False)


def without_area() -> trimesh.Trimesh:
    """Return triangles that are a line or a point, alone and on a house; and needles."""
    flat = [[[9, 9, 0], [9, 9, 4], [9, 9, 2]], [[-9, 9, 3], [-9, 9, 3], [-9, 9, 3]], [[-9, -3, 1], [-5, -3, 1], [-5, -3, 1]]]
    needles = [[[x, 8, 3], [x + 1e-5, 8, 3], [x, -2, 3.5]] for x in np.linspace(-12, 12, 9)]
    return joined(box((8, 6, 5)), soup(flat), soup(needles), soup([[[-4, -3, 5], [4, -3, 5], [0, -3, 5]]]))


@hard_case(
    "H18",
    "Triangles without an area and slivers make no NaN and no leak",
    "a house of slivers of aspect 1e3 to 1e6, lines and points for triangles, needles 10 m long and 10 microns thick; sun and spot",
    {"interior": 0, "pixels that are no number": 0},
)
def test_slivers(trial: Trial) -> dict[str, float]:
    views = {"eye": eye((14, 26, 12), (0, 3, 0)), "map": {"kind": "map", "bounds": [-16, -12, 16, 12]}}
    both = [worst_of(trial, joined(slivers(1e6), without_area()), "sun", views, sun=(180, 35))]
    both.append(worst_of(trial, joined(slivers(1e6), without_area()), "spot", some(views, "eye"), lights={"spot": SPOT}))
    aspects = (1e3, 1e4, 1e5, 1e6) if trial.thorough else ()
    return worst([*both, *(worst_of(trial, slivers(a), f"slivers_{a:g}", views, sun=(200, 35)) for a in aspects)])
