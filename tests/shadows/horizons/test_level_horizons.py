"""Horizons and sky view factors of levels: against the exact horizons of points, over seams, with far ground and objects."""

import numpy as np
import pytest
from pyproj import Proj

import skugga
from skugga.api.raster_view import raster_view
from skugga.shadows.horizons import block_ground
from skugga.shadows.horizons.azimuths import evenly_spaced_azimuths_deg
from skugga.shadows.horizons.block_ground import block_grid, horizon_blocks
from skugga.shadows.horizons.level_horizons import horizons_of_block, sky_view_of_block
from tests.rasters import ENGINEERING, write_geotiff

AZIMUTHS = 24

GRIDS = {
    "UTM, 3 degrees from its meridian": ("EPSG:32632", 670_000.0, 6_900_000.0, 30.0),
    "degrees": ("EPSG:4326", 15.0, 68.0, (2.0 / 3600.0, 1.0 / 3600.0)),
    "polar": ("EPSG:3031", 2_000_000.0, 900_000.0, 60.0),
    "flat": (ENGINEERING, 0.0, 0.0, 30.0),
}


def mountains(side=220):
    """Return heights (side, side) in metres, float32."""
    random = np.random.default_rng(11)
    row, col = np.mgrid[:side, :side]
    smooth = 600.0 * np.sin(row / 23.0) * np.cos(col / 17.0) + 200.0 * np.sin(col / 7.0 + row / 11.0)
    return (1500.0 + smooth + 4.0 * random.random((side, side))).astype(np.float32)


@pytest.fixture(params=GRIDS)
def open_mountains(request, tmp_path):
    """Return an open level of mountains in one of several CRSs."""
    with skugga.open_level(write_geotiff(tmp_path / "dem.tif", mountains(), *GRIDS[request.param])) as level:
        yield level


def angles_of_level(level):
    """Return the horizon angles of all cells of a level, (rows, cols, azimuths), computed by blocks."""
    view = raster_view(level._scene).view
    out = np.full((view.rows, view.cols, AZIMUTHS), np.nan, np.float32)
    for block, row, col in horizon_blocks(level._scene, view):
        out[row : row + block.rows, col : col + block.cols] = horizons_of_block(level._scene, block, AZIMUTHS)
    return out


