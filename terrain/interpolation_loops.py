"""Interpolation inside of compiled loops: smoothstep, and the parts of bilinear look-ups."""

from __future__ import annotations

from skugga.terrain.compiled import internal


@internal
def smoothstep_of(share):
    """Return 3 t^2 - 2 t^3 of a share, which is clamped to [0, 1] first."""
    share = min(max(share, 0.0), 1.0)
    return share * share * (3.0 - 2.0 * share)


@internal
def cell_before(place, count):
    """Return the cell before a place from 0 to ``count`` - 1, the one after it, and the share of the way to that one."""
    before = min(int(place), max(count - 2, 0))
    return before, min(before + 1, count - 1), place - before


@internal
def blend_corners(north_west, north_east, south_west, south_east, down, across):
    """Return the mean of four corners, weighted by the shares of the way down and across: exact at every corner."""
    north = north_west * (1.0 - across) + north_east * across
    south = south_west * (1.0 - across) + south_east * across
    return north * (1.0 - down) + south * down


@internal
def lerp_corners(north_west, north_east, south_west, south_east, down, across):
    """Return the same mean, by differences: cheaper, and exact at the north-western corner alone."""
    north = north_west + across * (north_east - north_west)
    south = south_west + across * (south_east - south_west)
    return north + down * (south - north)
