"""Furniture of the room: each piece is a list of closed bodies at the origin, facing south."""

from __future__ import annotations

import numpy as np

from skugga.terrain.meshes.body import Body, transformed
from skugga.terrain.meshes.generators.shapes import Colour, Vector, block, cuboid, lathe, loft, tube

OAK_COLOR, WALNUT_COLOR, BRASS_COLOR = (0.66, 0.50, 0.34), (0.42, 0.30, 0.22), (0.70, 0.58, 0.36)
LINEN_COLOR, PAINT_COLOR = (0.72, 0.69, 0.62), (0.85, 0.84, 0.80)
CLAY_COLOR, LEAF_COLOR = (0.68, 0.42, 0.30), (0.27, 0.42, 0.22)
ORANGE_PEEL_COLOR, GLAZE_COLOR = (0.85, 0.52, 0.18), (0.36, 0.50, 0.56)
BOOK_SPINE_COLORS = (
    (0.55, 0.25, 0.22),
    (0.28, 0.36, 0.45),
    (0.78, 0.72, 0.58),
    (0.33, 0.42, 0.33),
    (0.62, 0.48, 0.30),
    (0.30, 0.28, 0.30),
    (0.80, 0.78, 0.74),
)

TABLE_HEIGHT_M, SEAT_HEIGHT_M = 0.75, 0.45
"""Heights of the table top and of the seats."""


def dining_table() -> list[Body]:
    """Return a table for six on turned legs."""
    leg = [
        (0.0, 0.0),
        (0.022, 0.0),
        (0.03, 0.05),
        (0.024, 0.12),
        (0.042, 0.35),
        (0.03, 0.52),
        (0.045, 0.56),
        (0.045, 0.7),
        (0.0, 0.7),
    ]
    top = transformed(block((2.1, 1.0, 0.05), (14, 8, 2), OAK_COLOR, 16.0), (0, 0, TABLE_HEIGHT_M - 0.025))
    legs = [lathe(leg, 12, OAK_COLOR, (i * 0.9, j * 0.38, 0.0)) for i in (-1, 1) for j in (-1, 1)]
    aprons = [cuboid((-0.9, j * 0.38 - 0.015, 0.6), (0.9, j * 0.38 + 0.015, 0.72), OAK_COLOR) for j in (-1, 1)]
    aprons += [cuboid((i * 0.9 - 0.015, -0.38, 0.6), (i * 0.9 + 0.015, 0.38, 0.72), OAK_COLOR) for i in (-1, 1)]
    return [top, *legs, *aprons]


def chair() -> list[Body]:
    """Return a chair with a spindle back, its back to the north."""
    seat = transformed(block((0.46, 0.44, 0.045), (5, 5, 1), WALNUT_COLOR, 5.0), (0, 0, SEAT_HEIGHT_M - 0.022))
    feet = [(i * 0.21, j * 0.20, 0.0) for i in (-1, 1) for j in (-1, 1)]
    legs = [tube([foot, (foot[0] * 0.78, foot[1] * 0.78, SEAT_HEIGHT_M - 0.02)], [0.013, 0.019], 6, WALNUT_COLOR) for foot in feet]
    stays = [tube([(i * 0.185, -0.178, 0.2), (i * 0.185, 0.178, 0.2)], 0.011, 6, WALNUT_COLOR) for i in (-1, 1)]
    stays.append(tube([(-0.185, 0.0, 0.2), (0.185, 0.0, 0.2)], 0.011, 6, WALNUT_COLOR))
    x_positions = np.linspace(-0.18, 0.18, 7)
    back = [
        tube([(x * 0.9, 0.18, SEAT_HEIGHT_M - 0.02), (x * 1.15, 0.27, 0.9)], 0.016 if abs(x) > 0.17 else 0.008, 6, WALNUT_COLOR)
        for x in x_positions
    ]
    bow = [(x * 1.35, 0.275 - 1.2 * x * x, 0.9 + 0.012 * np.cos(8 * x)) for x in x_positions]
    return [seat, *legs, *stays, *back, tube(bow, 0.021, 6, WALNUT_COLOR)]


