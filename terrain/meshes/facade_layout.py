"""Layouts of façades: storeys, bays, windows and doors of walls, chosen by a building's size, its roof and its hash.

A wall has a whole number of storeys and of bays, with a window in the middle of each. Coordinates on a wall are metres along it
from its first corner, and metres above the ground floor.

- Houses (sloped roofs) have casement windows, some of them shutters, and a fascia below the eaves.
- Flat-roofed buildings have wide windows; large ones are offices with ribbons or grids of windows, or halls with a band of glass
  below the roof.
- Towers have few and narrow windows. Sheds and garages have a door alone.
- A building has one door, on one of its longest walls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

LENGTH, TOP, BAY_COUNT, BAY_PITCH, STOREY_COUNT, STOREY_PITCH, FIRST_STOREY = range(7)
HALF_WIDTH, SILL, HEAD, FRAME, MULLION, SHUTTER, SILL_DEPTH = range(7, 14)
DOOR_CENTRE, DOOR_HALF_WIDTH, DOOR_BASE, DOOR_TOP, PLINTH, FASCIA, GABLE_HALF_WIDTH, GABLE_SILL, GABLE_HEAD = range(14, 23)
FRAME_COLOR, SHUTTER_COLOR, DOOR_COLOR, LAYOUT_SIZE = range(23, 27)
"""Columns of a layout, metres but for counts and indices of colours.

- The wall's length and its height to the eaves; number and pitch of bays and of storeys; the first storey with windows.
- Half the width of a window, its sill and head above the storey's floor; the widths of its frame, of the mullion, of a shutter and
  of the sill (0: none).
- Centre, half width, base and top of the door (half width 0: none); top of the plinth; depth of the fascia; half width, sill and
  head of the window in the gable (half width 0: none).
