"""Accuracy of the line sweep on real rasters against traced rays, at azimuths off the 45-degree axes.

    python -m benchmarks.sweep_accuracy FOLDER [--azimuths 24] [--altitudes 3 10 30] [--lines 8] [--crop 1024]
                                        [--processes 2] [--markdown FILE]
    python -m benchmarks.sweep_accuracy FOLDER --all-azimuths NAME [--altitudes 10] [--crop 512]

The middle of every raster of heights below FOLDER becomes an array in a flat world. Its holes are filled as for shadow casting, and
its cells have the size of the cells at its middle latitude. Truth is traced with rays from the nodes. Quads are cut along their
higher diagonals, as in the sweep. Nodes count if truth does not depend on the rays' offset from the ground. ``--all-azimuths``
measures the azimuths 0 to 359 degrees on the raster of that name. The stored table is docs/reports/sweep-accuracy.md.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from skugga.shadows.sweep.grid import sunlit_nodes
from skugga.shadows.truth.metrics import MIN_INTERIOR_DISTANCE_PX, interior_error_mask
from skugga.terrain.casters.rays import RayScene
from skugga.terrain.errors import SkuggaError
from skugga.terrain.geo.world import WGS84
from skugga.terrain.ground.elevation import Elevation
from skugga.terrain.ground.sheet import Sheet, sheet_of

EXCLUDED_NAME_PARTS = ("landcover", "rgb")
"""Parts of the names of rasters that do not hold heights."""

NODE_OFFSET_FACTOR = 1.0 / 8.0
"""Offset of a node's rays, as a multiple of the offset in ``skugga.terrain.casters.rays``. It is smaller, because nodes are
vertices of the triangles, with the same rounding to float32.
"""

ALTITUDE_TOLERANCE_DEG = 0.01
"""Change of the sun's altitude, a fiftieth of its disc. Truth is certain only if it does not depend on this change."""

BATCH_RAYS = 1 << 20
"""Number of rays that are traced at a time."""


@dataclass(frozen=True, eq=False)
class Raster:
    """A raster of heights in a flat world.

    Attributes
    ----------
    name
        Its name.
    height_m
        Heights, float32 (rows, cols), NaN without data.
    valid
        Mask of cells with data, bool (rows, cols).
    cell_m
        Height and width of a cell, metres.
    """

    name: str
    height_m: np.ndarray
    valid: np.ndarray
    cell_m: tuple[float, float]

    @property
    def steepest_deg(self) -> float:
        """The angle of the steepest step from a cell to a neighbour, degrees."""
        steps = (np.abs(np.diff(self.height_m, axis=axis)) / self.cell_m[axis] for axis in (0, 1))
        return float(np.degrees(np.arctan(max(np.nanmax(step, initial=0.0) for step in steps))))


@dataclass(frozen=True, eq=False)
class GridTruth:
    """Truth by rays at a grid's nodes under one sun; bool arrays (rows, cols), False without ground.

    Attributes
    ----------
    lit
        Whether the sun is visible, with quads cut along their higher diagonals as in the sweep.
    certain
        Where ``lit`` is certain.
    certain_for_any_cut
        Where ``lit`` is certain and the same along either diagonal, for tools that cut quads differently.
    """

    lit: np.ndarray
    certain: np.ndarray
    certain_for_any_cut: np.ndarray


@dataclass(frozen=True)
class SweepFigures:
    """Errors of the sweep on one raster under one sun.

    Attributes
    ----------
    raster
        Name of the raster.
    azimuth_deg, altitude_deg
        The sun's angles.
    cells
        Number of decided cells: cells with data and with certain truth.
    shadow
        Share of the decided cells that are in shadow.
    wrong, false_shadow, missed_shadow
        Shares of the decided cells that are wrong in any way, lit in truth but in shadow, and in shadow in truth but lit.
    interior
        Share of the decided cells that are wrong away from shadow edges.
    undecided
        Share of the cells with data whose truth is not certain.
    """

    raster: str
    azimuth_deg: float
    altitude_deg: float
    cells: int
    shadow: float
    wrong: float
    false_shadow: float
    missed_shadow: float
    interior: float
    undecided: float