def pendant(cord_m: float) -> list[Body]:
    """Return a pendant lamp: the shade's rim at height 0, the end of its cord at ``cord_m``."""
    outside = [(0.27, 0.0), (0.262, 0.07), (0.235, 0.14), (0.18, 0.205), (0.1, 0.25), (0.05, 0.27), (0.04, 0.33)]
    inside = [(r - 0.008, up - 0.008) for r, up in outside[1:-1]]
    shade = [(0.0, 0.255), *reversed(inside), (0.262, 0.0), *outside, (0.0, 0.33)]
    angle = np.linspace(0, np.pi, 9)
    bulb = [(0.055 * np.sin(t), 0.1 - 0.055 * np.cos(t)) for t in angle]
    bulb[0], bulb[-1] = (0.0, bulb[0][1]), (0.0, bulb[-1][1])
    return [
        lathe(shade, 24, BRASS_COLOR),
        lathe(bulb, 16, PAINT_COLOR),
        lathe([(0.0, 0.15), (0.02, 0.15), (0.02, 0.27), (0.0, 0.27)], 12, BRASS_COLOR),
        tube([(0, 0, 0.32), (0, 0, cord_m)], 0.006, 6, WALNUT_COLOR),
    ]


def bookshelf() -> list[Body]:
    """Return a bookshelf of two bays with five boards of books, 2.2 m wide, its back to the north."""
    half, deep, high, thick = 1.1, 0.3, 2.1, 0.03
    bodies = [cuboid((x - thick / 2, 0.0, 0.0), (x + thick / 2, deep, high), OAK_COLOR) for x in (-half, 0.0, half)]
    bodies.append(cuboid((-half, deep - 0.01, 0.05), (half, deep + 0.01, high), OAK_COLOR))
    boards = np.linspace(0.06, high - thick, 6)
    bodies += [cuboid((-half, 0.002, up), (half, deep, up + thick), OAK_COLOR) for up in boards]
    rng = np.random.default_rng(11)
    for up in boards[:-1] + thick:
        for bay in (-half, 0.0):
            x, end = bay + 0.03 + rng.uniform(0.0, 0.1), bay + half - rng.uniform(0.04, 0.45)
            while x < end:
                wide, tall, book_depth = rng.uniform(0.022, 0.055), rng.uniform(0.2, 0.33), rng.uniform(0.17, 0.23)
                front = rng.uniform(0.02, 0.05)
                spine = BOOK_SPINE_COLORS[rng.integers(len(BOOK_SPINE_COLORS))]
                bodies.append(cuboid((x, front, up - 0.002), (x + wide, front + book_depth, up + tall), spine))
                x += wide + rng.uniform(0.001, 0.006)
    return bodies


