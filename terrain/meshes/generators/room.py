"""A living room half under a lattice. Light enters through slats, a window and an open front."""

from __future__ import annotations

import numpy as np
import shapely

from skugga.terrain.meshes.body import Body, transformed
from skugga.terrain.meshes.generators import furniture as furniture_pieces
from skugga.terrain.meshes.generators.furniture import (
    BRASS_COLOR,
    CLAY_COLOR,
    GLAZE_COLOR,
    LINEN_COLOR,
    OAK_COLOR,
    PAINT_COLOR,
    TABLE_HEIGHT_M,
    WALNUT_COLOR,
)
from skugga.terrain.meshes.generators.shapes import cuboid, loft, tube, wall

HALF_EAST_M, HALF_NORTH_M, ROOM_HEIGHT_M = 4.0, 3.0, 3.0
WALL_THICKNESS_M = 0.25
LATTICE_NORTH_EDGE_M = 1.5
"""North of this line the ceiling is solid."""

WINDOW_OPENING_M, DOOR_OPENING_M = (1.7, 0.8, 4.1, 2.4), (1.0, 0.0, 1.9, 2.15)
"""Start, sill, end and head, metres. The window counts from the south end of the west wall, the door from the west end of the
north wall."""

BEAM_EAST_POSITIONS_M = (-1.9, 0.2, 2.3)
TABLE_POSITION_M = (0.2, -0.75)

PLASTER_COLOR, RUG_COLOR = (0.88, 0.85, 0.79), (0.60, 0.38, 0.32)


def room() -> list[Body]:
    """Return walls, lattice and furniture: some 19,000 triangles."""
    return [*_walls(), *_ceiling(), *_window(), *_curtains(), *_furniture()]


def _walls() -> list[Body]:
    """Return the walls: west with a window, north with a door, east closed, south open between slender posts."""
    e, n, t = HALF_EAST_M, HALF_NORTH_M, WALL_THICKNESS_M
    overlap = t + 0.02  # the side walls overlap the north wall and end a little beyond it
    west = _wall_with_opening(2 * n + overlap, WINDOW_OPENING_M)
    north = _wall_with_opening(2 * e + 0.2, DOOR_OPENING_M)
    posts = [cuboid((x - 0.06, -n + 0.02, 0.0), (x + 0.06, -n + 0.14, 2.75), OAK_COLOR) for x in (-1.35, 1.35)]
    return [
        wall(west, (-e, -n), (-e, n + overlap), t, PLASTER_COLOR),
        wall(north, (-e - 0.1, n), (e + 0.1, n), t, PLASTER_COLOR),
        cuboid((e, -n, 0.0), (e + t, n + overlap, ROOM_HEIGHT_M), PLASTER_COLOR),
        *posts,
    ]


def _wall_with_opening(length_m: float, opening: tuple[float, float, float, float]) -> shapely.Polygon:
    """Return a wall's elevation with a rectangular opening (start, sill, end, head)."""
    return shapely.difference(shapely.box(0.0, 0.0, length_m, ROOM_HEIGHT_M), shapely.box(*opening))


def _ceiling() -> list[Body]:
    """Return a slab in the north, and beams, crossing slats and crossing laths in the south."""
    e, n, edge = HALF_EAST_M, HALF_NORTH_M, LATTICE_NORTH_EDGE_M
    slab = cuboid((-e - 0.35, edge, ROOM_HEIGHT_M - 0.02), (e + 0.35, n + 0.4, ROOM_HEIGHT_M + 0.2), PLASTER_COLOR)
    front = cuboid((-e - 0.1, -n, ROOM_HEIGHT_M - 0.3), (e + 0.1, -n + 0.16, ROOM_HEIGHT_M - 0.08), OAK_COLOR)
    beams = [
        cuboid((x - 0.05, -n - 0.4, ROOM_HEIGHT_M - 0.12), (x + 0.05, edge + 0.1, ROOM_HEIGHT_M + 0.06), OAK_COLOR)
        for x in BEAM_EAST_POSITIONS_M
    ]
    slats = [
        cuboid((-e - 0.3, y, ROOM_HEIGHT_M + 0.04), (e + 0.3, y + 0.05, ROOM_HEIGHT_M + 0.16), OAK_COLOR)
        for y in np.arange(-n - 0.3, edge, 0.25)
    ]
    laths = [
        cuboid((x, -n - 0.35, ROOM_HEIGHT_M + 0.14), (x + 0.035, edge + 0.02, ROOM_HEIGHT_M + 0.18), OAK_COLOR)
        for x in np.arange(-e, e, 0.25)
    ]
    return [slab, front, *beams, *slats, *laths]


