"""The third question: 31 masks of a day as GeoTIFF.

It compares one run of Skugga for all masks, a run of Skugga for each mask, and runs of other tools.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import rasterio

from benchmarks.peers.tools import Tool, ToolJob, ToolRun, make_tools, run_process
from benchmarks.sun_hours_accuracy import CellRays
from benchmarks.sun_questions.commands_and_rasters import SKUGGA_COMMAND, QuestionDem
from benchmarks.sun_questions.figures import SunAnswer
from skugga.api.products.mask import MASK_LIT
from skugga.api.raster_view import raster_view
from skugga.terrain.gbuffer.bare_nodes import bare_nodes
from skugga.terrain.geo.sun import direction_enu
from skugga.terrain.geo.sun_path import sun_path
from skugga.terrain.ground.sheet import sheet_of
from skugga.terrain.level.level import load_level
from skugga.terrain.scene import build_scene

MASKS_QUESTION = "31 masks of a day"

MASK_COUNT, MASK_STEP_MIN, FIRST_MASK_FROM_NOON_MIN = 31, 23, -345
"""Number of masks, minutes between two masks, and minutes from mean noon to the first mask."""

SAMPLING_INTERVAL, SAMPLING_INTERVAL_BY_TOOL = 3, {"Whitebox Workflows": 5}
"""Only one in this many single-mask runs is measured, and its seconds are multiplied. The dictionary holds exceptions by tool."""

PEER_NAMES = ("insolation", "solweig", "Whitebox Workflows", "gdaldem hillshade")
"""Names of the compared tools in ``benchmarks.peers.tools``."""

ALTITUDE_TOLERANCE_DEG = 0.01
"""Change of the sun's altitude, degrees. Truth in a cell is certain if a sun lower and a sun higher by this give the same
result."""

MARGIN_CELLS = 3
"""Width of the margin of a raster without sampled cells."""


def mask_times(lon_deg: float) -> list[datetime]:
    """Return the times of the masks on 21 March, UTC, around the mean noon of a longitude."""
    noon = datetime(2024, 3, 21, 12, tzinfo=UTC) - timedelta(minutes=round(4.0 * lon_deg))
    return [noon + timedelta(minutes=FIRST_MASK_FROM_NOON_MIN + n * MASK_STEP_MIN) for n in range(MASK_COUNT)]


@dataclass(frozen=True, eq=False)
class MaskTruth:
    """Truth at n sampled cells (``row``, ``col``) for each time.

    Masks are bool (times, n): whether the sun is visible (``lit``), and whether that is certain (``certain``). The prefix
    ``round_`` marks masks with each cell's own solar position on the round earth. The prefix ``flat_`` marks masks in a flat world
    with the sun's angles at each time (``azimuth_deg``, ``altitude_deg``), which are the input of other tools.
    """

    row: np.ndarray
    col: np.ndarray
    azimuth_deg: np.ndarray
    altitude_deg: np.ndarray
    round_lit: np.ndarray
    round_certain: np.ndarray
    flat_lit: np.ndarray
    flat_certain: np.ndarray


def trace_mask_truth(dem: QuestionDem, times: list[datetime], cells: int) -> MaskTruth:
    """Trace the truth of all masks with rays at ``cells`` random cells. ``times`` are those of the masks."""
    rows, cols = dem.height_m.shape
    rng = np.random.default_rng(1)
    row, col = (rng.integers(MARGIN_CELLS, length - MARGIN_CELLS, cells) for length in (rows, cols))
    scene = build_scene(load_level(dem.path))
    world = scene.world
    path = sun_path(times, world.anchor_lon_deg, world.anchor_lat_deg)
    view = raster_view(scene).view.with_pixels_as_nodes()
    frame = bare_nodes(scene, view, 1).frame
    nodes = np.empty((rows, cols, 3))
    nodes[..., 0], nodes[..., 1] = np.arange(cols) * dem.cell_m, -np.arange(rows)[:, None] * dem.cell_m
    nodes[..., 2] = dem.height_m
    start = nodes[row, col]
    flat_rays = CellRays(sheet_of(nodes), start, np.broadcast_to(np.array([0.0, 0.0, 1.0]), start.shape))
    round_rays = CellRays.from_cells(scene, view, row, col)

    def sun_directions_enu(step_deg: float) -> np.ndarray:
        pairs = zip(path.azimuth_deg, path.altitude_deg + step_deg, strict=True)
        return np.stack([direction_enu(*pair) for pair in pairs])

    def lit_on_round_earth(step_deg: float) -> np.ndarray:
        towards = frame.directions_from_earth(sun_directions_enu(step_deg) @ world.earth_from_anchor.T)
        return np.stack([round_rays.sun_visible(direction) for direction in towards])

    def lit_in_flat_world(step_deg: float) -> np.ndarray:
        return np.stack([flat_rays.sun_visible(direction) for direction in sun_directions_enu(step_deg)])

    masks = []
    for trace_lit in (lit_on_round_earth, lit_in_flat_world):
        lower, nominal, higher = (trace_lit(step) for step in (-ALTITUDE_TOLERANCE_DEG, 0.0, ALTITUDE_TOLERANCE_DEG))
        masks += [nominal, lower == higher]
    scene.close()
    return MaskTruth(row, col, path.azimuth_deg, path.altitude_deg, *masks)


def wrong_share(lit: np.ndarray, truth: np.ndarray, certain: np.ndarray) -> float:
    """Return the share of wrong results among the cells with certain truth. All masks have the same shape."""
    return float((certain & (lit != truth)).sum() / certain.sum())


def measure_masks(python: str, dem: QuestionDem, cells: int, left_out: dict[str, str]) -> Iterator[SunAnswer]:
    """Measure Skugga and other tools, and yield their results, with errors in ``cells`` sampled cells.

    Tools that fail are added to ``left_out`` with the reason.
    """
    times = mask_times(dem.lon_lat[0])
    truth = trace_mask_truth(dem, times, cells)
    yield from _measure_skugga(dem, times, truth)
    for tool in make_tools(python):
        if tool.name in PEER_NAMES and tool.installed_version() is not None:
            try:
                yield from _measure_peer(tool, dem, truth)
            except RuntimeError as error:
                left_out[tool.name] = str(error)


def _measure_skugga(dem: QuestionDem, times: list[datetime], truth: MaskTruth) -> Iterator[SunAnswer]:
    """Measure one run for all masks, and a run for each mask. An untimed run compiles the loops first."""
    begin, end = (time.strftime("%Y-%m-%dT%H:%M:%SZ") for time in (times[0], times[-1]))
    mask_files = [dem.path.with_name(f"mask_{time.strftime('%Y%m%dT%H%M%SZ')}.tif") for time in times]
    shade_command = [*SKUGGA_COMMAND, "shade", str(dem.path), "-o", str(dem.path.with_name("mask_{time}.tif"))]
    single_command = [*shade_command[:-1], str(dem.path.with_name("mask.tif")), "--time"]
    run_process([*single_command, begin], dem.path.with_name("mask.tif"))
    single_run = run_process([*shade_command, "--from", begin, "--to", end, "--step", f"{MASK_STEP_MIN}m"], mask_files[-1])
    lit = np.stack([_read_and_delete(mask_file, truth, lambda values: values == MASK_LIT) for mask_file in mask_files])
    error_share = wrong_share(lit, truth.round_lit, truth.round_certain)
    yield _mask_answer(dem, "Skugga shade, one run", True, [single_run], error_share, error_share)
    sampled_times = times[SAMPLING_INTERVAL // 2 :: SAMPLING_INTERVAL]
    runs = [
        run_process([*single_command, time.strftime("%Y-%m-%dT%H:%M:%SZ")], dem.path.with_name("mask.tif"))
        for time in sampled_times
    ]
    yield _mask_answer(
        dem, f"Skugga shade, {MASK_COUNT} runs", True, runs, error_share, error_share, MASK_COUNT / len(sampled_times)
    )


def _measure_peer(tool: Tool, dem: QuestionDem, truth: MaskTruth) -> Iterator[SunAnswer]:
    """Measure single-mask runs of a tool, and yield an answer scaled to all masks. Raises ``RuntimeError`` if a run fails.

    If the tool reports its time of computing, yield a second answer: one start of the process and the computing of all masks.
    """
    interval = SAMPLING_INTERVAL_BY_TOOL.get(tool.name, SAMPLING_INTERVAL)
    runs, mask_samples, indices = [], [], list(range(interval // 2, MASK_COUNT, interval))
    for n in indices:
        job = ToolJob(dem.path, float(truth.azimuth_deg[n]), float(truth.altitude_deg[n]), dem.path.with_name("mask.tif"))
        runs.append(tool.run(job))
        if tool.decode_mask is not None:
            mask_samples.append(tool.read_mask(job)[truth.row, truth.col])
    error_share = error_as_is = None
    if mask_samples:
        lit_stack = np.stack(mask_samples)
        error_share = wrong_share(lit_stack, truth.flat_lit[indices], truth.flat_certain[indices])
        error_as_is = wrong_share(lit_stack, truth.round_lit[indices], truth.round_certain[indices])
    seconds_factor = MASK_COUNT / len(indices)
    yield _mask_answer(dem, f"{tool.name}, {MASK_COUNT} runs", False, runs, error_share, error_as_is, seconds_factor)
    computing = [run.compute_s for run in runs if run.compute_s is not None]
    if len(computing) == len(runs):
        fastest_start = min(runs, key=lambda run: run.wall_s - (run.compute_s or 0.0))
        compute_s, overhead_s = sum(computing) * seconds_factor, fastest_start.wall_s - (fastest_start.compute_s or 0.0)
        yield SunAnswer(
            MASKS_QUESTION,
            dem.name,
            f"{tool.name}, one process at best",
            False,
            None,
            overhead_s + compute_s,
            None,
            error_share,
            None,
            error_as_is,
            True,
        )


def _mask_answer(
    dem: QuestionDem,
    name: str,
    is_skugga: bool,
    runs: list[ToolRun],
    error_share: float | None,
    error_as_is: float | None,
    seconds_factor: float = 1.0,
) -> SunAnswer:
    """Return an answer with the summed times of ``runs``, multiplied by ``seconds_factor``.

    ``name`` is the tool with its way of running. Errors are shares of the cells with certain truth, by the tool's own world and by
    the round earth. They are ``None`` if the tool casts no shadows.
    """
    wall_s, cpu_s = (seconds_factor * sum(getattr(run, cost) for run in runs) for cost in ("wall_s", "cpu_s"))
    return SunAnswer(
        MASKS_QUESTION, dem.name, name, is_skugga, None, wall_s, cpu_s, error_share, None, error_as_is, seconds_factor > 1.0
    )


def _read_and_delete(path: Path, truth: MaskTruth, decode_mask: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Read a mask file and delete it. Return whether the sun is visible, bool (n,), in the sampled cells.

    ``decode_mask`` converts the file's values (rows, cols) to that mask.
    """
    with rasterio.open(path) as dataset:
        values = decode_mask(dataset.read(1))[truth.row, truth.col]
    os.unlink(path)
    return values
