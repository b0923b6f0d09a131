"""Tree tops in canopy heights: known peaks, windows, units, coarse rasters, and a published inventory."""

from __future__ import annotations

import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from pyproj import CRS
from scipy.spatial import cKDTree

from skugga.terrain.errors import SourceError
from skugga.terrain.trees import canopy as module
from skugga.terrain.trees.canopy import (
    HEXAGONAL_CROWNS_PER_SQUARE,
    MIN_CROWN_CELLS,
    TREETOP_WINDOW_RADIUS_LINES,
    Canopy,
    CellWindow,
    growing_space_m,
)
from skugga.terrain.trees.canopy_sample import MAX_PLAUSIBLE_HEIGHT_M, MIN_TREE_HEIGHT_M
from tests.rasters import ENGINEERING

UTM = CRS.from_epsg(32633)
CELL_M = 0.5


def gaussian_crowns(rows: int, cols: int, tops: np.ndarray, height_m: np.ndarray, width_m: float = 1.2) -> np.ndarray:
    """Return Gaussian crowns at (row, col); each cell has the height of the highest crown."""
    row, col = np.mgrid[0:rows, 0:cols]
    square = ((row[..., None] - tops[:, 0]) ** 2 + (col[..., None] - tops[:, 1]) ** 2) * CELL_M**2
    return (height_m * np.exp(-square / (2 * width_m**2))).max(axis=-1).astype(np.float32)


def trees_of(canopy: Canopy, crs: CRS = UTM, species: str = "conifer"):
    """Return positions x and y and heights in metres of the trees of a canopy raster, each (n,)."""
    window = canopy.window(crs, None)
    pieces = list(canopy.trees(crs, 1.0, window, lambda h: 1.0 + 0.25 * h, TREETOP_WINDOW_RADIUS_LINES[species], 0))
    x, y = (np.concatenate([getattr(p.positions, axis) for p in pieces]) for axis in "xy")
    return x, y, np.concatenate([p.height_m for p in pieces])


@pytest.fixture(scope="module")
def grove():
    """Return tops with a spacing of at least 5 m, their heights, and a raster of unit crowns."""
    rng, tops = np.random.default_rng(3), []
    for place in rng.integers(4, 196, (4000, 2)):
        if all(np.hypot(*(place - other)) * CELL_M >= 5.0 for other in tops):
            tops.append(place)
    tops = np.array(tops)
    return tops, rng.uniform(6.0, 25.0, len(tops)).astype(np.float32), gaussian_crowns(200, 200, tops, np.float32(1.0))


def test_separate_crowns_are_found_one_by_one(write_raster, grove):
    tops, heights, _ = grove
    raster = gaussian_crowns(200, 200, tops, heights)
    x, y, height_m = trees_of(Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000100, CELL_M))))
    order = np.lexsort(tops.T[::-1])
    row, col = (5000100 - y) / CELL_M - 0.5, (x - 500000) / CELL_M - 0.5
    tree_order = np.lexsort((col, row))
    np.testing.assert_allclose(np.column_stack([row, col])[tree_order], tops[order], atol=1e-6)
    np.testing.assert_allclose(height_m[tree_order], heights[order], rtol=1e-6)


def test_blocks_agree_with_the_whole_raster(write_raster, monkeypatch):
    raster = np.random.default_rng(0).integers(0, 12, (120, 150)).astype(np.int16)  # ties everywhere
    canopy = Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000000, CELL_M)))
    all_trees = set(zip(*trees_of(canopy), strict=True))
    monkeypatch.setattr(module, "_BLOCK_CELLS", 17)
    assert set(zip(*trees_of(canopy), strict=True)) == all_trees


def test_tops_are_the_maxima_of_their_windows(write_raster):
    raster = np.random.default_rng(1).gamma(2.0, 5.0, (80, 90)).astype(np.float32)
    canopy = Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000000, CELL_M)))
    ((row, col, height_m),) = canopy.treetops(np.diag([CELL_M, -CELL_M]), CellWindow(0, 0, 80, 90), (0.8, 0.05))
    every_row, every_col = np.mgrid[0:80, 0:90]
    for r, c, h in zip(row, col, height_m, strict=True):
        distance = np.hypot(every_row - r, every_col - c) * CELL_M
        assert raster[distance <= 0.8 + 0.05 * h].max() == np.float32(h)
    expected = {
        (r, c) for r, c in np.ndindex(80, 90)
        if MIN_TREE_HEIGHT_M <= raster[r, c] <= MAX_PLAUSIBLE_HEIGHT_M and raster[r, c] == raster[
            np.maximum(np.hypot(every_row - r, every_col - c) * CELL_M - 0.05 * raster[r, c], 0) <= 0.8].max()
    }  # fmt: skip
    assert set(zip(row.tolist(), col.tolist(), strict=True)) == expected


