"""The second question: the horizon at a point, by several tools, and the exact horizon of the ground towards each azimuth."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pyproj import Geod, Transformer

from benchmarks.peers.tools import run_process
from benchmarks.sun_questions.commands_and_rasters import DATE, PROGRAMS_FILE, SKUGGA_COMMAND, SKUGGA_PYTHON, QuestionDem
from benchmarks.sun_questions.figures import SunAnswer

HORIZON_QUESTION = "horizon at a point"

AZIMUTH_STEP_DEG = 0.5
"""Degrees between two directions of a horizon of 720 directions."""

TOPOCALC_AZIMUTH_STEP_DEG = 15.0
"""Degrees between two directions of topocalc, which computes a whole raster for each direction. Its seconds are scaled to 720
directions."""

BEARING_DISTANCE_M = 20_000.0
"""Distance of the second point by which a true azimuth is converted to a direction of the grid."""

WGS84_AXES_M = (6_378_137.0, 6_356_752.314245)

EPSILON = 1e-9
"""Distances in columns, and components of a direction, below this count as zero."""

MARGIN_SHARE = 0.15
"""Minimum distance of points from the rim, as a share of the raster's sides."""

MAX_WALL_DISTANCE_CELLS = 15
"""Maximum distance of the walls on both sides of a street, cells."""


def exact_horizon(
    height_m: np.ndarray,
    row: int,
    col: int,
    col_direction: float,
    row_direction: float,
    cell_m: float,
    radius_m: float = np.inf,
    reach_cells: float = np.inf,
    cuts_lower: bool = False,
) -> float:
    """Return the exact horizon angle of a node in a direction, degrees.

    ``height_m`` are the heights of nodes (rows, cols). ``col_direction`` and ``row_direction`` are the unit vector of the direction
    in columns and rows. A column is ``cell_m`` metres wide, and ``radius_m`` is the earth's radius R. Ground counts up to the rim,
    at most ``reach_cells`` away; where there is none the horizon is level. Quads are cut along their higher diagonals, with
    ``cuts_lower`` along the lower ones. The result uses every crossing of the direction with edges of triangles: rows, columns and
    both diagonals of quads. Only one diagonal is an edge; crossings with the other do no harm. At a distance s, the tangent of the
    angle of a point of height h is ((R + h) cos(s/R) - (R + h0)) / ((R + h) sin(s/R)), where h0 is the height of the node.
    """
    rows, cols = height_m.shape
    rim_distances = [
        ((length - 1 - at) if rate > 0 else -at) / rate
        for at, rate, length in ((col, col_direction, cols), (row, row_direction, rows))
        if rate
    ]
    end = min([*rim_distances, reach_cells])
    crossing_rates = [
        abs(rate)
        for rate in (col_direction, row_direction, col_direction - row_direction, col_direction + row_direction)
        if abs(rate) > EPSILON
    ]
    crossings = np.concatenate([np.arange(1.0, np.floor(end * rate + EPSILON) + 1.0) / rate for rate in crossing_rates])
    if not len(crossings):
        return 0.0
    z_m = triangle_heights_m(height_m, row + crossings * row_direction, col + crossings * col_direction, cuts_lower)
    distance_m, z0_m = crossings * cell_m, float(height_m[row, col])
    if np.isinf(radius_m):
        return float(np.degrees(np.arctan(((z_m - z0_m) / distance_m).max())))
    angle = distance_m / radius_m
    # (R + h) cos a - (R + h0), without cancellation of two large numbers
    rise_m = (z_m - z0_m) - (radius_m + z_m) * 2.0 * np.sin(angle / 2.0) ** 2
    return float(np.degrees(np.arctan((rise_m / ((radius_m + z_m) * np.sin(angle))).max())))


def triangle_heights_m(height_m: np.ndarray, row: np.ndarray, col: np.ndarray, cuts_lower: bool = False) -> np.ndarray:
    """Return the heights (n,) of a triangle mesh at fractional rows and columns.

    The triangles join nodes (rows, cols). Quads are cut along their higher diagonals, with ``cuts_lower`` along the lower ones.
    """
    rows, cols = height_m.shape
    r0, c0 = np.clip(np.floor(row).astype(int), 0, rows - 2), np.clip(np.floor(col).astype(int), 0, cols - 2)
    nw, ne, sw, se = (height_m[r0 + i, c0 + j].astype(np.float64) for i in (0, 1) for j in (0, 1))
    u, v = col - c0, row - r0
    falling = np.where(v <= u, nw + u * (ne - nw) + v * (se - ne), nw + v * (sw - nw) + u * (se - sw))
    rising = np.where(u + v <= 1.0, nw + u * (ne - nw) + v * (sw - nw), se + (1.0 - u) * (sw - se) + (1.0 - v) * (ne - se))
    is_falling_higher = nw + se > ne + sw
    return np.where(is_falling_higher ^ cuts_lower, falling, rising)


