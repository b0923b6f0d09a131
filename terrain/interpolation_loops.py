"""Interpolation inside compiled loops: smoothstep and the parts of bilinear look-ups."""

from __future__ import annotations

from skugga.terrain.compiled import internal


@internal
def smoothstep_value(share):
    """Return the smoothstep 3 s^2 - 2 s^3 of the number s = ``share``, which is clamped to [0, 1] first."""
    share = min(max(share, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@internal
def cell_interval(position, count):
    """Return the cell at or before a fractional index, the next cell, and the fraction of the way between them.

    The index runs from 0 to ``count`` - 1.
    """
    before = min(int(position), max(count - 2, 0))
    return before, min(before + 1, count - 1), position - before


@internal
def blend_corners(north_west, north_east, south_west, south_east, row_fraction, col_fraction):
    """Return the bilinear mean of four corners. Exact at every corner.

    ``row_fraction`` and ``col_fraction`` run from 0 to 1 southwards and eastwards.
    """
    north = north_west * (1.0 - col_fraction) + north_east * col_fraction
    south = south_west * (1.0 - col_fraction) + south_east * col_fraction
    return north * (1.0 - row_fraction) + south * row_fraction


@internal
def lerp_corners(north_west, north_east, south_west, south_east, row_fraction, col_fraction):
    """Return the bilinear mean of four corners, as ``blend_corners``, by differences.

    It is cheaper, but exact at the north-western corner only.
    """
    north = north_west + col_fraction * (north_east - north_west)
    south = south_west + col_fraction * (south_east - south_west)
    return north + row_fraction * (south - north)