def test_flat_canopy_has_trees_a_window_apart(write_raster):
    canopy = Canopy(str(write_raster(np.full((100, 100), 20, np.int16), "EPSG:32633", 500000, 5000000, CELL_M)))
    x, y, _ = trees_of(canopy)
    nearest = cKDTree(np.column_stack([x, y])).query(np.column_stack([x, y]), k=2)[0][:, 1]
    assert nearest.min() > 0.8 + 0.05 * 20
    assert len(x) > 2500 / (np.pi * 1.8**2) / 2  # Matérn's second process keeps one tree per window area


def test_invalid_canopy_cells_have_no_trees(write_raster):
    raster = np.zeros((40, 40), np.float32)
    raster[5, 5], raster[5, 20], raster[20, 5], raster[20, 20], raster[30, 30] = np.nan, -9999.0, 1.9, 4000.0, -3.0
    raster[35, 10] = 8.0
    canopy = Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000000, CELL_M, nodata=-9999.0)))
    assert trees_of(canopy)[2].tolist() == [8.0]


def test_canopy_heights_in_feet_are_converted(write_raster):
    raster = np.zeros((20, 20), np.float32)
    raster[10, 10] = 100.0
    path = write_raster(raster, "EPSG:32633", 500000, 5000000, CELL_M)
    with rasterio.open(path, "r+") as dataset:
        dataset.units = ["ft"]
    assert trees_of(Canopy(str(path)))[2] == pytest.approx([30.48])


def test_canopy_in_degrees_has_the_same_trees(write_raster, grove):
    """Windows are circles on the ground: at 60 degrees north, a degree of longitude is half as long as one of latitude."""
    tops, heights, _ = grove
    step = CELL_M / 111_412.0  # half a metre in degrees of latitude at 60 degrees
    raster = gaussian_crowns(200, 200, tops, heights)
    x, y, height_m = trees_of(Canopy(str(write_raster(raster, "EPSG:4326", 15.0, 60.0, (2 * step, step)))))
    assert sorted(height_m.tolist()) == pytest.approx(sorted(heights.tolist()))


def test_coarse_canopy_is_scattered_with_closed_crowns(write_raster):
    raster = np.zeros((60, 80), np.float32)
    raster[10:50, 10:70] = 15.0  # 400 m x 600 m
    raster[20:30, 20:30] = np.nan
    canopy = Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000000, 10.0, nodata=np.nan)))
    x, y, height_m = trees_of(canopy)
    assert set(height_m.tolist()) == {15.0}
    row, col = np.floor((5000000 - y) / 10).astype(int), np.floor((x - 500000) / 10).astype(int)
    assert (raster[row, col] == 15.0).all()
    edges = module._height_classes(lambda h: 1.0 + 0.25 * h, MIN_TREE_HEIGHT_M)
    number = np.searchsorted(edges, 15.0) - 1
    crown_m = 1.0 + 0.25 * np.sqrt(edges[number] * edges[number + 1])
    assert 0.8 < crown_m / (1.0 + 0.25 * 15.0) < 1.25
    assert len(x) == pytest.approx(HEXAGONAL_CROWNS_PER_SQUARE * 230_000 / crown_m**2, rel=0.01)
    assert cKDTree(np.column_stack([x, y])).query(np.column_stack([x, y]), k=2)[0][:, 1].min() > 0.4 * crown_m


def test_wide_cells_show_tall_trees_over_scattered_shrubs(write_raster):
    """Cells are 2.5 m wide. Tall trees are 15 m apart, over shrubs with crowns narrower than a cell."""
    raster = np.full((120, 120), 3.0, np.float32)
    raster[3::6, 3::6] = 20.0
    x, y, height_m = trees_of(Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000000, 2.502))))
    is_tall = height_m == 20.0
    assert is_tall.sum() == 400 and set(height_m.tolist()) == {3.0, 20.0}
    np.testing.assert_allclose((x[is_tall] - 500000) / 2.502 % 6, 3.5, atol=1e-6)
    assert len(x) - 400 == pytest.approx(
        HEXAGONAL_CROWNS_PER_SQUARE * (300.24**2 - 400 * 2.502**2) / (1.0 + 0.25 * 3.0) ** 2, rel=0.2
    )


