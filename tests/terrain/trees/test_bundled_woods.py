"""Woods of the bundled level: adjacent stands of different density have natural borders, without straight edges or gaps."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import shape

STANDS = "woods", "pines", "between", "hills"
METRES_PER_DEGREE = np.array([89_500.0, 111_000.0])
"""Metres of a degree east and north in this level."""


def stand_outline(name: str) -> shapely.Geometry:
    """Return the outline of a stand in metres."""
    features = json.loads((Path("configs") / f"jacksboro_{name}.geojson").read_text())["features"]
    outlines = [shapely.transform(shape(feature["geometry"]), lambda places: places * METRES_PER_DEGREE) for feature in features]
    assert all(shapely.is_valid(outlines))
    return shapely.union_all(outlines)


def longest_along_an_axis(outline: shapely.Geometry) -> float:
    """Return the length in metres of the longest run of an outline within 3 degrees of north or east; collinear pieces count as
    one.
    """
    longest = 0.0
    for ring in shapely.get_rings(shapely.get_parts(outline)):
        steps = np.diff(shapely.get_coordinates(ring), axis=0)
        length = np.hypot(*steps.T)
        for axis in (0, 1):
            is_axis_aligned = np.abs(steps[:, 1 - axis]) < np.sin(np.radians(3.0)) * length
            for is_straight, run in itertools.groupby(range(len(steps)), is_axis_aligned.__getitem__):
                longest = max(longest, float(length[list(run)].sum()) if is_straight else 0.0)
    return longest


@pytest.mark.parametrize("name", ["woods", "between", "hills"])
def test_wood_has_no_straight_border_along_a_map_axis(name):
    assert longest_along_an_axis(stand_outline(name)) < 400.0


def test_adjacent_woods_have_no_gaps_or_overlaps():
    woods = {name: stand_outline(name) for name in STANDS}
    for first_name, second_name in itertools.combinations(STANDS, 2):
        assert woods[first_name].intersection(woods[second_name]).area < 3e-3 * min(woods[first_name].area, woods[second_name].area)
    union = shapely.union_all(list(woods.values()))
    slivers = union.buffer(8.0).buffer(-8.0).difference(union)
    assert slivers.area < 0.004 * union.area


def test_longest_along_an_axis_measures_straight_runs():
    assert longest_along_an_axis(shapely.box(0.0, 0.0, 300.0, 100.0)) == pytest.approx(300.0)
    assert longest_along_an_axis(shapely.Point(0.0, 0.0).buffer(100.0)) < 30.0
