"""The benchmark of irradiation: its rays beside quadrature, planes of cells, stored figures, and tables."""

from __future__ import annotations

import json
from dataclasses import asdict
from datetime import date

import numpy as np
import pytest

from benchmarks.irradiation.__main__ import REPORT, stored_results
from benchmarks.irradiation.constant_light import BEAM_W_M2
from benchmarks.irradiation.figures import HillRow, RayRow, Results, ToolRow
from benchmarks.irradiation.hill_raster import HillRaster, open_hills
from benchmarks.irradiation.hills import sun_irradiation
from benchmarks.irradiation.page import format_report
from benchmarks.irradiation.rays import BeamErrors, SampledCells, beam_errors, sample_cells
from skugga.shadows.irradiation.suns import sun_intervals
from skugga.terrain.geo.clock import SOLAR
from skugga.terrain.geo.daily_windows import windows_between


@pytest.fixture(scope="module")
def raster(tmp_path_factory: pytest.TempPathFactory):
    with open_hills(tmp_path_factory.mktemp("hills")) as raster:
        yield raster


@pytest.fixture(scope="module")
def cells(raster: HillRaster) -> SampledCells:
    return sample_cells(raster.scene, raster.view, 200)


def test_rays_agree_with_quadrature(raster: HillRaster, cells: SampledCells):
    """The two truths share the suns only: one has triangles and Embree, the other Gaussian hills."""
    windows = windows_between(raster.scene.world, date(2023, 12, 21), date(2023, 12, 21), 1, (0.0, 1440.0), SOLAR)
    suns = sun_intervals(windows, 60.0, cells.lon_deg, cells.lat_deg)
    rays = cells.beam_kwh(suns, np.broadcast_to(BEAM_W_M2, (len(cells.row), len(suns))))
    position = raster.positions_m(cells.row, cells.col)
    power = np.full((1, 2, len(suns)), BEAM_W_M2)
    (truth,) = sun_irradiation(raster.hills, *position, suns, np.array([0.0, 1000.0]), power)
    assert beam_errors(rays, truth).mean < 2e-3
    assert truth.min() < 0.5 * truth.max()


def test_all_fits_of_planes_are_those_of_smooth_ground(raster: HillRaster, cells: SampledCells):
    east, north = raster.hills.slopes(*raster.positions_m(cells.row, cells.col))
    expected = np.stack([-east, -north, np.ones(len(east))], axis=1) / np.sqrt(1.0 + east**2 + north**2)[:, None]
    half = raster.cell_m / 2.0
    position_m = raster.positions_m(cells.row, cells.col)
    east, north = raster.hills.slopes(position_m[0] + half, position_m[1] + half)
    beside = np.stack([-east, -north, np.ones(len(east))], axis=1) / np.sqrt(1.0 + east**2 + north**2)[:, None]
    for fit, normals in (("central", expected), ("horn", expected), ("quad", beside)):
        np.testing.assert_allclose(cells.normals(fit) @ cells.frame_from_enu, normals, atol=3e-3)


def test_errors_are_shares_of_the_mean():
    errors = beam_errors(np.array([1.0, 2.0, 3.3]), np.array([1.0, 2.0, 3.0]))
    assert (errors.mean, errors.bias) == (pytest.approx(0.05), pytest.approx(0.05))
    assert errors.p95 == pytest.approx(0.135)


def test_figures_are_read_as_written_and_shown():
    errors = BeamErrors(0.0012, 0.01, -0.0003)
    results = Results(
        "here", 0.5, 1.5, {"GRASS": "8.2.1"}, {"SEBE": "is missing"}, [HillRow("total", 1000.0, 1e-4, 3e-4, -2e-5, 0.02, 0.01)],
        [RayRow("Essen", 1_000_000, 4810, 500.0, 60.0, 90.0, 400.0, errors, errors, errors)],
        [ToolRow("Essen", "21 March", "Skugga, 60 min", True, 1.0, 4.0, 5.0, 300.0, 4.2, errors)],
    )  # fmt: skip
    assert Results.read(json.loads(json.dumps(asdict(results)))) == results
    text = format_report(results)
    assert "| `total` | 1000 | 0.01 % | 0.03 % | -0.002 % |" in text
    assert "| Essen | 1,000,000 | 4,810 | 500 | 0.12 % | 1.00 % | -0.03 % |" in text
    assert "**Skugga, 60 min**" in text and "- SEBE: is missing." in text and "Load 0.5 before and 1.5 after" in text


def test_the_report_is_up_to_date():
    assert format_report(stored_results()) == REPORT.read_text("utf-8")
