"""Five stone circles: rough uprights under lintels. Each stone is a rounded block, displaced by noise."""

from __future__ import annotations

import numpy as np

from skugga.terrain.meshes.body import Body, transformed
from skugga.terrain.meshes.generators.shapes import Vector, cell_box, solid, superellipsoid

RING_POSES = ((0.0, 0.0, 0.0), (34.0, 15.0, 77.0), (-8.0, 40.0, 140.0), (-37.0, -9.0, 201.0), (10.0, -41.0, 293.0))
"""East and north in metres, and rotation in degrees, of each ring."""

RING_SLOT_COUNT, RING_RADIUS_M = 14, 9.0
FALLEN_UPRIGHT_SLOTS, FALLEN_LINTEL_SLOT = (4, 10), 7
"""Numbers of the places in a ring: those with fallen uprights, outside the circle, and one whose lintel lies inside."""

TRILITHON_AZIMUTHS_DEG, TRILITHON_RADIUS_M, TRILITHON_HALF_SPAN_DEG = (45.0, 135.0, 225.0), 4.6, 18.5

UPRIGHT_SIZE_M, TRILITHON_UPRIGHT_SIZE_M, LINTEL_SIZE_M, FALLEN_STONE_SIZE_M = (
    (1.15, 2.0, 4.2),
    (1.2, 1.9, 5.6),
    (1.1, 4.5, 0.95),
    (1.7, 4.3, 1.1),
)
"""Sizes of ring uprights, trilithon uprights, lintels and fallen stones, metres: radial, tangential, vertical."""

UPRIGHT_CELLS, LINTEL_CELLS = (4, 5, 10), (4, 8, 4)

LINTEL_OVERLAP_M = 0.3
"""Overlap of a lintel with its uprights."""

SUPERELLIPSOID_EXPONENT = 5.0
TAPER_SHARE = 0.18
WEATHERING_DEPTH_M = 0.13
WEATHERING_WAVE_COUNT = 24
STONE_COLOR, MOSS_COLOR = np.array((0.60, 0.58, 0.55)), np.array((0.48, 0.49, 0.41))


def rocks() -> list[Body]:
    """Return five rotated copies of one ring of 33 stones: 63,600 triangles."""
    ring = _ring()
    return [transformed(stone, (east, north, 0.0), yaw_deg) for east, north, yaw_deg in RING_POSES for stone in ring]


def _ring() -> list[Body]:
    """Return the stones of one ring, placed round the origin."""
    slot = 360.0 / RING_SLOT_COUNT
    chord = RING_RADIUS_M * np.cos(np.pi / RING_SLOT_COUNT)
    stones = []
    for i in range(RING_SLOT_COUNT):
        if i in FALLEN_UPRIGHT_SLOTS:
            stones.append(
                _on_circle(
                    transformed(_upright_stone(FALLEN_STONE_SIZE_M, LINTEL_CELLS, i), yaw_deg=35.0),
                    RING_RADIUS_M + 3.6,
                    i * slot + 11.0,
                )
            )
        else:
            stones.append(_on_circle(_upright_stone(UPRIGHT_SIZE_M, UPRIGHT_CELLS, i), RING_RADIUS_M, i * slot))
        if not {i, (i + 1) % RING_SLOT_COUNT} & set(FALLEN_UPRIGHT_SLOTS) and i != FALLEN_LINTEL_SLOT:
            stones.append(_on_circle(_lintel(UPRIGHT_SIZE_M[2], RING_SLOT_COUNT + i), chord, (i + 0.5) * slot))
    fallen_lintel = transformed(
        _upright_stone(FALLEN_STONE_SIZE_M, LINTEL_CELLS, FALLEN_LINTEL_SLOT + RING_SLOT_COUNT), yaw_deg=-50.0
    )
    stones.append(_on_circle(fallen_lintel, RING_RADIUS_M - 3.0, (FALLEN_LINTEL_SLOT + 2.5) * slot))
    for seed, middle in enumerate(TRILITHON_AZIMUTHS_DEG, start=100):
        for side in (-1, 1):
            upright = _upright_stone(TRILITHON_UPRIGHT_SIZE_M, UPRIGHT_CELLS, seed + 10 * side)
            stones.append(_on_circle(upright, TRILITHON_RADIUS_M, middle + side * TRILITHON_HALF_SPAN_DEG))
        distance = TRILITHON_RADIUS_M * np.cos(np.radians(TRILITHON_HALF_SPAN_DEG))
        stones.append(_on_circle(_lintel(TRILITHON_UPRIGHT_SIZE_M[2], seed), distance, middle))
    return stones


def _on_circle(stone: Body, radius_m: float, azimuth_deg: float) -> Body:
    """Place a stone on a circle with its first axis outwards. The angle is counter-clockwise from east."""
    return transformed(transformed(stone, (radius_m, 0.0, 0.0)), yaw_deg=azimuth_deg)


def _upright_stone(size_m: Vector, cells: tuple[int, int, int], seed: int) -> Body:
    """Return an upright stone on the ground, with a flat foot, tapering sides and a round head.

    ``size_m`` is its size and ``cells`` the number of cells along each side (radial, tangential, vertical).
    """
    cube, triangles = cell_box(cells)
    high = (cube[:, 2:] + 1) / 2
    worn = superellipsoid(np.column_stack([cube[:, :2], np.maximum(cube[:, 2], 0)]), SUPERELLIPSOID_EXPONENT)
    shape = np.column_stack([worn[:, :2] * (1 - TAPER_SHARE * high), np.where(cube[:, 2] > 0, worn[:, 2], cube[:, 2])])
    points = shape * np.asarray(size_m) / 2 + [0, 0, size_m[2] / 2]
    wear = _weathering(points, worn, seed)
    wear[:, 2] *= 0.4 * high[:, 0]  # heads stay nearly level, so that a lintel fits
    return solid(points + wear, triangles, _stone_color(seed))


def _lintel(upright_m: float, seed: int) -> Body:
    """Return a stone that lies across two uprights of height ``upright_m``."""
    cube, triangles = cell_box(LINTEL_CELLS)
    shape = superellipsoid(cube, SUPERELLIPSOID_EXPONENT)
    points = shape * np.asarray(LINTEL_SIZE_M) / 2 + [0, 0, upright_m + LINTEL_SIZE_M[2] / 2 - LINTEL_OVERLAP_M]
    return solid(points + _weathering(points, shape, seed), triangles, _stone_color(seed))


def _weathering(points_m: np.ndarray, outward: np.ndarray, seed: int) -> np.ndarray:
    """Return displacements (n, 3) along ``outward``: a sum of plane waves of 0.9 to 5 m, longer ones with larger amplitudes."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(WEATHERING_WAVE_COUNT, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length_m = np.geomspace(0.9, 5.0, WEATHERING_WAVE_COUNT)
    wave = np.sin(2 * np.pi * (points_m @ direction.T / length_m + rng.uniform(size=WEATHERING_WAVE_COUNT))) * length_m**0.9
    return WEATHERING_DEPTH_M * wave.sum(axis=1, keepdims=True) / np.sqrt((length_m**1.8).sum() / 2) * outward


def _stone_color(seed: int) -> Vector:
    """Return a random sRGB colour between ``STONE_COLOR`` and ``MOSS_COLOR``."""
    share = np.random.default_rng(seed).uniform()
    return tuple(STONE_COLOR + (MOSS_COLOR - STONE_COLOR) * share)