class GridRays:
    """Rays against the triangles of a heightfield (rows, cols), with quads cut along the higher or along the lower diagonal.

    The outermost heights are repeated one cell further out, as in ``sunlit_nodes``.
    """

    def __init__(self, height_m: np.ndarray, cell_m: tuple[float, float]) -> None:
        padded = np.pad(height_m, 1, mode="edge")
        row, col = np.indices(padded.shape) - 1
        nodes = np.stack([col * cell_m[1], -row * cell_m[0], padded.astype(np.float64)], axis=-1)
        self._nodes = nodes[1:-1, 1:-1].reshape(-1, 3)
        self._valid = np.isfinite(height_m)
        sheet = sheet_of(nodes)
        self._rays_higher_diagonals, self._rays_lower_diagonals = RayScene([sheet]), RayScene([Sheet(nodes, ~sheet.is_cut_nw_se)])

    def truth(self, azimuth_deg: float, altitude_deg: float) -> GridTruth:
        """Return whether each node sees a sun (azimuth clockwise from north, degrees), and where that is certain.

        A node is on the surface for either diagonal of a quad. Its rays start at heights e and 4e above it. On a heightfield, a
        node that is lit at height e is lit at any greater height. A node in shadow at 4e is in shadow at any smaller height. So
        these two rays suffice. The rays miss casters that rise less than e above them, so e is small.

        A certain result must also be the same with the sun ``ALTITUDE_TOLERANCE_DEG`` lower and higher. Whole metres and equal
        cells make ties at some azimuths, which rounding decides.
        """
        lower, to_sun, higher = (
            _sun_direction(azimuth_deg, altitude_deg + step) for step in (-ALTITUDE_TOLERANCE_DEG, 0.0, ALTITUDE_TOLERANCE_DEG)
        )
        valid = np.flatnonzero(self._valid)
        lit = self._sun_visible(self._rays_higher_diagonals, valid, to_sun, 1.0)
        light, dark = lit.copy(), ~lit
        light[light] = self._sun_visible(self._rays_higher_diagonals, valid[light], lower, 1.0)
        dark[dark] = ~self._sun_visible(self._rays_higher_diagonals, valid[dark], higher, 4.0)
        is_certain = light | dark
        light[light] = self._sun_visible(self._rays_lower_diagonals, valid[light], lower, 1.0)
        dark[dark] = ~self._sun_visible(self._rays_lower_diagonals, valid[dark], higher, 4.0)
        return GridTruth(*(self._as_grid(valid, values) for values in (lit, is_certain, light | dark)))

    def _sun_visible(self, rays: RayScene, nodes: np.ndarray, to_sun: np.ndarray, offset_factor: float) -> np.ndarray:
        """Return whether nodes see the sun, bool (n,).

        ``nodes`` (n,) are flat indices into the grid, and ``to_sun`` (3,) is the unit vector to the sun. Rays start
        ``offset_factor`` times the usual offset above the nodes.
        """
        visible = np.empty(len(nodes), bool)
        for first in range(0, len(nodes), BATCH_RAYS):
            batch = slice(first, first + BATCH_RAYS)
            start = self._nodes[nodes[batch]] + np.array([0.0, 0.0, offset_factor * NODE_OFFSET_FACTOR * rays.offset_m])
            visible[batch] = ~rays.is_blocked(start, to_sun)
        return visible

    def _as_grid(self, nodes: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return values (n,) of nodes, given by flat indices (n,), as a mask of the grid (rows, cols). Other nodes are False."""
        out = np.zeros(self._valid.shape, bool)
        out.flat[nodes] = values
        return out


def _sun_direction(azimuth_deg: float, altitude_deg: float) -> np.ndarray:
    """Return the unit vector (3,) to the sun: east, north, up."""
    azimuth, altitude = np.radians([azimuth_deg, altitude_deg])
    return np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])


def compare_with_truth(
    raster: Raster, lit: np.ndarray, truth: GridTruth, certain: np.ndarray, azimuth_deg: float, altitude_deg: float
) -> SweepFigures:
    """Compare a mask of nodes that see the sun, bool (rows, cols), with truth where ``certain`` (a mask of ``truth``) is set."""
    valid = np.isfinite(raster.height_m)
    decided = certain & raster.valid
    wrong_cells = decided & (lit != truth.lit)
    count = max(int(decided.sum()), 1)
    return SweepFigures(
        raster=raster.name,
        azimuth_deg=azimuth_deg,
        altitude_deg=altitude_deg,
        cells=int(decided.sum()),
        shadow=int((decided & ~truth.lit).sum()) / count,
        wrong=int(wrong_cells.sum()) / count,
        false_shadow=int((wrong_cells & truth.lit).sum()) / count,
        missed_shadow=int((wrong_cells & ~truth.lit).sum()) / count,
        interior=int(interior_error_mask(wrong_cells, ~truth.lit & valid, valid, MIN_INTERIOR_DISTANCE_PX).sum()) / count,
        undecided=float((~certain)[raster.valid].mean()),
    )


def read_rasters(folder: Path, crop: int) -> Iterator[Raster]:
    """Yield the rasters of heights below a folder, at most ``crop`` cells a side. Print the errors of unreadable rasters."""
    for path in sorted(folder.rglob("*.tif")):
        if any(word in path.stem.lower() for word in EXCLUDED_NAME_PARTS):
            continue
        try:
            yield read_raster(path, crop)
        except SkuggaError as error:
            print(f"skipped: {error}", flush=True)


def read_raster(path: Path, crop: int) -> Raster:
    """Read heights from the middle of a raster, around the median position of its valid cells. Raises ``SourceError``.

    ``crop`` is the largest number of rows and of columns.
    """
    elevation = Elevation(str(path))
    shape = elevation.shape
    valid_indices = np.nonzero(np.isfinite(elevation.overview.mean_heights_m))
    size = [min(crop, length) for length in shape]
    middle = [int(np.median(indices) + 0.5) * 2**elevation.overview.lod for indices in valid_indices]
    first = [int(np.clip(m - s // 2, 0, length - s)) for m, s, length in zip(middle, size, shape, strict=True)]
    row, col = np.meshgrid(*(f + np.arange(s, dtype=float) for f, s in zip(first, size, strict=True)), indexing="ij")
    height_m, valid = elevation.heights_at(0, row, col)
    unit_m = 1.0 if elevation.crs.is_geographic else elevation.crs.axis_info[0].unit_conversion_factor
    if elevation.vertical.unit_source is None:  # by default heights are in the unit of the map: feet in feet
        height_m = height_m * np.float32(unit_m)
    name = f"{path.parent.name}/{path.stem}"
    cell_m = _cell_sides_m(elevation, first[0] + size[0] / 2, first[1] + size[1] / 2, unit_m)
    elevation.close()
    return Raster(name, height_m, valid, cell_m)


def _cell_sides_m(elevation: Elevation, row: float, col: float, unit_m: float) -> tuple[float, float]:
    """Return the sides (row, column) in metres of the cell at a row and column."""
    x, y = elevation.xy(np.array([row - 0.5, row + 0.5, row, row]), np.array([col, col, col - 0.5, col + 0.5]))
    if elevation.crs.is_geographic:
        _, _, length = WGS84.inv(x[::2], y[::2], x[1::2], y[1::2])
        return float(length[0]), float(length[1])
    return tuple(float(np.hypot(x[k + 1] - x[k], y[k + 1] - y[k])) * unit_m for k in (0, 2))  # type: ignore[return-value]


def measure(raster: Raster, suns: list[tuple[float, float]], lines: int) -> list[SweepFigures]:
    """Return the errors of the sweep on one raster under suns (azimuth, altitude) in degrees. ``lines`` is the number per cell."""
    rays = GridRays(raster.height_m, raster.cell_m)
    figures = []
    for sun in suns:
        truth = rays.truth(*sun)
        figures.append(
            compare_with_truth(raster, sunlit_nodes(raster.height_m, raster.cell_m, *sun, lines=lines), truth, truth.certain, *sun)
        )
    return figures


def format_report(rasters: list[Raster], all_figures: list[SweepFigures], lines: int) -> list[str]:
    """Format Markdown: a row per raster, and a summary. ``lines`` is the sweep's number of lines per cell."""
    # report_pages imports benchmarks.sweep_speed, which imports this module
    from benchmarks.report_pages import format_provenance, measured_here

    rows = [
        f"# Report: the line sweep against rays: {lines} line(s) a cell",
        "",
        format_provenance(measured_here("python -m benchmarks.sweep_accuracy FOLDER --markdown FILE")),
        "",
        "Shares of decided cells in per cent; `interior`: wrong and farther than 2 cells from truth's boundary.",
        "Steepest: from a cell to its neighbour. Undecided: of all cells.",
        "",
        "| raster | size | cell m | steepest | wrong: mean | worst | at | its shadow | `interior` | worst | undecided |",
        "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for raster in sorted(rasters, key=lambda raster: -raster.steepest_deg):
        figures = [row for row in all_figures if row.raster == raster.name]
        worst = max(figures, key=lambda f: f.wrong)
        means = {key: np.mean([getattr(f, key) for f in figures]) for key in ("wrong", "interior", "undecided")}
        rows.append(
            f"| {raster.name} | {raster.height_m.shape[1]} x {raster.height_m.shape[0]} | "
            f"{raster.cell_m[1]:.4g} x {raster.cell_m[0]:.4g} | {raster.steepest_deg:.0f}° | {100 * means['wrong']:.4f} | "
            f"{100 * worst.wrong:.4f} | {worst.azimuth_deg:g} / {worst.altitude_deg:g} | {100 * worst.shadow:.1f} | "
            f"{100 * means['interior']:.5f} | {100 * max(f.interior for f in figures):.5f} | "
            f"{100 * means['undecided']:.3f} |"
        )
    return rows + ["", *_summary(all_figures)]


def _summary(figures: list[SweepFigures]) -> list[str]:
    """Format the mean and the worst errors over all rasters and suns, by altitude and by azimuth."""
    wrong_shares = np.array([f.wrong for f in figures])
    azimuths, altitudes = (sorted({getattr(f, key) for f in figures}) for key in ("azimuth_deg", "altitude_deg"))
    per_azimuth = [np.mean([f.wrong for f in figures if f.azimuth_deg == azimuth]) for azimuth in azimuths]
    worst, middle = float(np.max(per_azimuth)), float(np.median(per_azimuth))
    cells = sum(f.cells for f in figures)
    count = sum(f.wrong * f.cells for f in figures)
    by_altitude = ", ".join(f"{a:g}°: {100 * np.mean([f.wrong for f in figures if f.altitude_deg == a]):.4f} %" for a in altitudes)
    shares = {key: 100 * np.mean([getattr(f, key) for f in figures]) for key in ("false_shadow", "missed_shadow", "interior")}
    return [
        f"Over {len(figures)} pictures: wrong {100 * wrong_shares.mean():.4f} % (false {shares['false_shadow']:.4f} %, missed "
        f"{shares['missed_shadow']:.4f} %), worst {100 * wrong_shares.max():.4f} %; by altitude {by_altitude}; "
        f"{100 * count / max(cells, 1):.4f} % of all {cells / 1e6:.0f} million cells.",
        f"Interior {shares['interior']:.5f} %, worst {100 * max(f.interior for f in figures):.5f} %.",
        f"Azimuths: the worst ({azimuths[int(np.argmax(per_azimuth))]:g}°) has {100 * worst:.4f} %, the median one "
        f"{100 * middle:.4f} %: " + (f"{worst / middle:.2f} times as many." if middle > 0 else "no ratio, as the median has none."),
    ]


def main() -> None:
    """Measure the rasters of the command line in parallel processes, and print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--azimuths", type=int, default=24, help="number of azimuths, evenly spaced from half a step on")
    parser.add_argument("--altitudes", type=float, nargs="+")
    parser.add_argument(
        "--all-azimuths", metavar="NAME", help="measure the azimuths 0 to 359 degrees on the raster whose name contains NAME"
    )
    parser.add_argument("--lines", type=int, default=8)
    parser.add_argument("--crop", type=int)
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--json", type=Path, help="file for the figures under every sun")
    args = parser.parse_args()
    every = args.all_azimuths is not None
    azimuths = np.arange(360.0) if every else (np.arange(args.azimuths) + 0.5) * 360.0 / args.azimuths
    if not every and not (azimuths % 45.0).all():
        parser.error(
            f"--azimuths: {args.azimuths} azimuths include multiples of 45 degrees, where the sweep has no errors. Use 8, 24 or 72."
        )
    suns = [(float(a), h) for h in args.altitudes or ([10.0] if every else [3.0, 10.0, 30.0]) for a in azimuths]
    rasters = list(read_rasters(args.folder, args.crop or (512 if every else 1024)))
    if every:
        rasters = [raster for raster in rasters if args.all_azimuths in raster.name][:1]
    if not rasters:
        name_text = f" with '{args.all_azimuths}' in its name" if every else ""
        parser.error(f"{args.folder} contains no raster of heights{name_text}.")
    rasters.sort(key=lambda raster: -raster.height_m.size)  # the longest work first, so that no core idles at the end
    parts = [suns[first :: args.processes] for first in range(args.processes)] if every else [suns]
    start, figures = time.perf_counter(), []
    with ProcessPoolExecutor(args.processes) as pool:
        work = {pool.submit(measure, raster, part, args.lines): raster.name for raster in rasters for part in parts}
        for future in as_completed(work):
            figures += future.result()
            mean, worst = (100 * f([row.wrong for row in future.result()]) for f in (np.mean, np.max))
            print(f"{time.perf_counter() - start:4.0f} s  {work[future]}: wrong {mean:.4f} %, worst {worst:.4f} %", flush=True)
    lines = format_report(rasters, figures, args.lines)
    print("\n".join(lines))
    if args.markdown:
        args.markdown.write_text("\n".join(lines) + "\n", encoding="utf-8")
    if args.json:
        args.json.write_text(json.dumps([asdict(row) for row in figures], indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
