"""Land cover: exact polygons, borders without gaps, and classes in any spelling."""

from __future__ import annotations

import json

import numba
import numpy as np
import pytest
import shapely
from pyogrio import raw

from skugga.terrain.errors import InputError
from skugga.terrain.ground.land_cover import (
    CROP,
    EARTH,
    FIELD_CLASSES,
    FOREST_FLOOR,
    MEADOW,
    ROCK,
    STUBBLE,
    LandCoverIndex,
    covered_share,
    land_cover_index,
)
from skugga.terrain.ground.land_cover_sources import CLASS_WORDS, COVER_BY_WORD, FIELD, class_of_value
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import Scene, build_scene
from tests.rasters import ENGINEERING, write_geotiff


@numba.njit
def _shares_at(x, y, index, across, along, softness):
    """Return the shares (polygons,) of a pixel at a point. Earlier polygons leave what they do not cover to later ones."""
    out = np.zeros(len(index.cover))
    col, row = int(np.floor((x - index.west_m) / index.cell_m)), int(np.floor((y - index.south_m) / index.cell_m))
    if col < 0 or row < 0 or row >= index.cell_counts[0] or col >= index.cell_counts[1]:
        return out
    cell, remaining = row * index.cell_counts[1] + col, 1.0
    for k in range(index.first[cell], index.first[cell + 1]):
        share = covered_share(
            x, y, k, index.west_m + (col + 0.5) * index.cell_m, index.south_m + (row + 0.5) * index.cell_m, index.has_centre,
            index.first_edge, index.edges_m, across, along, 0.0, 1.0, softness,
        )  # fmt: skip
        out[index.polygon[k]] = min(share, remaining)
        remaining -= out[index.polygon[k]]
    return out


def index_of(polygons: list[shapely.Polygon]) -> LandCoverIndex:
    """Return the index of polygons in metres from the anchor."""
    rings, owner = shapely.get_rings(np.array(polygons, object), return_index=True)
    xy, ring = shapely.get_coordinates(rings, return_index=True)
    start = np.flatnonzero(ring[1:] == ring[:-1])
    edges_m = np.concatenate([xy[start], xy[start + 1]], axis=1)
    count = len(polygons)
    return land_cover_index(edges_m, owner[ring[start]], np.full(count, MEADOW), np.tile([1.0, 0.0], (count, 1)))


def make_scene_of_polygons(folder, polygons: list[shapely.Geometry], fields: dict[str, list[object]], **keys: object) -> Scene:
    """Return a scene of a hill of 2 km with a file of land cover, in metres of an engineering CRS."""
    x = np.linspace(-1.0, 1.0, 50)
    heights = 300.0 * np.exp(-4.0 * (x[:, None] ** 2 + x**2)).astype(np.float32)
    write_geotiff(folder / "hill.tif", heights, ENGINEERING, -1000.0, 1000.0, 40.0)
    raw.write(
        folder / "cover.gpkg", shapely.to_wkb(np.array(polygons, object)), [np.array(values) for values in fields.values()],
        list(fields), geometry_type=polygons[0].geom_type, crs=ENGINEERING,
    )  # fmt: skip
    level = {"version": 1, "terrain": {"source": "hill.tif"}, "land_cover": [{"source": "cover.gpkg", **keys}]}
    (folder / "level.yaml").write_text(json.dumps(level))
    return build_scene(load_level(folder / "level.yaml"))


def test_points_lie_in_the_polygons_that_contain_them():
    """A disc with a hole, a star and a triangle narrower than a cell, against shapely, in all cells."""
    angles = np.linspace(0.0, 2.0 * np.pi, 41)[:-1]
    star = shapely.Polygon(np.stack([np.cos(angles), np.sin(angles)], axis=1) * (90.0 + 55.0 * (-1.0) ** np.arange(40))[:, None])
    disc = shapely.Point(260.0, 40.0).buffer(120.0).difference(shapely.Point(240.0, 30.0).buffer(47.0))
    needle = shapely.Polygon([(-300.0, -200.0), (400.0, -196.0), (400.0, -199.0)])
    polygons = [star, disc, needle]
    index = index_of(polygons)
    rng = np.random.default_rng(7)
    points = np.concatenate(
        [rng.uniform(-350, 450, (6000, 2)), np.column_stack([rng.uniform(-300, 400, 800), rng.uniform(-201, -195, 800)])]
    )
    shares = np.array([_shares_at(x, y, index, 1e-6, 1e-6, 1e-6) for x, y in points])
    inside = np.array([shapely.contains_xy(polygon, points) for polygon in polygons]).T
    assert np.array_equal(shares == 1.0, inside) and np.isin(shares, (0.0, 1.0)).all() and inside.sum(axis=0).min() > 100


