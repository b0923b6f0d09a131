"""Ground that a sweep over a map's block reads, and the course of its lines."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skugga.shadows.passes import PassLog
from skugga.shadows.sweep import rays
from skugga.shadows.sweep.grid import bordered, fitted_cubics
from skugga.shadows.sweep.rays import patch_windows
from skugga.shadows.sweep.settings import SweepSettings
from skugga.shadows.sweep.sweep import fill, fill_nodes
from skugga.terrain.casters.reach import PATCH_QUADS, Casters, Patch, find_casters, find_sun_casters
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.gbuffer.view_geometry import geometry_buffer
from skugga.terrain.geo.grid import MapView
from skugga.terrain.level.level import SUN
from tests.rasters import ENGINEERING

Q = PATCH_QUADS


@given(st.sets(st.tuples(st.integers(-3, 4), st.integers(-3, 4)), max_size=30))
def test_patch_windows_cover_each_patch_once(patches):
    covered: list[tuple[int, int]] = []
    for row, col, rows, cols in patch_windows([Patch(0, *place) for place in patches]):
        assert row % Q == col % Q == 0 and (rows - 1) % Q == (cols - 1) % Q == 0
        covered += [(row // Q + i, col // Q + j) for i in range(rows // Q) for j in range(cols // Q)]
    assert sorted(covered) == sorted(patches)


def test_fitted_cubics_reproduce_cubics():
    x = np.sort(np.random.default_rng(5).uniform(900.0, 3000.0, (6, 17)), axis=1)
    factors = np.random.default_rng(6).normal(size=(6, 4)) * (1.0, 1e-1, 1e-5, 1e-9)
    y = np.stack([np.polynomial.polynomial.polyval(*pair) for pair in zip(x, factors, strict=True)])
    found = fitted_cubics(x, y)
    assert np.allclose(found, factors, rtol=1e-6, atol=1e-12)
    assert np.allclose(fitted_cubics(x[:, :2], y[:, :2])[:, 2:], 0.0)  # a line through two points


@pytest.mark.parametrize("azimuth", [0.0, 100.0, 190.0, 280.0])
def test_sweep_ignores_rows_without_ground(write_raster, make_scene, monkeypatch, azimuth):
    """Memory of these rows may hold heights above all ground. They change no result, for nodes or for other points."""
    height = np.zeros((900, 900), np.float32)
    height[::60], height[:, ::70] = 40.0, 60.0
    scene = make_scene(write_raster(height, ENGINEERING, 0.0, 9000.0, 10.0), azimuth, 20.0)
    view = scene.view(bounds=(3003.0, 3003.0, 5003.0, 5003.0), size=(200, 200))
    buffer = geometry_buffer(scene, view)
    nodes = bare_nodes(scene, MapView(view.grid, float(int(view.row0)), float(int(view.col0)), 1.0, 1.0, 200, 200), 1)
    at_points = find_casters(scene, buffer)
    at_points = replace(
        at_points, culled=frozenset(at_points.patches)
    )  # the sheet keeps its size, and has no ground in those patches
    of_nodes = Casters(find_sun_casters(scene, nodes), at_points.reach)
    of_nodes = replace(of_nodes, culled=frozenset(of_nodes.patches))

    def seen() -> list[np.ndarray]:
        return [
            fill(buffer, scene, SUN, ("relief",), at_points, SweepSettings(), PassLog()),
            fill_nodes(nodes, scene, SUN, ("relief",), of_nodes, SweepSettings(), PassLog()),
        ]

    unknown = []

    def with_high_ground(n: int, m: int, known: slice, *window_to_fill: object) -> tuple[np.ndarray, np.ndarray]:
        with_border, inside = bordered(n, m, known, *window_to_fill)
        elsewhere = np.ones(n, bool)
        elsewhere[known] = False
        with_border[elsewhere] = 1e30
        unknown.append(elsewhere.sum())
        return with_border, inside

    before = seen()
    monkeypatch.setattr(rays, "bordered", with_high_ground)
    after = seen()
    assert all(0.02 < (each == 0.0).mean() < 0.98 for each in before) and min(unknown) > 0
    assert all(np.array_equal(one, other) for one, other in zip(before, after, strict=True))