- Indices in ``FRAME_COLORS``, ``SHUTTER_COLORS`` and ``DOOR_COLORS``.
"""

FRAME_COLORS = ((0.90, 0.89, 0.86), (0.90, 0.89, 0.86), (0.42, 0.29, 0.20), (0.36, 0.38, 0.40))
SHUTTER_COLORS = ((0.25, 0.36, 0.28), (0.36, 0.42, 0.50), (0.40, 0.21, 0.18), (0.36, 0.27, 0.20), (0.52, 0.52, 0.48))
DOOR_COLORS = ((0.36, 0.24, 0.16), (0.24, 0.33, 0.28), (0.45, 0.20, 0.17), (0.32, 0.35, 0.40), (0.72, 0.71, 0.68))
"""sRGB colours of frames (white, brown, anthracite), shutters and doors."""

MIN_WINDOW_HEIGHT_M, MIN_WALL_LENGTH_M, MIN_STOREY_M = 0.45, 1.8, 2.2
"""Minimum height of a window, length of a wall with windows and height of a storey."""

WINDOW_MARGIN_M = 0.25
"""Minimum width of wall above a window, and between windows."""

SHED_AREA_M2, SHED_EAVES_M = 42.0, 2.2
"""Maximum area of a shed or garage, and maximum height of its eaves."""

TOWER_HEIGHT_M, TOWER_SLENDERNESS = 11.0, 2.0
"""Minimum height of a tower, and minimum ratio of its height and the side of a square of its area."""

OFFICE_AREA_M2, OFFICE_HEIGHT_M, HALL_AREA_M2 = 380.0, 9.0, 600.0
"""Minimum area and height of a flat-roofed office, and minimum area of a hall, which is lower."""

HOUSE, FLATS, OFFICE_GRID, OFFICE_RIBBON, HALL, TOWER, SHED = range(7)
"""Kinds of buildings."""

_KIND_VALUES = np.array([
    # storey, bay, width, height, sill, frame, mullion, sill depth, plinth, fascia, door width, door height
    [2.9, 3.0, 1.05, 1.35, 0.90, 0.075, 0.07, 0.08, 0.40, 0.14, 1.05, 2.15],
    [2.9, 3.2, 1.70, 1.45, 0.90, 0.070, 0.07, 0.06, 0.30, 0.22, 1.50, 2.25],
    [3.4, 2.7, 1.75, 1.90, 0.80, 0.080, 0.06, 0.00, 0.45, 0.35, 2.40, 2.50],
    [3.4, 1.5, 1.42, 1.75, 0.90, 0.060, 0.00, 0.00, 0.45, 0.35, 2.40, 2.50],
    [99.0, 4.8, 3.60, 0.95, 0.00, 0.070, 0.08, 0.00, 0.35, 0.30, 3.60, 3.80],
    [5.5, 4.5, 0.60, 1.80, 2.60, 0.110, 0.00, 0.12, 0.60, 0.30, 1.40, 2.60],
    [99.0, 4.0, 0.90, 0.70, 1.20, 0.070, 0.00, 0.05, 0.15, 0.12, 2.40, 2.05],
])  # fmt: skip
"""Usual sizes of the kinds of buildings, metres."""


class WallPlaces(NamedTuple):
    """Walls (n,) and the buildings that they belong to.

    Attributes
    ----------
    length_m
        Lengths.
    gable_m
        Heights of the gables above the eaves; 0 without one.
    first_ground_m, last_ground_m
        Ground at the walls' first and last corner above the ground floor, metres.
    building
        Indices of the buildings, ascending.
    """

    length_m: np.ndarray
    gable_m: np.ndarray
    first_ground_m: np.ndarray
    last_ground_m: np.ndarray
    building: np.ndarray


class BuildingSizes(NamedTuple):
    """Buildings (n,).

    Attributes
    ----------
    hash_bits
        uint64 hashes below 2 ** 32.
    area_m2, eaves_m, height_m
        Area, and the heights of eaves and ridge above the ground floor.
    has_sloped_roof, is_on_ground
        Whether the roof is sloped, and whether the building begins at the ground.
    """

    hash_bits: np.ndarray
    area_m2: np.ndarray
    eaves_m: np.ndarray
    height_m: np.ndarray
    has_sloped_roof: np.ndarray
    is_on_ground: np.ndarray


def uniform(hash_bits: np.ndarray, stream: int) -> np.ndarray:
    """Return uniform numbers (n,) in [0, 1) for hashes (n,) uint64 below 2 ** 32, independent for each ``stream``."""
    low = np.uint64(0xFFFFFFFF)
    h = hash_bits ^ np.uint64((stream + 1) * 0x9E3779B1 & 0xFFFFFFFF)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & low
    return (h ^ (h >> np.uint64(16))) / 2.0**32


def building_kinds(sizes: BuildingSizes) -> np.ndarray:
    """Return the kinds (n,) of buildings."""
    side_m = np.sqrt(np.maximum(sizes.area_m2, 1.0))
    is_flat = ~sizes.has_sloped_roof
    kind = np.where(is_flat, FLATS, HOUSE)
    kind[is_flat & (sizes.area_m2 >= HALL_AREA_M2) & (sizes.height_m < OFFICE_HEIGHT_M)] = HALL
    is_office = is_flat & (sizes.area_m2 >= OFFICE_AREA_M2) & (sizes.height_m >= OFFICE_HEIGHT_M)
    kind[is_office] = np.where(uniform(sizes.hash_bits, 0) < 0.5, OFFICE_GRID, OFFICE_RIBBON)[is_office]
    kind[(sizes.area_m2 <= SHED_AREA_M2) & (sizes.height_m < 2.0 * MIN_STOREY_M) | (sizes.eaves_m < SHED_EAVES_M)] = SHED
    kind[(sizes.height_m >= TOWER_HEIGHT_M) & (sizes.height_m >= TOWER_SLENDERNESS * side_m)] = TOWER
    return kind


def wall_layouts(walls: WallPlaces, sizes: BuildingSizes) -> np.ndarray:
    """Return the layouts (n, LAYOUT_SIZE) float32 of walls."""
    kinds, at = building_kinds(sizes), walls.building
    kind, bits, top = kinds[at], sizes.hash_bits[at], sizes.eaves_m[at]
    storey, bay, width, height, sill, frame, mullion, sill_depth, plinth, fascia, door_width, door_height = _KIND_VALUES[kind].T
    out = np.zeros((len(at), LAYOUT_SIZE), np.float32)
    is_house, is_hall, is_shed, is_tower = (kind == value for value in (HOUSE, HALL, SHED, TOWER))
    varies = np.where(is_house | (kind == FLATS), 1.0, 0.0)
    width = width * (1.0 + 0.22 * varies * (uniform(bits, 1) - 0.5))
    height = height * (1.0 + 0.20 * varies * (uniform(bits, 2) - 0.5))
    storeys = np.maximum(np.rint(top / storey), 1.0)
    storey_pitch = top / storeys
    sill = np.where(is_hall, top - fascia - 0.35 - height, sill)
    height = np.minimum(height, storey_pitch - fascia - WINDOW_MARGIN_M - sill)
    bays = np.maximum(np.rint(walls.length_m / bay), 1.0)
    has_shed_window = is_shed & (uniform(bits, 3) < 0.5) & (walls.length_m >= 3.0) & ~_is_door_wall(walls, sizes)
    bays = np.where(is_shed, 1.0, np.where(is_tower, np.maximum(np.floor(walls.length_m / bay), 1.0), bays))
    bay_pitch = walls.length_m / bays
    width = np.minimum(width, bay_pitch - np.where(kind == OFFICE_RIBBON, 0.08, 2.0 * WINDOW_MARGIN_M))
    has_windows = (height >= MIN_WINDOW_HEIGHT_M) & (walls.length_m >= MIN_WALL_LENGTH_M) & (storey_pitch >= MIN_STOREY_M - 0.4)
    has_windows &= (width >= 0.3) & (sill >= 0.0) & (~is_shed | has_shed_window)
    highest_ground = np.fmax(walls.first_ground_m, walls.last_ground_m)
    first = np.ceil((np.nan_to_num(highest_ground) - 0.15 - sill) / storey_pitch)
    first = np.maximum(first, np.where(is_tower & (storeys > 1.0), 1.0, 0.0))
    shutter = np.where(is_house & (uniform(bits, 4) < 0.45), 0.5 * width, 0.0)
    shutter[bay_pitch < width + 2.0 * shutter + WINDOW_MARGIN_M] = 0.0
    out[:, LENGTH], out[:, TOP] = walls.length_m, top
    out[:, BAY_COUNT], out[:, BAY_PITCH] = np.where(has_windows, bays, 0.0), bay_pitch
    out[:, STOREY_COUNT], out[:, STOREY_PITCH], out[:, FIRST_STOREY] = storeys, storey_pitch, np.minimum(first, storeys)
    out[:, HALF_WIDTH], out[:, SILL], out[:, HEAD] = 0.5 * width, sill, sill + height
    out[:, FRAME], out[:, MULLION], out[:, SHUTTER] = frame, mullion, shutter
    out[:, SILL_DEPTH], out[:, FASCIA] = sill_depth, np.where(walls.gable_m > 0.0, 0.0, fascia)
    out[:, PLINTH] = np.where(sizes.is_on_ground[at], plinth * (0.8 + 0.4 * uniform(bits, 5)), -1e3)
    out[:, FRAME_COLOR] = np.where(kind >= OFFICE_GRID, 3, np.floor(3.0 * uniform(bits, 6)))
    out[is_tower | is_shed, FRAME_COLOR] = 2
    out[:, SHUTTER_COLOR] = np.floor(len(SHUTTER_COLORS) * uniform(bits, 7))
    out[:, DOOR_COLOR] = np.floor(len(DOOR_COLORS) * uniform(bits, 8))
    _add_gable_windows(out, walls, is_house & has_windows)
    _add_doors(out, walls, sizes, door_width, door_height)
    return out


def _add_gable_windows(out: np.ndarray, walls: WallPlaces, has_windows: np.ndarray) -> None:
    """Write the windows in gables that are high and wide enough to ``out``."""
    has_window = has_windows & (walls.gable_m >= 2.0) & (walls.length_m >= 4.5)
    out[has_window, GABLE_HALF_WIDTH] = 0.4
    out[:, GABLE_SILL] = out[:, TOP] + 0.30
    out[:, GABLE_HEAD] = out[:, TOP] + np.where(walls.gable_m >= 2.6, 1.25, 1.05)


def _add_doors(out: np.ndarray, walls: WallPlaces, sizes: BuildingSizes, door_width: np.ndarray, door_height: np.ndarray) -> None:
    """Write the doors to ``out``. A door takes the place of the windows of one bay of the ground floor."""
    door = np.flatnonzero(_is_door_wall(walls, sizes))
    bays = np.maximum(out[door, BAY_COUNT], 1.0)
    pitch = out[door, LENGTH] / bays
    bay = np.minimum(np.floor(bays * uniform(sizes.hash_bits[walls.building[door]], 9)), bays - 1.0)
    width = np.minimum(door_width[door], out[door, LENGTH] - 2.0 * WINDOW_MARGIN_M)
    reach = np.minimum(0.5 * width + WINDOW_MARGIN_M, 0.5 * out[door, LENGTH])
    centre = np.clip((bay + 0.5) * pitch, reach, out[door, LENGTH] - reach)
    first, last = (np.nan_to_num(ground[door]) for ground in (walls.first_ground_m, walls.last_ground_m))
    base = np.clip(first + (last - first) * centre / np.maximum(out[door, LENGTH], 1e-6), -1.2, 0.6)
    height = np.minimum(door_height[door], out[door, TOP] - 0.15 - base)
    has_door = (width >= 0.7) & (height >= 1.6)
    out[door, DOOR_CENTRE], out[door, DOOR_HALF_WIDTH] = centre, np.where(has_door, 0.5 * width, 0.0)
    out[door, DOOR_BASE], out[door, DOOR_TOP] = base, base + height


def _is_door_wall(walls: WallPlaces, sizes: BuildingSizes) -> np.ndarray:
    """Return the mask (n,) of walls with a door: of each building on the ground one of those nearly as long as its longest.

    Walls whose ground is level with the ground floor come first.
    """
    at, length = walls.building, walls.length_m
    longest = np.zeros(len(sizes.hash_bits))
    np.maximum.at(longest, at, length)
    wall_number = np.arange(len(at)) - np.searchsorted(at, at)
    ground_m = np.abs(np.nan_to_num(0.5 * (walls.first_ground_m + walls.last_ground_m)))
    score = uniform(sizes.hash_bits[at] ^ wall_number.astype(np.uint64), 10) - ground_m
    score[length < 0.9 * longest[at]] = -np.inf
    order = np.lexsort((score, at))
    is_last = np.append(at[order][1:] != at[order][:-1], True) if len(at) else np.zeros(0, np.bool_)
    out = np.zeros(len(at), np.bool_)
    out[order[is_last]] = True
    return out & sizes.is_on_ground[at]