@pytest.mark.parametrize("width_m", [0.01, 0.7, 6.0, 23.0])
def test_shares_of_neighbours_sum_to_one(width_m):
    """Across a shared edge the shares are a ramp as wide as the pixel, with no gap and no overlap."""
    polygons = [shapely.box(-100.0, -100.0, 3.0, 100.0), shapely.box(3.0, -100.0, 100.0, 100.0)]
    index = index_of(polygons)
    for x in np.linspace(-20.0, 26.0, 93):
        first, second = _shares_at(x, 11.0, index, width_m, 1e-3, 1e-3)
        assert first + second == pytest.approx(1.0)
        expected = 0.5 - (x - 3.0) / width_m
        if abs(x - 3.0) < 12.0:
            assert first == pytest.approx(np.clip(expected, 0.0, 1.0), abs=1e-6)


def test_width_of_borders_depends_on_the_direction_of_view():
    """A pixel is long to the north: it blurs a border that runs east, and not one that runs north."""
    index = index_of([shapely.box(0.0, 0.0, 50.0, 50.0)])
    assert _shares_at(-0.5, 25.0, index, 0.1, 8.0, 0.1)[0] == 0.0
    assert _shares_at(25.0, -0.5, index, 0.1, 8.0, 0.1)[0] == pytest.approx(0.5 - 0.5 / 8.0)


def test_the_first_polygon_of_the_index_covers_the_others():
    index = index_of([shapely.box(10.0, 10.0, 20.0, 20.0), shapely.box(0.0, 0.0, 50.0, 50.0)])
    assert _shares_at(15.0, 15.0, index, 0.1, 0.1, 0.1).tolist() == [1.0, 0.0]
    assert _shares_at(35.0, 15.0, index, 0.1, 0.1, 0.1).tolist() == [0.0, 1.0]


@pytest.mark.parametrize(
    ("value", "cover"),
    [
        ("Bare Rock", ROCK), ("bare_rock", ROCK), ("forest", FOREST_FLOOR), ("WOOD", FOREST_FLOOR), (10, FOREST_FLOOR),
        ("30", MEADOW), (40.0, FIELD), ("Farmland", FIELD), ("meadows", MEADOW), ("stubble", STUBBLE), (60, EARTH),
        ("Bare / sparse vegetation", EARTH), (None, None), (float("nan"), None), (True, None), (11, None), ("", None),
        ("atlantis", None), (30.5, None),
    ],
)  # fmt: skip
def test_classes_are_read_in_any_spelling(value, cover):
    assert class_of_value(value) == cover


def test_every_class_has_words_and_no_word_two_classes():
    assert set(CLASS_WORDS) == {FIELD, *range(17)} and len(COVER_BY_WORD) == sum(len(text.split()) for text in CLASS_WORDS.values())


def test_land_cover_is_read_from_tags_and_codes(tmp_path):
    boxes = [shapely.box(x, -100.0, x + 150.0, 200.0) for x in (-600.0, -400.0, -200.0, 0.0, 200.0)]
    fields = {"landuse": ["meadow", "farmland", None, "atlantis", "crop"], "natural": [None, None, "bare_rock", None, "sand"]}
    cover = make_scene_of_polygons(tmp_path, boxes, fields).objects.land_cover
    assert cover is not None and sorted(cover.index.cover[[0, 1, 3]].tolist()) == sorted([CROP, ROCK, MEADOW])
    assert cover.index.cover[2] in FIELD_CLASSES
    assert cover.warnings == ("cover.gpkg: landuse = atlantis: ignored, no known class of land cover",)
    np.testing.assert_allclose(np.abs(cover.index.row_direction), np.tile([0.0, 1.0], (4, 1)), atol=1e-6)
    low, high = cover.index.edges_m[:, [0, 2]].min(), cover.index.edges_m[:, [0, 2]].max()
    assert (low, high) == pytest.approx((-600.0, 350.0), abs=0.01)


@pytest.mark.parametrize(
    ("polygons", "fields", "message"),
    [
        ([shapely.box(0, 0, 50, 50)], {"colour": ["red"]}, "no attribute that names the class"),
        ([shapely.LineString([(0, 0), (50, 50)])], {"class": ["meadow"]}, "not polygons"),
        ([shapely.box(9000, 0, 9900, 50)], {"class": ["meadow"]}, "lies on the terrain"),
        ([shapely.box(0, 0, 50, 50)], {"class": ["atlantis"]}, "with a known class"),
    ],
)
def test_files_without_land_cover_are_errors(tmp_path, polygons, fields, message):
    with pytest.raises(InputError, match=message):
        make_scene_of_polygons(tmp_path, polygons, fields).objects.land_cover  # noqa: B018