def sofa() -> list[Body]:
    """Return a sofa for three, its back to the north."""

    def cushion(size_m: Vector, at_m: Vector, cells: tuple[int, int, int], color: Colour = LINEN_COLOR) -> Body:
        return transformed(block(size_m, cells, color, 6.0), at_m)

    seats = [cushion((0.68, 0.72, 0.2), (x, -0.04, 0.38), (5, 5, 2)) for x in (-0.66, 0.0, 0.66)]
    backs = [cushion((0.66, 0.2, 0.46), (x, 0.3, 0.68), (5, 2, 4)) for x in (-0.66, 0.0, 0.66)]
    arms = [cushion((0.18, 0.9, 0.46), (x, 0.0, 0.39), (2, 6, 3)) for x in (-1.06, 1.06)]
    pillows = [
        transformed(block((0.42, 0.14, 0.42), (5, 2, 5), GLAZE_COLOR, 3.0), (-0.72, 0.12, 0.7), 12.0),
        transformed(block((0.4, 0.13, 0.4), (5, 2, 5), CLAY_COLOR, 3.0), (0.7, 0.14, 0.68), -15.0),
    ]
    frame = [cuboid((-1.1, -0.38, 0.14), (1.1, 0.42, 0.3), LINEN_COLOR), cuboid((-1.1, 0.34, 0.2), (1.1, 0.46, 0.82), LINEN_COLOR)]
    feet = [
        lathe([(0, 0), (0.02, 0), (0.03, 0.16), (0, 0.16)], 10, WALNUT_COLOR, (i * 1.0, j * 0.34, 0.0))
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    return [*seats, *backs, *arms, *pillows, *frame, *feet]


def vase(height_m: float, color: Colour) -> Body:
    """Return a hollow vase with a belly, a neck and a lip."""
    share = np.linspace(0.0, 1.0, 10)
    radius = height_m * (0.13 + 0.15 * np.sin(np.pi * share**0.8) ** 1.5 * (1 - share) ** 0.3 + 0.06 * share**6)
    outside = list(zip(radius, height_m * share, strict=True))
    inside = [(r - 0.008, up) for r, up in reversed(outside[1:])]
    return lathe([(0.0, 0.0), *outside, *inside, (0.0, outside[1][1])], 20, color)


def fruit_bowl() -> list[Body]:
    """Return a wide bowl with six oranges."""
    outside = [(0.06, 0.0), (0.065, 0.02), (0.12, 0.045), (0.17, 0.085), (0.19, 0.125)]
    inside = [(r - 0.008, up + 0.004) for r, up in reversed(outside[1:-1])]
    bodies = [lathe([(0.0, 0.0), *outside, (0.183, 0.126), *inside, (0.0, 0.026)], 24, PAINT_COLOR)]
    angle = np.linspace(0, np.pi, 9)[1:-1]
    ball = [(0.0, -0.042), *((0.042 * np.sin(t), -0.042 * np.cos(t)) for t in angle), (0.0, 0.042)]
    for position in (
        (0.0, 0.08, 0.1),
        (0.078, 0.022, 0.1),
        (0.05, -0.068, 0.1),
        (-0.05, -0.066, 0.1),
        (-0.077, 0.024, 0.1),
        (0.0, 0.0, 0.15),
    ):
        bodies.append(lathe(ball, 12, ORANGE_PEEL_COLOR, position))
    return bodies


def potted_plant(leaves: int, height_m: float, seed: int) -> list[Body]:
    """Return a potted plant: stalks with long bent leaves."""
    pot = [(0.0, 0.0), (0.13, 0.0), (0.17, 0.26), (0.19, 0.27), (0.19, 0.32), (0.165, 0.32), (0.155, 0.27), (0.0, 0.27)]
    rng = np.random.default_rng(seed)
    bodies = [lathe(pot, 24, CLAY_COLOR)]
    for number in range(leaves):
        reach, top = rng.uniform(0.25, 0.55) * height_m, rng.uniform(0.55, 1.0) * height_m
        bodies.append(transformed(_leaf(reach, top), (0.0, 0.0, 0.24), number * 137.508 + rng.uniform(-12, 12)))
    return bodies


def _leaf(reach_m: float, top_m: float) -> Body:
    """Return a leaf on its stalk, lens-shaped in section, that rises from the origin and bends to the east."""
    share = np.linspace(0.0, 1.0, 7)
    spine = np.column_stack([0.02 + reach_m * share**1.7, np.zeros(7), top_m * np.sin(0.62 * np.pi * share) / np.sin(0.5 * np.pi)])
    width = np.maximum(0.007, 0.075 * np.sin(np.pi * np.clip((share - 0.3) / 0.72, 0, 1)))
    tangent = np.gradient(spine, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = np.column_stack([-tangent[:, 2], np.zeros(7), tangent[:, 0]])
    thick = np.where(width > 0.01, 0.004, 0.006)
    side = np.array([0.0, 1.0, 0.0])
    loops = np.stack(
        [
            spine + width[:, None] * side,
            spine + thick[:, None] * normal,
            spine - width[:, None] * side,
            spine - thick[:, None] * normal,
        ],
        axis=1,
    )
    return loft(loops, LEAF_COLOR)
