"""Colour scales of data layers, and their legends."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from skugga.terrain.cache import MIB, cached

LegendFormat = Literal["png", "svg"]
LEGEND_MEDIA_TYPES: dict[LegendFormat, str] = {"png": "image/png", "svg": "image/svg+xml"}

LEGEND_SIZE_INCHES = (3.4, 0.85)
"""Width and height of a legend in inches, at 100 pixels per inch."""

LEGEND_SIZE_PX = 340, 85
"""Width and height of a legend, pixels."""


@dataclass(frozen=True)
class ColorScale:
    """A colour map over a range of numbers.

    Attributes
    ----------
    title
        Title of the legend.
    colormap
        Name of a matplotlib colour map.
    low, high
        Ends of the range. Numbers beyond an end have its colour.
    ticks
        Numbers of the scale and their labels.
    """

    title: str
    colormap: str
    low: float
    high: float
    ticks: tuple[tuple[float, str], ...]

    def to_rgba(self, values: np.ndarray) -> np.ndarray:
        """Return numbers (rows, cols) as RGBA, uint8 (rows, cols, 4); NaN and infinity are transparent."""
        valid = np.isfinite(values)
        fraction = (np.where(valid, values, self.low) - self.low) / (self.high - self.low)
        out = _colormap_table(self.colormap)[np.clip(np.rint(fraction * 255.0), 0, 255).astype(np.uint8)]
        out[~valid] = 0
        return out

    def entries(self) -> list[dict[str, Any]]:
        """Return the ticks as JSON objects with value, label and colour (``#rrggbb``)."""
        colors = self.to_rgba(np.array([[value for value, _ in self.ticks]]))[0]
        return [
            {"value": value, "label": label, "color": "#" + bytes(color[:3]).hex()}
            for (value, label), color in zip(self.ticks, colors, strict=True)
        ]

    def legend(self, format: LegendFormat) -> bytes:
        """Return the legend as a picture file: a colour bar with ticks below and the title above."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import Normalize
        from matplotlib.figure import Figure

        figure = Figure(figsize=LEGEND_SIZE_INCHES, dpi=100, facecolor="white")
        FigureCanvasAgg(figure)
        axes = figure.add_axes((0.06, 0.36, 0.88, 0.26))
        bar = figure.colorbar(
            ScalarMappable(Normalize(self.low, self.high), self.colormap), cax=axes, orientation="horizontal",
            ticks=[value for value, _ in self.ticks],
        )  # fmt: skip
        bar.ax.set_xticklabels([label for _, label in self.ticks], fontsize=8)
        bar.ax.set_title(self.title, fontsize=9, pad=5)
        out = io.BytesIO()
        figure.savefig(out, format=format, metadata={"Date": None} if format == "svg" else {"Software": None})
        return out.getvalue()


@cached("process", MIB)
def _colormap_table(colormap: str) -> np.ndarray:
    """Return the 256 colours of a matplotlib colour map as RGBA, uint8 (256, 4), from its low to its high end.

    ``colormap`` is a name in matplotlib's registry, such as ``viridis``.
    """
    from matplotlib import colormaps

    return (colormaps[colormap](np.linspace(0.0, 1.0, 256)) * 255.0 + 0.5).astype(np.uint8)
