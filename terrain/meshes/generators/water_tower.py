"""A water tower on six braced legs, with one large round shadow and many fine ones."""

from __future__ import annotations

import numpy as np

from skugga.terrain.meshes.body import Body, transformed
from skugga.terrain.meshes.generators.shapes import arc, circle, hull, lathe, ring, tube

LEG_COUNT = 6
LEG_FOOT_RADIUS_M, LEG_TOP_RADIUS_M = 8.0, 5.75
TANK_RADIUS_M = 6.0
GALLERY_HEIGHT_M = 24.0
"""Height of the gallery, the lower end of the tank's wall and the upper end of the legs."""

BRACE_HEIGHTS_M = (0.9, 8.6, 16.3, 23.2)
"""Heights of the joints of the braces, the lowest on the footings."""

RUNG_SPACING_M = 0.36
LADDER_CAGE_BOTTOM_M, LADDER_CAGE_RADIUS_M = 2.6, 0.4

STEEL_COLOR, PAINT_COLOR, ROOF_COLOR, CONCRETE_COLOR = (
    (0.42, 0.47, 0.49),
    (0.80, 0.83, 0.82),
    (0.55, 0.31, 0.26),
    (0.68, 0.67, 0.64),
)


def water_tower() -> list[Body]:
    """Return tank, gallery, legs, braces and ladder, 37 m high: some 12,500 triangles."""
    return [*_tank(), *_gallery(), *_legs(), *_braces(), *_ladder()]


def _tank() -> list[Body]:
    """Return a bowl and a wall under a conical roof, and the riser pipe in the middle."""
    angles = np.radians(np.linspace(0, 90, 13))
    bowl = [(TANK_RADIUS_M * np.sin(angle), GALLERY_HEIGHT_M - 4.2 * np.cos(angle)) for angle in angles]
    wall_top = GALLERY_HEIGHT_M + 6.4
    eaves = TANK_RADIUS_M + 0.45
    roof = [(0.0, wall_top - 0.1), (eaves - 0.1, wall_top - 0.1), (eaves, wall_top), (eaves, wall_top + 0.12)]
    cone = [(eaves * (1 - s) + 0.5 * s, wall_top + 0.12 + 3.6 * s) for s in (0.25, 0.5, 0.75, 1.0)]
    cap = [
        (0.5, wall_top + 4.3),
        (0.62, wall_top + 4.35),
        (0.3, wall_top + 4.8),
        (0.06, wall_top + 5.0),
        (0.05, wall_top + 6.6),
        (0.0, wall_top + 6.6),
    ]
    return [
        lathe([*bowl, (TANK_RADIUS_M, wall_top), (0.0, wall_top)], 64, PAINT_COLOR),
        lathe([*roof, *cone, *cap], 64, ROOF_COLOR),
        lathe(
            [(0.0, 0.0), (1.1, 0.0), (1.1, 0.5), (0.55, 0.7), (0.55, GALLERY_HEIGHT_M - 4.0), (0.0, GALLERY_HEIGHT_M - 4.0)],
            24,
            PAINT_COLOR,
        ),
    ]


def _gallery() -> list[Body]:
    """Return a walkway around the tank with a railing of three bars."""
    inner, outer = TANK_RADIUS_M - 0.1, TANK_RADIUS_M + 1.1
    floor = [
        (inner, GALLERY_HEIGHT_M - 0.07),
        (outer, GALLERY_HEIGHT_M - 0.07),
        (outer, GALLERY_HEIGHT_M + 0.07),
        (inner, GALLERY_HEIGHT_M + 0.07),
    ]
    bars = [ring(circle((outer - 0.08, GALLERY_HEIGHT_M + up), 0.03, 6), 64, STEEL_COLOR) for up in (0.42, 0.77, 1.12)]
    posts = [
        tube(
            [
                (*_on_circle(outer - 0.08, azimuth_deg), GALLERY_HEIGHT_M),
                (*_on_circle(outer - 0.08, azimuth_deg), GALLERY_HEIGHT_M + 1.13),
            ],
            0.04,
            6,
            STEEL_COLOR,
        )
        for azimuth_deg in range(0, 360, 10)
    ]
    return [ring(floor, 64, STEEL_COLOR), *bars, *posts]