def true_horizon(dem: QuestionDem, row: int, col: int, azimuth_deg: np.ndarray, cuts_lower: bool = False) -> np.ndarray:
    """Return the horizon angles (n,) towards azimuths from true north on the round earth, degrees.

    Ground counts up to the raster's rim. ``cuts_lower`` is explained in ``exact_horizon``.
    """
    to_degrees = Transformer.from_crs(dem.crs, "EPSG:4326", always_xy=True)
    x, y = dem.xy(row, col)
    lon, lat = to_degrees.transform(x, y)
    count = len(azimuth_deg)
    bearing_points = Geod(ellps="WGS84").fwd(
        np.full(count, lon), np.full(count, lat), azimuth_deg, np.full(count, BEARING_DISTANCE_M)
    )
    east, north = np.array(to_degrees.transform(*bearing_points[:2], direction="INVERSE")) - np.array([[x], [y]])
    length = np.hypot(east, north)
    radius = _radius_m(lat, azimuth_deg)
    return np.array([
        exact_horizon(
            dem.height_m, row, col, e, -n, dem.cell_m * BEARING_DISTANCE_M / step_length, r, cuts_lower=cuts_lower
        )
        for e, n, step_length, r in zip(east / length, north / length, length, radius, strict=True)
    ])  # fmt: skip


def flat_horizon(
    dem: QuestionDem, row: int, col: int, azimuth_deg: np.ndarray, reach_cells: float = np.inf, cuts_lower: bool = False
) -> np.ndarray:
    """Return the horizon angles (n,) towards azimuths from the grid's north in a flat world, degrees.

    ``reach_cells`` and ``cuts_lower`` are explained in ``exact_horizon``.
    """
    azimuth = np.radians(azimuth_deg)
    return np.array([
        exact_horizon(dem.height_m, row, col, right, down, dem.cell_m, reach_cells=reach_cells, cuts_lower=cuts_lower)
        for right, down in zip(np.sin(azimuth), -np.cos(azimuth), strict=True)
    ])  # fmt: skip


def _radius_m(lat_deg: float, azimuth_deg: np.ndarray) -> np.ndarray:
    """Return the ellipsoid's radius of curvature towards azimuths, metres (Euler's formula)."""
    a, b = WGS84_AXES_M
    e2, lat, azimuth = 1.0 - (b / a) ** 2, np.radians(lat_deg), np.radians(azimuth_deg)
    w2 = 1.0 - e2 * np.sin(lat) ** 2
    meridian, prime = a * (1.0 - e2) / w2**1.5, a / np.sqrt(w2)
    return 1.0 / (np.cos(azimuth) ** 2 / meridian + np.sin(azimuth) ** 2 / prime)


def points_by_kind(dem: QuestionDem) -> dict[str, tuple[int, int]]:
    """Return row and column of points by kind, away from the rim.

    In mountains the points are the highest, the lowest and the steepest cell. In a city the point is a cell in a street, between
    walls in the west and in the east.
    """
    rows, cols = dem.height_m.shape
    top, left = int(rows * MARGIN_SHARE), int(cols * MARGIN_SHARE)
    inner = dem.height_m[top : rows - top, left : cols - left].astype(np.float64)

    def cell_of_max(values: np.ndarray) -> tuple[int, int]:
        row, col = np.unravel_index(int(np.argmax(values)), values.shape)
        return top + int(row), left + int(col)

    if dem.name == "Essen":
        wall_heights_m = [
            np.max([np.roll(inner, side * n, axis=1) for n in range(3, MAX_WALL_DISTANCE_CELLS)], axis=0) - inner
            for side in (-1, 1)
        ]
        lower_wall_m = np.minimum(*wall_heights_m)
        lower_wall_m[:, :MAX_WALL_DISTANCE_CELLS] = lower_wall_m[:, -MAX_WALL_DISTANCE_CELLS:] = 0.0
        return {"street": cell_of_max(lower_wall_m)}
    down, right = np.gradient(inner)
    return {"summit": cell_of_max(inner), "valley": cell_of_max(-inner), "slope": cell_of_max(np.hypot(down, right))}


@dataclass(frozen=True, eq=False)
class HorizonTool:
    """A tool and how to run it.

    Attributes
    ----------
    name
        Name with the settings.
    is_skugga
        Whether it is part of Skugga.
    command
        Returns its command for a raster, an output file and a point (x, y).
    read_horizon
        Reads its output file into azimuths and horizon angles (2, n), degrees.
    true_horizon
        Returns the horizon with which it is compared.
    suffix
        Suffix of its output file.
    direction_share
        Number of directions that its command computes, as a share of 720.
    full_command
        Returns the command of the whole process, if ``command`` only measures computing; else ``None``.
    """

    name: str
    is_skugga: bool
    command: Callable[[QuestionDem, Path, tuple[float, float]], list[str]]
    read_horizon: Callable[[Path], np.ndarray]
    true_horizon: Callable[[QuestionDem, int, int, np.ndarray], np.ndarray]
    suffix: str = ".npy"
    direction_share: float = 1.0
    full_command: Callable[[QuestionDem, Path, tuple[float, float]], list[str]] | None = None


