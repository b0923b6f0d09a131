"""The woods of the bundled level: stands of other densities meet along borders that no visitor takes for a tile's."""

from __future__ import annotations

import itertools
import json
from pathlib import Path

import numpy as np
import pytest
import shapely
from shapely.geometry import shape

STANDS = "woods", "pines", "between", "hills"
METRES = np.array([89_500.0, 111_000.0])
"""Of a degree east and north, there."""


def stand(name: str) -> shapely.Geometry:
    """A stand's outline in metres."""
    features = json.loads((Path("configs") / f"jacksboro_{name}.geojson").read_text())["features"]
    outlines = [shapely.transform(shape(feature["geometry"]), lambda places: places * METRES) for feature in features]
    assert all(shapely.is_valid(outlines))
    return shapely.union_all(outlines)


def longest_along_an_axis(outline: shapely.Geometry) -> float:
    """The longest piece of an outline, metres, that runs within 3 degrees of north or east; pieces that go on are one."""
    longest = 0.0
    for ring in shapely.get_rings(shapely.get_parts(outline)):
        steps = np.diff(shapely.get_coordinates(ring), axis=0)
        length = np.hypot(*steps.T)
        for axis in (0, 1):
            straight = np.abs(steps[:, 1 - axis]) < np.sin(np.radians(3.0)) * length
            for is_straight, run in itertools.groupby(range(len(steps)), straight.__getitem__):
                longest = max(longest, float(length[list(run)].sum()) if is_straight else 0.0)
    return longest


@pytest.mark.parametrize("name", ["woods", "between", "hills"])
def test_no_border_of_a_wood_is_a_straight_line_of_the_map(name):
    assert longest_along_an_axis(stand(name)) < 400.0


def test_woods_of_two_densities_meet_without_a_gap_or_an_overlap():
    woods = {name: stand(name) for name in STANDS}
    for one, other in itertools.combinations(STANDS, 2):
        assert woods[one].intersection(woods[other]).area < 3e-3 * min(woods[one].area, woods[other].area)
    whole = shapely.union_all(list(woods.values()))
    slivers = whole.buffer(8.0).buffer(-8.0).difference(whole)
    assert slivers.area < 0.004 * whole.area


def test_a_border_of_which_a_part_is_straight_is_told():
    assert longest_along_an_axis(shapely.box(0.0, 0.0, 300.0, 100.0)) == pytest.approx(300.0)
    assert longest_along_an_axis(shapely.Point(0.0, 0.0).buffer(100.0)) < 30.0
