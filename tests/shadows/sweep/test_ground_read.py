"""Ground that a sweep over a map's block reads, and the course of its lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.passes import PassLog
from skugga.shadows.sweep import ground_windows
from skugga.shadows.sweep.grid import allocate_bordered_grid
from skugga.shadows.sweep.ground_windows import patch_windows
from skugga.shadows.sweep.position_cubics import fit_cubics
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import fill_visibility, find_lit_nodes
from skugga.terrain.casters.caster_types import PATCH_QUADS, Casters, Patch
from skugga.terrain.casters.reach import find_casters, find_sun_casters
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from tests.rasters import ENGINEERING

QUADS = PATCH_QUADS


@given(st.sets(st.tuples(st.integers(-3, 4), st.integers(-3, 4)), max_size=30))
def test_patch_windows_cover_each_patch_once(patches):
    covered_patches: list[tuple[int, int]] = []
    for row, col, rows, cols in patch_windows([Patch(0, *row_col) for row_col in patches]):
        assert row % QUADS == col % QUADS == 0 and (rows - 1) % QUADS == (cols - 1) % QUADS == 0
        covered_patches += [(row // QUADS + i, col // QUADS + j) for i in range(rows // QUADS) for j in range(cols // QUADS)]
    assert sorted(covered_patches) == sorted(patches)


def test_fitted_cubics_reproduce_cubics():
    x = np.sort(np.random.default_rng(5).uniform(900.0, 3000.0, (6, 17)), axis=1)
    coefficients = np.random.default_rng(6).normal(size=(6, 4)) * (1.0, 1e-1, 1e-5, 1e-9)
    y = np.stack([np.polynomial.polynomial.polyval(*pair) for pair in zip(x, coefficients, strict=True)])
    fitted = fit_cubics(x, y)
    assert np.allclose(fitted, coefficients, rtol=1e-6, atol=1e-12)
    assert np.allclose(fit_cubics(x[:, :2], y[:, :2])[:, 2:], 0.0)  # a line through two points


@pytest.mark.parametrize("azimuth", [0.0, 100.0, 190.0, 280.0])
def test_sweep_ignores_rows_without_ground(write_raster, make_scene, monkeypatch, azimuth):
    """Memory of these rows may hold heights above all ground. They change no result, for nodes or for other points."""
    height = np.zeros((900, 900), np.float32)
    height[::60], height[:, ::70] = 40.0, 60.0
    scene = make_scene(write_raster(height, ENGINEERING, 0.0, 9000.0, 10.0), azimuth, 20.0)
    view = scene.view(bounds=(3003.0, 3003.0, 5003.0, 5003.0), size=(200, 200))
    buffer = geometry_buffer(scene, view)
    nodes = bare_nodes(scene, MapView(view.grid, float(int(view.row0)), float(int(view.col0)), 1.0, 1.0, 200, 200), 1)
    point_casters = find_casters(scene, buffer)
    point_casters = replace(
        point_casters, culled_patches=frozenset(point_casters.patches)
    )  # the sheet keeps its size, and has no ground in those patches
    node_casters = Casters(find_sun_casters(scene, nodes), point_casters.reach)
    node_casters = replace(node_casters, culled_patches=frozenset(node_casters.patches))

    def sweep_results() -> list[np.ndarray]:
        return [
            fill_visibility(buffer, scene, SUN, ("relief",), point_casters, SweepSettings(), PassLog()),
            find_lit_nodes(nodes, scene, SUN, ("relief",), node_casters, SweepSettings(), PassLog()),
        ]

    empty_row_counts = []

    def with_high_ground(n: int, m: int, filled_rows: slice, *window_to_fill: object) -> tuple[np.ndarray, np.ndarray]:
        with_border, inside = allocate_bordered_grid(n, m, filled_rows, *window_to_fill)
        is_empty_row = np.ones(n, bool)
        is_empty_row[filled_rows] = False
        with_border[is_empty_row] = 1e30
        empty_row_counts.append(is_empty_row.sum())
        return with_border, inside

    before = sweep_results()
    monkeypatch.setattr(ground_windows, "allocate_bordered_grid", with_high_ground)
    after = sweep_results()
    assert all(0.02 < (visibility == 0.0).mean() < 0.98 for visibility in before) and min(empty_row_counts) > 0
    assert all(np.array_equal(original, patched) for original, patched in zip(before, after, strict=True))
