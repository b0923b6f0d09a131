"""A village street of 400 triangles, with gabled houses on either side and a church at the end."""

from __future__ import annotations

from skugga.terrain.meshes.body import Body, transformed
from skugga.terrain.meshes.generators.shapes import Colour, cuboid, gable, hull

PLASTER_COLORS = ((0.86, 0.80, 0.68), (0.80, 0.66, 0.52), (0.78, 0.78, 0.74), (0.72, 0.52, 0.42), (0.88, 0.86, 0.80))
TILE_COLOR, SLATE_COLOR, BRICK_COLOR = (0.60, 0.30, 0.22), (0.36, 0.38, 0.42), (0.52, 0.30, 0.24)
STONE_COLOR, WOOD_COLOR, HEDGE_COLOR, IRON_COLOR = (0.70, 0.68, 0.63), (0.46, 0.35, 0.24), (0.28, 0.38, 0.20), (0.25, 0.26, 0.27)

ROOF_OVERHANG_M = 0.45
"""Overhang of the roofs beyond the walls."""

HOUSE_FRONT_DISTANCE_M = 5.5
"""Distance from the middle of the street to the houses."""

# Side of the street (1: east), position along it, setback, width along the street, depth, heights of eaves and ridge, chimney.
HOUSES = (
    (-1, -34.0, 0.0, 10.0, 8.0, 5.6, 9.4, True),
    (-1, -21.5, 1.5, 8.0, 9.5, 3.4, 7.9, True),
    (-1, -9.0, 0.0, 11.5, 8.0, 6.0, 9.8, True),
    (-1, 5.5, 0.8, 9.0, 8.5, 3.6, 7.6, False),
    (-1, 19.0, 0.0, 12.0, 8.5, 5.8, 9.6, True),
    (1, -35.0, 1.2, 9.0, 9.0, 3.5, 7.6, False),
    (1, -22.0, 0.0, 11.0, 8.0, 5.9, 9.6, True),
    (1, -8.5, 2.0, 8.5, 10.0, 3.3, 8.0, True),
    (1, 4.5, 0.0, 11.0, 8.0, 6.2, 10.0, True),
    (1, 18.0, 0.6, 9.0, 9.0, 3.8, 7.8, False),
)


def street() -> list[Body]:
    """Return ten houses, seven chimneys, a church and street furniture: 400 triangles."""
    bodies = []
    for number, (side, street_position, setback, width, depth, eaves, ridge, chimney) in enumerate(HOUSES):
        near = HOUSE_FRONT_DISTANCE_M + setback
        low, high = sorted((side * near, side * (near + depth)))
        roof = TILE_COLOR if number % 3 else SLATE_COLOR
        bodies += _house(
            (low, street_position - width / 2),
            (high, street_position + width / 2),
            eaves,
            ridge,
            PLASTER_COLORS[number % len(PLASTER_COLORS)],
            roof,
        )
        if chimney:
            east, north = (low + high) / 2 - side * 0.9, street_position + (number % 2 - 0.5) * width * 0.55
            bodies.append(cuboid((east - 0.45, north - 0.35, eaves), (east + 0.45, north + 0.35, ridge + 1.0), BRICK_COLOR))
    return bodies + _church() + _furniture()


def _house(
    low: tuple[float, float],
    high: tuple[float, float],
    eaves_height_m: float,
    ridge_height_m: float,
    wall_color: Colour,
    roof_color: Colour,
) -> list[Body]:
    """Return walls under a gabled roof with overhanging eaves: 20 triangles."""
    overhang = ROOF_OVERHANG_M
    return [
        cuboid((*low, 0.0), (*high, eaves_height_m + 0.1), wall_color),
        gable(
            (low[0] - overhang, low[1] - overhang),
            (high[0] + overhang, high[1] + overhang),
            eaves_height_m,
            ridge_height_m,
            roof_color,
        ),
    ]


def _church() -> list[Body]:
    """Return nave, tower and spire across the end of the street: 38 triangles."""
    nave = _house((-5.0, 42.0), (5.0, 60.0), 7.0, 13.0, PLASTER_COLORS[4], SLATE_COLOR)
    tower = cuboid((-2.6, 37.6, 0.0), (2.6, 42.8, 16.0), PLASTER_COLORS[4])
    return [*nave, tower, _pyramid((0.0, 40.2), 3.0, 15.8, 27.0, SLATE_COLOR)]


def _furniture() -> list[Body]:
    """Return a well house, lamps, a hedge and a bench: 78 triangles."""
    lamp = cuboid((-0.09, -0.09, 0.0), (0.09, 0.09, 4.6), IRON_COLOR)
    bench = cuboid((-0.3, -1.1, 0.0), (0.3, 1.1, 0.5), WOOD_COLOR)
    return [
        cuboid((-1.1, 29.4, 0.0), (1.1, 31.6, 2.3), STONE_COLOR),
        _pyramid((0.0, 30.5), 1.6, 2.25, 4.0, TILE_COLOR),
        transformed(lamp, (-4.2, -15.0, 0.0)),
        transformed(lamp, (4.2, -1.5, 0.0)),
        cuboid((4.6, -31.0, 0.0), (5.4, -28.2, 1.3), HEDGE_COLOR),
        transformed(bench, (-4.6, 9.4, 0.0)),
        transformed(lamp, (-4.2, 12.0, 0.0)),
    ]


def _pyramid(middle: tuple[float, float], half_width_m: float, bottom_m: float, top_m: float, color: Colour) -> Body:
    """Return a pyramid over a square, with its apex at ``top_m``. ``middle`` (east, north) is the middle of the square."""
    corners = [(middle[0] + i * half_width_m, middle[1] + j * half_width_m, bottom_m) for i in (-1, 1) for j in (-1, 1)]
    return hull([*corners, (*middle, top_m)], color)
