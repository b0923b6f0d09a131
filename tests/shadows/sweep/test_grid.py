"""Line sweep over plain arrays: known geometry, all azimuths, and windows without seams."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull

from skugga.shadows.sweep import grid as sweep_grid
from skugga.shadows.sweep.grid import (
    HIGHER_DIAGONALS,
    NO_GROUND_RAY_HEIGHT,
    NO_MASK,
    NO_RAY_HEIGHTS,
    LineState,
    flat_world_grid,
    initial_peaks,
    sun_aligned_linear_values,
    sunlit_nodes,
    sweep_nodes,
    sweep_to_state,
)
from skugga.shadows.sweep.horizon import horizon_deg
from skugga.shadows.sweep.lines import LineStrip, SunAlignedGrid, sweep_rows
from skugga.shadows.sweep.points import empty_strip_points
from skugga.shadows.sweep.position_cubics import position_cubics
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.errors import UnsupportedError
from skugga.terrain.ground.sheet import Sheet, diagonal_cuts, sheet_of

OFF_AXIS_AZIMUTHS_DEG = [7.0, 38.0, 67.0, 113.0, 158.0, 202.0, 251.0, 293.0, 338.0]


def mountains(side: int, seed: int = 1, roughness: float = 2.0) -> np.ndarray:
    """Return fractal heights (side, side), 0 to 40 cells of 10 m."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side))
    frequency[0, 0] = 1.0
    spectrum = rng.standard_normal((side, side // 2 + 1, 2)) @ [1.0, 1.0j] * frequency**-roughness
    spectrum[0, 0] = 0.0
    heights = np.fft.irfft2(spectrum, s=(side, side))
    return (400.0 * (heights - heights.min()) / np.ptp(heights)).astype(np.float32)


def sun_direction(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Return the unit vector (3,) to the sun: east, north, up."""
    azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def _node_positions(height_m: np.ndarray, down_m: float, right_m: float, first: int = 0) -> np.ndarray:
    """Return the positions (rows, cols, 3) of a grid's nodes, metres east, north and up.

    ``down_m`` and ``right_m`` are the sides of cells. ``first`` is the index of the first row and of the first column.
    """
    row, col = np.indices(height_m.shape) + first
    return np.stack([col * right_m, -row * down_m, height_m.astype(float)], axis=-1)


def traced_sunlit(
    height_m: np.ndarray,
    cell_m: float,
    azimuth_deg: float,
    altitude_deg: float,
    is_cut_nw_se: np.ndarray | None = None,
    padding_cells: int = 1,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which nodes see the sun, and where the result is independent of the rays' offset.

    Rays run over cuts, or along the higher diagonals; then the outermost heights continue for some cells ``padding_cells``.
    """
    rows, cols = height_m.shape
    nodes = _node_positions(height_m, cell_m, cell_m)
    padded_nodes = _node_positions(np.pad(height_m, padding_cells, mode="edge"), cell_m, cell_m, first=-padding_cells)
    caster = sheet_of(padded_nodes) if is_cut_nw_se is None else Sheet(nodes, is_cut_nw_se)
    rays, nodes = RayScene([caster]), nodes.reshape(-1, 3)
    lit_by_offset = []
    for offset_factor in (0.25, 1.0, 4.0):
        start = nodes + [0.0, 0.0, offset_factor * rays.offset_m]
        lit_by_offset.append(~rays.is_blocked(start, sun_direction(azimuth_deg, altitude_deg)).reshape(rows, cols))
    return lit_by_offset[0], (lit_by_offset[0] == lit_by_offset[1]) & (lit_by_offset[0] == lit_by_offset[2])


@pytest.mark.parametrize("azimuth", [*OFF_AXIS_AZIMUTHS_DEG, 0.0, 45.0, 90.0, 135.0, 180.0, 225.0, 270.0, 315.0])
def test_sunlit_matches_rays_at_every_azimuth(azimuth):
    heights = mountains(200)
    for altitude in (4.0, 15.0):
        lit, decidable = traced_sunlit(heights, 10.0, azimuth, altitude)
        mismatch = (sunlit_nodes(heights, 10.0, azimuth, altitude) != lit) & decidable
        assert decidable.mean() > 0.98 and (~lit).mean() > 0.2
        assert mismatch.mean() < 5e-4, f"{mismatch.mean():.2%} at {azimuth}"


@pytest.mark.parametrize("slant", [-30.0, -0.001, 0.0, 0.001, 10.0])
@pytest.mark.parametrize("azimuth", [0.0, 90.0, 180.0, 270.0])
def test_sunlit_shades_the_outermost_lines_of_a_wall(azimuth, slant):
    """A wall of four cells spans the grid under a sun at 45 degrees, and rays may leave the grid at any small angle.

    Shaded are the nodes nearer than four cells, that is three. Under slanting rays the shadow of the wall's last node may be
    narrower.
    """
    heights = np.zeros((40, 40), np.float32)
    heights[20] = 40.0
    wall_heights = heights if azimuth in (0.0, 180.0) else np.ascontiguousarray(heights.T)
    dark = ~sunlit_nodes(wall_heights, 10.0, azimuth + slant, 45.0)
    shaded_counts = dark.sum(axis=0 if wall_heights is heights else 1)
    assert (np.delete(shaded_counts, [0, 1, 2, -3, -2, -1]) == 3).all()
    assert shaded_counts[[0, -1]].min() >= (3 if abs(slant) < 1.0 else 1)


def test_sunlit_is_more_accurate_with_more_lines():
    """The error is that of interpolation between lines, which falls with their spacing."""
    heights = mountains(256, seed=4, roughness=1.8)
    error_counts = {1: 0, 4: 0}
    for azimuth in OFF_AXIS_AZIMUTHS_DEG[:4]:
        lit, decidable = traced_sunlit(heights, 10.0, azimuth, 10.0)
        for lines in error_counts:
            error_counts[lines] += int(((sunlit_nodes(heights, 10.0, azimuth, 10.0, lines=lines) != lit) & decidable).sum())
    assert error_counts[1] > 40
    assert error_counts[4] < error_counts[1] / 3


@pytest.mark.long
@given(azimuth=st.floats(0, 360), altitude=st.floats(10, 60), height=st.floats(100, 200))
def test_sunlit_shadow_of_a_cone_is_a_convex_hull(azimuth, altitude, height):
    """On a floor, the shadow is the hull of the cone's foot and its tip's shadow, height / tan(altitude) away from the sun."""
    cell, radius = 10.0, 60.0
    east, north = np.meshgrid((np.arange(221) - 110) * cell, (110 - np.arange(221)) * cell)
    heights = height * np.maximum(0.0, 1.0 - np.hypot(east, north) / radius).astype(np.float32)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    tip = -sun_direction(azimuth, altitude)[:2] * height / np.sin(np.radians(altitude))
    outline = ConvexHull(np.concatenate([radius * np.stack([np.sin(angle), np.cos(angle)], axis=1), [tip]]))
    outside = np.max(np.stack([east, north], axis=-1) @ outline.equations[:, :2].T + outline.equations[:, 2], axis=-1)
    dark = ~sunlit_nodes(heights, cell, azimuth, altitude)
    floor = np.hypot(east, north) > radius + cell
    assert dark[floor & (outside < -cell)].all()
    assert not dark[outside > cell].any()


@pytest.mark.parametrize("azimuth", [202.0, 113.0])
def test_sunlit_is_invariant_under_half_a_turn(azimuth):
    heights = mountains(150, seed=7)
    rotated = sunlit_nodes(np.ascontiguousarray(heights[::-1, ::-1]), 10.0, azimuth + 180.0, 12.0)
    assert (rotated[::-1, ::-1] != sunlit_nodes(heights, 10.0, azimuth, 12.0)).mean() < 1e-3


def test_sunlit_of_rectangular_cells_matches_rays():
    heights = mountains(160, seed=2)
    rays = RayScene([sheet_of(_node_positions(np.pad(heights, 1, mode="edge"), 13.0, 7.0, first=-1))])
    nodes = _node_positions(heights, 13.0, 7.0).reshape(-1, 3)
    lit = ~rays.is_blocked(nodes + [0, 0, rays.offset_m], sun_direction(157.0, 11.0)).reshape(160, 160)
    assert (sunlit_nodes(heights, (13.0, 7.0), 157.0, 11.0) != lit)[1:-1, 1:-1].mean() < 1e-3


@pytest.mark.parametrize("azimuth", [202.0, 113.0, 45.0, 90.0])
def test_sunlit_is_independent_of_strips_and_cores(azimuth, monkeypatch):
    heights = mountains(300, seed=3)
    expected = sunlit_nodes(heights, 10.0, azimuth, 6.0)
    for cells, cores in ((64, 1), (37, 2), (1, 2)):
        monkeypatch.setattr(sweep_grid, "STRIP_CELLS", cells)
        assert (sunlit_nodes(heights, 10.0, azimuth, 6.0, cores=cores) == expected).all()


def sun_aligned_grid(
    heights: np.ndarray, azimuth: float, altitude: float, is_cut_nw_se: np.ndarray | None = None
) -> SunAlignedGrid:
    """Return the sweep's grid of heights (rows, cols) under a sun, whose angles are in degrees.

    ``is_cut_nw_se`` tells for each quad whether its diagonal runs from north-west to south-east; ``None`` takes the higher
    diagonal.
    """
    orientation, row_m, col_m, column_of_t, t_of_column = flat_world_grid(heights.shape, 10.0, azimuth)
    sine, cosine, angle = np.sin(np.radians(altitude)), np.cos(np.radians(altitude)), np.radians(azimuth)
    ray_height = sun_aligned_linear_values(
        heights, orientation, cosine, sine * np.cos(angle) * row_m, -sine * np.sin(angle) * col_m
    )
    cuts = HIGHER_DIAGONALS if is_cut_nw_se is None else np.pad(orientation.sun_aligned_cuts(is_cut_nw_se), ((0, 0), (1, 1)))
    return SunAlignedGrid(ray_height, column_of_t, t_of_column, cuts)


def sweep_over_cuts(heights: np.ndarray, azimuth: float, altitude: float, is_cut_nw_se: np.ndarray | None) -> np.ndarray:
    """Return ``sunlit_nodes`` over cuts."""
    sheet = sun_aligned_grid(heights, azimuth, altitude, is_cut_nw_se)
    n, m = sheet.ray_height.shape
    lit, _, _ = sweep_nodes(sheet, 8, (sheet.t_of_column[:, 0].min(), m), row_range=(0, n))
    return flat_world_grid(heights.shape, 10.0, azimuth)[0].grid_order_view(lit)


@pytest.mark.parametrize("azimuth", [*OFF_AXIS_AZIMUTHS_DEG, 0.0, 45.0, 90.0, 135.0])
def test_sweep_over_any_cuts_matches_rays(azimuth):
    """Decimated ground of a perspective view has such cuts. Rays run over the same triangles."""
    heights = mountains(150, seed=11)
    is_cut_nw_se = np.random.default_rng(1).random((149, 149)) < 0.5
    for altitude in (4.0, 15.0):
        lit, decidable = traced_sunlit(heights, 10.0, azimuth, altitude, is_cut_nw_se)
        mismatch = (sweep_over_cuts(heights, azimuth, altitude, is_cut_nw_se) != lit) & decidable
        assert mismatch[1:-1, 1:-1].mean() < 5e-4


@pytest.mark.parametrize("azimuth", [*OFF_AXIS_AZIMUTHS_DEG, 0.0, 45.0, 90.0, 135.0])
def test_sweep_derives_the_higher_diagonals(azimuth):
    heights = mountains(150, seed=12)
    derived = sweep_over_cuts(heights, azimuth, 8.0, None)
    assert (sweep_over_cuts(heights, azimuth, 8.0, diagonal_cuts(heights)) != derived).mean() < 1e-4
    assert (
        sunlit_nodes(heights, 10.0, azimuth, 8.0) == sweep_over_cuts(np.pad(heights, 1, "edge"), azimuth, 8.0, None)[1:-1, 1:-1]
    ).all()
    if azimuth % 90.0:  # otherwise rays run along rows or columns, and cross no diagonal
        assert (sweep_over_cuts(heights, azimuth, 8.0, ~diagonal_cuts(heights)) != derived).mean() > 1e-3


def test_sweep_rows_continue_across_windows():
    """The lines of a window continue bit by bit where those of the previous window ended."""
    sheet = sun_aligned_grid(mountains(200, seed=5), 190.0, 5.0)
    n, columns = sheet.ray_height.shape
    results = []
    for borders in ([0, n - 1], [0, 1, 50, 51, 128, n - 1]):
        line_max, lit = np.full((4, 300), NO_GROUND_RAY_HEIGHT, np.float32), np.ones((n, columns), np.bool_)
        strip = LineStrip(4, -60, line_max, initial_peaks(4, 300))
        for first, last in zip(borders, borders[1:], strict=False):
            sweep_rows(sheet, strip, first, last, NO_RAY_HEIGHTS, lit, empty_strip_points(n))
        results.append((line_max, lit))
    assert (results[0][0] == results[1][0]).all() and (results[0][1] == results[1][1]).all()
    assert not results[0][1].all()


def test_sweep_state_carries_the_shadow_of_earlier_ground():
    heights = np.zeros((220, 90), np.float32)
    heights[10:14, 30:50] = 300.0  # a wall in the north, whose shadow reaches beyond row 60
    lit, _, _ = sweep_nodes(sun_aligned_grid(heights, 3.0, 20.0), 4, (-30.0, 120.0), row_range=(0, 220))
    assert (~lit[60:90]).any()
    first_grid, second_grid = sun_aligned_grid(heights[:61], 3.0, 20.0), sun_aligned_grid(heights[60:], 3.0, 20.0)
    shift = 60 * 10.0 * np.sin(np.radians(20.0)) * np.cos(np.radians(3.0))  # levels count from each window's corner
    state = sweep_to_state(first_grid, 4, (-30.0, 120.0))
    line_max = np.where(state.line_max > NO_GROUND_RAY_HEIGHT / 2, state.line_max - np.float32(shift), NO_GROUND_RAY_HEIGHT)
    shifted_state = LineState(state.first_cell, line_max.astype(np.float32))
    t0 = 60 * np.tan(np.radians(3.0))
    shifted_grid = SunAlignedGrid(
        second_grid.ray_height,
        second_grid.column_of_t + [t0, 0, 0, 0],
        second_grid.t_of_column - [t0, 0, 0, 0],
        second_grid.is_cut_nw_se,
    )
    continued_lit, _, _ = sweep_nodes(
        shifted_grid, 4, (-30.0, 120.0), entry_state=shifted_state, coarser_cell_ratio=1.0, row_range=(0, 160)
    )
    assert (continued_lit[1:] != lit[61:]).mean() < 2e-4 and (~continued_lit[1:30]).any()


def test_sunlit_holes_cast_no_shadow():
    heights = np.zeros((120, 120), np.float32)
    heights[20:40, 50:70] = 500.0
    with_wall = sunlit_nodes(heights, 10.0, 10.0, 30.0)
    heights[20:40, 50:70] = np.nan
    assert (~with_wall).sum() > 400
    assert sunlit_nodes(heights, 10.0, 10.0, 30.0).all()


def test_sunlit_floor_is_lit_under_any_sun():
    floor = np.zeros((70, 90), np.float32)
    for azimuth in (*range(0, 360, 7), 90, 180, 270, 45, 135, 225, 315):
        assert sunlit_nodes(floor, 10.0, float(azimuth), 0.5).all(), azimuth


@pytest.mark.parametrize("azimuth", [202.0, 67.0, 90.0])
def test_horizon_deg_answers_all_altitudes(azimuth):
    heights = mountains(160, seed=6)
    horizon = horizon_deg(heights, 10.0, azimuth)
    for altitude in (2.0, 8.0, 25.0, 50.0):
        lit, decidable = traced_sunlit(heights, 10.0, azimuth, altitude)
        mismatch = ((horizon <= altitude) != lit) & decidable
        assert mismatch.mean() < 2e-3
    for core_count in (1, 2):
        assert np.allclose(horizon_deg(heights, 10.0, azimuth, cores=core_count), horizon)


def test_horizon_deg_of_a_wall_is_its_angle():
    heights = np.zeros((90, 40), np.float32)
    heights[10] = 200.0
    horizon = horizon_deg(heights, 10.0, 0.0)
    distance = 10.0 * np.arange(1, 80)
    assert np.allclose(horizon[11:, 20], np.degrees(np.arctan(200.0 / distance)), atol=1e-3)
    assert (horizon[0] == 0.0).all()  # the ground goes on for a cell beyond the outermost nodes


def test_horizon_deg_and_sunlit_of_the_smallest_grids():
    """Beyond a single row or column, level ground goes on for a cell. Of two rows, one shades the other."""
    for shape in ((1, 1), (1, 9), (9, 1)):
        heights = np.arange(9.0, dtype=np.float32)[: np.prod(shape)].reshape(shape)
        for azimuth in (0.0, 45.0, 90.0, 200.0):
            assert horizon_deg(heights, 10.0, azimuth).shape == sunlit_nodes(heights, 10.0, azimuth, 1.0).shape == shape
    assert (horizon_deg(np.zeros((1, 9), np.float32), 10.0, 0.0) == 0.0).all()
    step = np.array([[10.0, 10.0], [0.0, 0.0]], np.float32)
    assert np.allclose(horizon_deg(step, 10.0, 0.0), [[0.0, 0.0], [45.0, 45.0]])
    assert sunlit_nodes(step, 10.0, 0.0, 46.0).all() and not sunlit_nodes(step, 10.0, 0.0, 44.0)[1].any()


@pytest.mark.parametrize("azimuth", [0.0, 67.0, 90.0, 180.0, 251.0, 270.0])
def test_horizon_deg_is_defined_beside_holes(azimuth):
    heights = mountains(80, seed=9)
    heights[np.random.default_rng(0).random(heights.shape) < 0.01] = np.nan
    assert (np.isnan(horizon_deg(heights, 10.0, azimuth)) == np.isnan(heights)).all()


def test_sweep_lines_of_varying_spacing_follow_their_cubics():
    """A plane is lit. Columns are one cell wide only in the middle of the grid, so runs of lines are curved."""
    rows, cols = 60, 1200
    column_of_t, t_of_column = position_cubics(lambda i, j: (j - 600.0) * (1.0 + 4e-5 * (j - 600.0)) - 0.6 * i, rows, cols, "")
    row, col = np.mgrid[:rows, : cols + 2].astype(float)
    ray_height = (30.0 * ((col - 601.0) * (1.0 + 4e-5 * (col - 601.0)) - 0.6 * row) + 2.0 * row).astype(np.float32)
    lit, _, _ = sweep_nodes(
        SunAlignedGrid(ray_height, column_of_t, t_of_column, HIGHER_DIAGONALS), 8, (-500.0, 600.0), row_range=(0, rows)
    )
    assert lit[1:, 100:-100].mean() > 0.99


def test_horizon_deg_is_independent_of_strips(monkeypatch):
    from skugga.shadows.sweep import horizon as sweep_horizon

    heights = mountains(120, seed=8)
    expected = horizon_deg(heights, 10.0, 112.0)
    monkeypatch.setattr(sweep_horizon, "STRIP_NODES", 2000)
    assert np.allclose(horizon_deg(heights, 10.0, 112.0), expected)


def test_position_cubics_refuse_rays_that_bend_too_much():
    column_of_t, t_of_column = position_cubics(lambda i, j: j + 0.3 * i + 1e-5 * i * j, 200, 300, "")
    assert np.allclose(
        column_of_t[100, 0] + column_of_t[100, 1] * (t_of_column[100, 0] + 50 * t_of_column[100, 1]), 50.0, atol=1e-3
    )
    with pytest.raises(UnsupportedError, match="shadow_map"):
        position_cubics(lambda i, j: j + 20.0 * np.sin(i / 9.0 + j / 11.0), 200, 300, "")
    with pytest.raises(UnsupportedError, match="CRS"):
        position_cubics(lambda i, j: np.where(j > 100, np.nan, j), 200, 300, "")
    with pytest.raises(UnsupportedError, match="shadow_map"):
        position_cubics(lambda i, j: np.abs(j - 150.0), 200, 300, "")


def test_sweep_nodes_without_rows_allocates_no_mask():
    lit, points_lit, shadow_heights = sweep_nodes(sun_aligned_grid(mountains(50), 20.0, 10.0), 2, (0.0, 40.0))
    assert lit.shape == NO_MASK.shape and len(points_lit) == len(shadow_heights) == 0


def test_sunlit_keeps_peaks_between_lines_near_a_diagonal():
    """Near a diagonal, nodes shade one another all along a ray. Peaks between two lines must not be cut off."""
    rng = np.random.default_rng(3)
    heights = (20.0 * (rng.random((200, 200)) < 0.01)).astype(np.float32)
    lit, decidable = traced_sunlit(heights, 2.5, 224.99, 10.0)
    missed = (sunlit_nodes(heights, 2.5, 224.99, 10.0) & ~lit & decidable)[2:-2, 2:-2]
    assert (~lit).mean() > 0.2 and missed.mean() < 5e-4
