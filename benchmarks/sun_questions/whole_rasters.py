"""The fourth and the fifth question: horizons and sky view factors of whole rasters, by several tools and by rays."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.peers.tools import run_process
from benchmarks.sun_questions.commands_and_rasters import SKUGGA_RASTER_COMMAND, QuestionDem, write_question_dem
from benchmarks.sun_questions.figures import SunAnswer
from benchmarks.sun_questions.one_horizon import flat_horizon, true_horizon

RASTER_HORIZONS_QUESTION = "horizons of a raster"
SKY_VIEW_QUESTION = "sky view of a raster"

AZIMUTH_COUNT = 72
"""Number of azimuths, clockwise from north."""

AZIMUTHS_DEG = 360.0 / AZIMUTH_COUNT * np.arange(AZIMUTH_COUNT)

FIRST_SAMPLE, SAMPLE_STRIDE = 5, 12
"""Of slow tools only the azimuths of these indices are measured, and their seconds are multiplied. None of them lies on an axis or
a diagonal of the grid."""

REACHES_CELLS = (10, 100)
"""Distances, in cells, up to which tools look that cannot look to the rim in a time that anybody waits. The first is the default of
RVT, xarray-spatial and SurtGIS."""

MARGIN_CELLS = 3
"""Width of the margin of a raster without sampled cells."""

WARM_UP_SIDE = 64
"""Side of the raster on which Skugga's loops are compiled before it is timed, in cells."""

PROGRAMS_FILE = Path(__file__).with_name("raster_programs.py")

SkyFormula = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""A function of horizons (n, azimuths), degrees, and rises of the ground per metre towards each azimuth in the cells' planes
(n, azimuths). It returns sky view factors (n,)."""


def solid_angle_sky(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the visible share of the sky's solid angle above a level plane, 1 - mean sin h."""
    return 1.0 - np.sin(np.radians(np.maximum(horizon_deg, 0.0))).mean(axis=1)