def _window() -> list[Body]:
    """Return frame, glazing bars and sill of the west window."""
    first, low, last, high = WINDOW_OPENING_M
    south, north, east = first - HALF_NORTH_M, last - HALF_NORTH_M, -HALF_EAST_M - 0.1
    bars = [
        cuboid((east - 0.06, y - 0.03, low), (east, y + 0.03, high), PAINT_COLOR)
        for y in (south + 0.02, (south + north) / 2, north - 0.02)
    ]
    thin = [
        cuboid((east - 0.045, y - 0.012, low), (east - 0.015, y + 0.012, high), PAINT_COLOR) for y in (south + 0.6, north - 0.6)
    ]
    rails = [cuboid((east - 0.06, south, up - 0.03), (east, north, up + 0.03), PAINT_COLOR) for up in (low + 0.02, high - 0.02)]
    cross = [
        cuboid((east - 0.045, south, up - 0.012), (east - 0.015, north, up + 0.012), PAINT_COLOR) for up in (low + 0.55, low + 1.07)
    ]
    sill = cuboid((east - 0.02, south - 0.05, low - 0.03), (-HALF_EAST_M + 0.08, north + 0.05, low + 0.01), OAK_COLOR)
    return [*bars, *thin, *rails, *cross, sill]


def _curtains() -> list[Body]:
    """Return a folded curtain on either side of the window, and its rod."""
    y = np.linspace(0.0, 0.55, 36)
    fold = 0.04 * np.sin(y * 2 * np.pi / 0.11)
    section = [(-0.006, 0.06), (-0.006, 2.62), (0.006, 2.62), (0.006, 0.06)]
    curtain = loft(
        np.stack([np.column_stack([fold + offset, y, np.full(len(y), up)]) for offset, up in section], axis=1), LINEN_COLOR
    )
    first, _, last, _ = WINDOW_OPENING_M
    ends = (first - HALF_NORTH_M - 0.5, last - HALF_NORTH_M - 0.05)
    curtains = [transformed(curtain, (-HALF_EAST_M + 0.1, y, 0.0)) for y in ends]
    return [
        *curtains,
        tube([(-HALF_EAST_M + 0.1, ends[0] - 0.1, 2.62), (-HALF_EAST_M + 0.1, ends[1] + 0.65, 2.62)], 0.018, 10, BRASS_COLOR),
    ]


def _furniture() -> list[Body]:
    """Return the dining table on its rug, the sofa, the shelf, a bench with vases, pictures and plants."""
    x, y = TABLE_POSITION_M
    pile = 0.012
    chairs = [(-0.5, 0.62, 4), (0.52, 0.66, -7), (-0.48, -0.64, 176), (0.5, -0.72, 190), (1.32, 0.02, -92), (-1.36, -0.04, 81)]
    groups = [
        _moved_bodies(furniture_pieces.dining_table(), x, y, pile),
        _moved_bodies(furniture_pieces.fruit_bowl(), x - 0.3, y + 0.1, pile + TABLE_HEIGHT_M),
        _moved_bodies([furniture_pieces.vase(0.34, CLAY_COLOR)], x + 0.55, y - 0.12, pile + TABLE_HEIGHT_M),
        _moved_bodies(furniture_pieces.pendant(ROOM_HEIGHT_M - 1.72), x, y, 1.65),
        *(_moved_bodies(furniture_pieces.chair(), x + east, y + north, pile, yaw_deg) for east, north, yaw_deg in chairs),
        _moved_bodies(furniture_pieces.bookshelf(), 1.7, HALF_NORTH_M - 0.32),
        _moved_bodies(furniture_pieces.sofa(), HALF_EAST_M - 0.5, -0.5, yaw_deg=-90.0),
        _moved_bodies(furniture_pieces.potted_plant(26, 1.5, 3), 3.4, 1.5),
        _moved_bodies(furniture_pieces.potted_plant(20, 1.15, 4), -3.45, -2.3),
        _moved_bodies([furniture_pieces.vase(0.5, GLAZE_COLOR)], -3.78, -0.5, 0.5),
        _moved_bodies([furniture_pieces.vase(0.36, PAINT_COLOR)], -3.8, 0.1, 0.5),
        _moved_bodies([furniture_pieces.vase(0.62, CLAY_COLOR)], -3.76, 0.65, 0.5),
    ]
    rug = cuboid((x - 1.75, y - 1.25, 0.0), (x + 1.75, y + 1.25, pile), RUG_COLOR)
    bench = [cuboid((-3.98, -1.0, 0.44), (-3.58, 1.0, 0.5), OAK_COLOR)]
    bench += [cuboid((-3.96, north - 0.03, 0.0), (-3.6, north + 0.03, 0.45), OAK_COLOR) for north in (-0.85, 0.85)]
    pictures = []
    for east, low, wide, tall, color in (
        (-1.75, 1.25, 0.7, 0.9, GLAZE_COLOR),
        (-0.85, 1.4, 0.5, 0.65, CLAY_COLOR),
        (-0.2, 1.3, 0.45, 0.8, LINEN_COLOR),
    ):
        pictures.append(cuboid((east, 2.965, low), (east + wide, 3.01, low + tall), WALNUT_COLOR))
        pictures.append(cuboid((east + 0.04, 2.955, low + 0.04), (east + wide - 0.04, 2.97, low + tall - 0.04), color))
    return [rug, *bench, *pictures, *(body for group in groups for body in group)]


def _moved_bodies(bodies: list[Body], east_m: float, north_m: float, up_m: float = 0.0, yaw_deg: float = 0.0) -> list[Body]:
    """Return the bodies, turned by ``yaw_deg`` counter-clockwise about the up axis, and then moved."""
    return [transformed(body, (east_m, north_m, up_m), yaw_deg) for body in bodies]