def exact_angles(level, cells):
    """Return the exact horizon angles (cells, azimuths) of points at the centres of cells."""
    view = raster_view(level._scene).view
    out = []
    for row, col in cells:
        x, y = float(view.grid.x(view.col0 + col)), float(view.grid.y(view.row0 + row))
        horizon = level.horizon(x, y, crs=view.grid.crs)
        np.testing.assert_allclose(horizon.azimuth_deg[:: 720 // AZIMUTHS], evenly_spaced_azimuths_deg(AZIMUTHS), atol=1e-9)
        out.append(horizon.elevation_deg[:: 720 // AZIMUTHS])
    return np.array(out)


CELLS = [(row, col) for row in range(4, 220, 42) for col in range(9, 220, 47)]


def cells_of(level):
    """Return the cells to compare: fewer in a flat world, where a point's exact horizon takes a second."""
    return CELLS[::6] if level._scene.world.is_flat else CELLS


def test_angles_are_those_of_points(open_mountains):
    angles = angles_of_level(open_mountains)
    cells = cells_of(open_mountains)
    wrong = np.abs(np.array([angles[cell] for cell in cells]) - exact_angles(open_mountains, cells))
    assert wrong.mean() < 0.05
    assert np.mean(wrong < 0.3) > 0.99


def test_far_ground_and_small_blocks_give_the_angles_of_points(open_mountains, monkeypatch):
    monkeypatch.setattr(block_ground, "BLOCK_SIDE_NODES", 64)
    monkeypatch.setattr(block_ground, "NEAR_NODES", 40)
    scene = open_mountains._scene
    blocks = horizon_blocks(scene, raster_view(scene).view)
    assert len(blocks) == 16 and [part.factor for part in block_grid(scene, blocks[0][0]).far] == [2, 4]
    angles = angles_of_level(open_mountains)
    cells = cells_of(open_mountains)
    wrong = np.abs(np.array([angles[cell] for cell in cells]) - exact_angles(open_mountains, cells))
    assert wrong.mean() < 0.1
    assert np.mean(wrong < 0.5) > 0.95  # far ground begins 40 nodes away here, with 20 of its nodes from there on
    beside_seams = np.abs(np.diff(angles, axis=1))
    assert beside_seams[:, 63].mean() < 1.1 * beside_seams[:, [31, 95]].mean()


def test_without_far_ground_angles_are_too_low(open_mountains, monkeypatch):
    """The comparison above sees far ground: without it the horizons change."""
    monkeypatch.setattr(block_ground, "BLOCK_SIDE_NODES", 64)
    monkeypatch.setattr(block_ground, "NEAR_NODES", 40)
    angles = angles_of_level(open_mountains)
    monkeypatch.setattr(block_ground, "_far_ground", lambda *_: [])
    assert np.nanmean(angles - angles_of_level(open_mountains)) > 0.05


def test_axes_of_the_grid_are_turned_to_true_north(tmp_path):
    """A ridge along a meridian of UTM, far from the zone's meridian: the highest horizon lies due east of the cells west of it."""
    crs, x0, y0, cell = GRIDS["UTM, 3 degrees from its meridian"]
    with skugga.open_level(write_geotiff(tmp_path / "dem.tif", mountains(), crs, x0, y0, cell)) as level:
        scene = level._scene
        (block, _, _) = horizon_blocks(scene, raster_view(scene).view)[0]
        grid = block_grid(scene, block)
    turn_deg = np.degrees(np.arctan2(grid.east_north_of_cell_m[1, 1], grid.east_north_of_cell_m[0, 1]))
    x, y = block.centre
    proj = Proj("EPSG:32632")
    assert turn_deg == pytest.approx(-proj.get_factors(*proj(x, y, inverse=True)).meridian_convergence, abs=1e-3)
    assert abs(turn_deg) > 2.0


def test_blocks_are_small_where_meridians_converge(tmp_path):
    heights = np.zeros((300, 700), np.float32)
    with skugga.open_level(write_geotiff(tmp_path / "pole.tif", heights, "EPSG:3031", 300_000.0, 300_000.0, 60.0)) as level:
        scene = level._scene
        assert len(horizon_blocks(scene, raster_view(scene).view)) > 1


def test_a_house_and_trees_hide_the_sky(level_with_objects):
    scene = level_with_objects._scene
    view = raster_view(scene).view
    opaque = sky_view_of_block(scene, view, "cosine", 72)
    half = sky_view_of_block(scene, view, "cosine", 72, 0.5)
    clear = sky_view_of_block(scene, view, "cosine", 72, 1.0)
    # 11 m west of the wall the house covers azimuths 47 to 133 degrees, up to 42 degrees in the middle.
    azimuth = np.radians(np.arange(0.0, 360.0, 5.0))
    meets_the_wall = (np.sin(azimuth) > 0.0) & (np.abs(10.5 * np.cos(azimuth)) < 10.0 * np.sin(azimuth))
    rise = np.where(meets_the_wall, 10.0 * np.sin(azimuth) / 10.5, 0.0)
    assert clear[100, 69] == pytest.approx(np.mean(1.0 / (1.0 + rise**2)), abs=0.01)
    assert clear[100, 90] == pytest.approx(1.0, abs=1e-3)  # on the roof
    assert clear[100, 30] > 0.99 > clear[100, 78] and clear[100, 78] == pytest.approx(0.55, abs=0.06)  # at the wall
    in_wood, beside_wood = (slice(60, 140), slice(145, 175)), (slice(90, 110), slice(134, 138))
    assert clear[in_wood].min() > 0.98 and np.median(opaque[in_wood]) < 0.05
    assert 0.4 < opaque[beside_wood].mean() < 0.85 < clear[beside_wood].mean()
    np.testing.assert_allclose(half, 0.5 * (opaque + clear), atol=1e-6)
    assert (opaque <= clear + 1e-6).all()


def test_crowns_are_as_high_as_those_of_points(level_with_objects):
    """Beside a wood, horizons over crowns as columns are those over the trees' pictures but for gaps between leaves."""
    scene = level_with_objects._scene
    angles = horizons_of_block(scene, raster_view(scene).view, AZIMUTHS)
    cells = [(100, 136), (100, 130), (90, 134), (120, 188), (30, 160)]
    exact = exact_angles(level_with_objects, np.array(cells))
    differences = np.stack([angles[cell] for cell in cells]) - exact
    assert abs(differences.mean()) < 2.0 and exact.max() > 45.0
    assert np.abs(differences).mean() < 4.0