def horizon_tools(python: str) -> list[HorizonTool]:
    """Return all tools. Python packages are those of the interpreter ``python``."""
    programs_file = str(PROGRAMS_FILE)

    def read_grass_horizon(path: Path) -> np.ndarray:
        direction, angle = np.loadtxt(path, delimiter=",", skiprows=1).T
        return np.stack([(90.0 - direction) % 360.0, angle])

    def format_xy(xy: tuple[float, float]) -> list[str]:
        return [f"{value:.9f}" for value in xy]

    def grass_tool(distance: str) -> HorizonTool:
        return HorizonTool(
            f"GRASS r.horizon, distance={distance}", False,
            lambda dem, out, xy: ["grass", "--tmp-location", str(dem.path), "--exec", sys.executable, programs_file, "r.horizon",
                                  str(dem.path), str(out), *format_xy(xy), f"{AZIMUTH_STEP_DEG:g}", distance],
            read_grass_horizon, true_horizon, ".csv",
        )  # fmt: skip

    return [
        HorizonTool(
            "Skugga", True,
            lambda dem, out, xy: [*SKUGGA_PYTHON, programs_file, "point", str(dem.path), str(out), *format_xy(xy)],
            np.load, true_horizon,
            full_command=lambda dem, out, xy: [*SKUGGA_COMMAND, "point", str(dem.path), "--at", ",".join(format_xy(xy)), "--crs",
                                        dem.crs, "--date", DATE, "--horizon", "pvlib", "-o", str(out.with_suffix(".csv"))],
        ),
        grass_tool("1"),
        grass_tool("0.5"),
        HorizonTool(
            "topocalc", False,
            lambda dem, out, xy: [
                python, programs_file, "topocalc", str(dem.path), str(out), *format_xy(xy), f"{TOPOCALC_AZIMUTH_STEP_DEG:g}",
            ],
            np.load, flat_horizon, direction_share=AZIMUTH_STEP_DEG / TOPOCALC_AZIMUTH_STEP_DEG,
        ),
    ]  # fmt: skip


def measure_horizons(tools: list[HorizonTool], dem: QuestionDem, repeats: int, left_out: dict[str, str]) -> Iterator[SunAnswer]:
    """Measure tools at the points of a raster, and yield their results with median seconds.

    Tools that fail are added to ``left_out`` with the reason. An untimed run of Skugga's commands compiles the loops first.
    """
    for tool in tools:
        if tool.full_command is not None:
            out, xy = dem.path.with_name(f"horizon{tool.suffix}"), dem.xy(*(length // 2 for length in dem.height_m.shape))
            run_process(tool.command(dem, out, xy), out)
            run_process(tool.full_command(dem, out, xy), out.with_suffix(".csv"))
    for place, (row, col) in points_by_kind(dem).items():
        for tool in tools:
            out = dem.path.with_name(f"horizon{tool.suffix}")
            try:
                runs = [
                    run_process(tool.command(dem, out, dem.xy(row, col)), out)
                    for _ in range(repeats if tool.direction_share == 1.0 else 1)
                ]
                whole_runs = runs
                if tool.full_command is not None:
                    csv_file = out.with_suffix(".csv")
                    whole_runs = [run_process(tool.full_command(dem, out, dem.xy(row, col)), csv_file) for _ in range(repeats)]
            except RuntimeError as error:
                left_out[tool.name] = str(error)
                continue
            azimuth, angle = tool.read_horizon(out)
            error_deg = np.abs(angle - tool.true_horizon(dem, row, col, azimuth))
            error_as_is_deg = np.abs(angle - true_horizon(dem, row, col, azimuth))
            compute_s = float(np.median([run.compute_s for run in runs if run.compute_s is not None]))
            unmeasured_s = compute_s * (1.0 / tool.direction_share - 1.0)
            yield SunAnswer(
                HORIZON_QUESTION, f"{dem.name}, {place}", tool.name, tool.is_skugga, compute_s + unmeasured_s,
                float(np.median([run.wall_s for run in whole_runs])) + unmeasured_s,
                float(np.median([run.cpu_s for run in whole_runs])) + unmeasured_s,
                float(error_deg.mean()), float(np.percentile(error_deg, 99)), float(error_as_is_deg.mean()),
                tool.direction_share < 1.0,
            )  # fmt: skip