def _legs() -> list[Body]:
    """Return the inclined legs, each between a footing and the tank's wall."""
    foot = np.array([(i * s, j * s, up) for s, up in ((0.95, 0.0), (0.6, 0.9)) for i in (-1, 1) for j in (-1, 1)])
    bodies = []
    for azimuth_deg in _leg_angles_deg():
        bodies.append(transformed(transformed(hull(foot, CONCRETE_COLOR), (LEG_FOOT_RADIUS_M, 0.0, 0.0)), yaw_deg=azimuth_deg))
        bodies.append(
            tube([_on_leg(0.5, azimuth_deg), _on_leg(GALLERY_HEIGHT_M + 1.0, azimuth_deg)], [0.34, 0.26], 16, STEEL_COLOR)
        )
    return bodies


def _braces() -> list[Body]:
    """Return the struts around each tier, and two crossed rods in each panel."""
    bodies = []
    for azimuth_deg, next_azimuth_deg in zip(_leg_angles_deg(), np.roll(_leg_angles_deg(), -1), strict=True):
        bodies += [
            tube([_on_leg(up, azimuth_deg), _on_leg(up, next_azimuth_deg)], 0.13, 8, STEEL_COLOR) for up in BRACE_HEIGHTS_M[1:]
        ]
        for low, high in zip(BRACE_HEIGHTS_M[:-1], BRACE_HEIGHTS_M[1:], strict=True):
            bodies += [
                tube([_on_leg(low, a), _on_leg(high, b)], 0.055, 6, STEEL_COLOR)
                for a, b in ((azimuth_deg, next_azimuth_deg), (next_azimuth_deg, azimuth_deg))
            ]
    return bodies


def _ladder() -> list[Body]:
    """Return a caged ladder to the gallery, tied to the struts, and a plain ladder from there to the roof."""
    ladder_east, half_width, gallery = TANK_RADIUS_M + 1.35, 0.24, GALLERY_HEIGHT_M + 1.1
    eaves, roof = TANK_RADIUS_M + 0.6, GALLERY_HEIGHT_M + 6.9
    bodies = []
    for side in (-half_width, half_width):
        bodies.append(tube([(ladder_east, side, 0.0), (ladder_east, side, gallery)], 0.035, 6, STEEL_COLOR))
        bodies.append(
            tube([(eaves, side, GALLERY_HEIGHT_M), (eaves, side, roof), (eaves - 1.2, side, roof + 0.5)], 0.035, 6, STEEL_COLOR)
        )
        for up in BRACE_HEIGHTS_M[1:]:
            strut = _on_leg(up, _leg_angles_deg()[0])[0]
            bodies.append(tube([(strut, side, up), (ladder_east, side, up)], 0.04, 6, STEEL_COLOR))
    for east, first, last in ((ladder_east, 0.4, GALLERY_HEIGHT_M), (eaves, GALLERY_HEIGHT_M + 0.4, roof)):
        for up in np.arange(first, last, RUNG_SPACING_M):
            bodies.append(tube([(east, -half_width, up), (east, half_width, up)], 0.022, 5, STEEL_COLOR))
    hoops = np.linspace(LADDER_CAGE_BOTTOM_M, gallery - 0.1, 16)
    for up in hoops:
        bodies.append(tube(arc((ladder_east + 0.22, 0.0, up), LADDER_CAGE_RADIUS_M, -145, 145, 9), 0.02, 5, STEEL_COLOR))
    for azimuth_deg in (-90, -30, 30, 90):
        east, north = _on_circle(LADDER_CAGE_RADIUS_M, azimuth_deg)
        bodies.append(
            tube(
                [(ladder_east + 0.22 + east, north, hoops[0]), (ladder_east + 0.22 + east, north, hoops[-1])], 0.02, 5, STEEL_COLOR
            )
        )
    return bodies


def _leg_angles_deg() -> np.ndarray:
    """Return the azimuths of the legs, degrees counter-clockwise from east."""
    return 30.0 + np.arange(LEG_COUNT) * 360.0 / LEG_COUNT


def _on_circle(radius_m: float, azimuth_deg: float) -> tuple[float, float]:
    """Return the point (east, north) on a circle round the origin. The angle is counter-clockwise from east."""
    return radius_m * np.cos(np.radians(azimuth_deg)), radius_m * np.sin(np.radians(azimuth_deg))


def _on_leg(up_m: float, azimuth_deg: float) -> tuple[float, float, float]:
    """Return the point of a leg's axis at a height."""
    radius = LEG_FOOT_RADIUS_M + (LEG_TOP_RADIUS_M - LEG_FOOT_RADIUS_M) * up_m / GALLERY_HEIGHT_M
    return (*_on_circle(radius, azimuth_deg), up_m)