def cosine_sky(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the visible share of the sky weighted by the cosine of its zenith angle, mean cos^2 h (Oke)."""
    return (np.cos(np.radians(np.maximum(horizon_deg, 0.0))) ** 2).mean(axis=1)


def tilted_sky(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the visible share of the sky weighted by the cosine of its angle to the cell's own normal (Dozier and Frew 1990, 7b).

    The horizon is the greatest of the terrain's, the level one and that of the cell's plane.
    """
    plane_deg = np.degrees(np.arctan(rises))
    return _tilted_terms(np.maximum(np.maximum(horizon_deg, 0.0), plane_deg), rises).mean(axis=1)


def topocalc_sky(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the same with the horizon of terrain alone, and without the azimuths whose contribution is negative."""
    return np.maximum(_tilted_terms(np.maximum(horizon_deg, 0.0), rises), 0.0).mean(axis=1)


def saga_sky(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the same with the horizon of terrain alone."""
    return _tilted_terms(np.maximum(horizon_deg, 0.0), rises).mean(axis=1)


def _tilted_terms(horizon_deg: np.ndarray, rises: np.ndarray) -> np.ndarray:
    """Return the contribution of each azimuth to the sky of a tilted plane, relative to a whole sky over a level one."""
    zenith = np.radians(90.0 - horizon_deg)
    rises_sideways = np.roll(rises, -AZIMUTH_COUNT // 4, axis=1)
    normal_up = 1.0 / np.sqrt(1.0 + rises**2 + rises_sideways**2)
    # sin S cos(azimuth - aspect) of the paper is the normal's component towards the azimuth, -normal_up * rises
    return normal_up * (np.sin(zenith) ** 2 - rises * (zenith - np.sin(zenith) * np.cos(zenith)))


def plane_rises(height_m: np.ndarray, row: np.ndarray, col: np.ndarray, cell_m: float, side_weight: float) -> np.ndarray:
    """Return the rises (n, azimuths) of the ground per metre towards each azimuth, in planes fitted to n cells' neighbours.

    ``side_weight`` is the weight of the differences of the neighbouring rows and columns, relative to that of the cell's own: 0.5
    for Horn's planes, 0 for central differences.
    """
    shifts_and_weights = ((-1, side_weight), (0, 1.0), (1, side_weight))
    scale = 2.0 * cell_m * (1.0 + 2.0 * side_weight)
    heights = height_m.astype(np.float64)
    east = sum(w * (heights[row + i, col + 1] - heights[row + i, col - 1]) for i, w in shifts_and_weights) / scale
    north = sum(w * (heights[row - 1, col + i] - heights[row + 1, col + i]) for i, w in shifts_and_weights) / scale
    azimuth = np.radians(AZIMUTHS_DEG)
    return east[:, None] * np.sin(azimuth) + north[:, None] * np.cos(azimuth)


@dataclass(frozen=True)
class RayGround:
    """The ground that rays see.

    Attributes
    ----------
    is_earth_round
        Whether the earth is round.
    reach_cells
        Distance up to which ground counts in a flat world, cells; infinite for the raster's rim.
    cuts_lower
        Whether quads are cut along their lower diagonals (``exact_horizon``).
    extends_beyond_nodes
        Whether the outermost rows and columns go on for a cell beyond the outermost nodes.
    """

    is_earth_round: bool = False
    reach_cells: float = np.inf
    cuts_lower: bool = False
    extends_beyond_nodes: bool = False


class RasterTruth:
    """Horizons of rays at n random cells of a raster, degrees (n, azimuths). ``row`` and ``col`` (n,) are the cells."""

    def __init__(self, dem: QuestionDem, cells: int) -> None:
        self._dem = dem
        rng = np.random.default_rng(1)
        self.row, self.col = (rng.integers(MARGIN_CELLS, length - MARGIN_CELLS, cells) for length in dem.height_m.shape)
        self._horizons: dict[RayGround, np.ndarray] = {}

    def horizons_deg(self, ground: RayGround) -> np.ndarray:
        """Return horizons in a flat world towards azimuths from the grid's north, or on the round earth from true north."""
        if ground not in self._horizons:
            dem, rim = self._dem, 1 if ground.extends_beyond_nodes else 0
            dem = replace(dem, height_m=np.pad(dem.height_m, rim, mode="edge"))
            self._horizons[ground] = np.stack([
                true_horizon(dem, row, col, AZIMUTHS_DEG, ground.cuts_lower)
                if ground.is_earth_round
                else flat_horizon(dem, row, col, AZIMUTHS_DEG, ground.reach_cells, ground.cuts_lower)
                for row, col in zip(self.row + rim, self.col + rim, strict=True)
            ])  # fmt: skip
        return self._horizons[ground]

    @property
    def mean_cut_deg(self) -> float:
        """Mean difference of the horizons over quads that are cut along their higher and their lower diagonals, degrees."""
        return float(np.abs(self.horizons_deg(RayGround()) - self.horizons_deg(RayGround(cuts_lower=True))).mean())

    def rises(self, side_weight: float) -> np.ndarray:
        """Return the rises of the cells' planes (n, azimuths). See ``plane_rises``."""
        return plane_rises(self._dem.height_m, self.row, self.col, self._dem.cell_m, side_weight)

    def write_points(self, path: Path) -> None:
        """Write eastings and northings of the cells, a line each."""
        points = [self._dem.xy(row, col) for row, col in zip(self.row, self.col, strict=True)]
        path.write_text("".join(f"{x:.6f} {y:.6f}\n" for x, y in points), "utf-8")


SKUGGA_GROUND = RayGround(extends_beyond_nodes=True)
"""The ground of arrays in Skugga, by its documentation."""


@dataclass(frozen=True, eq=False)
class RasterTool:
    """A tool for a whole raster.

    Attributes
    ----------
    name, is_skugga
        Name with the settings, and whether it is part of Skugga.
    command
        Returns its command for a raster, an output file and a file of points (``RasterTruth.write_points``).
    suffix
        Suffix of its output file.
    formula
        Its sky view factor of horizons; ``None`` if it computes horizons.
    side_weight
        How it fits planes to cells (``plane_rises``).
    is_earth_round
        Whether it knows the curvature of the earth.
    is_clamped
        Whether its horizons are level where ground lies below.
    reach_cells
        How far it looks, in cells; infinite for the raster's rim.
    is_sampled
        Whether it computes only one in ``SAMPLE_STRIDE`` azimuths.
    writes_points
        Whether its output file holds the sampled cells alone.
    """

    name: str
    is_skugga: bool
    command: Callable[[QuestionDem, Path, Path], list[str]]
    suffix: str = ".npy"
    formula: SkyFormula | None = None
    side_weight: float = 0.5
    is_earth_round: bool = False
    is_clamped: bool = True
    reach_cells: float = np.inf
    is_sampled: bool = False
    writes_points: bool = False

    @property
    def azimuth_indices(self) -> np.ndarray:
        """Indices of the azimuths that it computes."""
        return np.arange(FIRST_SAMPLE, AZIMUTH_COUNT, SAMPLE_STRIDE) if self.is_sampled else np.arange(AZIMUTH_COUNT)

    def read(self, path: Path, truth: RasterTruth) -> np.ndarray:
        """Read its output file at the sampled cells: horizons (n, azimuths) in degrees, or sky view factors (n,)."""
        if path.suffix == ".tif":
            with rasterio.open(path) as dataset:
                return dataset.read(1)[truth.row, truth.col]
        values = np.load(path, mmap_mode="r")
        if self.writes_points:
            return np.asarray(values)
        return np.asarray(values[..., truth.row, truth.col]).T

    def errors(self, values: np.ndarray, truth: RasterTruth, ground: RayGround) -> np.ndarray:
        """Return the absolute errors of its answers at the sampled cells, degrees or per cent of the sky. Rays see ``ground``."""
        horizon_deg = truth.horizons_deg(ground)
        if self.formula is not None:
            return 100.0 * np.abs(values - self.formula(horizon_deg, truth.rises(self.side_weight)))
        horizon_deg = horizon_deg[:, self.azimuth_indices]
        return np.abs(values - (np.maximum(horizon_deg, 0.0) if self.is_clamped else horizon_deg))

    def errors_by_its_ground(self, values: np.ndarray, truth: RasterTruth, reach_cells: float = np.inf) -> np.ndarray:
        """Return its errors over its own ground.

        That is documented of Skugga. Of others it is the one of quads cut along their higher or lower diagonals that suits them.
        """
        if self.is_skugga:
            return self.errors(values, truth, SKUGGA_GROUND)
        grounds = [RayGround(self.is_earth_round, reach_cells, cuts_lower) for cuts_lower in (False, True)]
        return min((self.errors(values, truth, ground) for ground in grounds), key=np.mean)

    def errors_as_is(self, values: np.ndarray, truth: RasterTruth) -> np.ndarray | None:
        """Return its errors against horizons on the round earth over higher diagonals; ``None`` if it computes no horizons."""
        if self.formula is not None:
            return None
        ground = RayGround(is_earth_round=True, extends_beyond_nodes=self.is_skugga)
        return np.abs(values - truth.horizons_deg(ground)[:, self.azimuth_indices])


def horizon_raster_tools(python: str) -> list[RasterTool]:
    """Return all tools for horizons. Python packages are those of the interpreter ``python``."""
    count, sample = str(AZIMUTH_COUNT), [str(FIRST_SAMPLE), str(SAMPLE_STRIDE)]

    def package(name: str, program: str, is_sampled: bool = False, is_clamped: bool = True) -> RasterTool:
        return RasterTool(
            name, False,
            lambda dem, out, points: [
                python, str(PROGRAMS_FILE), program, str(dem.path), str(out), count, *(sample if is_sampled else []),
            ],
            is_clamped=is_clamped, is_sampled=is_sampled,
        )  # fmt: skip

    return [
        RasterTool(
            "Skugga horizons", True,
            lambda dem, out, points: [*SKUGGA_RASTER_COMMAND, "horizons", str(dem.path), str(out), count],
            is_clamped=False,
        ),
        package("topocalc", "topocalc_horizons"),
        package("SurtGIS horizon_angle_map", "surtgis_horizons", is_sampled=True),
        package("Whitebox horizon_angle", "whitebox_horizons", is_sampled=True, is_clamped=False),
        RasterTool(
            "GRASS r.horizon", False,
            lambda dem, out, points: [*grass_command(dem), "r.horizon", str(dem.path), str(out), count, str(points)],
            is_earth_round=True, is_clamped=False, writes_points=True,
        ),
    ]  # fmt: skip


def grass_command(dem: QuestionDem) -> list[str]:
    """Return the command that runs a program of GRASS in a session of its own."""
    return ["grass", "--tmp-location", str(dem.path), "--exec", sys.executable, str(PROGRAMS_FILE)]


def sky_view_tools(python: str) -> list[RasterTool]:
    """Return all tools for sky view factors. Python packages are those of the interpreter ``python``."""
    count = str(AZIMUTH_COUNT)

    def skugga(kind: str, formula: SkyFormula) -> RasterTool:
        return RasterTool(
            f"Skugga sky_view, {kind}", True,
            lambda dem, out, points: [*SKUGGA_RASTER_COMMAND, "sky_view", str(dem.path), str(out), count, kind],
            formula=formula, side_weight=0.0,
        )  # fmt: skip

    def package(name: str, program: str, formula: SkyFormula, reach_cells: int | None = None) -> RasterTool:
        arguments = [] if reach_cells is None else [str(reach_cells)]
        return RasterTool(
            name if reach_cells is None else f"{name}, {reach_cells} cells", False,
            lambda dem, out, points: [python, str(PROGRAMS_FILE), program, str(dem.path), str(out), count, *arguments],
            formula=formula, reach_cells=np.inf if reach_cells is None else reach_cells,
        )  # fmt: skip

    def saga(name: str, method: str) -> RasterTool:
        return RasterTool(
            f"SAGA Sky View Factor, {name}", False,
            lambda dem, out, points: [
                "saga_cmd", "-f=s", "ta_lighting", "3", "-DEM", str(dem.path), "-VISIBLE", str(out.with_name("visible.tif")),
                "-SVF", str(out), "-RADIUS", "0", "-NDIRS", count, "-METHOD", method,
            ],
            suffix=".tif", formula=saga_sky, side_weight=0.0,
        )  # fmt: skip

    return [
        skugga("solid_angle", solid_angle_sky),
        skugga("cosine", cosine_sky),
        skugga("tilted", tilted_sky),
        RasterTool(
            "GRASS r.skyview", False,
            lambda dem, out, points: [*grass_command(dem), "r.skyview", str(dem.path), str(out), count],
            suffix=".tif", formula=solid_angle_sky, is_earth_round=True,
        ),
        saga("cell size", "0"),
        saga("multi scale", "1"),
        package("topocalc viewf", "topocalc_sky_view", topocalc_sky),
        *(package("xarray-spatial", "xrspatial_sky_view", solid_angle_sky, reach) for reach in REACHES_CELLS),
        *(package("RVT", "rvt_sky_view", solid_angle_sky, reach) for reach in REACHES_CELLS),
        *(package("SurtGIS", "surtgis_sky_view", cosine_sky, reach) for reach in REACHES_CELLS),
    ]  # fmt: skip


def measure_raster(
    question: str, tools: list[RasterTool], dem: QuestionDem, truth: RasterTruth, left_out: dict[str, str]
) -> Iterator[SunAnswer]:
    """Measure tools on a raster, one run each, and yield their results.

    Tools that fail are added to ``left_out`` with the reason. An untimed run of Skugga's commands compiles the loops first.
    """
    points = dem.path.with_name("points.txt")
    truth.write_points(points)
    part = np.ascontiguousarray(dem.height_m[:WARM_UP_SIDE, :WARM_UP_SIDE])
    warm_up_dem = write_question_dem("warm up", part, dem.cell_m, dem.crs, dem.middle_m[1], dem.path.parent)
    for tool in tools:
        out = dem.path.with_name(f"result{tool.suffix}")
        try:
            if tool.is_skugga:
                run_process(tool.command(warm_up_dem, out, points), out)
            run = run_process(tool.command(dem, out, points), out)
        except RuntimeError as error:
            left_out[tool.name] = str(error)
            continue
        values = tool.read(out, truth)
        errors = tool.errors_by_its_ground(values, truth)
        in_reach = None if np.isinf(tool.reach_cells) else tool.errors_by_its_ground(values, truth, tool.reach_cells)
        as_is = tool.errors_as_is(values, truth)
        out.unlink()
        compute_s = run.compute_s or 0.0
        unmeasured_s = compute_s * (AZIMUTH_COUNT / len(tool.azimuth_indices) - 1.0)
        yield SunAnswer(
            question, dem.name, tool.name, tool.is_skugga, None if run.compute_s is None else compute_s + unmeasured_s,
            run.wall_s + unmeasured_s, run.cpu_s + unmeasured_s * run.cores,
            float(errors.mean()), float(np.percentile(errors, 99)),
            None if as_is is None else float(as_is.mean()), tool.is_sampled,
            None if in_reach is None else float(in_reach.mean()), run.peak_mb,
        )  # fmt: skip
