"""The plot of `benchmarks.peers`: seconds of computing against wrong cells, on logarithmic axes. Each point has a label."""

from __future__ import annotations

import io
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox
from PIL import Image

from benchmarks.peers.figures import ComparedRaster, PeerComparison, ToolStanding, standings_by_case

SKUGGA_COLOR, PEER_COLOR, TEXT_COLOR, GRID_COLOR = "#0072B2", "#D55E00", "#333333", "#E4E4E4"
"""Blue and vermilion of Okabe and Ito, which are safe for colour-blind readers; the shapes of the points differ, too."""

ZERO_ERROR_PERCENT = 1e-6
"""Position on the logarithmic axis of tools without any wrong cell."""

LABEL_OFFSETS = [(8, 0), (-8, 0), (0, 8), (0, -8), (6, 6), (-6, 6), (6, -6), (-6, -6)]
"""Candidate positions of a label at its point: offsets in points."""

LABEL_MARGIN_PX = 14.0
"""The margin of other labels around a point, to either side."""


def write_plot(comparison: PeerComparison, path: Path) -> None:
    """Write the plot, with a panel for each raster, as WebP."""
    with mpl.rc_context({"font.family": "DejaVu Sans", "font.size": 10, "text.color": TEXT_COLOR, "axes.edgecolor": TEXT_COLOR}):
        figure = Figure(figsize=(11.5, 5.4), dpi=140, layout="constrained")
        canvas = FigureCanvasAgg(figure)
        panels = np.atleast_1d(figure.subplots(1, len(comparison.terrains), sharex=True, sharey=True))
        for axes, terrain in zip(panels, comparison.terrains, strict=True):
            _draw_panel(axes, comparison, terrain)
        panels[0].set_ylabel("wrong cells off the grid's axes, %")
        figure.suptitle("Cast shadows of a DEM: time against error. Faster is left, more accurate is down", fontsize=13)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # labels are placed at the final positions of points
        for axes, terrain in zip(panels, comparison.terrains, strict=True):
            _draw_labels(axes, canvas, _raster_standings(comparison, terrain))
        png = io.BytesIO()
        figure.savefig(png, format="png")
    Image.open(png).convert("RGB").save(path, quality=90, method=6)


def _raster_standings(comparison: PeerComparison, terrain: ComparedRaster) -> list[ToolStanding]:
    """Return the tools' mean standings on a raster, over the suns off the grid's axes."""
    return standings_by_case(comparison, "computing")[f"{terrain.name}, mean off the axes"]


def _plot_xy(standing: ToolStanding) -> tuple[float, float]:
    """Return a tool's point in the plot: seconds and per cent of wrong cells, both above the axes' lower limits."""
    return max(standing.seconds, 1e-3), max(100.0 * standing.wrong, ZERO_ERROR_PERCENT)


def _draw_panel(axes: Axes, comparison: PeerComparison, terrain: ComparedRaster) -> None:
    """Draw the tools' points on a raster, and the axes' grid and legend, without labels of points."""
    axes.set(xscale="log", yscale="log", xlabel="seconds of computing, mean of three suns")
    axes.set_title(f"{terrain.name}, {terrain.rows * terrain.cols / 1e6:.1f} million cells", fontsize=11)
    axes.grid(color=GRID_COLOR)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    standings = _raster_standings(comparison, terrain)
    skugga_positions = np.array([_plot_xy(standing) for standing in standings if standing.tool.ours])
    axes.plot(*skugga_positions.T, "-o", color=SKUGGA_COLOR, markersize=8, linewidth=1.5, label="Skugga")
    for is_upper_bound, label in ((False, "others"), (True, "others: at most so long")):
        positions = np.array(
            [
                _plot_xy(standing)
                for standing in standings
                if not standing.tool.ours and comparison.has_upper_bounds(standing.tool) == is_upper_bound
            ]
        )
        if len(positions):
            axes.plot(
                *positions.T,
                "D",
                color=PEER_COLOR,
                markersize=7,
                markerfacecolor="white" if is_upper_bound else PEER_COLOR,
                label=label,
            )
    axes.margins(x=0.12, y=0.12)
    axes.yaxis.set_major_formatter(
        lambda value, _: "none" if value < 1.5 * ZERO_ERROR_PERCENT else f"{value:.6f}".rstrip("0").rstrip(".")
    )
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.minorticks_off()
    axes.legend(loc="lower right", frameon=False)


def _draw_labels(axes: Axes, canvas: FigureCanvasAgg, standings: list[ToolStanding]) -> None:
    """Place each label where it overlaps points and other labels least."""
    renderer = canvas.get_renderer()
    points = axes.transData.transform([_plot_xy(standing) for standing in standings])
    occupied = [
        Bbox.from_extents(x - LABEL_MARGIN_PX, y - LABEL_MARGIN_PX, x + LABEL_MARGIN_PX, y + LABEL_MARGIN_PX) for x, y in points
    ]
    occupied.append(axes.get_legend().get_window_extent(renderer))  # type: ignore[union-attr]
    panel_box = axes.get_window_extent(renderer)
    for standing in standings:
        color = SKUGGA_COLOR if standing.tool.ours else PEER_COLOR
        name = standing.tool.name.removeprefix("Skugga sweep, ") if standing.tool.ours else standing.tool.name.split()[0]
        candidates = []
        for x, y in LABEL_OFFSETS:
            horizontal, vertical = (
                "left" if x > 0 else "right" if x < 0 else "center",
                "bottom" if y > 0 else "top" if y < 0 else "center",
            )
            text = axes.annotate(
                name, _plot_xy(standing), (x, y), textcoords="offset points", ha=horizontal, va=vertical, color=color, fontsize=10
            )
            box = text.get_window_extent(renderer)
            outside = box.width * box.height - _overlap_area(box, panel_box)
            candidates.append((outside + sum(_overlap_area(box, other) for other in occupied), text, box))
        best = min(candidates, key=lambda candidate: candidate[0])
        for _, text, _ in candidates:
            if text is not best[1]:
                text.remove()
        occupied.append(best[2])


def _overlap_area(box: Bbox, other: Bbox) -> float:
    """Return the area that two boxes share, in square pixels."""
    shared = Bbox.intersection(box, other)
    return 0.0 if shared is None else shared.width * shared.height