def test_detection_limit_grows_with_cell_size():
    def crown_of(height_m):
        return 1.0 + 0.25 * height_m

    assert (
        module._detection_limit_m(0.25, crown_of, MIN_TREE_HEIGHT_M)
        == module._detection_limit_m(1.0, crown_of, MIN_TREE_HEIGHT_M)
        == 0.0
    )
    assert crown_of(module._detection_limit_m(2.5, crown_of, MIN_TREE_HEIGHT_M)) == pytest.approx(MIN_CROWN_CELLS * 2.5, rel=0.01)
    assert np.isinf(module._detection_limit_m(3.01, crown_of, MIN_TREE_HEIGHT_M)) and np.isinf(
        module._detection_limit_m(2.5, np.ones_like, MIN_TREE_HEIGHT_M)
    )


def test_multi_peaked_crown_is_one_broadleaf_or_many_conifers(write_raster):
    peaks = np.array([[100, 100], [100, 105], [105, 100], [96, 97]])  # 2.5 m apart
    raster = gaussian_crowns(200, 200, peaks, np.array([20.0, 19.0, 18.5, 18.0], np.float32))
    canopy = Canopy(str(write_raster(raster, "EPSG:32633", 500000, 5000100, CELL_M)))
    assert [len(trees_of(canopy, species=species)[0]) for species in ("conifer", "broadleaf")] == [4, 1]


def test_broadleaf_window_is_half_a_deciduous_crown():
    height_m = np.linspace(8.0, 25.0, 100)
    base, slope = TREETOP_WINDOW_RADIUS_LINES["broadleaf"]
    np.testing.assert_allclose(base + slope * height_m, (3.09632 + 0.00895 * height_m**2) / 2, atol=0.22)
    conifer = TREETOP_WINDOW_RADIUS_LINES["conifer"]
    assert (base + slope * height_m > conifer[0] + conifer[1] * height_m).all()


def test_coarse_canopy_far_from_the_origin_of_a_flat_world(write_raster):
    raster = np.full((30, 40), 12.0, np.float32)
    canopy = Canopy(str(write_raster(raster, ENGINEERING, 7000, 90000, 10.0)))
    x, y, _ = trees_of(canopy, canopy.crs)
    assert x.min() >= 7000 and x.max() <= 7400 and y.min() >= 89700 and y.max() <= 90000
    assert np.histogram2d(x, y, bins=4)[0].min() > len(x) / 16 * 0.8


def test_height_classes_cover_all_heights_in_root_two_steps():
    def crown_of(height_m):
        return 1.0 + 0.3 * height_m

    edges = module._height_classes(crown_of, MIN_TREE_HEIGHT_M)
    assert edges[0] == MIN_TREE_HEIGHT_M and edges[-1] > MAX_PLAUSIBLE_HEIGHT_M
    assert (crown_of(edges[1:]) / crown_of(edges[:-1])).max() < 1.45
    assert module._height_classes(lambda h: np.full_like(h, 3.0), MIN_TREE_HEIGHT_M).size == 2


def test_room_is_the_mean_distance_to_three_neighbours():
    x, y = np.array([0.0, 3.0, 0.0, 0.0]), np.array([0.0, 0.0, 4.0, -5.0])
    assert growing_space_m(x, y, 0.3048)[0] == pytest.approx(4.0 * 0.3048)
    assert np.isinf(growing_space_m(x[:3], y[:3], 1.0)).all()


@pytest.mark.parametrize(
    ("dtype", "crs", "message"), [(np.float32, None, "no coordinate reference system"), (np.complex64, "EPSG:32633", "complex64")]
)
def test_invalid_canopy_rasters_are_rejected(write_raster, dtype, crs, message):
    data = np.zeros((4, 4), dtype)
    with pytest.raises(SourceError, match=message):
        Canopy(str(write_raster(data, crs, 0, 8, 2)))


def test_kootenay_inventory_is_reproduced(shared_data):
    """Compare with the inventory that ForestTools computed from this canopy (``vwf``, the same window, minimum height 1.5 m).

    ForestTools reports a point for each of several equal cells, which are one tree here.
    """
    _, _, wkb, (height_m, *_) = pyogrio.raw.read(shared_data / "forest" / "kootenay_treetops.gpkg")
    inventory = shapely.get_coordinates(shapely.from_wkb(wkb))
    canopy = Canopy(str(shared_data / "forest" / "kootenay_CHM_025m.tif"))
    x, y, found_m = trees_of(canopy, canopy.crs)
    tree_xy = np.column_stack([x, y])
    is_tall = height_m >= MIN_TREE_HEIGHT_M
    is_missed = cKDTree(tree_xy).query(inventory[is_tall])[0] > 1.5
    is_extra = cKDTree(inventory).query(tree_xy)[0] > 1.5
    assert is_missed.sum() <= 0.04 * is_tall.sum()
    assert is_extra.sum() <= 0.05 * len(tree_xy)
    assert found_m.max() == pytest.approx(height_m.max(), rel=1e-6)
