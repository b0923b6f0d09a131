"""Colours and files that the charts of a point share."""

from __future__ import annotations

import io
from collections.abc import Callable
from typing import Any, Literal

ChartFormat = Literal["svg", "png"]

DOTS_PER_INCH = 120
"""Resolution of PNG files."""

PAPER_COLOR, INK_COLOR, GRID_COLOR, LABEL_COLOR = "#ffffff", "#2b2b2b", "#c4ccd4", "#6c7680"
RELIEF_COLOR, SOLIDS_COLOR, FOREST_COLOR = "#8d8373", "#b3705c", "#6f8f5f"
SUN_COLOR, SKY_LIGHT_COLOR, REFLECTED_COLOR = "#e8a200", "#7f9fbf", "#c9b99a"
_FONT = ["DejaVu Sans"]


def chart_file(size_inches: tuple[float, float], format: ChartFormat, draw: Callable[[Any], None]) -> bytes:
    """Return a chart as an SVG or PNG file. ``draw`` draws on the empty matplotlib figure that it receives."""
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "skugga", "svg.fonttype": "path", "font.family": _FONT}):
        figure = Figure(figsize=size_inches, facecolor=PAPER_COLOR)
        FigureCanvasAgg(figure)
        draw(figure)
        file = io.BytesIO()
        figure.savefig(file, format=format, dpi=DOTS_PER_INCH, metadata={"Date": None} if format == "svg" else None)
    return file.getvalue()


def place_text(lon_deg: float | None, lat_deg: float | None, ground_m: float, height_m: float) -> str:
    """Return a position and its height as text; the height alone in a flat world."""
    height = f"{ground_m:.0f} m" + (f", {height_m:g} m above the ground" if height_m else "")
    if lon_deg is None or lat_deg is None:
        return height
    lon = f"{abs(lon_deg):.5f}° {'E' if lon_deg >= 0 else 'W'}"
    lat = f"{abs(lat_deg):.5f}° {'N' if lat_deg >= 0 else 'S'}"
    return f"{lat}, {lon}, {height}"
